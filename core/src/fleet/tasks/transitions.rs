//! Moves one task by the table and writes all that goes with it: attempt, robot's mutex, timers, counters, breaker.
//!
//! Called by every room that has news of a task. Invariant: only here does a task change its phase, and only by
//! `task::machine::next`.

use super::{arrivals, attempts, breaker, eligibility, energy_sums, load, place_breaker, plausible};
use crate::energy::fit::EnergySums;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::{HolderState, RobotAuthority, RobotCounter, RobotHolder, Timer, TimerKind};
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId, Subject, TaskId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::FaultClass;
use crate::robot::WorkState;
use crate::robot_events::AttemptReport;
use crate::step::Effect;
use crate::task::machine::{AttemptAction, Facts, MachineState, Next, next};
use crate::task::state::Uncertain;
use crate::task::{AfterStopping, Attempt, AttemptPhase, Event, Phase, TaskIntake, TaskState};

/// What happened to a task, with what is known about it.
#[derive(Clone, Copy, Debug)]
pub struct News<'a> {
    /// The event of the table.
    pub event: Event,
    /// Why, for the task's reason.
    pub why: Option<&'a Reason>,
    /// The robot's report behind it.
    pub report: Option<&'a AttemptReport>,
}

impl<'a> News<'a> {
    /// An event without a report.
    pub fn from_event(event: Event, why: Option<&'a Reason>) -> Self {
        Self { event, why, report: None }
    }
}

/// Moves `task_id` by the table. False: the event means nothing there and is only counted.
pub fn apply_event(tx: &mut Tx, task_id: &TaskId, news: News) -> bool {
    let Some(task) = tx.view.task(task_id).cloned() else { return false };
    let Some(intake) = tx.view.intake(task_id).cloned() else { return false };
    let attempt = task.attempt_id().and_then(|id| tx.view.attempt(&id).cloned());
    let passes = |r: &&AttemptReport| !r.opened && plausible::passes_irreversible(&intake, task.next_step, r);
    let opens = news.report.filter(passes).map(|r| AttemptReport { opened: true, ..r.clone() });
    let news = News { report: opens.as_ref().or(news.report), ..news };
    let facts = facts(tx, &task, &intake, attempt.as_ref(), &news);
    let uncertain = attempt.as_ref().is_some_and(|a| a.uncertain.is_some());
    let at = MachineState { phase: task.phase, uncertain, then: task.then };
    let Some(step) = next(at, news.event, &facts) else { return false };
    let attempt = attempt.filter(|a| !a.phase.is_terminal() || a.phase == AttemptPhase::Lost);
    let attempt = attempt.map(|a| move_attempt(tx, a, step, &news, &intake));
    move_task(tx, task, attempt.as_ref(), step, &news, &intake);
    true
}

fn facts(tx: &Tx, task: &TaskState, intake: &TaskIntake, attempt: Option<&Attempt>, news: &News) -> Facts {
    let opened =
        task.opened_robot_id.is_some() || attempt.is_some_and(|a| a.is_opened) || news.report.is_some_and(|r| r.opened);
    let step = news.report.map(|r| r.step_index).or(attempt.map(|a| a.step_index)).unwrap_or(0) as usize;
    let begun = intake.spec.steps.iter().take(step + 1).skip(task.next_step as usize);
    let refusal = news.report.and_then(|r| r.refusal.as_ref()).map(|r| r.code);
    let semantic_refusal = refusal == Some(Code::UnsupportedAction);
    let refusers = task.semantic_refusers.len() + usize::from(semantic_refusal);
    let semantic = news.report.is_some_and(says_semantic);
    // Of two robots that failed it a person hears.
    let is_first = |a: &&Attempt| task.failed_robots.iter().all(|failed| *failed == a.robot_id);
    let elsewhere = |a: &Attempt| eligibility::another_could(tx.view, task, intake, &a.robot_id);
    Facts {
        retries_left: task.failures < intake.spec.retry.max_retry_times,
        retry_wanted: intake.spec.retry.max_retry_times > 0,
        drops_left: task.failures < intake.spec.retry.max_retry_times.max(limits::DROPS_TOLERATED),
        opened,
        begun_repeatable: begun.into_iter().all(|s| s.effect == Effect::Repeatable),
        refusals_spent: task.refusals_in_row + 1 >= limits::REFUSALS_IN_ROW && are_enough(tx, task),
        refused_by_all: semantic_refusal && refusers >= tx.view.sessions.len(),
        semantic,
        elsewhere: semantic && attempt.filter(is_first).is_some_and(elsewhere),
        held: is_held(tx, task),
        accepted: attempt.is_some_and(|a| a.accepted.is_some()),
    }
}

/// Whether the robot says that the work cannot be done as asked.
fn says_semantic(report: &AttemptReport) -> bool {
    report.fault.as_ref().is_some_and(|f| f.class == FaultClass::Semantic)
}

/// Whether so many different robots have refused it, with the one that does now, that a person is asked: five, or all where there are fewer. One
/// robot alone must not send the work of others to people.
fn are_enough(tx: &Tx, task: &TaskState) -> bool {
    let last = task.robot_id.iter().filter(|robot_id| !task.refusers.contains(*robot_id)).count();
    task.refusers.len() + last >= tx.view.sessions.len().min(limits::REFUSALS_IN_ROW as usize)
}

/// Whether a token of the task or of its robot stands.
pub fn is_held(tx: &Tx, task: &TaskState) -> bool {
    !task.holds.is_empty() || task.robot_id.as_ref().is_some_and(|r| tx.view.robot_holds(r).next().is_some())
}

/// Tells a task that the last token went, if none of its own or of its robot stands. False: one stands.
pub fn go_on_unless_held(tx: &mut Tx, task: &TaskState) -> bool {
    let is_free = !is_held(tx, task);
    if is_free {
        apply_event(tx, &task.task_id, News::from_event(Event::LastHoldGone, None));
    }
    is_free
}

/// The attempt's new phase after `event`, if the event says one.
fn phase_of(event: Event, report: Option<&AttemptReport>) -> Option<AttemptPhase> {
    Some(match (event, report.map(|r| r.state)) {
        (Event::Succeeded, _) => AttemptPhase::Succeeded,
        (Event::FailedRecoverable | Event::FailedFinal, _) => AttemptPhase::Failed,
        (Event::Refused, _) => AttemptPhase::Refused,
        (_, Some(WorkState::Accepted)) => AttemptPhase::Accepted,
        (_, Some(WorkState::Navigating)) => AttemptPhase::Navigating,
        (_, Some(WorkState::Executing)) => AttemptPhase::Executing,
        (_, Some(WorkState::Paused)) => AttemptPhase::Paused,
        _ => return None,
    })
}

fn move_attempt(tx: &mut Tx, mut a: Attempt, step: Next, news: &News, intake: &TaskIntake) -> Attempt {
    if let Some(report) = news.report {
        attempts::note_step(&mut a, report.step_index);
        a.is_opened |= report.opened;
        a.stats = report.stats;
        a.fault = report.fault.clone().or(a.fault);
        a.refusal = report.refusal.clone().or(a.refusal);
    }
    let live = matches!(news.event, Event::Accepted | Event::Progress | Event::SeenRunning);
    if live && a.accepted.is_none() && !a.phase.is_terminal() {
        a.accepted = Some(tx.now.utc);
        disarm(tx, TimerKind::OfferAck, &a.attempt);
        arm(tx, TimerKind::StartToClose, &a.attempt, intake.spec.timeout_ms);
        if a.phase == AttemptPhase::Offered {
            a.phase = AttemptPhase::Accepted;
        }
    }
    match step.action {
        AttemptAction::Keep => {}
        AttemptAction::Stop => stop_attempt(tx, &mut a),
        AttemptAction::Uncertain => {
            let unsaid = if news.event == Event::StepUnknown { Code::StepUnknown } else { Code::LeaseOver };
            let cause = news.why.cloned().unwrap_or_else(|| unsaid.into());
            a.uncertain = Some(Uncertain { since: tx.now.utc, cause });
            arm(tx, TimerKind::Uncertain, &a.attempt, limits::UNCERTAIN_LIMIT.as_ms());
        }
        AttemptAction::Known => {
            a.uncertain = None;
            disarm(tx, TimerKind::Uncertain, &a.attempt);
            if step.phase == Phase::Stopping {
                stop_attempt(tx, &mut a);
            }
        }
        AttemptAction::End => {
            let taken = a.accepted.is_some() || a.phase == AttemptPhase::Lost;
            let confirmed = if taken { AttemptPhase::Aborted } else { AttemptPhase::OfferExpired };
            let said = phase_of(news.event, None).filter(|p| *p != AttemptPhase::Refused || a.accepted.is_none());
            a.phase = said.unwrap_or(confirmed);
            end_attempt(tx, &mut a);
        }
        AttemptAction::Abandon => {
            a.phase = AttemptPhase::Lost;
            a.uncertain = None;
            a.ended = Some(tx.now.utc);
            disarm_all(tx, &a.attempt);
            quarantine(tx, &a.robot_id, news.why);
        }
    }
    // What is no step of the attempt's own machine is an old or repeated report.
    if a.phase != AttemptPhase::Stopping
        && let Some(phase) = phase_of(news.event, news.report).filter(|p| a.phase.transitions().contains(p))
        && !a.phase.is_terminal()
    {
        a.phase = phase;
    }
    tx.put_row(a.clone(), "attempt.changed");
    a
}

/// The robot is told to stop, and has a limited time to confirm it.
fn stop_attempt(tx: &mut Tx, a: &mut Attempt) {
    a.phase = AttemptPhase::Stopping;
    disarm(tx, TimerKind::OfferAck, &a.attempt);
    disarm(tx, TimerKind::StartToClose, &a.attempt);
    if !tx.view.timers.contains_key(Timer::id_of(TimerKind::StopConfirm, &a.attempt).as_str()) {
        arm(tx, TimerKind::StopConfirm, &a.attempt, limits::STOP_CONFIRM.as_ms());
    }
}

/// The attempt is over and the robot is free: its mutex, timers, unentered grants, counters and breaker.
pub fn end_attempt(tx: &mut Tx, a: &mut Attempt) {
    a.ended = Some(tx.now.utc);
    a.uncertain = None;
    disarm_all(tx, &a.attempt);
    if tx.view.held_by(&a.robot_id) == Some(&a.attempt) {
        tx.put_row(RobotAuthority { robot_id: a.robot_id.clone(), holder: RobotHolder::None }, "robot.freed");
    }
    revoke_unentered(tx, &a.robot_id);
    lift_quarantine(tx, &a.robot_id);
    if matches!(a.phase, AttemptPhase::Refused | AttemptPhase::OfferExpired) {
        return;
    }
    count(tx, a);
    let robots_fault = a.fault.as_ref().is_some_and(|f| f.class != FaultClass::Semantic);
    if a.phase == AttemptPhase::Failed && robots_fault {
        breaker::trip(tx, &a.robot_id);
    }
    if a.phase == AttemptPhase::Failed {
        place_breaker::note_failure(tx, a);
    }
}

fn count(tx: &mut Tx, a: &Attempt) {
    let mut counter = counter(tx, &a.robot_id, &a.software);
    counter.stats += a.stats;
    if let Some(work) = energy_sums::work_of(tx.view, a) {
        counter.energy_sums.add(&work);
    }
    if a.errand.is_some() {
        counter.errands += a.stats;
    } else {
        match (a.phase, &a.fault) {
            (AttemptPhase::Succeeded, _) => counter.succeeded += 1,
            (AttemptPhase::Failed, Some(fault)) => *counter.failures.entry(fault.code).or_default() += 1,
            _ => {}
        }
    }
    tx.put_row(counter, "robot.counted");
}

/// Counts the hours of a robot that ends no attempt.
pub fn count_hours(tx: &mut Tx, robot_id: &RobotId) {
    let due = tx.view.attached.get(robot_id).is_some_and(|heard| heard.ms >= limits::HOURS_COUNTED_EVERY.as_ms());
    if let Some(session) = tx.view.sessions.get(robot_id.as_str()).filter(|_| due) {
        let software = session.row.inventory.software.clone();
        let counter = counter(tx, robot_id, &software);
        tx.put_row(counter, "robot.counted");
    }
}

/// What the robot has done under this software, with the time in which it was heard since that was last counted.
fn counter(tx: &mut Tx, robot_id: &RobotId, software: &str) -> RobotCounter {
    let known = tx.view.counters.get(format!("{robot_id}@{software}").as_str()).map(|c| c.row.clone());
    let mut counter = known.unwrap_or_else(|| RobotCounter {
        robot_id: robot_id.clone(),
        software: software.to_owned(),
        succeeded: 0,
        failures: std::collections::BTreeMap::new(),
        stats: crate::robot_events::WorkStats::default(),
        errands: crate::robot_events::WorkStats::default(),
        attached_ms: 0,
        counted: tx.now.utc,
        energy_sums: EnergySums::default(),
    });
    counter.counted = tx.now.utc;
    counter.attached_ms += tx.view.attached.get_mut(robot_id).map_or(0, |heard| std::mem::take(&mut heard.ms));
    counter
}

/// Takes back every grant the robot has not entered: it stays taken until the robot says so.
pub fn revoke_unentered(tx: &mut Tx, robot_id: &RobotId) {
    for id in places_of(tx, robot_id) {
        let Some(mut place) = tx.view.places.get(id.as_str()).map(|p| p.row.clone()) else { continue };
        let Some(holder) =
            place.holders.iter_mut().find(|h| h.robot_id == *robot_id && h.state == HolderState::Granted)
        else {
            continue;
        };
        holder.state = HolderState::Revoking;
        tx.put_row(place, "place.revoked");
    }
}

/// Closes the places in which the robot may be; where it was only let in it keeps its own seat, and the others go on.
fn quarantine(tx: &mut Tx, robot_id: &RobotId, why: Option<&Reason>) {
    for id in places_of(tx, robot_id) {
        let Some(mut place) = tx.view.places.get(id.as_str()).map(|p| p.row.clone()) else { continue };
        let is_whole = place.holder(robot_id).is_some_and(|holder| place.is_closed_whole_by(holder));
        if place.quarantine.is_none() && is_whole {
            let cause = why.map_or(Code::Forced, |r| r.code);
            place.quarantine =
                Some(Reason::from(Code::PlaceQuarantined).with("robot_id", robot_id).with("cause", cause));
            tx.put_row(place, "place.quarantined");
        }
    }
}

/// The robot reported: what was closed because nobody knew about it opens again.
pub fn lift_quarantine(tx: &mut Tx, robot_id: &RobotId) {
    for id in places_of(tx, robot_id) {
        let Some(mut place) = tx.view.places.get(id.as_str()).map(|p| p.row.clone()) else { continue };
        let ours = place
            .quarantine
            .as_ref()
            .is_some_and(|q| q.metadata.get("robot_id").is_some_and(|r| r == robot_id.as_str()));
        if ours {
            place.quarantine = None;
            tx.put_row(place, "place.quarantine_lifted");
        }
    }
}

/// Ids of the places a robot holds.
pub fn places_of(tx: &Tx, robot_id: &RobotId) -> Vec<String> {
    tx.view.held_places.get(robot_id).map(|p| p.iter().cloned().collect()).unwrap_or_default()
}

fn move_task(tx: &mut Tx, mut t: TaskState, a: Option<&Attempt>, step: Next, news: &News, intake: &TaskIntake) {
    let (was, wished, wanted) = (t.phase, t.then, t.reason.clone());
    t.phase = step.phase;
    t.then = step.then;
    if t.then.is_some() && t.then != wished && t.phase == was {
        t.reason = news.why.cloned().or(t.reason);
    }
    t.changed = tx.now.utc;
    if let Some(report) = news.report {
        let proven = a.map(|a| arrivals::proven(tx.view, &tx.now, a, &intake.spec.steps, report.step_index));
        let before = t.next_step;
        t.next_step = t.next_step.max(proven.unwrap_or(report.step_index));
        let is_all = t.phase == Phase::Succeeded;
        let done = before..if is_all { intake.spec.steps.len() as u32 } else { t.next_step };
        place_breaker::note_done(tx, &t, intake, done);
        if report.opened {
            t.opened_robot_id = t.robot_id.clone();
        }
    }
    if a.is_some_and(|a| a.accepted.is_some()) && t.started.is_none() {
        t.started = Some(tx.now.utc);
    }
    if step.action == AttemptAction::End
        && let Some(a) = a
    {
        t.stats += a.stats;
        count_end(&mut t, a, news, step);
        if t.phase == Phase::Succeeded {
            breaker::disprove(tx, &t);
        }
    }
    if t.phase != was {
        entered(tx, &mut t, was, news, intake);
    }
    let confirmed = matches!(news.event, Event::StopConfirmed | Event::Refused | Event::FailedRecoverable);
    if wished.is_some() && confirmed && (t.phase.is_terminal() || t.phase == Phase::NeedsOperator) {
        // Why it was to stop, not that it did.
        t.reason = wanted.or(t.reason);
    }
    hold_timer(tx, &t, was);
    tx.put_row(t, kind_of(step.phase));
}

fn count_end(t: &mut TaskState, a: &Attempt, news: &News, step: Next) {
    if a.phase == AttemptPhase::Refused {
        t.refusals_in_row += 1;
        t.refusers.insert(a.robot_id.clone());
        let code = a.refusal.as_ref().map(|r| r.code);
        if code == Some(Code::UnsupportedAction) {
            t.semantic_refusers.insert(a.robot_id.clone());
        }
        return;
    }
    t.refusals_in_row = 0;
    t.refusers.clear();
    let failed = matches!(news.event, Event::FailedRecoverable | Event::FailedFinal);
    if failed || (step.phase == Phase::RetryWait && a.accepted.is_some()) {
        t.failures += 1;
        t.failed_robots.insert(a.robot_id.clone());
    }
    if failed && news.report.is_some_and(says_semantic) {
        t.semantic_refusers.insert(a.robot_id.clone());
    }
}

fn kind_of(phase: Phase) -> &'static str {
    match phase {
        Phase::Queued => "task.queued",
        Phase::Assigned => "task.assigned",
        Phase::Running => "task.running",
        Phase::Held => "task.held",
        Phase::Suspended => "task.suspended",
        Phase::Stopping => "task.stopping",
        Phase::RetryWait => "task.retry_wait",
        Phase::NeedsOperator => "task.needs_operator",
        Phase::Succeeded => "task.succeeded",
        Phase::Failed => "task.failed",
        Phase::Canceled => "task.canceled",
        Phase::Expired => "task.expired",
    }
}

/// What goes with entering a phase.
fn entered(tx: &mut Tx, t: &mut TaskState, was: Phase, news: &News, intake: &TaskIntake) {
    t.retry_at = None;
    t.reason = match (t.phase, news.event) {
        // One robot's refusal is not why nobody does it.
        (Phase::NeedsOperator | Phase::Failed, Event::Refused) => default_reason(t, news),
        _ => news.why.cloned().or_else(|| default_reason(t, news)),
    };
    let waiting = AttemptId { subject: Subject::Task(t.task_id.clone()), epoch: 0 };
    if matches!(was, Phase::Queued | Phase::RetryWait) {
        disarm(tx, TimerKind::RetryDue, &waiting);
    }
    match t.phase {
        Phase::Queued => {
            // Whoever was only offered to a robot has waited all along.
            let begun = t.attempt_id().and_then(|id| tx.view.attempt(&id)).is_some_and(|a| a.accepted.is_some());
            if begun || was == Phase::NeedsOperator {
                t.queued_since = tx.now.utc;
            }
            t.reason = None;
            if was == Phase::NeedsOperator {
                t.failures = 0;
                t.refusals_in_row = 0;
                t.refusers.clear();
                t.semantic_refusers.clear();
                t.failed_robots.clear();
            }
        }
        Phase::RetryWait => {
            let wait_ms = intake.spec.retry.back_off_ms(t.failures, draw(&t.task_id, t.epoch));
            t.retry_at = Some(tx.now.utc.plus_ms(wait_ms));
            arm(tx, TimerKind::RetryDue, &waiting, wait_ms);
        }
        Phase::Running | Phase::Held => disarm(tx, TimerKind::ScheduleToStart, &waiting),
        phase if phase.is_terminal() => {
            t.ended = Some(tx.now.utc);
            disarm_all(tx, &waiting);
        }
        Phase::NeedsOperator => disarm_all(tx, &waiting),
        _ => {}
    }
}

fn default_reason(t: &TaskState, news: &News) -> Option<Reason> {
    let fault = news.report.and_then(|r| r.fault.as_ref());
    let code = match (t.phase, news.event) {
        (Phase::NeedsOperator, Event::FailedFinal) => Code::FaultNotRecoverable,
        (Phase::NeedsOperator, Event::FailedRecoverable) => Code::AttemptsSpent,
        (Phase::NeedsOperator, Event::Refused) => Code::NoRobotAccepts,
        (Phase::NeedsOperator, Event::StepUnknown) => Code::StepUnknown,
        (Phase::NeedsOperator, Event::StopConfirmed) => Code::RobotDroppedIt,
        (Phase::Failed, Event::Refused) => Code::NoRobotCan,
        (Phase::Failed, _) => Code::TaskFailed,
        (Phase::RetryWait, _) => Code::WaitingForRetry,
        (Phase::Queued | Phase::Assigned | Phase::Running | Phase::Succeeded, _) => return None,
        _ => return t.reason.clone(),
    };
    let mut reason = Reason::from(code);
    if let Some(refusal) = news.report.and_then(|r| r.refusal.as_ref()) {
        reason = reason.with("refusal", refusal.code);
    }
    if let Some(fault) = fault {
        reason = reason.with("fault_code", fault.code).with("fault", &fault.message);
    }
    Some(reason)
}

/// A number in 0..1 from the task and its epoch: spreads back-offs, the same in every replay.
fn draw(task_id: &TaskId, epoch: u64) -> f64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64 ^ epoch;
    for byte in task_id.as_str().bytes() {
        hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    }
    (hash >> 11) as f64 / (1_u64 << 53) as f64
}

/// start_to_close stands still while held.
fn hold_timer(tx: &mut Tx, t: &TaskState, was: Phase) {
    let Some(id) = t.attempt_id() else { return };
    let Some(mut timer) =
        tx.view.timers.get(Timer::id_of(TimerKind::StartToClose, &id).as_str()).map(|t| t.row.clone())
    else {
        return;
    };
    let served = tx.view.serving(&tx.now).site_ms;
    match (was, t.phase, timer.fires_at_service_ms) {
        (_, Phase::Held, Some(at)) => {
            timer.remaining_ms = at.saturating_sub(served);
            timer.fires_at_service_ms = None;
        }
        (Phase::Held, Phase::Running, None) => timer.fires_at_service_ms = Some(served + timer.remaining_ms),
        _ => return,
    }
    tx.put_row(timer, "timer.changed");
}

/// Sets a deadline `after_ms` of its own clock from now.
pub fn arm(tx: &mut Tx, kind: TimerKind, attempt: &AttemptId, after_ms: u64) {
    let served = tx.view.serving(&tx.now);
    let base = if kind.is_site() { served.site_ms } else { served.link_ms };
    let timer = Timer { kind, attempt: attempt.clone(), fires_at_service_ms: Some(base + after_ms), remaining_ms: 0 };
    tx.put_row(timer, "timer.armed");
}

/// Takes a deadline away, if there is one.
pub fn disarm(tx: &mut Tx, kind: TimerKind, attempt: &AttemptId) {
    tx.delete::<Timer>(&Timer::id_of(kind, attempt), "timer.disarmed");
}

fn disarm_all(tx: &mut Tx, attempt: &AttemptId) {
    use TimerKind::{OfferAck, RetryDue, ScheduleToStart, StartToClose, StopConfirm, Uncertain};
    for kind in [OfferAck, StopConfirm, Uncertain, StartToClose, ScheduleToStart, RetryDue] {
        disarm(tx, kind, attempt);
    }
}

/// What the robot reported, as the table's event. None: it changes nothing but the report itself.
pub fn event_of(report: &AttemptReport) -> Event {
    match report.state {
        WorkState::Accepted => Event::Accepted,
        WorkState::Refused => Event::Refused,
        // One that is not known comes here for attempts that are over only: `plausible` judges those that live.
        WorkState::Navigating
        | WorkState::Executing
        | WorkState::Paused
        | WorkState::Stopping
        | WorkState::Unknown(_) => Event::Progress,
        WorkState::Succeeded => Event::Succeeded,
        WorkState::Failed => match report.fault.as_ref().map(|f| f.class) {
            Some(FaultClass::Recoverable) => Event::FailedRecoverable,
            _ => Event::FailedFinal,
        },
        WorkState::Aborted | WorkState::Suspended => Event::StopConfirmed,
        WorkState::StepUnknown => Event::StepUnknown,
    }
}

/// Where `then` of a finished cancel is shown while the robot still stops.
pub fn wants_cancel(task: &TaskState) -> bool {
    task.then == Some(AfterStopping::Canceled)
}

/// Whether the task may wait for another robot from its next step boundary on: it runs, lets others go first, and is not opened.
pub fn may_suspend(view: &FleetProjection, task_id: &TaskId, live: &NewestHeartbeat) -> bool {
    let Some(task) = view.task(task_id).filter(|t| t.phase == Phase::Running && t.opened_robot_id.is_none()) else {
        return false;
    };
    let opened = task.attempt_id().and_then(|id| view.attempt(&id)).is_none_or(|a| a.is_opened);
    let preemptible = view.intake(task_id).is_some_and(|i| i.spec.preemptible);
    !opened && preemptible && load::carried(view, live).is_none()
}

/// A robot that was kept for an attempt the record had let go reports its end: it is free again.
pub(in crate::fleet) fn release(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport) {
    if tx.view.held_by(robot_id) != Some(&report.attempt) {
        return;
    }
    // An attempt that is still live in the record ends by the table or by repair, never beside its task.
    let lost = tx.view.attempt(&report.attempt).filter(|a| a.phase == AttemptPhase::Lost);
    let Some(mut a) = lost.cloned() else { return };
    a.stats = report.stats;
    a.phase = AttemptPhase::Aborted;
    end_attempt(tx, &mut a);
    tx.put_row(a, "attempt.released");
}
