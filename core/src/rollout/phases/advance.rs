//! Brings a roll-out from phase to phase: waves one after the other, a gate behind each, and back if one says so.
//!
//! Invariant: an abort is latched in the item that ends the roll-out, and nothing takes it back; a soak stands still
//! while the roll-out does; stuck and unreachable robots never keep a fleet waiting.

use super::pauses::update_pauses;
use crate::fleet::Board;
use crate::ids::RolloutId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::rollout::decision::plan::{Tx, incident};
use crate::rollout::judgement::verdict;
use crate::rollout::judgement::{ending, infrastructure};
use crate::rollout::members::area_bundles::forget_area_bundles;
use crate::rollout::members::{assign, matching};
use crate::rollout::projection::queue::{is_newcomer, is_retried};
use crate::rollout::projection::rows::{Bundle, Countdown, Outcome, Phase, Rollout, RolloutRobot, Step, Verdict};
use crate::rollout::projection::spec::AbortScope;
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::projection::timestamp::Stamp;
use crate::rollout::robots::due::is_irreversible;
use crate::rollout::robots::moves;
use crate::time::Now;

/// Stops a roll-out that must not go on as it is, before any robot is brought further.
pub fn guard(tx: &mut Tx, board: &Board, id: &RolloutId) {
    let Some(rollout) = tx.view.rollout(id).filter(|r| r.phase.runs()).cloned() else { return };
    if !ends_early(tx, &rollout) {
        update_pauses(tx, board, &rollout);
    }
}

/// Brings one roll-out to its next phase, if it may come to it.
pub fn advance_rollout(tx: &mut Tx, board: &Board, id: &RolloutId) {
    guard(tx, board, id);
    let Some(rollout) = tx.view.rollout(id) else { return };
    if rollout.phase.runs() {
        if !rollout.pauses.is_empty() {
            return;
        }
        verdict::count_tasks(tx, id);
    }
    let Some(rollout) = tx.view.rollout(id).cloned() else { return };
    match rollout.phase {
        Phase::Prefetching => prefetching(tx, board, rollout),
        Phase::Applying => applying(tx, board, rollout),
        Phase::Soaking => soaking(tx, rollout),
        Phase::Gate => judge_gate(tx, board, rollout),
        Phase::Aborting => aborting(tx, rollout),
        Phase::RollingBack => rolling_back(tx, board, rollout),
        _ => {}
    }
}

/// Comes to a phase. Of one that ends its bundle remembers when: the roll-out itself may be let go of.
pub fn enter_phase(tx: &mut Tx, rollout: Rollout, phase: Phase, kind: &'static str) {
    let bundle = tx.view.bundles.get(rollout.spec.bundle.as_str()).filter(|_| phase.is_over());
    if let Some(bundle) = bundle.map(|b| b.row.clone()) {
        tx.put_row(Bundle { ended: Some(tx.now.utc), ..bundle }, "bundle.rollout_ended");
    }
    tx.put_row(Rollout { phase, since: tx.now.utc, version: rollout.version + 1, ..rollout }, kind);
}

/// Ends it if something speaks against its bundle. True: it ends.
fn ends_early(tx: &mut Tx, rollout: &Rollout) -> bool {
    if rollout.revert_of.is_some() {
        return false;
    }
    let Some((reason, hard, seen)) = verdict::find_abort(tx.view, rollout) else { return false };
    let verdict = verdict::compose_verdict(rollout, &seen, Outcome::Aborted, reason.clone(), tx.now.utc);
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
    rollout.abort = Some(verdict::compose_abort(tx.view, &rollout, reason, hard, &tx.now, actor));
    rollout.verdicts.extend(verdict);
    rollout.generation += 1;
    (rollout.soak, rollout.exposure) = (None, None);
    let id = rollout.rollout_id.clone();
    enter_phase(tx, rollout, Phase::Aborting, "rollout.aborting");
    if !tx.view.bugs.pause_is_forgotten() {
        moves::take_back_asked(tx, &id);
    }
}

fn is_offline(view: &RolloutProjection, board: &Board, now: &Now, r: &RolloutRobot) -> bool {
    !view.is_heard(board, now, &r.robot_id)
}

/// It is not heard, or shows another key than its own: it goes back once it comes, or once a person has taken that key.
fn is_out_of_reach(view: &RolloutProjection, board: &Board, now: &Now, r: &RolloutRobot) -> bool {
    is_offline(view, board, now, r) || matching::other_key(view, &r.robot_id).is_some()
}

/// Begins with the first wave once each of its robots has the bundle, or will not have it soon.
fn prefetching(tx: &mut Tx, board: &Board, mut rollout: Rollout) {
    let waits_for = |id: &RolloutId| tx.view.rollout(id).is_some_and(|r| !r.phase.is_over());
    if rollout.supersedes.iter().any(waits_for) || assigns_missing(tx, board, &rollout) {
        return;
    }
    let late = tx.now.ms_since(rollout.since) >= limits::STAGED_WITHIN.as_ms();
    let now = tx.now;
    let has_it = |r: &RolloutRobot| r.step >= Step::Staged || is_offline(tx.view, board, &now, r);
    if late || verdict::robots_of_wave(tx.view, &rollout.rollout_id, 0).all(has_it) {
        rollout.wave = 0;
        enter_phase(tx, rollout, Phase::Applying, "rollout.wave_begun");
    }
}

/// A start that was cut short has left robots without a row: they get it now. True: some did.
fn assigns_missing(tx: &mut Tx, board: &Board, rollout: &Rollout) -> bool {
    let id = &rollout.rollout_id;
    let waves = (id.clone(), 0)..=(id.clone(), u32::MAX);
    let there: u32 = tx.view.wave_sizes.range(waves).map(|(_, size)| *size).sum();
    if there >= rollout.wave_sizes.iter().sum() {
        return false;
    }
    let (mut members, _) = matching::find_members(tx.view, board, rollout);
    members.retain(|(robot_id, ..)| tx.view.robot_of(id, robot_id).is_none());
    members.truncate(limits::ITEM_ROWS_MAX / 2);
    if members.is_empty() {
        // The others do not fit any more.
        let size = |wave| tx.view.wave_sizes.get(&(id.clone(), wave)).copied().unwrap_or_default();
        let wave_sizes = (0..rollout.wave_sizes.len() as u32).map(size).collect();
        tx.put_row(Rollout { wave_sizes, ..rollout.clone() }, "rollout.sized");
    }
    assign::assign_robots(tx, rollout, &members);
    true
}

/// The wave does not wait for a robot that counts against it already, or that was given permission and has said for
/// long that it is under way. It keeps its drain, and nobody is told that it came through.
fn is_given_up(now: &Now, rollout: &Rollout, r: &RolloutRobot) -> bool {
    let longest = rollout.spec.probation_ms + limits::STAGED_WITHIN.as_ms();
    r.failure.is_some() || (r.grant.is_some() && now.ms_since(r.since) >= longest)
}

fn applying(tx: &mut Tx, board: &Board, rollout: Rollout) {
    let wave = rollout.wave;
    // A place in a wave that a robot leaves is taken by the next one, or a canary of one would prove nothing.
    if wave < rollout.spec.waves.len() as u32 {
        let next = find_stand_ins(tx.view, board, &tx.now, &rollout);
        if !next.is_empty() {
            next.into_iter().for_each(|next| tx.put_row(RolloutRobot { wave, ..next }, "robot.stands_in"));
            return;
        }
    }
    let open = |r: &RolloutRobot| match r.step {
        Step::Waiting | Step::Staging | Step::Staged | Step::Draining => true,
        Step::Activating => !is_given_up(&tx.now, &rollout, r),
        Step::Reverting => rollout.revert_of.is_some() && !is_out_of_reach(tx.view, board, &tx.now, r),
        _ => false,
    };
    if verdict::robots_of_wave(tx.view, &rollout.rollout_id, wave).any(open) {
        return;
    }
    let on_trial = verdict::robots_of_wave(tx.view, &rollout.rollout_id, wave).any(|r| r.step == Step::Trial);
    let attempted = |r: &RolloutRobot| r.attempted && r.step != Step::Skipped;
    if on_trial {
        let soak = Countdown::new(tx.view.served_ms(&tx.now), rollout.spec.soak_ms);
        enter_phase(tx, Rollout { soak: Some(soak), ..rollout }, Phase::Soaking, "rollout.soaking");
    } else if rollout.revert_of.is_some() {
        let verdict = verdict::judge_wave(tx.view, board, &tx.now, &rollout);
        promote(tx, rollout, verdict);
    } else if verdict::robots_of_wave(tx.view, &rollout.rollout_id, wave).any(attempted) {
        // None of those that were given it works with it: there is nothing to watch, and much to judge.
        judge_gate(tx, board, rollout);
    } else {
        // Nobody of this wave could be had: there is nothing to judge.
        next_wave(tx, rollout);
    }
}

/// The next robots of later waves, for those of this wave that were skipped and for whom nobody stood in yet.
fn find_stand_ins(view: &RolloutProjection, board: &Board, now: &Now, rollout: &Rollout) -> Vec<RolloutRobot> {
    let id = &rollout.rollout_id;
    let planned = rollout.wave_sizes.get(rollout.wave as usize).copied().unwrap_or_default();
    let there = verdict::robots_of_wave(view, id, rollout.wave).filter(|r| r.step != Step::Skipped).count() as u32;
    let missing = planned.saturating_sub(there) as usize;
    if missing == 0 {
        return Vec::new();
    }
    let later = view.robots_of(id).filter(|r| r.wave > rollout.wave && !is_newcomer(rollout, r));
    let mut ready: Vec<_> = later.filter(|r| r.step < Step::Draining && !is_offline(view, board, now, r)).collect();
    ready.sort_by_key(|r| (r.wave, r.rank));
    ready.into_iter().take(missing.min(limits::ITEM_ROWS_MAX / 2)).cloned().collect()
}

fn soaking(tx: &mut Tx, rollout: Rollout) {
    let served = tx.view.served_ms(&tx.now);
    if rollout.soak.is_none_or(|soak| soak.left(served) == 0) {
        let exposure = Some(Countdown::new(served, rollout.spec.exposure_within_ms));
        enter_phase(tx, Rollout { soak: None, exposure, ..rollout }, Phase::Gate, "rollout.gate");
    }
}

/// A robot of the wave was not heard since its gate began: it says nothing for the bundle until it comes back, or is
/// lost, or the network is. Robots that come and go are not waited for until all are there at once, only until one is.
fn waits_for_word(tx: &Tx, board: &Board, rollout: &Rollout) -> bool {
    let began = rollout.since.max(rollout.resumed.unwrap_or_default());
    let on_trial: Vec<&RolloutRobot> =
        verdict::robots_of_wave(tx.view, &rollout.rollout_id, rollout.wave).filter(|r| r.step == Step::Trial).collect();
    let unheard = |r: &&RolloutRobot| !infrastructure::is_heard_since(board, &tx.now, &r.robot_id, began);
    let dark = |r: &&RolloutRobot| verdict::is_unheard(board, &tx.now, r);
    !on_trial.is_empty() && (on_trial.iter().any(unheard) || on_trial.iter().all(dark))
}

fn judge_gate(tx: &mut Tx, board: &Board, mut rollout: Rollout) {
    if rollout.revert_of.is_none() && waits_for_word(tx, board, &rollout) {
        return;
    }
    let on_trial = verdict::robots_of_wave(tx.view, &rollout.rollout_id, rollout.wave).any(|r| r.step == Step::Trial);
    let short = verdict::find_unexposed(tx.view, &rollout).count();
    if short > 0 && on_trial {
        let served = tx.view.served_ms(&tx.now);
        if rollout.exposure.is_none_or(|left| left.left(served) > 0) {
            return;
        }
        let seen = verdict::count_wave(tx.view, board, &tx.now, &rollout);
        let why = Reason::from(Code::NoExposure).with("robots", short);
        let verdict = verdict::compose_verdict(&rollout, &seen, Outcome::Review, why, tx.now.utc);
        rollout.verdicts.push(verdict);
        return enter_phase(tx, rollout, Phase::Review, "rollout.review");
    }
    let verdict = verdict::judge_wave(tx.view, board, &tx.now, &rollout);
    match verdict.outcome {
        Outcome::Promoted | Outcome::PromotedUnproven | Outcome::PromotedByPerson => promote(tx, rollout, verdict),
        Outcome::Review => {
            rollout.verdicts.push(verdict);
            enter_phase(tx, rollout, Phase::Review, "rollout.review");
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
        enter_phase(tx, rollout, Phase::Applying, "rollout.wave_begun");
    } else if !rollout.second_pass && tx.view.robots_of(&id).any(skipped) {
        // The skipped move to the wave behind the last one; see `robots`. If nothing was judged yet that would be
        // everybody at once, without a canary: then the waves begin anew.
        (rollout.second_pass, rollout.wave) = (true, if rollout.promoted == 0 { 0 } else { waves });
        enter_phase(tx, rollout, Phase::Applying, "rollout.second_pass");
    } else {
        complete_rollout(tx, rollout);
    }
}

fn complete_rollout(tx: &mut Tx, rollout: Rollout) {
    let rollout = Rollout { since: tx.now.utc, ..rollout };
    let outcome = Some(ending::decide_ending(tx, &rollout));
    if let Some(of) = &rollout.revert_of {
        forget_area_bundles(tx, of);
    }
    enter_phase(tx, Rollout { outcome, ..rollout }, Phase::Completed, "rollout.completed");
}

/// Waits until nobody can activate it any more.
fn aborting(tx: &mut Tx, rollout: Rollout) {
    let alive = |r: &RolloutRobot| r.grant.is_some() && r.moments.switched.is_none() && r.step == Step::Activating;
    let now = Stamp::new(&tx.now, &tx.view.started);
    let latched = rollout.abort.as_ref().and_then(|abort| abort.link);
    let waited_ms = latched.map_or_else(|| tx.now.ms_since(rollout.since), |latched| now.ms_since(&latched));
    if !tx.view.robots_of(&rollout.rollout_id).any(alive) || waited_ms >= ABORT_WAITS_MS {
        enter_phase(tx, rollout, Phase::RollingBack, "rollout.rolling_back");
    }
}

/// So long the phase says that permissions may be alive, milliseconds of link time, as permissions count: longer than
/// any lives. A robot that is not heard keeps its drain, and nothing else waits for it.
const ABORT_WAITS_MS: u64 = 60_000;

/// Waits until every robot is back, or will be before it works again.
fn rolling_back(tx: &mut Tx, board: &Board, rollout: Rollout) {
    let scope_all = rollout.spec.abort_scope == AbortScope::All;
    let irreversible = is_irreversible(tx.view, &rollout);
    let now = tx.now;
    let open = |r: &RolloutRobot| match r.step {
        Step::RolledBack | Step::Skipped | Step::Stuck => false,
        Step::Committed | Step::Committing => scope_all && !irreversible,
        Step::Waiting | Step::Staging | Step::Staged => true,
        _ => !is_out_of_reach(tx.view, board, &now, r),
    };
    if tx.view.robots_of(&rollout.rollout_id).any(open) {
        return;
    }
    forget_area_bundles(tx, &rollout.rollout_id);
    let end = if rollout.superseded_by.is_some() { Phase::Superseded } else { Phase::Aborted };
    enter_phase(tx, rollout, end, "rollout.ended");
}
