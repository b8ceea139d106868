//! A task goes to the robot that had another one.

use super::*;
use crate::reason::Code;
use crate::task::{Phase, TaskEdit};

fn robot(id: &str) -> Option<RobotId> {
    RobotId::parse(id).ok()
}

/// `return` is for the robot of `bring`, which `r2` has; `r1` stands beside the goal.
fn rig() -> Rig {
    let mut rig = Rig::new();
    rig.robot("r1", "A");
    rig.robot("r2", "park-b");
    rig.submit("bring", |raw| raw.robot_id = "r2".into());
    rig.submit("return", |raw| raw.same_robot_as = "bring".into());
    assert_eq!(given(&rig.cycle(Pace::Wake).items), ["bring"]);
    rig
}

impl Rig {
    fn end(&mut self, id: &str, phase: Phase) {
        let mut task = self.task(id).clone();
        task.phase = phase;
        task.started = task.robot_id.as_ref().map(|_| self.now.utc);
        let robot_id = task.robot_id.clone();
        self.change(&task);
        if let Some(authority) = robot_id.and_then(|id| self.view.authority.get_mut(id.as_str())) {
            authority.row.holder = crate::fleet::projection::rows::RobotHolder::None;
        }
    }
}

#[test]
fn it_waits_for_the_end_of_that_task_and_goes_to_its_robot_alone() {
    let mut rig = rig();
    let why = rig.why(&TaskId::parse("return").expect("an id")).expect("it waits");
    assert_eq!((why.code, why.metadata["task_id"].as_str()), (Code::WaitingForDependency, "bring"));
    rig.end("bring", Phase::Failed);
    rig.pass(1_000);
    rig.cycle(Pace::Wake);
    let task = rig.task("return");
    assert_eq!((&task.same_robot, &task.robot_id), (&robot("r2"), &robot("r2")), "not to the nearer one");
    assert_eq!(task.phase, Phase::Assigned);
}

#[test]
fn a_persons_word_of_the_robot_goes_before_it() {
    for edited in [robot("r1"), None] {
        let mut rig = rig();
        rig.end("bring", Phase::Succeeded);
        let mut task = rig.task("return").clone();
        task.edit = TaskEdit { robot_id: Some(edited), ..TaskEdit::default() };
        rig.change(&task);
        rig.pass(1_000);
        rig.cycle(Pace::Wake);
        assert_eq!(rig.task("return").robot_id, robot("r1"));
    }
}

#[test]
fn a_robot_that_was_offered_that_task_and_did_not_take_it_did_not_have_it() {
    let mut rig = rig();
    let mut task = rig.task("bring").clone();
    task.phase = Phase::Canceled;
    rig.change(&task);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.task("return").phase, Phase::NeedsOperator);
}

#[test]
fn where_no_robot_had_that_task_a_persons_word_is_enough() {
    let mut rig = Rig::new();
    rig.robot("r1", "A");
    rig.submit("bring", |raw| raw.not_before = Some(BEGIN.plus_ms(60_000)));
    rig.submit("return", |raw| raw.same_robot_as = "bring".into());
    let mut task = rig.task("return").clone();
    task.edit = TaskEdit { robot_id: Some(robot("r1")), ..TaskEdit::default() };
    rig.change(&task);
    rig.end("bring", Phase::Canceled);
    rig.cycle(Pace::Wake);
    assert_eq!(rig.task("return").robot_id, robot("r1"));
}

#[test]
fn where_no_robot_had_that_task_a_person_is_asked() {
    let mut rig = Rig::new();
    rig.submit("bring", |_| {});
    rig.submit("return", |raw| raw.same_robot_as = "bring".into());
    rig.end("bring", Phase::Canceled);
    rig.cycle(Pace::Wake);
    let task = rig.task("return");
    assert_eq!(
        (task.phase, task.reason.as_ref().map(|r| r.code)),
        (Phase::NeedsOperator, Some(Code::DependencyFailed))
    );
}
