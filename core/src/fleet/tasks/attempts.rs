//! Attempts as they begin: the record, the robot's mutex, and the steps that an errand stands for. Reads and writes attempts only.

use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::{RobotAuthority, RobotHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{AttemptId, RobotId};
use crate::robot_events::WorkStats;
use crate::step::{Effect, StepKind, WorkStep};
use crate::task::state::{Errand, VisitedPlaces};
use crate::task::{Attempt, AttemptPhase};
use crate::time::SiteDuration;

/// Longest errand; a charge ends long before. Site clock.
pub const ERRAND_TIMEOUT: SiteDuration = SiteDuration::from_secs(4 * 3600);

/// Steps done of an errand whose robot stands at its goal.
pub const AT_GOAL: u32 = 1;

/// Steps of an errand: drive to its goal, then charge or park.
pub fn steps(view: &FleetProjection, a: &Attempt) -> Vec<WorkStep> {
    let Some(goal) = &a.goal else { return Vec::new() };
    let mut params = serde_json::Map::new();
    let name = match a.errand {
        Some(Errand::Charge) => {
            let area = view.site.find(goal).map(|at| view.site.area_of(at).area_id.clone());
            let stop = area.map_or(900, |area| view.policy(&area).charge_stop_permille);
            params.insert("stop_permille".to_owned(), stop.into());
            "charge"
        }
        _ => "park",
    };
    let step = |kind| WorkStep {
        kind,
        effect: Effect::Repeatable,
        pause_allowed: true,
        cancel_allowed: true,
        timeout_ms: None,
        continue_on_fail: false,
    };
    vec![step(StepKind::Goto { waypoint: goal.clone() }), step(StepKind::Action { name: name.to_owned(), params })]
}

/// A new attempt of a robot, not yet written.
pub fn fresh_attempt(tx: &Tx, attempt: AttemptId, robot_id: &RobotId, offer: crate::authority::Authority) -> Attempt {
    let session = tx.view.sessions.get(robot_id.as_str()).map(|s| &s.row);
    let software = session.map(|s| s.inventory.software.clone()).unwrap_or_default();
    let of_task = session.filter(|_| attempt.subject.task_id().is_some());
    let visited = of_task.map(|s| VisitedPlaces { ring: s.ring.clone(), ..VisitedPlaces::default() });
    Attempt {
        attempt,
        robot_id: robot_id.clone(),
        errand: None,
        goal: None,
        phase: AttemptPhase::Offered,
        uncertain: None,
        offer,
        step_index: 0,
        reported: None,
        is_opened: false,
        offered: tx.now.utc,
        accepted: None,
        ended: None,
        fault: None,
        refusal: None,
        stats: WorkStats::default(),
        software,
        visited,
    }
}

/// Notes how far the robot's report says that the attempt is.
pub(in crate::fleet) fn note_step(a: &mut Attempt, step_index: u32) {
    a.step_index = a.step_index.max(step_index);
    a.reported = a.reported.max(Some(step_index));
}

/// Takes the robot's mutex for an attempt: the update of one row that two planners cannot both make.
pub fn take_robot(tx: &mut Tx, a: &Attempt) {
    tx.put_row(
        RobotAuthority { robot_id: a.robot_id.clone(), holder: RobotHolder::Attempt(a.attempt.clone()) },
        "robot.taken",
    );
}
