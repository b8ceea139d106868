//! Whether a robot on trial that stands with its work is jammed by its bundle, or stands as the others do.
//!
//! Invariant: it is blamed only while at least [`limits::CONTROLS_MIN`] robots that do not try this bundle have work
//! too, and most of them get on with it. Whom a stop, a person or its own safety system holds is not jammed, nor who
//! stands for a place that it was not given.

use super::infrastructure::is_open_to;
use crate::fleet::Board;
use crate::fleet::liveness;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::limits;
use crate::presence::Presence;
use crate::robot::WorkState;
use crate::robot::{HardwareStop, Mode, StopLevel};
use crate::rollout::projection::rows::{Rollout, RolloutRobot};
use crate::rollout::projection::state::RolloutProjection;
use crate::time::{Now, SiteDuration};

/// Whether the bundle has jammed a robot on trial whose gate is open.
pub fn is_blamed(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout, r: &RolloutRobot) -> bool {
    let long = r.moments.on_trial.is_some_and(|at| now.ms_since(at) >= limits::JAMMED_AFTER.as_ms());
    let waited = view.control.get(r.robot_id.as_str()).and_then(|control| control.row.waited_for_place);
    let since_wait = |stood: SiteDuration| waited.map_or(stood, |at| stood.min(SiteDuration(now.ms_since(at))));
    let stood = stood(view, board, now, &r.robot_id).map(since_wait);
    let stands = long && is_open_to(rollout, r) && stood.is_some_and(is_long);
    stands && others_get_on(view, board, now, rollout, r)
}

fn is_long(stood: SiteDuration) -> bool {
    stood >= limits::JAMMED_AFTER
}

/// How long a robot has stood with work that it may do. None: it has none, is not heard, or something else holds it.
fn stood(view: &RolloutProjection, board: &Board, now: &Now, robot_id: &RobotId) -> Option<SiteDuration> {
    let live = board.get(robot_id).filter(|_| liveness::presence(board, robot_id, now) != Presence::Offline)?;
    let is_on_its_way =
        |state: WorkState| matches!(state, WorkState::Accepted | WorkState::Navigating | WorkState::Executing);
    let has_work = live.report.attempts.iter().any(|a| is_on_its_way(a.state));
    // Before the start of the service nobody watched.
    let since = live.progress_at.max(view.started.site);
    (has_work && !is_held(live)).then(|| now.site.since(since))
}

fn is_held(live: &NewestHeartbeat) -> bool {
    let report = &live.report;
    let by_stop =
        report.stop_level != StopLevel::None || !report.stops.is_empty() || !report.awaiting_resume.is_empty();
    by_stop || report.hardware_stop != HardwareStop::None || report.field_violation || report.mode != Mode::Automatic
}

/// Most robots with work that do not try this bundle get on: those of its area, or of the site if those are too few.
fn others_get_on(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout, r: &RolloutRobot) -> bool {
    let area = |id: &RobotId| view.software.get(id.as_str()).and_then(|s| s.row.area.as_ref());
    let tries = |id: &RobotId| view.robot_of(&rollout.rollout_id, id).is_some_and(|other| other.step.is_active());
    let others = board.keys().filter(|id| **id != r.robot_id && !tries(id));
    let working: Vec<(&RobotId, SiteDuration)> =
        others.filter_map(|id| Some((id, stood(view, board, now, id)?))).collect();
    let near: Vec<SiteDuration> =
        working.iter().filter(|(id, _)| area(id) == area(&r.robot_id)).map(|(_, stood)| *stood).collect();
    let controls: Vec<SiteDuration> = match near.len() < limits::CONTROLS_MIN {
        true => working.into_iter().map(|(_, stood)| stood).collect(),
        false => near,
    };
    let get_on = controls.iter().filter(|stood| !is_long(**stood)).count();
    controls.len() >= limits::CONTROLS_MIN && get_on * 1_000 >= controls.len() * limits::CONTROLS_HEARD_PERMILLE
}
