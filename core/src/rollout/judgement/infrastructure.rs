//! Whether a robot that is not heard was lost by its bundle, or whether the network is.
//!
//! Invariant: a robot counts as lost only while at least [`limits::CONTROLS_MIN`] robots that have nothing to do with
//! the change are there to compare it with, and most of them are heard.

use crate::fleet::Board;
use crate::fleet::liveness;
use crate::ids::RobotId;
use crate::limits;
use crate::presence::Presence;
use crate::robot::Duty;
use crate::rollout::projection::rows::{Pause, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;
use crate::time::{LinkTime, Now, Utc};
use std::collections::BTreeMap;

/// The robot runs the bundle, or may, and is not heard for too long. After the gate of its wave that is not the
/// bundle's matter.
pub fn is_missing(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout, r: &RolloutRobot) -> bool {
    let watched = match r.step {
        Step::Activating => r.grant.is_some(),
        Step::Trial => is_open_to(rollout, r),
        _ => false,
    };
    watched && now.link.since(last_heard(view, board, &r.robot_id)) >= limits::LOST_AFTER
}

/// Milliseconds of link time since a robot was heard last.
pub fn silent_ms(view: &RolloutProjection, board: &Board, now: &Now, robot_id: &RobotId) -> u64 {
    now.link.since(last_heard(view, board, robot_id)).as_ms()
}

/// When a robot was heard last. After a start everybody counts as heard at that moment.
fn last_heard(view: &RolloutProjection, board: &Board, robot_id: &RobotId) -> LinkTime {
    board.get(robot_id).map_or(view.started.link, |live| live.processed_at.max(view.started.link))
}

/// Whether a heartbeat of the robot came since then, UTC on the site clock.
pub fn is_heard_since(board: &Board, now: &Now, robot_id: &RobotId, since: Utc) -> bool {
    let silent = board.get(robot_id).map(|live| now.site.since(live.processed_site));
    silent.is_some_and(|silent| silent.as_ms() <= now.ms_since(since))
}

/// The gate of its wave has not closed.
pub fn is_open_to(rollout: &Rollout, r: &RolloutRobot) -> bool {
    r.wave >= rollout.promoted
}

/// Whether robots beside this one kept contact while it was missed: those of its area, or of the site if those are too
/// few.
///
/// # Errors
/// Why the roll-out has to stand still instead.
pub fn check_controls(view: &RolloutProjection, board: &Board, now: &Now, r: &RolloutRobot) -> Result<(), Pause> {
    let area = view.software.get(r.robot_id.as_str()).and_then(|s| s.row.area.as_ref());
    let all: Vec<&RobotId> =
        view.sessions.values().map(|s| &s.row.robot_id).filter(|id| is_control(view, board, r, id)).collect();
    let here = |id: &&RobotId| view.software.get(id.as_str()).and_then(|s| s.row.area.as_ref()) == area;
    let near: Vec<&RobotId> = all.iter().copied().filter(here).collect();
    let controls = if near.len() < limits::CONTROLS_MIN { all } else { near };
    if controls.len() < limits::CONTROLS_MIN {
        return Err(Pause::InfrastructureUnknown);
    }
    let heard = controls.iter().filter(|id| keeps_contact(view, board, now, id)).count();
    if heard * 1_000 >= controls.len() * limits::CONTROLS_HEARD_PERMILLE { Ok(()) } else { Err(Pause::Infrastructure) }
}

/// It is heard, and was without a break for as long as a robot has to be missed to be lost, but for the time that it
/// may take to come back after a start. Whoever came back a moment ago was missed too: the network is back, and the
/// missing robot may be about to be.
fn keeps_contact(view: &RolloutProjection, board: &Board, now: &Now, robot_id: &RobotId) -> bool {
    let long_ms = limits::LOST_AFTER.as_ms() - limits::OFFLINE_AFTER.as_ms();
    let unbroken = view.contacts.get(robot_id).is_some_and(|c| now.link.since(c.since).as_ms() >= long_ms);
    unbroken && liveness::presence(board, robot_id, now) != Presence::Offline
}

/// It changes nothing now, and was in contact when the robot was heard last: one in a store room says nothing of the
/// network.
fn is_control(view: &RolloutProjection, board: &Board, missing: &RolloutRobot, robot_id: &RobotId) -> bool {
    let since = last_heard(view, board, &missing.robot_id);
    let kept = board.get(robot_id).is_some_and(|live| since.since(live.processed_at) < limits::OFFLINE_AFTER);
    let changes = view.rows_of_robot(robot_id).any(|r| r.step == Step::Activating);
    kept && !changes && *robot_id != missing.robot_id && view.duty(robot_id) != Duty::Retired
}

/// Why a roll-out has to stand still: robots of it are missing, and so are others.
pub fn find_pause(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout) -> Option<Pause> {
    let missing = view.robots_of(&rollout.rollout_id).filter(|r| is_missing(view, board, now, rollout, r));
    // One of each area stands for all that are missing there.
    let area = |r: &RolloutRobot| view.software.get(r.robot_id.as_str()).and_then(|s| s.row.area.clone());
    let by_area: BTreeMap<_, _> = missing.map(|r| (area(r), r)).collect();
    by_area.values().find_map(|r| check_controls(view, board, now, r).err())
}
