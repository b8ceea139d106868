//! `midshift task …`

mod change;
mod follow;
mod many;
mod resume;
mod shown;
mod submit;
mod target;
mod types;

pub use resume::Resume;

use super::client::{Call, Change, Exit, Guarded, unary};
use super::explain::verdict;
use super::out::{Out, plain};
use super::zone;
use clap::Subcommand;
use follow::{until_over, watch};
use midshift_proto::task::v1;
use shown::{priority, show, state, waypoints};
use std::time::Duration;
use submit::Submit;
use target::{Answer, TargetTasks, TaskSelection, TaskTarget};
use tonic::Code;

/// How far a long search is, is said after so many tasks each.
const TOLD_EVERY: u64 = 100_000;

/// Verbs of tasks.
#[derive(Subcommand)]
pub enum Verb {
    /// Submit a transport, a task of a registered type, or a whole list.
    Submit(Box<Submit>),
    /// Task types of the site: look at, register, delete.
    #[command(subcommand)]
    Type(types::Verb),
    /// List tasks, newest first.
    Ls(List),
    /// Show one task with its attempts.
    Get(TaskTarget),
    /// Follow changes of tasks.
    Watch {
        #[command(flatten)]
        call: Call,
        /// Only these tasks.
        ids: Vec<String>,
        /// Resume after this cursor.
        #[arg(long, default_value = "")]
        cursor: String,
    },
    /// Wait until a task is over.
    Wait {
        #[command(flatten)]
        one: TaskTarget,
        /// Give up after this (exit code 10).
        #[arg(long, value_parser = super::duration, default_value = "1h")]
        timeout: Duration,
    },
    /// Why a task is not running.
    Explain(TaskTarget),
    /// End a task, or with --all every one that is meant.
    Cancel {
        #[command(flatten)]
        which: TaskSelection,
        /// Why it is to end.
        #[arg(long)]
        reason: String,
        /// End the record at once; the robot stays kept until it reports.
        #[arg(long)]
        force: bool,
        #[command(flatten)]
        guarded: Guarded,
    },
    /// Change a task that waits: its priority, its times, its robot.
    Edit(Box<change::Edit>),
    /// Hold a task: it waits, or its robot pauses where it may, until it is released.
    Hold(change::Stand),
    /// Let a task go on that a person holds.
    Release(change::Stand),
    /// Answer a task that needs an operator, or with --all every one that is meant.
    Resolve {
        #[command(flatten)]
        which: TaskSelection,
        /// What is to become of it.
        #[arg(long = "as", value_enum)]
        resolution: Answer,
        /// What you saw or did.
        #[arg(long)]
        reason: String,
        /// The etag you saw; without it the task is read first.
        #[arg(long, default_value = "")]
        if_match: String,
        #[command(flatten)]
        change: Change,
    },
    /// Let held tasks and robots go on: the same as `midshift resume`.
    Resume(Resume),
}

/// What to list.
#[derive(clap::Args)]
pub struct List {
    #[command(flatten)]
    call: Call,
    #[command(flatten)]
    meant: TargetTasks,
    /// At most so many, 1..1000.
    #[arg(long, default_value_t = 100)]
    limit: u32,
    /// Continue after this page.
    #[arg(long, default_value = "")]
    page_token: String,
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Submit(args) => submit::run(*args, out).await,
        Verb::Type(verb) => types::run(verb, out).await,
        Verb::Ls(args) => list(args, out).await,
        Verb::Get(one) => get(&one, out).await,
        Verb::Watch { call, ids, cursor } => watch(&call, ids, cursor, out).await,
        Verb::Wait { one, timeout } => {
            let id = one.find().await?;
            until_over(&one.call, &id, String::new(), timeout, out).await
        }
        Verb::Explain(one) => explain(&one, out).await,
        Verb::Cancel { which, reason, force, guarded: Guarded { if_match, change } } => {
            let Some(one) = which.one() else { return many::cancel(&which, &reason, force, &change, out).await };
            let task_id = one.find().await?;
            let request = v1::CancelTaskRequest {
                task_id: task_id.clone(),
                request_id: change.request_id,
                etag: if_match,
                reason,
                force,
                validate_only: change.dry_run,
            };
            let answer = one.call.task().await?.cancel_task(unary(request)).await?.into_inner();
            show(&answer.task.clone().unwrap_or_default(), out)?;
            if answer.pending {
                out.next(&format!("the cancel is durable and waits for fleet; midshift task wait {task_id}"));
            }
            Ok(())
        }
        Verb::Edit(args) => change::edit(*args, out).await,
        Verb::Hold(args) => change::hold(args, out).await,
        Verb::Release(args) => change::release(args, out).await,
        Verb::Resolve { which, resolution, reason, if_match, change } => {
            let Some(one) = which.one() else {
                return many::resolve(&which, resolution.wire(), &reason, &change, out).await;
            };
            resolve(one, resolution, reason, if_match, change, out).await
        }
        Verb::Resume(resume) => resume.run(out).await,
    }
}

async fn resolve(
    one: TaskTarget,
    resolution: Answer,
    reason: String,
    if_match: String,
    change: Change,
    out: &Out,
) -> Result<(), Exit> {
    let task = one.read().await?.task.unwrap_or_default();
    let (robot_id, only) = (task.robot_id.clone(), change.dry_run);
    let request = v1::ResolveTaskRequest {
        task_id: task.task_id,
        request_id: change.request_id,
        etag: if if_match.is_empty() { task.etag } else { if_match },
        resolution: resolution.wire() as i32,
        reason,
        validate_only: change.dry_run,
    };
    let answer = one.call.task().await?.resolve_task(unary(request)).await?.into_inner();
    show(&answer.task.unwrap_or_default(), out)?;
    if !only {
        zone::tell_kept(&one.call, &robot_id, out).await;
    }
    Ok(())
}

async fn list(args: List, out: &Out) -> Result<(), Exit> {
    let filter = args.meant.filter()?;
    let mut request = v1::ListTasksRequest { filter: Some(filter), page_size: args.limit, page_token: args.page_token };
    let mut client = args.call.task().await?;
    let mut page = client.list_tasks(unary(request.clone())).await?.into_inner();
    // A rare filter without an index: the server says how far it looked, and goes on from there.
    while page.tasks.is_empty() && !page.next_page_token.is_empty() {
        request.page_token.clone_from(&page.next_page_token);
        let looked_at = page.rows_read;
        page = client.list_tasks(unary(request.clone())).await?.into_inner();
        page.rows_read += looked_at;
        if page.rows_read / TOLD_EVERY > looked_at / TOLD_EVERY {
            out.inform(&format!("{} tasks looked at", page.rows_read));
        }
    }
    out.list(&page)?;
    if !page.next_page_token.is_empty() {
        out.next(&format!("more with --page-token {}", page.next_page_token));
    }
    Ok(())
}

async fn get(one: &TaskTarget, out: &Out) -> Result<(), Exit> {
    let answer = one.read().await?;
    let task = answer.task.clone().unwrap_or_default();
    out.one(&answer, &task.task_id, || {
        let mut text =
            format!("{}  {}  priority {}  {}\n", task.task_id, state(&task), priority(&task), waypoints(&task));
        if let Some(reason) = &task.reason {
            text += &format!("  {}: {}\n", reason.code, plain(&reason.message));
        }
        if !task.edited_fields.is_empty() {
            text += &format!("  changed since it was submitted: {}\n", task.edited_fields.join(", "));
        }
        let allowed = task.allowed_resolutions().filter_map(Answer::word).collect::<Vec<_>>().join(", ");
        if !allowed.is_empty() {
            text += &format!(
                "  a person may answer: midshift task resolve {} --as {allowed} --reason TEXT\n",
                task.task_id
            );
        }
        for attempt in &answer.attempts {
            let name = attempt.state().as_str_name().trim_start_matches("ATTEMPT_STATE_");
            let fault =
                attempt.fault.as_ref().map(|f| format!("  fault {} {}", f.code, plain(&f.message))).unwrap_or_default();
            let refusal = attempt.refusal.as_ref().map(|r| format!("  {}", r.code)).unwrap_or_default();
            text += &format!(
                "  attempt {}  {}  {name}  step {}{fault}{refusal}\n",
                attempt.epoch, attempt.robot_id, attempt.step_index
            );
        }
        text
    })?;
    Ok(())
}

async fn explain(one: &TaskTarget, out: &Out) -> Result<(), Exit> {
    let task_id = one.find().await?;
    let request = midshift_proto::fleet::v1::ExplainTaskRequest { task_id: task_id.clone() };
    let answer = match one.call.fleet().await?.explain_task(unary(request)).await {
        // Fleet knows tasks that are not over; of one that is, the record says why.
        Err(status) if status.code() == Code::NotFound => return get(one, out).await,
        answer => answer?.into_inner(),
    };
    let e = answer.explanation.clone().unwrap_or_default();
    out.one(&answer, &task_id, || {
        let mut text = task_id.clone();
        if let Some(position) = e.position {
            text += &format!("  number {position} in the queue");
        }
        text += &verdict(e.verdict.as_ref(), "nothing holds it");
        text += &super::explain::expected_start(&e);
        text += &e.choice.as_ref().map_or_else(String::new, super::explain::choice);
        let rows: Vec<Vec<String>> = e
            .candidates
            .iter()
            .map(|c| {
                let why =
                    c.reason.as_ref().map_or_else(|| "eligible".to_owned(), |r| format!("{}: {}", r.code, r.message));
                let distance = c.distance_mm.map_or_else(|| "-".to_owned(), |d| format!("{:.1} m", d as f64 / 1000.0));
                vec![c.robot_id.clone(), distance, why]
            })
            .collect();
        if !rows.is_empty() {
            text += &super::out::columns(&["ROBOT", "DISTANCE", "WHY NOT"], &rows);
        }
        text
    })?;
    Ok(())
}
