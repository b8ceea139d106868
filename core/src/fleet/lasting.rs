//! Tells people of robots that have stood for long because of what only a person at the robot ends: its own stop, manual mode, a fault.
//!
//! Called once a sweep. Invariant: an incident of these closes by itself once the robot is heard and says that it is over.

use super::view::View;
use super::{Board, Plan, heard, incidents, standing};
use crate::ids::RobotId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::{FaultClass, HardwareStop, Mode, Presence, ReportedState};
use crate::time::{LinkTime, Now};
use std::collections::BTreeMap;

/// What lasts, by robot and code, since when, link clock. Volatile.
pub type Lasting = BTreeMap<(RobotId, Code), LinkTime>;

/// What is looked at.
const CODES: [Code; 3] = [Code::RobotStopped, Code::RobotManual, Code::RobotFault];

/// What a robot says of itself that only a person at the robot ends.
fn said(report: &ReportedState) -> Vec<Reason> {
    let stop = (report.hardware_stop != HardwareStop::None).then(|| standing::stopped_by_itself(report.hardware_stop));
    let manual = (report.mode != Mode::Automatic).then(|| Reason::from(Code::RobotManual));
    let fault = report.fault.as_ref().filter(|fault| fault.class != FaultClass::Recoverable);
    let fault = fault.map(|fault| Reason::from(Code::RobotFault).with("fault_code", fault.code));
    [stop, manual, fault].into_iter().flatten().collect()
}

/// Opens what has lasted long enough, and closes what is over.
pub(super) fn tell_lasting(view: &mut View, board: &Board, now: Now, plan: &mut Plan) {
    let mut before = std::mem::take(&mut view.lasting);
    let open: Vec<(RobotId, Code)> = view
        .incidents
        .values()
        .map(|i| &i.row)
        .filter_map(|i| {
            let is_ours = i.closed.is_none() && CODES.contains(&i.reason.code);
            i.robot_id.clone().filter(|_| is_ours).map(|robot_id| (robot_id, i.reason.code))
        })
        .collect();
    for (robot_id, live) in board {
        // Of a robot that is not heard nobody knows that it goes on, nor that it is over.
        let is_heard = heard::presence(board, robot_id, &now) == Presence::Online;
        for reason in said(&live.report) {
            let key = (robot_id.clone(), reason.code);
            let since = before.remove(&key).unwrap_or(now.link);
            if now.link.since(since) >= limits::LASTS_BEFORE_INCIDENT && is_heard && !open.contains(&key) {
                plan.decide(view, now, "fleet", |tx| {
                    incidents::open_about(tx, reason, Some(robot_id), "");
                });
            }
            view.lasting.insert(key, since);
        }
        for (_, code) in open.iter().filter(|(of, _)| of == robot_id && is_heard) {
            if !view.lasting.contains_key(&(robot_id.clone(), *code)) {
                plan.decide(view, now, "fleet", |tx| {
                    incidents::close_about(tx, *code, robot_id, "the robot says that it is over")
                });
            }
        }
    }
}
