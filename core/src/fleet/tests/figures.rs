//! What is counted of a shift.

use super::*;
use crate::fleet::FleetFigures;
use crate::fleet::projection::rows::RobotCounter;
use crate::robot_events::WorkStats;
use crate::task::Phase;
use crate::task::spec::Class;

#[test]
fn what_a_task_came_to_is_told_once() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |raw| raw.priority = Some(1));
    rig.pass(3_000);
    rig.cycle(Pace::Wake);
    let mut done = rig.task("T1").clone();
    (done.phase, done.started, done.ended) =
        (Phase::Succeeded, Some(rig.now.utc.plus_ms(500)), Some(rig.now.utc.plus_ms(60_000)));
    rig.change(&done);
    let ended = rig.cycle(Pace::Wake).report.ended;
    let [task] = &ended[..] else { panic!("{ended:?}") };
    assert_eq!((task.class, task.kind.as_str(), task.attempts), (Class::Urgent, "transport", 1));
    assert_eq!((task.wait_ms, task.completion_ms), (Some(3_500), Some(63_000)));
    assert!(rig.cycle(Pace::Wake).report.ended.is_empty());
}

#[test]
fn a_task_that_no_robot_had_has_neither_wait_nor_completion() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    let mut over = rig.task("T1").clone();
    (over.phase, over.ended) = (Phase::Canceled, Some(rig.now.utc));
    rig.change(&over);
    let ended = rig.cycle(Pace::Wake).report.ended;
    assert_eq!(ended.iter().map(|t| (t.wait_ms, t.completion_ms, t.attempts)).collect::<Vec<_>>(), [(None, None, 0)]);
}

#[test]
fn robots_are_counted_by_what_has_them_and_way_by_work_and_load() {
    let mut rig = Rig::new();
    for (id, at) in [("r1", "park-a"), ("r2", "park-b"), ("r3", "charge")] {
        rig.robot(id, at);
    }
    rig.submit("T1", |raw| raw.robot_id = "r1".into());
    rig.cycle(Pace::Wake);
    let robot_id = RobotId::parse("r3").expect("an id");
    Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).report.vitals.battery_permille = 50;
    let stats = |path_mm, loaded_path_mm| WorkStats { path_mm, loaded_path_mm, ..WorkStats::default() };
    rig.absorb(&RobotCounter {
        robot_id: robot_id.clone(),
        software: "1.0.0".into(),
        succeeded: 1,
        failures: std::collections::BTreeMap::new(),
        stats: stats(10_000, 4_000),
        errands: stats(1_000, 0),
        attached_ms: 0,
        counted: rig.now.utc,
        energy_sums: Default::default(),
    });
    let figures = FleetFigures::new(&rig.view, &rig.board, &rig.now);
    let robots = |does| figures.robots[does];
    assert_eq!((robots("task"), robots("nothing"), robots("charge")), (1, 2, 0));
    assert_eq!(figures.waits_for_charger, 1);
    assert_eq!(figures.driven_mm, [("task", "yes", 4_000), ("task", "no", 5_000), ("errand", "no", 1_000)]);
}
