//! One cycle of the planner: takes what robots say, brings each robot and each roll-out a step further, and writes
//! serving time.
//!
//! Invariant: the projection has absorbed the whole feed before anything is decided on it.

use super::decision::directive::{NoSign, Sign};
use super::decision::plan::{Plan, Tx};
use super::facts::reports;
use super::members::newcomers;
use super::phases::advance;
use super::projection::rows::{OtaClock, OtaMark, Phase, Rollout};
use super::projection::state::RolloutProjection;
use super::robots::machine::Move;
use super::robots::{drains, due, moves};
use crate::fleet::Board;
use crate::ids::{RobotId, RolloutId};
use crate::reason::Code;
use crate::rows::{Record, Seq};
use crate::time::Now;
use std::collections::BTreeSet;

/// Robots brought further in one cycle; the next one follows at once.
const MOVES_PER_CYCLE: usize = 1_024;

/// One cycle over a view that has absorbed the whole feed. Items of earlier decisions of the cycle are already in
/// `plan`. `heard`: robots with a new heartbeat. `sign`: or why nothing can be signed that robots take; then roll-outs
/// stand still, and nobody is told what would have to be signed. True: there is more to do at once.
pub fn cycle(
    view: &mut RolloutProjection,
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
        write_passed(view, now, first, plan);
    }
    if !more {
        write_time(view, now, plan);
    }
    more
}

/// What changed nothing when it was said is not heard again after a restart: by then it might change something. Written
/// before the first decision that it came before.
fn write_passed(view: &mut RolloutProjection, now: Now, first: usize, plan: &mut Plan) {
    let passed = view.passed;
    if view.marks.get("ota").is_none_or(|m| m.row.seq < passed) {
        let mut tx = Tx::new(view, now, "ota");
        tx.put_row(OtaMark { seq: passed }, "ota.passed");
        if let Some(item) = tx.finish() {
            plan.items.insert(first, item);
        }
    }
}

/// Everything but the service's own rows. True: there is more to do at once.
fn plan_all(
    view: &mut RolloutProjection,
    now: Now,
    board: &Board,
    heard: &BTreeSet<RobotId>,
    sign: &dyn Sign,
    plan: &mut Plan,
) -> bool {
    for live in heard.iter().filter_map(|id| board.get(id)) {
        view.keep_contact(live);
    }
    repair_from_heartbeats(view, now, board, heard, plan);
    add_newcomers(view, now, board, plan);
    let open: Vec<RolloutId> =
        view.rollouts.values().map(|r| &r.row).filter(|r| !r.phase.is_over()).map(|r| r.rollout_id.clone()).collect();
    for id in &open {
        plan.decide(view, now, "ota", |tx| advance::guard(tx, board, id));
    }
    let mut moves = 0;
    for id in due_robots(view) {
        let Some(row) = view.robots.get(id.as_str()).map(|r| &r.row) else { continue };
        let Some(rollout) = view.rollout(&row.rollout_id) else { continue };
        let due = due::decide_move(view, board, &now, rollout, row);
        let is_withheld =
            |due: &Move| moves::is_signed(view, rollout, row, due) && moves::why_unsigned(view, row).is_some();
        if let Some(due) = due.filter(|due| !is_withheld(due)) {
            if moves == MOVES_PER_CYCLE {
                return true;
            }
            moves += 1;
            plan.decide(view, now, "ota", |tx| moves::apply(tx, sign, board, &id, due));
        }
    }
    for id in open {
        plan.decide(view, now, "ota", |tx| advance::advance_rollout(tx, board, &id));
    }
    plan.decide(view, now, "ota", drains::forget_drains);
    false
}

/// Heartbeats that say what the rows do not.
fn repair_from_heartbeats(
    view: &mut RolloutProjection,
    now: Now,
    board: &Board,
    heard: &BTreeSet<RobotId>,
    plan: &mut Plan,
) {
    for robot_id in heard {
        if let Some(live) = board.get(robot_id)
            && view.is_settled(live)
            && reports::is_repair_due(view, live)
        {
            plan.decide(view, now, robot_id.as_str(), |tx| reports::repair(tx, live));
        }
    }
}

/// Robots that came since: whoever should have had a part in a completed roll-out gets one.
fn add_newcomers(view: &mut RolloutProjection, now: Now, board: &Board, plan: &mut Plan) {
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
        if let Some(rollout) = newcomers::find_rollout(view, board, &robot_id) {
            plan.decide(view, now, "ota", |tx| newcomers::add_newcomer(tx, board, &robot_id, &rollout));
        }
    }
}

/// Ids of robots' rows that something may be due for, by roll-out, wave and rank.
fn due_robots(view: &RolloutProjection) -> Vec<String> {
    let mut ids = view.open.clone();
    let whole = |r: &&Rollout| {
        matches!(r.phase, Phase::Aborting | Phase::RollingBack) || (r.second_pass && r.phase == Phase::Applying)
    };
    for rollout in view.rollouts.values().map(|r| &r.row).filter(whole) {
        ids.extend(view.robots_of(&rollout.rollout_id).map(Record::id));
    }
    let applies = |id: &&String| {
        let row = view.robots.get(id.as_str()).map(|r| &r.row);
        row.and_then(|r| view.rollout(&r.rollout_id)).is_some_and(|rollout| rollout.phase == Phase::Applying)
    };
    ids.extend(view.waiting_out.iter().filter(applies).cloned());
    let mut ids: Vec<String> = ids.into_iter().collect();
    let order = |id: &String| {
        view.robots
            .get(id.as_str())
            .map(|r| (r.row.rollout_id.clone(), r.row.failure.is_none(), r.row.wave, r.row.rank))
    };
    ids.sort_by_cached_key(order);
    ids
}

/// Entries after which the consumed position is written though nothing else is: logs are never pruned past it.
const CONSUMED_MAX: u64 = 10_000;

/// Writes serving time and the consumed position, at most once a second, with something else or when there was much to
/// consume.
fn write_time(view: &mut RolloutProjection, now: Now, plan: &mut Plan) {
    let clock = view.clocks.get("ota").map(|c| c.row).unwrap_or_default();
    let consumed = view.marks.get("ota").map_or(Seq(0), |m| m.row.seq);
    if plan.items.is_empty() && view.absorbed.0.saturating_sub(consumed.0) < CONSUMED_MAX {
        return;
    }
    let site_ms = view.served_ms(&now);
    if site_ms >= clock.site_ms + 1_000 || clock == OtaClock::default() {
        plan.decide(view, now, "ota", |tx| {
            tx.put_row(OtaClock { site_ms, ..clock }, "ota.served");
            tx.put_row(OtaMark { seq: tx.view.absorbed }, "ota.consumed");
        });
    }
}
