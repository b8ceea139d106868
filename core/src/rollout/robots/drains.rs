//! Drains of robots for a roll-out: asked of fleet, released, counted, and forgotten when they are over.
//!
//! Invariants:
//! 1. A drain is released only for one of [`ReleasedBy`]. Time alone releases none.
//! 2. Robots out of work for a roll-out are counted in its row, in the item that takes one more.

use crate::drain_request::{DrainRelease, DrainRequest, ReleasedBy};
use crate::fleet::Board;
use crate::fleet::rows::{Drain, DrainState};
use crate::ids::{DrainId, RolloutId};
use crate::limits;
use crate::rollout::decision::plan::Tx;
use crate::rollout::projection::rows::{GivenPermission, OtaClock, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;
use crate::time::Now;
use crate::update::{UpdateReport, UpdateState};

/// Fleet was asked to take it out of work, and its drain has not begun.
pub(super) fn is_asked(view: &RolloutProjection, r: &RolloutRobot) -> bool {
    let waits = |id| view.drain(id).is_none_or(|drain| drain.state == DrainState::Waiting);
    r.step == Step::Draining && r.drain_id.as_ref().is_some_and(waits)
}

/// Asks fleet to take a robot out of work.
pub(super) fn ask_drain(tx: &mut Tx, rollout: &Rollout, r: &mut RolloutRobot, urgent: bool) {
    let Ok(drain_id) = DrainId::parse(&format!("ota:{}", next_number(tx, 0))) else { return };
    let is_way_back = rollout.phase.goes_back();
    let goal = if is_way_back || rollout.revert_of.is_some() { "goes back from" } else { "changes to" };
    let label = tx.view.bundles.get(rollout.spec.bundle.as_str()).map(|b| b.row.label()).unwrap_or_default();
    let request = DrainRequest {
        drain_id: drain_id.clone(),
        robot_id: r.robot_id.clone(),
        rollout_id: r.rollout_id.clone(),
        reason: format!("{goal} {label}"),
        within_ms: rollout.spec.drain_within_ms,
        urgent,
        is_way_back,
        forward: rollout.revert_of.is_none() && r.step == Step::Staged,
        written_off: !r.counts(),
    };
    tx.put_row(request, "drain.requested");
    r.drain_id = Some(drain_id);
    (r.ready, r.grant, r.not_used) = (false, None, false);
    if r.counts() {
        count_in_flight(tx, &r.rollout_id, 1);
    }
}

/// Rising, and never used again also after the store was restored; above `used`, which somebody says was given before.
pub(super) fn next_number(tx: &mut Tx, used: u64) -> u64 {
    let clock = tx.view.clocks.get("ota").map(|c| c.row).unwrap_or_default();
    let number = (clock.number.max(used) + 1).max(tx.now.wall.0.max(0) as u64);
    tx.put_row(OtaClock { number, ..clock }, "ota.numbered");
    number
}

/// Whether a permission was seen unused, so that its drain may be left: past its life a heartbeat of the current session
/// says so, and nothing it said before is on its way. `report`: what the robot said of its directive.
pub(super) fn is_permission_unused(
    view: &RolloutProjection,
    board: &Board,
    now: &Now,
    r: &RolloutRobot,
    given: &GivenPermission,
    report: Option<&UpdateReport>,
) -> bool {
    let life_ms = given.authority.life_ms();
    if view.bugs.time_releases_drain() {
        return r.moments.granted_link.is_some_and(|at| now.wall.ms_since(at.wall_unix_ms) > life_ms);
    }
    let Some(live) = board.get(&r.robot_id).filter(|live| view.is_settled(live)) else { return false };
    let other_session = live.report.session_epoch != given.authority.session_epoch;
    let beats = life_ms.div_ceil(limits::HEARTBEAT.as_ms()) + 1;
    let past = other_session || live.report.hb > given.authority.hb + beats;
    let said = live.report.update.as_ref();
    // One that took it and was killed before its switch record was written is where it was, and does not take it
    // again.
    let not_used = said.is_some_and(|u| u.grant_id <= given.grant_id && u.state == UpdateState::Staged);
    let is_staged = report.is_some_and(|report| report.state == UpdateState::Staged);
    past && not_used && is_staged
}

/// Why a drain without a permission that may be alive may end.
pub(super) fn unpermitted(r: &RolloutRobot) -> ReleasedBy {
    if r.not_used { ReleasedBy::NotUsed } else { ReleasedBy::NoGrant }
}

/// Releases the drain of a robot: fleet may give it back.
pub(super) fn release_drain(tx: &mut Tx, r: &mut RolloutRobot, why: ReleasedBy) {
    let Some(drain_id) = r.drain_id.take() else { return };
    (r.ready, r.grant) = (false, None);
    tx.put_row(DrainRelease { drain_id, why }, "drain.release");
    if r.counts() {
        count_in_flight(tx, &r.rollout_id, -1);
    }
}

/// The drain of a robot counts for fleet and for the roll-out from now on, or does not.
pub(super) fn recount(tx: &mut Tx, r: &RolloutRobot, by: i32) {
    let request = r.drain_id.as_ref().and_then(|id| tx.view.requests.get(id.as_str())).map(|q| q.row.clone());
    if let Some(request) = request {
        tx.put_row(DrainRequest { written_off: by < 0, ..request }, "drain.recounted");
        count_in_flight(tx, &r.rollout_id, by);
    }
}

/// One more or less is out of work for a roll-out: the row that two planners fight over.
fn count_in_flight(tx: &mut Tx, rollout_id: &RolloutId, by: i32) {
    let Some(rollout) = tx.view.rollout(rollout_id).cloned() else { return };
    let in_flight = rollout.in_flight.saturating_add_signed(by);
    tx.put_row(Rollout { in_flight, ..rollout }, "rollout.in_flight");
}

/// Takes requests away that fleet has nothing left to do for.
pub fn forget_drains(tx: &mut Tx) {
    let over = tx.view.releases.values().map(|r| r.row.drain_id.clone());
    let over: Vec<DrainId> = over.filter(|id| tx.view.drain(id).is_none()).take(limits::ITEM_ROWS_MAX / 4).collect();
    for drain_id in over {
        tx.rely::<Drain>(drain_id.as_str());
        tx.delete::<DrainRequest>(drain_id.as_str(), "drain.forgotten");
        tx.delete::<DrainRelease>(drain_id.as_str(), "drain.forgotten");
    }
}
