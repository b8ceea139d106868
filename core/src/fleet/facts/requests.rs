//! Obeys what people asked of tasks and robots: cancel, resolve, resume, and by `task_changes` edit, hold and release. Requests are durable
//! before they come here.

use super::holds::holds_changed;
use super::stops;
use super::task_changes::change_task;
use crate::fleet::decision::plan::{Plan, Tx, mark};
use crate::fleet::projection::rows::HoldToken;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::{News, apply_event, go_on_unless_held};
use crate::fleet::traffic::grants;
use crate::ids::{AreaId, RobotId, TaskId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::rows::{Entry, Seq};
use crate::task::{Ask, Event, Phase, Resolution, TaskRequest};
use crate::time::Now;

/// Obeys one request. The mark that it was obeyed goes with the last item: what was lost on the way is done again. False: the store would
/// never take it.
pub fn obey_request(
    view: &mut FleetProjection,
    now: Now,
    request: &TaskRequest,
    entry: &Entry,
    plan: &mut Plan,
) -> bool {
    let resumes = match &request.ask {
        Ask::ResumeHeld { stop_id, area_id, task_ids, robot_ids } => {
            resumes(view, stop_id.as_deref(), area_id.as_ref(), task_ids, robot_ids)
        }
        _ => Vec::new(),
    };
    let mut decide = |decision: &mut dyn FnMut(&mut Tx)| -> bool {
        let mut tx = Tx::new(view, now, &request.actor).on_request(entry.request_id.as_deref());
        decision(&mut tx);
        plan.keep_decision(tx)
    };
    for some in resumes.chunks(limits::RESUMES_PER_ITEM) {
        decide(&mut |tx| {
            some.iter().for_each(|one| resume(tx, one));
            // The mark stays where it is and is written all the same: an item of this request that is lost takes the later ones with it.
            let before = tx.view.marks.get("fleet").map_or(Seq(0), |m| m.row.seq);
            mark(tx, before);
        });
    }
    decide(&mut |tx| {
        match &request.ask {
            Ask::Cancel { task_id, force } => cancel(tx, task_id, *force, request),
            Ask::Resolve { task_id, resolution } => resolve(tx, task_id, *resolution, request),
            Ask::Edit { task_id, .. } | Ask::Hold { task_id } | Ask::Release { task_id } => {
                change_task(tx, task_id, request);
            }
            Ask::ResumeHeld { .. } => {}
        }
        mark(tx, entry.seq);
    })
}

fn cancel(tx: &mut Tx, task_id: &TaskId, force: bool, request: &TaskRequest) {
    let Some(mut task) = tx.view.task(task_id).cloned() else { return };
    task.cancel_requested = Some(tx.now.utc);
    tx.put_row(task, "task.cancel_requested");
    let code = if force { Code::Forced } else { Code::CanceledByPerson };
    let why = Reason::new(code, request.reason.clone()).with("actor", &request.actor);
    let event = if force { Event::CancelForce } else { Event::Cancel };
    apply_event(tx, task_id, News::from_event(event, Some(&why)));
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
    if !allowed_resolutions(task.phase, task.opened_robot_id.is_some(), kept).contains(&resolution) {
        return;
    }
    match resolution {
        Resolution::RequeueHandedOver => task.opened_robot_id = None,
        Resolution::RequeuePutBack => {
            task.opened_robot_id = None;
            task.next_step = 0;
        }
        _ => {}
    }
    tx.put_row(task, "task.resolved");
    let event = match resolution {
        Resolution::Requeue | Resolution::RequeueHandedOver | Resolution::RequeuePutBack => Event::ResolveRequeue,
        Resolution::Succeeded => Event::ResolveSucceeded,
        Resolution::Failed | Resolution::FailedItemLost => Event::ResolveFailed,
        Resolution::Canceled => Event::ResolveCanceled,
    };
    let why = Reason::new(Code::ResolvedByPerson, request.reason.clone()).with("actor", &request.actor);
    apply_event(tx, task_id, News::from_event(event, Some(&why)));
}

/// One thing that is let go.
enum Resume {
    /// A token of a robot.
    Robot(HoldToken),
    /// Tokens of a task that this takes away.
    Task(TaskId, Vec<String>),
}

/// What a resume lets go: `resume:` tokens of the robots and tasks that are named, or that stand in the area.
fn resumes(
    view: &FleetProjection,
    stop_id: Option<&str>,
    area_id: Option<&AreaId>,
    task_ids: &[TaskId],
    robot_ids: &[RobotId],
) -> Vec<Resume> {
    let wanted = |token: &str| match stop_id {
        Some(stop) => token.strip_prefix("resume:") == Some(stop),
        None => token.starts_with("resume:"),
    };
    // A stop that is named alone means everywhere; the service refuses a request that names nothing.
    let anywhere = area_id.is_none() && task_ids.is_empty() && robot_ids.is_empty();
    let area_robots = area_id.map(|area| grants::robots_in_area(view, area)).unwrap_or_default();
    let near = |robot: &RobotId| anywhere || robot_ids.contains(robot) || area_robots.contains(robot);
    let works_on = |robot: &RobotId| {
        view.held_by(robot).and_then(|a| a.subject.task_id()).is_some_and(|task| task_ids.contains(task))
    };
    let tokens = view.holds.values().map(|h| &h.row).filter(|h| wanted(&h.token));
    let robots = tokens.filter(|h| near(&h.robot_id) || works_on(&h.robot_id)).cloned().map(Resume::Robot);
    let tasks = view.tasks.values().map(|t| &t.row).filter_map(|t| {
        let tokens: Vec<String> = t.holds.iter().filter(|h| wanted(h)).cloned().collect();
        let named = task_ids.contains(&t.task_id) || t.robot_id.as_ref().map_or(anywhere, near);
        (named && !tokens.is_empty()).then(|| Resume::Task(t.task_id.clone(), tokens))
    });
    robots.chain(tasks).collect()
}

fn resume(tx: &mut Tx, resume: &Resume) {
    match resume {
        Resume::Robot(hold) => {
            tx.delete::<HoldToken>(&HoldToken::id_of(&hold.robot_id, &hold.token), "hold.resumed");
            stops::resumed(tx, &hold.robot_id, &hold.token);
            holds_changed(tx, &hold.robot_id);
        }
        Resume::Task(task_id, tokens) => {
            let Some(mut task) = tx.view.task(task_id).cloned() else { return };
            task.holds.retain(|h| !tokens.contains(h));
            tx.put_row(task.clone(), "task.resumed");
            go_on_unless_held(tx, &task);
        }
    }
}
