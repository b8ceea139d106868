//! Hold tokens of robots: the maker's own stop makes one, and the task of a robot hears when the first comes and the last goes.
//!
//! Invariant: a token that stands for a released stop is taken away by a person only.

use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::{HoldToken, RobotControl};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::{self, News, apply_event};
use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use crate::robot::HardwareStop;
use crate::task::Event;

/// Token while the body's own safety system stops it.
pub fn stop_token(robot_id: &RobotId) -> String {
    format!("stop:body:{robot_id}")
}

/// Token after that, until a person resumes.
pub fn resume_token(robot_id: &RobotId) -> String {
    format!("resume:body:{robot_id}")
}

/// The maker's stop makes a hold token of the robot; its release turns that into one that only a person takes away.
pub fn apply_hardware_stop(tx: &mut Tx, robot_id: &RobotId, stop: HardwareStop) {
    let (stopped, resume) = (stop_token(robot_id), resume_token(robot_id));
    let stands = tx.view.holds.contains_key(HoldToken::id_of(robot_id, &stopped).as_str());
    let since = tx.now.utc;
    if stop != HardwareStop::None && !stands {
        tx.delete::<HoldToken>(&HoldToken::id_of(robot_id, &resume), "hold.replaced");
        tx.put_row(HoldToken { robot_id: robot_id.clone(), token: stopped, since }, "hold.stopped");
        touch(tx, robot_id);
        holds_changed(tx, robot_id);
    } else if stop == HardwareStop::None && stands {
        tx.delete::<HoldToken>(&HoldToken::id_of(robot_id, &stopped), "hold.released");
        tx.put_row(HoldToken { robot_id: robot_id.clone(), token: resume, since }, "hold.awaits_resume");
    }
}

/// Every offer writes the robot's control row: one that was planned without the token that has just come is lost.
pub(in crate::fleet) fn touch(tx: &mut Tx, robot_id: &RobotId) {
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    tx.put_row(known.unwrap_or_else(|| RobotControl::new(robot_id.clone())), "robot.held");
}

/// Tells the robot's task that a token came or that the last one went.
pub fn holds_changed(tx: &mut Tx, robot_id: &RobotId) {
    tx.view.dirty.insert(robot_id.clone());
    let Some(task_id) = tx.view.held_by(robot_id).and_then(|a| a.subject.task_id().cloned()) else { return };
    let Some(task) = tx.view.task(&task_id).cloned() else { return };
    if !transitions::go_on_unless_held(tx, &task) {
        let why = why_held(tx.view, robot_id);
        apply_event(tx, &task_id, News::from_event(Event::Hold, why.as_ref()));
    }
}

/// Why a robot is held: by a fleet stop, or by its own safety system. None: no token of it stands.
pub(super) fn why_held(view: &FleetProjection, robot_id: &RobotId) -> Option<Reason> {
    let is_own = |h: &HoldToken| h.token == stop_token(robot_id) || h.token == resume_token(robot_id);
    let mut tokens = view.robot_holds(robot_id).peekable();
    tokens.peek()?;
    Some(if tokens.any(is_own) { Code::HoldByBody } else { Code::HoldByStop }.into())
}
