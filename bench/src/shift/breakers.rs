//! The person who looks at robots that their breaker took out of work, and lets them work again.
//!
//! A breaker opens after three failed attempts in ten minutes and stays open until a person says otherwise: without one
//! a fleet with faults shrinks. The person comes as late as one who mends a body.

use super::control_plane::ControlPlane;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// Seconds until a person has looked.
const COMES_AFTER_S: std::ops::RangeInclusive<u64> = 120..=300;

/// The watch over breakers.
pub struct BreakerWatch {
    rng: ChaCha8Rng,
    /// When each robot that is out of work is looked at, milliseconds since the beginning.
    due_ms: BTreeMap<String, u64>,
    reinstated: u64,
}

impl BreakerWatch {
    /// Nobody is out of work yet.
    pub fn new(seed: u64) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6272_6561_6b65);
        Self { rng, due_ms: BTreeMap::new(), reinstated: 0 }
    }

    /// Robots that were let work again so far.
    pub fn reinstated(&self) -> u64 {
        self.reinstated
    }

    /// Lets robots work again for which it is time. While the planner is away nobody can say so.
    ///
    /// # Errors
    /// The planner does not answer, or refuses.
    pub async fn look_at_robots(&mut self, plane: &ControlPlane, now_ms: u64) -> anyhow::Result<()> {
        if plane.is_planner_away() {
            return Ok(());
        }
        let broken_off = plane.list_broken_off().await?;
        self.due_ms.retain(|robot_id, _| broken_off.contains(robot_id));
        for robot_id in broken_off {
            let rng = &mut self.rng;
            let comes_ms = || now_ms + 1_000 * rng.random_range(COMES_AFTER_S);
            if *self.due_ms.entry(robot_id.clone()).or_insert_with(comes_ms) <= now_ms {
                plane.reinstate_robot(robot_id).await?;
                self.reinstated += 1;
            }
        }
        Ok(())
    }
}
