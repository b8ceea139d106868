//! Whether somebody may do what is asked about a roll-out, or about the software of a robot.
//!
//! Invariant: no person approves what it wrote itself, by whatever token; what a caller may not see is for it as if it
//! were not there, and what is not there is refused by nobody here.

use super::dry_run::find_superseded;
use crate::fleet::Board;
use crate::identity::{Caller, Permission, Principal};
use crate::ids::{RobotId, RolloutId};
use crate::reason::{Code, Kind, Reason, Refusal};
use crate::rollout::projection::requests::{Command, Verb};
use crate::rollout::projection::rows::{Quarantine, Rollout};
use crate::rollout::projection::state::RolloutProjection;

fn missing(code: Code, key: &str, id: &impl ToString) -> Refusal {
    Refusal::new(Kind::NotFound, Reason::from(code).with(key, id.to_string()))
}

/// Whether a caller may see a roll-out: each area that it is for. One that names none is the site's.
pub fn sees(by: &Caller, rollout: &Rollout) -> bool {
    by.is_permitted_in(Permission::Read, &rollout.spec.selector.areas)
}

/// Whether a caller may see a robot.
pub fn sees_robot(view: &RolloutProjection, board: &Board, by: &Caller, robot_id: &RobotId) -> bool {
    let area = || board.get(robot_id).and_then(|live| view.area_of(live));
    by.is_permitted_everywhere(Permission::Read) || by.is_permitted_in(Permission::Read, area().as_ref())
}

/// A roll-out that a caller may see.
///
/// # Errors
/// It is not there, or may not be seen.
pub fn find_seen<'v>(view: &'v RolloutProjection, by: &Caller, rollout_id: &RolloutId) -> Result<&'v Rollout, Refusal> {
    let found = view.rollout(rollout_id).filter(|rollout| sees(by, rollout));
    found.ok_or_else(|| missing(Code::RolloutNotFound, "rollout_id", rollout_id))
}

fn authorize_rollout(
    view: &RolloutProjection,
    by: &Caller,
    permission: Permission,
    rollout_id: &RolloutId,
) -> Result<(), Refusal> {
    let Some(rollout) = view.rollout(rollout_id) else { return Ok(()) };
    let areas = &rollout.spec.selector.areas;
    by.authorize_visible(permission, areas, || missing(Code::RolloutNotFound, "rollout_id", rollout_id))
}

/// Whether a caller may do what it asks.
///
/// # Errors
/// It may not see what it is about, may not do that to it, or would approve what it wrote.
pub fn permit(view: &RolloutProjection, board: &Board, by: &Caller, command: &Command) -> Result<(), Refusal> {
    let author = Permission::Author;
    match command {
        Command::Create { spec, .. } => {
            let areas = &spec.selector.areas;
            by.authorize(author, areas)?;
            // Another right than to write one: many robots meet a bad bundle before a gate has seen it.
            if spec.allow_full_push { by.authorize(Permission::Push, areas) } else { Ok(()) }
        }
        Command::Rollback { of, .. } => authorize_rollout(view, by, author, of),
        Command::Do { rollout_id, verb: Verb::Approve, .. } => {
            authorize_rollout(view, by, Permission::Approve, rollout_id)?;
            require_another_person(view, by, rollout_id)
        }
        Command::Do { rollout_id, verb, .. } => {
            authorize_rollout(view, by, author, rollout_id)?;
            match verb {
                // Whoever ends others' roll-outs for its own must be allowed to end them.
                Verb::Start { supersede: true } if !by.is_permitted_everywhere(author) => {
                    let others = find_superseded(view, board, rollout_id);
                    others
                        .iter()
                        .filter_map(|id| view.rollout(id))
                        .try_for_each(|r| by.authorize(author, &r.spec.selector.areas))
                }
                _ => Ok(()),
            }
        }
        Command::Revoke { .. } => by.authorize(author, []),
        Command::Pin { robot_id, .. } | Command::Unpin { robot_id } | Command::Unstick { robot_id, .. } => {
            if !view.sessions.contains_key(robot_id.as_str()) {
                return Ok(());
            }
            authorize_robot(view, board, by, robot_id, Code::RobotNotFound)
        }
        // Which machine is which robot is for whoever administers the site.
        Command::AcceptKey { .. } => by.authorize(Permission::Administer, []),
        Command::LiftQuarantine { robot_id, bundle } => {
            if !view.quarantines.contains_key(Quarantine::id_of(robot_id, bundle).as_str()) {
                return Ok(());
            }
            authorize_robot(view, board, by, robot_id, Code::QuarantineNotFound)
        }
    }
}

fn authorize_robot(
    view: &RolloutProjection,
    board: &Board,
    by: &Caller,
    robot_id: &RobotId,
    code: Code,
) -> Result<(), Refusal> {
    let area = board.get(robot_id).and_then(|live| view.area_of(live));
    by.authorize_visible(Permission::Author, area.as_ref(), || missing(code, "robot_id", robot_id))
}

/// Refuses a person that wrote the roll-out itself. Where nobody signs in there is nobody else.
fn require_another_person(view: &RolloutProjection, by: &Caller, rollout_id: &RolloutId) -> Result<(), Refusal> {
    let Some(rollout) = view.rollout(rollout_id) else { return Ok(()) };
    if matches!(by.principal(), Principal::Local) || rollout.created.person() != by.person() {
        return Ok(());
    }
    Err(Refusal::new(Kind::Denied, Reason::from(Code::NotYourOwn).with("rollout_id", rollout_id)))
}
