//! What robots say of places: whose word is taken, and how far.
//!
//! 1. A place that we granted to a robot always counts as held once it says so.
//! 2. Of places without a grant of ours at most [`limits::CLAIMED_PLACES_MAX`] are taken over: those near its pose first.
//! 3. A robot that says more is believed no further, frees nothing, and gets no work and no grant until it says less.
//! 4. Two robots inside one exclusive place are an incident for each pair; nobody else is let in.
//!
//! Called by `inbox` for events and by `repair` for heartbeats. Invariant: no word of a robot frees the place of another.

use super::rows::{HolderState, Incident, Place, PlaceHolder};
use super::view::View;
use super::{Plan, Tx, inbox, incidents};
use crate::ids::{PlaceId, RobotId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::stop::Region;
use crate::time::Now;
use crate::work::{Live, PlaceNews};
use std::collections::BTreeMap;

/// One difference: the place, the grant, and what the robot says happened.
type Difference = (PlaceId, u64, PlaceNews);

/// Brings place rows to what a settled robot reports: entered, gone, or standing somewhere nobody knew of. What is not `sound` frees nothing.
pub fn repair(view: &mut View, now: Now, live: &Live, sound: bool, plan: &mut Plan) {
    let robot_id = &live.robot_id;
    let excess = too_many(view, live);
    let mut changes = differences(view, live);
    changes.retain(|(_, _, news)| (sound && excess.is_none()) || *news == PlaceNews::Entered);
    for some in changes.chunks(limits::PLACES_PER_ITEM) {
        plan.decide(view, now, "fleet", |tx| {
            for (place_id, grant_id, news) in some {
                inbox::place(tx, robot_id, place_id, *grant_id, *news);
            }
        });
    }
    if let Some(why) = excess {
        plan.decide(view, now, "fleet", |tx| {
            incidents::open_about(tx, why, Some(robot_id), "");
        });
    }
}

/// What a settled robot says of places that the rows do not; what is near its pose comes before what is not.
fn differences(view: &View, live: &Live) -> Vec<Difference> {
    let robot_id = &live.robot_id;
    let standing_on = live.report.vitals.waypoint.as_ref().filter(|_| live.report.vitals.speed_mm_s == 0);
    let mut changes = Vec::new();
    for (place, holder) in super::view::held(view, robot_id) {
        let place_id = &place.place_id;
        match live.report.places.iter().find(|p| p.place_id == *place_id) {
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
fn is_near(view: &View, live: &Live, place_id: &PlaceId) -> bool {
    let Some(pose) = &live.report.vitals.pose else { return false };
    Region::of_zone(&view.site, place_id).is_some_and(|region| region.is_near(pose, limits::CLAIMED_PLACE_MARGIN_MM))
}

/// Places without a grant of ours that the robot holds already.
fn taken_over(view: &View, robot_id: &RobotId) -> usize {
    super::view::held(view, robot_id).filter(|(_, holder)| holder.claimed).count()
}

/// The robot says that it is inside of more places without a grant than it can be.
pub fn too_many(view: &View, live: &Live) -> Option<Reason> {
    let robot_id = &live.robot_id;
    let is_claim = |id: &PlaceId| {
        let place = view.places.get(id.as_str()).map(|place| &place.row);
        place.is_some_and(|place| place.holder(robot_id).is_none_or(|holder| holder.claimed))
    };
    let claims = live.report.places.iter().filter(|p| p.inside && is_claim(&p.place_id)).count();
    let reason = || Reason::from(Code::PlacesImplausible).with("most", limits::CLAIMED_PLACES_MAX);
    (claims > limits::CLAIMED_PLACES_MAX).then(reason)
}

/// A robot is where the rows do not know of it: its word is taken, whatever the capacity, before the place is given to another one.
pub fn take_over(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId, grant_id: u64) {
    let Some(mut place) = tx.view.places.get(place_id.as_str()).map(|p| p.row.clone()) else { return };
    if place.holder(robot_id).is_some() {
        return;
    }
    let is_blamed = grant_id != 0 || tx.view.bugs.claims_are_blamed();
    if is_blamed && !place.cleared.contains(&grant_id) && !is_ahead(tx.view, robot_id, &tx.now) {
        let reason = Reason::from(Code::GrantUnknown).with("place_id", place_id).with("grant_id", grant_id);
        incidents::open_about(tx, reason, Some(robot_id), "place_id");
    }
    if taken_over(tx.view, robot_id) >= limits::CLAIMED_PLACES_MAX {
        return;
    }
    let (robot_id, since) = (robot_id.clone(), tx.now.utc);
    place.holders.push(PlaceHolder { robot_id, grant_id, state: HolderState::Inside, since, claimed: true });
    tx.put(place, "place.adopted");
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
pub fn is_ahead(view: &View, robot_id: &RobotId, now: &Now) -> bool {
    let is_it = |i: &Incident| i.reason.code == Code::StoreBehindRobot && i.robot_id.as_ref() == Some(robot_id);
    let told = view.incidents.values().map(|i| &i.row).filter(|i| is_it(i));
    let given = view.desired_work.get(robot_id.as_str()).map_or(0, |d| d.row.generation);
    view.sessions.get(robot_id.as_str()).is_some_and(|s| s.row.followed_work() > given)
        || told.into_iter().any(|i| now.ms_since(i.opened) <= limits::RESTORED_LATELY.as_ms())
}

/// A robot is inside of the place now: with more inside than it holds, people are told of each pair that it makes.
pub fn entered(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId) {
    let Some(place) = tx.view.places.get(place_id.as_str()).map(|p| &p.row) else { return };
    let others: Vec<RobotId> = others_inside(place, robot_id).cloned().collect();
    for other in others {
        let (a, b) = if *robot_id < other { (robot_id, &other) } else { (&other, robot_id) };
        let reason = broken_exclusion(place_id, b).with("pair", format!("{place_id} {a} {b}"));
        incidents::open_about(tx, reason, Some(a), "pair");
    }
}

/// Robots that are inside beside this one where there is no room for them; so many are named.
fn others_inside<'p>(place: &'p Place, robot_id: &'p RobotId) -> impl Iterator<Item = &'p RobotId> {
    let inside = place.holders.iter().filter(|h| h.state == HolderState::Inside).map(|h| &h.robot_id);
    let is_broken = inside.clone().count() > place.capacity as usize && inside.clone().any(|r| r == robot_id);
    inside.filter(move |other| is_broken && *other != robot_id).take(limits::CLAIMED_PLACES_MAX)
}

/// Another robot is where there is room for this one only.
pub fn broken(view: &View, robot_id: &RobotId) -> Option<Reason> {
    super::view::held(view, robot_id).find_map(|(place, _)| {
        others_inside(place, robot_id).next().map(|other| broken_exclusion(&place.place_id, other))
    })
}

fn broken_exclusion(place_id: &PlaceId, other: &RobotId) -> Reason {
    Reason::from(Code::ExclusionBroken).with("place_id", place_id).with("other", other)
}
