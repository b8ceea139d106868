//! Which pairs of robots and tasks a plan weighs: of each robot the nearest tasks, and of the first tasks in the queue all
//! robots, or of each task the nearest robots where there are many.
//!
//! Invariant: each pair could be made as far as robot and task alone say; what else stands against it is asked of the
//! few that are chosen.

use super::cost::{self, Urgency};
use super::robots::{Free, Robot};
use crate::fleet::assignment::filters;
use crate::fleet::decision::slice::Slice;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::ready::{ByGoal, Need, ReadyTask};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::eligibility;
use crate::ids::TaskId;
use crate::planner_policy::PlannerPolicy;
use crate::site::WaypointIx;
use crate::site::route::DistanceField;
use crate::time::Now;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::sync::Arc;

/// Nearest tasks of a robot, or nearest robots of a task, that are weighed.
const NEAREST: usize = 8;
/// Robots that are weighed for one of the first tasks.
const ROBOTS_OF_FIRST: usize = 32;
/// Tasks that are looked at for one robot.
const LOOKS_PER_ROBOT: usize = 256;

/// A pair that may be made.
#[derive(Clone, Copy, Debug)]
pub struct Choice {
    /// Index of the robot.
    pub robot: usize,
    /// Index of the task.
    pub task: usize,
    /// What it costs, before the worth of its class.
    pub cost: i64,
}

/// Pairs that may be made, with the tasks that they are about.
#[derive(Default)]
pub struct Choices {
    /// Tasks, each once.
    pub tasks: Vec<TaskId>,
    /// What is known of each.
    pub urgencies: Vec<Urgency>,
    /// Pairs, each once.
    pub pairs: Vec<Choice>,
    known: BTreeMap<TaskId, usize>,
    seen: BTreeSet<(usize, usize)>,
}

/// What a plan knows while it finds pairs.
pub struct Finder<'a> {
    /// The projection.
    pub view: &'a FleetProjection,
    /// Newest heartbeats.
    pub board: &'a Board,
    /// The clocks.
    pub now: Now,
    /// What each thing weighs.
    pub policy: &'a PlannerPolicy,
    /// Robots, by id.
    pub robots: &'a [Robot],
    fields: BTreeMap<WaypointIx, Arc<DistanceField>>,
    /// Robots that have what is needed, by need.
    able: BTreeMap<Arc<Need>, Vec<bool>>,
    found: Choices,
}

impl<'a> Finder<'a> {
    /// Nothing found yet.
    pub fn new(
        view: &'a FleetProjection,
        board: &'a Board,
        now: Now,
        policy: &'a PlannerPolicy,
        robots: &'a [Robot],
    ) -> Self {
        let (fields, able) = (BTreeMap::new(), BTreeMap::new());
        Self { view, board, now, policy, robots, fields, able, found: Choices::default() }
    }

    /// All pairs that were found.
    pub fn into_choices(self) -> Choices {
        self.found
    }

    /// Finds the nearest tasks of a robot. False: there is none that it could do.
    pub fn find_tasks(&mut self, robot: usize, slice: &mut Slice) -> bool {
        let view = self.view;
        let bound = view.ready.bound_to(&self.robots[robot].robot_id).take(NEAREST);
        let mut found = bound.filter(|rank| self.add(robot, &rank.task_id)).count();
        let mut goals: Vec<(u64, &ByGoal, Option<WaypointIx>)> = Vec::new();
        for (need, by_goal) in view.ready.by_need() {
            if !self.is_able(robot, need, by_goal) {
                continue;
            }
            for goal in by_goal.keys() {
                goals.extend(self.way_mm(robot, *goal).map(|way_mm| (way_mm, by_goal, *goal)));
            }
        }
        let mut nearest: BinaryHeap<_> =
            goals.iter().enumerate().map(|(nth, (way_mm, ..))| Reverse((*way_mm, nth))).collect();
        let mut looks = 0;
        while let Some(Reverse((_, nth))) = nearest.pop() {
            let (_, by_goal, goal) = goals[nth];
            for rank in by_goal.get(&goal).into_iter().flatten() {
                looks += 1;
                found += usize::from(self.add(robot, &rank.task_id));
                if found >= NEAREST || looks >= LOOKS_PER_ROBOT {
                    slice.count_looks(looks / NEAREST);
                    return found > 0;
                }
            }
        }
        found > 0
    }

    /// Finds robots for a task. False: there is none that could do it.
    pub fn find_robots(&mut self, task_id: &TaskId, slice: &mut Slice) -> bool {
        let view = self.view;
        let Some(task) = view.ready.get(task_id) else { return false };
        let mut near: Vec<Reverse<(u64, usize)>> = Vec::new();
        for robot in 0..self.robots.len() {
            let is_for = task.bound_to.as_ref().is_none_or(|bound| *bound == self.robots[robot].robot_id);
            if is_for
                && self.is_able_for(robot, task)
                && let Some(way_mm) = self.way_mm(robot, task.goal)
            {
                near.push(Reverse((way_mm + self.robots[robot].ready_ms, robot)));
            }
        }
        let most = if self.robots.len() > super::ROBOTS_MAX { NEAREST } else { ROBOTS_OF_FIRST };
        let (mut near, mut found, mut looks) = (BinaryHeap::from(near), 0, 0);
        while let Some(Reverse((_, robot))) = near.pop().filter(|_| found < most && looks < 4 * most) {
            looks += 1;
            found += usize::from(self.add(robot, task_id));
        }
        slice.count_looks(1 + looks / NEAREST);
        found > 0
    }

    /// Adds a pair unless something stands against it. Of a robot that is free everything is asked.
    pub fn add(&mut self, robot: usize, task_id: &TaskId) -> bool {
        let view = self.view;
        let Some((task, intake)) = view.task(task_id).zip(view.intake(task_id)) else { return false };
        let Some(ready) = view.ready.get(task_id) else { return false };
        let known = self.found.known.get(task_id).copied();
        if known.is_some_and(|known| self.found.seen.contains(&(robot, known))) {
            return true;
        }
        let Robot { robot_id, free, .. } = &self.robots[robot];
        let is_fit = match free {
            Free::Now => filters::pair(view, self.board, robot_id, task, intake, &self.now).is_ok(),
            Free::Soon if view.meant.is_over(task_id, self.now.site) => false,
            Free::AfterErrand | Free::Soon => view
                .sessions
                .get(robot_id.as_str())
                .is_some_and(|s| eligibility::fits(view, &s.row, task, intake).is_ok()),
        };
        let Some(way_mm) = self.way_mm(robot, ready.goal).filter(|_| is_fit) else { return false };
        if known.is_none() && filters::task(view, self.board, task, intake, &self.now).is_err() {
            return false;
        }
        let known = known.unwrap_or_else(|| {
            let urgency = Urgency { class: ready.rank.class, since: ready.rank.since, deadline: intake.spec.deadline };
            self.found.urgencies.push(urgency);
            self.found.tasks.push(task_id.clone());
            self.found.known.insert(task_id.clone(), self.found.tasks.len() - 1);
            self.found.tasks.len() - 1
        });
        self.found.seen.insert((robot, known));
        let pair = cost::Pair {
            way_mm,
            has_failed: task.failed_robots.contains(robot_id),
            is_meant: view.meant.robot_of(task_id) == Some(robot_id),
        };
        let cost = cost::of_pair(self.policy, &self.now, &self.robots[robot], &self.found.urgencies[known], &pair);
        self.found.pairs.push(Choice { robot, task: known, cost });
        true
    }

    fn is_able_for(&mut self, robot: usize, task: &ReadyTask) -> bool {
        let view = self.view;
        let robots = self.robots;
        let able = self.able.entry(task.need.clone()).or_insert_with(|| {
            let intake = view.intake(&task.rank.task_id);
            robots.iter().map(|robot| intake.is_some_and(|intake| is_able(view, robot, intake))).collect()
        });
        able[robot]
    }

    fn is_able(&mut self, robot: usize, need: &Arc<Need>, by_goal: &ByGoal) -> bool {
        if let Some(able) = self.able.get(need) {
            return able[robot];
        }
        let first = by_goal.values().find_map(|ranks| ranks.first());
        let first = first.and_then(|rank| self.view.ready.get(&rank.task_id));
        first.is_some_and(|first| self.is_able_for(robot, first))
    }

    /// Millimetres from where the robot is free to a goal; 0 without a goal. None: no way leads there.
    fn way_mm(&mut self, robot: usize, goal: Option<WaypointIx>) -> Option<u64> {
        let Some(goal) = goal else { return Some(0) };
        let field = self.fields.entry(goal).or_insert_with(|| self.view.router.field(goal));
        field.distance_mm(self.robots[robot].at)
    }
}

fn is_able(view: &FleetProjection, robot: &Robot, intake: &crate::task::TaskIntake) -> bool {
    view.sessions.get(robot.robot_id.as_str()).is_some_and(|s| eligibility::able(view, &s.row, intake).is_ok())
}
