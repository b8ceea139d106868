//! Changed maps: what stands in the way of one (tasks that are to go where it has nothing, robots under way there, places that are held), and
//! robots that drive by another one.
//!
//! Called at a start, before a process begins to plan, and with each heartbeat that is compared. Invariant: a map is taken only if what the rows say of
//! the floor is true of it too, or if a person forces it; then each thing in the way is an incident.

use crate::desired_state::RoutePoint;
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::rows::Place;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{PlaceId, RobotId, TaskId, WaypointId};
use crate::reason::{Code, Reason};
use crate::site::{Site, WaypointIx, read_stored};
use crate::time::Now;
use std::collections::BTreeMap;

/// Names of one kind that an incident lists; of more it says how many.
const LISTED_MAX: usize = 16;

/// One thing in the way of a map.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Obstacle {
    /// It has a goal that the map does not have there.
    Task(TaskId),
    /// It is on a route that the map does not have.
    Robot(RobotId),
    /// It is held, and the map has it elsewhere, smaller, or not at all.
    Place(PlaceId),
}

impl Obstacle {
    /// Its kind and its name.
    fn named(&self) -> (&'static str, String) {
        match self {
            Self::Task(id) => ("tasks", id.to_string()),
            Self::Robot(id) => ("robots", id.to_string()),
            Self::Place(id) => ("places", id.to_string()),
        }
    }
}

/// What became of the map that a process was started with.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MapChange {
    /// It is the stored one, or was taken with nothing in its way.
    #[default]
    Taken,
    /// The stored one goes on.
    NotTaken {
        /// Version of the map that was not taken.
        version: String,
        /// What is in its way.
        obstacles: Vec<Obstacle>,
    },
    /// A person forced it.
    Forced {
        /// What was in its way.
        obstacles: Vec<Obstacle>,
    },
}

impl MapChange {
    /// What a person has taken into account.
    fn forced(&self) -> &[Obstacle] {
        match self {
            Self::Forced { obstacles } => obstacles,
            Self::Taken | Self::NotTaken { .. } => &[],
        }
    }
}

/// Why a process that begins to plan must not write its map, which `view` stands on, over the stored one: this is another one than at its
/// start, or something is in the way now that was not when it chose. It chooses anew in its next start.
pub fn outdated(view: &FleetProjection, site_text: &str, at_start: Option<&str>, change: &MapChange) -> Option<Reason> {
    let stored = view.sites.get(view.site.site_id().as_str()).map(|s| &s.row).filter(|row| row.text != site_text)?;
    let reason = |obstacles: &[Obstacle]| not_taken(&stored.map_version, view.site.map_version(), obstacles);
    if at_start != Some(stored.text.as_str()) {
        return Some(reason(&[]));
    }
    // Of a text that is no site nobody can say what is in the way.
    let stored_site = read_stored(stored.site_id.as_str(), &stored.text).ok()?;
    let obstacles = in_the_way(view, &stored_site, &view.site);
    let is_new = |obstacle: &Obstacle| !change.forced().contains(obstacle);
    obstacles.iter().any(is_new).then(|| reason(&obstacles))
}

/// What is in the way of `new` by the rows of `view`, which were written by the stored map.
pub fn in_the_way(view: &FleetProjection, stored: &Site, new: &Site) -> Vec<Obstacle> {
    let differs = |name: &WaypointId| point(stored, name) != point(new, name);
    let goes_there = |id: &TaskId| view.intake(id).is_some_and(|intake| intake.spec.goals(0).any(differs));
    let live = view.tasks.values().map(|task| &task.row).filter(|task| !task.phase.is_terminal());
    let tasks = live.map(|task| &task.task_id).filter(|id| goes_there(id)).cloned().map(Obstacle::Task);
    let under_way = view.desired_work.values().filter_map(|d| Some((&d.row.robot_id, d.row.assignment.as_ref()?)));
    let robots = under_way.filter(|(_, work)| !is_route_of(new, &work.route));
    let robots = robots.map(|(robot_id, _)| Obstacle::Robot(robot_id.clone()));
    let held = view.places.values().map(|place| &place.row).filter(|place| !place.holders.is_empty());
    let places = held.filter(|place| !holds(stored, new, place)).map(|place| Obstacle::Place(place.place_id.clone()));
    tasks.chain(robots).chain(places).collect()
}

fn point(site: &Site, name: &WaypointId) -> Option<(i64, i64)> {
    let at = site.waypoint(site.find(name)?);
    Some((at.x_mm, at.y_mm))
}

/// Whether the map has every point of a route where the route has it, and a lane from each to the next.
fn is_route_of(site: &Site, route: &[RoutePoint]) -> bool {
    let stands = |p: &RoutePoint| point(site, &p.waypoint) == Some((p.x_mm.into(), p.y_mm.into()));
    let find = |p: &RoutePoint| site.find(&p.waypoint);
    let leads = |pair: &[RoutePoint]| {
        let ends = find(&pair[0]).zip(find(&pair[1]));
        ends.is_some_and(|(from, to)| from == to || site.find_lane(from, to).is_some())
    };
    route.iter().all(stands) && route.windows(2).all(leads)
}

/// Whether the map has a held place as the stored one has it, with room for whoever holds it.
fn holds(stored: &Site, new: &Site, row: &Place) -> bool {
    let shape = |site: &Site| {
        let place = site.place(site.find_place(&row.place_id)?);
        let named = |at: &WaypointIx| {
            let waypoint = site.waypoint(*at);
            (waypoint.waypoint_id.clone(), waypoint.x_mm, waypoint.y_mm)
        };
        let inside = place.inside().map(|inside| inside.waypoints.iter().map(named).collect::<Vec<_>>());
        Some((place.waypoint().as_ref().map(named), inside))
    };
    let room = new.find_place(&row.place_id).map(|ix| new.place(ix).capacity as usize);
    shape(stored) == shape(new) && room.is_some_and(|room| room >= row.holders.len())
}

/// The robot says that it drives by another map than the one that is planned on.
pub fn differs(view: &FleetProjection, live: &NewestHeartbeat) -> Option<Reason> {
    let (own, ours) = (&live.report.map_version, view.site.map_version());
    let reason = || Reason::from(Code::MapDiffers).with("robot_map", own).with("map_version", ours);
    (!own.is_empty() && own != ours).then(reason)
}

/// Opens the incident of a robot with another map, and closes it once it has ours.
pub(in crate::fleet) fn compare(tx: &mut Tx, live: &NewestHeartbeat) {
    let id = format!("{}:{}", Code::MapDiffers, live.robot_id);
    let open = tx.view.incidents.get(id.as_str()).map(|i| &i.row).filter(|i| i.closed.is_none());
    match (differs(tx.view, live), open.map(|i| &i.reason)) {
        (Some(why), known) if known != Some(&why) => incidents::open_as(tx, id, why, Some(&live.robot_id), None),
        (None, Some(_)) => incidents::close(tx, &id, "the robot drives by the map of the server", "fleet"),
        _ => {}
    }
}

/// Tells people of what became of the map.
pub(in crate::fleet) fn tell_of_change(view: &mut FleetProjection, now: Now, change: &MapChange, plan: &mut Plan) {
    let id = format!("{}:{}", Code::MapNotTaken, view.site.site_id());
    let open = view.incidents.get(id.as_str()).map(|i| &i.row).filter(|i| i.closed.is_none()).map(|i| i.reason.clone());
    if let MapChange::NotTaken { version, obstacles } = change {
        let reason = not_taken(view.site.map_version(), version, obstacles);
        if open.as_ref() != Some(&reason) {
            plan.decide(view, now, "fleet", |tx| incidents::open_as(tx, id, reason, None, None));
        }
        return;
    }
    if open.is_some() {
        plan.decide(view, now, "fleet", |tx| incidents::close(tx, &id, "the map is taken", "fleet"));
    }
    let MapChange::Forced { obstacles } = change else { return };
    for obstacle in obstacles {
        plan.decide(view, now, "fleet", |tx| open_forced(tx, obstacle));
    }
}

fn not_taken(stored: &str, version: &str, obstacles: &[Obstacle]) -> Reason {
    let reason = Reason::from(Code::MapNotTaken).with("map_version", version).with("stored", stored);
    let mut named: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for obstacle in obstacles {
        let (kind, name) = obstacle.named();
        named.entry(kind).or_default().push(name);
    }
    named.into_iter().fold(reason, |reason, (kind, names)| {
        let more = names.len().saturating_sub(LISTED_MAX);
        let listed = names.into_iter().take(LISTED_MAX).collect::<Vec<_>>().join(" ");
        reason.with(kind, if more == 0 { listed } else { format!("{listed} and {more} more") })
    })
}

/// Opens the incident of a thing that a forced map does not fit: once in a start of the process, however often it reads the rows anew.
fn open_forced(tx: &mut Tx, obstacle: &Obstacle) {
    let (kind, name) = obstacle.named();
    let id = format!("{}:{kind}:{name}:{}", Code::MapForced, tx.view.started.wall.0);
    if tx.view.incidents.contains_key(id.as_str()) {
        return;
    }
    let reason = Reason::from(Code::MapForced);
    match obstacle {
        Obstacle::Task(task_id) => incidents::open_as(tx, id, reason, None, Some(task_id)),
        Obstacle::Robot(robot_id) => incidents::open_as(tx, id, reason, Some(robot_id), None),
        Obstacle::Place(place_id) => incidents::open_as(tx, id, reason.with("place_id", place_id), None, None),
    }
}
