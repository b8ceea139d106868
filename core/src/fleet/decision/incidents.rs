//! What people should look into: opened by whoever meets it, closed by a person who has looked.
//!
//! Invariant: there are at most [`limits::INCIDENTS_MAX`]; the oldest goes for a new one, a closed one before an open one.

use super::plan::{Plan, Tx};
use crate::fleet::projection::rows::{Incident, IncidentClosure};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{PlaceId, RobotId, TaskId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::time::Now;
use std::cmp::Ordering;

/// What the last incident of a kind says of those that come after it.
const FURTHER: &str = "not told one by one until some of these are closed";

/// Opens an incident, once per reason, subject and moment: several of one code may come of one message.
pub fn open(tx: &mut Tx, reason: Reason, robot_id: Option<&RobotId>, task_id: Option<&TaskId>) {
    let of = |id: Option<String>| id.or_else(|| reason.metadata.get("rollout_id").cloned()).unwrap_or_default();
    let about = of(robot_id.map(ToString::to_string).or(task_id.map(ToString::to_string)));
    let (first, mut nth) = (format!("{}:{about}:{}", reason.code, tx.now.wall.0), 1);
    let mut id = first.clone();
    while tx.view.incidents.get(id.as_str()).is_some_and(|known| known.row.reason != reason) {
        nth += 1;
        id = format!("{first}:{nth}");
    }
    open_as(tx, id, reason, robot_id, task_id);
}

/// Opens the incident of this id, also again.
pub(in crate::fleet) fn open_as(
    tx: &mut Tx,
    id: String,
    reason: Reason,
    robot_id: Option<&RobotId>,
    task_id: Option<&TaskId>,
) {
    if tx.view.incidents.len() >= limits::INCIDENTS_MAX {
        let age = |i: &Incident| (i.closed.is_none(), i.opened_unix_ms);
        let oldest = tx.view.incidents.values().map(|i| &i.row).min_by_key(|i| age(i)).map(|i| i.id.clone());
        oldest.iter().for_each(|id| tx.delete::<Incident>(id, "incident.forgotten"));
    }
    let incident = Incident {
        id,
        reason,
        robot_id: robot_id.cloned(),
        task_id: task_id.cloned(),
        area_id: None,
        opened_unix_ms: tx.now.utc,
        closed: None,
    };
    tx.put_row(incident, "incident.opened");
}

/// Opens an incident unless an open one says the same of the robot: what goes on is met again and again.
pub fn open_once(tx: &mut Tx, reason: Reason, robot_id: Option<&RobotId>) {
    let same = |i: &Incident| i.closed.is_none() && i.robot_id.as_ref() == robot_id && i.reason == reason;
    if !tx.view.incidents.values().any(|i| same(&i.row)) {
        open(tx, reason, robot_id, None);
    }
}

/// Opens an incident unless an open one with its code names the same robot and the same `key`. Returns whether there was none. The words of
/// one robot open [`limits::INCIDENTS_OF_ROBOT_MAX`] of a code at most; the last of them says that it stands for further ones.
pub fn open_about(tx: &mut Tx, reason: Reason, robot_id: Option<&RobotId>, key: &str) -> bool {
    if tx.view.bugs.each_word_is_told() {
        open(tx, reason, robot_id, None);
        return true;
    }
    let alike = |i: &&Incident| i.closed.is_none() && i.reason.code == reason.code && i.robot_id.as_ref() == robot_id;
    let open_ones = tx.view.incidents.values().map(|i| &i.row).filter(alike);
    let about: Vec<Option<&String>> = open_ones.map(|i| i.reason.metadata.get(key)).collect();
    if about.contains(&reason.metadata.get(key)) {
        return false;
    }
    match (about.len() + 1).cmp(&limits::INCIDENTS_OF_ROBOT_MAX) {
        Ordering::Less => open(tx, reason, robot_id, None),
        Ordering::Equal => open(tx, reason.with("further", FURTHER), robot_id, None),
        Ordering::Greater => {}
    }
    true
}

/// Opens an incident of a place; an open one of the same code is told anew and stays as old as it is.
pub fn tell_of_place(tx: &mut Tx, reason: Reason, place_id: &PlaceId) {
    let is_it = |i: &&Incident| {
        let of_place = i.reason.metadata.get("place_id").is_some_and(|id| *id == place_id.as_str());
        of_place && i.closed.is_none() && i.reason.code == reason.code
    };
    let known = tx.view.incidents.values().map(|i| &i.row).find(is_it).cloned();
    match known {
        None => open(tx, reason, None, None),
        Some(known) if known.reason == reason => {}
        Some(known) => tx.put_row(Incident { reason, robot_id: None, ..known }, "incident.changed"),
    }
}

/// What an incident was about is over: it closes by itself.
pub fn close_about(tx: &mut Tx, code: Code, robot_id: &RobotId, reason: &str) {
    let is_it = |i: &Incident| i.closed.is_none() && i.reason.code == code && i.robot_id.as_ref() == Some(robot_id);
    let open: Vec<String> = tx.view.incidents.values().filter(|i| is_it(&i.row)).map(|i| i.row.id.clone()).collect();
    open.iter().for_each(|id| close(tx, id, reason, "fleet"));
}

/// A person has looked into it.
pub fn close(tx: &mut Tx, incident_id: &str, reason: &str, actor: &str) {
    let Some(mut incident) = tx.view.incidents.get(incident_id).map(|i| i.row.clone()) else { return };
    incident.closed = Some(IncidentClosure { actor: actor.to_owned(), reason: reason.to_owned(), at: tx.now.utc });
    tx.put_row(incident, "incident.closed");
}

/// Tells people of every decision, and of every row of a newer version, that was put aside since.
pub fn open_put_aside(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    for (reason, robot_id) in view.refused.take_untold() {
        plan.decide(view, now, "fleet", |tx| open_once(tx, reason, robot_id.as_ref()));
    }
    // One call of a newer version may leave a row for each task.
    for (reason, robot_id) in view.unknown_rows.take_untold() {
        plan.decide(view, now, "fleet", |tx| {
            open_about(tx, reason, robot_id.as_ref(), "row");
        });
    }
}
