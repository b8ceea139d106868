//! The planner `rolling`: all that may be given now is weighed at once, and what is given costs least in sum.
//!
//! Robots that are free soon are weighed too, so that no robot drives far to a task that another will stand beside. What is
//! meant for them is memory of this process, no row and no promise.
//!
//! In reading order: `robots` that may take something; which pairs are weighed (`choices`); what a pair costs (`cost`); the
//! pairs of least cost (`matching`, by `least_cost`); why these (`reasons`); what gives way to urgent tasks (`preemption`). Called by
//! `assign`. Invariants:
//! 1. A task of a higher class goes first, and as many tasks are given as can be.
//! 2. The same rows, heartbeats and memory give the same pairs, in whatever order they came.

mod choices;
mod cost;
mod least_cost;
pub mod matching;
pub mod preemption;
mod reasons;
mod robots;

use super::candidates::Candidate;
use super::{filters, offers};
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::chosen::PlanChoice;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::plans::{Free, Weighed, WeighedRobot};
use crate::fleet::projection::queue::Walk;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::errand_reports;
use crate::ids::RobotId;
use crate::planner_policy::PlannerPolicy;
use crate::time::Now;
use choices::{Finder, Scene};
use reasons::Reasons;
use robots::{ROBOTS_MAX, Robot};
use std::collections::BTreeSet;

/// Of so many robots each is weighed for the first tasks in the queue, half as many again.
const FIRST_PER_TWO_ROBOTS: usize = 3;

/// Gives ready tasks to robots that are free, each assignment an item of its own, and gives back who is free still.
pub fn plan(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    policy: &PlannerPolicy,
    plan: &mut Plan,
) -> Vec<Candidate> {
    let free = robots::find_free(view, board, &now);
    if free.is_empty() {
        return Vec::new();
    }
    let present: BTreeSet<RobotId> = free.iter().map(|robot| robot.id().clone()).collect();
    if view.queue.is_seen_by_all(&present, heard) {
        return free.into_iter().filter(|robot| robot.weighed.free == Free::Now).map(Candidate::from).collect();
    }
    let mut robots = robots::find_stopping(view, board, &now);
    let room = ROBOTS_MAX.saturating_sub(free.len() + robots.len());
    if room > 0 {
        let mut soon = robots::find_soon(view, board, &now, policy.horizon_ms);
        soon.sort_by_key(|robot| robot.weighed.ready_ms);
        robots.extend(soon.into_iter().take(room));
    }
    robots.extend(free);
    robots.sort_by(|a, b| a.id().cmp(b.id()));
    let scene = Scene { board, now, robots: &robots };
    let (weighed, unfinished) = if robots.len() > ROBOTS_MAX {
        find_by_task(view, scene, heard, &present, plan)
    } else {
        (find_by_robot(view, scene, heard, &present, plan), None)
    };
    let made = matching::choose_pairs(policy, now.utc, &weighed);
    let rank_of = |view: &FleetProjection, task: usize| view.queue.rank(&weighed.tasks[task].task_id).cloned();
    let mut pairs = made.clone();
    pairs.sort_by_cached_key(|(_, task)| rank_of(view, *task));
    let mut reasons = Reasons::new(policy, now.utc, &weighed, &pairs);
    plan.slice.renew();
    let (mut given, mut recalled, mut meant) = (BTreeSet::new(), false, Vec::new());
    for (robot, nth) in pairs {
        let WeighedRobot { robot_id, free, ready_ms, .. } = &weighed.robots[robot];
        let task_id = weighed.tasks[nth].task_id.clone();
        // The first is decided in any case: else a turn might do nothing, and the next one the same.
        if *free != Free::Soon && (recalled || !given.is_empty()) && plan.is_cut() {
            continue;
        }
        if *free == Free::Now {
            let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
            let (task, intake) = (task.clone(), intake.clone());
            plan.decide(view, now, "fleet", |tx| offers::offer(tx, &task, &intake, robot_id, board));
            // What the store would refuse was given up, and must not be tried again at once.
            if view.held_by(robot_id).is_some() {
                plan.report.offers += 1;
                given.insert(robot_id.clone());
                let why = reasons.of_task(nth, robot);
                view.chosen.note_choice(task_id, PlanChoice { is_given: true, ..why });
            }
            continue;
        }
        if *free == Free::AfterErrand {
            plan.decide(view, now, "fleet", |tx| errand_reports::stop_errand(tx, robot_id));
            recalled |= !filters::recallable(view, board, robot_id);
        }
        let why = reasons.of_task(nth, robot);
        view.chosen.note_choice(task_id.clone(), why);
        meant.push((task_id, robot_id.clone(), now.utc.plus_ms(*ready_ms)));
    }
    view.meant.put_plan(meant, now.site);
    if !made.is_empty() {
        view.plans.note(now.utc, policy, weighed, made);
    }
    let is_unfinished = unfinished.is_some();
    if let Some(walk) = unfinished
        && ((given.is_empty() && !recalled) || walk.is_of_news())
    {
        // Nothing came of these tasks, or they are shown once: the next turn goes on behind them.
        view.queue.pause(walk);
    }
    // Those that are left may be near to tasks that were not weighed for them. Only who must charge does not wait for that.
    let goes_on = is_unfinished || (!given.is_empty() && given.len() < present.len());
    plan.report.more |= goes_on;
    let is_left =
        |robot: &Robot| robot.weighed.free == Free::Now && !given.contains(robot.id()) && (robot.is_low || !goes_on);
    robots.into_iter().filter(is_left).map(Candidate::from).collect()
}

impl From<Robot> for Candidate {
    fn from(robot: Robot) -> Self {
        Self { robot_id: robot.weighed.robot_id, at: robot.at, tasks: robot.weighed.tasks }
    }
}

/// Of each robot its nearest tasks, and of the first tasks all robots. A robot that found nothing is shown new tasks alone
/// until it is heard.
fn find_by_robot(
    view: &mut FleetProjection,
    scene: Scene<'_>,
    heard: &BTreeSet<RobotId>,
    present: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Weighed {
    let rested = view.queue.rested(present, heard);
    let news = view.queue.take_news();
    let mut nothing = BTreeSet::new();
    let mut finder = Finder::new(view, scene);
    for (nth, robot) in scene.robots.iter().enumerate() {
        let is_rested = rested.contains(robot.id()) && news.len() <= ROBOTS_MAX;
        let has_found = match (robot.is_low, is_rested) {
            (true, _) => false,
            (false, true) => news.iter().filter(|rank| finder.add_pair(nth, &rank.task_id)).count() > 0,
            (false, false) => finder.find_tasks(nth, &mut plan.slice),
        };
        if !has_found && present.contains(robot.id()) {
            nothing.insert(robot.id().clone());
        }
    }
    let awake = present.len() - nothing.len();
    let first = (awake * FIRST_PER_TWO_ROBOTS / 2).min(plan.slice.decisions());
    let mut found = 0;
    for task_id in view.queue.ready().take(4 * first) {
        plan.report.looked += 1;
        found += usize::from(finder.find_robots(task_id, &mut plan.slice));
        if found >= first {
            break;
        }
    }
    let weighed = finder.into_weighed();
    view.queue.let_rest(nothing);
    weighed
}

/// Where there are more robots than can be weighed against all tasks: of each of the first tasks the nearest robots. Gives
/// back the walk along the tasks if it is not over.
fn find_by_task(
    view: &mut FleetProjection,
    scene: Scene<'_>,
    heard: &BTreeSet<RobotId>,
    present: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> (Weighed, Option<Walk>) {
    let mut walk = view.queue.walk(present, heard);
    let mut finder = Finder::new(view, scene);
    let most = plan.slice.decisions();
    let mut found = 0;
    while found < most && !plan.slice.is_spent() {
        let Some(task_id) = view.queue.next(&mut walk) else {
            let weighed = finder.into_weighed();
            if found == 0 {
                let left = present.intersection(&walk.robots).cloned().collect();
                plan.report.more |= view.queue.end(&walk, left, present);
            }
            return (weighed, None);
        };
        plan.report.looked += 1;
        found += usize::from(finder.find_robots(&task_id, &mut plan.slice));
    }
    (finder.into_weighed(), Some(walk))
}
