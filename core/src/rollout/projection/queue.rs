//! Whose turn it is in a roll-out, and since when. Reads rows only.
//!
//! Called by every room that waits for a robot or passes one over.

use super::rows::{Phase, Rollout, RolloutRobot, Step};
use crate::limits;
use crate::reason::Code;
use crate::time::{Now, Utc};

/// The robot's turn has come.
pub fn is_on(rollout: &Rollout, r: &RolloutRobot) -> bool {
    match rollout.phase {
        Phase::Applying => r.wave <= rollout.wave,
        // Newcomers of a completed roll-out come one by one.
        Phase::Completed => is_newcomer(rollout, r),
        _ => false,
    }
}

/// It came after the roll-out was completed.
pub fn is_newcomer(rollout: &Rollout, r: &RolloutRobot) -> bool {
    r.wave > rollout.spec.waves.len() as u32
}

/// Reasons that may have passed by the end of a roll-out: the server's, and those of a robot that refused.
const PASSING: [Code; 7] = [
    Code::SkippedOffline,
    Code::SkippedBusy,
    Code::SkippedStuck,
    Code::NoRoom,
    Code::BaseTooSoon,
    Code::MetadataRefused,
    Code::DirectiveRefused,
];

/// Whether a robot that was skipped is tried once more at the end.
pub fn is_retried(r: &RolloutRobot) -> bool {
    r.why.as_ref().is_some_and(|why| PASSING.contains(&why.code))
}

/// How long, in milliseconds since it was skipped, a robot said that it must wait until it can take the bundle. None:
/// it is not waited for, or was tried again.
pub fn waits_out(r: &RolloutRobot) -> Option<u64> {
    let why = r.why.as_ref().filter(|why| why.code == Code::BaseTooSoon)?;
    let wait_ms = why.metadata.get("wait_ms")?.parse().ok()?;
    (r.step == Step::Skipped && !r.again).then_some(wait_ms)
}

/// The robot's turn came long ago. The time in which the roll-out stood still does not count.
pub fn is_late(now: &Now, rollout: &Rollout, r: &RolloutRobot) -> bool {
    now.ms_since(turn_came(rollout, r)) >= limits::STAGED_WITHIN.as_ms()
}

/// When the robot's turn came, or the roll-out went on after that.
pub fn turn_came(rollout: &Rollout, r: &RolloutRobot) -> Utc {
    rollout.since.max(r.since).max(rollout.resumed.unwrap_or_default())
}

/// A directive that was signed then is signed anew if it was not taken.
pub fn is_directive_old(now: &Now, signed: Utc) -> bool {
    now.wall.ms_since(signed) >= limits::DIRECTIVE_RENEWED_MS
}
