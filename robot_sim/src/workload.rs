//! Seeded work for a site: transports between its stations, and when the next one comes.
//!
//! Invariant: the same seed and site give the same work. It submits nothing; the client of `dev` does.

use midshift_core::ids::WaypointId;
use midshift_core::site::Site;
use midshift_core::task::forms::Transport;
use midshift_core::time::SiteDuration;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What the transports of a workload have in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkloadConfig {
    /// Decides all that is drawn.
    pub seed: u64,
    /// 0..=9; 7 leaves a user's own task before the background.
    pub priority: i64,
    /// Milliseconds of site time for one attempt.
    pub timeout_ms: i64,
    /// Attempts after the first.
    pub max_retry_times: i64,
    /// Kinds of items.
    pub skus: u32,
}

impl WorkloadConfig {
    /// The background work of `dev`.
    pub const fn background(seed: u64) -> Self {
        Self { seed, priority: 7, timeout_ms: 600_000, max_retry_times: 3, skus: 40 }
    }
}

/// The generator.
#[derive(Debug)]
pub struct Workload {
    config: WorkloadConfig,
    rng: ChaCha8Rng,
    ends: Vec<WaypointId>,
}

impl Workload {
    /// Between the stations of a site; where it has none, between all waypoints where items can be handled. None: there
    /// are fewer than two.
    pub fn new(config: WorkloadConfig, site: &Site) -> Option<Self> {
        let name = |at| site.name_of(at).clone();
        let mut ends: Vec<WaypointId> = site.stations().map(name).collect();
        if ends.is_empty() {
            let all = (0..site.waypoints().len() as u32).map(midshift_core::site::WaypointIx);
            ends = all.filter(|at| site.can_handle(*at)).map(name).collect();
        }
        let rng = ChaCha8Rng::seed_from_u64(config.seed ^ 0x776f_726b);
        (ends.len() >= 2).then_some(Self { config, rng, ends })
    }
    /// The next transport: two different ends and an item.
    pub fn next_transport(&mut self) -> Transport {
        let from = self.rng.random_range(0..self.ends.len());
        let other = self.rng.random_range(0..self.ends.len() - 1);
        let to = if other >= from { other + 1 } else { other };
        Transport {
            kind: "transport".to_owned(),
            priority: Some(self.config.priority),
            from_waypoint: self.ends[from].to_string(),
            to_waypoint: self.ends[to].to_string(),
            item_sku: format!("SKU-{:03}", self.rng.random_range(1..=self.config.skus.max(1))),
            timeout_ms: Some(self.config.timeout_ms),
            max_retry_times: Some(self.config.max_retry_times),
            ..Transport::default()
        }
    }
    /// Site time until the next arrival of a Poisson process.
    pub fn next_gap(&mut self, per_hour: f64) -> SiteDuration {
        let draw = -(1.0 - self.rng.random::<f64>()).ln();
        SiteDuration((draw * 3_600_000.0 / per_hour.max(1e-6)) as u64)
    }
}
