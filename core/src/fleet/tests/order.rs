//! In which order waiting tasks are served, and what is looked at for it.

use super::*;
use crate::planner_policy::AssignmentPolicy;
use crate::reason::Code;
use crate::task::Phase;

/// Looks of one turn.
const LOOKS: usize = crate::limits::DECISIONS_PER_STAGE * crate::limits::LOOKS_PER_DECISION;

#[test]
fn tasks_of_one_number_are_served_each() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.robot("r2", "park-b");
    rig.submit_as("T1", 7, |_| {});
    rig.submit_as("X1", 7, |_| {});
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["T1", "X1"]);
}

#[test]
fn tasks_that_wait_for_something_keep_none_that_is_ready_from_its_robot() {
    let mut rig = Rig::new();
    let later = BEGIN.plus_ms(3_600_000);
    for n in 0..2_000 {
        rig.submit(&format!("timed-{n}"), |raw| raw.not_before = Some(later));
        rig.submit(&format!("after-{n}"), |raw| raw.depends_on = vec!["open".into()]);
    }
    for n in 0..200 {
        rig.submit(&format!("urgent-{n}"), |raw| {
            raw.priority = Some(0);
            raw.not_before = Some(later);
        });
    }
    rig.submit("ready", |_| {});
    rig.robot("r1", "park-a");
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["ready"]);
}

#[test]
fn native_tasks_of_a_class_go_before_promoted_ones_and_those_by_age() {
    let mut rig = Rig::new();
    let wait = crate::limits::MAX_WAIT.as_ms();
    rig.submit("old-background", |raw| raw.priority = Some(9));
    rig.pass(1);
    rig.submit("old-six", |raw| raw.priority = Some(6));
    rig.pass(1);
    rig.submit("old-five", |raw| raw.priority = Some(5));
    rig.pass(wait);
    rig.submit("urgent", |raw| raw.priority = Some(1));
    rig.submit("normal", |raw| raw.priority = Some(6));
    rig.cycle(Pace::Wake);
    assert_eq!(rig.order(), ["urgent", "old-six", "old-five", "normal", "old-background"]);
    rig.pass(wait);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.order(), ["urgent", "old-background", "old-six", "old-five", "normal"]);
}

#[test]
fn the_time_since_when_a_task_is_ready_survives_a_requeue() {
    let mut rig = Rig::new();
    rig.submit("older", |_| {});
    rig.pass(1_000);
    rig.submit("younger", |_| {});
    let mut given = rig.task("older").clone();
    given.phase = Phase::RetryWait;
    rig.change(&given);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.order(), ["younger"]);
    rig.pass(5_000);
    let mut back = rig.task("older").clone();
    (back.phase, back.queued_since) = (Phase::Queued, rig.now.utc);
    rig.change(&back);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.order(), ["older", "younger"]);
}

#[test]
fn what_cannot_run_yet_is_not_looked_at() {
    let mut rig = Rig::new();
    for n in 0..500 {
        rig.submit(&format!("timed-{n}"), |raw| raw.not_before = Some(BEGIN.plus_ms(3_600_000)));
        rig.submit(&format!("after-{n}"), |raw| raw.depends_on = vec!["open".into()]);
    }
    rig.submit("ready", |_| {});
    rig.robot("r1", "park-a");
    let plan = rig.cycle(Pace::Sweep);
    assert_eq!((plan.report.offers, plan.report.looked), (1, 1));
}

#[test]
fn tasks_that_no_idle_robot_may_do_keep_no_later_one_from_its_robot() {
    let mut rig = Rig::new();
    rig.plan_as(AssignmentPolicy::FifoNearest);
    rig.robot("r1", "park-a");
    for n in 0..3 * LOOKS {
        rig.submit(&format!("elsewhere-{n}"), |raw| raw.robot_id = "r2".into());
    }
    rig.submit("mine", |raw| raw.priority = Some(9));
    let mut looked = Vec::new();
    let given = loop {
        let plan = rig.cycle(Pace::Wake);
        looked.push(plan.report.looked as usize);
        if !plan.report.more {
            break given(&plan.items);
        }
    };
    assert_eq!(given, ["mine"]);
    assert!(looked.iter().all(|tasks| *tasks <= LOOKS), "{looked:?}");
    assert_eq!(looked.iter().sum::<usize>(), 3 * LOOKS + 1, "each once: {looked:?}");
}

#[test]
fn a_robot_that_found_nothing_looks_only_at_new_tasks_until_it_is_heard() {
    let mut rig = Rig::new();
    rig.plan_as(AssignmentPolicy::FifoNearest);
    rig.robot("r1", "park-a");
    for n in 0..100 {
        rig.submit(&format!("elsewhere-{n}"), |raw| raw.robot_id = "r2".into());
    }
    assert_eq!(rig.cycle(Pace::Sweep).report.looked, 100);
    assert_eq!(rig.cycle(Pace::Wake).report.looked, 0);
    rig.submit("mine", |_| {});
    let plan = rig.cycle(Pace::Wake);
    assert_eq!((plan.report.looked, given(&plan.items)), (1, vec!["mine".to_owned()]));
}

#[test]
fn a_failed_dependency_goes_to_a_person_and_a_met_one_is_ready_from_then() {
    let mut rig = Rig::new();
    rig.submit("first", |_| {});
    rig.submit("second", |raw| raw.depends_on = vec!["first".into()]);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.task("second").ready_since, None);
    rig.pass(60_000);
    let mut ended = rig.task("first").clone();
    ended.phase = Phase::Succeeded;
    rig.change(&ended);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.task("second").ready_since, Some(BEGIN.plus_ms(60_000)));
    rig.submit("third", |raw| raw.depends_on = vec!["second".into()]);
    let mut ended = rig.task("second").clone();
    ended.phase = Phase::Canceled;
    rig.change(&ended);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.task("third").reason.as_ref().map(|r| r.code), Some(Code::DependencyFailed));
}
