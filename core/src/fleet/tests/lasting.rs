//! What lasts is told to a person, and closes by itself.

use super::Rig;
use crate::fleet::{Plan, lasting};
use crate::ids::RobotId;
use crate::reason::Code;
use crate::robot::{FAULT_JAM, Fault, FaultClass, HardwareStop, Mode, ReportedState};
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
