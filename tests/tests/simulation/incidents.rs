//! Laws of incidents: what only a person can solve has one, and honest robots bring none of those that tell of robots that behave badly.

use crate::law_names::{BOUNDED, REFUSED};
use crate::observer::{Observer, ready};
use midshift_core::fleet::rows::{HolderState, Incident, Place, RobotControl};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::rows::{Record, Row, Table};
use midshift_core::task::Attempt;
use midshift_store::{MemoryStore, Store};
use std::collections::{BTreeMap, BTreeSet};

/// What only a person can solve has an incident.
pub const ASKED: &str = "what a person must solve has an incident";
/// Honest robots are not blamed.
pub const NOT_BLAMED: &str = "no honest robot opens an incident of robots that behave badly";

/// What honest robots never bring about.
const OF_BAD_ROBOTS: [Code; 12] = [
    Code::RobotDoesNotAnswer,
    Code::OffersNotAnswered,
    Code::ReportImplausible,
    Code::ReportTooLong,
    Code::RobotNotUnderstood,
    Code::AttemptUnknown,
    Code::PlacesImplausible,
    Code::ExclusionBroken,
    Code::GrantUnknown,
    Code::GoalNotEntered,
    Code::DecisionPutAside,
    Code::WorkUnreadable,
];

/// What the words of one robot alone may open again and again.
const BY_WORDS: [Code; 9] = [
    Code::AttemptUnknown,
    Code::ExclusionBroken,
    Code::GoalNotEntered,
    Code::GrantUnknown,
    Code::PlacesImplausible,
    Code::ReportImplausible,
    Code::RobotDoesNotAnswer,
    Code::StoreBehindRobot,
    Code::WorkUnreadable,
];

fn all<R: Record>(rows: &[Row]) -> impl Iterator<Item = R> {
    rows.iter().filter(|row| row.key.table == R::TABLE).filter_map(|row| row.decode().ok())
}

fn rows(store: &MemoryStore) -> Vec<Row> {
    let tables = [Table::Incident, Table::RobotControl, Table::Attempt, Table::PlaceGrant];
    ready(store.snapshot(&tables)).map(|snapshot| snapshot.rows).unwrap_or_default()
}

/// Looks at the rows as they are now, beside robots that behave badly.
pub fn are_open_and_few(store: &MemoryStore, seen: &mut Observer) {
    let rows = rows(store);
    are_open(&rows, seen);
    are_few(&rows, seen);
}

/// No decision was put aside, and what one robot says opens no more than it may.
fn are_few(rows: &[Row], seen: &mut Observer) {
    let mut by_words: BTreeMap<(Code, RobotId), usize> = BTreeMap::new();
    for incident in all::<Incident>(rows) {
        let code = incident.reason.code;
        seen.check(REFUSED, code != Code::DecisionPutAside, || format!("{incident:?}"));
        let counts = incident.closed.is_none() && BY_WORDS.contains(&code);
        if let Some(robot_id) = incident.robot_id.filter(|_| counts) {
            *by_words.entry((code, robot_id)).or_insert(0) += 1;
        }
    }
    for ((code, robot_id), many) in by_words {
        let holds = many <= limits::INCIDENTS_OF_ROBOT_MAX;
        seen.check(BOUNDED, holds, || format!("{many} incidents {code} of {robot_id}"));
    }
}

/// Codes of all incidents, open and closed.
pub fn codes(store: &MemoryStore) -> BTreeSet<Code> {
    all::<Incident>(&rows(store)).map(|incident| incident.reason.code).collect()
}

fn are_open(rows: &[Row], seen: &mut Observer) {
    let incidents: Vec<Incident> = all(rows).collect();
    let has = |code: Code, robot_id: &str| {
        let of_code = incidents.iter().filter(|i| i.reason.code == code);
        of_code.filter(|i| i.closed.is_none()).any(|i| i.robot_id.as_ref().is_some_and(|r| r.as_str() == robot_id))
    };
    let mut wanted: Vec<(Code, String)> = Vec::new();
    for control in all::<RobotControl>(rows) {
        let robot_id = control.robot_id.to_string();
        wanted.extend(control.breaker.map(|_| (Code::RobotBreakerOpened, robot_id.clone())));
        wanted.extend(control.unanswered_since.map(|_| (Code::RobotDoesNotAnswer, robot_id)));
    }
    for attempt in all::<Attempt>(rows).filter(|a| !a.phase.is_terminal()) {
        let doubted = attempt.uncertain.filter(|u| u.cause.code == Code::ReportImplausible);
        wanted.extend(doubted.map(|_| (Code::ReportImplausible, attempt.robot_id.to_string())));
    }
    for (code, robot_id) in wanted {
        seen.check(ASKED, has(code, &robot_id), || format!("{code} of {robot_id}: {incidents:?}"));
    }
    let inside = |place: &Place| place.holders.iter().filter(|h| h.state == HolderState::Inside).count();
    for place in all::<Place>(rows).filter(|place| inside(place) > place.capacity as usize) {
        let named = |i: &Incident| i.reason.metadata.get("place_id").is_some_and(|id| *id == place.place_id.as_str());
        let told = incidents.iter().any(|i| i.reason.code == Code::ExclusionBroken && named(i));
        seen.check(ASKED, told, || format!("two are inside of {place:?}: {incidents:?}"));
    }
}

/// Looks at that law of a shift with honest robots alone.
pub fn nobody_is_blamed(store: &MemoryStore, seen: &mut Observer) {
    let blamed: Vec<_> =
        all::<Incident>(&rows(store)).filter(|i| OF_BAD_ROBOTS.contains(&i.reason.code)).map(|i| i.id).collect();
    seen.check(NOT_BLAMED, blamed.is_empty(), || format!("{blamed:?}"));
}
