//! Naive rules that tests may switch on, to prove that the right ones are needed. Only with the feature `seeded-bugs`.
//!
//! Invariant: without the feature every question here is answered `false` at compile time.

/// One naive rule.
#[cfg(feature = "seeded-bugs")]
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SeededBug {
    /// An offer or a resume is valid from its receipt, whatever heartbeat anchors it.
    AuthorityFromReceipt,
    /// A place may be entered for its validity from the receipt of the grant.
    GrantFromReceipt,
    /// The ledger refuses no passed epoch and no finished task.
    NoEpochFence,
    /// A second attempt is taken while another holds the robot.
    IgnoreHolder,
    /// A session is kept however long the server is silent.
    PatientSession,
}

/// Which naive rules are on. None by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bugs {
    #[cfg(feature = "seeded-bugs")]
    on: u8,
}

#[cfg(feature = "seeded-bugs")]
impl Bugs {
    /// With these rules on.
    pub fn of(bugs: &[SeededBug]) -> Self {
        Self { on: bugs.iter().fold(0, |on, bug| on | 1 << *bug as u8) }
    }
    fn has(self, bug: SeededBug) -> bool {
        self.on & (1 << bug as u8) != 0
    }
}

macro_rules! questions {
    ($($name:ident $bug:ident;)*) => {
        impl Bugs {
            $(pub(crate) fn $name(self) -> bool {
                #[cfg(feature = "seeded-bugs")]
                { self.has(SeededBug::$bug) }
                #[cfg(not(feature = "seeded-bugs"))]
                { false }
            })*
        }
    };
}

questions! {
    authority_from_receipt AuthorityFromReceipt;
    grant_from_receipt GrantFromReceipt;
    no_epoch_fence NoEpochFence;
    ignore_holder IgnoreHolder;
    patient_session PatientSession;
}
