//! What the copy of the fleet stops says of now: which robots they keep work from, and which places they close.

use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use crate::robot::StopLevel;
use crate::site::{PlaceIx, Site};
use crate::stop::{Scope, Stop};
use std::collections::BTreeSet;

/// Stops that are engaged, as they were copied. What was reset is not looked at.
pub(in crate::fleet) fn engaged(view: &FleetProjection) -> impl Iterator<Item = &Stop> {
    view.engaged.iter().filter_map(|id| view.stops.get(id.as_str())).map(|record| &record.row.stop)
}

/// Those that stand robots.
fn standing(view: &FleetProjection) -> impl Iterator<Item = &Stop> {
    engaged(view).filter(|stop| stop.level >= StopLevel::Halt)
}

/// Of these, whom a robot lies inside of.
pub(in crate::fleet) fn over<'v>(
    view: &'v FleetProjection,
    robot_id: &'v RobotId,
    live: Option<&'v NewestHeartbeat>,
) -> impl Iterator<Item = &'v Stop> {
    let pose = live.and_then(|live| live.report.vitals.pose.as_ref());
    standing(view).filter(move |stop| stop.includes(robot_id, pose))
}

/// Checks that no stop keeps work from the robot, also before its token is written.
pub(in crate::fleet) fn check_stops(
    view: &FleetProjection,
    robot_id: &RobotId,
    live: Option<&NewestHeartbeat>,
) -> Result<(), Reason> {
    match over(view, robot_id, live).next() {
        Some(stop) => Err(Reason::from(Code::StopEngaged).with("stop_id", &stop.stop_id).with("scope", &stop.scope)),
        None => Ok(()),
    }
}

/// Places that lie inside of a stop of a part of the site: nobody is let into them.
pub(in crate::fleet) fn closed(view: &FleetProjection) -> BTreeSet<PlaceIx> {
    let site: &Site = &view.site;
    let mut closed = BTreeSet::new();
    for stop in standing(view) {
        match &stop.scope {
            Scope::Zone(place_id) => closed.extend(site.find_place(place_id)),
            Scope::Area(area_id) => {
                let area = site.find_area(area_id);
                let places = (0..site.places().len() as u32).map(PlaceIx);
                closed.extend(places.filter(|ix| {
                    let at = site.place(*ix).waypoint();
                    at.is_some_and(|at| Some(site.waypoint(at).area) == area)
                }));
            }
            Scope::Robot(_) | Scope::Fleet => {}
        }
    }
    closed
}
