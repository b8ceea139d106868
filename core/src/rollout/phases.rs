//! Brings a roll-out from phase to phase: waves one after the other, a gate behind each, and back if one says so.
//!
//! Invariant: an abort is latched in the item that ends the roll-out, and nothing takes it back; a soak stands still while the roll-out does;
//! stuck and unreachable robots never keep a fleet waiting.

use super::robots::{is_newcomer, is_retried};
use super::rows::{AreaBundle, Countdown, Outcome, Pause, Phase, Rollout, RolloutRobot, Step, Verdict};
use super::verdict;
use super::view::View;
use super::{Board, Tx, incident, infrastructure};
use crate::fleet::heard;
use crate::ids::{AreaId, RolloutId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::Presence;
use crate::time::Now;
use std::collections::BTreeMap;

/// Brings one roll-out further.
pub fn further(tx: &mut Tx, board: &Board, id: &RolloutId) {
    let Some(rollout) = tx.view.rollout(id).cloned() else { return };
    if rollout.phase.runs() {
        if pauses(tx, board, &rollout) || ends_early(tx, &rollout) {
            return;
        }
        if !rollout.pauses.is_empty() {
            return;
        }
        verdict::count_tasks(tx, &rollout);
    }
    let Some(rollout) = tx.view.rollout(id).cloned() else { return };
    match rollout.phase {
        Phase::Prefetching => prefetching(tx, board, rollout),
        Phase::Applying => applying(tx, board, rollout),
        Phase::Soaking => soaking(tx, rollout),
        Phase::Gate => gate(tx, rollout),
        Phase::Aborting => aborting(tx, rollout),
        Phase::RollingBack => rolling_back(tx, board, rollout),
        _ => {}
    }
}

/// Comes to a phase.
pub fn enter(tx: &mut Tx, rollout: Rollout, phase: Phase, kind: &'static str) {
    tx.put(Rollout { phase, since: tx.now.utc, ..rollout }, kind);
}

/// Sets and lifts the pauses that nobody has to ask for. True: something changed.
fn pauses(tx: &mut Tx, board: &Board, rollout: &Rollout) -> bool {
    let mut pauses = rollout.pauses.clone();
    let bundle = tx.view.bundles.get(rollout.spec.bundle.as_str()).map(|b| &b.row);
    let gone = rollout.revert_of.is_none() && bundle.is_none_or(|b| b.revoked.is_some() || !b.listed);
    if gone {
        pauses.insert(Pause::Revoked);
    }
    let network = infrastructure::pause(tx.view, board, &tx.now, rollout);
    pauses.retain(|p| !matches!(p, Pause::Infrastructure | Pause::InfrastructureUnknown));
    pauses.extend(network);
    if pauses == rollout.pauses {
        return false;
    }
    set_pauses(tx, rollout.clone(), pauses, "rollout.pauses_changed");
    true
}

/// Stands still for these reasons, or goes on if there is none. Permissions of before are not given any more.
pub fn set_pauses(tx: &mut Tx, mut rollout: Rollout, pauses: std::collections::BTreeSet<Pause>, kind: &'static str) {
    let served = tx.view.served_ms(&tx.now);
    let runs = pauses.is_empty();
    for countdown in [&mut rollout.soak, &mut rollout.exposure] {
        *countdown = countdown.map(|c| c.set_running(served, runs));
    }
    rollout.generation += 1;
    rollout.pauses = pauses;
    tx.put(rollout, kind);
}

/// Ends it if something speaks against its bundle. True: it ends.
fn ends_early(tx: &mut Tx, rollout: &Rollout) -> bool {
    if rollout.revert_of.is_some() {
        return false;
    }
    let Some((reason, hard, seen)) = verdict::against(tx.view, rollout) else { return false };
    let verdict = verdict::of(rollout, &seen, Outcome::Aborted, reason.clone(), tx.now.utc);
    abort(tx, rollout.clone(), reason, hard, Some(verdict), None);
    true
}

/// Ends it early: the evidence is latched here.
pub fn abort(
    tx: &mut Tx,
    mut rollout: Rollout,
    reason: Reason,
    hard: bool,
    verdict: Option<Verdict>,
    actor: Option<String>,
) {
    let told = Reason::from(Code::RolloutAborted).with("rollout_id", &rollout.rollout_id).with("because", reason.code);
    incident(tx, None, &told);
    rollout.abort = Some(verdict::abort(tx.view, &rollout, reason, hard, tx.now.utc, actor));
    rollout.verdicts.extend(verdict);
    rollout.generation += 1;
    (rollout.soak, rollout.exposure) = (None, None);
    enter(tx, rollout, Phase::Aborting, "rollout.aborting");
}

fn is_offline(board: &Board, now: &Now, r: &RolloutRobot) -> bool {
    heard::presence(board, &r.robot_id, now) == Presence::Offline
}

/// Begins with the first wave once each of its robots has the bundle, or will not have it soon.
fn prefetching(tx: &mut Tx, board: &Board, mut rollout: Rollout) {
    let waits_for = |id: &RolloutId| tx.view.rollout(id).is_some_and(|r| !r.phase.is_over());
    if rollout.supersedes.iter().any(waits_for) {
        return;
    }
    let late = tx.now.utc.ms_since(rollout.since) >= limits::STAGED_WITHIN.as_ms();
    let now = tx.now;
    let has_it = |r: &RolloutRobot| r.step >= Step::Staged || is_offline(board, &now, r);
    if late || verdict::wave(tx.view, &rollout.rollout_id, 0).all(has_it) {
        rollout.wave = 0;
        enter(tx, rollout, Phase::Applying, "rollout.wave_begun");
    }
}

fn applying(tx: &mut Tx, board: &Board, rollout: Rollout) {
    let wave = rollout.wave;
    // A place in a wave that a robot leaves is taken by the next one, or a canary of one would prove nothing.
    if !rollout.second_pass
        && let Some(next) = stand_in(tx.view, board, &tx.now, &rollout)
    {
        tx.put(RolloutRobot { wave, ..next }, "robot.stands_in");
        return;
    }
    let open = |r: &RolloutRobot| {
        matches!(r.step, Step::Waiting | Step::Staging | Step::Staged | Step::Draining | Step::Activating)
            || (rollout.revert_of.is_some() && r.step == Step::Reverting && !is_offline(board, &tx.now, r))
    };
    if verdict::wave(tx.view, &rollout.rollout_id, wave).any(open) {
        return;
    }
    let on_trial = verdict::wave(tx.view, &rollout.rollout_id, wave).any(|r| r.step == Step::Trial);
    if on_trial {
        let soak = Countdown::new(tx.view.served_ms(&tx.now), rollout.spec.soak_ms);
        enter(tx, Rollout { soak: Some(soak), ..rollout }, Phase::Soaking, "rollout.soaking");
    } else if rollout.revert_of.is_some() {
        let verdict = verdict::gate(tx.view, &rollout, tx.now.utc);
        promote(tx, rollout, verdict);
    } else {
        // Nobody of this wave could be had: there is nothing to judge.
        next_wave(tx, rollout);
    }
}

/// The next robot of a later wave, if one of this wave was skipped and nobody stood in for it yet.
fn stand_in(view: &View, board: &Board, now: &Now, rollout: &Rollout) -> Option<RolloutRobot> {
    let id = &rollout.rollout_id;
    let planned = rollout.sizes.get(rollout.wave as usize).copied().unwrap_or_default();
    let there = verdict::wave(view, id, rollout.wave).filter(|r| r.step != Step::Skipped).count() as u32;
    if there >= planned {
        return None;
    }
    let later = view.robots_of(id).filter(|r| r.wave > rollout.wave && !is_newcomer(rollout, r));
    let ready = later.filter(|r| r.step < Step::Draining && !is_offline(board, now, r));
    ready.min_by_key(|r| (r.wave, r.place)).cloned()
}

fn soaking(tx: &mut Tx, rollout: Rollout) {
    let served = tx.view.served_ms(&tx.now);
    if rollout.soak.is_none_or(|soak| soak.left(served) == 0) {
        let exposure = Some(Countdown::new(served, rollout.spec.exposure_within_ms));
        enter(tx, Rollout { soak: None, exposure, ..rollout }, Phase::Gate, "rollout.gate");
    }
}

fn gate(tx: &mut Tx, mut rollout: Rollout) {
    let on_trial = verdict::wave(tx.view, &rollout.rollout_id, rollout.wave).any(|r| r.step == Step::Trial);
    let short = verdict::unexposed(tx.view, &rollout).count();
    if short > 0 && on_trial {
        let served = tx.view.served_ms(&tx.now);
        if rollout.exposure.is_none_or(|left| left.left(served) > 0) {
            return;
        }
        let seen = verdict::see(tx.view, &rollout, Some(rollout.wave));
        let why = Reason::from(Code::NoExposure).with("robots", short);
        let verdict = verdict::of(&rollout, &seen, Outcome::Review, why, tx.now.utc);
        rollout.verdicts.push(verdict);
        return enter(tx, rollout, Phase::Review, "rollout.review");
    }
    let verdict = verdict::gate(tx.view, &rollout, tx.now.utc);
    match verdict.outcome {
        Outcome::Promoted | Outcome::PromotedUnproven | Outcome::PromotedByPerson => promote(tx, rollout, verdict),
        Outcome::Review => {
            rollout.verdicts.push(verdict);
            enter(tx, rollout, Phase::Review, "rollout.review");
        }
        Outcome::Aborted => {
            let reason = verdict.reason.clone();
            abort(tx, rollout, reason, false, Some(verdict), None);
        }
    }
}

/// The wave is kept, and the next one begins.
pub fn promote(tx: &mut Tx, mut rollout: Rollout, verdict: Verdict) {
    rollout.verdicts.push(verdict);
    rollout.promoted = rollout.wave + 1;
    next_wave(tx, rollout);
}

fn next_wave(tx: &mut Tx, mut rollout: Rollout) {
    let waves = rollout.spec.waves.len() as u32;
    (rollout.soak, rollout.exposure) = (None, None);
    let skipped = |r: &RolloutRobot| r.step == Step::Skipped && !r.again && is_retried(r);
    let id = rollout.rollout_id.clone();
    if rollout.wave + 1 < waves {
        rollout.wave += 1;
        enter(tx, rollout, Phase::Applying, "rollout.wave_begun");
    } else if !rollout.second_pass && tx.view.robots_of(&id).any(skipped) {
        // The skipped move to the wave behind the last one; see `robots`.
        (rollout.second_pass, rollout.wave) = (true, waves);
        enter(tx, rollout, Phase::Applying, "rollout.second_pass");
    } else {
        complete(tx, rollout);
    }
}

fn complete(tx: &mut Tx, rollout: Rollout) {
    let id = rollout.rollout_id.clone();
    let mut by_area: BTreeMap<AreaId, Vec<String>> = BTreeMap::new();
    for r in tx.view.robots_of(&id).filter(|r| matches!(r.step, Step::Trial | Step::Committing | Step::Committed)) {
        let area = tx.view.software.get(r.robot_id.as_str()).and_then(|s| s.row.area.clone());
        let model = tx.view.sessions.get(r.robot_id.as_str()).map(|s| s.row.inventory.model.clone());
        if let Some((area, model)) = area.zip(model) {
            by_area.entry(area).or_default().push(model);
        }
    }
    for (area_id, models) in by_area {
        let known = tx.view.area_bundles.get(area_id.as_str()).map(|a| a.row.clone());
        let mut row = known.unwrap_or_else(|| AreaBundle { area_id, rollouts: BTreeMap::new() });
        row.rollouts.extend(models.into_iter().map(|model| (model, id.clone())));
        tx.put(row, "area.bundle_set");
    }
    if let Some(of) = &rollout.revert_of {
        forget_area_bundles(tx, of);
    }
    enter(tx, rollout, Phase::Completed, "rollout.completed");
}

/// Robots that come later do not get it any more.
pub fn forget_area_bundles(tx: &mut Tx, id: &RolloutId) {
    let named: Vec<AreaBundle> = tx
        .view
        .area_bundles
        .values()
        .map(|a| &a.row)
        .filter(|a| a.rollouts.values().any(|r| r == id))
        .cloned()
        .collect();
    for mut row in named {
        row.rollouts.retain(|_, rollout| rollout != id);
        tx.put(row, "area.bundle_forgotten");
    }
}

/// Waits until nobody can activate it any more.
fn aborting(tx: &mut Tx, rollout: Rollout) {
    let alive = |r: &RolloutRobot| r.grant.is_some() && r.moments.switched.is_none() && r.step == Step::Activating;
    if !tx.view.robots_of(&rollout.rollout_id).any(alive) || tx.now.utc.ms_since(rollout.since) >= ABORT_WAITS_MS {
        enter(tx, rollout, Phase::RollingBack, "rollout.rolling_back");
    }
}

/// So long the phase says that permissions may be alive, milliseconds of site time: longer than any lives. A robot that is not heard keeps
/// its drain, and nothing else waits for it.
const ABORT_WAITS_MS: u64 = 60_000;

/// Waits until every robot is back, or will be before it works again.
fn rolling_back(tx: &mut Tx, board: &Board, rollout: Rollout) {
    let scope_all = rollout.spec.abort_scope == super::spec::AbortScope::All;
    let irreversible = tx.view.bundles.get(rollout.spec.bundle.as_str()).is_some_and(|b| b.row.is_irreversible);
    let now = tx.now;
    let open = |r: &RolloutRobot| match r.step {
        Step::RolledBack | Step::Skipped | Step::Stuck => false,
        Step::Committed | Step::Committing => scope_all && !irreversible,
        Step::Waiting | Step::Staging | Step::Staged => true,
        _ => !is_offline(board, &now, r),
    };
    if tx.view.robots_of(&rollout.rollout_id).any(open) {
        return;
    }
    forget_area_bundles(tx, &rollout.rollout_id);
    let end = if rollout.superseded_by.is_some() { Phase::Superseded } else { Phase::Aborted };
    enter(tx, rollout, end, "rollout.ended");
}
