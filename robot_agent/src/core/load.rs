//! Since when heartbeats list the load at hand, so that a person's word about a load never reaches a newer one.
//!
//! Invariant: a word takes away only what its heartbeat listed and what has not changed since.

use midshift_core::robot::Load;

/// The load as heartbeats of the session at hand list it.
#[derive(Debug, Default)]
pub(crate) struct ListedLoad(Option<(u64, Load)>);

impl ListedLoad {
    /// Notes what heartbeat `hb` lists.
    pub(crate) fn note(&mut self, hb: u64, load: Option<&Load>) {
        if self.0.as_ref().map(|(_, listed)| listed) != load {
            self.0 = load.map(|load| (hb, load.clone()));
        }
    }

    /// Begins anew: the load has changed, or another session counts heartbeats.
    pub(crate) fn clear(&mut self) {
        self.0 = None;
    }

    /// Whether heartbeat `hb` and each one since listed this load.
    pub(crate) fn was_in(&self, load: &Load, hb: u64) -> bool {
        self.0.as_ref().is_some_and(|(since, listed)| listed == load && *since <= hb)
    }
}
