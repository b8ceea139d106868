//! What opens a task, whatever its robot says of that.

use super::*;
use crate::fleet::facts::inbox;
use crate::fleet::tasks::plausible::passes_irreversible;
use crate::ids::Subject;
use crate::robot::Load;
use crate::robot_events::{AttemptReport, WorkStats};

#[test]
fn a_report_that_passes_a_step_which_must_not_be_done_twice_opens_the_task() {
    let mut rig = Rig::new();
    rig.submit("T1", |_| {});
    let task_id = TaskId::parse("T1").expect("an id");
    let intake = rig.view.intake(&task_id).expect("a task");
    let passes = |next_step: u32, step_index: u32| {
        let report = AttemptReport {
            attempt: AttemptId { subject: Subject::Task(task_id.clone()), epoch: 1 },
            state: WorkState::Executing,
            step_index,
            opened: false,
            refusal: None,
            fault: None,
            stats: WorkStats::default(),
        };
        passes_irreversible(intake, next_step, &report)
    };
    // To A, pick, to B, place.
    assert_eq!([1, 2, 3].map(|step_index| passes(0, step_index)), [false, true, true]);
    assert_eq!(
        [3, 4].map(|step_index| passes(2, step_index)),
        [false, true],
        "what was done before opens nothing anew"
    );
}

#[test]
fn a_robot_that_carries_an_item_of_its_task_has_opened_it() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    rig.submit("T1", |_| {});
    rig.cycle(Pace::Sweep);
    let (robot_id, task_id) = (RobotId::parse("r1").expect("an id"), TaskId::parse("T1").expect("an id"));
    assert_eq!((rig.task("T1").robot_id.as_ref(), &rig.task("T1").opened_robot_id), (Some(&robot_id), &None));
    let (now, load) = (rig.now, Load { task_id: Some(task_id), item: "box".to_owned() });
    Plan::default().decide(&mut rig.view, now, "fleet", |tx| inbox::note_load(tx, &robot_id, &load));
    assert_eq!(rig.task("T1").opened_robot_id, Some(robot_id));
}
