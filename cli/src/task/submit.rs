//! `midshift task submit`: a transport, a task by type and fields, or a whole list.

use super::follow::{report_state, until_over};
use super::shown::show;
use crate::client::{Call, Change, Exit, unary};
use crate::out::Out;
use crate::site_file;
use crate::task_list::{read_list, request};
use indicatif::{ProgressBar, ProgressStyle};
use midshift_core::task::forms::Transport;
use midshift_proto::common::v1::Reason;
use midshift_proto::task::v1;
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

/// How long one attempt of a transport may take where nothing is said.
const TIMEOUT: Duration = Duration::from_secs(600);

/// What to submit.
#[derive(clap::Args)]
pub struct Submit {
    #[command(flatten)]
    call: Call,
    /// Waypoint to pick up at. Without it the robot only drives to --to.
    #[arg(long, default_value = "")]
    from: String,
    /// Waypoint to bring it to.
    #[arg(long, required_unless_present_any = ["file", "type"])]
    to: Option<String>,
    /// A task of this registered type instead (`midshift task type ls`): its steps are made of its fields.
    #[arg(long, value_name = "TYPE", conflicts_with_all = ["from", "to", "sku"])]
    r#type: Option<String>,
    /// A field of the type, as often as needed.
    #[arg(long, value_name = "NAME=VALUE", requires = "type", value_parser = field_value)]
    field: Vec<(String, String)>,
    /// The item.
    #[arg(long, default_value = "")]
    sku: String,
    /// 0 most urgent .. 9.
    #[arg(long)]
    priority: Option<i64>,
    /// Only this robot.
    #[arg(long, default_value = "")]
    robot: String,
    /// Only the robot that had this task, once that has ended.
    #[arg(long, default_value = "", conflicts_with = "robot")]
    same_robot_as: String,
    /// Of the ready tasks with one key and the same areas only the newest stays.
    #[arg(long, default_value = "")]
    coalesce_key: String,
    /// Also if nobody knows a robot that a task names: it waits until that robot comes.
    #[arg(long)]
    unknown_robot: bool,
    /// How long one attempt may take. Without it 10m, or what the type says.
    #[arg(long, value_parser = crate::duration)]
    timeout: Option<Duration>,
    /// How long it may be ready before a robot starts; then a person is asked. Without it as long as it takes.
    #[arg(long, value_parser = crate::duration)]
    schedule_to_start: Option<Duration>,
    /// Attempts after the first.
    #[arg(long, default_value_t = 3)]
    retries: i64,
    /// Your own id for it.
    #[arg(long, default_value = "")]
    task_id: String,
    /// A list instead: .jsonl, .csv, or .tasks of a grid (then with --map).
    #[arg(long, conflicts_with_all = ["from", "to", "sku", "type", "same_robot_as", "coalesce_key", "wait"])]
    file: Option<PathBuf>,
    /// The grid map a .tasks list belongs to.
    #[arg(long)]
    map: Option<PathBuf>,
    /// Follow it to its end.
    #[arg(long)]
    wait: bool,
    #[command(flatten)]
    change: Change,
}

/// A field and its value, which may be empty.
fn field_value(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() => Ok((name.to_owned(), value.to_owned())),
        _ => Err("must be NAME=VALUE".to_owned()),
    }
}

/// Submits a task, or a list of them.
pub async fn run(args: Submit, out: &Out) -> Result<(), Exit> {
    if let Some(path) = &args.file {
        return submit_list(&args, path, out).await;
    }
    let mut message = match &args.r#type {
        Some(name) => typed(&args, name)?,
        None => request(&transport(&args)),
    };
    message.request_id = args.change.request_id.clone();
    message.task_id = args.task_id.clone();
    message.validate_only = args.change.dry_run;
    robots_are_known(&args, std::iter::once(&message)).await?;
    let task = args.call.task().await?.submit_task(unary(message)).await?.into_inner().task.unwrap_or_default();
    if args.wait && !args.change.dry_run {
        let told = report_state(&task.task_id, "", &task, out);
        return until_over(&args.call, &task.task_id, told, Duration::from_secs(86_400), out).await;
    }
    if args.change.dry_run {
        out.inform("valid; nothing was stored");
    }
    show(&task, out)?;
    if !args.change.dry_run {
        out.next(&format!("midshift task wait {}", task.task_id));
    }
    Ok(())
}

fn transport(args: &Submit) -> Transport {
    let milliseconds = |time: Duration| i64::try_from(time.as_millis()).ok();
    Transport {
        kind: if args.from.is_empty() { "patrol" } else { "transport" }.to_owned(),
        priority: args.priority,
        robot_id: args.robot.clone(),
        from_waypoint: args.from.clone(),
        to_waypoint: args.to.clone().unwrap_or_default(),
        item_sku: args.sku.clone(),
        timeout_ms: milliseconds(args.timeout.unwrap_or(TIMEOUT)),
        max_retry_times: Some(args.retries),
        retry_interval_ms: None,
        schedule_to_start_ms: args.schedule_to_start.and_then(milliseconds),
        same_robot_as: args.same_robot_as.clone(),
        coalesce_key: args.coalesce_key.clone(),
    }
}

/// A task by type and fields. Values go as text: the server reads them as the type says.
fn typed(args: &Submit, name: &str) -> Result<v1::SubmitTaskRequest, Exit> {
    let mut fields = prost_types::Struct::default();
    for (field, value) in &args.field {
        let text = prost_types::value::Kind::StringValue(value.clone());
        if fields.fields.insert(field.clone(), prost_types::Value { kind: Some(text) }).is_some() {
            return Err(Exit::new(2, format!("--field {field} is there twice")));
        }
    }
    let small = |number: i64| i32::try_from(number).unwrap_or(i32::MAX);
    let seconds = |time: Duration| i32::try_from(time.as_secs()).unwrap_or(i32::MAX);
    let typed = v1::TypedTask {
        r#type: name.to_owned(),
        fields: Some(fields),
        robot_id: args.robot.clone(),
        priority: args.priority.map(small),
        timeout_seconds: args.timeout.map(seconds),
        max_retry_times: Some(small(args.retries)),
        schedule_to_start_seconds: args.schedule_to_start.map(seconds),
        same_robot_as: args.same_robot_as.clone(),
        coalesce_key: args.coalesce_key.clone(),
        ..v1::TypedTask::default()
    };
    let body = Some(v1::submit_task_request::Body::Typed(typed));
    Ok(v1::SubmitTaskRequest { body, ..v1::SubmitTaskRequest::default() })
}

/// Refuses to send tasks for robots that the server does not know: one task of each robot is checked, and nothing is
/// stored.
async fn robots_are_known(args: &Submit, tasks: impl IntoIterator<Item = &v1::SubmitTaskRequest>) -> Result<(), Exit> {
    if args.unknown_robot {
        return Ok(());
    }
    let mut pinned = BTreeMap::new();
    for task in tasks {
        let robot = robot_of(task);
        if !robot.is_empty() {
            pinned.entry(robot.to_owned()).or_insert(task);
        }
    }
    let mut client = args.call.task().await?;
    for (robot, task) in pinned {
        let check = v1::SubmitTaskRequest { validate_only: true, ..task.clone() };
        let notes = client.submit_task(unary(check)).await?.into_inner().notes;
        robot_is_known(&robot, &notes)?;
    }
    Ok(())
}

/// Refuses to bind a task to a robot of which the server's notes say that nobody knows it.
pub(super) fn robot_is_known(robot: &str, notes: &[Reason]) -> Result<(), Exit> {
    if notes.iter().any(|note| note.code == midshift_core::reason::Code::PinnedRobotUnknown.as_str()) {
        let text = format!("nobody knows a robot {robot}: it is not enrolled and has never connected");
        return Err(
            Exit::new(4, text).or_try("midshift robot ls, or --unknown-robot to bind the task to it all the same")
        );
    }
    Ok(())
}

/// The robot that a task names; empty: none.
fn robot_of(task: &v1::SubmitTaskRequest) -> &str {
    use v1::submit_task_request::Body;
    match &task.body {
        Some(Body::Spec(spec)) => &spec.robot_id,
        Some(Body::Flat(flat)) => &flat.robot_id,
        Some(Body::Nested(nested)) => &nested.robot_id,
        Some(Body::Typed(typed)) => &typed.robot_id,
        None => "",
    }
}

/// Tasks of one call.
const BURST: usize = 1_000;

async fn submit_list(args: &Submit, path: &std::path::Path, out: &Out) -> Result<(), Exit> {
    let site = site_file::load(None, args.map.as_deref(), None)?.site;
    let mut list = read_list(path, &site)?;
    let run = if args.change.request_id.is_empty() {
        format!("cli-{:016x}", rand::random::<u64>())
    } else {
        args.change.request_id.clone()
    };
    for (i, item) in list.iter_mut().enumerate() {
        item.request_id = format!("{run}-{}", i + 1);
    }
    if args.change.dry_run {
        out.inform(&format!("{} tasks read; nothing was sent", list.len()));
        return Ok(());
    }
    robots_are_known(args, &list).await?;
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new(list.len() as u64) } else { ProgressBar::hidden() };
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} submitted") {
        bar.set_style(style);
    }
    let mut client = args.call.task().await?;
    let mut whole = v1::SubmitTasksResponse::default();
    while !list.is_empty() {
        let rest = list.split_off(list.len().min(BURST));
        let items: Vec<_> = std::mem::replace(&mut list, rest)
            .into_iter()
            .map(|item| v1::SubmitTasksRequest { item: Some(item) })
            .collect();
        let sent = items.len() as u64;
        whole.results.extend(client.submit_tasks(tokio_stream::iter(items)).await?.into_inner().results);
        bar.inc(sent);
    }
    bar.finish_and_clear();
    use v1::submit_task_result::Outcome;
    let refused = whole.results.iter().filter(|r| matches!(r.outcome, Some(Outcome::Refusal(_)))).count();
    let rows = |r: &v1::SubmitTaskResult| match &r.outcome {
        Some(Outcome::TaskId(id)) => vec![r.request_id.clone(), id.clone(), String::new()],
        Some(Outcome::Refusal(refusal)) => {
            let why = refusal
                .violations
                .iter()
                .map(|v| format!("{}: {}", v.field, v.description))
                .collect::<Vec<_>>()
                .join("; ");
            vec![r.request_id.clone(), "refused".to_owned(), why]
        }
        None => vec![r.request_id.clone(), "unknown".to_owned(), String::new()],
    };
    out.many(&whole, &whole.results, |r| r.request_id.clone(), &["REQUEST", "TASK", "WHY"], rows)?;
    out.inform(&format!("{} submitted, {refused} refused", whole.results.len() - refused));
    if refused > 0 {
        Err(Exit::new(
            2,
            format!("{refused} tasks were refused; mend them and send the list again with --request-id {run}"),
        ))
    } else {
        Ok(())
    }
}
