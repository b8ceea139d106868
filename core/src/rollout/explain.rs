//! What one robot of a roll-out waits for, since when, and until when at most. Reads only; the planner's own questions.
//!
//! Invariant: a moment until which something is waited for lies ahead; what is overdue waits as long as it takes.

use crate::fleet::Board;
use crate::fleet::liveness;
use crate::fleet::rows::{Drain, DrainState};
use crate::ids::RobotId;
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::rollout::judgement::infrastructure;
use crate::rollout::projection::queue;
use crate::rollout::projection::rows::{Countdown, Phase, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::robots::{due, moves};
use crate::time::{Now, Utc};
use crate::update::UpdateState;

/// Robots that a reason names.
const NAMED_MAX: usize = 8;

/// Why nothing happens to a robot at this moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Blocked {
    /// What it waits for, or what keeps it.
    pub by: Reason,
    /// UTC, site clock.
    pub since: Utc,
    /// UTC, site clock, when it is given up; none: it waits as long as it takes.
    pub deadline: Option<Utc>,
}

/// What `r` waits for; none: nothing is left to do.
pub fn blocked(
    view: &RolloutProjection,
    board: &Board,
    now: &Now,
    rollout: &Rollout,
    r: &RolloutRobot,
) -> Option<Blocked> {
    let waits = silent(view, board, now, rollout, r).or_else(|| waits_for(view, board, now, rollout, r))?;
    let by = name_robots(view, board, now, rollout, waits.by);
    Some(Blocked { by, deadline: waits.deadline.filter(|deadline| *deadline > now.utc), ..waits })
}

/// A robot that is out of work and is not heard waits for nothing else: since when, and until when nobody is told.
fn silent(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout, r: &RolloutRobot) -> Option<Blocked> {
    r.drain_id.as_ref().filter(|id| view.drain(id).is_some_and(Drain::is_on))?;
    if liveness::presence(board, &r.robot_id, now) != Presence::Offline {
        return None;
    }
    let left_ms = rollout.spec.lost_after_ms.saturating_sub(infrastructure::silent_ms(view, board, now, &r.robot_id));
    let heard_ms = board.get(&r.robot_id).map(|live| now.site.since(live.processed_site).as_ms());
    let since = heard_ms.map_or(r.since, |ms| Utc(now.utc.0.saturating_sub_unsigned(ms)));
    let deadline = r.lost.is_none().then(|| now.utc.plus_ms(left_ms));
    let by = Reason::from(Code::BlockedBySilence).with("lost", r.lost.is_some()).with("counts", r.counts());
    Some(Blocked { by, since, deadline })
}

/// A reason that waits for room, with the robots that have it now.
fn name_robots(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout, by: Reason) -> Reason {
    let of_rollout = |r: &&RolloutRobot| r.drain_id.is_some() && r.counts();
    let robots: Vec<&RobotId> = match by.code {
        Code::BlockedByBudget => {
            let area = by.metadata.get("area_id").and_then(|area| view.budgets.get(area.as_str()));
            area.map(|area| area.row.off_work.iter().collect()).unwrap_or_default()
        }
        Code::BlockedByTurnInWave => {
            view.robots_of(&rollout.rollout_id).filter(of_rollout).map(|r| &r.robot_id).collect()
        }
        _ => return by,
    };
    let name = |id: &&RobotId| match liveness::presence(board, id, now) {
        Presence::Offline => format!("{id} (not heard)"),
        _ => format!("{id}"),
    };
    let names: Vec<String> = robots.iter().take(limits::CROWD_NAMED_MAX).map(name).collect();
    if names.is_empty() {
        return by;
    }
    let more = match robots.len() - names.len() {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    let names = names.join(", ") + &more;
    let message = format!("{} They are {names}.", by.code.help());
    let mut told = by.with("held_by", names);
    told.message = message;
    told
}

fn waits_for(
    view: &RolloutProjection,
    board: &Board,
    now: &Now,
    rollout: &Rollout,
    r: &RolloutRobot,
) -> Option<Blocked> {
    let mut since = r.since;
    let mut deadline = None;
    if let Some(by) = moves::why_unsigned(view, r)
        && let Some(due) = due::decide_move(view, board, now, rollout, r)
        && moves::is_signed(view, rollout, r, &due)
    {
        return Some(Blocked { by, since, deadline });
    }
    let by = match r.step {
        Step::Committed | Step::RolledBack | Step::Skipped => return None,
        Step::Waiting if !(rollout.phase.runs() || rollout.phase == Phase::Completed) => Code::BlockedByWave.into(),
        Step::Waiting | Step::Staged => {
            let by = due::blocked(view, board, now, rollout, r).unwrap_or_else(|| Code::BlockedByWave.into());
            name_wave(view, rollout, by)
        }
        Step::Staging => {
            deadline =
                queue::is_on(rollout, r).then(|| queue::turn_came(rollout, r).plus_ms(limits::STAGED_WITHIN.as_ms()));
            let progress =
                board.get(&r.robot_id).and_then(|l| l.report.update.as_ref()).map_or(0, |u| u.progress_permille);
            Reason::from(Code::BlockedByDownload).with("progress_permille", progress)
        }
        Step::Draining => {
            let drain = r.drain_id.as_ref().and_then(|id| view.drain(id));
            since = drain.map_or(r.since, |drain| drain.since);
            deadline = draining_until(drain);
            waiting(drain).unwrap_or_else(|| Code::BlockedByDrain.into())
        }
        Step::Activating => {
            let state =
                view.report_of(board, r).filter(|u| u.directive_generation >= r.directive_generation).map(|u| u.state);
            match state {
                Some(UpdateState::Probation) => {
                    since = r.moments.switched.unwrap_or(r.since);
                    deadline = Some(since.plus_ms(rollout.spec.probation_ms));
                    Code::BlockedByProbation.into()
                }
                _ if r.grant.is_some() => Code::BlockedBySwitch.into(),
                _ => {
                    deadline = Some(r.since.plus_ms(limits::READY_WITHIN.as_ms()));
                    let said = view.report_of(board, r).and_then(|u| u.reason.as_ref());
                    let because = said.and_then(|why| why.metadata.get("by")).cloned().unwrap_or_default();
                    Reason::from(Code::BlockedByRobot).with("by", because)
                }
            }
        }
        Step::Trial => {
            let left = [rollout.soak, rollout.exposure].into_iter().flatten().next();
            deadline = left.map(|c: Countdown| now.utc.plus_ms(c.left(view.served_ms(now))));
            Reason::from(Code::BlockedByGate).with("phase", format!("{:?}", rollout.phase).to_uppercase())
        }
        Step::Committing => Code::BlockedByCommit.into(),
        Step::Reverting => {
            let drain = r.drain_id.as_ref().and_then(|id| view.drain(id));
            since = drain.map_or(r.since, |drain| drain.since);
            deadline = draining_until(drain);
            waiting(drain).unwrap_or_else(|| Code::BlockedByRevert.into())
        }
        Step::Stuck => Code::RollbackFailed.into(),
    };
    Some(Blocked { by, since, deadline })
}

/// A reason that waits for a wave names robots of the present one that are not decided.
fn name_wave(view: &RolloutProjection, rollout: &Rollout, by: Reason) -> Reason {
    if by.code != Code::BlockedByWave {
        return by;
    }
    let open = |r: &&RolloutRobot| r.wave == rollout.wave && !r.step.is_over();
    let robots = view.robots_of(&rollout.rollout_id).filter(open).take(NAMED_MAX);
    let names: Vec<&str> = robots.map(|r| r.robot_id.as_str()).collect();
    if names.is_empty() { by } else { by.with("robot_ids", names.join(" ")) }
}

/// When a drain that has begun must be over.
fn draining_until(drain: Option<&Drain>) -> Option<Utc> {
    drain.filter(|d| d.state == DrainState::Draining).map(|d| d.since.plus_ms(d.within_ms))
}

/// What a drain waits for before it begins.
fn waiting(drain: Option<&Drain>) -> Option<Reason> {
    drain.filter(|d| d.state == DrainState::Waiting).and_then(|d| d.why.clone())
}
