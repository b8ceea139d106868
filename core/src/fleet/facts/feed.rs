//! Takes entries of the feed in commit order: rows into the projection, requests and robots' events into decisions.
//!
//! Invariant: an entry is obeyed once. Its item writes the mark; an entry that can never be obeyed is passed over, and a person is told.

use super::{inbox, requests};
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::{Plan, Tx, mark};
use crate::fleet::projection::index;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::FleetMark;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::arrivals;
use crate::ids::RobotId;
use crate::item::Item;
use crate::reason::{Code, Reason};
use crate::robot_events::InboxEntry;
use crate::rows::{BadRow, Entry, Key, Log, Revision, Row, Seq, Table};
use crate::task::TaskRequest;
use crate::time::Now;
use std::collections::BTreeMap;

/// Logs that fleet reads.
pub const LOGS: &[Log] = &[Log::Task, Log::Fleet, Log::Telemetry, Log::RobotInbox, Log::Ota, Log::Stop, Log::Identity];

/// Takes entries of the feed, in commit order: rows into the view, requests and robots' events into decisions.
pub fn absorb(view: &mut FleetProjection, now: Now, board: &Board, entries: &[Entry], plan: &mut Plan) {
    let consumed = view.marks.get("fleet").map_or(Seq(0), |m| m.row.seq);
    for entry in entries {
        take_row(view, entry, &mut plan.report.unreadable);
        if entry.seq <= consumed {
            continue;
        }
        if view.unusable.contains(&entry.seq) {
            plan.decide(view, now, "fleet", |tx| pass_over(tx, entry));
            lose_word(view, now, entry, plan);
            continue;
        }
        match (entry.log, entry.table, &entry.body) {
            (Log::RobotInbox, None, Some(body)) => match InboxEntry::parse(body) {
                Ok(said) => {
                    let mut tally = plan.report.tally;
                    let is_obeyed = plan.decide(view, now, said.robot_id.as_str(), |tx| {
                        inbox::obey_entry(tx, &said, board, &mut tally);
                        mark(tx, entry.seq);
                    });
                    plan.report.tally = tally;
                    if !is_obeyed {
                        plan.decide(view, now, "fleet", |tx| pass_over(tx, entry));
                        lose_word(view, now, entry, plan);
                    }
                }
                Err(error) => {
                    plan.report.unreadable.push(format!("inbox {}: {error}", entry.seq.0));
                    lose_word(view, now, entry, plan);
                }
            },
            (Log::Task, Some(Table::TaskRequest), Some(body)) => {
                let key = Key::new(Table::TaskRequest, &*entry.subject);
                let row = Row { key, revision: Revision(1), index: entry.index.clone(), body: body.clone() };
                match row.decode::<TaskRequest>() {
                    Ok(request) => {
                        if !requests::obey_request(view, now, &request, entry, plan) {
                            plan.decide(view, now, "fleet", |tx| pass_over(tx, entry));
                        }
                    }
                    // A newer version knows the word. Meanwhile those of its tasks that wait are offered to nobody.
                    Err(error) => {
                        plan.report.unreadable.push(format!("request {}: {error}", entry.seq.0));
                        view.unknown_rows.keep_aside(&row, &error);
                    }
                }
            }
            (Log::Telemetry, None, _) if matches!(&*entry.kind, CLONE_SEEN | NOT_ENROLLED_SEEN | REPORT_TOO_LONG) => {
                plan.decide(view, now, "fleet", |tx| {
                    let robot_id = RobotId::parse(&entry.subject).ok();
                    incidents::open_once(tx, told_by_telemetry(entry), robot_id.as_ref());
                    mark(tx, entry.seq);
                });
            }
            (Log::Telemetry, None, _) if &*entry.kind == NOT_UNDERSTOOD_SEEN => {
                plan.decide(view, now, "fleet", |tx| {
                    let robot_id = RobotId::parse(&entry.subject).ok();
                    incidents::open_about(tx, told_by_telemetry(entry), robot_id.as_ref(), "");
                    mark(tx, entry.seq);
                });
            }
            (Log::Ota | Log::Stop, None, Some(body)) if &*entry.kind == crate::drain_request::INCIDENT => {
                match serde_json::from_str::<Reason>(body) {
                    Ok(reason) => {
                        let by = if entry.log == Log::Stop { "stop" } else { "ota" };
                        plan.decide(view, now, by, |tx| {
                            incidents::open(tx, reason, RobotId::parse(&entry.subject).ok().as_ref(), None);
                            mark(tx, entry.seq);
                        });
                    }
                    Err(error) => plan.report.unreadable.push(format!("incident {}: {error}", entry.seq.0)),
                }
            }
            _ => {}
        }
    }
}

fn take_row(view: &mut FleetProjection, entry: &Entry, unreadable: &mut Vec<String>) {
    if let Some(table) = entry.table.filter(|_| entry.seq > view.read_at) {
        let key = crate::rows::Key { table, id: entry.subject.clone() };
        if let Err(error) = view.absorb(&key, entry.revision, crate::projection::row_of(entry, table).as_ref()) {
            unreadable.push(error.to_string());
        }
        view.refused.row_changed(&key);
    }
    view.absorbed = view.absorbed.max(entry.seq);
}

/// Takes entries of the feed as somebody does who decides nothing: rows only. What a planner would have to look at is not gathered.
pub fn follow_rows(view: &mut FleetProjection, now: Now, entries: &[Entry], unreadable: &mut Vec<String>) {
    for entry in entries {
        take_row(view, entry, unreadable);
        if entry.table == Some(Table::ServiceClock) {
            view.served = view.clocks.get("fleet").map(|c| c.row).unwrap_or_default();
            view.read = now;
        }
    }
    index::advance(view, now.utc);
    view.rest();
}

/// Puts rows as they were just read over what was to become of them: an item that touches `keys` was not applied.
///
/// # Errors
/// A row that cannot be read.
pub fn reread(view: &mut FleetProjection, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
    put_right(view, keys, rows)?;
    view.rest();
    Ok(())
}

/// Puts rows as they were just read over what was to become of `keys`; other rows are those that [`named`](crate::fleet::projection::named) names, which this projection
/// may have let go.
///
/// # Errors
/// A row that cannot be read.
pub fn put_right(view: &mut FleetProjection, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
    let found: BTreeMap<&Key, &Row> = rows.iter().map(|row| (&row.key, row)).collect();
    for key in keys {
        view.put_right(key, found.get(key).copied())?;
    }
    rows.iter().try_for_each(|row| view.absorb(&row.key, row.revision, Some(row)))
}

/// What an entry asks for can never be written: a person is told, and the rest of the log goes on.
fn pass_over(tx: &mut Tx, entry: &Entry) {
    let reason = Reason::from(Code::EntryPassedOver).with("seq", entry.seq.0).with("kind", &entry.kind);
    incidents::open(tx, reason, None, None);
    mark(tx, entry.seq);
}

/// An entry of the inbox that is not obeyed may have said where its robot was.
fn lose_word(view: &mut FleetProjection, now: Now, entry: &Entry, plan: &mut Plan) {
    if let Some(robot_id) = RobotId::parse(&entry.subject).ok().filter(|_| entry.log == Log::RobotInbox) {
        plan.decide(view, now, "fleet", |tx| arrivals::lost(tx, &robot_id));
    }
}

/// The entry of the feed that an item obeys: the mark it writes.
pub fn obeyed(item: &Item) -> Option<Seq> {
    crate::projection::written::<FleetMark>(item).map(|mark| mark.seq)
}

/// Kind of the fact that a second machine has attached with a robot's name, stated by telemetry.
pub const CLONE_SEEN: &str = "session.clone_seen";

/// Kind of the fact that a machine with a genuine certificate has attached that is not enrolled, stated by telemetry.
pub const NOT_ENROLLED_SEEN: &str = "session.not_enrolled_seen";

/// Kind of the fact that a heartbeat had a list longer than one may be and was not processed, stated by telemetry.
pub const REPORT_TOO_LONG: &str = "session.report_too_long";

/// Kind of the fact that a robot dials again and again and is refused because of what it says, stated by telemetry.
pub const NOT_UNDERSTOOD_SEEN: &str = "session.not_understood_seen";

/// What telemetry met: the start and certificate of a second machine, the key and certificate of one that is not enrolled, the list that was too long, or why
/// a robot is refused.
fn told_by_telemetry(entry: &Entry) -> Reason {
    let said: BTreeMap<String, serde_json::Value> =
        entry.body.as_deref().and_then(|body| serde_json::from_str(body).ok()).unwrap_or_default();
    let code = match &*entry.kind {
        CLONE_SEEN => Code::CloneSeen,
        NOT_ENROLLED_SEEN => Code::RobotNotEnrolled,
        NOT_UNDERSTOOD_SEEN => Code::RobotNotUnderstood,
        _ => Code::ReportTooLong,
    };
    let known =
        ["boot_id", "certificate", "key", "list"].into_iter().filter_map(|key| Some((key, said.get(key)?.as_str()?)));
    let told = match said.get("why").and_then(|why| why.as_str()) {
        Some(why) => Reason::new(code, format!("It dials and is refused: {why}.")),
        None => code.into(),
    };
    known.fold(told, |reason, (key, value)| reason.with(key, value))
}
