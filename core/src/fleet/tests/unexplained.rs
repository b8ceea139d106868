//! What stands without a reason is counted; what has one is not.

use super::{BEGIN, Rig};
use crate::fleet::explanation::{unexplained, wait_reasons};
use crate::fleet::projection::RevisedRow;
use crate::fleet::rows::Cordon;
use crate::fleet::{Pace, Plan};
use crate::ids::{RobotId, StopId, TaskId};
use crate::reason::{Code, Reason};
use crate::robot::{StopLevel, WorkState};
use crate::rows::{Record, Revision, Row};
use crate::stop::Scope;
use crate::stop::latch::{Reset, Stop};
use crate::stop::record::StopRecord;

/// What is counted in so many seconds in which nobody plans.
fn counted(rig: &mut Rig, secs: u64) -> Vec<String> {
    let mut plan = Plan::default();
    for _ in 0..secs {
        rig.pass(1_000);
        unexplained::count_unexplained(&mut rig.view, &rig.board, rig.now, &mut plan);
    }
    plan.report.unexplained
}

#[test]
fn a_task_that_an_idle_robot_could_take_is_counted_once_if_nobody_offers_it() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    assert_eq!(counted(&mut rig, 10), Vec::<String>::new());
    assert_eq!(counted(&mut rig, 30), ["task T1"]);
}

#[test]
fn a_task_whose_robots_all_have_a_reason_against_them_is_not_counted() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |raw| raw.capabilities = vec!["weld".into()]);
    rig.submit("T2", |_| {});
    rig.cycle(Pace::Sweep);
    let robot_id = RobotId::parse("r1").expect("an id");
    let mut control = rig.view.control["r1"].row.clone();
    control.cordon = Some(Cordon { reason: "a wheel".into(), actor: "me".into(), since: rig.now.utc });
    rig.view.control.insert("r1".into(), RevisedRow { revision: Revision(9), row: control });
    assert_eq!(counted(&mut rig, 40), Vec::<String>::new());
    let told = crate::fleet::explain::robot(&rig.view, &rig.board, &rig.now, &robot_id).expect("known").verdict;
    assert!(told.as_ref().is_some_and(wait_reasons::is_told), "{told:?}");
}

#[test]
fn an_attempt_of_a_robot_that_was_given_away_without_a_record_is_counted() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Sweep);
    assert_eq!(rig.task("T1").robot_id.as_ref().map(RobotId::as_str), Some("r1"));
    assert_eq!(counted(&mut rig, 40), Vec::<String>::new(), "it waits for the answer of its robot");
    rig.view.attempts.clear();
    let mut found = counted(&mut rig, 40);
    found.sort();
    assert_eq!(found, ["robot r1", "task T1"]);
}

#[test]
fn each_reason_against_a_robot_names_whom_it_waits_for() {
    let robot_id = RobotId::parse("r1").expect("an id");
    for code in Code::ALL {
        let told = wait_reasons::about_robot(Reason::from(*code), &robot_id);
        assert!(wait_reasons::is_told(&told), "{told:?}");
    }
}

#[test]
fn a_robot_at_the_end_of_its_released_route_that_waits_for_no_place_has_no_reason() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Sweep);
    let task_id = TaskId::parse("T1").expect("an id");
    let id = rig.task("T1").attempt_id().expect("given");
    rig.drives(&id);
    let robot_id = RobotId::parse("r1").expect("an id");
    assert_eq!(rig.why(&task_id), None);
    rig.says(&robot_id, &id, WorkState::Executing, 0, 1_000);
    assert_eq!(rig.why(&task_id).map(|why| why.code), Some(Code::WorksOnStep));
}

#[test]
fn what_a_turn_found_of_robots_serves_all_its_explanations_and_none_of_the_next() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    for id in ["T1", "T2"] {
        rig.submit(id, |raw| raw.not_before = Some(BEGIN.plus_ms(3_600_000)));
    }
    rig.cycle(Pace::Sweep);
    let against = |rig: &Rig, id: &str| {
        let told = crate::fleet::explain::task(&rig.view, &rig.board, &rig.now, &rig.task(id).task_id);
        told.expect("a task").candidates[0].reason.as_ref().map(|reason| reason.code)
    };
    assert_eq!(against(&rig, "T1"), None);
    let mut control = rig.view.control["r1"].row.clone();
    control.cordon = Some(Cordon { reason: "a wheel".into(), actor: "me".into(), since: rig.now.utc });
    rig.view.control.insert("r1".into(), RevisedRow { revision: Revision(9), row: control });
    assert_eq!(against(&rig, "T2"), None, "the robot is not looked at again");
    rig.cycle(Pace::Wake);
    assert_eq!(against(&rig, "T2"), Some(Code::RobotCordoned));
}

#[test]
fn a_turn_answers_fewer_questions_the_more_robots_there_are_and_one_at_least() {
    use crate::fleet::explain::per_turn;
    assert!(per_turn(0) >= crate::limits::REQUESTS_PER_TURN && per_turn(50) >= crate::limits::REQUESTS_PER_TURN);
    assert_eq!((per_turn(1_000), per_turn(1_000_000)), (4, 1));
}

#[test]
fn a_stop_that_was_reset_is_not_looked_at_again() {
    let mut rig = Rig::new();
    let stop_id = StopId::parse("STOP-1").expect("an id");
    let stop = Stop::new(stop_id.clone(), Scope::Fleet, StopLevel::Halt, rig.now.utc);
    let mut record = StopRecord { stop, reset: None };
    rig.absorb(&record);
    assert_eq!(rig.view.engaged.len(), 1);
    record.reset = Some(Reset::new(stop_id, rig.now.utc));
    let row = Row { key: record.key(), revision: Revision(2), index: record.index(), body: record.body() };
    rig.view.absorb(&row.key, row.revision, Some(&row)).expect("a row of ours");
    assert_eq!((rig.view.engaged.len(), rig.view.stops.len()), (0, 1));
}
