//! The law of roll-outs: which robot gets which bundle when, what counts for and against it, and the way back.
//!
//! [`cycle`] takes what happened and gives items to commit; the service around it only reads, signs, commits and publishes.
//! Rooms: `spec` and `requests` are what is asked for, `rows` and `view` are what is known; `hear` and `commands` are what happens
//! (`refusals`: what robots would not take); `matching` says who and `dry_run` what it would come to, `robots` says what is due for each
//! (`turns`: whose turn it is) and `moves` writes it, `phases` the whole, `ending` whether enough have it at the end, `newcomers` who comes
//! later (`served`: what they get; `assign`: how anybody comes in), `named` which bundles are still needed, `past` what the picture holds of
//! what has ended; `verdict`, `jams` and `infrastructure` judge, with what `effort` saw; `explain` says what a robot waits for. Rooms name
//! each other in one direction only.
//! Invariant: no IO, no clock, no hash-map order; the same inputs give the same items.

pub mod assign;
pub mod bugs;
pub mod commands;
pub mod dry_run;
pub mod effort;
pub mod ending;
pub mod explain;
pub mod hear;
pub mod infrastructure;
pub mod jams;
pub mod matching;
pub mod moves;
pub mod named;
pub mod newcomers;
mod noted;
pub mod objects;
pub mod past;
pub mod phases;
pub mod refusals;
pub mod requests;
pub mod robots;
pub mod rows;
pub mod served;
pub mod spec;
pub mod stamp;
pub mod turns;
pub mod verdict;
pub mod view;

#[cfg(test)]
mod tests;

pub use crate::fleet::Board;
use crate::identity::Actor;
use crate::ids::{BundleId, RobotId, RolloutId};
use crate::lead::Rivals;
use crate::reason::{Code, Reason};
use crate::rows::{BadRow, Entry, Item, Key, Log, Revision, Row, Seq, Table};
use crate::time::{Now, Utc};
use crate::work::InboxEntry;
use rows::{OtaClock, OtaMark, Phase};
use std::collections::BTreeSet;
use view::View;

/// A decision of the rollout service under way.
pub type Tx<'a> = crate::picture::Tx<'a, View>;

/// Logs that the service reads.
pub const LOGS: &[Log] = &[Log::Ota, Log::Fleet, Log::Telemetry, Log::RobotInbox];

/// What a directive says.
#[derive(Clone, Copy, Debug)]
pub struct Order<'a> {
    /// To whom.
    pub robot_id: &'a RobotId,
    /// Rises with each directive of the robot.
    pub generation: u64,
    /// Which bundle.
    pub bundle: &'a BundleId,
    /// Bytes of its manifest.
    pub manifest_length: u64,
    /// No component may have a lower `rollback_index`.
    pub rollback_floor: u64,
    /// For which roll-out.
    pub rollout_id: &'a RolloutId,
    /// UTC of the wall.
    pub issued_at: Utc,
}

/// Signs directives. The same order gives the same envelope.
pub trait Sign {
    /// The envelope, as text.
    fn directive(&self, order: &Order) -> String;
}

/// Where nothing has to be signed.
struct NoSign;

impl Sign for NoSign {
    fn directive(&self, _order: &Order) -> String {
        String::new()
    }
}

/// Items to commit, in order, and what could not be read.
#[derive(Debug, Default)]
pub struct Plan {
    /// Each atomic by itself; later ones expect the revisions that earlier ones write.
    pub items: Vec<Item>,
    /// Rows or entries that could not be read; each was passed over and is logged.
    pub unreadable: Vec<String>,
}

impl Plan {
    /// Makes one decision; nothing is added if it changed nothing, or if it touches a row of a newer version.
    pub fn decide(&mut self, view: &mut View, now: Now, actor: impl Into<Actor>, decision: impl FnOnce(&mut Tx)) {
        let mut tx = Tx::new(view, now, actor);
        decision(&mut tx);
        if tx.unknown_row().is_some() {
            tx.take_back();
            return;
        }
        self.items.extend(tx.finish());
    }
}

/// States that a person should look into something.
fn incident(tx: &mut Tx, robot_id: Option<&RobotId>, reason: &Reason) {
    tx.tell(robot_id.map_or("", RobotId::as_str), crate::maintenance::INCIDENT, reason);
}

/// States that a signed file is damaged on the server's disk.
pub fn tell_damaged(view: &mut View, now: Now, digest: &str, plan: &mut Plan) {
    let reason = Reason::from(Code::SoftwareDamaged).with("digest", digest);
    plan.decide(view, now, "ota", |tx| incident(tx, None, &reason));
}

/// Entry of the log that an item obeys, if it obeys one.
pub fn obeyed(item: &Item) -> Option<Seq> {
    crate::picture::written::<OtaMark>(item).map(|mark| mark.seq)
}

/// Takes entries of the feed, in commit order: rows into the view, robots' events into decisions.
pub fn absorb(view: &mut View, now: Now, entries: &[Entry], plan: &mut Plan) {
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
            tx.put(OtaMark { seq: entry.seq }, "ota.consumed");
            plan.items.extend(tx.finish());
            continue;
        }
        match InboxEntry::parse(body) {
            Ok(said) => {
                let mut tx = Tx::new(view, now, said.robot_id.as_str());
                hear::take(&mut tx, &said);
                if tx.rows() > 0 {
                    tx.put(OtaMark { seq: entry.seq }, "ota.consumed");
                } else {
                    tx.view.passed = entry.seq;
                }
                plan.items.extend(tx.finish());
            }
            Err(error) => plan.unreadable.push(format!("inbox {}: {error}", entry.seq.0)),
        }
    }
}

fn take_row(view: &mut View, entry: &Entry, unreadable: &mut Vec<String>) {
    let table = entry.table.filter(|_| entry.seq > view.read_at);
    if let Some(table) = table.filter(|table| !past::is_elsewhere(view, entry, *table)) {
        let key = Key { table, id: entry.subject.clone() };
        if let Err(error) = view.absorb(&key, entry.revision, crate::picture::row_of(entry, table).as_ref()) {
            unreadable.push(error.to_string());
        }
    }
    view.absorbed = view.absorbed.max(entry.seq);
}

/// Takes entries of the feed as somebody does who decides nothing: rows only. What a planner would have to look at is not gathered.
pub fn follow_rows(view: &mut View, now: Now, entries: &[Entry], unreadable: &mut Vec<String>) {
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
pub fn reread(view: &mut View, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
    for key in keys {
        view.absorb(key, Revision(u64::MAX), None)?;
        if let Some(row) = rows.iter().find(|row| row.key == *key) {
            view.absorb(key, row.revision, Some(row))?;
        }
    }
    view.arrived.clear();
    Ok(())
}

/// Who else may plan on a store that other processes open too, or not.
pub fn rivals(is_shared: bool, bugs: bugs::Bugs) -> Rivals {
    match (bugs.everybody_leads(), is_shared) {
        (true, _) => Rivals::Ignored,
        (false, true) => Rivals::Some,
        (false, false) => Rivals::None,
    }
}

/// Robots brought further in one cycle; the next one follows at once.
const MOVES_PER_CYCLE: usize = 1_024;

/// One cycle over a view that has absorbed the whole feed. Items of earlier decisions of the cycle are already in `plan`. `heard`: robots with
/// a new heartbeat. `sign`: or why nothing can be signed that robots take; then roll-outs stand still, and nobody is told what would have to be
/// signed. True: there is more to do at once.
pub fn cycle(
    view: &mut View,
    now: Now,
    board: &Board,
    heard: &BTreeSet<RobotId>,
    sign: Result<&dyn Sign, Code>,
    plan: &mut Plan,
) -> bool {
    let first = plan.items.len();
    view.keyless = sign.err();
    let more = plan_all(view, now, board, heard, sign.unwrap_or(&NoSign), plan);
    if plan.items.len() > first {
        pass(view, now, first, plan);
    }
    if !more {
        tell_time(view, now, plan);
    }
    more
}

/// What changed nothing when it was said is not heard again after a restart: by then it might change something. Written before the first
/// decision that it came before.
fn pass(view: &mut View, now: Now, first: usize, plan: &mut Plan) {
    let passed = view.passed;
    if view.marks.get("ota").is_none_or(|m| m.row.seq < passed) {
        let mut tx = Tx::new(view, now, "ota");
        tx.put(OtaMark { seq: passed }, "ota.passed");
        if let Some(item) = tx.finish() {
            plan.items.insert(first, item);
        }
    }
}

/// Everything but the service's own rows. True: there is more to do at once.
fn plan_all(
    view: &mut View,
    now: Now,
    board: &Board,
    heard: &BTreeSet<RobotId>,
    sign: &dyn Sign,
    plan: &mut Plan,
) -> bool {
    for live in heard.iter().filter_map(|id| board.get(id)) {
        view.keep_contact(live);
    }
    listen(view, now, board, heard, plan);
    welcome(view, now, board, plan);
    let open: Vec<RolloutId> =
        view.rollouts.values().map(|r| &r.row).filter(|r| !r.phase.is_over()).map(|r| r.rollout_id.clone()).collect();
    for id in &open {
        plan.decide(view, now, "ota", |tx| phases::guard(tx, board, id));
    }
    let mut moves = 0;
    for id in due(view) {
        let Some(row) = view.robots.get(&id).map(|r| &r.row) else { continue };
        let Some(rollout) = view.rollout(&row.rollout_id) else { continue };
        let due = robots::next(view, board, &now, rollout, row);
        let is_withheld =
            |due: &robots::Move| moves::is_signed(view, rollout, row, due) && moves::unsigned(view, row).is_some();
        if let Some(due) = due.filter(|due| !is_withheld(due)) {
            if moves == MOVES_PER_CYCLE {
                return true;
            }
            moves += 1;
            plan.decide(view, now, "ota", |tx| moves::make(tx, sign, board, &id, due));
        }
    }
    for id in open {
        plan.decide(view, now, "ota", |tx| phases::further(tx, board, &id));
    }
    plan.decide(view, now, "ota", moves::forget_drains);
    false
}

/// Heartbeats that say what the rows do not.
fn listen(view: &mut View, now: Now, board: &Board, heard: &BTreeSet<RobotId>, plan: &mut Plan) {
    for robot_id in heard {
        if let Some(live) = board.get(robot_id)
            && view.is_settled(live)
            && hear::is_due(view, live)
        {
            plan.decide(view, now, robot_id.as_str(), |tx| hear::repair(tx, live));
        }
    }
}

/// Robots that came since: whoever should have had a part in a completed roll-out gets one.
fn welcome(view: &mut View, now: Now, board: &Board, plan: &mut Plan) {
    if view.area_bundles.is_empty() {
        return;
    }
    let heard: Vec<RobotId> = view.arrived.iter().filter(|id| board.contains_key(*id)).cloned().collect();
    for robot_id in heard {
        let settled = board.get(&robot_id).is_some_and(|live| view.is_settled(live));
        if !settled {
            continue;
        }
        view.arrived.remove(&robot_id);
        if let Some(rollout) = newcomers::due(view, board, &robot_id) {
            plan.decide(view, now, "ota", |tx| newcomers::add(tx, board, &robot_id, &rollout));
        }
    }
}

/// Ids of robots' rows that something may be due for, by roll-out, wave and place.
fn due(view: &View) -> Vec<String> {
    let mut ids = view.open.clone();
    let whole = |r: &&rows::Rollout| {
        matches!(r.phase, Phase::Aborting | Phase::RollingBack) || (r.second_pass && r.phase == Phase::Applying)
    };
    for rollout in view.rollouts.values().map(|r| &r.row).filter(whole) {
        ids.extend(view.robots_of(&rollout.rollout_id).map(crate::rows::Record::id));
    }
    let applies = |id: &&String| {
        let row = view.robots.get(*id).map(|r| &r.row);
        row.and_then(|r| view.rollout(&r.rollout_id)).is_some_and(|rollout| rollout.phase == Phase::Applying)
    };
    ids.extend(view.waiting_out.iter().filter(applies).cloned());
    let mut ids: Vec<String> = ids.into_iter().collect();
    let order = |id: &String| {
        view.robots.get(id).map(|r| (r.row.rollout_id.clone(), r.row.failure.is_none(), r.row.wave, r.row.place))
    };
    ids.sort_by_cached_key(order);
    ids
}

/// Entries after which the consumed position is written though nothing else is: logs are never pruned past it.
const CONSUMED_MAX: u64 = 10_000;

/// Writes serving time and the consumed position, at most once a second, with something else or when there was much to consume.
fn tell_time(view: &mut View, now: Now, plan: &mut Plan) {
    let clock = view.clocks.get("ota").map(|c| c.row).unwrap_or_default();
    let consumed = view.marks.get("ota").map_or(Seq(0), |m| m.row.seq);
    if plan.items.is_empty() && view.absorbed.0.saturating_sub(consumed.0) < CONSUMED_MAX {
        return;
    }
    let site_ms = view.served_ms(&now);
    if site_ms >= clock.site_ms + 1_000 || clock == OtaClock::default() {
        plan.decide(view, now, "ota", |tx| {
            tx.put(OtaClock { site_ms, ..clock }, "ota.served");
            tx.put(OtaMark { seq: tx.view.absorbed }, "ota.consumed");
        });
    }
}
