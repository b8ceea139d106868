//! Tells people of robots that have stood for long because of what only a person ends: their own stop, manual mode, a fault, the
//! breaker.
//!
//! Called once a sweep. Invariants:
//! 1. An incident of these closes by itself once it is over: the robot is heard and says so, or the breaker was reset.
//! 2. How long something lasts before it is an incident is said by the rules of the area in which the robot is.
//! 3. An incident that a person closes while it goes on is told again after as long.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::eligibility;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::robot::{FaultClass, HardwareStop, Mode, ReportedState};
use crate::time::{LinkDuration, Now};
use std::collections::BTreeSet;

/// What is looked at.
const CODES: [Code; 4] = [Code::RobotStopped, Code::RobotManual, Code::RobotFault, Code::RobotBreakerOpened];

/// What a robot says of itself that only a person at the robot ends.
fn list_own_reasons(report: &ReportedState) -> Vec<Reason> {
    let stop =
        (report.hardware_stop != HardwareStop::None).then(|| eligibility::stopped_by_itself(report.hardware_stop));
    let manual = (report.mode != Mode::Automatic).then(|| Reason::from(Code::RobotManual));
    let fault = report.fault.as_ref().filter(|fault| fault.class != FaultClass::Recoverable);
    let fault = fault.map(|fault| Reason::from(Code::RobotFault).with("fault_code", fault.code));
    [stop, manual, fault].into_iter().flatten().collect()
}

/// The breaker of a robot, if it is open.
fn breaker(view: &FleetProjection, robot_id: &RobotId) -> Option<Reason> {
    let control = view.control.get(robot_id.as_str()).map(|c| &c.row).filter(|c| c.breaker.is_some())?;
    Some(Reason::from(Code::RobotBreakerOpened).with("failures", control.failures.len()))
}

/// How long something lasts before people are told of it, where the robot is.
fn patience(view: &FleetProjection, live: Option<&NewestHeartbeat>) -> LinkDuration {
    let area = live.and_then(|live| live.area(&view.site));
    area.map_or(limits::LASTS_BEFORE_INCIDENT, |area| LinkDuration(view.policy(area).incident_after_ms))
}

/// Opens what has lasted long enough, and closes what is over.
pub(in crate::fleet) fn tell_lasting(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) {
    let mut before = std::mem::take(&mut view.lasting);
    let open: BTreeSet<(RobotId, Code)> = view
        .incidents
        .values()
        .map(|i| &i.row)
        .filter(|i| i.closed.is_none() && CODES.contains(&i.reason.code))
        .filter_map(|i| Some((i.robot_id.clone()?, i.reason.code)))
        .collect();
    let broken_off = view.control.values().map(|c| &c.row).filter(|c| c.breaker.is_some()).map(|c| &c.robot_id);
    let says_any = |live: &NewestHeartbeat| !list_own_reasons(&live.report).is_empty();
    let out_of_work = board.iter().filter(|(_, live)| says_any(live)).map(|(robot_id, _)| robot_id);
    let robots: BTreeSet<RobotId> =
        out_of_work.chain(broken_off).chain(open.iter().map(|(robot_id, _)| robot_id)).cloned().collect();
    for robot_id in &robots {
        let live = board.get(robot_id);
        // Of what a robot says of itself nobody knows, while it is not heard, that it goes on, nor that it is over.
        let is_heard = liveness::presence(board, robot_id, &now) == Presence::Online;
        let is_known = |code: Code| is_heard || code == Code::RobotBreakerOpened;
        let said = live.map(|live| list_own_reasons(&live.report)).unwrap_or_default();
        for reason in said.into_iter().chain(breaker(view, robot_id)) {
            let key = (robot_id.clone(), reason.code);
            let since = before.remove(&key).filter(|_| !open.contains(&key)).unwrap_or(now.link);
            let lasts = || now.link.since(since) >= patience(view, live.map(AsRef::as_ref));
            if is_known(reason.code) && !open.contains(&key) && lasts() {
                plan.decide(view, now, "fleet", |tx| {
                    incidents::open_about(tx, reason, Some(robot_id), "");
                });
            }
            view.lasting.insert(key, since);
        }
        for code in CODES.into_iter().filter(|code| is_known(*code)) {
            let key = (robot_id.clone(), code);
            if open.contains(&key) && !view.lasting.contains_key(&key) {
                plan.decide(view, now, "fleet", |tx| incidents::close_about(tx, code, robot_id, over(code)));
            }
        }
    }
}

/// Why an incident closes by itself.
const fn over(code: Code) -> &'static str {
    match code {
        Code::RobotBreakerOpened => "the breaker was reset",
        _ => "the robot says that it is over",
    }
}
