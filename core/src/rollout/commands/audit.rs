//! What a command about software leaves in the audit.

use crate::audit::Note;
use crate::ids::RolloutId;
use crate::rollout::projection::requests::{Command, Verb};

/// Of one command that is one item. A start and a retry are many; the first of them has the row.
pub(super) fn note(command: &Command) -> Note {
    match command {
        Command::Create { rollout_id, spec } => {
            Note::new("rollout.create").about("rollout", rollout_id).about("bundle", &spec.bundle)
        }
        Command::Rollback { of, rollout_id } => {
            Note::new("rollout.rollback").about("rollout", rollout_id).about("rollout", of)
        }
        Command::Do { rollout_id, verb, reason } => note_of_verb(rollout_id, verb, reason),
        Command::Revoke { bundle, reason } => Note::new("bundle.revoke").about("bundle", bundle).because(reason),
        Command::Pin { robot_id, reason } => Note::new("robot.pin").about("robot", robot_id).because(reason),
        Command::Unpin { robot_id } => Note::new("robot.unpin").about("robot", robot_id),
        Command::Unstick { robot_id, reason } => Note::new("robot.unstick").about("robot", robot_id).because(reason),
        Command::AcceptKey { robot_id, device_key } => {
            Note::new("robot.accept_key").about("robot", robot_id).with("device_key", device_key)
        }
        Command::LiftQuarantine { robot_id, bundle } => {
            Note::new("quarantine.lift").about("robot", robot_id).about("bundle", bundle)
        }
    }
}

/// Of something about one roll-out.
pub(super) fn note_of_verb(rollout_id: &RolloutId, verb: &Verb, reason: &str) -> Note {
    let of = |action| Note::new(action).about("rollout", rollout_id).because(reason);
    match verb {
        Verb::Submit => of("rollout.submit"),
        Verb::Approve => of("rollout.approve"),
        Verb::Start { supersede } => of("rollout.start").with("supersede", supersede),
        Verb::Pause => of("rollout.pause"),
        Verb::Resume => of("rollout.resume"),
        Verb::Promote => of("rollout.promote"),
        Verb::Abort => of("rollout.abort"),
        Verb::RetryFailed => of("rollout.retry_failed"),
        Verb::Exclude(robot_id) => of("rollout.exclude").about("robot", robot_id),
        Verb::WriteOff(robot_id) => of("rollout.write_off").about("robot", robot_id),
    }
}
