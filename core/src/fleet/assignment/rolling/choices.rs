//! Which pairs of robots and tasks a plan weighs: of each robot the nearest tasks, and of the first tasks in the queue all
//! robots, or of each task the nearest robots where there are many.
//!
//! Invariant: each pair could be made as far as robot and task alone say; what else stands against it is asked of the
//! few that are chosen.

use super::cost;
use super::robots::{ROBOTS_MAX, Robot};
use crate::fleet::assignment::demand::Demand;
use crate::fleet::assignment::filters;
use crate::fleet::decision::slice::Slice;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::plans::{Free, Weighed, WeighedPair, WeighedRobot, WeighedTask};
use crate::fleet::projection::queue::Rank;
use crate::fleet::projection::ready::{Need, ReadyTask};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::eligibility;
use crate::fleet::traffic::routing;
use crate::ids::{RobotId, TaskId};
use crate::site::WaypointIx;
use crate::time::Now;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::rc::Rc;
use std::sync::Arc;

/// Nearest tasks of a robot, or nearest robots of a task, that are weighed.
const NEAREST: usize = 8;
/// Robots that are weighed for one of the first tasks.
const ROBOTS_OF_FIRST: usize = 32;
/// Tasks that are looked at for one robot.
const LOOKS_PER_ROBOT: usize = 256;

/// What a plan is made of.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    /// Newest heartbeats.
    pub board: &'a Board,
    /// The clocks.
    pub now: Now,
    /// Robots, by id.
    pub robots: &'a [Robot],
}

/// A ready task that was looked at, and that may be given.
struct Looked<'a> {
    demand: Demand<'a>,
    /// Robots that have what it needs.
    able: Rc<[bool]>,
    /// For whom it was meant in the plan before.
    meant_for: Option<&'a RobotId>,
    /// It was meant for one robot or another for too long.
    is_overdue: bool,
    /// Where it stands among the tasks with a pair.
    nth: Option<usize>,
    /// Robots with which it makes a pair.
    robots: BTreeSet<usize>,
}

/// Ready tasks of one need that begin at one goal.
struct Spot<'a> {
    goal: Option<WaypointIx>,
    ranks: &'a BTreeSet<Rank>,
    need: &'a Arc<Need>,
}

/// Robots that have what a need is, by the way to one goal: put in order as far as somebody asks.
#[derive(Default)]
struct Near {
    ahead: BinaryHeap<Reverse<(u64, usize)>>,
    in_order: Vec<usize>,
    /// Tasks that asked so far: each begins with the next robot, so that not all are shown the same.
    asked: usize,
}

impl Near {
    fn get(&mut self, nth: usize) -> Option<usize> {
        while self.in_order.len() <= nth {
            let Reverse((_, robot)) = self.ahead.pop()?;
            self.in_order.push(robot);
        }
        Some(self.in_order[nth])
    }
}

/// Finds pairs.
pub struct Finder<'a> {
    view: &'a FleetProjection,
    scene: Scene<'a>,
    spots: Vec<Spot<'a>>,
    /// Robots that have what is needed, by need.
    able: BTreeMap<&'a Arc<Need>, Rc<[bool]>>,
    near: BTreeMap<(&'a Arc<Need>, Option<WaypointIx>), Near>,
    /// Tasks that were looked at; none: what it is keeps the task from every robot.
    looked: BTreeMap<&'a TaskId, Option<Looked<'a>>>,
    found: Weighed,
}

impl<'a> Finder<'a> {
    /// Nothing found yet.
    pub fn new(view: &'a FleetProjection, scene: Scene<'a>) -> Self {
        let spots = view
            .ready
            .by_need()
            .flat_map(|(need, goals)| goals.iter().map(move |(goal, ranks)| Spot { goal: *goal, ranks, need }));
        Self {
            view,
            scene,
            spots: spots.collect(),
            able: BTreeMap::new(),
            near: BTreeMap::new(),
            looked: BTreeMap::new(),
            found: Weighed::default(),
        }
    }

    /// All pairs that were found, with their robots and tasks.
    pub fn into_weighed(self) -> Weighed {
        let robots = self.scene.robots.iter().map(|robot| robot.weighed.clone()).collect();
        Weighed { robots, ..self.found }
    }

    /// Finds the nearest tasks of a robot. False: among those that were looked at there is none that it could do.
    pub fn find_tasks(&mut self, nth: usize, slice: &mut Slice) -> bool {
        let (view, robot) = (self.view, &self.scene.robots[nth]);
        let (mut found, mut looks) = (0, 0);
        for rank in view.ready.bound_to(robot.id()).take(LOOKS_PER_ROBOT) {
            looks += 1;
            found += usize::from(self.add_pair(nth, &rank.task_id));
            if found >= NEAREST {
                break;
            }
        }
        // The straight line is never longer than the way, which is asked for where it may matter.
        let mut nearest = Vec::new();
        let mut able: Option<(&Arc<Need>, Rc<[bool]>)> = None;
        for at in 0..self.spots.len() {
            let Spot { goal, ranks, need } = self.spots[at];
            if able.as_ref().is_none_or(|(known, _)| !Arc::ptr_eq(known, need))
                && let Some(first) = ranks.first()
            {
                able = Some((need, self.find_able(need, first)));
            }
            if able.as_ref().is_some_and(|(_, able)| able[nth]) {
                nearest.push(Reverse((line_mm(view, robot.at, goal), false, at)));
            }
        }
        let mut nearest = BinaryHeap::from(nearest);
        while let Some(Reverse((_, is_way, at))) = nearest.pop().filter(|_| found < NEAREST && looks < LOOKS_PER_ROBOT)
        {
            let Spot { goal, ranks, .. } = self.spots[at];
            if !is_way {
                let way_mm = way_mm(view, robot.at, goal);
                nearest.extend(way_mm.map(|way_mm| Reverse((way_mm, true, at))));
                continue;
            }
            // Tasks of one spot are much alike: those behind some that it cannot do are left for others.
            let mut missed = 0;
            for rank in ranks {
                looks += 1;
                let is_found = self.add_pair(nth, &rank.task_id);
                (found, missed) = (found + usize::from(is_found), missed + usize::from(!is_found));
                if found >= NEAREST || missed >= NEAREST {
                    break;
                }
            }
        }
        slice.count_looks(looks / NEAREST);
        found > 0
    }

    /// Finds robots for a task. False: there is none that is free, or can be, and could do it.
    pub fn find_robots(&mut self, task_id: &TaskId, slice: &mut Slice) -> bool {
        let (view, robots) = (self.view, self.scene.robots);
        let Some(task) = view.ready.get(task_id) else { return false };
        if let Some(bound_to) = &task.bound_to {
            slice.count_looks(1);
            let nth = robots.binary_search_by(|robot| robot.id().cmp(bound_to));
            return nth.is_ok_and(|nth| self.add_pair(nth, task_id) && robots[nth].weighed.free != Free::Soon);
        }
        let able = self.find_able(&task.need, &task.rank);
        let mut near = self.near.remove(&(&task.need, task.goal)).unwrap_or_else(|| {
            let field = task.goal.map(|goal| view.router.field_around(goal, routing::closed(view)));
            let way_mm = |robot: &Robot| field.as_ref().map_or(Some(0), |field| field.distance_mm(robot.at));
            let able = robots.iter().enumerate().filter(|(nth, _)| able[*nth]);
            let ahead = able.filter_map(|(nth, robot)| Some(Reverse((way_mm(robot)? + robot.weighed.ready_ms, nth))));
            Near { ahead: ahead.collect(), ..Near::default() }
        });
        let most = if robots.len() > ROBOTS_MAX { NEAREST } else { ROBOTS_OF_FIRST };
        let (mut found, mut looks, mut is_free) = (0, 0, false);
        // Behind the last robot come those that were passed over, as far as nobody was found.
        let begin = if robots.len() > ROBOTS_MAX { near.asked } else { 0 };
        for at in (begin..).chain(0..begin) {
            let is_enough = found >= most || (looks >= 4 * most && found > 0);
            let Some(robot) = near.get(at).filter(|_| !is_enough) else { break };
            looks += 1;
            if self.add_pair(robot, task_id) {
                found += 1;
                is_free |= robots[robot].weighed.free != Free::Soon;
            }
        }
        near.asked += 1;
        self.near.insert((&task.need, task.goal), near);
        slice.count_looks(1 + looks / NEAREST);
        is_free
    }

    /// Adds a pair unless something stands against it. Of a robot that is free everything is asked.
    pub fn add_pair(&mut self, robot: usize, task_id: &TaskId) -> bool {
        let (view, Scene { board, now, robots }) = (self.view, self.scene);
        let Some(ready) = view.ready.get(task_id) else { return false };
        let task_id = &ready.rank.task_id;
        if !self.looked.contains_key(task_id) {
            let looked = self.look_at(ready);
            self.looked.insert(task_id, looked);
        }
        let Some(Some(looked)) = self.looked.get_mut(task_id) else { return false };
        if looked.robots.contains(&robot) {
            return true;
        }
        let Robot { weighed: WeighedRobot { robot_id, free, .. }, at, energy, .. } = &robots[robot];
        let Demand { task, intake, .. } = looked.demand;
        let is_fit = looked.able[robot]
            && match free {
                Free::Now | Free::AfterErrand => {
                    filters::pair_if_able(view, board, robot_id, &looked.demand, &now).is_ok()
                }
                Free::Soon => !looked.is_overdue && eligibility::bound(robot_id, task, intake).is_ok(),
            };
        let Some(way_mm) = way_mm(view, *at, ready.goal).filter(|_| is_fit) else { return false };
        let nth = *looked.nth.get_or_insert_with(|| {
            let (Rank { class, since, .. }, deadline) = (ready.rank.clone(), task.deadline(intake));
            self.found.tasks.push(WeighedTask { task_id: task_id.clone(), class, since, deadline });
            self.found.tasks.len() - 1
        });
        looked.robots.insert(robot);
        self.found.pairs.push(WeighedPair {
            robot,
            task: nth,
            way_mm,
            energy_mwh: energy.beyond_model_mwh(way_mm, cost::way_ms(way_mm)),
            has_failed: task.failed_robots.contains(robot_id),
            is_meant: looked.meant_for == Some(robot_id),
        });
        true
    }

    /// What is known of a ready task, unless something stands against it whatever the robot.
    fn look_at(&mut self, ready: &'a ReadyTask) -> Option<Looked<'a>> {
        let (view, Scene { board, now, .. }, task_id) = (self.view, self.scene, &ready.rank.task_id);
        let (task, intake) = view.task(task_id).zip(view.intake(task_id))?;
        filters::task(view, board, task, intake, &now).ok()?;
        Some(Looked {
            demand: Demand::new(view, task, intake),
            able: self.find_able(&ready.need, &ready.rank),
            meant_for: view.meant.get(task_id).map(|meant| &meant.robot_id),
            is_overdue: view.meant.is_over(task_id, now.site),
            nth: None,
            robots: BTreeSet::new(),
        })
    }

    /// Which robots have what a task needs, and charge for any: the same for all tasks of the need.
    fn find_able(&mut self, need: &'a Arc<Need>, of_task: &Rank) -> Rc<[bool]> {
        let (view, robots) = (self.view, self.scene.robots);
        let is_able = |robot: &Robot, intake| {
            let session = view.sessions.get(robot.id().as_str());
            !robot.is_low && session.is_some_and(|s| eligibility::able(view, &s.row, intake).is_ok())
        };
        let able = self.able.entry(need).or_insert_with(|| {
            let intake = view.intake(&of_task.task_id);
            robots.iter().map(|robot| intake.is_some_and(|intake| is_able(robot, intake))).collect()
        });
        able.clone()
    }
}

/// Millimetres to a goal around closed places; 0 without a goal. None: no way leads there.
fn way_mm(view: &FleetProjection, from: WaypointIx, goal: Option<WaypointIx>) -> Option<u64> {
    goal.map_or(Some(0), |goal| view.router.field_around(goal, routing::closed(view)).distance_mm(from))
}

/// Millimetres of the straight line to a goal; 0 without one.
fn line_mm(view: &FleetProjection, from: WaypointIx, goal: Option<WaypointIx>) -> u64 {
    let Some(goal) = goal else { return 0 };
    let (from, goal) = (view.site.waypoint(from), view.site.waypoint(goal));
    let (x_mm, y_mm) = ((from.x_mm - goal.x_mm) as f64, (from.y_mm - goal.y_mm) as f64);
    x_mm.hypot(y_mm) as u64
}
