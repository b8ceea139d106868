//! Carries out what people ask of roll-outs: write one down, check it, stand for it, begin, stand still, go on, judge,
//! end, take back; and of robots: pin, leave out, lift a quarantine, go back once more.
//!
//! Invariant: a command is checked against the whole projection before anything of it is written; asked twice it does the
//! same once.

use super::audit::{note, note_of_verb};
use super::check::{check_command, is_to_retry, stuck_robots};
use super::dry_run::{find_overlapping, members_to_start};
use super::objects;
use crate::audit::Note;
use crate::fleet::Board;
use crate::gates::{Efforts, FailureEvidence};
use crate::idempotency;
use crate::identity::Actor;
use crate::ids::{RobotId, RolloutId};
use crate::item::Item;
use crate::limits;
use crate::reason::{Code, Reason, Refusal};
use crate::rollout::decision::directive::NoSign;
use crate::rollout::decision::plan::{Plan, Tx};
use crate::rollout::judgement::{effort, refusals, verdict};
use crate::rollout::members::assign;
use crate::rollout::phases::{advance, pauses};
use crate::rollout::projection::requests::{Ask, CheckOnly, Command, CommandOutcome, Verb};
use crate::rollout::projection::rows::{
    Act, Bundle, Outcome, Pause, Phase, Quarantine, RobotSoftware, Rollout, RolloutRobot, TaskBaseline, Verdict,
};
use crate::rollout::projection::spec::{RolloutSpec, Wave};
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::robots::machine::Move;
use crate::rollout::robots::moves;
use crate::rows::Writer;
use crate::time::Now;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Decides on a request whole: what was carried out before, under its request_id or by what is known, is not carried
/// out again. What is refused may leave an item too, for the audit alone.
///
/// # Errors
/// Why not; whoever asks may not; a request_id that was used for something else.
pub fn decide_request(
    view: &mut RolloutProjection,
    board: &Board,
    now: Now,
    ask: &Ask,
    plan: &mut Plan,
) -> Result<CommandOutcome, Refusal> {
    let Ask { command, seen, check_only, request_id, by } = ask;
    let actor = &Actor::from(by);
    // For the audit, also if whoever asks may not. What it may not even see is about nothing that there is, and leaves
    // nothing.
    let mut refused = |refusal: Refusal| {
        if *check_only == CheckOnly::No {
            let item = Item::for_refusal(Writer::Ota, actor, request_id.as_deref(), note(command), &refusal);
            plan.items.extend(item);
        }
        refusal
    };
    objects::permit(view, board, by, command).map_err(&mut refused)?;
    if let Some(id) = request_id
        && let Some(at) = idempotency::done_before(&view.command_keys, id, command, *seen)?
    {
        return Ok(CommandOutcome::Before(at));
    }
    let is_done = check_command(view, board, command, *seen).map_err(refused)?;
    if *check_only == CheckOnly::Yes {
        return Ok(CommandOutcome::Now);
    }
    match request_id {
        None if is_done => {}
        None => carry_out(view, board, now, command, actor, plan),
        Some(id) => {
            let mut tx = Tx::new(view, now, actor).on_request(Some(id));
            tx.audit(note(command));
            if !is_done {
                carry_out_one(&mut tx, board, command, actor);
            }
            idempotency::remember(&mut tx, id, command, *seen);
            plan.items.extend(tx.finish());
        }
    }
    Ok(CommandOutcome::Now)
}

/// Carries out a command that passed its check: one item for most, many for a start.
pub(in crate::rollout) fn carry_out(
    view: &mut RolloutProjection,
    board: &Board,
    now: Now,
    command: &Command,
    actor: &Actor,
    plan: &mut Plan,
) {
    match command {
        Command::Do { rollout_id, verb: Verb::Start { supersede }, .. } => {
            start(view, board, now, rollout_id, *supersede, actor, plan);
        }
        Command::Do { rollout_id, verb: Verb::RetryFailed, reason } => {
            retry_failed(view, now, rollout_id, actor, reason, plan);
        }
        command => plan.decide(view, now, actor, |tx| {
            tx.audit(note(command));
            carry_out_one(tx, board, command, actor);
        }),
    }
}

fn compose_act(tx: &Tx, actor: &Actor, reason: &str) -> Act {
    let person = actor.person().map(ToString::to_string);
    Act { actor: actor.to_string(), person, reason: reason.to_owned(), at: tx.now.utc }
}

fn carry_out_one(tx: &mut Tx, board: &Board, command: &Command, actor: &Actor) {
    match command {
        Command::Create { rollout_id, spec } => {
            let row = draft(tx, rollout_id, spec.clone(), actor);
            tx.put_row(row, "rollout.created");
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
            tx.put_row(Rollout { revert_of: Some(of.clone()), ..row }, "rollout.created");
        }
        Command::Do { rollout_id, verb, reason } => carry_out_verb(tx, board, rollout_id, verb, actor, reason),
        Command::Revoke { bundle, reason } => {
            let Some(row) = tx.view.bundles.get(bundle.as_str()).map(|b| b.row.clone()) else { return };
            let revoked = Some(compose_act(tx, actor, reason));
            tx.put_row(Bundle { revoked, ..row }, "bundle.revoked");
            let is_of = |r: &&Rollout| r.spec.bundle == *bundle && r.revert_of.is_none();
            let of: Vec<Rollout> = tx.view.rollouts.values().map(|r| &r.row).filter(is_of).cloned().collect();
            of.into_iter().for_each(|rollout| pauses::revoke(tx, rollout));
        }
        Command::Pin { robot_id, reason } => {
            let pin = Some(compose_act(tx, actor, reason));
            let row = tx.view.software_of(robot_id);
            tx.put_row(RobotSoftware { pin, ..row }, "robot.pinned");
        }
        Command::Unpin { robot_id } => {
            let row = tx.view.software_of(robot_id);
            tx.put_row(RobotSoftware { pin: None, ..row }, "robot.unpinned");
            tx.view.arrived.insert(robot_id.clone());
        }
        Command::Unstick { robot_id, .. } => {
            let rows: Vec<RolloutRobot> = stuck_robots(tx.view, robot_id).cloned().collect();
            for row in rows {
                moves::unstick(tx, row);
            }
        }
        Command::AcceptKey { robot_id, device_key } => {
            let row = tx.view.software_of(robot_id);
            tx.put_row(RobotSoftware { device_key: Some(device_key.clone()), ..row }, "robot.device_key_accepted");
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
        wave_sizes: Vec::new(),
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
        created: compose_act(tx, actor, ""),
        approved: None,
        started: None,
        resumed: None,
        since: tx.now.utc,
        outcome: None,
        refusals_seen: BTreeSet::new(),
    }
}

fn carry_out_verb(tx: &mut Tx, board: &Board, id: &RolloutId, verb: &Verb, actor: &Actor, reason: &str) {
    let Some(mut rollout) = tx.view.rollout(id).cloned() else { return };
    let why = |code: Code| Reason::new(code, reason).with("actor", actor);
    match verb {
        Verb::Submit => advance::enter_phase(tx, rollout, Phase::Validated, "rollout.validated"),
        Verb::Approve => {
            rollout.approved = Some(compose_act(tx, actor, reason));
            advance::enter_phase(tx, rollout, Phase::Approved, "rollout.approved");
        }
        Verb::Pause | Verb::Resume => {
            let mut pauses = rollout.pauses.clone();
            let kind = if *verb == Verb::Pause {
                pauses.insert(Pause::Operator);
                "rollout.paused"
            } else {
                pauses.retain(|pause| !matches!(pause, Pause::Operator | Pause::Content));
                let refused: Vec<RobotId> =
                    refusals::refused_content(tx.view, &rollout).map(|r| r.robot_id.clone()).collect();
                rollout.refusals_seen.extend(refused);
                "rollout.resumed"
            };
            pauses::set_pauses(tx, rollout, pauses, kind);
        }
        Verb::Promote => {
            let seen = verdict::count_wave(tx.view, board, &tx.now, &rollout);
            let verdict = verdict::compose_verdict(
                &rollout,
                &seen,
                Outcome::PromotedByPerson,
                why(Code::PromotedByPerson),
                tx.now.utc,
            );
            advance::promote(tx, rollout, Verdict { actor: Some(actor.to_string()), ..verdict });
        }
        Verb::Abort => advance::abort(tx, rollout, why(Code::AbortedByPerson), false, None, Some(actor.to_string())),
        Verb::Exclude(robot_id) => {
            let row = RolloutRobot::id_of(id, robot_id);
            moves::apply(tx, &NoSign, board, &row, Move::Skip(why(Code::SkippedExcluded)));
        }
        Verb::WriteOff(robot_id) => {
            let Some(row) = tx.view.robot_of(id, robot_id).cloned() else { return };
            let act = compose_act(tx, actor, reason);
            moves::write_off(tx, row, act);
        }
        Verb::Start { .. } | Verb::RetryFailed => {}
    }
}

fn start(
    view: &mut RolloutProjection,
    board: &Board,
    now: Now,
    id: &RolloutId,
    supersede: bool,
    actor: &Actor,
    plan: &mut Plan,
) {
    let Some(rollout) = view.rollout(id).cloned() else { return };
    let Ok((robots, sizes)) = members_to_start(view, board, &rollout) else { return };
    let others = find_overlapping(view, &rollout, robots.iter().map(|(id, ..)| id));
    let control = verdict::tasks_of_controls(view, &rollout);
    let effort = effort::effort_of_controls(view, &rollout);
    let counted = Arc::new(TaskBaseline { at_ms: view.served_ms(&now), control, effort, ..TaskBaseline::default() });
    if supersede {
        for other in &others {
            plan.decide(view, now, actor, |tx| {
                let Some(old) = tx.view.rollout(other).cloned() else { return };
                let ended = Note::new("rollout.abort").about("rollout", other).with("superseded_by", id);
                tx.audit(ended);
                let reason = Reason::from(Code::SupersededBy).with("rollout_id", id);
                let old = Rollout { superseded_by: Some(id.clone()), ..old };
                if old.phase.goes_back() {
                    tx.put_row(old, "rollout.superseded");
                } else {
                    advance::abort(tx, old, reason, false, None, Some(actor.to_string()));
                }
            });
        }
    }
    // The row first: robots of a roll-out that did not begin are nobody's. Its robots come with it, a slice to each
    // item.
    let mut slices = robots.chunks(limits::ITEM_ROWS_MAX / 2);
    let first = slices.next().unwrap_or_default();
    plan.decide(view, now, actor, |tx| {
        let (phase, started, since) = (Phase::Prefetching, Some(tx.now.utc), tx.now.utc);
        let row = Rollout {
            phase,
            started,
            since,
            wave_sizes: sizes.clone(),
            supersedes: others.clone(),
            counted,
            ..rollout.clone()
        };
        tx.put_row(row, "rollout.started");
        let supersede = Verb::Start { supersede };
        tx.audit(note_of_verb(id, &supersede, ""));
        assign::assign_robots(tx, &rollout, first);
    });
    for slice in slices {
        plan.decide(view, now, actor, |tx| assign::assign_robots(tx, &rollout, slice));
    }
}

fn retry_failed(view: &mut RolloutProjection, now: Now, id: &RolloutId, actor: &Actor, reason: &str, plan: &mut Plan) {
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
                    assign::new_robot(&tx.now.clone(), &rollout, &r.robot_id, wave, r.rank, r.from_version.clone());
                let why = (!reason.is_empty()).then(|| Reason::new(Code::RetriedByPerson, reason).with("actor", actor));
                tx.put_row(RolloutRobot { again: true, why, ..fresh }, "robot.retried");
            }
        });
    }
}
