//! Which pairs of robots and tasks a plan weighs: of each robot the nearest tasks, and of the first tasks in the queue all
//! robots, or of each task the nearest robots where there are many.
//!
//! Invariant: each pair could be made as far as robot and task alone say; what else stands against it is asked of the
//! few that are chosen.

use super::cost::{self, Urgency};
use super::robots::{Free, ROBOTS_MAX, Robot};
use crate::fleet::assignment::filters;
use crate::fleet::decision::slice::Slice;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::queue::Rank;
use crate::fleet::projection::ready::Need;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::eligibility;
use crate::ids::TaskId;
use crate::planner_policy::PlannerPolicy;
use crate::site::WaypointIx;
use crate::site::route::DistanceField;
use crate::task::TaskIntake;
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

/// What a plan is made of.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    /// Newest heartbeats.
    pub board: &'a Board,
    /// The clocks.
    pub now: Now,
    /// What each thing weighs.
    pub policy: &'a PlannerPolicy,
    /// Robots, by id.
    pub robots: &'a [Robot],
}

/// Ready tasks of one need that begin at one goal.
struct Spot<'a> {
    field: Option<Arc<DistanceField>>,
    ranks: &'a BTreeSet<Rank>,
    need: &'a Arc<Need>,
}

/// Finds pairs.
pub struct Finder<'a> {
    view: &'a FleetProjection,
    scene: Scene<'a>,
    spots: Vec<Spot<'a>>,
    /// Robots that have what is needed, by need.
    able: BTreeMap<&'a Arc<Need>, Vec<bool>>,
    found: Choices,
}

impl<'a> Finder<'a> {
    /// Nothing found yet.
    pub fn new(view: &'a FleetProjection, scene: Scene<'a>) -> Self {
        Self { view, scene, spots: Vec::new(), able: BTreeMap::new(), found: Choices::default() }
    }

    /// All pairs that were found.
    pub fn into_choices(self) -> Choices {
        self.found
    }

    /// Finds the nearest tasks of a robot. False: there is none that it could do.
    pub fn find_tasks(&mut self, robot: usize, slice: &mut Slice) -> bool {
        let view = self.view;
        if self.spots.is_empty() {
            let goals = view.ready.by_need().flat_map(|(need, goals)| goals.iter().map(move |goal| (need, goal)));
            let spot = |(need, (goal, ranks)): (&'a Arc<Need>, (&Option<WaypointIx>, &'a BTreeSet<Rank>))| Spot {
                field: goal.map(|goal| view.router.field(goal)),
                ranks,
                need,
            };
            self.spots = goals.map(spot).collect();
        }
        let bound = view.ready.bound_to(&self.scene.robots[robot].robot_id).take(NEAREST);
        let mut found = bound.filter(|rank| self.add(robot, &rank.task_id)).count();
        let mut nearest = Vec::new();
        for nth in 0..self.spots.len() {
            let Spot { field, ranks, need } = &self.spots[nth];
            let way_mm = way_mm(field.as_deref(), &self.scene.robots[robot]);
            if let (Some(way_mm), Some(first), need) = (way_mm, ranks.first(), *need)
                && self.is_able(robot, need, first)
            {
                nearest.push(Reverse((way_mm, nth)));
            }
        }
        let mut nearest = BinaryHeap::from(nearest);
        let mut looks = 0;
        'nearest: while let Some(Reverse((_, nth))) = nearest.pop() {
            for rank in self.spots[nth].ranks {
                if found >= NEAREST || looks >= LOOKS_PER_ROBOT {
                    break 'nearest;
                }
                looks += 1;
                found += usize::from(self.add(robot, &rank.task_id));
            }
        }
        slice.count_looks(looks / NEAREST);
        found > 0
    }

    /// Finds robots for a task. False: there is none that could do it.
    pub fn find_robots(&mut self, task_id: &TaskId, slice: &mut Slice) -> bool {
        let view = self.view;
        let Some(task) = view.ready.get(task_id) else { return false };
        let field = task.goal.map(|goal| view.router.field(goal));
        let mut near: Vec<Reverse<(u64, usize)>> = Vec::new();
        for (nth, robot) in self.scene.robots.iter().enumerate() {
            let is_for = task.bound_to.as_ref().is_none_or(|bound| *bound == robot.robot_id);
            if is_for
                && self.is_able(nth, &task.need, &task.rank)
                && let Some(way_mm) = way_mm(field.as_deref(), robot)
            {
                near.push(Reverse((way_mm + robot.ready_ms, nth)));
            }
        }
        let most = if self.scene.robots.len() > ROBOTS_MAX { NEAREST } else { ROBOTS_OF_FIRST };
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
        let (view, Scene { board, now, policy, robots }) = (self.view, self.scene);
        let known = self.found.known.get(task_id).copied();
        if known.is_some_and(|known| self.found.seen.contains(&(robot, known))) {
            return true;
        }
        let Some((task, intake)) = view.task(task_id).zip(view.intake(task_id)) else { return false };
        let Some(ready) = view.ready.get(task_id) else { return false };
        let Robot { robot_id, free, .. } = &robots[robot];
        let is_fit = match free {
            Free::Now => filters::pair(view, board, robot_id, task, intake, &now).is_ok(),
            Free::Soon if view.meant.is_over(task_id, now.site) => false,
            Free::AfterErrand | Free::Soon => {
                let session = view.sessions.get(robot_id.as_str());
                session.is_some_and(|s| eligibility::fits(view, &s.row, task, intake).is_ok())
            }
        };
        let field = ready.goal.map(|goal| view.router.field(goal));
        let Some(way_mm) = way_mm(field.as_deref(), &robots[robot]).filter(|_| is_fit) else { return false };
        if known.is_none() && filters::task(view, board, task, intake, &now).is_err() {
            return false;
        }
        let known = known.unwrap_or_else(|| {
            let Rank { class, since, .. } = ready.rank;
            self.found.urgencies.push(Urgency { class, since, deadline: intake.spec.deadline });
            self.found.tasks.push(task_id.clone());
            self.found.known.insert(task_id.clone(), self.found.tasks.len() - 1);
            self.found.tasks.len() - 1
        });
        self.found.seen.insert((robot, known));
        let pair = cost::Pair {
            way_mm,
            has_failed: task.failed_robots.contains(robot_id),
            is_meant: view.meant.get(task_id).is_some_and(|meant| meant.robot_id == *robot_id),
        };
        let cost = cost::of_pair(policy, &now, &robots[robot], &self.found.urgencies[known], &pair);
        self.found.pairs.push(Choice { robot, task: known, cost });
        true
    }

    /// Whether a robot has what a task needs, as it has for all tasks of the need.
    fn is_able(&mut self, robot: usize, need: &'a Arc<Need>, of_task: &Rank) -> bool {
        let (view, robots) = (self.view, self.scene.robots);
        let able = self.able.entry(need).or_insert_with(|| {
            let intake = view.intake(&of_task.task_id);
            robots.iter().map(|robot| intake.is_some_and(|intake| is_able(view, robot, intake))).collect()
        });
        able[robot]
    }
}

fn is_able(view: &FleetProjection, robot: &Robot, intake: &TaskIntake) -> bool {
    view.sessions.get(robot.robot_id.as_str()).is_some_and(|s| eligibility::able(view, &s.row, intake).is_ok())
}

/// Millimetres from where the robot is free to a goal; 0 without a goal. None: no way leads there.
fn way_mm(field: Option<&DistanceField>, robot: &Robot) -> Option<u64> {
    field.map_or(Some(0), |field| field.distance_mm(robot.at))
}
