//! The copy of a stop that services read: written by what follows the stop service, which itself never sees the store.

use super::latch::{Latch, Reset, Stop};
use super::scope::Scope;
use crate::audit::Note;
use crate::identity::Actor;
use crate::ids::StopId;
use crate::item::{Expect, Item};
use crate::rows::{Index, Record, Revision, Table, Writer, body_is_json};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One stop and its reset.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopRecord {
    /// As it was engaged.
    pub stop: Stop,
    /// As it was reset; none: it is effective.
    pub reset: Option<Reset>,
}

impl StopRecord {
    /// It is engaged and not reset.
    pub const fn is_effective(&self) -> bool {
        self.reset.is_none()
    }
}

impl StopRecord {
    /// Takes over the tokens that a copy knows: a stop or reset that came back from a robot has none, and is the same.
    fn keep_tokens_of(&mut self, known: &Self) {
        self.stop.token_id = self.stop.token_id.take().or_else(|| known.stop.token_id.clone());
        if let (Some(reset), Some(known)) = (&mut self.reset, &known.reset) {
            reset.token_id = reset.token_id.take().or_else(|| known.token_id.clone());
        }
    }
}

impl Record for StopRecord {
    const TABLE: Table = Table::StopRecord;
    body_is_json!();
    fn id(&self) -> String {
        self.stop.stop_id.to_string()
    }
    fn index(&self) -> Index {
        Index {
            state: Some(i64::from(self.is_effective())),
            order: Some(self.stop.engaged_unix_ms.0),
            ..Index::default()
        }
    }
}

/// What must be written so that the copy has all that the latch knows, each stop by itself. What the latch has lost and was not reset stays: the copy is then the
/// one place in which it stands.
pub fn copy(latch: &Latch, copied: &BTreeMap<StopId, (StopRecord, Revision)>) -> Vec<Item> {
    let mut items = Vec::new();
    for stop in latch.stops() {
        let mut record = StopRecord { stop: stop.clone(), reset: latch.reset_of(&stop.stop_id).cloned() };
        if let Some((known, _)) = copied.get(&stop.stop_id) {
            record.keep_tokens_of(known);
        }
        match copied.get(&stop.stop_id) {
            // Engaged by one and reset by another in between: each leaves its own row in the audit.
            None => {
                items.push(write(&StopRecord { reset: None, ..record.clone() }, Expect::Absent));
                items.extend(record.reset.is_some().then(|| write(&record, Expect::At(Revision(1)))));
            }
            Some((known, revision)) if *known != record => items.push(write(&record, Expect::At(*revision))),
            Some(_) => {}
        }
    }
    for (known, revision) in copied.values().filter(|(known, _)| latch.stop(&known.stop.stop_id).is_none()) {
        match (latch.reset_of(&known.stop.stop_id), &known.reset) {
            (Some(reset), None) => {
                let record = StopRecord { reset: Some(reset.clone()), ..known.clone() };
                items.push(write(&record, Expect::At(*revision)));
            }
            // Its reset was long ago, and its name is forgotten everywhere.
            (None, Some(reset)) => {
                let mut item = Item::new(Writer::Stop, &reset.actor);
                item.delete(known.key(), *revision, "stop.forgotten");
                items.push(item);
            }
            (Some(_), Some(_)) | (None, None) => {}
        }
    }
    items
}

fn write(record: &StopRecord, expect: Expect) -> Item {
    let stop = &record.stop;
    let (actor, fact, note) = match &record.reset {
        Some(reset) => {
            let actor = Actor::new(&reset.actor, reset.token_id.clone());
            (
                actor,
                "stop.reset",
                Note::new("stop.reset").because(&reset.reason).with("at_unix_ms", reset.reset_unix_ms.0),
            )
        }
        None => {
            let level = format!("{:?}", stop.level);
            let note = Note::new("stop.engage").because(&stop.reason).with("level", level).with("scope", &stop.scope);
            let actor = Actor::new(&stop.actor, stop.token_id.clone());
            (actor, "stop.engaged", note.with("at_unix_ms", stop.engaged_unix_ms.0))
        }
    };
    let note = note.about("stop", &stop.stop_id);
    let note = match &stop.scope {
        Scope::Robot(id) => note.about("robot", id),
        Scope::Zone(id) => note.about("place", id),
        Scope::Area(id) => note.about("area", id),
        Scope::Fleet => note,
    };
    let mut item = Item::new(Writer::Stop, actor);
    item.put_row(record, expect, fact).audit(note);
    item
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::StopLevel;
    use crate::time::Utc;

    fn stop(name: &str) -> Stop {
        let stop_id = StopId::parse(name).expect("an id");
        Stop { actor: "anna".to_owned(), ..Stop::new(stop_id, Scope::Fleet, StopLevel::Halt, Utc(1)) }
    }

    fn reset(name: &str) -> Reset {
        let stop_id = StopId::parse(name).expect("an id");
        Reset { actor: "bert".to_owned(), reason: "clear".to_owned(), ..Reset::new(stop_id, Utc(2)) }
    }

    fn latch(stops: &[&str], resets: &[&str]) -> Latch {
        let mut latch = Latch::default();
        for name in stops {
            latch.engage(stop(name));
        }
        for name in resets {
            latch.reset(reset(name));
        }
        latch
    }

    fn copied(records: &[(&str, bool)]) -> BTreeMap<StopId, (StopRecord, Revision)> {
        let record = |(name, over): &(&str, bool)| {
            let record = StopRecord { stop: stop(name), reset: over.then(|| reset(name)) };
            (record.stop.stop_id.clone(), (record, Revision(7)))
        };
        records.iter().map(record).collect()
    }

    /// Each written row with who did it and what it says of the stop.
    fn said(items: &[Item]) -> Vec<(String, String, Option<bool>)> {
        let row = |item: &Item| {
            let change = &item.rows[0];
            let record = crate::projection::written::<StopRecord>(item);
            (change.key.id.to_string(), item.actor.to_string(), record.map(|record| record.is_effective()))
        };
        items.iter().map(row).collect()
    }

    #[test]
    fn what_is_engaged_and_reset_is_copied_once_with_who_did_it() {
        let known = latch(&["S1", "S2"], &["S2"]);
        let told = [("S1", "anna", true), ("S2", "anna", true), ("S2", "bert", false)];
        let told = told.map(|(name, actor, effective)| (name.to_owned(), actor.to_owned(), Some(effective)));
        let items = copy(&known, &BTreeMap::new());
        assert_eq!(said(&items), told);
        let actions: Vec<_> = items.iter().filter_map(|item| Some(item.note.as_ref()?.action)).collect();
        assert_eq!(actions, ["stop.engage", "stop.engage", "stop.reset"], "each in the audit, by whoever it was");
        assert_eq!(said(&copy(&known, &copied(&[("S1", false), ("S2", false)]))), told[2..]);
        assert_eq!(said(&copy(&known, &copied(&[("S1", false), ("S2", true)]))), []);
    }

    #[test]
    fn a_latch_that_was_lost_takes_no_stop_out_of_the_copy_and_a_reset_by_name_ends_it() {
        let lost = copied(&[("S1", false)]);
        assert_eq!(said(&copy(&latch(&[], &[]), &lost)), []);
        let ended = [("S1".to_owned(), "bert".to_owned(), Some(false))];
        assert_eq!(said(&copy(&latch(&[], &["S1"]), &lost)), ended);
    }

    #[test]
    fn a_stop_that_was_reset_and_forgotten_leaves_the_copy() {
        let forgotten = [("S1".to_owned(), "bert".to_owned(), None)];
        assert_eq!(said(&copy(&latch(&[], &[]), &copied(&[("S1", true)]))), forgotten);
    }

    #[test]
    fn the_token_of_a_stop_is_in_the_audit_and_stays_in_the_copy_when_the_stop_came_back_without_it() {
        let token_id = crate::identity::TokenId::new("t1");
        let mut known = Latch::default();
        known.engage(Stop { token_id: token_id.clone(), ..stop("S1") });
        known.reset(Reset { token_id: token_id.clone(), ..reset("S1") });
        let items = copy(&known, &BTreeMap::new());
        assert!(items.len() == 2 && items.iter().all(|item| item.token == token_id), "{items:?}");
        let record = crate::projection::written::<StopRecord>(&items[1]).expect("a record");
        let copied = BTreeMap::from([(record.stop.stop_id.clone(), (record, Revision(2)))]);
        assert_eq!(copy(&latch(&["S1"], &["S1"]), &copied), [], "a robot brought it back: it is the same");
    }
}
