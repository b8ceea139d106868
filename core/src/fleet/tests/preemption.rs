//! Robots that are taken from tasks which may be interrupted, for urgent ones.

use super::rolling::{line, visits};
use super::*;
use crate::reason::Code;
use crate::task::spec::Class;
use crate::task::{AfterStopping, Phase};

/// Goes to `c0` with this priority.
fn visit(priority: i64) -> impl FnOnce(&mut RawTask) {
    move |raw| {
        visits(&[0])(raw);
        raw.priority = Some(priority);
    }
}

/// A robot at a cell that drives for a task of its own to other cells, which may give way or not.
fn at_work(rig: &mut Rig, robot: &str, from: u32, task: &str, to: &[u32], preemptible: bool) {
    rig.robot(robot, &format!("c{from}"));
    rig.submit(task, |raw| {
        visits(to)(raw);
        (raw.priority, raw.preemptible, raw.timeout_ms) = (Some(7), preemptible, Some(3_600_000));
    });
    rig.cycle(Pace::Sweep);
    let attempt = rig.task(task).attempt_id().expect("a grant");
    let mut running = rig.task(task).clone();
    assert_eq!(running.robot_id.as_ref().map(|id| id.as_str()), Some(robot));
    running.phase = Phase::Running;
    rig.change(&running);
    rig.drives(&attempt);
    let mut known = rig.view.attempts.remove(attempt.to_string().as_str()).expect("a row");
    known.row.accepted = Some(rig.now.utc);
    rig.view.attempts.insert(attempt.to_string().into(), known);
}

/// Of these tasks those that give way.
fn give_way(rig: &Rig, tasks: &[&str]) -> Vec<String> {
    let gives = |id: &&&str| rig.task(id).then == Some(AfterStopping::Suspended);
    tasks.iter().filter(gives).map(|id| (*id).to_owned()).collect()
}

#[test]
fn an_urgent_task_takes_the_nearest_robot_whose_task_may_be_interrupted() {
    let mut rig = line();
    at_work(&mut rig, "far", 100, "t-far", &[199], true);
    at_work(&mut rig, "near", 10, "t-near", &[90], true);
    rig.submit("urgent", visit(0));
    rig.cycle(Pace::Sweep);
    // Each ends its step first: `near` is at c90 then, `far` at c199.
    assert_eq!(give_way(&rig, &["t-far", "t-near"]), ["t-near"]);
    let why = rig.task("t-near").reason.clone().expect("a reason");
    assert_eq!(why.code, Code::UrgentSuspend);
    assert_eq!(why.metadata.get("task_id").map(String::as_str), Some("urgent"));
    // One is enough: the next turns know that it comes.
    for _ in 0..3 {
        rig.pass(1_000);
        rig.cycle(Pace::Sweep);
    }
    assert_eq!(give_way(&rig, &["t-far", "t-near"]), ["t-near"]);
}

#[test]
fn what_may_not_be_interrupted_or_is_opened_or_urgent_goes_on() {
    let mut rig = line();
    at_work(&mut rig, "r1", 10, "firm", &[90], false);
    at_work(&mut rig, "r2", 10, "opened", &[90], true);
    let mut opened = rig.task("opened").clone();
    opened.opened_robot_id = opened.robot_id.clone();
    rig.change(&opened);
    rig.submit("urgent", visit(0));
    rig.cycle(Pace::Sweep);
    assert_eq!(give_way(&rig, &["firm", "opened"]), Vec::<String>::new());
    assert_eq!(rig.task("urgent").phase, Phase::Queued);
}

#[test]
fn only_an_urgent_task_takes_a_robot() {
    let mut rig = line();
    at_work(&mut rig, "r1", 10, "t1", &[90], true);
    rig.submit("normal", visit(5));
    rig.cycle(Pace::Sweep);
    assert_eq!(give_way(&rig, &["t1"]), Vec::<String>::new());
}

#[test]
fn a_task_that_is_urgent_by_waiting_alone_takes_no_robot() {
    let mut rig = line();
    at_work(&mut rig, "r1", 10, "t1", &[90], true);
    rig.submit("old", visit(5));
    rig.cycle(Pace::Wake);
    rig.pass(901_000);
    rig.cycle(Pace::Wake);
    let rank = rig.view.queue.rank(&TaskId::parse("old").expect("an id")).expect("ready").clone();
    assert_eq!((rank.class, rank.promoted), (Class::Urgent, true));
    assert_eq!(give_way(&rig, &["t1"]), Vec::<String>::new());
}

#[test]
fn a_robot_that_is_free_soon_is_awaited_unless_both_drives_are_won() {
    // `soon` is there after 10 s and a way of 20 m, `other` after 5 and 9 or 9 and 5: of each way it is to win the double.
    for (stops_at, is_taken) in [(9, false), (5, true)] {
        let mut rig = line();
        at_work(&mut rig, "other", 14, "t-other", &[stops_at, 150], true);
        at_work(&mut rig, "soon", 10, "t-soon", &[20], false);
        rig.submit("urgent", visit(0));
        rig.cycle(Pace::Sweep);
        assert_eq!(give_way(&rig, &["t-other"]).len(), usize::from(is_taken), "{stops_at}");
    }
}

#[test]
fn a_task_gives_way_once_in_ten_minutes() {
    let mut rig = line();
    at_work(&mut rig, "r1", 10, "t1", &[90], true);
    rig.submit("urgent", visit(0));
    rig.cycle(Pace::Sweep);
    assert_eq!(give_way(&rig, &["t1"]), ["t1"]);
    // As if it had been given to a robot again at once, and the urgent one had found none.
    let mut again = rig.task("t1").clone();
    (again.phase, again.then) = (Phase::Running, None);
    rig.change(&again);
    let attempt = rig.task("t1").attempt_id().expect("a grant");
    rig.drives(&attempt);
    rig.pass(1_000);
    rig.cycle(Pace::Sweep);
    assert_eq!(give_way(&rig, &["t1"]), Vec::<String>::new());
    rig.pass(600_000);
    rig.drives(&attempt);
    rig.cycle(Pace::Wake);
    assert_eq!(give_way(&rig, &["t1"]), ["t1"]);
}
