//! What is due by time alone: timers, deadlines, and robots that were heard or fell silent. Gathered each period, done in slices.
//!
//! Invariant: what waits here is looked at again right before it is done: it may have passed meanwhile.

use super::repair;
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::memory::Agenda;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::timers;
use crate::fleet::tasks::transitions::{News, apply_event};
use crate::fleet::traffic::desired;
use crate::ids::RobotId;
use crate::rows::Record;
use crate::task::{Event, Phase};
use crate::time::Now;
use std::collections::BTreeSet;

/// Gathers what is due. Robots that wait from the period before still do.
pub(in crate::fleet) fn gather(view: &mut FleetProjection, now: Now, board: &Board) {
    let (timers, late) = timers::due(view, &now);
    let suspended = view.tasks.values().filter(|t| t.row.phase == Phase::Suspended).map(|t| t.row.task_id.clone());
    let suspended = suspended.collect();
    let mut heard = repair::find_due(view, board, &now);
    heard.append(&mut view.agenda.heard);
    view.agenda = Agenda { timers, late, suspended, heard };
    let worn = desired::find_expiring_permissions(view, board);
    view.dirty.extend(worn);
}

/// Does what a slice holds of what is due; gives back the robots that were compared with the rows.
pub(in crate::fleet) fn carry_out(
    view: &mut FleetProjection,
    now: Now,
    board: &Board,
    plan: &mut Plan,
) -> BTreeSet<RobotId> {
    let mut compared = BTreeSet::new();
    while let Some(robot_id) = view.agenda.heard.first().filter(|_| !plan.is_cut()).cloned() {
        view.agenda.heard.remove(&robot_id);
        plan.slice.count_looks(1);
        repair::repair_robot(view, now, &robot_id, board, plan);
        compared.insert(robot_id);
    }
    plan.slice.renew();
    while let Some(timer) = view.agenda.timers.pop_if(|_| !plan.is_cut()) {
        if view.timers.get(timer.id().as_str()).is_some_and(|stands| stands.row == timer) {
            plan.decide(view, now, "fleet", |tx| timers::fire(tx, &timer, board));
        }
    }
    while let Some(task_id) = view.agenda.late.pop_if(|_| !plan.is_cut()) {
        if timers::is_late(view, &task_id, &now) {
            plan.decide(view, now, "fleet", |tx| timers::deadline(tx, &task_id));
        }
    }
    while let Some(task_id) = view.agenda.suspended.pop_if(|_| !plan.is_cut()) {
        plan.decide(view, now, "fleet", |tx| {
            apply_event(tx, &task_id, News::from_event(Event::RetryDue, None));
        });
    }
    compared
}
