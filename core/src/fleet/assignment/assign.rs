//! Gives ready tasks to robots, as the planner's policy says.
//!
//! Called once a cycle. Where no task is ready nobody chooses: then idle robots are looked at for errands alone.

use super::candidates::Candidate;
use super::{nearest, rolling};
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::chosen::Chosen;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::planner_policy::AssignmentPolicy;
use crate::time::Now;
use std::collections::BTreeSet;

/// Gives ready tasks to robots, each assignment an item of its own, and gives back who is still idle: of those that were `heard` if no task is
/// ready.
pub fn plan(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Vec<Candidate> {
    let policy = view.planner();
    match policy.policy {
        AssignmentPolicy::Rolling if !view.queue.is_empty() => {
            let idle = rolling::plan(view, board, now, heard, &policy, plan);
            rolling::preemption::plan(view, board, now, &policy, plan);
            idle
        }
        AssignmentPolicy::Rolling | AssignmentPolicy::FifoNearest => {
            view.meant.put_plan(Vec::new(), now.site);
            if policy.policy == AssignmentPolicy::FifoNearest {
                view.chosen = Chosen::default();
            }
            nearest::plan(view, board, now, heard, plan)
        }
    }
}
