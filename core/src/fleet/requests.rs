//! Obeys what people asked of tasks and robots: cancel, resolve, resume. Requests are durable before they come here.

use super::inbox::holds_changed;
use super::rows::HoldToken;
use super::tasks::{News, happen};
use super::tx::Tx;
use crate::ids::{AreaId, RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::task::{Ask, Event, Phase, Resolution, TaskRequest};
use std::collections::BTreeSet;

/// Obeys one request.
pub fn take(tx: &mut Tx, request: &TaskRequest) {
    match &request.ask {
        Ask::Cancel { task_id, force } => cancel(tx, task_id, *force, request),
        Ask::Resolve { task_id, resolution } => resolve(tx, task_id, *resolution, request),
        Ask::ResumeHeld { stop_id, area_id, task_ids, robot_ids } => {
            resume(tx, stop_id.as_deref(), area_id.as_ref(), task_ids, robot_ids);
        }
    }
}

fn cancel(tx: &mut Tx, task_id: &TaskId, force: bool, request: &TaskRequest) {
    let Some(mut task) = tx.view.task(task_id).cloned() else { return };
    task.cancel_requested = Some(tx.now.utc);
    tx.put(task, "task.cancel_requested");
    let code = if force { Code::Forced } else { Code::CanceledByUser };
    let why = Reason::new(code, request.reason.clone()).with("actor", &request.actor);
    let event = if force { Event::CancelForce } else { Event::Cancel };
    happen(tx, task_id, News::of(event, Some(&why)));
}

/// What a person may answer to a task in NEEDS_OPERATOR.
pub fn allowed_resolutions(phase: Phase, opened: bool, robot_kept: bool) -> Vec<Resolution> {
    use Resolution::{Canceled, Failed, FailedItemLost, Requeue, RequeueHandedOver, RequeuePutBack, Succeeded};
    match (phase, opened, robot_kept) {
        (Phase::NeedsOperator, false, _) => vec![Requeue, Succeeded, Failed, Canceled],
        (Phase::NeedsOperator, true, false) => {
            vec![Requeue, RequeueHandedOver, RequeuePutBack, Succeeded, Failed, FailedItemLost, Canceled]
        }
        (Phase::NeedsOperator, true, true) => {
            vec![RequeueHandedOver, RequeuePutBack, Succeeded, Failed, FailedItemLost, Canceled]
        }
        _ => Vec::new(),
    }
}

fn resolve(tx: &mut Tx, task_id: &TaskId, resolution: Resolution, request: &TaskRequest) {
    let Some(mut task) = tx.view.task(task_id).cloned() else { return };
    let kept =
        task.robot_id.as_ref().is_some_and(|r| tx.view.held_by(r) == task.attempt_id().as_ref() && task.epoch > 0);
    if !allowed_resolutions(task.phase, task.opened.is_some(), kept).contains(&resolution) {
        return;
    }
    match resolution {
        Resolution::RequeueHandedOver => task.opened = None,
        Resolution::RequeuePutBack => {
            task.opened = None;
            task.next_step = 0;
        }
        _ => {}
    }
    tx.put(task, "task.resolved");
    let event = match resolution {
        Resolution::Requeue | Resolution::RequeueHandedOver | Resolution::RequeuePutBack => Event::ResolveRequeue,
        Resolution::Succeeded => Event::ResolveSucceeded,
        Resolution::Failed | Resolution::FailedItemLost => Event::ResolveFailed,
        Resolution::Canceled => Event::ResolveCanceled,
    };
    let why = Reason::new(Code::ResolvedByUser, request.reason.clone()).with("actor", &request.actor);
    happen(tx, task_id, News::of(event, Some(&why)));
}

/// Takes `resume:` tokens away. Nothing named: of all robots and tasks.
fn resume(tx: &mut Tx, stop_id: Option<&str>, area_id: Option<&AreaId>, task_ids: &[TaskId], robot_ids: &[RobotId]) {
    let wanted = |token: &str| match stop_id {
        Some(stop) => token == format!("resume:{stop}"),
        None => token.starts_with("resume:"),
    };
    let anywhere = area_id.is_none() && task_ids.is_empty() && robot_ids.is_empty();
    let area_robots: BTreeSet<RobotId> = match area_id {
        Some(area) => super::places::robots_in_area(tx.view, area),
        None => BTreeSet::new(),
    };
    let of_task = |tx: &Tx, robot: &RobotId| {
        tx.view.held_by(robot).and_then(|a| a.subject.task_id()).is_some_and(|t| task_ids.contains(t))
    };
    let tokens: Vec<HoldToken> = tx.view.holds.values().map(|h| h.row.clone()).filter(|h| wanted(&h.token)).collect();
    for hold in tokens {
        let robot = &hold.robot_id;
        if anywhere || robot_ids.contains(robot) || area_robots.contains(robot) || of_task(tx, robot) {
            tx.delete::<HoldToken>(&HoldToken::id_of(robot, &hold.token), "hold.resumed");
            holds_changed(tx, robot);
        }
    }
    let held: Vec<TaskId> = tx
        .view
        .tasks
        .values()
        .filter(|t| t.row.holds.iter().any(|h| wanted(h)))
        .map(|t| t.row.task_id.clone())
        .collect();
    for task_id in held {
        let Some(mut task) = tx.view.task(&task_id).cloned() else { continue };
        let near = task.robot_id.as_ref().is_some_and(|r| robot_ids.contains(r) || area_robots.contains(r));
        if anywhere || near || task_ids.contains(&task_id) {
            task.holds.retain(|h| !wanted(h));
            let free = task.holds.is_empty();
            tx.put(task, "task.resumed");
            if free {
                happen(tx, &task_id, News::of(Event::LastHoldGone, None));
            }
        }
    }
}
