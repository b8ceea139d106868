//! What a robot has in its hands, by its own word and by a person's, and who waits for it to be laid down.
//!
//! Called by every room that asks whether a robot carries something. Invariants:
//! 1. What a robot says only adds: a person's word that it carries nothing holds against heartbeats up to the newest at that
//!    moment, and against no newer one.
//! 2. A robot that drains is given no work but the rest of the task whose item it carries.

use super::rows::{Drain, DrainState, LoadSettled};
use super::view::View;
use super::{Board, heard};
use crate::ids::RobotId;
use crate::reason::{Code, Kind, Reason, Refusal};
use crate::robot::{Load, Presence};
use crate::task::Phase;
use crate::time::Now;
use crate::work::Live;

/// What a robot carries by its newest heartbeat, unless a person has said since that it carries nothing.
pub fn carried<'l>(view: &View, live: &'l Live) -> Option<&'l Load> {
    live.report.load.as_ref().filter(|_| settled(view, &live.robot_id, Some(live)).is_none())
}

/// A person's word that the robot carries nothing, as long as the robot has said nothing newer.
pub fn settled<'v>(view: &'v View, robot_id: &RobotId, live: Option<&Live>) -> Option<&'v LoadSettled> {
    let word = view.control.get(robot_id.as_str())?.row.load_settled.as_ref()?;
    let is_newer = |live: &Live| (live.report.session_epoch, live.report.hb) > (word.session_epoch, word.hb);
    (!live.is_some_and(is_newer)).then_some(word)
}

/// Whether a person's word can settle what the robot carries: not against its own word while it is heard, nor beside a task
/// whose item lies on it as far as anybody knows.
///
/// # Errors
/// Who says otherwise.
pub(super) fn may_settle(view: &View, board: &Board, now: &Now, robot_id: &RobotId) -> Result<(), Refusal> {
    let no = |reason: Reason| Err(Refusal::new(Kind::Precondition, reason.with("robot_id", robot_id)));
    let is_heard = heard::presence(board, robot_id, now) != Presence::Offline;
    if let Some(load) = board.get(robot_id).filter(|_| is_heard).and_then(|live| live.report.load.as_ref()) {
        let item = &load.item;
        let told = format!(
            "{robot_id} is heard and says itself that it carries {item}: take it off, and if the robot cannot feel that, tell \
             it at its own panel. Its next heartbeat settles it."
        );
        let reason = Reason::new(Code::RobotLoaded, told).with("item", item);
        return no(load.task_id.iter().fold(reason, |reason, task_id| reason.with("task_id", task_id)));
    }
    let opened = view.tasks.values().map(|task| &task.row).find(|task| task.opened.as_ref() == Some(robot_id));
    let Some(task) = opened else { return Ok(()) };
    let told = format!(
        "Task {0} is {1} and its item lies on {robot_id} as far as anybody knows: say first what became of it, with \
         `midshift task resolve {0}` or `midshift task cancel {0}`.",
        task.task_id,
        task.phase.as_str()
    );
    no(Reason::new(Code::NotAllowedNow, told).with("task_id", &task.task_id))
}

/// Session and number of the newest heartbeat by now; the highest number, if this server has not heard the robot.
pub(super) fn newest_word(view: &View, board: &Board, robot_id: &RobotId) -> (u64, u64) {
    let session = || view.sessions.get(robot_id.as_str()).map_or(0, |session| session.row.session_epoch);
    board.get(robot_id).map_or_else(|| (session(), u64::MAX), |live| (live.report.session_epoch, live.report.hb))
}

/// The robot carries something that it is not taken with: software changes only on an empty robot, unless it goes back to what it kept.
/// With a person's drain somebody comes to it, who waits only for a task that goes on.
pub fn must_deliver(view: &View, drain: &Drain, live: Option<&Live>) -> bool {
    let loaded = live.is_some_and(|live| carried(view, live).is_some());
    loaded && !drain.returns && (!drain.is_of_person() || goes_on(view, live))
}

/// The task whose item the robot carries is tried again by itself, on this robot.
pub fn goes_on(view: &View, live: Option<&Live>) -> bool {
    let Some(live) = live else { return false };
    let task_id = carried(view, live).and_then(|load| load.task_id.as_ref());
    task_id.and_then(|id| view.task(id)).is_some_and(|task| {
        let waits = matches!(task.phase, Phase::Queued | Phase::RetryWait);
        waits && task.opened.as_ref() == Some(&live.robot_id)
    })
}

/// Whether a robot that drains may be given work all the same: of the task whose item it carries, and of no other.
pub fn may_end_its_task(view: &View, drain: &Drain, live: &Live) -> bool {
    drain.state == DrainState::Draining && must_deliver(view, drain, Some(live)) && goes_on(view, Some(live))
}
