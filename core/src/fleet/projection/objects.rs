//! Where the things lie that people ask fleet about, and whether somebody may do what is asked.
//!
//! Invariant: what a caller may not see is for it as if it were not there, and what is not there is refused by nobody here.

use super::command::Command;
use super::liveness::Board;
use super::rows::Incident;
use super::state::FleetProjection;
use crate::identity::{Caller, Permission};
use crate::ids::{AreaId, PlaceId, RobotId, TaskId};
use crate::reason::{Code, Kind, Reason, Refusal};
use std::collections::BTreeSet;

/// The area in which a robot is; none: not known.
pub fn area_of(view: &FleetProjection, board: &Board, robot_id: &RobotId) -> Option<AreaId> {
    board.get(robot_id)?.area(&view.site).cloned()
}

/// The areas of the goals of a task that has not ended.
pub fn areas_of_task(view: &FleetProjection, task_id: &TaskId) -> BTreeSet<AreaId> {
    view.intake(task_id).map(|intake| view.site.areas_of_task(&intake.spec)).unwrap_or_default()
}

/// The areas of what an incident is about: of the robot, of the task, the area, or the place. None: the site.
pub fn areas_of_incident(view: &FleetProjection, board: &Board, incident: &Incident) -> BTreeSet<AreaId> {
    if let Some(robot_id) = &incident.robot_id {
        return area_of(view, board, robot_id).into_iter().collect();
    }
    if let Some(task_id) = &incident.task_id {
        return areas_of_task(view, task_id);
    }
    if let Some(area_id) = &incident.area_id {
        return BTreeSet::from([area_id.clone()]);
    }
    let place_id = incident.reason.metadata.get("place_id").and_then(|id| PlaceId::parse(id).ok());
    place_id.map(|id| view.site.areas_of_place(&id)).unwrap_or_default()
}

/// Whether a caller may see a robot.
pub fn sees_robot(view: &FleetProjection, board: &Board, by: &Caller, robot_id: &RobotId) -> bool {
    by.is_permitted_everywhere(Permission::Read)
        || by.is_permitted_in(Permission::Read, area_of(view, board, robot_id).as_ref())
}

/// Whether a caller may see an incident.
pub fn sees_incident(view: &FleetProjection, board: &Board, by: &Caller, incident: &Incident) -> bool {
    let read = Permission::Read;
    by.is_permitted_everywhere(read) || by.is_permitted_in(read, &areas_of_incident(view, board, incident))
}

/// Whether a caller may see a place.
pub fn sees_place(view: &FleetProjection, by: &Caller, place_id: &PlaceId) -> bool {
    by.is_permitted_everywhere(Permission::Read)
        || by.is_permitted_in(Permission::Read, &view.site.areas_of_place(place_id))
}

/// Whether a caller may see a task.
pub fn sees_task(view: &FleetProjection, by: &Caller, task_id: &TaskId) -> bool {
    by.is_permitted_everywhere(Permission::Read) || by.is_permitted_in(Permission::Read, &areas_of_task(view, task_id))
}

/// Whether a caller may do what it asks.
///
/// # Errors
/// It may not see what it is about, or may not do that to it.
pub fn permit(view: &FleetProjection, board: &Board, by: &Caller, command: &Command) -> Result<(), Refusal> {
    let operate = Permission::Operate;
    if by.is_permitted_everywhere(operate) && by.is_permitted_everywhere(Permission::Read) {
        return Ok(());
    }
    let missing = |code: Code, key: &str, id: &dyn ToString| {
        Refusal::new(Kind::NotFound, Reason::from(code).with(key, id.to_string()))
    };
    match command {
        Command::Cordon { robot_id, .. }
        | Command::Uncordon { robot_id }
        | Command::Retire { robot_id, .. }
        | Command::Disown { robot_id, .. }
        | Command::SettleLoad { robot_id, .. }
        | Command::Label { robot_id, .. }
        | Command::Drain { robot_id, .. }
        | Command::Undrain { robot_id } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Ok(());
            }
            let area = area_of(view, board, robot_id);
            by.authorize_visible(operate, area.as_ref(), || missing(Code::RobotNotFound, "robot_id", robot_id))
        }
        Command::PutPolicy(policy) => {
            let area_id = &policy.area_id;
            by.authorize_visible(operate, [area_id], || missing(Code::AreaNotFound, "area_id", area_id))
        }
        // The site's: a right that was given for areas is not enough.
        Command::PutPlanner(_) => by.authorize(operate, []),
        Command::ClearPlace { place_id, .. }
        | Command::BlockPlace { place_id, .. }
        | Command::UnblockPlace { place_id, .. } => {
            if !view.places.contains_key(place_id.as_str()) {
                return Ok(());
            }
            let areas = view.site.areas_of_place(place_id);
            by.authorize_visible(operate, &areas, || missing(Code::PlaceNotFound, "place_id", place_id))
        }
        Command::CloseIncident { incident_id, .. } => {
            let Some(incident) = view.incidents.get(incident_id.as_str()) else { return Ok(()) };
            let areas = areas_of_incident(view, board, &incident.row);
            by.authorize_visible(operate, &areas, || missing(Code::IncidentNotFound, "incident_id", incident_id))
        }
    }
}
