//! What a robot has in its hands, by its own word and by a person's, and who waits for it to be laid down.
//!
//! Called by every room that asks whether a robot carries something. Invariants:
//! 1. What a robot says only adds: a person's word that it carries nothing holds against heartbeats up to the newest at that
//!    moment, and against no newer one.
//! 2. A robot that is heard and knows its load by memory alone is told that word, and counts as loaded until it has forgotten
//!    the load: a heartbeat may be under way that still names it.
//! 3. A robot that drains is given no work but the rest of the task whose item it carries.

use crate::desired_state::LoadWord;
use crate::fleet::decision::plan::Tx;
use crate::fleet::decision::report::WAITS_FOR;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::{Drain, DrainState, LoadSettled, RobotControl};
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::presence::Presence;
use crate::reason::{Code, Kind, Reason, Refusal};
use crate::robot::Load;
use crate::step::Effect;
use crate::task::{Phase, TaskIntake, TaskState};
use crate::time::Now;

/// What a robot carries by its newest heartbeat, unless a person has said since, while it was not heard, that it carries nothing.
pub fn carried<'l>(view: &FleetProjection, live: &'l NewestHeartbeat) -> Option<&'l Load> {
    live.report.load.as_ref().filter(|_| settled(view, &live.robot_id, Some(live)).is_none())
}

/// A person's word that holds: the robot was not heard then, and has said nothing newer.
fn settled<'v>(
    view: &'v FleetProjection,
    robot_id: &RobotId,
    live: Option<&NewestHeartbeat>,
) -> Option<&'v LoadSettled> {
    let word = view.control.get(robot_id.as_str())?.row.load_settled.as_ref().filter(|word| !word.is_forget_pending)?;
    let is_newer = |live: &NewestHeartbeat| (live.report.session_epoch, live.report.hb) > (word.session_epoch, word.hb);
    (!live.is_some_and(is_newer)).then_some(word)
}

/// A person's word that the robot carries nothing: it holds, or the robot is told it.
pub fn standing_word<'v>(
    view: &'v FleetProjection,
    robot_id: &RobotId,
    live: Option<&NewestHeartbeat>,
) -> Option<&'v LoadSettled> {
    let told = || view.control.get(robot_id.as_str())?.row.load_settled.as_ref().filter(|word| word.is_forget_pending);
    settled(view, robot_id, live).or_else(told)
}

/// Whether the robot knows what it carries by its memory alone, and forgets it by a person's word.
fn is_by_memory(view: &FleetProjection, robot_id: &RobotId) -> bool {
    view.sessions.get(robot_id.as_str()).is_some_and(|session| session.row.inventory.load_by_memory)
}

/// A person's word as the robot is told it: while it says by memory, in the session of that word, that it carries something.
pub(in crate::fleet) fn word_for(view: &FleetProjection, live: &NewestHeartbeat) -> Option<LoadWord> {
    let report = &live.report;
    let word = view.control.get(live.robot_id.as_str())?.row.load_settled.as_ref()?;
    let is_older = word.session_epoch == report.session_epoch && word.hb <= report.hb;
    let is_due = is_older && report.load.is_some() && is_by_memory(view, &live.robot_id);
    is_due.then_some(LoadWord { session_epoch: word.session_epoch, hb: word.hb })
}

/// Ends a person's word that the robot's own has overtaken: it carries nothing any more, or speaks in another session.
pub(in crate::fleet) fn end_word(tx: &mut Tx, live: &NewestHeartbeat) {
    let Some(control) = tx.view.control.get(live.robot_id.as_str()).map(|control| &control.row) else { return };
    let Some(word) = &control.load_settled else { return };
    let (session_epoch, hb) = (live.report.session_epoch, live.report.hb);
    let is_confirmed = (session_epoch, hb) > (word.session_epoch, word.hb) && live.report.load.is_none();
    if is_confirmed || session_epoch > word.session_epoch {
        let control = RobotControl { load_settled: None, ..control.clone() };
        tx.put_row(control, "robot.load_word_over");
    }
}

/// Whether the load is the item of the task, as the record of the task has it. Once a person has put the item back no step that
/// took it counts as done, and who still carries it by its own word carries something else.
pub(in crate::fleet) fn is_item_of(load: &Load, task: &TaskState, intake: &TaskIntake) -> bool {
    let mut done = intake.spec.steps.iter().take(task.next_step as usize);
    let was_taken = task.opened_robot_id.is_some() || done.any(|step| step.effect == Effect::AtMostOnce);
    load.task_id.as_ref() == Some(&task.task_id) && was_taken
}

/// Says that the robot carries what keeps it from other work, and what a person can do about it.
pub(in crate::fleet) fn explain_load(view: &FleetProjection, robot_id: &RobotId, load: &Load) -> Reason {
    let reason = Reason::from(Code::RobotLoaded).with("item", &load.item);
    if !is_by_memory(view, robot_id) {
        return reason;
    }
    reason.with(WAITS_FOR, format!("a person who has looked: midshift robot load {robot_id} --none"))
}

/// Whether a person may declare that the robot carries nothing. Refused in two cases:
/// 1. The robot is heard, reports a load, and does not know it by memory alone.
/// 2. A task is opened on this robot, so that its item still lies on it as far as the rows know.
///
/// # Errors
/// The case that applies, with what to do instead.
pub(in crate::fleet) fn may_settle(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    robot_id: &RobotId,
) -> Result<(), Refusal> {
    let no = |reason: Reason| Err(Refusal::new(Kind::Precondition, reason.with("robot_id", robot_id)));
    let is_believed = liveness::presence(board, robot_id, now) != Presence::Offline && !is_by_memory(view, robot_id);
    if let Some(load) = board.get(robot_id).filter(|_| is_believed).and_then(|live| live.report.load.as_ref()) {
        let item = &load.item;
        let told = format!(
            "{robot_id} is heard and feels that it carries {item}: take it off, and its next heartbeat settles it. A robot that \
             cannot feel it says so when it connects (`load_by_memory`); one that does not say so is told at its own panel."
        );
        let reason = Reason::new(Code::RobotLoaded, told).with("item", item);
        return no(load.task_id.iter().fold(reason, |reason, task_id| reason.with("task_id", task_id)));
    }
    let opened = view.tasks.values().map(|task| &task.row).find(|task| task.opened_robot_id.as_ref() == Some(robot_id));
    let Some(task) = opened else { return Ok(()) };
    let told = format!(
        "Task {0} is {1} and its item lies on {robot_id} as far as anybody knows: say first what became of it, with \
         `midshift task resolve {0} --as ANSWER --reason TEXT` or `midshift task cancel {0}`.",
        task.task_id,
        task.phase.as_str()
    );
    no(Reason::new(Code::NotAllowedNow, told).with("task_id", &task.task_id))
}

/// A person's word against the newest heartbeat by now; against all of the session, if this server has not heard the robot.
pub(in crate::fleet) fn settle(tx: &Tx, board: &Board, robot_id: &RobotId, reason: &str, actor: &str) -> LoadSettled {
    let session = || tx.view.sessions.get(robot_id.as_str()).map_or(0, |session| session.row.session_epoch);
    let live = board.get(robot_id);
    let (session_epoch, hb) =
        live.map_or_else(|| (session(), u64::MAX), |live| (live.report.session_epoch, live.report.hb));
    let is_heard = liveness::presence(board, robot_id, &tx.now) != Presence::Offline;
    LoadSettled {
        reason: reason.to_owned(),
        actor: actor.to_owned(),
        since: tx.now.utc,
        session_epoch,
        hb,
        is_forget_pending: is_heard && live.is_some_and(|live| live.report.load.is_some()),
    }
}

/// The robot carries something that it is not taken with: software changes only on an empty robot, unless it goes back to what it kept.
/// With a person's drain somebody comes to it, who waits only for a task that goes on.
pub fn must_deliver(view: &FleetProjection, drain: &Drain, live: Option<&NewestHeartbeat>) -> bool {
    let loaded = live.is_some_and(|live| carried(view, live).is_some());
    loaded && !drain.is_way_back && (!drain.is_of_person() || goes_on(view, live))
}

/// The task whose item the robot carries is tried again by itself, on this robot.
pub fn goes_on(view: &FleetProjection, live: Option<&NewestHeartbeat>) -> bool {
    let Some(live) = live else { return false };
    let task_id = carried(view, live).and_then(|load| load.task_id.as_ref());
    task_id.and_then(|id| view.task(id)).is_some_and(|task| {
        let waits = matches!(task.phase, Phase::Queued | Phase::RetryWait);
        waits && task.opened_robot_id.as_ref() == Some(&live.robot_id)
    })
}

/// Whether a robot that drains may be given work all the same: of the task whose item it carries, and of no other.
pub fn may_end_its_task(view: &FleetProjection, drain: &Drain, live: &NewestHeartbeat) -> bool {
    drain.state == DrainState::Draining && must_deliver(view, drain, Some(live)) && goes_on(view, Some(live))
}
