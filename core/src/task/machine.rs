//! The task's table of transitions: one enum of phases, one of events, one function. Nothing else decides where a task goes.
//!
//! Called by `fleet`. Invariant: UNCERTAIN is a property of the attempt, never a phase: cancel and hold stay legal, and a robot
//! that is heard again brings the task to what its hold set and `then` demand. A timeout never frees a robot or a place.

use serde::{Deserialize, Serialize};

/// Where a task is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Waits for a robot.
    Queued,
    /// Offered to a robot.
    Assigned,
    /// A robot has it.
    Running,
    /// A robot has it and a hold token stands.
    Held,
    /// Handed back at a step boundary; waits to be queued again.
    Suspended,
    /// The robot was told to stop and has not confirmed.
    Stopping,
    /// Failed in a way that is tried again, waits out its back-off.
    RetryWait,
    /// A person must decide.
    NeedsOperator,
    /// Done. Terminal.
    Succeeded,
    /// Given up. Terminal.
    Failed,
    /// Not wanted any more. Terminal.
    Canceled,
    /// Its deadline passed. Terminal.
    Expired,
}

impl Phase {
    /// All phases.
    pub const ALL: [Phase; 12] = [
        Self::Queued,
        Self::Assigned,
        Self::Running,
        Self::Held,
        Self::Suspended,
        Self::Stopping,
        Self::RetryWait,
        Self::NeedsOperator,
        Self::Succeeded,
        Self::Failed,
        Self::Canceled,
        Self::Expired,
    ];
    /// No way out.
    pub const fn is_terminal(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Canceled | Self::Expired)
    }
    /// A robot has, or may have, a live attempt of it.
    pub const fn has_attempt(self) -> bool {
        matches!(self, Self::Assigned | Self::Running | Self::Held | Self::Stopping)
    }
    /// Number in indices and on the wire.
    pub const fn number(self) -> i64 {
        self as i64 + 1
    }
    /// Name, UPPER_SNAKE.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "QUEUED",
            Self::Assigned => "ASSIGNED",
            Self::Running => "RUNNING",
            Self::Held => "HELD",
            Self::Suspended => "SUSPENDED",
            Self::Stopping => "STOPPING",
            Self::RetryWait => "RETRY_WAIT",
            Self::NeedsOperator => "NEEDS_OPERATOR",
            Self::Succeeded => "SUCCEEDED",
            Self::Failed => "FAILED",
            Self::Canceled => "CANCELED",
            Self::Expired => "EXPIRED",
        }
    }
}

/// The phase that follows STOPPING, once the robot has confirmed the stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AfterStopping {
    /// It ends as CANCELED.
    Canceled,
    /// FAILED, or NEEDS_OPERATOR if it is opened: a person must look where the item is.
    Failed,
    /// RETRY_WAIT, or NEEDS_OPERATOR if it is opened or its attempts are spent.
    Retry,
    /// It is held as SUSPENDED.
    Suspended,
    /// QUEUED: nobody took it.
    Requeue,
    /// It ends as EXPIRED.
    Expired,
    /// It waits for a person as NEEDS_OPERATOR.
    NeedsOperator,
}

/// What happened to a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Event {
    /// The planner offers it to a robot.
    PlanOffers,
    /// Nobody started it in time.
    ScheduleToStart,
    /// Its deadline passed.
    Deadline,
    /// Somebody cancels.
    Cancel,
    /// Somebody ends the record at once.
    CancelForce,
    /// A hold token came.
    Hold,
    /// The last hold token went.
    LastHoldGone,
    /// Somebody changes what was asked for.
    Edit,
    /// The robot took it.
    Accepted,
    /// The robot did not take it.
    Refused,
    /// The robot did not answer.
    OfferAckTimeout,
    /// The robot reports a step.
    Progress,
    /// The robot reports the end.
    Succeeded,
    /// A fault that may be tried again.
    FailedRecoverable,
    /// A fault that must not be.
    FailedFinal,
    /// The robot confirmed that it does not have it (stopped, dropped, never had it).
    StopConfirmed,
    /// The attempt took too long.
    StartToClose,
    /// No progress.
    Stall,
    /// The robot was not heard for longer than its authority, or a person drives it.
    LeaseOver,
    /// The robot lists it as live.
    SeenRunning,
    /// The robot restarted inside a step that must not be done twice.
    StepUnknown,
    /// Hand it back at the next boundary. No producer until charging or more urgent work pre-empts.
    Suspend,
    /// No confirmation of the stop.
    StopConfirmTimeout,
    /// The back-off is over, or a suspended task may queue again.
    RetryDue,
    /// UNCERTAIN for too long.
    UncertainTimeout,
    /// A person: try again.
    ResolveRequeue,
    /// A person: done by hand.
    ResolveSucceeded,
    /// A person: give up.
    ResolveFailed,
    /// A person: not wanted.
    ResolveCanceled,
}

impl Event {
    /// All events.
    pub const ALL: [Event; 29] = [
        Self::PlanOffers,
        Self::ScheduleToStart,
        Self::Deadline,
        Self::Cancel,
        Self::CancelForce,
        Self::Hold,
        Self::LastHoldGone,
        Self::Edit,
        Self::Accepted,
        Self::Refused,
        Self::OfferAckTimeout,
        Self::Progress,
        Self::Succeeded,
        Self::FailedRecoverable,
        Self::FailedFinal,
        Self::StopConfirmed,
        Self::StartToClose,
        Self::Stall,
        Self::LeaseOver,
        Self::SeenRunning,
        Self::StepUnknown,
        Self::Suspend,
        Self::StopConfirmTimeout,
        Self::RetryDue,
        Self::UncertainTimeout,
        Self::ResolveRequeue,
        Self::ResolveSucceeded,
        Self::ResolveFailed,
        Self::ResolveCanceled,
    ];
}

/// Where a task stands when an event arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MachineState {
    /// Its phase.
    pub phase: Phase,
    /// Its attempt is UNCERTAIN.
    pub uncertain: bool,
    /// Where STOPPING leads.
    pub then: Option<AfterStopping>,
}

/// Facts that choose between the outcomes of one table cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Facts {
    /// Retries asked for and not spent, counting the attempt that ends now.
    pub retries_left: bool,
    /// Any retry was asked for at all.
    pub retry_wanted: bool,
    /// One more drop by a robot is tried again, whatever the task asked for: a drop is not a fault of the work.
    pub drops_left: bool,
    /// First irreversible step done or unknown.
    pub opened: bool,
    /// Every step begun in this attempt may be repeated.
    pub begun_repeatable: bool,
    /// This refusal is the last allowed in a row.
    pub refusals_spent: bool,
    /// Every candidate refused it for its content.
    pub refused_by_all: bool,
    /// The fault says that the work cannot be done as asked.
    pub semantic: bool,
    /// No other robot failed it, and one that is heard could do it.
    pub elsewhere: bool,
    /// A hold token stands.
    pub held: bool,
    /// The robot had accepted.
    pub accepted: bool,
}

/// What the table does to the attempt of the task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttemptAction {
    /// It goes on, or there is none.
    Keep,
    /// It is told to stop.
    Stop,
    /// Nobody knows any more.
    Uncertain,
    /// It is known again.
    Known,
    /// It is over and the robot is free.
    End,
    /// The record lets it go, but robot and places stay kept until the robot reports.
    Abandon,
}

/// The answer of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Next {
    /// New phase.
    pub phase: Phase,
    /// New `then`.
    pub then: Option<AfterStopping>,
    /// What is done to the attempt.
    pub action: AttemptAction,
}

/// Where a confirmed stop leads.
fn after_stop(then: AfterStopping, facts: &Facts) -> Phase {
    match then {
        AfterStopping::Canceled => Phase::Canceled,
        AfterStopping::Failed if facts.opened => Phase::NeedsOperator,
        AfterStopping::Failed => Phase::Failed,
        AfterStopping::Retry if facts.opened || !facts.retries_left => Phase::NeedsOperator,
        AfterStopping::Retry => Phase::RetryWait,
        AfterStopping::Suspended => Phase::Suspended,
        AfterStopping::Requeue => Phase::Queued,
        AfterStopping::Expired => Phase::Expired,
        AfterStopping::NeedsOperator => Phase::NeedsOperator,
    }
}

/// Where an attempt that failed recoverably leads.
fn after_recoverable(facts: &Facts) -> Phase {
    if facts.retries_left {
        Phase::RetryWait
    } else if facts.retry_wanted || facts.opened {
        Phase::NeedsOperator
    } else {
        Phase::Failed
    }
}

/// Where an attempt that failed for good leads. What one robot cannot do as asked another is given before a person is
/// asked.
fn after_final(facts: &Facts) -> Phase {
    let is_open_to_others = facts.semantic && !facts.opened;
    if is_open_to_others && facts.refused_by_all {
        Phase::Failed
    } else if is_open_to_others && facts.begun_repeatable && facts.elsewhere && facts.retries_left {
        Phase::RetryWait
    } else {
        Phase::NeedsOperator
    }
}

/// Where a robot's drop of a running task leads: it stands without anybody having asked for it.
fn after_drop(facts: &Facts) -> Phase {
    if facts.begun_repeatable && !facts.opened && facts.drops_left { Phase::RetryWait } else { Phase::NeedsOperator }
}

/// The table. `None`: the event means nothing there (fenced, duplicate, too late) and is counted, not obeyed.
pub fn next(at: MachineState, event: Event, facts: &Facts) -> Option<Next> {
    if at.phase.is_terminal() {
        return None;
    }
    if at.uncertain && at.phase.has_attempt() {
        return uncertain(at, event, facts);
    }
    match at.phase {
        Phase::Queued | Phase::Suspended | Phase::RetryWait => waiting(at, event),
        Phase::Assigned => assigned(at, event, facts),
        Phase::Running | Phase::Held => running(at, event, facts),
        Phase::Stopping => stopping(at, event, facts),
        Phase::NeedsOperator => needs_operator(at, event),
        Phase::Succeeded | Phase::Failed | Phase::Canceled | Phase::Expired => None,
    }
}

/// Whether what was asked for may change in this phase: no robot has the task, and none may have it.
pub fn takes_edit(phase: Phase) -> bool {
    next(MachineState { phase, uncertain: false, then: None }, Event::Edit, &Facts::default()).is_some()
}

fn go(phase: Phase, action: AttemptAction) -> Option<Next> {
    Some(Next { phase, then: None, action })
}

fn stop(then: AfterStopping) -> Option<Next> {
    Some(Next { phase: Phase::Stopping, then: Some(then), action: AttemptAction::Stop })
}

fn stay(at: MachineState) -> Option<Next> {
    Some(Next { phase: at.phase, then: at.then, action: AttemptAction::Keep })
}

fn waiting(at: MachineState, event: Event) -> Option<Next> {
    match (at.phase, event) {
        (Phase::Queued, Event::PlanOffers) => go(Phase::Assigned, AttemptAction::Keep),
        (Phase::Queued | Phase::RetryWait, Event::ScheduleToStart) => go(Phase::NeedsOperator, AttemptAction::Keep),
        (_, Event::Deadline) => go(Phase::Expired, AttemptAction::Keep),
        (_, Event::Cancel | Event::CancelForce) => go(Phase::Canceled, AttemptAction::Keep),
        (Phase::Suspended | Phase::RetryWait, Event::RetryDue) => go(Phase::Queued, AttemptAction::Keep),
        (_, Event::Hold | Event::LastHoldGone | Event::Edit) => stay(at),
        _ => None,
    }
}

fn assigned(at: MachineState, event: Event, facts: &Facts) -> Option<Next> {
    let work = if facts.held { Phase::Held } else { Phase::Running };
    match event {
        Event::Accepted | Event::Progress | Event::SeenRunning => go(work, AttemptAction::Keep),
        Event::Refused if facts.refused_by_all => go(Phase::Failed, AttemptAction::End),
        Event::Refused if facts.refusals_spent => go(Phase::NeedsOperator, AttemptAction::End),
        Event::Refused | Event::StopConfirmed => go(Phase::Queued, AttemptAction::End),
        Event::OfferAckTimeout | Event::Suspend => stop(AfterStopping::Requeue),
        Event::ScheduleToStart => stop(AfterStopping::NeedsOperator),
        Event::Deadline => stop(AfterStopping::Expired),
        Event::Cancel => stop(AfterStopping::Canceled),
        Event::CancelForce => go(Phase::Canceled, AttemptAction::Abandon),
        Event::Succeeded => go(Phase::Succeeded, AttemptAction::End),
        Event::FailedRecoverable => go(after_recoverable(facts), AttemptAction::End),
        Event::FailedFinal => go(after_final(facts), AttemptAction::End),
        Event::LeaseOver | Event::StepUnknown => Some(Next { action: AttemptAction::Uncertain, ..stay(at)? }),
        Event::Hold | Event::LastHoldGone => stay(at),
        _ => None,
    }
}

fn running(at: MachineState, event: Event, facts: &Facts) -> Option<Next> {
    let too_long = if facts.retry_wanted { AfterStopping::Retry } else { AfterStopping::Failed };
    match event {
        Event::Accepted | Event::Progress | Event::SeenRunning => stay(at),
        Event::Hold => go(Phase::Held, AttemptAction::Keep),
        Event::LastHoldGone if at.phase == Phase::Held => go(Phase::Running, AttemptAction::Keep),
        Event::Suspend => stop(AfterStopping::Suspended),
        Event::Succeeded => go(Phase::Succeeded, AttemptAction::End),
        Event::FailedRecoverable => go(after_recoverable(facts), AttemptAction::End),
        Event::FailedFinal => go(after_final(facts), AttemptAction::End),
        Event::StopConfirmed => go(after_drop(facts), AttemptAction::End),
        Event::Stall if at.phase == Phase::Running => stop(too_long),
        Event::StartToClose => stop(too_long),
        Event::Deadline => stop(AfterStopping::Expired),
        Event::Cancel => stop(AfterStopping::Canceled),
        Event::CancelForce => go(Phase::Canceled, AttemptAction::Abandon),
        Event::LeaseOver | Event::StepUnknown => Some(Next { action: AttemptAction::Uncertain, ..stay(at)? }),
        _ => None,
    }
}

fn stopping(at: MachineState, event: Event, facts: &Facts) -> Option<Next> {
    let then = at.then.unwrap_or(AfterStopping::NeedsOperator);
    match event {
        Event::Succeeded => go(Phase::Succeeded, AttemptAction::End),
        Event::Refused | Event::FailedRecoverable | Event::StopConfirmed => {
            go(after_stop(then, facts), AttemptAction::End)
        }
        Event::FailedFinal if then == AfterStopping::Retry => go(after_final(facts), AttemptAction::End),
        Event::FailedFinal => go(after_stop(then, facts), AttemptAction::End),
        Event::Cancel => stop(AfterStopping::Canceled),
        Event::Deadline if then != AfterStopping::Canceled => stop(AfterStopping::Expired),
        Event::ScheduleToStart if then == AfterStopping::Requeue => stop(AfterStopping::NeedsOperator),
        Event::CancelForce => go(Phase::Canceled, AttemptAction::Abandon),
        Event::StopConfirmTimeout => go(Phase::NeedsOperator, AttemptAction::Abandon),
        Event::LeaseOver | Event::StepUnknown => Some(Next { action: AttemptAction::Uncertain, ..stay(at)? }),
        Event::Accepted
        | Event::Progress
        | Event::SeenRunning
        | Event::Hold
        | Event::LastHoldGone
        | Event::Deadline => stay(at),
        _ => None,
    }
}

fn uncertain(at: MachineState, event: Event, facts: &Facts) -> Option<Next> {
    let wish = |then| Some(Next { phase: at.phase, then: Some(then), action: AttemptAction::Keep });
    let known = |phase| Some(Next { phase, then: at.then, action: AttemptAction::Known });
    let too_long = if facts.retry_wanted { AfterStopping::Retry } else { AfterStopping::Failed };
    match event {
        Event::Accepted | Event::Progress | Event::SeenRunning => match (at.then, facts.held) {
            (Some(_), _) => Some(Next { phase: Phase::Stopping, then: at.then, action: AttemptAction::Known }),
            (None, true) => known(Phase::Held),
            (None, false) => known(Phase::Running),
        },
        Event::Succeeded => go(Phase::Succeeded, AttemptAction::End),
        Event::FailedRecoverable => {
            go(at.then.map_or_else(|| after_recoverable(facts), |t| after_stop(t, facts)), AttemptAction::End)
        }
        Event::FailedFinal => match at.then {
            Some(then) if then != AfterStopping::Retry => go(after_stop(then, facts), AttemptAction::End),
            _ => go(after_final(facts), AttemptAction::End),
        },
        // Refused after it was accepted: the robot lost its memory of it, and with that the work.
        Event::Refused | Event::StopConfirmed => match at.then {
            Some(then) => go(after_stop(then, facts), AttemptAction::End),
            None if !facts.accepted => go(Phase::Queued, AttemptAction::End),
            None => go(after_drop(facts), AttemptAction::End),
        },
        Event::StartToClose => wish(at.then.unwrap_or(too_long)),
        Event::Deadline if at.then != Some(AfterStopping::Canceled) => wish(AfterStopping::Expired),
        Event::ScheduleToStart if at.then == Some(AfterStopping::Requeue) => wish(AfterStopping::NeedsOperator),
        Event::Cancel => wish(AfterStopping::Canceled),
        Event::CancelForce => go(Phase::Canceled, AttemptAction::Abandon),
        Event::StepUnknown | Event::UncertainTimeout => go(Phase::NeedsOperator, AttemptAction::Abandon),
        Event::Hold | Event::LastHoldGone | Event::Deadline => stay(at),
        _ => None,
    }
}

fn needs_operator(at: MachineState, event: Event) -> Option<Next> {
    match event {
        Event::Succeeded => go(Phase::Succeeded, AttemptAction::End),
        Event::StopConfirmed => Some(Next { action: AttemptAction::End, ..stay(at)? }),
        // What its robot goes on to say of steps and of opening is kept: a person's answer depends on it.
        Event::Deadline | Event::Progress | Event::SeenRunning | Event::Hold | Event::LastHoldGone => stay(at),
        Event::Cancel | Event::CancelForce | Event::ResolveCanceled => go(Phase::Canceled, AttemptAction::Keep),
        Event::ResolveRequeue => go(Phase::Queued, AttemptAction::Keep),
        Event::ResolveSucceeded => go(Phase::Succeeded, AttemptAction::Keep),
        Event::ResolveFailed => go(Phase::Failed, AttemptAction::Keep),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
