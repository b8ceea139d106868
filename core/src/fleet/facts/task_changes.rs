//! Edits, holds and releases tasks as people asked. What became of each request is kept in the task's own row, beside what it did.
//!
//! Invariants:
//! 1. A request is answered in the item that carries it out or refuses it: its caller is told nothing else, however often it asks.
//! 2. What was asked for stays as it was: an edit goes before it.
//! 3. A hold keeps the robot, its places and its load where they are.

use super::holds;
use crate::fleet::decision::plan::Tx;
use crate::fleet::tasks::transitions::{self, News, apply_event};
use crate::ids::TaskId;
use crate::reason::{Code, Reason};
use crate::rows::Revision;
use crate::task::requests::{check_alive, check_edit};
use crate::task::state::{OPERATOR_HOLD, OperatorHold};
use crate::task::{Ask, Event, TaskEdit, TaskRequest, TaskState};
use crate::time::Utc;

/// Carries out an edit, a hold or a release, or refuses it, and notes the answer. A task that has ended and was let go has none.
pub(super) fn change_task(tx: &mut Tx, task_id: &TaskId, request: &TaskRequest) {
    let Some(task) = tx.view.task(task_id).cloned() else { return };
    let (kind, done) = match &request.ask {
        Ask::Edit { seen, edit, .. } => ("task.edited", edit_task(tx, task, *seen, edit)),
        Ask::Hold { .. } => ("task.held_by_person", hold_task(tx, task, request)),
        Ask::Release { .. } => ("task.released", release_task(tx, task)),
        Ask::Cancel { .. } | Ask::Resolve { .. } | Ask::ResumeHeld { .. } => return,
    };
    let Some(mut task) = tx.view.task(task_id).cloned() else { return };
    let kind = if done.is_ok() { kind } else { "task.change_refused" };
    task.note_answer(&request.id, done.err());
    tx.put_row(task, kind);
}

fn edit_task(tx: &mut Tx, task: TaskState, seen: Option<Revision>, edit: &TaskEdit) -> Result<(), Reason> {
    let task_id = task.task_id.clone();
    let revision = tx.view.tasks.get(task_id.as_str()).map_or(Revision(0), |row| row.revision);
    let intake = tx.view.intake(&task_id).cloned().ok_or(Code::NotAllowedNow)?;
    check_edit(&task, revision, &intake, seen, edit)?;
    if !apply_event(tx, &task_id, News::from_event(Event::Edit, None)) {
        return Err(Code::NotAllowedNow.into());
    }
    let Some(mut task) = tx.view.task(&task_id).cloned() else { return Ok(()) };
    if edit.priority.is_some_and(|priority| priority != task.priority(&intake)) {
        task.priority_since = Some(tx.now.utc);
    }
    task.edit = task.edit.and_then(edit.clone());
    if edit.not_before.is_some() {
        let begins = task.not_before(&intake).map_or(tx.now.utc, |at| at.max(tx.now.utc));
        forget_promised_start(&mut task, tx.now.utc, begins);
    }
    tx.put_row(task, "task.edited");
    Ok(())
}

/// A task is born with the time at which it will be ready. What keeps it from that takes the word back: it is noted anew when it is ready.
fn forget_promised_start(task: &mut TaskState, now: Utc, begins: Utc) {
    task.ready_since = task.ready_since.filter(|since| *since <= now);
    if task.queued_since > now {
        task.queued_since = begins;
    }
}

fn hold_task(tx: &mut Tx, mut task: TaskState, request: &TaskRequest) -> Result<(), Reason> {
    check_alive(&task)?;
    let (task_id, since) = (task.task_id.clone(), tx.now.utc);
    task.holds.insert(OPERATOR_HOLD.to_owned());
    let (actor, reason) = (request.actor.clone(), request.reason.clone());
    task.operator_hold = Some(OperatorHold { actor, reason, since });
    let begins = task.queued_since;
    forget_promised_start(&mut task, since, begins);
    let why = task.held_by_person();
    tx.put_row(task, "task.held_by_person");
    apply_event(tx, &task_id, News::from_event(Event::Hold, why.as_ref()));
    Ok(())
}

fn release_task(tx: &mut Tx, mut task: TaskState) -> Result<(), Reason> {
    check_alive(&task)?;
    task.holds.remove(OPERATOR_HOLD);
    task.operator_hold = None;
    if let Some(why) = task.robot_id.as_ref().and_then(|robot_id| holds::why_held(tx.view, robot_id))
        && task.reason.as_ref().is_some_and(|reason| reason.code == Code::HoldByPerson)
    {
        task.reason = Some(why);
    }
    tx.put_row(task.clone(), "task.released");
    transitions::go_on_unless_held(tx, &task);
    Ok(())
}
