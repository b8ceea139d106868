//! Places that are closed because nobody knows what a robot does there: by whom, since when, and how a person opens them.
//!
//! Called by the explanations, and once a sweep. Invariants:
//! 1. A robot that fell silent before it said that it entered closes its own seat and no other: it may have entered since, so it holds that
//!    seat until it is heard or a person clears the place. One that had entered, or a place of one seat, closes the whole place.
//! 2. A closed place has one open incident, which closes by itself once the place is open.
//! 3. An incident that a person closes while the place stays closed is told again after [`limits::LASTS_BEFORE_INCIDENT`].

use super::{blocked_places, engaged_stops};
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Plan;
use crate::fleet::decision::report::WAITS_FOR;
use crate::fleet::projection::rows::{Incident, Place, PlaceHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{PlaceId, RobotId, WaypointId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::task::{Attempt, AttemptPhase};
use crate::time::{Now, Utc};
use std::collections::BTreeMap;

/// The fact of an incident that names its place.
const PLACE_ID: &str = "place_id";

/// The fact that says what a person types to open the place.
const COMMAND: &str = "command";

/// What is closed of one place.
#[derive(Clone, Debug, PartialEq)]
pub struct ClosedPlace {
    /// The place with something closed.
    pub place_id: PlaceId,
    /// In words, with the robots and the command that opens it.
    pub reason: Reason,
    /// Since when; none: the record does not say.
    pub since: Option<Utc>,
}

/// What is closed of the place; none: nothing.
pub fn find_closed(view: &FleetProjection, place: &Place) -> Option<ClosedPlace> {
    let of_holder = |h: &PlaceHolder| lost(view, &h.robot_id).map(|a| (h.robot_id.to_string(), a.ended));
    let mut robots: BTreeMap<String, Option<Utc>> = place.holders.iter().filter_map(of_holder).collect();
    let quarantine = place.quarantine.as_ref();
    if quarantine.is_none() && robots.is_empty() {
        return None;
    }
    let seats = quarantine.map_or_else(|| robots.len().to_string(), |_| "all".to_owned());
    if let Some(robot_id) = quarantine.and_then(|closed| closed.metadata.get("robot_id")) {
        robots.entry(robot_id.clone()).or_default();
    }
    let since = robots.values().flatten().min().copied();
    let named: Vec<&str> = robots.keys().take(limits::CROWD_NAMED_MAX).map(String::as_str).collect();
    let command = format!("midshift zone clear {} --reason TEXT --if-match ETAG", place.place_id);
    let told = describe_closed(place, &named, since, &command);
    let reason = Reason::new(Code::PlaceQuarantined, told).with(PLACE_ID, &place.place_id).with("seats", seats);
    let reason = reason.with("robots", named.join(" ")).with(COMMAND, command);
    let reason = since.into_iter().fold(reason, |reason, at| reason.with("since", at.rfc3339()));
    let cause = quarantine.and_then(|closed| closed.metadata.get("cause"));
    let reason = cause.into_iter().fold(reason, |reason, cause| reason.with("cause", cause));
    Some(ClosedPlace { place_id: place.place_id.clone(), reason, since })
}

fn describe_closed(place: &Place, named: &[&str], since: Option<Utc>, command: &str) -> String {
    let (place_id, who) = (&place.place_id, named.join(", "));
    let since = since.map_or_else(String::new, |at| format!(" since {}", at.rfc3339()));
    let what = match place.quarantine {
        Some(_) => format!("Place {place_id} is closed{since}: nobody knows what {who} does there."),
        None => format!(
            "A seat of place {place_id} is closed{since}: {who} was let in, and nobody knows whether it is inside. \
             The other seats are open."
        ),
    };
    format!(
        "{what} It opens once the robot is heard and says where it is, or once a person has looked: `{command}`; \
         `midshift zone ls` shows the ETAG."
    )
}

/// The attempt that a robot still has, and that was given up because nobody knew what the robot did.
fn lost<'v>(view: &'v FleetProjection, robot_id: &RobotId) -> Option<&'v Attempt> {
    view.attempt(view.held_by(robot_id)?).filter(|a| a.phase == AttemptPhase::Lost)
}

impl ClosedPlace {
    /// `reason` in the words of this closure, with its facts.
    pub fn word_reason(&self, mut reason: Reason) -> Reason {
        reason.message.clone_from(&self.reason.message);
        reason.metadata.extend(self.reason.metadata.clone());
        let command = self.reason.metadata.get(COMMAND).map_or("", String::as_str);
        reason.with(WAITS_FOR, format!("a person at place {}: {command}", self.place_id))
    }
    /// A robot that is heard has a moment to say where it is; how long the place is closed is not always known.
    fn lasts(&self, now: &Now) -> bool {
        self.since.is_none_or(|since| now.utc.ms_since(since) >= limits::STOP_CONFIRM.as_ms())
    }
    /// A person closed its incident a moment ago.
    fn is_looked_at(&self, now: &Now, incident: &Incident) -> bool {
        incident.closed.as_ref().is_some_and(|closed| {
            let is_of_this = self.since.is_none_or(|since| closed.at >= since);
            is_of_this && now.utc.ms_since(closed.at) < limits::LASTS_BEFORE_INCIDENT.as_ms()
        })
    }
}

/// A way that a closed or blocked place bars, with that place; another reason stays as it is.
pub fn name_closed(view: &FleetProjection, reason: Reason) -> Reason {
    if reason.code != Code::PlaceOccupied || !reason.message.is_empty() {
        return reason;
    }
    let goal = reason.metadata.get("goal").and_then(|goal| WaypointId::parse(goal).ok());
    let goal = goal.and_then(|goal| view.site.find(&goal)).and_then(|at| view.site.standing_at(at));
    let goal_block = goal.and_then(|ix| blocked_places::find_block(view, ix));
    let goal = goal.and_then(|ix| view.places.get(view.site.place(ix).place_id.as_str()));
    let is_shut = |place: &&Place| place.quarantine.is_some();
    let goal = goal.map(|place| &place.row).filter(is_shut);
    // A stop may bar the way as well: then nobody says which of them does.
    let is_alone = || engaged_stops::closed(view).is_empty();
    let on_the_way = || view.places.values().map(|place| &place.row).find(is_shut).filter(|_| is_alone());
    let closure = goal.or_else(on_the_way).and_then(|place| find_closed(view, place));
    let only_block = || blocked_places::find_only_block(view).filter(|_| is_alone());
    match (goal_block, closure) {
        (None, Some(closure)) => closure.word_reason(reason),
        (block, _) => match block.or_else(only_block) {
            Some(block) => blocked_places::word_block(reason, block),
            None => reason,
        },
    }
}

/// Opens an incident of each place that is closed, and closes those of places that are open.
pub(in crate::fleet) fn keep_incidents(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let closed = view.places.values().filter_map(|place| find_closed(view, &place.row));
    let closed: BTreeMap<String, ClosedPlace> = closed.map(|closure| (closure.place_id.to_string(), closure)).collect();
    let told = view.incidents.values().map(|i| &i.row).filter(|i| i.reason.code == Code::PlaceQuarantined);
    let told: Vec<Incident> = told.cloned().collect();
    let place_of = |incident: &Incident| incident.reason.metadata.get(PLACE_ID).cloned().unwrap_or_default();
    for incident in told.iter().filter(|i| i.closed.is_none() && !closed.contains_key(&place_of(i))) {
        plan.decide(view, now, "fleet", |tx| incidents::close(tx, &incident.id, "the place is open again", "fleet"));
    }
    for (place_id, closure) in &closed {
        let of_place: Vec<&Incident> = told.iter().filter(|i| place_of(i) == *place_id).collect();
        let is_due = match of_place.iter().find(|i| i.closed.is_none()) {
            Some(open) => open.reason != closure.reason,
            None => closure.lasts(&now) && !of_place.iter().any(|i| closure.is_looked_at(&now, i)),
        };
        if is_due {
            plan.decide(view, now, "fleet", |tx| {
                incidents::tell_of_place(tx, closure.reason.clone(), &closure.place_id);
            });
        }
    }
}
