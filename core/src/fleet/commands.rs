//! What people ask of fleet directly: cordon, uncordon and retire, a word about a load, rules of an area and of the planner, clearing
//! and blocking a place, closing an incident. Each is one item, answered after its commit.

use crate::audit::Note;
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::maintenance::drain;
pub use crate::fleet::projection::command::Command;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::{Cordon, HolderState, Place, PlaceBlock, PlaceHolder, RobotControl};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::{arrivals, claims, load};
use crate::identity::Caller;
use crate::ids::{AttemptId, RobotId};
use crate::item::Item;
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Kind, Reason, Refusal, Violations};
use crate::rows::{Record, Revision, Writer};
use crate::task::raw::check_labels;
use crate::time::Now;
use std::collections::{BTreeMap, BTreeSet};

/// Checks a command against what is known; an error changes nothing.
pub fn check(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    command: &Command,
    seen: Option<Revision>,
) -> Result<(), Refusal> {
    let current = match command {
        Command::Cordon { robot_id, .. }
        | Command::Uncordon { robot_id }
        | Command::Retire { robot_id, .. }
        | Command::Disown { robot_id, .. }
        | Command::SettleLoad { robot_id, .. }
        | Command::Label { robot_id, .. }
        | Command::Drain { robot_id, .. }
        | Command::Undrain { robot_id } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Err(Refusal::new(Kind::NotFound, Reason::from(Code::RobotNotFound).with("robot_id", robot_id)));
            }
            if let (Command::Drain { .. }, Some(open)) = (command, view.drain_of(robot_id)) {
                let reason = Reason::from(Code::RobotDraining).with("drain_id", &open.drain_id);
                return Err(Refusal::new(Kind::Precondition, reason));
            }
            if let Command::Disown { attempt, .. } = command {
                may_disown(view, board, now, robot_id, attempt)?;
            }
            if let Command::SettleLoad { .. } = command {
                load::may_settle(view, board, now, robot_id)?;
            }
            if let Command::Label { labels, removed, .. } = command {
                may_label(view, robot_id, labels, removed)?;
            }
            view.control.get(robot_id.as_str()).map_or(Revision(0), |c| c.revision)
        }
        Command::PutPolicy(policy) => {
            if view.site.find_area(&policy.area_id).is_none() {
                return Err(Refusal::new(
                    Kind::NotFound,
                    Reason::from(Code::AreaNotFound).with("area_id", &policy.area_id),
                ));
            }
            let mut bad = Violations::default();
            policy.check("policy", &mut bad);
            bad.finish()?;
            view.policies.get(policy.area_id.as_str()).map_or(Revision(0), |p| p.revision)
        }
        Command::PutPlanner(policy) => {
            let site_id = view.site.site_id();
            let mut bad = Violations::default();
            policy.check_for(site_id, "policy", &mut bad);
            bad.finish()?;
            view.planner_policies.get(site_id.as_str()).map_or(Revision(0), |p| p.revision)
        }
        Command::ClearPlace { place_id, .. } => {
            let Some(row) = view.places.get(place_id.as_str()) else {
                return Err(Refusal::new(Kind::NotFound, Reason::from(Code::PlaceNotFound).with("place_id", place_id)));
            };
            may_clear(board, now, &row.row)?;
            row.revision
        }
        Command::BlockPlace { place_id, .. } | Command::UnblockPlace { place_id, .. } => {
            if !view.places.contains_key(place_id.as_str()) {
                return Err(Refusal::new(Kind::NotFound, Reason::from(Code::PlaceNotFound).with("place_id", place_id)));
            }
            let block = view.place_blocks.get(place_id.as_str());
            if block.is_none() && matches!(command, Command::UnblockPlace { .. }) {
                let reason = Reason::from(Code::PlaceNotBlocked).with("place_id", place_id);
                return Err(Refusal::new(Kind::Precondition, reason));
            }
            block.map_or(Revision(0), |block| block.revision)
        }
        Command::CloseIncident { incident_id, .. } => {
            let found = view.incidents.get(incident_id.as_str()).filter(|i| i.row.closed.is_none());
            let reason = || Reason::from(Code::IncidentNotFound).with("incident_id", incident_id);
            found.ok_or_else(|| Refusal::new(Kind::NotFound, reason()))?.revision
        }
    };
    match seen {
        Some(seen) if seen != current => {
            Err(Refusal::new(Kind::Conflict, Reason::from(Code::EtagMismatch).with("etag", current.0)))
        }
        _ => Ok(()),
    }
}

/// One inside is believed while it is heard; one that may still enter is let go only when its permission must be over.
fn may_be_there(board: &Board, now: &Now, holder: &PlaceHolder) -> bool {
    match liveness::presence(board, &holder.robot_id, now) {
        Presence::Online => true,
        Presence::Suspect => holder.state != HolderState::Inside,
        Presence::Offline => false,
    }
}

/// A place of one seat is not cleared while a robot may be there; of one with more seats, those of robots that are not heard are.
fn may_clear(board: &Board, now: &Now, place: &Place) -> Result<(), Refusal> {
    let is_there = |h: &&PlaceHolder| may_be_there(board, now, h);
    let is_shared = place.capacity > 1;
    let Some(first) = place.holders.iter().find(is_there) else { return Ok(()) };
    if is_shared && !place.holders.iter().all(|h| may_be_there(board, now, h)) {
        return Ok(());
    }
    let (robot_id, place_id) = (&first.robot_id, &place.place_id);
    let told = match first.state {
        HolderState::Inside => format!("{robot_id} is heard and stands in {place_id}."),
        HolderState::Granted | HolderState::Revoking => format!("{robot_id} may be on its way into {place_id}."),
    };
    let reason = Reason::new(Code::PlaceNotClear, told).with("robot_id", robot_id).with("place_id", place_id);
    Err(Refusal::new(Kind::Precondition, reason))
}

/// Lets go of what a person has seen empty. A robot that may be there keeps its seat, and what is closed because of it stays closed.
fn clear(tx: &mut Tx, board: &Board, place: Place) {
    let now = tx.now;
    let (kept, gone): (Vec<_>, Vec<_>) = place.holders.into_iter().partition(|h| may_be_there(board, &now, h));
    for holder in &gone {
        arrivals::note(tx, &holder.robot_id, &place.place_id);
    }
    let mut cleared = place.cleared;
    cleared.extend(gone.iter().map(|holder| holder.grant_id).filter(|id| *id != 0));
    cleared.drain(..cleared.len().saturating_sub(limits::CLAIMED_PLACES_MAX));
    let is_of_kept = |closed: &Reason| {
        let robot_id = closed.metadata.get("robot_id");
        kept.iter().any(|holder| robot_id.is_some_and(|id| *id == holder.robot_id.as_str()))
    };
    let quarantine = place.quarantine.filter(is_of_kept);
    let (place_id, capacity, kind) = (place.place_id, place.capacity, place.kind);
    tx.put_row(Place { place_id, capacity, kind, holders: kept, quarantine, cleared }, "place.cleared");
}

/// What people may say of a robot is what it may say of itself.
fn may_label(
    view: &FleetProjection,
    robot_id: &RobotId,
    labels: &BTreeMap<String, String>,
    removed: &BTreeSet<String>,
) -> Result<(), Refusal> {
    let mut bad = Violations::default();
    if labels.is_empty() && removed.is_empty() {
        bad.add("labels", "is required, or removed is");
    }
    if labels.keys().any(|key| removed.contains(key)) {
        bad.add("removed", "must not name a label that is put");
    }
    let known = view.control.get(robot_id.as_str()).map(|c| c.row.labels.clone()).unwrap_or_default();
    check_labels(&relabeled(known, labels, removed), "labels", &mut bad);
    bad.finish()
}

fn relabeled(
    mut known: BTreeMap<String, String>,
    labels: &BTreeMap<String, String>,
    removed: &BTreeSet<String>,
) -> BTreeMap<String, String> {
    known.retain(|key, _| !removed.contains(key));
    known.extend(labels.iter().map(|(key, value)| (key.clone(), value.clone())));
    known
}

/// An attempt is ignored only while its robot is heard, stands still, lists it as its own, and no row knows it: not right after it turned out to
/// know more than a restored store.
fn may_disown(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    robot_id: &RobotId,
    attempt: &AttemptId,
) -> Result<(), Refusal> {
    let no = |what: &str| {
        let reason = Reason::new(Code::NotAllowedNow, what).with("robot_id", robot_id).with("attempt", attempt);
        Err(Refusal::new(Kind::Precondition, reason))
    };
    let Some(live) = board.get(robot_id).filter(|_| liveness::presence(board, robot_id, now) == Presence::Online)
    else {
        return no("the robot is not heard");
    };
    let lists = live.report.attempts.iter().any(|r| r.attempt == *attempt && !r.state.is_over());
    match () {
        () if !lists => no("the robot does not list this attempt as its own"),
        () if view.held_by(robot_id) == Some(attempt) => no("the server knows this attempt: cancel its task"),
        () if live.report.vitals.speed_mm_s != 0 => no("the robot moves: stop it first"),
        () if claims::is_ahead(view, robot_id, now) => {
            no("the robot knows more than the store, which was restored: it is still heard out")
        }
        () => Ok(()),
    }
}

/// What a command leaves in the audit.
pub fn note(view: &FleetProjection, command: &Command) -> Note {
    let of_robot = |action, robot_id: &RobotId| Note::new(action).about("robot", robot_id);
    match command {
        Command::Cordon { robot_id, reason } => of_robot("robot.cordon", robot_id).because(reason),
        Command::Uncordon { robot_id } => of_robot("robot.uncordon", robot_id),
        Command::Retire { robot_id, reason } => of_robot("robot.retire", robot_id).because(reason),
        Command::Disown { robot_id, attempt, reason } => {
            of_robot("robot.disown", robot_id).because(reason).with("attempt", attempt.to_string())
        }
        Command::SettleLoad { robot_id, reason } => of_robot("robot.settle_load", robot_id).because(reason),
        Command::Label { robot_id, labels, removed } => {
            let put: Vec<String> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
            let removed: Vec<&str> = removed.iter().map(String::as_str).collect();
            of_robot("robot.label", robot_id).with("labels", put.join(" ")).with("removed", removed.join(" "))
        }
        Command::Drain { robot_id, reason, within_ms } => {
            of_robot("robot.drain", robot_id).because(reason).with("within_ms", within_ms)
        }
        Command::Undrain { robot_id } => of_robot("robot.undrain", robot_id),
        Command::PutPolicy(policy) => {
            Note::new("area.put_policy").about("area", &policy.area_id).with("policy", policy.body())
        }
        Command::PutPlanner(policy) => {
            Note::new("planner.put").about("site", &policy.site_id).with("policy", policy.body())
        }
        Command::ClearPlace { place_id, reason } => {
            let note = Note::new("place.clear").about("place", place_id).because(reason);
            let robots = view.places.get(place_id.as_str()).into_iter().flat_map(|place| &place.row.holders);
            robots.fold(note, |note, holder| note.about("robot", &holder.robot_id))
        }
        Command::BlockPlace { place_id, reason, lasts_ms } => {
            let note = Note::new("place.block").about("place", place_id).because(reason);
            lasts_ms.iter().fold(note, |note, lasts_ms| note.with("lasts_ms", lasts_ms))
        }
        Command::UnblockPlace { place_id, reason } => {
            Note::new("place.unblock").about("place", place_id).because(reason)
        }
        Command::CloseIncident { incident_id, reason } => {
            let note = Note::new("incident.close").about("incident", incident_id).because(reason);
            let Some(incident) = view.incidents.get(incident_id.as_str()).map(|i| &i.row) else { return note };
            let note = incident.robot_id.iter().fold(note, |note, id| note.about("robot", id));
            let note = incident.task_id.iter().fold(note, |note, id| note.about("task", id));
            incident.area_id.iter().fold(note, |note, id| note.about("area", id))
        }
    }
}

/// What a command that was refused leaves in the audit, if anything.
pub fn refusal(
    view: &FleetProjection,
    command: &Command,
    by: &Caller,
    request_id: Option<&str>,
    why: &Refusal,
) -> Option<Item> {
    Item::for_refusal(Writer::Fleet, by, request_id, note(view, command), why)
}

/// Carries out a command that passed its check.
pub fn apply(tx: &mut Tx, board: &Board, command: &Command, actor: &str) {
    tx.audit(note(tx.view, command));
    match command {
        Command::Cordon { robot_id, reason } => {
            let mut control = control(tx, robot_id);
            control.cordon = Some(Cordon { reason: reason.clone(), actor: actor.to_owned(), since: tx.now.utc });
            tx.put_row(control, "robot.cordoned");
        }
        Command::Uncordon { robot_id } => {
            let mut control = control(tx, robot_id);
            control.cordon = None;
            control.retired = None;
            control.breaker = None;
            control.failures.clear();
            control.unanswered_since = None;
            control.unanswered.clear();
            tx.put_row(control, "robot.uncordoned");
        }
        Command::Retire { robot_id, reason } => {
            let mut control = control(tx, robot_id);
            control.retired = Some(Cordon { reason: reason.clone(), actor: actor.to_owned(), since: tx.now.utc });
            tx.put_row(control, "robot.retired");
        }
        Command::Disown { robot_id, attempt, .. } => {
            let mut control = control(tx, robot_id);
            if !control.disowned.contains(attempt) && control.disowned.len() < limits::REPORTED_LIST_MAX {
                control.disowned.push(attempt.clone());
            }
            tx.put_row(control, "robot.disowned");
            tx.view.unknown.remove(robot_id);
            incidents::close_about(tx, Code::AttemptUnknown, robot_id, "the attempt was disowned");
        }
        Command::SettleLoad { robot_id, reason } => {
            let mut control = control(tx, robot_id);
            control.load_settled = Some(load::settle(tx, board, robot_id, reason, actor));
            tx.put_row(control, "robot.load_settled");
        }
        Command::Label { robot_id, labels, removed } => {
            let control = control(tx, robot_id);
            let labels = relabeled(control.labels.clone(), labels, removed);
            tx.put_row(RobotControl { labels, ..control }, "robot.labeled");
        }
        Command::Drain { robot_id, reason, within_ms } => drain::request_drain(tx, robot_id, reason, actor, *within_ms),
        Command::Undrain { robot_id } => drain::undrain(tx, robot_id),
        Command::PutPolicy(policy) => {
            tx.put_row(policy.clone(), "area.policy_put");
        }
        Command::PutPlanner(policy) => {
            tx.put_row(policy.clone(), "planner.policy_put");
        }
        Command::ClearPlace { place_id, reason } => {
            tx.add_fact(
                place_id.as_str(),
                "place.judged_clear",
                &serde_json::json!({"actor": actor, "reason": reason}),
            );
            let Some(place) = tx.view.places.get(place_id.as_str()).map(|p| p.row.clone()) else { return };
            clear(tx, board, place);
        }
        Command::BlockPlace { place_id, reason, lasts_ms } => {
            let block = PlaceBlock {
                place_id: place_id.clone(),
                reason: reason.clone(),
                actor: actor.to_owned(),
                since: tx.now.utc,
                until: lasts_ms.map(|ms| tx.now.utc.plus_ms(ms)),
            };
            tx.put_row(block, "place.blocked");
        }
        Command::UnblockPlace { place_id, .. } => tx.delete::<PlaceBlock>(place_id.as_str(), "place.unblocked"),
        Command::CloseIncident { incident_id, reason } => incidents::close(tx, incident_id, reason, actor),
    }
}

fn control(tx: &Tx, robot_id: &RobotId) -> RobotControl {
    tx.view.control.get(robot_id.as_str()).map_or_else(|| RobotControl::new(robot_id.clone()), |c| c.row.clone())
}
