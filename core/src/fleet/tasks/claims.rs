//! What robots say of places: whose word is taken, and how far.
//!
//! 1. A place that we granted to a robot always counts as held once it says so.
//! 2. Of places without a grant of ours at most [`limits::CLAIMED_PLACES_MAX`] are taken over: those near its pose first, so one that only an
//!    event tells and that is not near waits for the next heartbeat.
//! 3. A robot that says more is believed no further, frees nothing, and gets no work and no grant until it says less, or until a person has
//!    closed the incident that names these places.
//! 4. A place that a robot has entered is not free because it lists it no more, while its own pose lies in it.
//! 5. More robots inside one place than it has room for are one incident of that place; nobody else is let in.
//!
//! Called by `facts::inbox` for events and by `facts::repair` for heartbeats. Invariant: no word of a robot frees the place of another.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::{HolderState, Incident, Place, PlaceHolder};
use crate::fleet::projection::state::{self, FleetProjection};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{PlaceId, RobotId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot_events::PlaceNews;
use crate::stop::Region;
use crate::time::Now;
use std::collections::{BTreeMap, BTreeSet};

/// What an incident calls the places that a robot says it is inside of.
pub(in crate::fleet) const PLACES: &str = "places";

/// One difference: the place, the grant, and what the robot says happened.
pub(in crate::fleet) type Difference = (PlaceId, u64, PlaceNews);

/// What a settled robot says of places that the rows do not; what is near its pose comes before what is not.
pub(in crate::fleet) fn differences(view: &FleetProjection, live: &NewestHeartbeat) -> Vec<Difference> {
    let robot_id = &live.robot_id;
    let standing_on = live.report.vitals.waypoint.as_ref().filter(|_| live.report.vitals.speed_mm_s == 0);
    let mut changes = Vec::new();
    for (place, holder) in state::held(view, robot_id) {
        let place_id = &place.place_id;
        match live.report.places.iter().find(|p| p.place_id == *place_id) {
            // It entered and does not say that it left: a robot that lost its memory is still where its pose is.
            None if holder.state == HolderState::Inside && lies_inside(view, live, place_id) => {}
            None if standing_on.is_none_or(|w| w.as_str() != place_id.as_str()) => {
                changes.push((place_id.clone(), holder.grant_id, PlaceNews::NotEntered));
            }
            Some(p) if p.inside && holder.state != HolderState::Inside => {
                changes.push((place_id.clone(), holder.grant_id, PlaceNews::Entered));
            }
            _ => {}
        }
    }
    let mut inside: BTreeMap<&PlaceId, u64> =
        live.report.places.iter().filter(|p| p.inside).map(|p| (&p.place_id, p.grant_id)).collect();
    let stands = standing_on.and_then(|w| PlaceId::parse(w.as_str()).ok());
    if let Some(place_id) = &stands {
        inside.entry(place_id).or_insert(0);
    }
    let is_news = |place_id: &PlaceId| {
        view.places.get(place_id.as_str()).is_some_and(|place| place.row.holder(robot_id).is_none())
    };
    let mut entered: Vec<_> = inside.into_iter().filter(|(id, _)| is_news(id)).collect();
    if entered.len() > 1 {
        entered.sort_by_cached_key(|(id, _)| (stands.as_ref() != Some(*id), !is_near(view, live, id)));
    }
    changes.extend(entered.into_iter().map(|(id, grant_id)| (id.clone(), grant_id, PlaceNews::Entered)));
    changes
}

/// Whether the robot's pose lies in the place or near it.
fn is_near(view: &FleetProjection, live: &NewestHeartbeat, place_id: &PlaceId) -> bool {
    is_within(view, live, place_id, limits::CLAIMED_PLACE_MARGIN_MM)
}

/// Whether the robot's pose lies in the place.
fn lies_inside(view: &FleetProjection, live: &NewestHeartbeat, place_id: &PlaceId) -> bool {
    is_within(view, live, place_id, 0)
}

fn is_within(view: &FleetProjection, live: &NewestHeartbeat, place_id: &PlaceId, margin_mm: i32) -> bool {
    let Some(pose) = &live.report.vitals.pose else { return false };
    Region::of_zone(&view.site, place_id).is_some_and(|region| region.is_near(pose, margin_mm))
}

/// The robot's event says that it entered a place which it does not hold, and by the pose of this session it does not stand near: what its
/// next heartbeat says comes first.
pub fn waits_for_heartbeat(view: &FleetProjection, board: &Board, robot_id: &RobotId, place_id: &PlaceId) -> bool {
    let is_held = view.places.get(place_id.as_str()).is_some_and(|place| place.row.holder(robot_id).is_some());
    let session = view.sessions.get(robot_id.as_str()).map(|s| s.row.session_epoch);
    let live = board.get(robot_id).filter(|live| Some(live.report.session_epoch) == session);
    let live = live.filter(|live| live.report.vitals.pose.is_some());
    live.is_some_and(|live| !is_held && !is_near(view, live, place_id))
}

/// Places without a grant of ours that the robot holds already.
fn taken_over(view: &FleetProjection, robot_id: &RobotId) -> usize {
    state::held(view, robot_id).filter(|(_, holder)| holder.claimed).count()
}

/// The robot says that it is inside of more places without a grant than it can be, and no person has looked at that.
pub fn too_many(view: &FleetProjection, live: &NewestHeartbeat) -> Option<Reason> {
    excess(view, live).map(|_| implausible())
}

pub(in crate::fleet) fn implausible() -> Reason {
    Reason::from(Code::PlacesImplausible).with("most", limits::CLAIMED_PLACES_MAX)
}

/// Places without a grant that the robot says it is inside of, if they are more than it can be inside of and no person has looked at that.
pub(in crate::fleet) fn excess<'l>(view: &FleetProjection, live: &'l NewestHeartbeat) -> Option<BTreeSet<&'l str>> {
    let robot_id = &live.robot_id;
    let is_claim = |id: &PlaceId| {
        let place = view.places.get(id.as_str()).map(|place| &place.row);
        place.is_some_and(|place| place.holder(robot_id).is_none_or(|holder| holder.claimed))
    };
    let inside = live.report.places.iter().filter(|p| p.inside).map(|p| &p.place_id);
    let claims: BTreeSet<&str> = inside.filter(|id| is_claim(id)).map(PlaceId::as_str).collect();
    (claims.len() > limits::CLAIMED_PLACES_MAX && !is_looked_at(view, robot_id, &claims)).then_some(claims)
}

/// A person closed an incident that names all of these places.
fn is_looked_at(view: &FleetProjection, robot_id: &RobotId, claims: &BTreeSet<&str>) -> bool {
    let is_closed = |i: &&Incident| {
        i.closed.is_some() && i.reason.code == Code::PlacesImplausible && i.robot_id.as_ref() == Some(robot_id)
    };
    view.incidents.values().map(|i| &i.row).filter(is_closed).any(|incident| {
        let named = incident.reason.metadata.get(PLACES).map(|places| places.split(' ').collect::<BTreeSet<_>>());
        named.is_some_and(|named| claims.is_subset(&named))
    })
}

/// A robot is where the rows do not know of it: its word is taken, whatever the capacity, before the place is given to another one.
pub fn take_over(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId, grant_id: u64) {
    check_grant(tx, robot_id, place_id, grant_id);
    let Some(mut place) = tx.view.places.get(place_id.as_str()).map(|p| p.row.clone()) else { return };
    if place.holder(robot_id).is_some() || taken_over(tx.view, robot_id) >= limits::CLAIMED_PLACES_MAX {
        return;
    }
    let (robot_id, since) = (robot_id.clone(), tx.now.utc);
    place.holders.push(PlaceHolder { robot_id, grant_id, state: HolderState::Inside, since, claimed: true });
    tx.put_row(place, "place.adopted");
}

/// The robot says that it has applied a newer generation than this store gave: a restore, or an error of the robot. Of the store itself its
/// word moves nothing but the next number, and that no further than the clock.
pub fn outran(tx: &mut Tx, robot_id: &RobotId, applied_work: u64, is_followed: bool) {
    if is_followed {
        let clock = tx.now.wall.0.max(0).cast_unsigned();
        tx.view.behind = tx.view.behind.max(Some(applied_work.min(clock)));
    }
    let reason = Reason::from(Code::StoreBehindRobot).with("applied_work", applied_work);
    let reason = if is_followed { reason } else { reason.with("most", limits::GENERATION_FOLLOWED_MAX) };
    incidents::open_about(tx, reason, Some(robot_id), "");
}

/// The store turned out a moment ago to be older than this robot: it does not know what it gave it. What one robot says excuses no other:
/// whatever a store gave and forgot has raised the generation of the robot that has it.
pub fn is_ahead(view: &FleetProjection, robot_id: &RobotId, now: &Now) -> bool {
    let is_it = |i: &Incident| i.reason.code == Code::StoreBehindRobot && i.robot_id.as_ref() == Some(robot_id);
    let told = view.incidents.values().map(|i| &i.row).filter(|i| is_it(i));
    let given = view.desired_work.get(robot_id.as_str()).map_or(0, |d| d.row.generation);
    view.sessions.get(robot_id.as_str()).is_some_and(|s| s.row.followed_work() > given)
        || told.into_iter().any(|i| now.ms_since(i.opened_unix_ms) <= limits::RESTORED_LATELY.as_ms())
}

/// A robot entered on a grant that nobody gave it, of a place that it holds or not: people are told.
pub fn check_grant(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId, grant_id: u64) {
    let Some(place) = tx.view.places.get(place_id.as_str()).map(|p| &p.row) else { return };
    let is_held = place.holder(robot_id).is_some_and(|holder| holder.grant_id == grant_id);
    let is_blamed = grant_id != 0 || tx.view.bugs.claims_are_blamed();
    if !is_blamed || is_held || place.cleared.contains(&grant_id) || is_ahead(tx.view, robot_id, &tx.now) {
        return;
    }
    let reason = Reason::from(Code::GrantUnknown).with("place_id", place_id).with("grant_id", grant_id);
    incidents::open_about(tx, reason, Some(robot_id), "place_id");
}

/// A robot is inside of the place now: with more inside than it has room for, people are told of all of them.
pub fn entered(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId) {
    let Some(place) = tx.view.places.get(place_id.as_str()).map(|p| &p.row) else { return };
    let crowd = crowd(place);
    if !crowd.contains(&robot_id) {
        return;
    }
    let named: Vec<&str> = crowd.iter().take(limits::CROWD_NAMED_MAX).map(|r| r.as_str()).collect();
    let reason = broken_exclusion(place_id).with("robots", named.join(" ")).with("inside", crowd.len());
    incidents::tell_of_place(tx, reason, place_id);
}

/// Robots inside of a place that has no room for all of them, in the order in which they entered; empty: it has.
fn crowd(place: &Place) -> Vec<&RobotId> {
    let inside = place.holders.iter().filter(|h| h.state == HolderState::Inside).map(|h| &h.robot_id);
    let inside: Vec<&RobotId> = inside.collect();
    if inside.len() > place.capacity as usize { inside } else { Vec::new() }
}

/// Another robot is where there is room for this one only.
pub fn broken(view: &FleetProjection, robot_id: &RobotId) -> Option<Reason> {
    state::held(view, robot_id).find_map(|(place, _)| {
        let crowd = crowd(place);
        let other = crowd.iter().find(|other| **other != robot_id).filter(|_| crowd.contains(&robot_id))?;
        Some(broken_exclusion(&place.place_id).with("other", other))
    })
}

fn broken_exclusion(place_id: &PlaceId) -> Reason {
    Reason::from(Code::ExclusionBroken).with("place_id", place_id)
}
