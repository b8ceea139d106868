//! Carries out what people ask of roll-outs: write one down, check it, stand for it, begin, stand still, go on, judge, end, take back; and of
//! robots: pin, leave out, lift a quarantine, go back once more.
//!
//! Invariant: a command is checked against the whole picture before anything of it is written; asked twice it does the same once.

use super::dry_run::{bundle, dry_run, meets_floor, members_to_start, overlapping};
use super::matching::keeps;
use super::noted::{note, note_of_verb};
use super::requests::{Ask, CheckOnly, Command, Taken, Verb};
use super::rows::{
    Act, Bundle, Counted, Outcome, Pause, Phase, Quarantine, RobotSoftware, Rollout, RolloutRobot, Step, Verdict,
    WayBack,
};
use super::spec::{RolloutSpec, Wave};
use super::view::View;
use super::{Board, Plan, Tx, assign, effort, hear, moves, objects, phases, refusals, robots, verdict};
use crate::audit::{self, Note};
use crate::gates::{Efforts, FailureEvidence};
use crate::identity::Actor;
use crate::ids::{RobotId, RolloutId};
use crate::limits;
use crate::once;
use crate::reason::{Code, Kind, Reason, Refusal, Violations};
use crate::rows::{Revision, Writer};
use crate::time::Now;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Decides on a request whole: what was carried out before, under its request_id or by what is known, is not carried out again. What is refused may leave
/// an item too, for the audit alone.
///
/// # Errors
/// Why not; whoever asks may not; a request_id that was used for something else.
pub fn take(view: &mut View, board: &Board, now: Now, ask: &Ask, plan: &mut Plan) -> Result<Taken, Refusal> {
    let Ask { command, seen, check_only, request_id, by } = ask;
    let actor = &Actor::from(by);
    // For the audit, also if whoever asks may not. What it may not even see is about nothing that there is, and leaves nothing.
    let mut refused = |refusal: Refusal| {
        if *check_only == CheckOnly::No {
            let item = audit::refusal(Writer::Ota, actor, request_id.as_deref(), note(command), &refusal);
            plan.items.extend(item);
        }
        refusal
    };
    objects::permit(view, board, by, command).map_err(&mut refused)?;
    if let Some(id) = request_id
        && let Some(at) = once::done_before(&view.command_keys, id, command, *seen)?
    {
        return Ok(Taken::Before(at));
    }
    let is_done = check(view, board, command, *seen).map_err(refused)?;
    if *check_only == CheckOnly::Yes {
        return Ok(Taken::Now);
    }
    match request_id {
        None if is_done => {}
        None => apply(view, board, now, command, actor, plan),
        Some(id) => {
            let mut tx = Tx::new(view, now, actor).on_request(Some(id));
            tx.audit(note(command));
            if !is_done {
                apply_one(&mut tx, board, command, actor);
            }
            once::remember(&mut tx, id, command, *seen);
            plan.items.extend(tx.finish());
        }
    }
    Ok(Taken::Now)
}

fn not_found(code: Code, key: &str, id: &impl ToString) -> Refusal {
    Refusal::new(Kind::NotFound, Reason::from(code).with(key, id.to_string()))
}

/// Checks a command against what is known; an error changes nothing. True: it was carried out before.
///
/// # Errors
/// Why not.
pub fn check(view: &View, board: &Board, command: &Command, seen: Option<Revision>) -> Result<bool, Refusal> {
    match command {
        Command::Create { rollout_id, spec } => {
            if let Some(known) = view.rollout(rollout_id) {
                let same = known.spec == *spec && known.revert_of.is_none();
                let reason = || Reason::from(Code::RolloutIdTaken).with("rollout_id", rollout_id);
                return if same { Ok(true) } else { Err(Refusal::new(Kind::AlreadyExists, reason())) };
            }
            let mut bad = Violations::default();
            spec.check(&mut bad);
            bad.finish()?;
            meets_floor(bundle(view, &spec.bundle)?, spec)?;
            room(view)
        }
        Command::Rollback { of, rollout_id } => {
            if let Some(known) = view.rollout(rollout_id) {
                let same = known.revert_of.as_ref() == Some(of);
                let reason = || Reason::from(Code::RolloutIdTaken).with("rollout_id", rollout_id);
                return if same { Ok(true) } else { Err(Refusal::new(Kind::AlreadyExists, reason())) };
            }
            let known = view.rollout(of).ok_or_else(|| not_found(Code::RolloutNotFound, "rollout_id", of))?;
            let keeps = view.robots_of(of).any(|r| keeps(view, known, r));
            if known.phase != Phase::Completed || !keeps || robots::is_irreversible(view, known) {
                return Err(Refusal::new(
                    Kind::Precondition,
                    Reason::from(Code::NothingToRevert).with("rollout_id", of),
                ));
            }
            room(view)
        }
        Command::Do { rollout_id, verb, .. } => {
            let rowed = view.rollouts.get(rollout_id.as_str());
            let rowed = rowed.ok_or_else(|| not_found(Code::RolloutNotFound, "rollout_id", rollout_id))?;
            let current = Revision(rowed.row.version);
            if seen.is_some_and(|seen| seen != current) {
                let reason = Reason::from(Code::EtagMismatch).with("etag", current.0);
                return Err(Refusal::new(Kind::Conflict, reason));
            }
            verb_fits(view, board, &rowed.row, verb)
        }
        Command::Revoke { bundle, .. } => {
            let known =
                view.bundles.get(bundle.as_str()).ok_or_else(|| not_found(Code::BundleNotFound, "bundle", bundle))?;
            Ok(known.row.revoked.is_some())
        }
        Command::Pin { robot_id, .. } | Command::Unpin { robot_id } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Err(not_found(Code::RobotNotFound, "robot_id", robot_id));
            }
            let pinned = view.software_of(robot_id).pin.is_some();
            Ok(pinned == matches!(command, Command::Pin { .. }))
        }
        Command::Unstick { robot_id, .. } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Err(not_found(Code::RobotNotFound, "robot_id", robot_id));
            }
            if stuck(view, robot_id).next().is_some() {
                return Ok(false);
            }
            let reason = || Reason::from(Code::NotStuck).with("robot_id", robot_id);
            let is_told = hear::rows_of(view, robot_id).any(|r| r.step == Step::Reverting && r.way_back.unstuck);
            if is_told { Ok(true) } else { Err(Refusal::new(Kind::Precondition, reason())) }
        }
        Command::AcceptKey { robot_id, device_key } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Err(not_found(Code::RobotNotFound, "robot_id", robot_id));
            }
            Ok(view.software_of(robot_id).device_key.as_ref() == Some(device_key))
        }
        Command::LiftQuarantine { robot_id, bundle } => {
            let known = view.quarantines.contains_key(&Quarantine::id_of(robot_id, bundle));
            if known { Ok(false) } else { Err(not_found(Code::QuarantineNotFound, "robot_id", robot_id)) }
        }
    }
}

/// The robot in each roll-out that it could not go back from.
fn stuck<'a>(view: &'a View, robot_id: &'a RobotId) -> impl Iterator<Item = &'a RolloutRobot> {
    hear::rows_of(view, robot_id).filter(|r| r.step == Step::Stuck)
}

fn room(view: &View) -> Result<bool, Refusal> {
    let open = view.rollouts.values().filter(|r| !r.row.phase.is_over()).count();
    if open >= limits::ROLLOUTS_OPEN_MAX {
        return Err(Refusal::new(Kind::Exhausted, Reason::from(Code::Overloaded).with("rollouts_open", open)));
    }
    Ok(false)
}

/// True: it was done before.
fn verb_fits(view: &View, board: &Board, rollout: &Rollout, verb: &Verb) -> Result<bool, Refusal> {
    let phase = rollout.phase;
    let now_is = |fits: bool, done: bool| {
        let reason = || {
            let reason = Reason::from(Code::NotAllowedNow).with("phase", format!("{phase:?}").to_uppercase());
            if rollout.pauses.is_empty() { reason } else { reason.with("pauses", robots::pauses(rollout)) }
        };
        match (fits, done) {
            (true, _) => Ok(false),
            (_, true) => Ok(true),
            _ => Err(Refusal::new(Kind::Precondition, reason())),
        }
    };
    match verb {
        Verb::Submit => now_is(phase == Phase::Draft, phase != Phase::Draft).and_then(|done| {
            if !done && rollout.revert_of.is_none() {
                dry_run(view, board, &rollout.rollout_id, &rollout.spec)?;
            }
            Ok(done)
        }),
        Verb::Approve => now_is(phase == Phase::Validated, rollout.approved.is_some()),
        Verb::Start { supersede } => {
            let done = now_is(phase == Phase::Approved, rollout.started.is_some())?;
            if !done {
                may_start(view, board, rollout, *supersede)?;
            }
            Ok(done)
        }
        Verb::Pause => now_is(
            phase.runs() && !rollout.pauses.contains(&Pause::Operator),
            rollout.pauses.contains(&Pause::Operator),
        ),
        Verb::Resume => {
            let by_person = [Pause::Operator, Pause::Content].iter().any(|pause| rollout.pauses.contains(pause));
            now_is(by_person, phase.runs() && rollout.pauses.is_empty())
        }
        // What stands still is resumed first: a wave is not kept while nobody may be told so.
        Verb::Promote => {
            now_is(matches!(phase, Phase::Soaking | Phase::Gate | Phase::Review) && rollout.pauses.is_empty(), false)
        }
        Verb::Abort => now_is(!phase.is_over() && !phase.goes_back(), phase.goes_back()),
        Verb::RetryFailed => {
            let some = view.robots_of(&rollout.rollout_id).any(is_to_retry);
            now_is(phase == Phase::Completed && some, false)
        }
        Verb::Exclude(robot_id) => {
            let known = view.robot_of(&rollout.rollout_id, robot_id);
            let known = known.ok_or_else(|| not_found(Code::RobotNotFound, "robot_id", robot_id))?;
            now_is(known.step < Step::Draining, known.step == Step::Skipped)
        }
        Verb::Lost(robot_id) => {
            let known = view.robot_of(&rollout.rollout_id, robot_id);
            let known = known.ok_or_else(|| not_found(Code::RobotNotFound, "robot_id", robot_id))?;
            let after = rollout.spec.lost_after_ms;
            let reason = || Reason::from(Code::RobotNotLost).with("robot_id", robot_id).with("lost_after_ms", after);
            let lost = known.lost.as_ref().ok_or_else(|| Refusal::new(Kind::Precondition, reason()))?;
            Ok(lost.written_off.is_some())
        }
    }
}

fn is_to_retry(r: &RolloutRobot) -> bool {
    matches!(r.step, Step::RolledBack | Step::Skipped) && r.why.as_ref().is_none_or(|w| w.code != Code::SkippedExcluded)
}

fn may_start(view: &View, board: &Board, rollout: &Rollout, supersede: bool) -> Result<(), Refusal> {
    let (robots, _) = members_to_start(view, board, rollout)?;
    let others = overlapping(view, rollout, robots.iter().map(|(id, ..)| id));
    match others.iter().next() {
        Some(other) if !supersede => {
            Err(Refusal::new(Kind::Precondition, Reason::from(Code::RolloutOverlap).with("rollout_id", other)))
        }
        _ => Ok(()),
    }
}

/// Carries out a command that passed its check: one item for most, many for a start.
pub fn apply(view: &mut View, board: &Board, now: Now, command: &Command, actor: &Actor, plan: &mut Plan) {
    match command {
        Command::Do { rollout_id, verb: Verb::Start { supersede }, .. } => {
            start(view, board, now, rollout_id, *supersede, actor, plan);
        }
        Command::Do { rollout_id, verb: Verb::RetryFailed, reason } => {
            retry_failed(view, now, rollout_id, actor, reason, plan);
        }
        command => plan.decide(view, now, actor, |tx| {
            tx.audit(note(command));
            apply_one(tx, board, command, actor);
        }),
    }
}

fn act(tx: &Tx, actor: &Actor, reason: &str) -> Act {
    let person = actor.person().map(ToString::to_string);
    Act { actor: actor.to_string(), person, reason: reason.to_owned(), at: tx.now.utc }
}

fn apply_one(tx: &mut Tx, board: &Board, command: &Command, actor: &Actor) {
    match command {
        Command::Create { rollout_id, spec } => {
            let row = draft(tx, rollout_id, spec.clone(), actor);
            tx.put(row, "rollout.created");
        }
        Command::Rollback { of, rollout_id } => {
            let Some(original) = tx.view.rollout(of).cloned() else { return };
            let spec = RolloutSpec {
                waves: vec![Wave::Rest],
                allow_full_push: true,
                // A robot that is not heard keeps its place in the count: it must not keep the others from going back.
                max_in_flight: None,
                soak_ms: 0,
                exposure_tasks: 0,
                ..RolloutSpec::clone(&original.spec)
            };
            let row = draft(tx, rollout_id, Arc::new(spec), actor);
            tx.put(Rollout { revert_of: Some(of.clone()), ..row }, "rollout.created");
        }
        Command::Do { rollout_id, verb, reason } => verb_one(tx, board, rollout_id, verb, actor, reason),
        Command::Revoke { bundle, reason } => {
            let Some(row) = tx.view.bundles.get(bundle.as_str()).map(|b| b.row.clone()) else { return };
            let revoked = Some(act(tx, actor, reason));
            tx.put(Bundle { revoked, ..row }, "bundle.revoked");
            let is_of = |r: &&Rollout| r.spec.bundle == *bundle && r.revert_of.is_none();
            let of: Vec<Rollout> = tx.view.rollouts.values().map(|r| &r.row).filter(is_of).cloned().collect();
            of.into_iter().for_each(|rollout| phases::revoke(tx, rollout));
        }
        Command::Pin { robot_id, reason } => {
            let pin = Some(act(tx, actor, reason));
            let row = tx.view.software_of(robot_id);
            tx.put(RobotSoftware { pin, ..row }, "robot.pinned");
        }
        Command::Unpin { robot_id } => {
            let row = tx.view.software_of(robot_id);
            tx.put(RobotSoftware { pin: None, ..row }, "robot.unpinned");
            tx.view.arrived.insert(robot_id.clone());
        }
        Command::Unstick { robot_id, .. } => {
            let rows: Vec<RolloutRobot> = stuck(tx.view, robot_id).cloned().collect();
            for row in rows {
                let way_back = WayBack { unstuck: true, ..WayBack::default() };
                tx.put(RolloutRobot { step: Step::Reverting, since: tx.now.utc, way_back, ..row }, "robot.unstuck");
            }
        }
        Command::AcceptKey { robot_id, device_key } => {
            let row = tx.view.software_of(robot_id);
            tx.put(RobotSoftware { device_key: Some(device_key.clone()), ..row }, "robot.device_key_accepted");
        }
        Command::LiftQuarantine { robot_id, bundle } => {
            tx.delete::<Quarantine>(&Quarantine::id_of(robot_id, bundle), "quarantine.lifted");
        }
    }
}

fn draft(tx: &Tx, rollout_id: &RolloutId, spec: Arc<RolloutSpec>, actor: &Actor) -> Rollout {
    Rollout {
        rollout_id: rollout_id.clone(),
        spec,
        phase: Phase::Draft,
        wave: 0,
        pauses: BTreeSet::new(),
        version: 1,
        generation: 1,
        in_flight: 0,
        soak: None,
        exposure: None,
        sizes: Vec::new(),
        promoted: 0,
        verdicts: Vec::new(),
        abort: None,
        second_pass: false,
        revert_of: None,
        supersedes: BTreeSet::new(),
        superseded_by: None,
        tasks: FailureEvidence::default(),
        counted: Arc::default(),
        efforts: Efforts::default(),
        created: act(tx, actor, ""),
        approved: None,
        started: None,
        resumed: None,
        since: tx.now.utc,
        outcome: None,
        refusals_seen: BTreeSet::new(),
    }
}

fn verb_one(tx: &mut Tx, board: &Board, id: &RolloutId, verb: &Verb, actor: &Actor, reason: &str) {
    let Some(mut rollout) = tx.view.rollout(id).cloned() else { return };
    let why = |code: Code| Reason::new(code, reason).with("actor", actor);
    match verb {
        Verb::Submit => phases::enter(tx, rollout, Phase::Validated, "rollout.validated"),
        Verb::Approve => {
            rollout.approved = Some(act(tx, actor, reason));
            phases::enter(tx, rollout, Phase::Approved, "rollout.approved");
        }
        Verb::Pause | Verb::Resume => {
            let mut pauses = rollout.pauses.clone();
            let kind = if *verb == Verb::Pause {
                pauses.insert(Pause::Operator);
                "rollout.paused"
            } else {
                pauses.retain(|pause| !matches!(pause, Pause::Operator | Pause::Content));
                let refused: Vec<RobotId> =
                    refusals::of_content(tx.view, &rollout).map(|r| r.robot_id.clone()).collect();
                rollout.refusals_seen.extend(refused);
                "rollout.resumed"
            };
            phases::set_pauses(tx, rollout, pauses, kind);
        }
        Verb::Promote => {
            let seen = verdict::see_wave(tx.view, board, &tx.now, &rollout);
            let verdict =
                verdict::of(&rollout, &seen, Outcome::PromotedByPerson, why(Code::PromotedByUser), tx.now.utc);
            phases::promote(tx, rollout, Verdict { actor: Some(actor.to_string()), ..verdict });
        }
        Verb::Abort => phases::abort(tx, rollout, why(Code::AbortedByUser), false, None, Some(actor.to_string())),
        Verb::Exclude(robot_id) => {
            let row = RolloutRobot::id_of(id, robot_id);
            moves::make(tx, &super::NoSign, board, &row, robots::Move::Skip(why(Code::SkippedExcluded)));
        }
        Verb::Lost(robot_id) => {
            let Some(row) = tx.view.robot_of(id, robot_id).cloned() else { return };
            let act = act(tx, actor, reason);
            moves::write_off(tx, row, act);
        }
        Verb::Start { .. } | Verb::RetryFailed => {}
    }
}

fn start(view: &mut View, board: &Board, now: Now, id: &RolloutId, supersede: bool, actor: &Actor, plan: &mut Plan) {
    let Some(rollout) = view.rollout(id).cloned() else { return };
    let Ok((robots, sizes)) = members_to_start(view, board, &rollout) else { return };
    let others = overlapping(view, &rollout, robots.iter().map(|(id, ..)| id));
    let control = verdict::controls_of(view, &rollout);
    let effort = effort::of_controls(view, &rollout);
    let counted = Arc::new(Counted { at_ms: view.served_ms(&now), control, effort, ..Counted::default() });
    if supersede {
        for other in &others {
            plan.decide(view, now, actor, |tx| {
                let Some(old) = tx.view.rollout(other).cloned() else { return };
                let ended = Note::new("rollout.abort").about("rollout", other).with("superseded_by", id);
                tx.audit(ended);
                let reason = Reason::from(Code::SupersededBy).with("rollout_id", id);
                let old = Rollout { superseded_by: Some(id.clone()), ..old };
                if old.phase.goes_back() {
                    tx.put(old, "rollout.superseded");
                } else {
                    phases::abort(tx, old, reason, false, None, Some(actor.to_string()));
                }
            });
        }
    }
    // The row first: robots of a roll-out that did not begin are nobody's. Its robots come with it, a slice to each item.
    let mut slices = robots.chunks(limits::ITEM_ROWS_MAX / 2);
    let first = slices.next().unwrap_or_default();
    plan.decide(view, now, actor, |tx| {
        let (phase, started, since) = (Phase::Prefetching, Some(tx.now.utc), tx.now.utc);
        let row = Rollout {
            phase,
            started,
            since,
            sizes: sizes.clone(),
            supersedes: others.clone(),
            counted,
            ..rollout.clone()
        };
        tx.put(row, "rollout.started");
        let supersede = Verb::Start { supersede };
        tx.audit(note_of_verb(id, &supersede, ""));
        assign::add(tx, &rollout, first);
    });
    for slice in slices {
        plan.decide(view, now, actor, |tx| assign::add(tx, &rollout, slice));
    }
}

fn retry_failed(view: &mut View, now: Now, id: &RolloutId, actor: &Actor, reason: &str, plan: &mut Plan) {
    let Some(rollout) = view.rollout(id).cloned() else { return };
    let wave = rollout.spec.waves.len() as u32 + 1;
    let robots: Vec<RolloutRobot> = view.robots_of(id).filter(|r| is_to_retry(r)).cloned().collect();
    for (nth, slice) in robots.chunks(limits::ITEM_ROWS_MAX / 4).enumerate() {
        plan.decide(view, now, actor, |tx| {
            if nth == 0 {
                tx.audit(note_of_verb(id, &Verb::RetryFailed, reason));
            }
            for r in slice {
                let key = Quarantine::id_of(&r.robot_id, &rollout.spec.bundle);
                tx.delete::<Quarantine>(&key, "quarantine.lifted");
                let fresh =
                    assign::fresh(&tx.now.clone(), &rollout, &r.robot_id, wave, r.place, r.from_version.clone());
                let why = (!reason.is_empty()).then(|| Reason::new(Code::RetriedByUser, reason).with("actor", actor));
                tx.put(RolloutRobot { again: true, why, ..fresh }, "robot.retried");
            }
        });
    }
}
