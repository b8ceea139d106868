//! Which robot gets which task where all are weighed at once.

use super::*;
use crate::fleet::assignment::errands;
use crate::fleet::assignment::rolling::matching;
use crate::fleet::explain;
use crate::fleet::projection::memory::Meant;
use crate::rows::Table;
use crate::site::grid;
use crate::task::Phase;
use crate::task::raw::{RawStep, RawStepKind};
use crate::task::state::Errand;
use std::collections::BTreeSet;

/// A line of cells, `c0` to `c199`, a metre each, that robots drive along at 1 m/s.
pub(super) fn line() -> Rig {
    let map = format!("type octile\nheight 1\nwidth 200\nmap\n{}\n", ".".repeat(200));
    Rig::of_site(Arc::new(grid::parse_map("line", &map).expect("a map")))
}

/// Goes to these cells, one after the other.
pub(super) fn visits(cells: &[u32]) -> impl FnOnce(&mut RawTask) {
    let goto = |cell| RawStep { kind: Some(RawStepKind::Goto(format!("c{cell}"))), ..RawStep::default() };
    let steps = cells.iter().map(goto).collect();
    |raw| raw.steps = steps
}

/// Pairs of robot and task of a cycle, by robot.
fn pairs(plan: &Plan) -> Vec<(String, String)> {
    let rows = plan.items.iter().flat_map(|item| &item.rows).filter(|row| row.key.table == Table::TaskState);
    let pair = |row: &crate::item::RowChange| {
        let Write::Put { body, .. } = &row.write else { return None };
        let task: TaskState = serde_json::from_str(body).ok()?;
        Some((task.robot_id.filter(|_| task.phase == Phase::Assigned)?.to_string(), task.task_id.to_string()))
    };
    let mut pairs: Vec<_> = rows.filter_map(pair).collect();
    pairs.sort();
    pairs
}

fn named(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
    pairs.iter().map(|(robot, task)| ((*robot).to_owned(), (*task).to_owned())).collect()
}

#[test]
fn all_ways_together_are_the_shortest_not_that_of_the_first_task() {
    let mut rig = line();
    rig.robot("left", "c0");
    rig.robot("right", "c60");
    // The nearest to the first task is `right`, which then leaves 100 m to the other.
    rig.submit("first", visits(&[40]));
    rig.submit("second", visits(&[100]));
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("left", "first"), ("right", "second")]));
}

#[test]
fn a_choice_is_told_from_the_costs_that_decided_with_what_the_next_robot_took() {
    let mut rig = line();
    rig.robot("left", "c0");
    rig.robot("right", "c60");
    rig.submit("first", visits(&[40]));
    rig.submit("second", visits(&[100]));
    rig.cycle(Pace::Wake);
    let first = TaskId::parse("first").expect("an id");
    let told = explain::task(&rig.view, &rig.board, &rig.now, &first).expect("a task");
    let choice = told.choice.expect("a plan gave it");
    assert_eq!((choice.robot_id.as_str(), choice.is_given, choice.weighed), ("left", true, 2));
    // Each metre is a second and weighs twice.
    assert_eq!((choice.cost.way, choice.cost.sum()), (80_000_000, 80_000_000));
    let next: Vec<_> =
        choice.next.iter().map(|n| (n.robot_id.as_str(), n.cost.sum(), n.took.as_ref().map(TaskId::as_str))).collect();
    assert_eq!(next, [("right", 40_000_000, Some("second"))], "nearer, and worth more elsewhere");
}

#[test]
fn a_plan_is_remembered_with_all_that_it_was_decided_by_and_comes_out_the_same_again() {
    let mut rig = line();
    rig.robot("left", "c0");
    rig.robot("right", "c60");
    rig.submit("first", visits(&[40]));
    rig.submit("second", visits(&[100]));
    rig.cycle(Pace::Wake);
    let plan = rig.view.plans.get(None).expect("a plan").clone();
    assert_eq!((plan.number, plan.at, &plan.policy), (1, rig.now.utc, &rig.view.planner()));
    let robots: Vec<&str> = plan.weighed.robots.iter().map(|robot| robot.robot_id.as_str()).collect();
    let tasks: Vec<&str> = plan.weighed.tasks.iter().map(|task| task.task_id.as_str()).collect();
    let made: Vec<_> = plan.made.iter().map(|(robot, task)| (robots[*robot], tasks[*task])).collect();
    assert_eq!((made, plan.weighed.pairs.len()), (vec![("left", "first"), ("right", "second")], 4));
    assert_eq!(matching::choose_pairs(&plan.policy, plan.at, &plan.weighed), plan.made);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.view.plans.iter().count(), 1, "nothing was decided since");
}

#[test]
fn a_robot_takes_the_task_that_is_near_to_it_unless_another_has_waited_ten_times_as_long_as_the_way() {
    let mut rig = line();
    rig.submit("old", visits(&[100]));
    rig.cycle(Pace::Wake);
    rig.pass(1_000);
    rig.submit("near", visits(&[10]));
    rig.robot("r1", "c0");
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("r1", "near")]));
    // 90 m further are 180 s of weight, which a tenth of half an hour makes up for; before that it is promoted.
    let mut rig = line();
    rig.submit("old", visits(&[40]));
    rig.cycle(Pace::Wake);
    rig.pass(800_000);
    rig.submit("near", visits(&[10]));
    rig.robot("r1", "c0");
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("r1", "old")]));
}

#[test]
fn a_task_of_a_higher_class_goes_first_however_far_it_is() {
    let mut rig = line();
    rig.robot("r1", "c0");
    rig.submit("near", visits(&[1]));
    rig.submit("urgent", |raw| {
        visits(&[190])(raw);
        raw.priority = Some(0);
    });
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("r1", "urgent")]));
}

#[test]
fn as_many_tasks_are_given_as_can_be() {
    let mut rig = line();
    rig.robot("r1", "c0");
    rig.robot("r2", "c50");
    rig.submit("for-one", |raw| {
        visits(&[1])(raw);
        raw.robot_id = "r1".into();
    });
    rig.submit("for-all", visits(&[2]));
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("r1", "for-one"), ("r2", "for-all")]));
}

/// A robot that drives to its only goal, `left_mm` before it, and an idle one that is far away.
fn one_soon(left_m: u32) -> Rig {
    let mut rig = line();
    rig.robot("soon", &format!("c{}", 100 - left_m));
    rig.submit("at-work", visits(&[100]));
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["at-work"]);
    let robot_id = RobotId::parse("soon").expect("an id");
    let attempt = rig.view.held_by(&robot_id).expect("an attempt").clone();
    rig.drives(&attempt);
    rig.robot("idle", "c10");
    rig
}

#[test]
fn a_task_beside_which_another_robot_is_free_soon_waits_for_that_one() {
    let mut rig = one_soon(20);
    rig.submit("beside", visits(&[101]));
    assert!(pairs(&rig.cycle(Pace::Wake)).is_empty());
    let task_id = TaskId::parse("beside").expect("an id");
    assert_eq!(rig.view.meant.get(&task_id).map(|meant| meant.robot_id.to_string()).as_deref(), Some("soon"));
    let told = explain::task(&rig.view, &rig.board, &rig.now, &task_id).expect("known");
    let waits_for = told.verdict.and_then(|why| why.metadata.get("waits_for").cloned());
    assert_eq!(waits_for.as_deref(), Some("robot soon: it is free soon and nearer than others"));
    let free = told.expected.expect("an estimate").ms_since(rig.now.utc);
    assert!((20_000..22_000).contains(&free), "20 m at 1 m/s, and the hand-over: {free}");
    // The robot that it is meant for may be long in coming.
    rig.pass(31_000);
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("idle", "beside")]));
}

#[test]
fn a_task_that_was_meant_for_too_long_and_found_no_robot_is_not_meant_for_one_again_at_once() {
    let (task_id, robot_id) = (TaskId::parse("beside").expect("an id"), RobotId::parse("soon").expect("an id"));
    let plan = || vec![(task_id.clone(), robot_id.clone(), BEGIN)];
    let mut meant = Meant::default();
    for s in [0, 10, 30] {
        meant.put_plan(plan(), SiteTime(s * 1_000));
        assert!(!meant.is_over(&task_id, SiteTime(s * 1_000)), "{s}");
    }
    assert!(meant.is_over(&task_id, SiteTime(31_000)));
    // The plan that leaves it out, and those behind it.
    for s in [31, 32, 60] {
        meant.put_plan(Vec::new(), SiteTime(s * 1_000));
        assert!(meant.get(&task_id).is_none() && meant.is_over(&task_id, SiteTime(s * 1_000)), "{s}");
    }
    assert!(!meant.is_over(&task_id, SiteTime(61_000)));
    // For one that breaks off its errand it is meant at any time, and from then on as if anew.
    meant.put_plan(plan(), SiteTime(100_000));
    meant.put_plan(Vec::new(), SiteTime(131_000));
    meant.put_plan(plan(), SiteTime(132_000));
    assert!(!meant.is_over(&task_id, SiteTime(162_000)) && meant.is_over(&task_id, SiteTime(163_000)));
    // Plans between that mean it for nobody count with it, unless it was long for nobody.
    for (s, tasks) in [(200, plan()), (220, Vec::new()), (224, plan()), (228, Vec::new())] {
        meant.put_plan(tasks, SiteTime(s * 1_000));
    }
    assert!(meant.get(&task_id).is_none() && meant.is_over(&task_id, SiteTime(231_000)));
    meant.put_plan(plan(), SiteTime(240_000));
    assert!(!meant.is_over(&task_id, SiteTime(270_000)));
}

#[test]
fn a_robot_that_is_not_free_within_the_horizon_counts_for_nothing() {
    let mut rig = one_soon(40);
    rig.submit("beside", visits(&[101]));
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("idle", "beside")]));
}

#[test]
fn the_order_in_which_tasks_and_robots_came_changes_nothing() {
    let plan = |order: &[usize]| {
        let mut rig = line();
        for nth in order {
            rig.robot(&format!("r{nth}"), &format!("c{}", nth * 37 % 200));
        }
        for nth in order {
            let cell = (nth * 59 % 200) as u32;
            rig.submit_as(&format!("T{nth}"), *nth as u64, visits(&[cell]));
        }
        pairs(&rig.cycle(Pace::Wake))
    };
    let there: Vec<usize> = (0..40).collect();
    let back: Vec<usize> = there.iter().rev().copied().collect();
    assert_eq!(plan(&there).len(), 40);
    assert_eq!(plan(&there), plan(&back));
}

#[test]
fn where_there_are_more_robots_than_are_weighed_at_once_every_task_gets_one_near_it() {
    let mut rig = line();
    for nth in 0..512 {
        rig.robot(&format!("r{nth:04}"), &format!("c{}", nth % 200));
    }
    for nth in 0..100 {
        rig.submit(&format!("T{nth:03}"), visits(&[nth]));
    }
    let mut all = Vec::new();
    loop {
        let plan = rig.cycle(Pace::Wake);
        all.extend(pairs(&plan));
        if !plan.report.more {
            break;
        }
    }
    assert_eq!(all.len(), 100);
    for (robot, task) in all {
        let cell = robot[1..].parse::<usize>().expect("a number") % 200;
        assert_eq!(format!("T{cell:03}"), task, "one stands there");
    }
}

#[test]
fn robots_that_stand_in_one_place_get_a_task_each_in_turn_after_turn() {
    let mut rig = line();
    for nth in 0..120 {
        rig.robot(&format!("r{nth:03}"), "c0");
        rig.submit(&format!("T{nth:03}"), visits(&[100]));
    }
    let mut offers = 0;
    loop {
        let plan = rig.cycle(Pace::Wake);
        offers += plan.report.offers;
        if !plan.report.more {
            break;
        }
        assert!(plan.report.offers > 0, "a turn that asks for another one did something");
    }
    assert_eq!(offers, 120);
}

#[test]
fn a_robot_that_none_of_many_tasks_is_for_rests_until_it_is_heard_or_a_task_comes() {
    let mut rig = line();
    rig.robot("r1", "c0");
    for nth in 0..100 {
        rig.submit(&format!("elsewhere-{nth}"), |raw| {
            visits(&[nth])(raw);
            raw.robot_id = "r2".into();
        });
    }
    let here = BTreeSet::from([RobotId::parse("r1").expect("an id")]);
    assert!(!rig.view.queue.is_seen_by_all(&here, &BTreeSet::new()));
    rig.cycle(Pace::Wake);
    assert!(rig.view.queue.is_seen_by_all(&here, &BTreeSet::new()));
    assert!(!rig.view.queue.is_seen_by_all(&here, &here), "it was heard");
    rig.cycle(Pace::Wake);
    rig.submit("mine", visits(&[190]));
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("r1", "mine")]));
}

/// A corridor with a robot that has parked and may be called from there, as its row and its report say.
fn parked(rig: &mut Rig, id: &str, waypoint: &str) {
    rig.robot(id, waypoint);
    let robot_id = RobotId::parse(id).expect("an id");
    let mut plan = Plan::default();
    let goal = rig.view.site.find(&WaypointId::parse(waypoint).expect("a name")).expect("a waypoint");
    let (now, board) = (rig.now, rig.board.clone());
    let begin = |tx: &mut crate::fleet::Tx| errands::begin(tx, &robot_id, Errand::Park, goal, &board);
    assert!(plan.decide(&mut rig.view, now, "tests", begin));
    let attempt = rig.view.held_by(&robot_id).expect("an errand").clone();
    let mut row = rig.view.attempt(&attempt).expect("a row").clone();
    (row.phase, row.accepted) = (AttemptPhase::Executing, Some(now.utc));
    let revision = rig.view.attempts[attempt.to_string().as_str()].revision;
    rig.view.attempts.insert(attempt.to_string().into(), RevisedRow { revision, row });
    rig.says(&robot_id, &attempt, WorkState::Executing, 0, 0);
}

/// Robots whose errand a cycle breaks off.
fn recalled(plan: &Plan) -> usize {
    plan.items.iter().flat_map(|item| &item.rows).filter(|row| row.kind == "errand.stopping").count()
}

#[test]
fn one_task_calls_one_robot_from_its_errand_however_long_that_takes() {
    let mut rig = line();
    for nth in 0..5 {
        parked(&mut rig, &format!("r{nth}"), &format!("c{nth}"));
    }
    rig.submit("task", visits(&[100]));
    let first = rig.cycle(Pace::Wake);
    assert_eq!(
        recalled(&first),
        1,
        "{:?}",
        first.items.iter().flat_map(|i| &i.rows).map(|r| r.kind).collect::<Vec<_>>()
    );
    let mut more = 0;
    for _ in 0..40 {
        rig.pass(1_000);
        more += recalled(&rig.cycle(Pace::Wake));
    }
    assert!(more <= 1, "after half a minute another one may be called: {more}");
}

#[test]
fn eight_tasks_that_a_robot_cannot_do_hide_none_that_it_can() {
    let mut rig = line();
    rig.robot("r1", "c0");
    for nth in 0..20 {
        rig.submit(&format!("heavy-{nth:02}"), |raw| {
            visits(&[1])(raw);
            raw.robot_id = "r1".into();
            raw.payload_g = 1_000_000;
        });
    }
    rig.submit("light", |raw| {
        visits(&[150])(raw);
        raw.robot_id = "r1".into();
    });
    assert_eq!(pairs(&rig.cycle(Pace::Wake)), named(&[("r1", "light")]));
}

#[test]
fn a_turn_of_a_small_slice_gives_as_many_tasks_as_it_may() {
    let mut rig = line();
    for nth in 0..200 {
        rig.robot(&format!("r{nth:03}"), &format!("c{nth}"));
        rig.submit(&format!("T{nth:03}"), visits(&[nth]));
    }
    let mut turns = 0;
    let mut offers = 0;
    loop {
        let mut plan = Plan::for_slice(crate::fleet::Slice::for_decisions(32));
        cycle(&mut rig.view, rig.now, &rig.board, Pace::Wake, &mut plan);
        (turns, offers) = (turns + 1, offers + plan.report.offers);
        if !plan.report.more {
            break;
        }
    }
    assert_eq!(offers, 200);
    assert!(turns <= 10, "{turns} turns");
}

#[test]
fn a_task_whose_goal_the_map_has_lost_is_meant_for_nobody() {
    let mut rig = one_soon(20);
    rig.submit("lost", visits(&[999]));
    let task_id = TaskId::parse("lost").expect("an id");
    rig.cycle(Pace::Wake);
    assert!(rig.view.meant.get(&task_id).is_none() && rig.view.ready.get(&task_id).is_none());
    assert!(rig.view.queue.rank(&task_id).is_some(), "it waits");
}
