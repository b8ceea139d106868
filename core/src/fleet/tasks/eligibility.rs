//! What keeps a robot from a task and does not pass by itself: a person's decision, the robot's own state, its pins and its abilities.
//!
//! Called by the filters, by the task table and by whoever asks whether any robot could ever do a task. Reads only.

use super::load;
use crate::fleet::decision::slice::Slice;
use crate::fleet::projection::rows::RobotControl;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use crate::robot::{Duty, FaultClass, HardwareStop, Mode, StopLevel};
use crate::session::Session;
use crate::task::raw::parse_version;
use crate::task::{TaskIntake, TaskState};
use std::collections::BTreeMap;

pub(in crate::fleet) fn decided_by_people(
    view: &FleetProjection,
    robot_id: &RobotId,
    live: Option<&NewestHeartbeat>,
) -> Result<(), Reason> {
    if let Some(control) = view.control.get(robot_id.as_str()).map(|c| &c.row) {
        match control.duty() {
            Duty::InWork => {}
            Duty::Cordoned => {
                let why = control.cordon.as_ref().map(|c| c.reason.clone()).unwrap_or_default();
                return Err(Reason::from(Code::RobotCordoned).with("cordon", why));
            }
            Duty::BrokenOff => return Err(Code::RobotBrokenOff.into()),
            Duty::Retired => return Err(Code::SkippedRetired.into()),
        }
    }
    if let Some(drain) = view.drain_of(robot_id)
        && !live.is_some_and(|live| load::may_end_its_task(view, drain, live))
    {
        return Err(Reason::from(Code::RobotDraining).with("drain_id", &drain.drain_id));
    }
    match view.robot_holds(robot_id).next() {
        Some(hold) => Err(Reason::from(Code::RobotHeld).with("token", &hold.token)),
        None => Ok(()),
    }
}

/// What a robot says of itself that keeps it from work.
pub(in crate::fleet) fn reported(live: &NewestHeartbeat) -> Result<(), Reason> {
    let r = &live.report;
    if r.mode != Mode::Automatic {
        return Err(Code::RobotManual.into());
    }
    if r.hardware_stop != HardwareStop::None {
        return Err(stopped_by_itself(r.hardware_stop));
    }
    if r.stop_level >= StopLevel::Halt {
        return Err(Code::RobotStopped.into());
    }
    match &r.fault {
        Some(fault) if fault.class != FaultClass::Recoverable => {
            Err(Reason::from(Code::RobotFault).with("fault_code", fault.code))
        }
        _ => Ok(()),
    }
}

/// What does not pass by itself: pin, binding, what the robot refused or failed for good, and what it said of itself at its last Hello.
pub(in crate::fleet) fn fits(
    view: &FleetProjection,
    session: &Session,
    task: &TaskState,
    intake: &TaskIntake,
) -> Result<(), Reason> {
    bound(&session.robot_id, task, intake)?;
    able(view, session, intake)
}

/// Whether another robot than this one could do the task, apart from its other work: it is heard, nothing that people
/// decided keeps it from work, and it has not failed the task.
pub(in crate::fleet) fn another_could(
    view: &FleetProjection,
    task: &TaskState,
    intake: &TaskIntake,
    robot_id: &RobotId,
) -> bool {
    let is_at_work = |id: &RobotId| {
        let is_heard = view.attached.get(id).is_some_and(|attached| attached.is_heard);
        is_heard && decided_by_people(view, id, None).is_ok()
    };
    let sessions = view.sessions.values().map(|session| &session.row);
    let mut others = sessions.filter(|s| s.robot_id != *robot_id && !task.failed_robots.contains(&s.robot_id));
    others.any(|other| is_at_work(&other.robot_id) && fits(view, other, task, intake).is_ok())
}

/// Whether the task itself leaves the robot out, whatever it can do.
pub(in crate::fleet) fn bound(robot_id: &RobotId, task: &TaskState, intake: &TaskIntake) -> Result<(), Reason> {
    let spec = &intake.spec;
    if task.pinned_robot(intake).is_some_and(|r| r != robot_id) {
        return Err(Code::RobotPinnedElsewhere.into());
    }
    if task.opened_robot_id.as_ref().is_some_and(|r| r != robot_id) {
        return Err(Code::BoundElsewhere.into());
    }
    if task.semantic_refusers.contains(robot_id) {
        return Err(Code::UnsupportedAction.into());
    }
    if spec.retry.exclude_failed_robot && task.opened_robot_id.is_none() && task.failed_robots.contains(robot_id) {
        return Err(Code::ExcludedAfterFailure.into());
    }
    Ok(())
}

/// Whether any known robot could ever do the task; each that is looked at is a look of the slice. Of a robot that is enrolled and has never
/// connected nobody knows what it can do. While no robot is known, nobody knows either.
///
/// # Errors
/// Why not, with how many robots each reason leaves out.
pub(in crate::fleet) fn could_ever(
    view: &FleetProjection,
    task: &TaskState,
    intake: &TaskIntake,
    slice: &mut Slice,
) -> Result<(), Reason> {
    let retired = |id: &str| view.control.get(id).is_some_and(|control| control.row.duty() == Duty::Retired);
    let mut against: BTreeMap<Code, u64> = BTreeMap::new();
    for session in view.sessions.iter().filter(|(id, _)| !retired(id)).map(|(_, session)| &session.row) {
        slice.count_looks(1);
        match fits(view, session, task, intake) {
            Ok(()) => return Ok(()),
            Err(reason) => *against.entry(reason.code).or_default() += 1,
        }
    }
    let unheard = view.enrolled.iter().filter(|(id, _)| !view.sessions.contains_key(*id) && !retired(id));
    for robot in unheard.map(|(_, robot)| &robot.row).filter(|robot| robot.revoked.is_none()) {
        slice.count_looks(1);
        match bound(&robot.robot_id, task, intake) {
            Ok(()) => return Ok(()),
            Err(reason) => *against.entry(reason.code).or_default() += 1,
        }
    }
    if against.is_empty() {
        return Ok(());
    }
    let reason = Reason::from(Code::NoKnownRobot);
    Err(against.into_iter().fold(reason, |reason, (code, robots)| reason.with(code.as_str(), robots)))
}

pub(in crate::fleet) fn able(view: &FleetProjection, session: &Session, intake: &TaskIntake) -> Result<(), Reason> {
    let spec = &intake.spec;
    let has = |c: &str| session.inventory.capabilities.iter().any(|h| h == c);
    let wanted = spec.actions().into_iter().chain(spec.selector.capabilities.iter().map(String::as_str));
    if let Some(missing) = wanted.into_iter().find(|c| !has(c)) {
        return Err(Reason::from(Code::MissingCapability).with("capability", missing));
    }
    let control = view.control.get(session.robot_id.as_str()).map(|c| &c.row);
    let label = |key: &str| RobotControl::label(control, &session.inventory, key);
    if spec.selector.labels.iter().any(|(key, value)| label(key) != Some(value.as_str())) {
        return Err(Code::LabelMismatch.into());
    }
    if spec.selector.payload_g > session.inventory.payload_g {
        return Err(Reason::from(Code::PayloadTooHeavy).with("payload_g", session.inventory.payload_g));
    }
    let least = spec.selector.minimum_software.as_deref().and_then(parse_version);
    if least.is_some_and(|least| parse_version(&session.inventory.software).is_none_or(|has| has < least)) {
        return Err(Reason::from(Code::SoftwareTooOld).with("software", &session.inventory.software));
    }
    Ok(())
}

/// What a robot's own safety system says, in words.
pub fn stopped_by_itself(stop: HardwareStop) -> Reason {
    let told = match stop {
        HardwareStop::AutoAck => {
            "The robot's own safety system stopped it; that ends by itself once its field is free."
        }
        HardwareStop::Remote => "The robot's own safety system was stopped from a remote device. Reset it there.",
        HardwareStop::Manual | HardwareStop::None => {
            "The robot's own safety system stopped it. Look at the robot and reset it there."
        }
    };
    Reason::new(Code::RobotStopped, told).with("hardware_stop", format!("{stop:?}"))
}
