//! Labels that people give a robot go before what it says itself.

use super::super::commands::{self, Command};
use super::*;
use crate::fleet::Slice;
use crate::fleet::tasks::eligibility;
use crate::reason::Refusal;

fn label(rig: &mut Rig, labels: &[(&str, &str)], removed: &[&str]) -> Result<(), Refusal> {
    let labels = labels.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
    let removed = removed.iter().map(|key| (*key).to_owned()).collect();
    let command = Command::Label { robot_id: RobotId::parse("r1").expect("an id"), labels, removed };
    let Rig { view, board, now, .. } = rig;
    commands::check(view, board, now, &command, None)?;
    Plan::default().decide(view, *now, "ana", |tx| commands::apply(tx, board, &command, "ana"));
    Ok(())
}

/// Whether any robot could ever do task `t1`.
fn could(rig: &Rig) -> bool {
    let id = TaskId::parse("t1").expect("an id");
    let (task, intake) = rig.view.task(&id).zip(rig.view.intake(&id)).expect("a task");
    eligibility::could_ever(&rig.view, task, intake, &mut Slice::default()).is_ok()
}

fn rig() -> Rig {
    let mut rig = Rig::new();
    rig.robot("r1", "A");
    let said = &mut rig.view.sessions.get_mut("r1").expect("it attached").row.inventory.labels;
    said.insert("floor".to_owned(), "1".to_owned());
    rig.submit("t1", |raw| raw.selector_labels = [("floor".to_owned(), "2".to_owned())].into());
    rig
}

#[test]
fn a_label_of_a_person_goes_before_the_robots_own_which_counts_again_without_it() {
    let mut rig = rig();
    assert!(!could(&rig), "it says floor 1");
    label(&mut rig, &[("floor", "2")], &[]).expect("allowed");
    assert!(could(&rig));
    label(&mut rig, &[("line", "a")], &["floor"]).expect("allowed");
    assert!(!could(&rig), "it says floor 1");
}

#[test]
fn people_may_say_no_labels_that_a_robot_may_not_say() {
    let mut rig = rig();
    let many: Vec<String> = (0..33).map(|n| format!("k{n}")).collect();
    let many: Vec<(&str, &str)> = many.iter().map(|key| (key.as_str(), "v")).collect();
    assert!(label(&mut rig, &many, &[]).is_err(), "more than one may have");
    assert!(label(&mut rig, &[("", "v")], &[]).is_err(), "without a key");
    assert!(label(&mut rig, &[("a", "v")], &["a"]).is_err(), "put and taken back");
    assert!(label(&mut rig, &[], &[]).is_err(), "nothing");
    assert!(label(&mut rig, &many[..32], &[]).is_ok());
    assert!(label(&mut rig, &many[32..], &["k0"]).is_ok(), "one goes and one comes");
}
