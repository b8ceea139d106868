//! An action under way: what is done, to which item, and how it will end.

use midshift_core::time::SiteDuration;

/// What is done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Deed {
    Pick,
    Place,
    Inspect,
    Wait,
}

/// An action under way.
#[derive(Clone, Debug)]
pub(super) struct Act {
    pub(super) deed: Deed,
    /// As the step named it; empty: any.
    pub(super) item: String,
    pub(super) left: SiteDuration,
    pub(super) jams: bool,
    pub(super) misses: bool,
}

impl Act {
    /// Whether joints move.
    pub(super) fn works(&self) -> bool {
        self.deed != Deed::Wait
    }
}
