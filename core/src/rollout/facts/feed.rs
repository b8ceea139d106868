//! Takes entries of the feed: rows into the projection, and robots' events into decisions.
//!
//! Invariant: an entry of the inbox is obeyed once; the item that obeys it writes how far the feed is consumed.

use super::reports;
use crate::item::Item;
use crate::projection;
use crate::reason::{Code, Reason};
use crate::robot_events::InboxEntry;
use crate::rollout::decision::plan::{Plan, Tx, incident};
use crate::rollout::projection::ended;
use crate::rollout::projection::rows::OtaMark;
use crate::rollout::projection::state::RolloutProjection;
use crate::rows::{BadRow, Entry, Key, Log, Revision, Row, Seq, Table};
use crate::time::Now;

/// Logs that the service reads.
pub const LOGS: &[Log] = &[Log::Ota, Log::Fleet, Log::Telemetry, Log::RobotInbox];

/// Entry of the log that an item obeys, if it obeys one.
pub fn obeyed(item: &Item) -> Option<Seq> {
    projection::written::<OtaMark>(item).map(|mark| mark.seq)
}

/// Takes entries of the feed, in commit order: rows into the view, robots' events into decisions.
pub fn absorb(view: &mut RolloutProjection, now: Now, entries: &[Entry], plan: &mut Plan) {
    let consumed = view.marks.get("ota").map_or(Seq(0), |m| m.row.seq);
    for entry in entries {
        take_row(view, entry, &mut plan.unreadable);
        let (Log::RobotInbox, None, Some(body)) = (entry.log, entry.table, &entry.body) else { continue };
        if entry.seq <= consumed {
            continue;
        }
        if view.unusable.contains(&entry.seq) {
            let mut tx = Tx::new(view, now, "ota");
            let reason = Reason::from(Code::EntryPassedOver).with("seq", entry.seq.0).with("kind", &entry.kind);
            incident(&mut tx, None, &reason);
            tx.put_row(OtaMark { seq: entry.seq }, "ota.consumed");
            plan.items.extend(tx.finish());
            continue;
        }
        match InboxEntry::parse(body) {
            Ok(said) => {
                let mut tx = Tx::new(view, now, said.robot_id.as_str());
                reports::obey_event(&mut tx, &said);
                if tx.rows() > 0 {
                    tx.put_row(OtaMark { seq: entry.seq }, "ota.consumed");
                } else {
                    tx.view.passed = entry.seq;
                }
                plan.items.extend(tx.finish());
            }
            Err(error) => plan.unreadable.push(format!("inbox {}: {error}", entry.seq.0)),
        }
    }
}

fn take_row(view: &mut RolloutProjection, entry: &Entry, unreadable: &mut Vec<String>) {
    let table = entry.table.filter(|_| entry.seq > view.read_at);
    if let Some(table) = table.filter(|table| !ended::is_elsewhere(view, entry, *table)) {
        let key = Key { table, id: entry.subject.clone() };
        if let Err(error) = view.take_row(&key, entry.revision, projection::row_of(entry, table).as_ref()) {
            unreadable.push(error.to_string());
        }
    }
    view.absorbed = view.absorbed.max(entry.seq);
}

/// Takes entries of the feed as somebody does who decides nothing: rows only. What a planner would have to look at is
/// not gathered.
pub fn follow_rows(view: &mut RolloutProjection, now: Now, entries: &[Entry], unreadable: &mut Vec<String>) {
    for entry in entries {
        take_row(view, entry, unreadable);
        if entry.table == Some(Table::OtaClock) {
            view.served = view.clocks.get("ota").map(|c| c.row).unwrap_or_default();
            view.read = now;
        }
    }
    view.arrived.clear();
}

/// Puts rows as they were just read over what was to become of them: an item that touches `keys` was not applied.
///
/// # Errors
/// A row that cannot be read.
pub fn reread(view: &mut RolloutProjection, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
    for key in keys {
        view.take_row(key, Revision(u64::MAX), None)?;
        if let Some(row) = rows.iter().find(|row| row.key == *key) {
            view.take_row(key, row.revision, Some(row))?;
        }
    }
    view.arrived.clear();
    Ok(())
}

/// States that a signed file is damaged on the server's disk.
pub fn tell_damaged(view: &mut RolloutProjection, now: Now, digest: &str, plan: &mut Plan) {
    let reason = Reason::from(Code::SoftwareDamaged).with("digest", digest);
    plan.decide(view, now, "ota", |tx| incident(tx, None, &reason));
}
