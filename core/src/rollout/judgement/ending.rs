//! Says how a roll-out ended that nothing ended early: with its bundle on as many robots as its spec asks, or not.
//!
//! Invariants:
//! 1. An incomplete roll-out serves nobody who comes later.
//! 2. Robots that are tried again, or come back, can complete it; nothing makes it incomplete afterwards.

use crate::ids::RolloutId;
use crate::reason::{Code, Reason};
use crate::rollout::decision::plan::{Tx, incident};
use crate::rollout::members::area_bundles::serve_newcomers;
use crate::rollout::projection::queue::is_newcomer;
use crate::rollout::projection::rows::{Ending, Phase, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;

const OFFERED_TO_NOBODY: &str = "A roll-out ended that was offered to no robot: people had excluded, pinned or retired \
     all of them, or it had none.";

/// Robots of a roll-out as its ending counts them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Share {
    /// Robots that the bundle was offered to. Whom a person kept from it is not among them.
    pub offered: u32,
    /// Of these, robots that keep it, had it already, or are about to keep it. Where a roll-out takes one back: robots
    /// that went back.
    pub reached: u32,
}

/// Counts robots.
pub fn count_share(view: &RolloutProjection, rollout: &Rollout) -> Share {
    let mut share = Share::default();
    for r in view.robots_of(&rollout.rollout_id).filter(|r| is_offered(rollout, r)) {
        share.offered += 1;
        share.reached += u32::from(is_reached(rollout, r));
    }
    share
}

fn is_offered(rollout: &Rollout, r: &RolloutRobot) -> bool {
    let by_person = [Code::SkippedExcluded, Code::SkippedPinned, Code::SkippedRetired];
    let kept_out = r.step == Step::Skipped && r.why.as_ref().is_some_and(|why| by_person.contains(&why.code));
    let came_later = is_newcomer(rollout, r) && !r.again;
    !kept_out && !came_later
}

fn is_reached(rollout: &Rollout, r: &RolloutRobot) -> bool {
    match r.step {
        Step::RolledBack => rollout.revert_of.is_some(),
        Step::Committed | Step::Committing => rollout.revert_of.is_none(),
        // Its wave is kept: it is told so next.
        Step::Trial => r.failure.is_none() && r.wave < rollout.promoted,
        Step::Skipped => {
            rollout.revert_of.is_none() && r.why.as_ref().is_some_and(|why| why.code == Code::SkippedCurrent)
        }
        _ => false,
    }
}

/// How a roll-out ends, or would as things are. One that was offered to nobody has brought nothing.
pub fn judge_ending(view: &RolloutProjection, rollout: &Rollout) -> Ending {
    let Share { offered, reached } = count_share(view, rollout);
    let enough =
        offered > 0 && u64::from(reached) * 100 >= u64::from(offered) * u64::from(rollout.spec.complete_percent);
    if enough { Ending::Complete } else { Ending::Incomplete }
}

/// Decides how it ends: who comes later is served by it, or a person is told.
pub fn decide_ending(tx: &mut Tx, rollout: &Rollout) -> Ending {
    let ending = judge_ending(tx.view, rollout);
    match ending {
        Ending::Complete => serve_newcomers(tx, rollout),
        Ending::Incomplete => {
            let Share { offered, reached } = count_share(tx.view, rollout);
            let code = Code::RolloutIncomplete;
            let told = if offered == 0 { Reason::new(code, OFFERED_TO_NOBODY) } else { code.into() };
            let told = told.with("rollout_id", &rollout.rollout_id).with("offered", offered).with("reached", reached);
            incident(tx, None, &told.with("complete_percent", rollout.spec.complete_percent));
        }
    }
    ending
}

/// Completes one that ended incomplete, once enough robots have come after all.
pub fn reconsider_ending(tx: &mut Tx, id: &RolloutId) {
    let Some(rollout) = tx.view.rollout(id).cloned() else { return };
    let was_short = rollout.phase == Phase::Completed && rollout.outcome == Some(Ending::Incomplete);
    if was_short && judge_ending(tx.view, &rollout) == Ending::Complete {
        serve_newcomers(tx, &rollout);
        tx.put_row(Rollout { outcome: Some(Ending::Complete), ..rollout }, "rollout.complete_after_all");
    }
}
