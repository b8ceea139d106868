//! How long an update waits before what failed is tried once more.
//!
//! Invariant: robots that failed at one moment, as when a server ends, do not all come back at one moment; what a robot
//! waits is drawn from its name and from how often it failed, so that a run can be played again.

use midshift_bundle::digest::Digest;
use midshift_core::ids::RobotId;
use midshift_core::time::LinkDuration;

/// Longest pause after the first failure, and after any.
const LONGEST: (LinkDuration, LinkDuration) = (LinkDuration(1_000), LinkDuration(60_000));

/// The pause after so many failures in a row: between a half of the longest that there is after so many, and all of it.
pub(crate) fn pause(robot_id: &RobotId, failures: u32) -> LinkDuration {
    let (first, most) = LONGEST;
    let longest = first.as_ms().saturating_mul(1 << failures.saturating_sub(1).min(6)).min(most.as_ms());
    let drawn = u64::from(Digest::of_content(format!("{failures} {robot_id}").as_bytes()).bytes()[0]);
    LinkDuration(longest / 2 + longest / 2 * drawn / u64::from(u8::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    fn robots() -> impl Iterator<Item = RobotId> {
        (0..100).map(|nth| RobotId::parse(&format!("rbt-{nth}")).expect("a name"))
    }

    #[test]
    fn pauses_double_to_a_minute() {
        for robot in robots() {
            for (failures, longest) in
                [(1, 1_000), (2, 2_000), (3, 4_000), (6, 32_000), (7, 60_000), (u32::MAX, 60_000)]
            {
                let pause = pause(&robot, failures).as_ms();
                assert!((longest / 2..=longest).contains(&pause), "{robot} after {failures}: {pause}");
            }
        }
    }

    #[test]
    fn robots_that_failed_together_come_back_apart() {
        for failures in [1, 4, 9] {
            let pauses: BTreeSet<u64> = robots().map(|robot| pause(&robot, failures).as_ms()).collect();
            assert!(pauses.len() > 50, "after {failures}: {pauses:?}");
        }
    }
}
