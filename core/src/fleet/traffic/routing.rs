//! Routes as robots get them: from where a robot stands through every goal that is left, around places that are closed.

use super::blocked_places;
use crate::desired_state::RoutePoint;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::WaypointId;
use crate::limits;
use crate::site::route::Blocked;
use crate::site::{Site, WaypointIx};
use crate::step::{StepKind, WorkStep};

/// Places that no route may lead into now: found once, until a place, a block or a stop changes.
pub fn closed(view: &FleetProjection) -> &Blocked {
    view.closed_places.get_or_init(|| {
        let quarantined = view.places.values().filter(|p| p.row.quarantine.is_some());
        let quarantined = quarantined.filter_map(|p| view.site.find_place(&p.row.place_id));
        Blocked::new(quarantined.chain(blocked_places::barred(view)))
    })
}

/// Goals of the goto steps from `from_step` on, with their step numbers.
pub fn goals(site: &Site, steps: &[WorkStep], from_step: u32) -> Option<Vec<(u32, WaypointIx)>> {
    let left = steps.iter().enumerate().skip(from_step as usize);
    left.filter_map(|(i, s)| match &s.kind {
        StepKind::Goto { waypoint } => Some(site.find(waypoint).map(|at| (i as u32, at))),
        _ => None,
    })
    .collect()
}

/// The route from `start` through `goals`, with the ways between them; none if no lanes lead there.
pub fn route(
    view: &FleetProjection,
    start: WaypointIx,
    via: Option<WaypointIx>,
    goals: &[(u32, WaypointIx)],
) -> Option<Vec<RoutePoint>> {
    let site = &view.site;
    let blocked = closed(view);
    let mut points = vec![point(site, None, start)];
    let mut at = start;
    let legs = via.map(|v| (None, v)).into_iter().chain(goals.iter().map(|(step, goal)| (Some(*step), *goal)));
    for (step, goal) in legs {
        let way = view.router.route_around(at, goal, blocked).or_else(|| view.router.route(at, goal))?;
        if way.len() == 1 && (step.is_some() && points.last().is_some_and(|p| p.ends_step.is_some())) {
            points.push(point(site, None, goal));
        }
        for pair in way.windows(2) {
            points.push(point(site, Some(pair[0]), pair[1]));
        }
        if let Some(last) = points.last_mut() {
            last.ends_step = step;
        }
        at = goal;
    }
    (points.len() <= limits::ROUTE_POINTS_MAX).then_some(points)
}

/// Whether a route of `work_mm` through all goals would have too many points. A bound decides for nearly all: only what might be too
/// long is counted.
pub fn is_too_long(view: &FleetProjection, start: WaypointIx, goals: &[WaypointIx], work_mm: u64) -> bool {
    let most = work_mm / u64::from(view.site.shortest_lane_mm()) + 2 * goals.len() as u64 + 1;
    most > limits::ROUTE_POINTS_MAX as u64
        && route(view, start, None, &goals.iter().map(|goal| (0, *goal)).collect::<Vec<_>>()).is_none()
}

fn point(site: &Site, from: Option<WaypointIx>, at: WaypointIx) -> RoutePoint {
    let waypoint = site.waypoint(at);
    let lane = from.and_then(|f| site.find_lane(f, at)).map(|l| site.lane(l));
    let passages =
        lane.map(|l| l.passages.iter().map(|p| site.place(*p).place_id.clone()).collect()).unwrap_or_default();
    RoutePoint {
        waypoint: waypoint.waypoint_id.clone(),
        x_mm: waypoint.x_mm as i32,
        y_mm: waypoint.y_mm as i32,
        ends_step: None,
        standing: site.standing_at(at).map(|p| site.place(p).place_id.clone()),
        passages,
        speed_limit_mm_s: lane.and_then(|l| l.speed_limit_mm_s),
        area_id: site.area_of(at).area_id.clone(),
    }
}

/// Indices of a route's waypoints; none if the site does not know one of them.
pub fn indices(site: &Site, route: &[RoutePoint]) -> Option<Vec<WaypointIx>> {
    route.iter().map(|p| site.find(&p.waypoint)).collect()
}

/// Millimetres to each of the goals from the one before it, in order.
pub fn legs_mm(view: &FleetProjection, start: WaypointIx, goals: &[WaypointIx]) -> Option<Vec<u64>> {
    let starts = std::iter::once(&start).chain(goals);
    starts.zip(goals).map(|(at, goal)| way_mm(view, *at, *goal)).collect()
}

/// Millimetres from one waypoint to another around closed places; through them, if no way leads around: they open again.
pub fn way_mm(view: &FleetProjection, from: WaypointIx, to: WaypointIx) -> Option<u64> {
    let around = view.router.field_around(to, closed(view)).distance_mm(from);
    around.or_else(|| view.router.distance_mm(from, to))
}

/// Index of a waypoint by name.
pub fn find(view: &FleetProjection, name: Option<&WaypointId>) -> Option<WaypointIx> {
    name.and_then(|n| view.site.find(n))
}
