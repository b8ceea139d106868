//! `midshift task edit|hold|release`: what people change of a task while it waits, and tasks that stand until they are let go.

use super::shown::show;
use super::submit::robot_is_known;
use super::target::TaskTarget;
use crate::client::{Change, Exit, Guarded, unary};
use crate::out::{Out, plain};
use midshift_core::time::Utc;
use midshift_proto::convert::timestamp;
use midshift_proto::task::v1;

/// What is to change of which task.
#[derive(clap::Args)]
pub struct Edit {
    #[command(flatten)]
    one: TaskTarget,
    #[command(flatten)]
    changes: Changes,
    /// Also if nobody knows the robot: the task waits until it comes.
    #[arg(long)]
    unknown_robot: bool,
    /// Why it changes.
    #[arg(long)]
    reason: String,
    #[command(flatten)]
    guarded: Guarded,
}

/// New values; what is not named stays.
#[derive(clap::Args)]
#[group(required = true, multiple = true)]
struct Changes {
    /// 0 most urgent .. 9.
    #[arg(long)]
    priority: Option<i32>,
    /// Worthless after this moment, as 2026-11-22T06:00:00Z.
    #[arg(long, value_name = "TIME", value_parser = moment, conflicts_with = "no_deadline")]
    deadline: Option<Utc>,
    /// Never worthless.
    #[arg(long)]
    no_deadline: bool,
    /// Not before this moment, as 2026-11-22T06:00:00Z.
    #[arg(long, value_name = "TIME", value_parser = moment, conflicts_with = "at_once")]
    not_before: Option<Utc>,
    /// As soon as a robot can.
    #[arg(long)]
    at_once: bool,
    /// Only this robot.
    #[arg(long, conflicts_with = "no_robot")]
    robot: Option<String>,
    /// Any robot that can.
    #[arg(long)]
    no_robot: bool,
}

/// A task that is to stand, or to go on.
#[derive(clap::Args)]
pub struct Stand {
    #[command(flatten)]
    one: TaskTarget,
    /// Why it is to stand or to go on.
    #[arg(long)]
    reason: String,
    #[command(flatten)]
    change: Change,
}

fn moment(text: &str) -> Result<Utc, String> {
    Utc::parse_rfc3339(text).ok_or_else(|| "must be as 2026-11-22T06:00:00Z".to_owned())
}

impl Changes {
    /// What changes, and the names of it.
    fn into_update(self) -> (prost_types::FieldMask, v1::TaskUpdate) {
        let named = [
            ("priority", self.priority.is_some()),
            ("deadline", self.deadline.is_some() || self.no_deadline),
            ("not_before", self.not_before.is_some() || self.at_once),
            ("robot_id", self.robot.is_some() || self.no_robot),
        ];
        let paths = named.into_iter().filter(|(_, is_named)| *is_named).map(|(name, _)| name.to_owned()).collect();
        let update = v1::TaskUpdate {
            priority: self.priority,
            robot_id: self.robot.unwrap_or_default(),
            not_before: self.not_before.map(timestamp),
            deadline: self.deadline.map(timestamp),
        };
        (prost_types::FieldMask { paths }, update)
    }
}

/// Changes a task.
pub async fn edit(args: Edit, out: &Out) -> Result<(), Exit> {
    let Edit { one, changes, unknown_robot, reason, guarded: Guarded { if_match, change } } = args;
    let task_id = one.find().await?;
    let (mask, update) = changes.into_update();
    let request = v1::UpdateTaskRequest {
        task_id: task_id.clone(),
        request_id: change.request_id,
        etag: if_match,
        update_mask: Some(mask),
        update: Some(update),
        reason,
        validate_only: change.dry_run,
    };
    let robot = request.update.as_ref().map_or("", |update| &update.robot_id);
    if !robot.is_empty() && !unknown_robot {
        let check = v1::UpdateTaskRequest { validate_only: true, ..request.clone() };
        robot_is_known(robot, &one.call.task().await?.update_task(unary(check)).await?.into_inner().notes)?;
    }
    let answer = one.call.task().await?.update_task(unary(request)).await?.into_inner();
    show(&answer.task.unwrap_or_default(), out)?;
    answer.notes.iter().for_each(|note| out.inform(&format!("{}: {}", note.code, plain(&note.message))));
    if answer.pending {
        let told = "the edit is durable and waits for fleet, which may still refuse it";
        return Err(Exit::new(10, told).or_try(&format!("midshift task get {task_id}, or the same --request-id again")));
    }
    Ok(())
}

/// Holds a task.
pub async fn hold(args: Stand, out: &Out) -> Result<(), Exit> {
    let Stand { one, reason, change } = args;
    let task_id = one.find().await?;
    let (request_id, validate_only) = (change.request_id, change.dry_run);
    let request = v1::HoldTaskRequest { task_id: task_id.clone(), request_id, reason, validate_only };
    let answer = one.call.task().await?.hold_task(unary(request)).await?.into_inner();
    show(&answer.task.unwrap_or_default(), out)?;
    if answer.pending {
        out.next(&format!("the hold is durable and waits for fleet; midshift task get {task_id}"));
    } else if !validate_only {
        out.next(&format!("midshift task release {task_id} --reason TEXT"));
    }
    Ok(())
}

/// Lets a task go on that a person holds.
pub async fn release(args: Stand, out: &Out) -> Result<(), Exit> {
    let Stand { one, reason, change } = args;
    let task_id = one.find().await?;
    let (request_id, validate_only) = (change.request_id, change.dry_run);
    let request = v1::ReleaseTaskRequest { task_id: task_id.clone(), request_id, reason, validate_only };
    let answer = one.call.task().await?.release_task(unary(request)).await?.into_inner();
    show(&answer.task.unwrap_or_default(), out)?;
    if answer.pending {
        out.next(&format!("the release is durable and waits for fleet; midshift task get {task_id}"));
    }
    Ok(())
}
