//! Robots that work may be given to, taken one after the other, the nearest first.
//!
//! Called by `assign` for tasks and by `errands` for the robots that are left. Invariant: who is taken depends on distance, tasks so far and id,
//! never on the order in which robots were met.

use super::demand::Demand;
use super::filters;
use crate::fleet::decision::slice::Slice;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::traffic::routing;
use crate::ids::RobotId;
use crate::site::WaypointIx;
use crate::task::{TaskIntake, TaskState};
use crate::time::Now;
use std::collections::BTreeSet;

/// A robot that a task may go to.
pub struct Candidate {
    /// The robot that a task may go to.
    pub robot_id: RobotId,
    /// Where it stands.
    pub at: WaypointIx,
    /// Tasks that it was given so far.
    pub tasks: u64,
}

/// Robots that tasks are given to one after the other.
#[derive(Default)]
pub struct Pool {
    /// By id.
    all: Vec<Candidate>,
    /// Who is left, as indices into `all` with what the choice looks at; in any order.
    left: Vec<(usize, WaypointIx, u64)>,
}

impl Pool {
    /// Of these robots, by id, those on the board for which `can` holds.
    pub fn on_board<'a>(
        view: &FleetProjection,
        board: &Board,
        robots: impl IntoIterator<Item = &'a RobotId>,
        can: impl Fn(&RobotId) -> bool,
    ) -> Self {
        let all: Vec<_> = robots
            .into_iter()
            .filter(|id| can(id))
            .filter_map(|id| {
                let at = routing::find(view, board.get(id)?.report.vitals.waypoint.as_ref())?;
                let tasks = view.control.get(id.as_str()).map_or(0, |c| c.row.tasks);
                Some(Candidate { robot_id: id.clone(), at, tasks })
            })
            .collect();
        Self { left: all.iter().enumerate().map(|(ix, c)| (ix, c.at, c.tasks)).collect(), all }
    }

    /// Whether nobody is left.
    pub fn is_empty(&self) -> bool {
        self.left.is_empty()
    }

    /// Who is left, in any order.
    pub fn robots(&self) -> impl Iterator<Item = &RobotId> {
        self.left.iter().map(|(ix, ..)| &self.all[*ix].robot_id)
    }

    /// Leaves out all but these.
    pub fn retain(&mut self, robots: &BTreeSet<RobotId>) {
        let all = &self.all;
        self.left.retain(|(ix, ..)| robots.contains(&all[*ix].robot_id));
    }

    /// Takes the nearest that passes every filter: another than one that failed the task, if there is one; then by distance, tasks so
    /// far, id. Each robot that the filters look at is a look of the slice.
    pub fn take_nearest(
        &mut self,
        view: &FleetProjection,
        board: &Board,
        task: &TaskState,
        intake: &TaskIntake,
        now: &Now,
        slice: &mut Slice,
    ) -> Option<RobotId> {
        if self.left.is_empty() {
            return None;
        }
        let field = first_goal(view, task, intake).map(|g| view.router.field(g));
        let failed = |ix: usize| !task.failed_robots.is_empty() && task.failed_robots.contains(&self.all[ix].robot_id);
        let cost = |nth: usize| {
            let (ix, at, tasks) = self.left[nth];
            let distance = field.as_ref().map_or(Some(0), |f| f.distance_mm(at))?;
            Some((failed(ix), distance, tasks, ix))
        };
        let demand = Demand::new(view, task, intake);
        let mut passes = |nth: &usize| {
            slice.count_looks(1);
            filters::pair(view, board, &self.all[self.left[*nth].0].robot_id, &demand, now).is_ok()
        };
        // Nearly always the first one passes; only else are all put in order.
        let mut first = None;
        for nth in 0..self.left.len() {
            if let Some(cost) = cost(nth).filter(|c| first.is_none_or(|(best, _)| *c < best)) {
                first = Some((cost, nth));
            }
        }
        let nth = first.map(|(_, nth)| nth).filter(&mut passes).or_else(|| {
            let mut by_cost: Vec<_> = (0..self.left.len()).filter_map(|nth| Some((cost(nth)?, nth))).collect();
            by_cost.sort_unstable();
            by_cost.into_iter().map(|(_, nth)| nth).find(&mut passes)
        })?;
        let (ix, ..) = self.left.swap_remove(nth);
        Some(self.all[ix].robot_id.clone())
    }

    /// Who was not taken, by id.
    pub fn rest(self) -> impl Iterator<Item = Candidate> {
        let left: BTreeSet<usize> = self.left.into_iter().map(|(ix, ..)| ix).collect();
        self.all.into_iter().enumerate().filter(move |(ix, _)| left.contains(ix)).map(|(_, c)| c)
    }
}

/// First goal of what is left of the task.
fn first_goal(view: &FleetProjection, task: &TaskState, intake: &TaskIntake) -> Option<WaypointIx> {
    let from = crate::step::from_step(&intake.spec.steps, task.next_step);
    intake.spec.next_goal(from as usize).and_then(|g| view.site.find(g))
}
