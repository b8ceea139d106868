//! Free bays for robots that stand in a place which others need.

use super::desired::{Release, Releases};
use super::grants::{self, Occupancy};
use super::{route_requests, routing};
use crate::desired_state::Assignment;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::HolderState;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::site::route::segments;
use crate::site::{Kind, PlaceIx};
use crate::task::Attempt;
use crate::time::{SiteDuration, SiteTime};

/// A robot that blocks a place others need steps aside after this long, at once if somebody waits for it.
const STEP_ASIDE_AFTER: SiteDuration = SiteDuration::from_secs(3);

/// The robot stands in a place or passage that others need while its own goal is taken: it goes to a free bay on the way.
pub(super) fn step_aside(
    tx: &mut Tx,
    a: &Attempt,
    work: &Assignment,
    since: SiteTime,
    releases: &mut Releases,
    occupancy: &mut Occupancy,
) -> bool {
    let robot_id = &a.robot_id;
    let released = work.released_index.unwrap_or(0) as usize;
    let Some(here) = work.route.get(released).and_then(|p| tx.view.site.find(&p.waypoint)) else { return false };
    let place = tx.view.site.standing_at(here);
    let kind = tx.view.site.waypoint(here).kind;
    let bars = match place {
        Some(place) => !matches!(kind, Kind::Hold | Kind::Park) && stands_in(tx.view, robot_id, place),
        None => route_requests::bars_passage(tx.view, robot_id),
    };
    if !bars {
        return false;
    }
    let contested = place.is_some_and(|place| {
        let here_id = tx.view.site.place(place).place_id.clone();
        tx.view.waits.iter().any(|(r, w)| r != robot_id && w.places.contains(&here_id))
    });
    if !contested && tx.now.site.since(since) < STEP_ASIDE_AFTER {
        return false;
    }
    let left: Vec<_> =
        work.route.iter().skip(released + 1).filter_map(|p| p.ends_step.zip(tx.view.site.find(&p.waypoint))).collect();
    let Some((_, goal)) = left.first().copied() else { return false };
    let site = tx.view.site.clone();
    let mut bays: Vec<_> = site
        .hold_points()
        .chain(site.parks())
        .filter_map(|bay| {
            let there = tx.view.router.distance_mm(here, bay)?;
            Some((there + tx.view.router.distance_mm(bay, goal)?, bay))
        })
        .collect();
    bays.sort_unstable();
    for (_, bay) in bays {
        let Some(mut route) = routing::route(tx.view, here, Some(bay), &left) else { continue };
        route[0].ends_step = None;
        let Some(ixs) = routing::indices(&site, &route) else { continue };
        let Some(first) = segments(&site, &ixs).into_iter().next() else { continue };
        if first.standing == place || !grants::can_grant(tx.view, robot_id, &first.places(), occupancy) {
            continue;
        }
        grants::grant_places(tx, robot_id, &first.places(), occupancy);
        tx.view.dirty.insert(a.robot_id.clone());
        releases.0.insert(robot_id.clone(), Release { route: Some(route), released_index: first.end as u32 });
        return true;
    }
    false
}

fn stands_in(view: &FleetProjection, robot_id: &RobotId, place: PlaceIx) -> bool {
    let id = &view.site.place(place).place_id;
    view.places.get(id.as_str()).and_then(|p| p.row.holder(robot_id)).is_some_and(|h| h.state == HolderState::Inside)
}
