//! Holds what robots report of their attempts against what an attempt can be.
//!
//! 1. The step lies between the first one of the attempt and the number of steps.
//! 2. SUCCEEDED comes only with the number of steps.
//! 3. Within an attempt the step is never lower than reported before.
//! 4. The state is one that this build knows.
//!
//! Invariant: a report that breaks one of these frees nothing and moves nothing forward. What it adds is taken: places and loads.
//! Called by `facts::inbox` for events, by `facts::repair` for heartbeats, and by whoever gives work or places. `facts::disbelief` acts on it.

use super::{attempts, claims};
use crate::fleet::projection::liveness;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId};
use crate::reason::{Code, Reason};
use crate::robot::WorkState;
use crate::robot_events::AttemptReport;
use crate::step::Effect;
use crate::task::{Attempt, AttemptPhase, TaskIntake};

/// Steps that reports of one attempt may name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Bounds {
    /// The first step of the attempt: where it drives to first.
    first: u32,
    /// Where it goes on after that drive.
    resume: u32,
    /// Number of steps.
    steps: u32,
}

impl Bounds {
    /// Those of `a`; none if nothing is known of its steps any more.
    fn of_attempt(view: &FleetProjection, a: &Attempt) -> Option<Self> {
        let given = view.desired_work.get(a.robot_id.as_str()).and_then(|d| d.row.assignment.as_ref());
        if let Some(given) = given.filter(|given| given.attempt == a.attempt) {
            let steps = given.steps.len() as u32;
            return Some(Self { first: given.from_step, resume: given.resume_step, steps });
        }
        // It is taken back already, or was never sent: nobody knows where it began.
        let steps = match a.attempt.subject.task_id() {
            Some(task_id) => view.intake(task_id)?.spec.steps.len(),
            None => attempts::steps(view, a).len(),
        };
        Some(Self { first: 0, resume: steps as u32, steps: steps as u32 })
    }
    /// The lowest step that may be reported of an attempt whose row says that `done` steps are done and that `reported` was reported. A row of
    /// an older version does not say what was reported: its steps were once they are more than those it began with.
    fn least(self, reported: Option<u32>, done: u32) -> u32 {
        reported.or((done > self.resume).then_some(done)).unwrap_or(0).max(self.first)
    }
    fn allow(self, least: u32, state: WorkState, step_index: u32) -> bool {
        match state {
            WorkState::Unknown(_) => false,
            // It never began.
            WorkState::Refused => step_index <= self.steps,
            WorkState::Succeeded => step_index == self.steps,
            _ => (least..=self.steps).contains(&step_index),
        }
    }
}

/// Why a report of the attempt cannot be; none: it is plausible, or the attempt is over.
pub fn judge(
    view: &FleetProjection,
    id: &AttemptId,
    robot_id: &RobotId,
    state: WorkState,
    step_index: u32,
) -> Option<Reason> {
    let a = view.attempt(id).filter(|a| a.robot_id == *robot_id)?;
    if a.phase.is_terminal() && a.phase != AttemptPhase::Lost {
        return None;
    }
    if matches!(state, WorkState::Unknown(_)) && view.bugs.unknown_states_are_taken() {
        return None;
    }
    let bounds = Bounds::of_attempt(view, a)?;
    let least = bounds.least(a.reported, a.step_index);
    let reason = || {
        Reason::from(Code::ReportImplausible)
            .with("attempt", id)
            .with("state", format!("{state:?}"))
            .with("step_index", step_index)
            .with("least", least)
            .with("steps", bounds.steps)
    };
    (!bounds.allow(least, state, step_index)).then(reason)
}

/// The first attempt that a heartbeat lists in a way that cannot be. One that is older than the robot's events tells nothing.
pub fn doubtful(view: &FleetProjection, live: &NewestHeartbeat) -> Option<(AttemptId, Reason)> {
    if !liveness::is_fresh(view, live) {
        return None;
    }
    let listed = live.report.attempts.iter();
    let mut doubts = listed.filter_map(|r| {
        let why = judge(view, &r.attempt, &live.robot_id, r.state, r.step_index)?;
        Some((r.attempt.clone(), why))
    });
    doubts.next()
}

/// Keeps work and grants from a robot whose newest word cannot be, or whose decisions are put aside.
///
/// # Errors
/// If so; the reason says what.
pub fn keeps_back(view: &FleetProjection, live: &NewestHeartbeat) -> Result<(), Reason> {
    view.unknown_rows.check_robot(&live.robot_id)?;
    view.refused.check_robot(&live.robot_id)?;
    match doubtful(view, live).map(|(_, why)| why).or_else(|| claims::too_many(view, live)) {
        Some(why) => Err(why),
        None => Ok(()),
    }
}

/// The report passes a step that must not be done twice, so it opens the task, whatever it says of that.
pub fn passes_irreversible(intake: &TaskIntake, next_step: u32, report: &AttemptReport) -> bool {
    let passed = intake.spec.steps.iter().take(report.step_index as usize).skip(next_step as usize);
    passed.into_iter().any(|step| step.effect == Effect::AtMostOnce)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_is_legal_within_its_steps_and_never_goes_back() {
        use WorkState::{Aborted, Executing, Failed, Refused, Succeeded, Unknown};
        let bounds = Bounds { first: 2, resume: 3, steps: 6 };
        let table = [
            (None, Executing, 1, false),
            (None, Executing, 2, true),
            (None, Executing, 3, true),
            (Some(2), Executing, 2, true),
            (Some(3), Executing, 2, false),
            (Some(3), Executing, 3, true),
            (Some(4), Executing, 3, false),
            (Some(4), Executing, 4, true),
            (Some(4), Failed, 6, true),
            (Some(4), Aborted, 7, false),
            (Some(4), Failed, u32::MAX, false),
            (Some(4), Succeeded, 5, false),
            (Some(4), Succeeded, 6, true),
            (Some(4), Succeeded, 7, false),
            (None, Refused, 0, true),
            (None, Refused, 7, false),
            (None, Unknown(99), 4, false),
        ];
        for (reported, state, step, legal) in table {
            // The row began with the step that it goes on with.
            let least = bounds.least(reported, reported.unwrap_or(0).max(3));
            assert_eq!(bounds.allow(least, state, step), legal, "{reported:?} {state:?} {step}");
        }
    }

    #[test]
    fn a_row_of_an_older_version_says_what_was_reported_by_the_steps_that_are_done() {
        let bounds = Bounds { first: 2, resume: 3, steps: 6 };
        assert_eq!([3, 4, 6].map(|done| bounds.least(None, done)), [2, 4, 6]);
    }
}
