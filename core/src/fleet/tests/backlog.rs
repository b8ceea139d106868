//! Tasks that wait for long: what is a person's, and what is only told.

use super::*;
use crate::fleet::explain;
use crate::fleet::rows::Incident;
use crate::identity::RobotIdentity;
use crate::limits;
use crate::reason::Code;
use crate::task::Phase;

/// Milliseconds of a minute.
const MINUTE: u64 = 60_000;

fn reason(rig: &Rig, id: &str) -> Option<Code> {
    rig.task(id).reason.as_ref().map(|reason| reason.code)
}

/// Lets minutes pass, with a sweep in each.
fn wait(rig: &mut Rig, minutes: u64) {
    for _ in 0..minutes {
        rig.pass(MINUTE);
        rig.cycle(Pace::Sweep);
    }
}

/// A robot that is known and not there.
fn known(rig: &mut Rig, id: &str) {
    rig.robot(id, "park-a");
    rig.board.remove(&RobotId::parse(id).expect("an id"));
}

fn incidents(rig: &Rig) -> Vec<&Incident> {
    rig.view.incidents.values().map(|incident| &incident.row).collect()
}

#[test]
fn a_task_that_only_waits_for_robots_is_no_persons_problem() {
    let mut rig = Rig::new();
    known(&mut rig, "r1");
    rig.submit("T1", |_| {});
    wait(&mut rig, 12 * 60);
    assert_eq!(rig.task("T1").phase, Phase::Queued);
}

#[test]
fn schedule_to_start_counts_only_while_the_task_is_ready() {
    let mut rig = Rig::new();
    known(&mut rig, "r1");
    rig.submit("first", |_| {});
    rig.submit("T1", |raw| {
        raw.schedule_to_start_ms = Some(20 * MINUTE as i64);
        raw.depends_on = vec!["first".into()];
    });
    let later = rig.now.utc.plus_ms(60 * MINUTE);
    rig.submit("T2", |raw| {
        raw.schedule_to_start_ms = Some(20 * MINUTE as i64);
        raw.not_before = Some(later);
    });
    wait(&mut rig, 60);
    let mut ended = rig.task("first").clone();
    ended.phase = Phase::Succeeded;
    rig.change(&ended);
    wait(&mut rig, 10);
    let mut held = rig.task("T1").clone();
    held.holds.insert("operator".into());
    rig.change(&held);
    wait(&mut rig, 60);
    assert_eq!((rig.task("T1").phase, reason(&rig, "T2")), (Phase::Queued, Some(Code::ScheduleToStart)));
    let mut free = rig.task("T1").clone();
    free.holds.clear();
    rig.change(&free);
    wait(&mut rig, 8);
    assert_eq!(rig.task("T1").phase, Phase::Queued);
    wait(&mut rig, 4);
    assert_eq!((rig.task("T1").phase, reason(&rig, "T1")), (Phase::NeedsOperator, Some(Code::ScheduleToStart)));
}

#[test]
fn what_no_known_robot_could_ever_do_is_a_persons_after_a_quarter_of_an_hour() {
    let mut rig = Rig::new();
    rig.submit("weld", |raw| raw.capabilities = vec!["weld".into()]);
    rig.submit("pinned", |raw| raw.robot_id = "r2".into());
    rig.submit("fine", |_| {});
    wait(&mut rig, 14);
    assert_eq!(rig.task("weld").phase, Phase::Queued);
    known(&mut rig, "r1");
    wait(&mut rig, 2);
    for id in ["weld", "pinned"] {
        assert_eq!((rig.task(id).phase, reason(&rig, id)), (Phase::NeedsOperator, Some(Code::NoKnownRobot)), "{id}");
    }
    assert_eq!(rig.task("fine").phase, Phase::Queued);
    let why = rig.task("weld").reason.clone().expect("a reason");
    assert_eq!(why.metadata.get("MISSING_CAPABILITY").map(String::as_str), Some("1"));
}

#[test]
fn nobody_says_that_no_robot_could_while_none_is_known_or_one_was_never_heard() {
    let mut rig = Rig::new();
    rig.submit("weld", |raw| raw.capabilities = vec!["weld".into()]);
    wait(&mut rig, 40);
    assert_eq!(rig.task("weld").phase, Phase::Queued, "no robot is known");
    known(&mut rig, "r1");
    let robot_id = RobotId::parse("r2").expect("an id");
    let enrolled = RobotIdentity {
        robot_id,
        key: None,
        enrolled_unix_ms: None,
        expires_unix_ms: None,
        enrolment: None,
        revoked: None,
        denied: Vec::new(),
    };
    rig.absorb(&enrolled);
    rig.submit("pinned", |raw| raw.robot_id = "r2".into());
    wait(&mut rig, 40);
    assert_eq!([rig.task("weld").phase, rig.task("pinned").phase], [Phase::Queued; 2], "r2 may be able to");
}

#[test]
fn waiting_promotes_one_class_each_quarter_of_an_hour_and_explain_says_so() {
    let mut rig = Rig::new();
    known(&mut rig, "r1");
    rig.submit("T1", |raw| raw.priority = Some(9));
    let mut classes = Vec::new();
    for _ in 0..3 {
        let told = explain::task(&rig.view, &rig.board, &rig.now, &rig.task("T1").task_id).expect("a task");
        let verdict = told.verdict.expect("it waits");
        classes.push(verdict.metadata.get("class").cloned());
        wait(&mut rig, 15);
    }
    assert_eq!(classes, [None, Some("normal".to_owned()), Some("urgent".to_owned())]);
}

#[test]
fn a_backlog_older_than_an_hour_is_one_incident_that_closes_and_opens_by_itself() {
    let mut rig = Rig::new();
    known(&mut rig, "r1");
    rig.submit("T1", |_| {});
    rig.submit("T2", |_| {});
    wait(&mut rig, 60);
    assert!(incidents(&rig).is_empty(), "not older than an hour");
    wait(&mut rig, 30);
    let open = |rig: &Rig| incidents(rig).iter().map(|i| (i.reason.code, i.closed.is_none())).collect::<Vec<_>>();
    assert_eq!(open(&rig), [(Code::TaskBacklog, true)]);
    let now = rig.now;
    let mut plan = Plan::default();
    let id = incidents(&rig)[0].id.clone();
    plan.decide(&mut rig.view, now, "anna", |tx| crate::fleet::incidents::close(tx, &id, "seen", "anna"));
    wait(&mut rig, limits::BACKLOG_PAUSE.as_ms() / MINUTE - 1);
    assert_eq!(open(&rig), [(Code::TaskBacklog, false)], "a person has seen it");
    wait(&mut rig, 1);
    assert_eq!(open(&rig), [(Code::TaskBacklog, true)]);
    for id in ["T1", "T2"] {
        let mut ended = rig.task(id).clone();
        ended.phase = Phase::Canceled;
        rig.change(&ended);
    }
    wait(&mut rig, 1);
    assert_eq!(open(&rig), [(Code::TaskBacklog, false)]);
}
