//! Robots that are refused because of what they say: people hear why, until such a robot is served again.

use super::Rig;
use crate::fleet::facts::misreads;
use crate::fleet::{Plan, explain, incidents};
use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use std::sync::Arc;

/// Telemetry has stated it, and fleet has opened the incident.
fn refused(rig: &mut Rig, robot_id: &RobotId) {
    let now = rig.now;
    let reason = Reason::new(Code::RobotNotUnderstood, "It dials and is refused: reported.mode.");
    Plan::default().decide(&mut rig.view, now, "fleet", |tx| {
        incidents::open_about(tx, reason, Some(robot_id), "");
    });
}

/// Open incidents after a look.
fn open(rig: &mut Rig) -> Vec<Code> {
    misreads::close_understood(&mut rig.view, &rig.board, rig.now, &mut Plan::default());
    let open = rig.view.incidents.values().filter(|i| i.row.closed.is_none());
    open.map(|i| i.row.reason.code).collect()
}

#[test]
fn the_incident_of_a_robot_that_is_not_understood_closes_once_it_was_served_for_a_minute() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    let robot_id = RobotId::parse("r1").expect("an id");
    Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).report.hb = 1;
    refused(&mut rig, &robot_id);
    let beat = |rig: &mut Rig| {
        rig.pass(1_000);
        let now = rig.now.site;
        Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).processed_site = now;
    };
    for _ in 2..60 {
        beat(&mut rig);
        assert_eq!(open(&mut rig), [Code::RobotNotUnderstood]);
    }
    beat(&mut rig);
    assert_eq!(open(&mut rig), []);
}

#[test]
fn heartbeats_of_before_it_was_refused_close_nothing() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    let robot_id = RobotId::parse("r1").expect("an id");
    refused(&mut rig, &robot_id);
    assert_eq!(open(&mut rig), [Code::RobotNotUnderstood], "the newest heartbeat is older");
    rig.view.sessions.get_mut("r1").expect("its row").row.session_epoch = 2;
    rig.pass(1_000);
    assert_eq!(open(&mut rig), [Code::RobotNotUnderstood], "it is of the session before");
}

#[test]
fn a_robot_that_is_refused_is_explained_by_what_was_wrong_and_not_by_its_network() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    let [heard, unheard] = ["r1", "r2"].map(|id| RobotId::parse(id).expect("an id"));
    let verdict = |rig: &Rig, robot_id| {
        let told = explain::robot(&rig.view, &rig.board, &rig.now, robot_id);
        told.map(|told| told.verdict.map(|why| (why.code, why.message)))
    };
    assert_eq!(verdict(&rig, &unheard), None, "nobody knows it");
    for robot_id in [&heard, &unheard] {
        refused(&mut rig, robot_id);
    }
    let why = (Code::RobotNotUnderstood, "It dials and is refused: reported.mode.".to_owned());
    assert_eq!(verdict(&rig, &unheard), Some(Some(why.clone())), "it never got in");
    let of_heard = verdict(&rig, &heard).flatten();
    assert!(of_heard.is_none_or(|(code, _)| code != Code::RobotNotUnderstood), "it is heard all the same");
    rig.board.clear();
    assert_eq!(verdict(&rig, &heard), Some(Some(why)));
}
