//! The simulated person of the hall: clears what is broken and carries back what a robot was left with, after some
//! minutes.
//!
//! Invariant: a person acts on bodies alone and knows of the server only which tasks live, if told.
//! Called every few seconds of site time by whoever runs the swarm.

use crate::faults::draw_secs;
use crate::handle::SimHandle;
use midshift_agent::body::Body;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::Mode;
use midshift_core::time::SiteTime;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// Seconds of site time until a person is there.
const COMES_AFTER_S: std::ops::RangeInclusive<u64> = 120..=300;

/// What a person saw at a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Need {
    Broken,
    Left,
    Driven,
}

/// What a person did.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Deed {
    /// Mended a robot.
    Cleared(RobotId),
    /// Carried a robot's load back.
    CarriedBack(RobotId),
    /// Handed a robot back to its agent.
    HandedBack(RobotId),
}

/// One person for all robots; everything drawn comes from the seed.
#[derive(Debug)]
pub struct Person {
    rng: ChaCha8Rng,
    due: BTreeMap<(RobotId, Need), SiteTime>,
}

impl Person {
    /// A person who has seen nothing yet.
    pub fn new(seed: u64) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed ^ 0x7065_7273_6f6e), due: BTreeMap::new() }
    }
    /// Looks at every robot, remembers what is new, and does what is due. `live` says whether a task still wants its
    /// item from the robot that carries it; without knowledge of tasks say `false`: then a load goes back from any
    /// robot that has stood without an order for as long as it takes the person to come.
    pub fn round(&mut self, now: SiteTime, robots: &[SimHandle], live: &dyn Fn(&TaskId) -> bool) -> Vec<Deed> {
        let mut deeds = Vec::new();
        for robot in robots {
            for need in [Need::Broken, Need::Left, Need::Driven] {
                let key = (robot.robot_id().clone(), need);
                if !needs(robot, now, need, live) {
                    self.due.remove(&key);
                } else if let Some(due) = self.due.get(&key) {
                    if *due <= now {
                        self.due.remove(&key);
                        deeds.push(help(robot, now, need));
                    }
                } else {
                    let comes = now + draw_secs(&mut self.rng, COMES_AFTER_S);
                    self.due.insert(key, comes);
                }
            }
        }
        deeds
    }
}

fn needs(robot: &SimHandle, now: SiteTime, need: Need, live: &dyn Fn(&TaskId) -> bool) -> bool {
    let mut body = robot.lock();
    body.advance(now);
    match need {
        Need::Broken => body.broken().is_some(),
        Need::Driven => body.mode() != Mode::Automatic,
        Need::Left => {
            let wanted = |load: midshift_core::robot::Load| load.task_id.is_some_and(|t| live(&t));
            body.idle_since().is_some() && body.load().is_some_and(|load| !wanted(load))
        }
    }
}

fn help(robot: &SimHandle, now: SiteTime, need: Need) -> Deed {
    let mut body = robot.lock();
    let id = robot.robot_id().clone();
    match need {
        Need::Broken => {
            body.clear(now);
            Deed::Cleared(id)
        }
        Need::Left => {
            body.take_load(now);
            Deed::CarriedBack(id)
        }
        Need::Driven => {
            body.hand_back(now);
            Deed::HandedBack(id)
        }
    }
}
