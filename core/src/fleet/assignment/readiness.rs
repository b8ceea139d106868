//! Brings the queue up to now: marks tasks that are ready, and gives to a person what can never be done or waits for too long.
//!
//! Called once a cycle, before tasks are given. Invariant: a turn looks at a bounded number of tasks; the others follow in the next.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::index::advance;
use crate::fleet::projection::queue::{TASKS_PER_TURN, Wait};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::{News, apply_event};
use crate::fleet::tasks::{eligibility, place_breaker, timers};
use crate::ids::TaskId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::task::Event;
use crate::time::{Now, Utc};

/// Brings the queue up to now: notes since when a task is ready, arms what counts from then, and gives to a person what can never be ready.
/// Gives back tasks that moved in the queue.
pub(in crate::fleet) fn settle(view: &mut FleetProjection, now: Now, plan: &mut Plan) -> Vec<TaskId> {
    advance(view, now.utc);
    place_breaker::choose_probes(view, now.utc);
    coalesce(view, now, plan);
    let mut moved = Vec::new();
    for task_id in view.queue.failed.iter().take(TASKS_PER_TURN).cloned().collect::<Vec<_>>() {
        let why = view.queue.waiting.get(&task_id).and_then(|w| w.wait.reason());
        if plan.is_cut() {
            return moved;
        }
        ask_person(view, now, &task_id, why.as_ref(), plan);
    }
    for task_id in view.queue.moved.iter().take(TASKS_PER_TURN).cloned().collect::<Vec<_>>() {
        if plan.is_cut() {
            return moved;
        }
        let is_unmarked = view.queue.waiting.get(&task_id).is_some_and(|w| w.wait == Wait::Mark);
        plan.decide(view, now, "fleet", |tx| {
            if is_unmarked && let Some(mut task) = tx.view.task(&task_id).cloned() {
                task.ready_since = Some(now.utc);
                task.same_robot = tx.view.robot_asked_for(&task_id).cloned();
                tx.put_row(task, "task.ready");
            }
            timers::count_readiness(tx, &task_id);
        });
        view.queue.moved.remove(&task_id);
        moved.push(task_id);
    }
    check_robots(view, now, plan);
    moved
}

/// Notes what some tasks have before them that began to be ready and that the plan gave to nobody, and some that are ready for long.
pub(in crate::fleet) fn reckon_starts(view: &mut FleetProjection, now: Now, moved: &[TaskId]) {
    let left: Vec<&TaskId> = moved.iter().filter(|task_id| view.queue.rank(task_id).is_some()).collect();
    for task_id in view.starts.pick_tasks(left.into_iter(), now.utc) {
        match view.start_outlook(&task_id, now.utc) {
            Some(outlook) => view.starts.reckon_task(&task_id, &outlook, now.utc),
            None => view.starts.forget_task(&task_id),
        }
    }
}

/// Ends ready tasks that a newer one with the same key replaces, but those that others wait for. What they had waited for already counts for the
/// newer one.
fn coalesce(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let replaced = view.same_key.replaced().filter(|(older, _)| !view.dependants.contains_key(older));
    let replaced: Vec<_> =
        replaced.take(TASKS_PER_TURN).map(|(older, newest)| (older.clone(), newest.clone())).collect();
    for (older, newest) in replaced {
        if plan.is_cut() {
            break;
        }
        let Some((was, mut stays)) = view.task(&older).zip(view.task(&newest).cloned()) else { continue };
        let asked = [was.asked_since, was.ready_since, stays.asked_since].into_iter().flatten().min();
        stays.asked_since = asked.filter(|asked| *asked <= now.utc);
        let told = format!("The newer task {newest} with the same coalesce_key replaces it.");
        let why = Reason::new(Code::Coalesced, told).with("task_id", &newest);
        plan.decide(view, now, "fleet", |tx| {
            apply_event(tx, &older, News::from_event(Event::Cancel, Some(&why)));
            if tx.view.task(&newest) != Some(&stays) {
                tx.put_row(stays.clone(), "task.replaces");
            }
        });
    }
    plan.slice.renew();
}

/// Gives a waiting task to a person.
fn ask_person(view: &mut FleetProjection, now: Now, task_id: &TaskId, why: Option<&Reason>, plan: &mut Plan) {
    plan.decide(view, now, "fleet", |tx| {
        apply_event(tx, task_id, News::from_event(Event::ScheduleToStart, why));
    });
}

/// A task that is ready for long and that no known robot could ever do goes to a person.
fn check_robots(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    while let Some(task_id) = view.queue.unchecked.first().filter(|_| !plan.is_cut()).cloned() {
        view.queue.unchecked.remove(&task_id);
        let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
        if let Err(why) = eligibility::could_ever(view, task, intake, &mut plan.slice) {
            ask_person(view, now, &task_id, Some(&why), plan);
        }
    }
}

/// One incident of the site tells of a backlog. It closes by itself, and opens again after a pause.
pub(in crate::fleet) fn tell_backlog(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let id = format!("{}:{}", Code::TaskBacklog, view.site.site_id());
    let known = view.incidents.get(id.as_str()).map(|incident| &incident.row);
    let old = view.queue.oldest().filter(|(since, _)| now.ms_since(*since) > limits::BACKLOG_AGE.as_ms());
    match (old, known.map(|incident| &incident.closed)) {
        (None, Some(None)) => {
            let why = "no task waits longer than an hour";
            plan.decide(view, now, "fleet", |tx| incidents::close(tx, &id, why, "fleet"));
        }
        (Some((since, task_id)), closed) => {
            let rested = |at: Utc| now.ms_since(at) >= limits::BACKLOG_PAUSE.as_ms();
            if closed.is_some_and(|closed| closed.as_ref().is_none_or(|closed| !rested(closed.at))) {
                return;
            }
            let reason = Reason::from(Code::TaskBacklog).with("oldest_task_id", task_id).with("since", since.rfc3339());
            let reason = reason.with("tasks", view.queue.ready.len());
            plan.decide(view, now, "fleet", |tx| incidents::open_as(tx, id, reason, None, None));
        }
        (None, _) => {}
    }
}
