//! `midshift task …`

mod many;
mod resume;

pub use resume::Resume;

use super::client::{self, Call, Change, Exit, unary};
use super::explain::verdict;
use super::lookup::{self, Found};
use super::out::{Format, Out, plain};
use super::zone;
use crate::site_file;
use crate::task_list::{read_list, request};
use clap::{Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use midshift_core::task::forms::Transport;
use midshift_proto::task::v1::{self, watch_tasks_response::Item};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Duration;
use tonic::Code;

/// How far a long search is, is said after so many tasks each.
const TOLD_EVERY: u64 = 100_000;

/// Verbs of tasks.
#[derive(Subcommand)]
pub enum Verb {
    /// Submit a transport, or a whole list.
    Submit(Box<Submit>),
    /// List tasks, newest first.
    Ls(List),
    /// Show one task with its attempts.
    Get(One),
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
        one: One,
        /// Give up after this (exit code 10).
        #[arg(long, value_parser = super::duration, default_value = "1h")]
        timeout: Duration,
    },
    /// Why a task is not running.
    Explain(One),
    /// End a task, or with --all every one that is meant.
    Cancel {
        #[command(flatten)]
        which: Which,
        /// Why it is to end.
        #[arg(long)]
        reason: String,
        /// End the record at once; the robot stays kept until it reports.
        #[arg(long)]
        force: bool,
        /// Only if the task is still as this etag says.
        #[arg(long, default_value = "")]
        if_match: String,
        #[command(flatten)]
        change: Change,
    },
    /// Answer a task that needs an operator, or with --all every one that is meant.
    Resolve {
        #[command(flatten)]
        which: Which,
        /// What is to become of it.
        #[arg(long = "as", value_enum)]
        resolution: As,
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

/// One task.
#[derive(clap::Args)]
pub struct One {
    #[command(flatten)]
    call: Call,
    /// Its id, or a prefix that only one task has.
    task_id: String,
}

/// One task, or many.
#[derive(clap::Args)]
pub struct Which {
    #[command(flatten)]
    pub(super) call: Call,
    /// Its id, or a prefix that only one task has.
    #[arg(required_unless_present = "all")]
    task_id: Option<String>,
    /// All tasks that the flags mean; each is asked for by itself, with the rights that it needs.
    #[arg(long, conflicts_with_all = ["task_id", "if_match"])]
    all: bool,
    #[command(flatten)]
    pub(super) meant: Meant,
}

/// Which tasks are meant.
#[derive(clap::Args)]
pub struct Meant {
    /// Only these states, e.g. needs-operator.
    #[arg(long)]
    state: Vec<String>,
    /// Only of these robots.
    #[arg(long)]
    robot: Vec<String>,
    /// Only these types.
    #[arg(long = "type")]
    kind: Vec<String>,
    /// Only of this work order.
    #[arg(long, default_value = "")]
    external_ref: String,
}

impl Which {
    /// The one task; none: many are meant.
    fn one(&self) -> Option<One> {
        self.task_id.clone().map(|task_id| One { call: self.call.clone(), task_id })
    }
}

impl Meant {
    /// As the server reads it.
    pub(super) fn filter(&self) -> Result<v1::TaskFilter, Exit> {
        let mut states = Vec::new();
        for text in &self.state {
            let name = format!("TASK_STATE_{}", text.to_uppercase().replace('-', "_"));
            let state = v1::TaskState::from_str_name(&name)
                .ok_or_else(|| Exit::usage(format!("there is no task state {text}")))?;
            states.push(state as i32);
        }
        Ok(v1::TaskFilter {
            states,
            robot_ids: self.robot.clone(),
            types: self.kind.clone(),
            external_ref: self.external_ref.clone(),
            ..v1::TaskFilter::default()
        })
    }
}

/// What to submit.
#[derive(clap::Args)]
pub struct Submit {
    #[command(flatten)]
    call: Call,
    /// Waypoint to pick up at. Without it the robot only drives to --to.
    #[arg(long, default_value = "")]
    from: String,
    /// Waypoint to bring it to.
    #[arg(long, required_unless_present = "file")]
    to: Option<String>,
    /// The item.
    #[arg(long, default_value = "")]
    sku: String,
    /// 0 most urgent .. 9.
    #[arg(long)]
    priority: Option<i64>,
    /// Only this robot.
    #[arg(long, default_value = "")]
    robot: String,
    /// Also if nobody knows a robot that a task names: it waits until that robot comes.
    #[arg(long)]
    unknown_robot: bool,
    /// How long one attempt may take.
    #[arg(long, value_parser = super::duration, default_value = "10m")]
    timeout: Duration,
    /// How long it may be ready before a robot starts; then a person is asked. Without it as long as it takes.
    #[arg(long, value_parser = super::duration)]
    schedule_to_start: Option<Duration>,
    /// Attempts after the first.
    #[arg(long, default_value_t = 3)]
    retries: i64,
    /// Your own id for it.
    #[arg(long, default_value = "")]
    task_id: String,
    /// A list instead: .jsonl, .csv, or .tasks of a grid (then with --map).
    #[arg(long, conflicts_with_all = ["from", "to", "sku", "wait"])]
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

/// What to list.
#[derive(clap::Args)]
pub struct List {
    #[command(flatten)]
    call: Call,
    #[command(flatten)]
    meant: Meant,
    /// At most so many, 1..1000.
    #[arg(long, default_value_t = 100)]
    limit: u32,
    /// Continue after this page.
    #[arg(long, default_value = "")]
    page_token: String,
}

/// Answers to NEEDS_OPERATOR.
#[derive(Clone, Copy, ValueEnum)]
pub enum As {
    /// Try again.
    Requeue,
    /// Try again; the item was handed to another robot.
    HandedOver,
    /// Try again from the start; the item was put back.
    PutBack,
    /// Done by hand.
    Succeeded,
    /// Give up.
    Failed,
    /// Give up; the item is lost.
    ItemLost,
    /// Not wanted any more.
    Canceled,
}

impl As {
    /// The word for an answer on the wire, as `--as` takes it.
    fn word(answer: v1::Resolution) -> Option<String> {
        let known = Self::value_variants().iter().find(|word| word.wire() == answer)?;
        Some(known.to_possible_value()?.get_name().to_owned())
    }
    fn wire(self) -> v1::Resolution {
        match self {
            Self::Requeue => v1::Resolution::Requeue,
            Self::HandedOver => v1::Resolution::RequeueHandedOver,
            Self::PutBack => v1::Resolution::RequeuePutBack,
            Self::Succeeded => v1::Resolution::Succeeded,
            Self::Failed => v1::Resolution::Failed,
            Self::ItemLost => v1::Resolution::FailedItemLost,
            Self::Canceled => v1::Resolution::Canceled,
        }
    }
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Submit(args) => submit(*args, out).await,
        Verb::Ls(args) => list(args, out).await,
        Verb::Get(one) => get(&one, out).await,
        Verb::Watch { call, ids, cursor } => watch(&call, ids, cursor, out).await,
        Verb::Wait { one, timeout } => {
            let id = one.find().await?;
            follow(&one.call, &id, String::new(), timeout, out).await
        }
        Verb::Explain(one) => explain(&one, out).await,
        Verb::Cancel { which, reason, force, if_match, change } => {
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
    one: One,
    resolution: As,
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

impl One {
    /// The whole id behind a prefix. A whole id is always itself, however many others begin with it.
    async fn find(&self) -> Result<String, Exit> {
        if self.task_id.is_empty() {
            return Err(Exit::usage("the id of a task is empty\n  try: midshift task ls"));
        }
        let mut client = self.call.task().await?;
        match client.get_task(unary(v1::GetTaskRequest { task_id: self.task_id.clone() })).await {
            Ok(_) => return Ok(self.task_id.clone()),
            Err(status) if matches!(status.code(), Code::NotFound | Code::InvalidArgument) => {}
            Err(status) => return Err(status.into()),
        }
        let filter = v1::TaskFilter { task_id_prefix: self.task_id.clone(), ..v1::TaskFilter::default() };
        let request =
            v1::ListTasksRequest { filter: Some(filter), page_size: lookup::SHOWN, page_token: String::new() };
        let page = client.list_tasks(unary(request)).await?.into_inner();
        let row = |task: &v1::Task| vec![state(task), way(task)];
        let found = Found::page(&page.tasks, &page.next_page_token, |task| &task.task_id, row);
        let nothing = || Exit::new(4, format!("no task begins with {}\n  try: midshift task ls", self.task_id));
        found.single("task", &self.task_id)?.ok_or_else(nothing)
    }
    async fn read(&self) -> Result<v1::GetTaskResponse, Exit> {
        let task_id = self.find().await?;
        Ok(self.call.task().await?.get_task(unary(v1::GetTaskRequest { task_id })).await?.into_inner())
    }
}

fn state(task: &v1::Task) -> String {
    task.state().as_str_name().trim_start_matches("TASK_STATE_").to_owned()
}

fn reason(task: &v1::Task) -> String {
    task.reason.as_ref().map(|r| r.code.clone()).unwrap_or_default()
}

fn way(task: &v1::Task) -> String {
    let goals = task.spec.iter().flat_map(|s| &s.steps).filter_map(|s| match &s.kind {
        Some(v1::step::Kind::Goto(goto)) => Some(goto.waypoint.as_str()),
        _ => None,
    });
    goals.collect::<Vec<_>>().join(" > ")
}

fn priority(task: &v1::Task) -> String {
    task.spec.as_ref().and_then(|s| s.priority).map_or_else(|| "5".to_owned(), |p| p.to_string())
}

fn show(task: &v1::Task, out: &Out) -> anyhow::Result<()> {
    out.one(task, &task.task_id, || {
        let why = task.reason.as_ref().map(|r| format!("\n  {}: {}", r.code, plain(&r.message))).unwrap_or_default();
        format!("{}  {}  {}  {}{why}", task.task_id, state(task), task.robot_id, way(task))
    })
}

async fn submit(args: Submit, out: &Out) -> Result<(), Exit> {
    if let Some(path) = &args.file {
        return submit_list(&args, path, out).await;
    }
    let transport = Transport {
        kind: if args.from.is_empty() { "patrol" } else { "transport" }.to_owned(),
        priority: args.priority,
        robot_id: args.robot.clone(),
        from_waypoint: args.from.clone(),
        to_waypoint: args.to.clone().unwrap_or_default(),
        item_sku: args.sku.clone(),
        timeout_ms: i64::try_from(args.timeout.as_millis()).ok(),
        max_retry_times: Some(args.retries),
        retry_interval_ms: None,
        schedule_to_start_ms: args.schedule_to_start.and_then(|t| i64::try_from(t.as_millis()).ok()),
    };
    let mut message = request(&transport);
    message.request_id = args.change.request_id.clone();
    message.task_id = args.task_id.clone();
    message.validate_only = args.change.dry_run;
    robots_are_known(&args, std::iter::once(&message)).await?;
    let task = args.call.task().await?.submit_task(unary(message)).await?.into_inner().task.unwrap_or_default();
    if args.wait && !args.change.dry_run {
        let told = tell(&task.task_id, "", &task, out);
        return follow(&args.call, &task.task_id, told, Duration::from_secs(86_400), out).await;
    }
    if args.change.dry_run {
        out.say("valid; nothing was stored");
    }
    show(&task, out)?;
    if !args.change.dry_run {
        out.next(&format!("midshift task wait {}", task.task_id));
    }
    Ok(())
}

/// Refuses to send tasks for robots that the server does not know: one task of each robot is checked, and nothing is stored.
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
        if notes.iter().any(|note| note.code == midshift_core::reason::Code::PinnedRobotUnknown.as_str()) {
            let text = format!("nobody knows a robot {robot}: it is not enrolled and has never connected");
            return Err(Exit::new(4, text).or_try("midshift robot ls, or --unknown-robot to submit it all the same"));
        }
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
        out.say(&format!("{} tasks read; nothing was sent", list.len()));
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
    out.say(&format!("{} submitted, {refused} refused", whole.results.len() - refused));
    if refused > 0 {
        Err(Exit::new(
            2,
            format!("{refused} tasks were refused; mend them and send the list again with --request-id {run}"),
        ))
    } else {
        Ok(())
    }
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
            out.say(&format!("{} tasks looked at", page.rows_read));
        }
    }
    let row = |t: &v1::Task| vec![t.task_id.clone(), state(t), priority(t), t.robot_id.clone(), way(t), reason(t)];
    out.many(&page, &page.tasks, |t| t.task_id.clone(), &["TASK", "STATE", "PRIO", "ROBOT", "WAY", "WHY"], row)?;
    if !page.next_page_token.is_empty() {
        out.next(&format!("more with --page-token {}", page.next_page_token));
    }
    Ok(())
}

async fn get(one: &One, out: &Out) -> Result<(), Exit> {
    let answer = one.read().await?;
    let task = answer.task.clone().unwrap_or_default();
    out.one(&answer, &task.task_id, || {
        let mut text = format!("{}  {}  priority {}  {}\n", task.task_id, state(&task), priority(&task), way(&task));
        if let Some(reason) = &task.reason {
            text += &format!("  {}: {}\n", reason.code, plain(&reason.message));
        }
        let allowed = task.allowed_resolutions().filter_map(As::word).collect::<Vec<_>>().join(", ");
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

async fn explain(one: &One, out: &Out) -> Result<(), Exit> {
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

async fn watch(call: &Call, task_ids: Vec<String>, cursor: String, out: &Out) -> Result<(), Exit> {
    let filter = v1::TaskFilter { task_ids, ..v1::TaskFilter::default() };
    // A stream that was cut goes on behind what it said last.
    let said = RefCell::new(cursor.clone());
    let open = async || {
        let request = v1::WatchTasksRequest { filter: Some(filter.clone()), cursor: said.borrow().clone() };
        Ok(call.task().await?.watch_tasks(request).await?.into_inner())
    };
    let take = |message: Option<v1::WatchTasksResponse>| {
        if let Some(message) = message {
            show_change(&message, out)?;
            said.replace(message.cursor);
        }
        Ok(ControlFlow::Continue(()))
    };
    loop {
        match client::follow(out, &open, take).await {
            // A place that the caller named is the caller's to mend.
            Err(exit) if exit.is_of_a_lost_place() && *said.borrow() != cursor => {
                out.say("the server does not know any more where this watch was: what is known now follows, and changes may be missing");
                said.take();
            }
            end => return end,
        }
    }
}

fn show_change(message: &v1::WatchTasksResponse, out: &Out) -> Result<(), Exit> {
    if matches!(out.format, Format::Json | Format::Jsonl) {
        return Ok(out.json(message)?);
    }
    let task = match &message.item {
        Some(Item::Existing(task)) => Some(task),
        Some(Item::Change(change)) => change.task.as_ref(),
        Some(Item::Bookmark(_)) | None => None,
    };
    if let Some(task) = task {
        let (state, way, reason) = (state(task), way(task), reason(task));
        out.line(&format!("{}  {state:<14}  {:<8}  {way}  {reason}", task.task_id, task.robot_id));
    }
    Ok(())
}

/// Follows a task to its end; exit code by how it ended; `told` is what was last said of it.
async fn follow(call: &Call, task_id: &str, told: String, timeout: Duration, out: &Out) -> Result<(), Exit> {
    let end = tokio::time::timeout(timeout, until_over(call, task_id, told, out)).await;
    let task = end.map_err(|_| {
        Exit::new(10, format!("{task_id} is not over after {timeout:?}\n  try: midshift task explain {task_id}"))
    })??;
    let took = match (&task.create_time, &task.end_time) {
        (Some(from), Some(to)) => (to.seconds - from.seconds) as f64 + f64::from(to.nanos - from.nanos) / 1e9,
        _ => 0.0,
    };
    let path_m = task.stats.as_ref().map_or(0.0, |s| s.path_mm as f64 / 1000.0);
    out.one(&task, &task.task_id, || format!("  {took:.1} s, {path_m:.1} m, attempt {}", task.epoch))?;
    match task.state() {
        v1::TaskState::Succeeded => Ok(()),
        v1::TaskState::NeedsOperator => Err(Exit::new(
            1,
            format!("{task_id} needs an operator: {}\n  try: midshift task get {task_id}", reason(&task)),
        )),
        _ => Err(Exit::new(1, format!("{task_id} ended {}: {}", state(&task), reason(&task)))),
    }
}

/// Says where a task is, if that is news, and gives it back.
fn tell(task_id: &str, told: &str, task: &v1::Task, out: &Out) -> String {
    let now = format!("{} {}", state(task), task.robot_id).trim().to_owned();
    if now != told && out.format == Format::Table {
        let begin = if told.is_empty() { task_id } else { "  >" };
        out.say(&format!("{begin} {now}"));
    }
    now
}

async fn until_over(call: &Call, task_id: &str, mut told: String, out: &Out) -> Result<v1::Task, Exit> {
    let open = async || {
        let filter = v1::TaskFilter { task_ids: vec![task_id.to_owned()], ..v1::TaskFilter::default() };
        let request = v1::WatchTasksRequest { filter: Some(filter), cursor: String::new() };
        Ok(call.task().await?.watch_tasks(request).await?.into_inner())
    };
    let mut is_known = false;
    let take = |message: Option<v1::WatchTasksResponse>| {
        let task = match message.and_then(|m| m.item) {
            Some(Item::Existing(task)) => task,
            Some(Item::Change(change)) => change.task.unwrap_or_default(),
            Some(Item::Bookmark(_)) if !is_known => {
                return Err(Exit::new(4, format!("the server knows no task {task_id}\n  try: midshift task ls")));
            }
            Some(Item::Bookmark(_)) => return Ok(ControlFlow::Continue(())),
            None => {
                is_known = false;
                return Ok(ControlFlow::Continue(()));
            }
        };
        is_known = true;
        told = tell(task_id, &told, &task, out);
        use v1::TaskState::{Canceled, Expired, Failed, NeedsOperator, Succeeded};
        let is_over = matches!(task.state(), Succeeded | Failed | Canceled | Expired | NeedsOperator);
        Ok(if is_over { ControlFlow::Break(task) } else { ControlFlow::Continue(()) })
    };
    client::follow(out, open, take).await
}

#[cfg(test)]
mod tests {
    #[test]
    fn each_answer_that_a_task_allows_is_told_by_the_word_that_the_command_takes() {
        use clap::ValueEnum;
        for number in 1.. {
            let Ok(answer) = super::v1::Resolution::try_from(number) else { break };
            let word = super::As::word(answer).expect("a word");
            assert_eq!(super::As::from_str(&word, false).map(super::As::wire), Ok(answer), "{word}");
        }
    }
}
