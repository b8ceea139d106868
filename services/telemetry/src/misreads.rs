//! Counts by robot how often it dialled and was refused because what it said could not be read, so that people are told when that goes on.
//!
//! Invariant: of one robot at most one fact a minute, whatever it sends.

use midshift_core::ids::RobotId;
use midshift_core::limits;
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::time::Instant;

/// Robots that are counted at once: where nobody logs in, names cost nothing.
const ROBOTS_MAX: usize = 1_024;
/// Since when each robot is counted, and how often it was refused since. Volatile.
#[derive(Debug, Default)]
pub struct Misreads(Mutex<BTreeMap<RobotId, (Instant, u32)>>);

impl Misreads {
    /// Counts one. Whether people should hear of it now.
    pub fn count(&self, robot_id: &RobotId, now: Instant) -> bool {
        let within = Duration::from_millis(limits::MISREADS_WITHIN.as_ms());
        let mut robots = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        robots.retain(|_, (since, _)| now < *since + within);
        if robots.len() >= ROBOTS_MAX && !robots.contains_key(robot_id) {
            return false;
        }
        let (_, times) = robots.entry(robot_id.clone()).or_insert((now, 0));
        *times += 1;
        *times == limits::MISREADS_TOLD
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_is_told_of_once_a_minute_at_its_fifth_refusal() {
        let (misreads, begin) = (Misreads::default(), Instant::now());
        let id = |name: &str| RobotId::parse(name).expect("an id");
        let at = |name, secs| misreads.count(&id(name), begin + Duration::from_secs(secs));
        assert_eq!([0, 1, 2, 3, 4, 5, 59].map(|secs| at("r1", secs)), [false, false, false, false, true, false, false]);
        assert_eq!([60, 61, 62, 63].map(|secs| at("r1", secs)), [false; 4]);
        assert!(!at("r2", 63), "each robot is counted by itself");
        assert!(at("r1", 64), "it goes on");
    }

    #[test]
    fn refusals_that_are_far_apart_are_nobodys_matter() {
        let (misreads, begin) = (Misreads::default(), Instant::now());
        let robot_id = RobotId::parse("r1").expect("an id");
        for nth in 0..100_u32 {
            assert!(!misreads.count(&robot_id, begin + nth * Duration::from_secs(20)));
        }
    }

    #[test]
    fn names_that_are_made_up_take_no_more_memory_than_so_many_robots() {
        let (misreads, now) = (Misreads::default(), Instant::now());
        for nth in 0..2 * ROBOTS_MAX {
            misreads.count(&RobotId::parse(&format!("r{nth}")).expect("an id"), now);
        }
        assert_eq!(misreads.0.lock().expect("not poisoned").len(), ROBOTS_MAX);
    }
}
