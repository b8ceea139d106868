//! The law of the fleet: who gets which task, who may enter which place, what a heartbeat repairs, and why not now.
//!
//! [`cycle`] takes what happened and gives items to commit and a report; the service around it only reads, commits and publishes.
//! Rooms: `rows` and `view` are what is known; `inbox`, `requests`, `timers`, `repair`, `plausible`, `claims`, `arrivals`, `answers`, `commands` (`asked`: which there are) are what happens; `tasks` moves tasks by
//! the table and `breaker` counts what robots fail; `heard`, `anchor`, `attempts`, `incidents` and `refused` are what they share; `queue`, `screen`, `pool` and `assign` give work, in turns cut by `slice`; `stops` and `stopped` keep it from who is stopped; `starts` keeps places for robots that are to come; `errands`, `drain`, `budget`, `places`, `desired`, `way` bring robots where they belong; `standing` says what is done or waited for, `explain` tells people, `unexplained` counts what nobody can say, `lasting` opens incidents of robots that stand for long, `closures` of places that are closed; `maps` says what a changed map waits for.
//! Invariant: no IO, no clock, no hash-map order; the same inputs give the same items.

pub mod anchor;
pub mod answers;
pub mod arrivals;
pub mod asked;
pub mod assign;
pub mod attempts;
pub mod breaker;
pub mod budget;
pub mod bugs;
pub mod claims;
pub mod closures;
pub mod commands;
pub mod desired;
pub mod drain;
pub mod errands;
pub mod explain;
pub mod heard;
pub mod inbox;
pub mod incidents;
pub mod lasting;
pub mod load;
pub mod maps;
pub mod misreads;
pub mod objects;
pub mod places;
pub mod plausible;
pub mod pool;
pub mod queue;
pub mod refused;
pub mod repair;
pub mod requests;
pub mod rows;
pub mod screen;
pub mod slice;
pub mod standing;
pub mod starts;
pub mod stopped;
pub mod stops;
pub mod sweep;
pub mod tasks;
pub mod timers;
pub mod unexplained;
pub mod view;
pub mod way;

#[cfg(test)]
mod tests;

use crate::identity::Actor;
use crate::ids::RobotId;
use crate::lead::Rivals;
use crate::reason::{Code, Reason};
use crate::rows::{BadRow, Entry, Item, Key, Log, Row, Seq, Table};
use crate::task::TaskRequest;
use crate::time::Now;
use crate::work::{InboxEntry, Live};
use rows::{FleetMark, RobotAuthority, RobotControl, RobotHolder, ServiceClock, SiteRow};
pub use slice::Slice;
use std::collections::BTreeMap;
use std::sync::Arc;
use view::View;

/// A decision of fleet under way.
pub type Tx<'a> = crate::picture::Tx<'a, View>;

/// The newest heartbeat of every robot.
pub type Board = BTreeMap<RobotId, Arc<Live>>;

/// What was counted on the way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Reports of an epoch that had passed, or of nothing that is known.
    pub fenced: u64,
    /// Messages that robots refused for their authority.
    pub stale_authority: u64,
    /// Differences between a heartbeat and the rows that were repaired.
    pub repaired: u64,
    /// Robots whose differences do not count yet.
    pub pending: u64,
    /// Robots that wait for a place.
    pub waiting_for_place: u64,
}

/// What a cycle did and why the rest was not done.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// Tasks offered.
    pub offers: u64,
    /// Errands offered.
    pub errands: u64,
    /// Ready tasks looked at.
    pub looked: u64,
    /// Something was left for the next turn.
    pub more: bool,
    /// Waiting tasks by reason.
    pub waiting: BTreeMap<Code, u64>,
    /// What was counted on the way.
    pub tally: Tally,
    /// Robots and tasks that stand for long without a reason, once each; logged.
    pub unexplained: Vec<String>,
    /// Rows or entries that could not be read; each was passed over and is logged.
    pub unreadable: Vec<String>,
}

/// Items to commit, in order, and the report.
#[derive(Debug, Default)]
pub struct Plan {
    /// Each atomic by itself; later ones expect the revisions that earlier ones write.
    pub items: Vec<Item>,
    /// What was done and why not.
    pub report: Report,
    /// What this turn may still do.
    pub slice: Slice,
}

impl Plan {
    /// An empty plan of a turn that may do so much.
    pub fn of(slice: Slice) -> Self {
        Self { slice, ..Self::default() }
    }
    /// Makes one decision; nothing is added if it changed nothing. False: it was given up, since the store would never take it.
    pub fn decide(
        &mut self,
        view: &mut View,
        now: Now,
        actor: impl Into<Actor>,
        decision: impl FnOnce(&mut Tx),
    ) -> bool {
        let mut tx = Tx::new(view, now, actor);
        decision(&mut tx);
        self.keep_decision(tx)
    }

    /// Adds a decision that was made. False: it was given up, since the store would never take it, or since it touches a row of a newer
    /// version.
    pub fn keep_decision(&mut self, mut tx: Tx) -> bool {
        if tx.unknown_row().is_some() {
            tx.take_back();
            return false;
        }
        let is_aside = tx.view.refused.keeps_any() && tx.view.refused.is_aside(&tx.outline());
        if !is_aside && !tx.is_too_large() {
            let item = tx.finish();
            self.slice.decide(usize::from(item.is_some()));
            self.items.extend(item);
            return true;
        }
        self.slice.decide(1);
        let outline = tx.outline();
        let view = tx.take_back();
        if !is_aside {
            refused::note_refusal(view, outline);
        }
        false
    }
    /// Whether a stage goes on in the next turn; then the next turn comes at once.
    fn is_cut(&mut self) -> bool {
        let is_cut = self.slice.is_spent();
        self.report.more |= is_cut;
        is_cut
    }
}

/// Logs that fleet reads.
pub const LOGS: &[Log] = &[Log::Task, Log::Fleet, Log::Telemetry, Log::RobotInbox, Log::Ota, Log::Stop, Log::Identity];

/// Takes entries of the feed, in commit order: rows into the view, requests and robots' events into decisions.
pub fn absorb(view: &mut View, now: Now, board: &Board, entries: &[Entry], plan: &mut Plan) {
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
                        inbox::take(tx, &said, board, &mut tally);
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
            (Log::Task, Some(Table::TaskRequest), Some(body)) => match serde_json::from_str::<TaskRequest>(body) {
                Ok(request) => {
                    if !requests::take(view, now, &request, entry, plan) {
                        plan.decide(view, now, "fleet", |tx| pass_over(tx, entry));
                    }
                }
                Err(error) => plan.report.unreadable.push(format!("request {}: {error}", entry.seq.0)),
            },
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
            (Log::Ota | Log::Stop, None, Some(body)) if &*entry.kind == crate::maintenance::INCIDENT => {
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

fn take_row(view: &mut View, entry: &Entry, unreadable: &mut Vec<String>) {
    if let Some(table) = entry.table.filter(|_| entry.seq > view.read_at) {
        let key = crate::rows::Key { table, id: entry.subject.clone() };
        if let Err(error) = view.absorb(&key, entry.revision, crate::picture::row_of(entry, table).as_ref()) {
            unreadable.push(error.to_string());
        }
        view.refused.row_changed(&key);
    }
    view.absorbed = view.absorbed.max(entry.seq);
}

/// Takes entries of the feed as somebody does who decides nothing: rows only. What a planner would have to look at is not gathered.
pub fn follow_rows(view: &mut View, now: Now, entries: &[Entry], unreadable: &mut Vec<String>) {
    for entry in entries {
        take_row(view, entry, unreadable);
        if entry.table == Some(Table::ServiceClock) {
            view.served = view.clocks.get("fleet").map(|c| c.row).unwrap_or_default();
            view.read = now;
        }
    }
    queue::advance(view, now.utc);
    view.rest();
}

/// Puts rows as they were just read over what was to become of them: an item that touches `keys` was not applied.
///
/// # Errors
/// A row that cannot be read.
pub fn reread(view: &mut View, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
    put_right(view, keys, rows)?;
    view.rest();
    Ok(())
}

/// Puts rows as they were just read over what was to become of `keys`; other rows are those that [`view::named`] names, which this picture
/// may have let go.
///
/// # Errors
/// A row that cannot be read.
pub fn put_right(view: &mut View, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
    let found: BTreeMap<&Key, &Row> = rows.iter().map(|row| (&row.key, row)).collect();
    for key in keys {
        view.put_right(key, found.get(key).copied())?;
    }
    rows.iter().try_for_each(|row| view.absorb(&row.key, row.revision, Some(row)))
}

/// Who else may plan on a store that other processes open too, or not.
pub fn rivals(is_shared: bool, bugs: bugs::Bugs) -> Rivals {
    match (bugs.everybody_leads(), is_shared) {
        (true, _) => Rivals::Ignored,
        (false, true) => Rivals::Some,
        (false, false) => Rivals::None,
    }
}

/// What an entry asks for can never be written: a person is told, and the rest of the log goes on.
fn pass_over(tx: &mut Tx, entry: &Entry) {
    let reason = Reason::from(Code::EntryPassedOver).with("seq", entry.seq.0).with("kind", &entry.kind);
    incidents::open(tx, reason, None, None);
    mark(tx, entry.seq);
}

/// An entry of the inbox that is not obeyed may have said where its robot was.
fn lose_word(view: &mut View, now: Now, entry: &Entry, plan: &mut Plan) {
    if let Some(robot_id) = RobotId::parse(&entry.subject).ok().filter(|_| entry.log == Log::RobotInbox) {
        plan.decide(view, now, "fleet", |tx| arrivals::lost(tx, &robot_id));
    }
}

/// The entry of the feed that an item obeys: the mark it writes.
pub fn obeyed(item: &Item) -> Option<Seq> {
    crate::picture::written::<FleetMark>(item).map(|mark| mark.seq)
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

fn mark(tx: &mut Tx, seq: Seq) {
    tx.put(FleetMark { seq }, "fleet.consumed");
}

/// Rows every start makes sure of: the site, its places, and serving time.
pub fn found(view: &mut View, now: Now, site_text: &str, map: &maps::MapChange, plan: &mut Plan) {
    maps::tell_of_change(view, now, map, plan);
    let site = view.site.clone();
    if view.sites.get(site.site_id().as_str()).is_some_and(|stored| stored.row.text != site_text) {
        arrivals::forget(view, now, plan);
    }
    plan.decide(view, now, "fleet", |tx| {
        let row = SiteRow {
            site_id: site.site_id().clone(),
            map_version: site.map_version().to_owned(),
            text: site_text.to_owned(),
        };
        if tx.view.sites.get(site.site_id().as_str()).is_none_or(|s| s.row != row) {
            tx.put(row, "site.loaded");
        }
    });
    for chunk in site.places().chunks(128) {
        plan.decide(view, now, "fleet", |tx| {
            for place in chunk {
                if site_has(tx.view, place) || tx.view.unknown_rows.is_place_aside(&place.place_id) {
                    continue;
                }
                let known = tx.view.places.get(place.place_id.as_str()).map(|p| p.row.clone());
                let fresh = places::fresh(place);
                let row = known.map_or(fresh.clone(), |k| rows::Place {
                    capacity: fresh.capacity,
                    standing: fresh.standing,
                    ..k
                });
                tx.put(row, "place.founded");
            }
        });
    }
    let all: Vec<RobotId> = view.sessions.values().map(|s| s.row.robot_id.clone()).collect();
    view.dirty.extend(all.iter().cloned());
    view.policy_dirty.extend(all);
}

fn site_has(view: &View, place: &crate::site::Place) -> bool {
    let standing = place.waypoint().is_some();
    view.places
        .get(place.place_id.as_str())
        .is_some_and(|p| p.row.capacity == place.capacity && p.row.standing == standing)
}

/// How much of a cycle is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Something happened: plan with what is known.
    Wake,
    /// The period is over: timers and every heartbeat too.
    Sweep,
}

/// One cycle over a view that has absorbed the whole feed. Items of earlier decisions of the cycle are already in `plan`. Each stage does as
/// much as a slice holds, and leaves the rest for the next turn: then the report says `more`.
pub fn cycle(view: &mut View, now: Now, board: &Board, pace: Pace, plan: &mut Plan) {
    view.screened.take();
    refused::open_incidents(view, now, plan);
    refused::try_again(view);
    welcome(view, now, board, plan);
    if pace == Pace::Sweep {
        sweep::gather(view, now, board);
    }
    plan.slice.renew();
    let heard = sweep::carry_out(view, now, board, plan);
    plan.slice.renew();
    if pace == Pace::Sweep || view.stops_changed {
        stops::plan(view, board, now, plan);
    }
    plan.slice.renew();
    drain::obey(view, now, plan);
    plan.slice.renew();
    budget::plan(view, board, now, plan);
    plan.slice.renew();
    drain::plan(view, board, now, plan);
    plan.slice.renew();
    queue::settle(view, now, plan);
    if pace == Pace::Sweep {
        queue::tell_backlog(view, now, plan);
    }
    plan.slice.renew();
    let idle = assign::plan(view, board, now, &heard, plan);
    errands::plan(view, board, now, idle, plan);
    plan.slice.renew();
    write_down(view, now, board, &desired::Releases::default(), plan);
    let releases = places::advance(view, board, now, plan);
    plan.slice.renew();
    write_down(view, now, board, &releases, plan);
    if pace == Pace::Sweep {
        plan.slice.renew();
        unexplained::count_unexplained(view, board, now, plan);
        lasting::tell_lasting(view, board, now, plan);
        closures::tell_closed(view, now, plan);
        misreads::close_understood(view, board, now, plan);
    }
    if !plan.items.is_empty() {
        tell_time(view, now, plan);
    }
    view.forget_ended();
}

/// Robots that are new get their rows.
fn welcome(view: &mut View, now: Now, board: &Board, plan: &mut Plan) {
    let new: Vec<RobotId> = board
        .keys()
        .filter(|r| view.sessions.contains_key(r.as_str()) && !view.authority.contains_key(r.as_str()))
        .cloned()
        .collect();
    for robot_id in new {
        if plan.is_cut() {
            return;
        }
        plan.decide(view, now, "fleet", |tx| {
            tx.put(RobotAuthority { robot_id: robot_id.clone(), holder: RobotHolder::None }, "robot.known");
            if !tx.view.control.contains_key(robot_id.as_str()) {
                tx.put(RobotControl::new(robot_id.clone()), "robot.known");
            }
            desired::compose_policy(tx, &robot_id);
        });
        view.dirty.insert(robot_id);
    }
}

/// Composes the desired state of every robot that something changed for; first of those that were just let go further.
fn write_down(view: &mut View, now: Now, board: &Board, releases: &desired::Releases, plan: &mut Plan) {
    let mut due = std::mem::take(&mut view.dirty);
    for robot_id in releases.0.keys() {
        due.remove(robot_id);
        plan.decide(view, now, "fleet", |tx| desired::compose(tx, robot_id, board, releases));
    }
    while let Some(robot_id) = due.first().filter(|_| !plan.is_cut()).cloned() {
        due.remove(&robot_id);
        plan.decide(view, now, "fleet", |tx| desired::compose(tx, &robot_id, board, releases));
    }
    view.dirty = due;
    while let Some(robot_id) = view.policy_dirty.first().filter(|_| !plan.is_cut()).cloned() {
        view.policy_dirty.remove(&robot_id);
        plan.decide(view, now, "fleet", |tx| desired::compose_policy(tx, &robot_id));
    }
}

/// Writes serving time and the consumed position with the items of this cycle, at most once a second.
fn tell_time(view: &mut View, now: Now, plan: &mut Plan) {
    let served = view.serving(&now);
    let written = view.clocks.get("fleet").map(|c| c.row).unwrap_or_default();
    if served.link_ms >= written.link_ms + 1_000 || written == ServiceClock::default() {
        plan.decide(view, now, "fleet", |tx| {
            tx.put(served, "fleet.served");
            mark(tx, tx.view.absorbed);
        });
    }
}
