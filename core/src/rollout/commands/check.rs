//! Whether a command fits what is known: nothing of it is written before all of it was looked at.
//!
//! Invariant: what was carried out before is told from what may not be done, so that asking twice does the same once.

use super::dry_run::{dry_run, find_bundle, find_overlapping, meets_floor, members_to_start};
use crate::fleet::Board;
use crate::ids::RobotId;
use crate::limits;
use crate::reason::{Code, Kind, Reason, Refusal, Violations};
use crate::rollout::members::matching::is_kept;
use crate::rollout::projection::requests::{Command, Verb};
use crate::rollout::projection::rows::{Pause, Phase, Quarantine, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::robots::due::is_irreversible;
use crate::rows::Revision;

fn not_found(code: Code, key: &str, id: &impl ToString) -> Refusal {
    Refusal::new(Kind::NotFound, Reason::from(code).with(key, id.to_string()))
}

/// Checks a command against what is known; an error changes nothing. True: it was carried out before.
///
/// # Errors
/// Why not.
pub(in crate::rollout) fn check_command(
    view: &RolloutProjection,
    board: &Board,
    command: &Command,
    seen: Option<Revision>,
) -> Result<bool, Refusal> {
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
            meets_floor(find_bundle(view, &spec.bundle)?, spec)?;
            has_room(view)
        }
        Command::Rollback { of, rollout_id } => {
            if let Some(known) = view.rollout(rollout_id) {
                let same = known.revert_of.as_ref() == Some(of);
                let reason = || Reason::from(Code::RolloutIdTaken).with("rollout_id", rollout_id);
                return if same { Ok(true) } else { Err(Refusal::new(Kind::AlreadyExists, reason())) };
            }
            let known = view.rollout(of).ok_or_else(|| not_found(Code::RolloutNotFound, "rollout_id", of))?;
            let keeps = view.robots_of(of).any(|r| is_kept(view, known, r));
            if known.phase != Phase::Completed || !keeps || is_irreversible(view, known) {
                return Err(Refusal::new(
                    Kind::Precondition,
                    Reason::from(Code::NothingToRevert).with("rollout_id", of),
                ));
            }
            has_room(view)
        }
        Command::Do { rollout_id, verb, .. } => {
            let revised = view.rollouts.get(rollout_id.as_str());
            let revised = revised.ok_or_else(|| not_found(Code::RolloutNotFound, "rollout_id", rollout_id))?;
            let current = Revision(revised.row.version);
            if seen.is_some_and(|seen| seen != current) {
                let reason = Reason::from(Code::EtagMismatch).with("etag", current.0);
                return Err(Refusal::new(Kind::Conflict, reason));
            }
            verb_fits(view, board, &revised.row, verb)
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
            if stuck_robots(view, robot_id).next().is_some() {
                return Ok(false);
            }
            let reason = || Reason::from(Code::NotStuck).with("robot_id", robot_id);
            let is_told = view.rows_of_robot(robot_id).any(|r| r.step == Step::Reverting && r.way_back.unstuck);
            if is_told { Ok(true) } else { Err(Refusal::new(Kind::Precondition, reason())) }
        }
        Command::AcceptKey { robot_id, device_key } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Err(not_found(Code::RobotNotFound, "robot_id", robot_id));
            }
            Ok(view.software_of(robot_id).device_key.as_ref() == Some(device_key))
        }
        Command::LiftQuarantine { robot_id, bundle } => {
            let known = view.quarantines.contains_key(Quarantine::id_of(robot_id, bundle).as_str());
            if known { Ok(false) } else { Err(not_found(Code::QuarantineNotFound, "robot_id", robot_id)) }
        }
    }
}

/// The robot in each roll-out that it could not go back from.
pub(super) fn stuck_robots<'a>(
    view: &'a RolloutProjection,
    robot_id: &'a RobotId,
) -> impl Iterator<Item = &'a RolloutRobot> {
    view.rows_of_robot(robot_id).filter(|r| r.step == Step::Stuck)
}

fn has_room(view: &RolloutProjection) -> Result<bool, Refusal> {
    let open = view.rollouts.values().filter(|r| !r.row.phase.is_over()).count();
    if open >= limits::ROLLOUTS_OPEN_MAX {
        return Err(Refusal::new(Kind::Exhausted, Reason::from(Code::Overloaded).with("rollouts_open", open)));
    }
    Ok(false)
}

/// True: it was done before.
fn verb_fits(view: &RolloutProjection, board: &Board, rollout: &Rollout, verb: &Verb) -> Result<bool, Refusal> {
    let phase = rollout.phase;
    let now_is = |fits: bool, done: bool| {
        let reason = || {
            let reason = Reason::from(Code::NotAllowedNow).with("phase", format!("{phase:?}").to_uppercase());
            if rollout.pauses.is_empty() { reason } else { reason.with("pauses", rollout.pauses_text()) }
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
        Verb::WriteOff(robot_id) => {
            let known = view.robot_of(&rollout.rollout_id, robot_id);
            let known = known.ok_or_else(|| not_found(Code::RobotNotFound, "robot_id", robot_id))?;
            let after = rollout.spec.lost_after_ms;
            let reason = || Reason::from(Code::RobotNotLost).with("robot_id", robot_id).with("lost_after_ms", after);
            let lost = known.lost.as_ref().ok_or_else(|| Refusal::new(Kind::Precondition, reason()))?;
            Ok(lost.written_off.is_some())
        }
    }
}

pub(super) fn is_to_retry(r: &RolloutRobot) -> bool {
    matches!(r.step, Step::RolledBack | Step::Skipped) && r.why.as_ref().is_none_or(|w| w.code != Code::SkippedExcluded)
}

fn may_start(view: &RolloutProjection, board: &Board, rollout: &Rollout, supersede: bool) -> Result<(), Refusal> {
    let (robots, _) = members_to_start(view, board, rollout)?;
    let others = find_overlapping(view, rollout, robots.iter().map(|(id, ..)| id));
    match others.iter().next() {
        Some(other) if !supersede => {
            Err(Refusal::new(Kind::Precondition, Reason::from(Code::RolloutOverlap).with("rollout_id", other)))
        }
        _ => Ok(()),
    }
}
