//! Since when heartbeats list the load at hand, so that a person's word about a load never reaches a newer one.
//!
//! Invariant: a word takes away only what its heartbeat listed and what has not changed since. Called by the core alone.

use crate::core::AgentCore;
use midshift_core::robot::Load;
use midshift_core::time::Now;
use midshift_core::work::LoadWord;

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
    fn was_in(&self, load: &Load, hb: u64) -> bool {
        self.0.as_ref().is_some_and(|(since, listed)| listed == load && *since <= hb)
    }
}

impl AgentCore {
    /// Obeys a person's word that the robot carries nothing, where its body knows its load by memory alone.
    pub(crate) fn obey_load_word(&mut self, now: &Now, word: Option<LoadWord>) {
        let Some(word) = word.filter(|_| self.inventory.load_by_memory) else { return };
        let Some(load) = self.body.load() else { return };
        let is_meant = self.session_epoch() == Some(word.session_epoch) && self.listed_load.was_in(&load, word.hb);
        if !is_meant {
            return;
        }
        tracing::warn!(robot_id = %self.config.robot_id, "a person says that it carries nothing; its load is forgotten");
        self.body.forget_load(now.site);
        self.take_news(now);
        self.beat_at_once(now);
    }
}
