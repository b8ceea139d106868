//! Naive rules that twins of tests switch on at run time; compiled only with the feature `seeded-bugs`.

/// Which naive rules are on. The default has none, and without the feature there are none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bugs {
    /// Acknowledge events when they arrive, before their commit.
    #[cfg(feature = "seeded-bugs")]
    pub ack_before_commit: bool,
    /// Let every session of a robot have work, whether or not it proved its succession.
    #[cfg(feature = "seeded-bugs")]
    pub no_clone_fence: bool,
}

impl Bugs {
    #[cfg(feature = "seeded-bugs")]
    pub(crate) const fn ack_before_commit(self) -> bool {
        self.ack_before_commit
    }
    #[cfg(not(feature = "seeded-bugs"))]
    pub(crate) const fn ack_before_commit(self) -> bool {
        false
    }
    #[cfg(feature = "seeded-bugs")]
    pub(crate) const fn no_clone_fence(self) -> bool {
        self.no_clone_fence
    }
    #[cfg(not(feature = "seeded-bugs"))]
    pub(crate) const fn no_clone_fence(self) -> bool {
        false
    }
}
