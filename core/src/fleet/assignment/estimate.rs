//! How long what a robot does will still take, as far as one can tell.
//!
//! Called by the planner `rolling` and by drains. Reads only.

use crate::energy;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::traffic::routing;
use crate::heartbeat::NewestHeartbeat;
use crate::site::WaypointIx;
use crate::step::StepKind;
use crate::task::TaskIntake;

/// Speed of a robot on its way, millimetres per second: that of a grid's cells.
pub const USUAL_MM_S: u64 = crate::site::grid::SPEED_MM_S as u64;

/// What is left of a task.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rest {
    /// Millimetres to drive.
    pub way_mm: u64,
    /// Actions to do.
    pub actions: u64,
    /// Milliseconds to wait, in steps that wait.
    pub waits_ms: u64,
    /// Where it ends; none: nobody knows.
    pub ends_at: Option<WaypointIx>,
}

impl Rest {
    /// Of a task whose robot is at this step.
    pub fn of_task(view: &FleetProjection, intake: &TaskIntake, step: usize, live: &NewestHeartbeat) -> Self {
        let mut rest = Self::default();
        for step in intake.spec.steps.iter().skip(step) {
            match &step.kind {
                StepKind::Goto { .. } => {}
                StepKind::Wait { duration_ms } => rest.waits_ms += duration_ms,
                StepKind::Action { .. } => rest.actions += 1,
            }
        }
        let goals: Option<Vec<_>> = intake.spec.goals(step).map(|goal| view.site.find(goal)).collect();
        let here = routing::find(view, live.report.vitals.waypoint.as_ref());
        let legs = here.zip(goals.as_ref()).and_then(|(here, goals)| routing::legs_mm(view, here, goals));
        if let (Some(legs), Some(goals)) = (legs, goals) {
            rest.way_mm = legs.iter().sum();
            rest.ends_at = goals.last().copied().or(here);
        }
        rest
    }

    /// Milliseconds of site time that it usually takes, unless something is in the way.
    pub fn usual_ms(&self) -> u64 {
        self.way_mm * 1_000 / USUAL_MM_S + self.actions * energy::HANDLE.as_ms() + self.waits_ms
    }
}
