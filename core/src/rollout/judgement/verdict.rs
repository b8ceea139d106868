//! Gates: what was seen of a bundle, and what follows from it.
//!
//! Invariant: a verdict is made of stored numbers only, and stands in the row with them. Small n is honest n: what was
//! not proven is never called so.

use super::effort;
use super::failures::is_hard;
use crate::fleet::Board;
use crate::fleet::liveness;
use crate::fleet::rows::RobotCounter;
use crate::gates::{self, FEW_ROBOTS, RobotOutcomes, Suspicion, TaskTally};
use crate::ids::{AreaId, RobotId, RolloutId};
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::robot::Duty;
use crate::rollout::decision::plan::Tx;
use crate::rollout::projection::rows::{Abort, Outcome, Rollout, RolloutRobot, Step, TaskBaseline, Verdict};
use crate::rollout::projection::spec::{SmallWave, SmallWaveFailure};
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::projection::timestamp::Stamp;
use crate::time::{Now, Utc};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Robots named in an abort or an incident.
pub const NAMED_MAX: usize = 16;

/// Robots of a roll-out as its gates count them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Seen {
    /// Robots that were given permission.
    pub attempted: u32,
    /// Of these, those that are decided.
    pub outcomes: RobotOutcomes,
}

/// Tasks that a robot has ended with the roll-out's version, since ever.
pub fn tasks_of_robot(view: &RolloutProjection, rollout: &Rollout, robot_id: &RobotId) -> TaskTally {
    let Some(bundle) = view.bundles.get(rollout.spec.bundle.as_str()) else { return TaskTally::default() };
    let id = format!("{robot_id}@{}", bundle.row.version);
    view.counters.get(id.as_str()).map_or_else(TaskTally::default, |c| ended_tasks(&c.row))
}

fn ended_tasks(counter: &RobotCounter) -> TaskTally {
    TaskTally { succeeded: counter.succeeded, failed: counter.failures.values().sum() }
}

fn tasks_since(now: TaskTally, before: TaskTally) -> TaskTally {
    TaskTally {
        succeeded: now.succeeded.saturating_sub(before.succeeded),
        failed: now.failed.saturating_sub(before.failed),
    }
}

/// Tasks that a robot has ended on trial.
pub fn exposure_of(view: &RolloutProjection, rollout: &Rollout, r: &RolloutRobot) -> TaskTally {
    match r.moments.on_trial {
        Some(_) => tasks_since(tasks_of_robot(view, rollout, &r.robot_id), r.before),
        None => TaskTally::default(),
    }
}

/// Tasks that all robots have ended with any other version, since ever.
pub fn tasks_of_controls(view: &RolloutProjection, rollout: &Rollout) -> TaskTally {
    let version = view.bundles.get(rollout.spec.bundle.as_str()).map(|b| b.row.version.as_str());
    let others = view.counters.values().map(|c| &c.row).filter(|c| Some(c.software.as_str()) != version);
    others.map(ended_tasks).fold(TaskTally::default(), TaskTally::plus)
}

/// Takes in what ended since it was counted last. By the clock, never because a task failed.
pub fn count_tasks(tx: &mut Tx, id: &RolloutId) {
    let Some(rollout) = tx.view.rollout(id) else { return };
    let at_ms = tx.view.served_ms(&tx.now);
    let waited_ms = at_ms.saturating_sub(rollout.counted.at_ms);
    if rollout.revert_of.is_some() || waited_ms < limits::TASKS_COUNTED_EVERY.as_ms() {
        return;
    }
    let on_trial = tx.view.robots_of(&rollout.rollout_id).filter(|r| r.moments.on_trial.is_some());
    let trial: BTreeMap<RobotId, TaskTally> =
        on_trial.map(|r| (r.robot_id.clone(), exposure_of(tx.view, rollout, r))).collect();
    let control = tasks_of_controls(tx.view, rollout);
    let before = |id: &RobotId| rollout.counted.trial.get(id).copied().unwrap_or_default();
    let news = trial.iter().map(|(id, tally)| (id.clone(), tasks_since(*tally, before(id)))).collect();
    let mut tasks = rollout.tasks.clone();
    tasks.observe(&news, tasks_since(control, rollout.counted.control));
    let counted = Arc::new(TaskBaseline { at_ms, trial, control, effort: rollout.counted.effort });
    let efforts = effort::see_efforts(tx.view, rollout);
    let row = Rollout { tasks, counted, efforts, ..rollout.clone() };
    tx.put_row(row, "rollout.tasks_counted");
}

/// Counts robots at the gate of its wave. Those on trial in this wave or before that are not dark count as having come
/// through.
pub fn count_wave(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout) -> Seen {
    count_robots(view, rollout, |r| r.wave <= rollout.wave && !is_unheard(board, now, r))
}

/// It is not heard at this moment: as long as it is on trial it is not called clean.
pub fn is_unheard(board: &Board, now: &Now, r: &RolloutRobot) -> bool {
    liveness::presence(board, &r.robot_id, now) == Presence::Offline
}

/// Counts robots. `came_through`: whether one on trial counts for the bundle.
fn count_robots(view: &RolloutProjection, rollout: &Rollout, came_through: impl Fn(&RolloutRobot) -> bool) -> Seen {
    let mut seen = Seen::default();
    for r in view.robots_of(&rollout.rollout_id).filter(|r| r.attempted) {
        seen.attempted += 1;
        let kept = matches!(r.step, Step::Committing | Step::Committed);
        let on_trial = r.step == Step::Trial && came_through(r);
        match r.failure {
            Some(_) => seen.outcomes.failed += 1,
            // One that was kept out of work says nothing for the bundle.
            None if (kept || on_trial) && (is_in_work(view, r) || has_worked(view, rollout, r)) => {
                seen.outcomes.clean += 1;
            }
            None => {}
        }
    }
    seen
}

/// A verdict with the numbers behind it.
pub fn compose_verdict(rollout: &Rollout, seen: &Seen, outcome: Outcome, reason: Reason, at: Utc) -> Verdict {
    let mut robots = seen.outcomes.evidence();
    if reason.code == Code::FailureAmongFew {
        robots.false_abort_permille = Some(gates::false_abort_permille(u64::from(seen.attempted)));
    }
    Verdict {
        wave: rollout.wave,
        outcome,
        reason,
        attempted: seen.attempted,
        robots,
        tasks: rollout.tasks.clone(),
        suspicion: rollout.tasks.suspicion(),
        efforts: rollout.efforts,
        at,
        actor: None,
    }
}

/// Why the roll-out must end now, if it must. Looked at in every phase, also while it stands still.
pub fn find_abort(view: &RolloutProjection, rollout: &Rollout) -> Option<(Reason, bool, Seen)> {
    let seen = count_robots(view, rollout, |_| false);
    let failed = seen.outcomes.failed;
    let mut failures = view.robots_of(&rollout.rollout_id).filter_map(|r| r.failure.as_ref());
    if let Some(hard) = failures.find(|f| is_hard(f)) {
        return Some((hard.clone(), true, seen));
    }
    let numbers = |code: Code| Reason::from(code).with("failed", failed).with("attempted", seen.attempted);
    let few = failed > 0 && seen.attempted < FEW_ROBOTS;
    if few && rollout.spec.small_wave_failure == SmallWaveFailure::Abort {
        return Some((numbers(Code::FailureAmongFew), false, seen));
    }
    if seen.outcomes.verdict() == gates::Verdict::Abort {
        return Some((numbers(Code::TooManyFailed), false, seen));
    }
    if rollout.tasks.suspicion() == Suspicion::Release
        && let Some(by) = acts_on_rates(view, rollout)
    {
        let reason = Reason::from(Code::RateTooHigh).with("e_value", format!("{:.1}", rollout.tasks.e_value()));
        return Some((by.name_areas(reason), false, seen));
    }
    None
}

/// Who says that rates of task failures end a roll-out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ActsOnRates {
    /// Whoever asked for the roll-out.
    Spec,
    /// The rules of these areas, never none.
    Areas(BTreeSet<AreaId>),
}

impl ActsOnRates {
    /// Names areas in a reason, if it is they.
    fn name_areas(&self, reason: Reason) -> Reason {
        match self {
            Self::Spec => reason,
            Self::Areas(areas) => {
                let areas: Vec<&str> = areas.iter().map(AreaId::as_str).collect();
                reason.with("area_ids", areas.join(" "))
            }
        }
    }
}

/// Who says at this moment that the gate on rates of task failures ends the roll-out; none: what it finds is only
/// shown. The spec, or else the rules of an area in which a robot is, as far as it said last, that has run the bundle
/// on trial: tasks of such robots are the evidence, also when their wave was kept. Robots that never ran it say nothing
/// for or against it, also if they were given permission, so neither do their areas. Rules are read as they are now: a
/// rule that is put while the roll-out runs holds at once, also for what was counted before. Nothing ends what is over,
/// or takes something back.
pub fn acts_on_rates(view: &RolloutProjection, rollout: &Rollout) -> Option<ActsOnRates> {
    if rollout.phase.is_over() || rollout.revert_of.is_some() {
        return None;
    }
    if rollout.spec.acts_on_rates {
        return Some(ActsOnRates::Spec);
    }
    let ran_it = view.robots_of(&rollout.rollout_id).filter(|r| r.moments.on_trial.is_some());
    let software = ran_it.filter_map(|r| view.software.get(r.robot_id.as_str()));
    areas_that_act(view, software.filter_map(|s| s.row.area.as_ref()))
}

/// Those of the areas whose rules say that rates of task failures end roll-outs; none: no rules say so.
pub fn areas_that_act<'a>(view: &RolloutProjection, areas: impl Iterator<Item = &'a AreaId>) -> Option<ActsOnRates> {
    let areas: BTreeSet<&AreaId> = areas.collect();
    let areas = areas.into_iter().filter(|area| view.policy(area).software.acts_on_rates);
    let areas: BTreeSet<AreaId> = areas.cloned().collect();
    (!areas.is_empty()).then_some(ActsOnRates::Areas(areas))
}

/// What is latched when a roll-out ends early.
pub fn compose_abort(
    view: &RolloutProjection,
    rollout: &Rollout,
    reason: Reason,
    hard: bool,
    now: &Now,
    actor: Option<String>,
) -> Abort {
    let failed = view.robots_of(&rollout.rollout_id).filter(|r| r.failure.is_some());
    let robots = failed.map(|r| r.robot_id.clone()).take(NAMED_MAX).collect();
    let touched = view.robots_of(&rollout.rollout_id).filter(|r| r.attempted).count() as u32;
    let link = Some(Stamp::new(now, &view.started));
    Abort { reason, hard, robots, touched, at: now.utc, link, actor }
}

/// Robots of the wave that have not worked enough to be judged, and may yet. Whom people or the breaker keep out of
/// work is not waited for, unless nobody else of the wave has worked enough.
pub fn find_unexposed<'a>(view: &'a RolloutProjection, rollout: &'a Rollout) -> impl Iterator<Item = &'a RolloutRobot> {
    let on_trial = || robots_of_wave(view, &rollout.rollout_id, rollout.wave).filter(|r| r.step == Step::Trial);
    let nobody = !on_trial().any(|r| has_worked(view, rollout, r));
    on_trial().filter(move |r| !has_worked(view, rollout, r) && (nobody || is_in_work(view, r)))
}

/// It has ended as many tasks on trial as it is judged by.
fn has_worked(view: &RolloutProjection, rollout: &Rollout, r: &RolloutRobot) -> bool {
    exposure_of(view, rollout, r).ended() >= rollout.spec.exposure_tasks
}

fn is_in_work(view: &RolloutProjection, r: &RolloutRobot) -> bool {
    view.duty(&r.robot_id) == Duty::InWork
}

/// Robots of one wave.
pub fn robots_of_wave<'a>(
    view: &'a RolloutProjection,
    id: &RolloutId,
    wave: u32,
) -> impl Iterator<Item = &'a RolloutRobot> + use<'a> {
    view.robots_of(id).filter(move |r| r.wave == wave)
}

/// What the gate after a wave says. What would go on waits for a person where its robots' work costs more than its spec
/// lets pass.
pub fn judge_wave(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout) -> Verdict {
    let rollout = &Rollout { efforts: effort::see_efforts(view, rollout), ..rollout.clone() };
    let verdict = judge(view, board, now, rollout);
    let goes_on =
        matches!(verdict.outcome, Outcome::Promoted | Outcome::PromotedUnproven) && rollout.revert_of.is_none();
    match effort::find_excess(&rollout.efforts, &rollout.spec.effort).filter(|_| goes_on) {
        Some(reason) => Verdict { outcome: Outcome::Review, reason, ..verdict },
        None => verdict,
    }
}

fn judge(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout) -> Verdict {
    let seen = count_wave(view, board, now, rollout);
    let give = |outcome, code: Code| compose_verdict(rollout, &seen, outcome, code.into(), now.utc);
    if rollout.revert_of.is_some() {
        return give(Outcome::Promoted, Code::GateReverted);
    }
    match seen.outcomes.verdict() {
        gates::Verdict::Promote => give(Outcome::Promoted, Code::GateProven),
        gates::Verdict::Abort => give(Outcome::Aborted, Code::TooManyFailed),
        gates::Verdict::Inconclusive if seen.outcomes.failed > 0 => give(Outcome::Review, Code::GateInconclusive),
        gates::Verdict::Inconclusive if rollout.spec.small_wave == SmallWave::Review => {
            give(Outcome::Review, Code::GateAsksPerson)
        }
        // Nobody came through: what was not seen is not called unproven, a person looks.
        gates::Verdict::Inconclusive if seen.outcomes.clean == 0 => give(Outcome::Review, Code::GateInconclusive),
        gates::Verdict::Inconclusive => give(Outcome::PromotedUnproven, Code::GateUnproven),
    }
}
