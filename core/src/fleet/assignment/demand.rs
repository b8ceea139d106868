//! What is left of a task, looked up once for all robots that are held against it.
//!
//! Made by whoever asks `filters`. Reads only. Invariant: nothing in it depends on a robot.

use crate::energy::{RobotEnergy, Trip};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::traffic::routing;
use crate::ids::WaypointId;
use crate::reason::{Code, Reason};
use crate::site::WaypointIx;
use crate::site::route::DistanceField;
use crate::step::{self, StepKind};
use crate::task::{TaskIntake, TaskState};
use std::sync::Arc;

/// What is left of a task.
pub struct Demand<'a> {
    /// The task as it stands.
    pub task: &'a TaskState,
    /// What was asked.
    pub intake: &'a TaskIntake,
    /// Where its robot has to go; none: the map has lost a goal.
    goals: Option<Vec<WaypointIx>>,
    /// The way to the first goal around closed places.
    first: Option<Arc<DistanceField>>,
    /// Millimetres from each goal to the next; none: no way leads there.
    onward_mm: Option<Vec<u64>>,
    /// Millimetres from the last goal to the nearest charger, on a site that has some; none: no way leads to any.
    home_mm: Option<u64>,
}

impl<'a> Demand<'a> {
    /// Of a task and what was asked.
    pub fn new(view: &FleetProjection, task: &'a TaskState, intake: &'a TaskIntake) -> Self {
        let from = step::from_step(&intake.spec.steps, task.next_step) as usize;
        let goals: Option<Vec<WaypointIx>> = intake.spec.goals(from).map(|goal| view.site.find(goal)).collect();
        let known = goals.as_deref().unwrap_or_default();
        let onward = known.iter().zip(known.iter().skip(1));
        Self {
            task,
            intake,
            first: known.first().map(|goal| view.router.field_around(*goal, routing::closed(view))),
            onward_mm: onward.map(|(at, goal)| routing::way_mm(view, *at, *goal)).collect(),
            home_mm: known.last().and_then(|last| home_mm(view, *last)),
            goals,
        }
    }

    /// Where its robot has to go.
    pub fn goals(&self) -> Result<&[WaypointIx], Reason> {
        self.goals.as_deref().ok_or_else(|| Code::NoRoute.into())
    }

    /// Millimetres from here to the first goal, and from each goal to the next.
    pub fn legs_mm(&self, here: WaypointIx) -> Result<impl Iterator<Item = u64> + Clone + '_, Reason> {
        let first_mm = self.first.as_ref().map(|field| field.distance_mm(here).ok_or(Code::NoRoute)).transpose()?;
        let onward_mm = self.onward_mm.as_ref().ok_or(Code::NoRoute)?;
        Ok(first_mm.into_iter().chain(onward_mm.iter().copied()))
    }

    /// What all of it costs a robot of this `energy` that stands here with a load or without, and the way to the nearest charger behind it.
    /// None: the site has no chargers.
    pub fn trip_home(
        &self,
        view: &FleetProjection,
        energy: &RobotEnergy,
        here: WaypointIx,
        has_load: bool,
    ) -> Result<Option<Trip>, Reason> {
        if view.site.chargers().next().is_none() {
            return Ok(None);
        }
        let spec = &self.intake.spec;
        let mut trip = Trip::new(energy, has_load, spec.speed_limit_mm_s);
        let mut legs_mm = self.legs_mm(here)?;
        for step in &spec.steps[step::from_step(&spec.steps, self.task.next_step) as usize..] {
            match &step.kind {
                StepKind::Goto { .. } => trip.drive(legs_mm.next().unwrap_or(0)),
                step => trip.act(step),
            }
        }
        let last = self.goals()?.last();
        let home_mm = last.map_or_else(|| home_mm(view, here), |_| self.home_mm);
        let name = |at: WaypointIx| -> &WaypointId { view.site.name_of(at) };
        let no_way = || Reason::from(Code::NoRoute).with("goal", name(*last.unwrap_or(&here))).with("to", "a charger");
        trip.drive(home_mm.ok_or_else(no_way)?);
        Ok(Some(trip))
    }
}

/// Millimetres from a waypoint to the nearest charger.
fn home_mm(view: &FleetProjection, from: WaypointIx) -> Option<u64> {
    view.site.chargers().filter_map(|charger| routing::way_mm(view, from, charger)).min()
}
