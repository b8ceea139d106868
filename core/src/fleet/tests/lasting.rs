//! What lasts is told to a person, and closes by itself.

use super::Rig;
use crate::fleet::explanation::lasting;
use crate::fleet::projection::RevisedRow;
use crate::fleet::rows::RobotControl;
use crate::fleet::{Plan, incidents};
use crate::ids::RobotId;
use crate::policy::AreaPolicy;
use crate::reason::Code;
use crate::robot::{FAULT_JAM, Fault, FaultClass, HardwareStop, Mode, ReportedState};
use crate::rows::{Record, Revision};
use std::sync::Arc;

/// A change of what a robot says.
type Change<'a> = &'a dyn Fn(&mut ReportedState);

/// Open incidents after so many seconds.
fn open_after(rig: &mut Rig, secs: u64) -> Vec<Code> {
    let mut plan = Plan::default();
    for _ in 0..secs {
        rig.pass(1_000);
        lasting::tell_lasting(&mut rig.view, &rig.board, rig.now, &mut plan);
    }
    let open = rig.view.incidents.values().filter(|i| i.row.closed.is_none());
    open.map(|i| i.row.reason.code).collect()
}

#[test]
fn a_stop_manual_mode_and_a_jam_that_last_a_minute_are_incidents_until_they_are_over() {
    let jam = Fault { code: FAULT_JAM, class: FaultClass::Mechanical, message: String::new() };
    let says: [(Code, Change<'_>); 3] = [
        (Code::RobotStopped, &|report| report.hardware_stop = HardwareStop::Manual),
        (Code::RobotManual, &|report| report.mode = Mode::Manual),
        (Code::RobotFault, &|report| report.fault = Some(jam.clone())),
    ];
    for (code, change) in says {
        let mut rig = Rig::new();
        rig.robot("r1", "park-a");
        let robot_id = RobotId::parse("r1").expect("an id");
        let well = rig.board[&robot_id].report.clone();
        change(&mut Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).report);
        assert_eq!(open_after(&mut rig, 60), [], "{code}");
        assert_eq!(open_after(&mut rig, 1), [code]);
        assert_eq!(open_after(&mut rig, 60), [code], "once");
        Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).report = well;
        assert_eq!(open_after(&mut rig, 1), [], "{code} closes by itself");
    }
}

/// The rules of the area in which everything stands.
fn told_after(rig: &mut Rig, incident_after_ms: u64) {
    let area_id = rig.view.site.areas()[0].area_id.clone();
    let row = AreaPolicy { incident_after_ms, ..AreaPolicy::default_of(area_id) };
    rig.view.policies.insert(row.id().into(), RevisedRow { revision: Revision(1), row });
}

#[test]
fn the_rules_of_an_area_say_how_long_something_lasts_before_people_are_told() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    told_after(&mut rig, 5_000);
    let robot_id = RobotId::parse("r1").expect("an id");
    Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).report.mode = Mode::Manual;
    assert_eq!(open_after(&mut rig, 5), []);
    assert_eq!(open_after(&mut rig, 1), [Code::RobotManual]);
    let mut other = Rig::new();
    other.robot("r1", "park-a");
    told_after(&mut other, 600_000);
    Arc::make_mut(other.board.get_mut(&robot_id).expect("a robot")).report.mode = Mode::Manual;
    assert_eq!(open_after(&mut other, 600), []);
    assert_eq!(open_after(&mut other, 1), [Code::RobotManual]);
}

#[test]
fn an_open_breaker_is_an_incident_until_it_is_reset_also_while_the_robot_is_not_heard() {
    let mut rig = Rig::new();
    let robot_id = RobotId::parse("r1").expect("an id");
    let row = RobotControl { breaker: Some(rig.now.utc), ..RobotControl::new(robot_id.clone()) };
    rig.view.control.insert(row.id().into(), RevisedRow { revision: Revision(1), row });
    assert_eq!(open_after(&mut rig, 60), []);
    assert_eq!(open_after(&mut rig, 1), [Code::RobotBreakerOpened]);
    rig.view.control.get_mut("r1").expect("its row").row.breaker = None;
    assert_eq!(open_after(&mut rig, 1), [], "it closes by itself");
}

#[test]
fn what_goes_on_after_a_person_closed_its_incident_is_told_again_after_as_long() {
    let mut rig = Rig::new();
    rig.robot("r1", "park-a");
    let robot_id = RobotId::parse("r1").expect("an id");
    Arc::make_mut(rig.board.get_mut(&robot_id).expect("a robot")).report.mode = Mode::Manual;
    assert_eq!(open_after(&mut rig, 120), [Code::RobotManual]);
    let id = rig.view.incidents.keys().next().expect("an incident").to_string();
    let now = rig.now;
    Plan::default().decide(&mut rig.view, now, "anna", |tx| incidents::close(tx, &id, "seen", "anna"));
    assert_eq!(open_after(&mut rig, 59), []);
    assert_eq!(open_after(&mut rig, 3), [Code::RobotManual]);
}
