//! Keeps what is derived from rows: each row that changes brings the queue, deadlines, holders of places and robots to
//! compose up to date.
//!
//! Invariant: what is derived depends on the rows alone, never on the order in which they came; but for a probe of a broken step, which
//! only the process knows that chose it.

use super::broken_steps::{StepAt, StepChange};
use super::queue::{Ended, TASKS_PER_TURN, Wait};
use super::rows::{
    Drain, HoldToken, Incident, Place, PlaceBlock, RobotAuthority, RobotControl, RobotCounter, RobotHolder,
};
use super::state::FleetProjection;
use crate::energy::fit::fit_robot;
use crate::ids::{RobotId, TaskId};
use crate::policy::AreaPolicy;
use crate::projection::Indexed;
use crate::session::Session;
use crate::stop::record::StopRecord;
use crate::task::{Attempt, Phase, TaskIntake, TaskState};
use crate::time::Utc;

impl Indexed<TaskState> for FleetProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&TaskState>) {
        let Ok(task_id) = TaskId::parse(id) else { return };
        let (task, intake) = (view.task(&task_id), view.intake(&task_id));
        let (before, now) = (deadline(old, intake), deadline(task, intake));
        move_deadline(view, &task_id, before, now);
        if let Some(task) = view.tasks.get(id).map(|t| &t.row) {
            view.dirty.extend(task.robot_id.clone());
            view.unasked.remove(&task_id);
            if task.phase.is_terminal() {
                let end = Ended::from(task);
                note_end(view, &task_id, end);
            } else {
                note_open(view, &task_id);
            }
        }
        put_in_queue(view, &task_id);
    }
}

impl Indexed<TaskIntake> for FleetProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&TaskIntake>) {
        let spec = view.intakes.get(id).map(|i| &i.row.spec);
        let waits_for: Vec<TaskId> = spec.into_iter().flat_map(|spec| spec.waits_for()).cloned().collect();
        for task_id in waits_for {
            let known = view.tasks.get(task_id.as_str()).map(|t| &t.row);
            if let Some(task) = known.filter(|task| task.phase.is_terminal()) {
                view.ended.insert(task_id.clone(), task.into());
            } else if known.is_none() && !view.ended.contains_key(&task_id) {
                view.unasked.insert(task_id.clone());
            }
            *view.dependants.entry(task_id).or_default() += 1;
        }
        old.into_iter().for_each(|old| view.waits_no_more(old));
        if let Ok(task_id) = TaskId::parse(id) {
            let (task, intake) = (view.task(&task_id), view.intake(&task_id));
            let (before, now) = (deadline(task, old), deadline(task, intake));
            move_deadline(view, &task_id, before, now);
            put_in_queue(view, &task_id);
        }
    }
}

impl Indexed<AreaPolicy> for FleetProjection {
    /// Whoever put it, this process or another: every robot hears of it.
    fn changed(view: &mut Self, _id: &str, _old: Option<&AreaPolicy>) {
        let robots: Vec<RobotId> = view.sessions.values().map(|s| s.row.robot_id.clone()).collect();
        view.policy_dirty.extend(robots);
    }
}

impl Indexed<Incident> for FleetProjection {
    /// A person has looked: what was put aside is tried again.
    fn changed(view: &mut Self, id: &str, old: Option<&Incident>) {
        let new = view.incidents.get(id).map(|i| &i.row);
        match view.broken_steps.put_incident(old, new) {
            Some(StepChange::Broke(at)) => bar_tasks(view, &at),
            Some(StepChange::Mended(at, closed)) => {
                closed.iter().for_each(|closed| view.steps_failed.forget_failures(&at, *closed));
                view.steps_failed.probes.remove(&at);
                let barred: Vec<TaskId> = view.queue.barred(&at).cloned().collect();
                barred.iter().for_each(|task_id| put_in_queue(view, task_id));
            }
            None => {}
        }
        if let Some(closed) = view.incidents.get(id).map(|i| &i.row).filter(|i| i.closed.is_some()) {
            view.refused.incident_closed(&closed.reason);
        }
    }
}

impl Indexed<StopRecord> for FleetProjection {
    fn changed(view: &mut Self, id: &str, _old: Option<&StopRecord>) {
        view.closed_places.take();
        view.stops_changed = true;
        match view.stops.get(id).is_some_and(|record| record.row.is_effective()) {
            true => view.engaged.insert(id.to_owned()),
            false => view.engaged.remove(id),
        };
    }
}

impl Indexed<Drain> for FleetProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&Drain>) {
        match (view.drains.get(id).map(|d| d.row.robot_id.clone()), old) {
            (Some(robot_id), _) => {
                view.drains_of.entry(robot_id).or_default().insert(id.to_owned());
            }
            (None, Some(old)) => {
                if let Some(ids) = view.drains_of.get_mut(&old.robot_id) {
                    ids.remove(id);
                }
            }
            (None, None) => {}
        }
    }
}

impl Indexed<Attempt> for FleetProjection {
    fn changed(view: &mut Self, id: &str, _old: Option<&Attempt>) {
        if let Some(attempt) = view.attempts.get(id) {
            view.dirty.insert(attempt.row.robot_id.clone());
        }
    }
}

impl Indexed<HoldToken> for FleetProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&HoldToken>) {
        let robot = view.holds.get(id).map(|h| h.row.robot_id.clone()).or_else(|| old.map(|h| h.robot_id.clone()));
        view.dirty.extend(robot);
    }
}

impl Indexed<RobotAuthority> for FleetProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&RobotAuthority>) {
        let new = view.authority.get(id).map(|a| &a.row);
        let Some(robot_id) = new.or(old).map(|authority| authority.robot_id.clone()) else { return };
        if new.is_some_and(|authority| matches!(authority.holder, RobotHolder::Attempt(_))) {
            view.at_work.insert(robot_id.clone());
        } else {
            view.at_work.remove(&robot_id);
        }
        view.dirty.extend(new.is_some().then_some(robot_id));
    }
}

impl Indexed<RobotControl> for FleetProjection {
    /// A person's word about its load goes to the robot, whichever process took it.
    fn changed(view: &mut Self, id: &str, old: Option<&RobotControl>) {
        let word = |control: &RobotControl| control.load_settled.clone();
        let new = view.control.get(id).map(|c| &c.row);
        if new.and_then(word) != old.and_then(word) {
            view.dirty.extend(new.map(|control| control.robot_id.clone()));
        }
    }
}

impl Indexed<RobotCounter> for FleetProjection {
    /// The rates of a robot's energy follow from all that was counted of it.
    fn changed(view: &mut Self, id: &str, old: Option<&RobotCounter>) {
        let new = view.counters.get(id).map(|c| &c.row);
        let Some(robot_id) = new.or(old).map(|counter| counter.robot_id.clone()) else { return };
        let newest = view.counters_of(&robot_id).max_by_key(|counter| counter.counted);
        let energy = newest.map(|newest| {
            fit_robot(&newest.energy_sums, view.counters_of(&robot_id).map(|counter| &counter.energy_sums))
        });
        match energy.filter(|energy| energy.attempts > 0) {
            Some(energy) => view.energy.insert(robot_id, energy),
            None => view.energy.remove(&robot_id),
        };
    }
}

impl Indexed<Session> for FleetProjection {
    fn changed(view: &mut Self, id: &str, _old: Option<&Session>) {
        view.dirty.extend(view.sessions.get(id).map(|s| s.row.robot_id.clone()));
    }
}

impl Indexed<PlaceBlock> for FleetProjection {
    fn changed(view: &mut Self, _id: &str, _old: Option<&PlaceBlock>) {
        view.closed_places.take();
    }
}

impl Indexed<Place> for FleetProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&Place>) {
        let is_shut = |place: Option<&Place>| place.is_some_and(|place| place.quarantine.is_some());
        if is_shut(old) != is_shut(view.places.get(id).map(|place| &place.row)) {
            view.closed_places.take();
        }
        for robot in old.into_iter().flat_map(|p| &p.holders).map(|h| &h.robot_id) {
            view.dirty.insert(robot.clone());
            if let Some(places) = view.held_places.get_mut(robot) {
                places.remove(id);
            }
        }
        let now: Vec<RobotId> =
            view.places.get(id).into_iter().flat_map(|p| &p.row.holders).map(|h| h.robot_id.clone()).collect();
        for robot in now {
            view.held_places.entry(robot.clone()).or_default().insert(id.to_owned());
            view.dirty.insert(robot);
        }
    }
}

/// When a task that has not ended is worthless, as far as its rows are here; UTC.
fn deadline(task: Option<&TaskState>, intake: Option<&TaskIntake>) -> Option<Utc> {
    match (task, intake) {
        (Some(task), _) if task.phase.is_terminal() => None,
        (Some(task), Some(intake)) => task.deadline(intake),
        (None, Some(intake)) => intake.spec.deadline,
        (_, None) => None,
    }
}

/// A row of a task changed, and its deadline with it, if so.
fn move_deadline(view: &mut FleetProjection, task_id: &TaskId, old: Option<Utc>, new: Option<Utc>) {
    if old == new {
        return;
    }
    if let Some(at) = old {
        view.deadlines.remove(&(at, task_id.clone()));
    }
    view.deadlines.extend(new.map(|at| (at, task_id.clone())));
}

/// Puts a task where its rows say that it stands: out of the queue, if it waits for no robot.
pub(in crate::fleet) fn put_in_queue(view: &mut FleetProjection, task_id: &TaskId) {
    let rows = view.task(task_id).filter(|task| task.phase == Phase::Queued).zip(view.intake(task_id));
    let (mut is_ready, was_ready) = (false, view.queue.rank(task_id).is_some());
    let wait = rows.map(|(task, intake)| {
        let wait = match view.wait_of(task, intake, view.queue.now) {
            Wait::Turn(rank) if view.bugs.nobody_is_promoted() => Wait::Turn(rank.unpromoted(task.priority(intake))),
            wait => wait,
        };
        is_ready = matches!(wait, Wait::Turn(_) | Wait::Step(..) | Wait::Mark);
        (wait, task.queued_since)
    });
    if was_ready && !matches!(wait, Some((Wait::Turn(_), _))) {
        let is_given = view.task(task_id).is_some_and(|task| task.phase == Phase::Assigned);
        match is_given {
            true => view.starts.note_start(task_id, view.queue.now),
            false => view.starts.forget_task(task_id),
        }
    }
    view.queue.set_wait(task_id, wait);
    let rows = view.tasks.get(task_id.as_str()).map(|t| &t.row).zip(view.intakes.get(task_id.as_str()).map(|i| &i.row));
    view.same_key.put_task(task_id, rows.filter(|_| is_ready), &view.site);
    if view.ready.put_task(task_id, view.queue.rank(task_id), rows, |goal| view.site.find(goal)) {
        view.queue.show_again(task_id);
    }
}

/// A step is broken: a task that has it still before it is ready no more.
fn bar_tasks(view: &mut FleetProjection, at: &StepAt) {
    let leads_there = |task_id: &&TaskId| {
        let spec = view.intake(task_id).map(|intake| &intake.spec);
        spec.is_some_and(|spec| spec.goals(0).any(|goal| *goal == at.waypoint))
    };
    let ready: Vec<TaskId> = view.queue.ready().filter(leads_there).cloned().collect();
    ready.iter().for_each(|task_id| put_in_queue(view, task_id));
}

/// A task has ended: those that depend on it, if there are any, wait for the next thing, or for nothing more.
pub(in crate::fleet) fn note_end(view: &mut FleetProjection, task_id: &TaskId, end: Ended) {
    if !view.dependants.contains_key(task_id) {
        return;
    }
    view.ended.insert(task_id.clone(), end);
    for dependent in view.queue.dependents.get(task_id).cloned().unwrap_or_default() {
        put_in_queue(view, &dependent);
    }
}

/// A task that was taken for ended goes on: those that depend on it wait for it again.
pub(in crate::fleet) fn note_open(view: &mut FleetProjection, task_id: &TaskId) {
    if view.ended.remove(task_id).is_none() {
        return;
    }
    let intakes = view.intakes.values().map(|intake| &intake.row);
    let dependents: Vec<TaskId> =
        intakes.filter(|intake| intake.spec.waits_for().any(|id| id == task_id)).map(|i| i.task_id.clone()).collect();
    for dependent in dependents {
        put_in_queue(view, &dependent);
    }
}

/// Time has passed: whose time has come is ready, and who waited for long is promoted.
pub(in crate::fleet) fn advance(view: &mut FleetProjection, now: Utc) {
    view.queue.now = now;
    let due = [&view.queue.due, &view.queue.checks]
        .into_iter()
        .flat_map(|tasks| tasks.iter().take_while(|(at, _)| *at <= now).take(TASKS_PER_TURN));
    for task_id in due.map(|(_, id)| id.clone()).collect::<Vec<_>>() {
        put_in_queue(view, &task_id);
    }
}

impl FleetProjection {
    /// What a task that wants a robot waits for first.
    pub fn wait_of(&self, task: &TaskState, intake: &TaskIntake, now: Utc) -> Wait {
        match Wait::of_task(task, intake, &self.ended, now) {
            Wait::Turn(rank) => match self.broken_steps.bars(task, intake, &self.steps_failed) {
                Some(at) => Wait::Step(at, rank),
                None => Wait::Turn(rank),
            },
            wait => wait,
        }
    }

    /// A task is over, or gone: nothing is asked any more of those that it waited for alone.
    pub(super) fn waits_no_more(&mut self, intake: &TaskIntake) {
        for task_id in intake.spec.waits_for() {
            let Some(left) = self.dependants.get_mut(task_id) else { continue };
            *left -= 1;
            if *left == 0 {
                self.dependants.remove(task_id);
                self.ended.remove(task_id);
                self.unasked.remove(task_id);
            }
        }
    }
}
