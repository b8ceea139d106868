//! What a task costs the server from its submit until it is over: CPU, context switches, bytes and commits, less what the same robots cost in
//! the same run before, while they had nothing to do. So what grows with a store counts as cost of tasks.
//!
//! The robots do in no time what they are given. The server and they have a core each; whoever submits, and PostgreSQL, run on all. Its CPU is
//! told for itself.

use crate::child::Child;
use crate::engine::{Engine, EngineArgs};
use crate::figure::Figure;
use crate::simulators::await_sessions;
use crate::submit::transports;
use crate::usage::{Rates, Usage};
use anyhow::ensure;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::SubmitTaskRequest;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use std::time::Duration;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tonic::transport::Channel;

/// How often a server is asked how many tasks it has, with work and without.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Different transports that are submitted over and over.
const TRANSPORTS: usize = 1_000;
/// Open tasks of each robot above which the robots are too slow for the rate: what is measured would be a backlog.
const OPEN_PER_ROBOT: u64 = 2;
const ADMITTED: &str = "midshift_task_admitted_total";
const OPEN: &str = "midshift_fleet_tasks_open";

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct TaskArgs {
    /// Simulated robots on the demo site, at most 20.
    #[arg(long, default_value_t = 20)]
    robots: usize,
    /// Tasks a second.
    #[arg(long, default_value_t = 32)]
    rate: u64,
    /// Seconds measured of each round, first idle, then at work. CPU is counted in hundredths of a second.
    #[arg(long, default_value_t = 60)]
    seconds: u64,
    /// Seconds before each of the two that are not measured.
    #[arg(long, default_value_t = 15)]
    settle_seconds: u64,
    /// Rounds on each engine.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    #[command(flatten)]
    engine: EngineArgs,
}

/// One round.
struct Measured {
    /// Each second without work, and with it.
    idle: Rates,
    busy: Rates,
    /// Over each second.
    tasks: f64,
    /// The database's own processes, seconds of CPU each second, without work and with it.
    database: Option<(f64, f64)>,
}

/// Runs rounds on each engine, in turn.
pub async fn run(args: TaskArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let engines = args.engine.engines(say);
    let requests = transports(&text::parse(DEMO)?, TRANSPORTS)?;
    let mut measured: Vec<Vec<Measured>> = engines.iter().map(|_| Vec::new()).collect();
    for round in 1..=args.rounds {
        for (engine, rounds) in engines.iter().zip(&mut measured) {
            let one = measure(&args, engine, &requests).await?;
            let each_ms = (one.busy.cpu_s - one.idle.cpu_s) * 1e3 / one.tasks;
            say(&format!("round {round}{}: {:.1} tasks a second, {each_ms:.2} ms each", engine.suffix(), one.tasks));
            rounds.push(one);
        }
    }
    Ok(engines.iter().zip(&measured).flat_map(|(engine, rounds)| figures(&args, engine, rounds)).collect())
}

async fn measure(args: &TaskArgs, engine: &Engine, requests: &[SubmitTaskRequest]) -> anyhow::Result<Measured> {
    let bed = engine.bed(args.engine.dir.as_ref())?;
    let mut server = bed.serve(None, Some(0)).await?;
    let robots = start_robots(args, &server)?;
    await_sessions(&mut server, args.robots).await?;
    let (idle, _, database_idle) = spend(args, engine, &mut server, None).await?;
    let work = Submitter { client: TaskServiceClient::new(server.channel().await?), requests, submitted: 0 };
    let (busy, tasks, database_busy) = spend(args, engine, &mut server, Some(work)).await?;
    ensure!(tasks > 0.0, "no task is over");
    drop((robots, server));
    Ok(Measured { idle, busy, tasks, database: database_idle.zip(database_busy) })
}

fn start_robots(args: &TaskArgs, server: &Child) -> anyhow::Result<Child> {
    let (address, robots) = (server.address.to_string(), args.robots.to_string());
    Child::start(&["workers", "--server", &address, "--robots", &robots], Some(1))
}

/// What the server spends each second, what it has done each second, and the database's CPU, after a while to settle.
async fn spend(
    args: &TaskArgs,
    engine: &Engine,
    server: &mut Child,
    mut work: Option<Submitter<'_>>,
) -> anyhow::Result<(Rates, f64, Option<f64>)> {
    pass(args, args.settle_seconds, server, &mut work).await?;
    let (before, over, database_s) = (Usage::read(server)?, count_over(server)?, engine.cpu_s()?);
    let begun = Instant::now();
    pass(args, args.seconds, server, &mut work).await?;
    let seconds = begun.elapsed().as_secs_f64();
    let spent = Usage::read(server)?.a_second_since(&before, seconds);
    let database = engine.cpu_s()?.zip(database_s).map(|(after_s, before_s)| (after_s - before_s) / seconds);
    Ok((spent, count_over(server)?.saturating_sub(over) as f64 / seconds, database))
}

/// Lets some seconds go by, with or without work.
async fn pass(
    args: &TaskArgs,
    seconds: u64,
    server: &mut Child,
    work: &mut Option<Submitter<'_>>,
) -> anyhow::Result<()> {
    let end = Instant::now() + Duration::from_secs(seconds);
    let mut due = interval(Duration::from_secs(1) / u32::try_from(args.rate.max(1))?);
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut look = interval(LOOK_EVERY);
    while Instant::now() < end {
        tokio::select! {
            _ = look.tick() => {
                let open = server.ask(OPEN)?;
                ensure!(open <= OPEN_PER_ROBOT * args.robots as u64, "{open} tasks are open: ask for a lower --rate");
            }
            _ = due.tick() => if let Some(work) = work { work.submit().await? },
        }
    }
    Ok(())
}

/// Tasks that are over, however they ended. The server counts the open ones at its sweeps.
fn count_over(server: &mut Child) -> anyhow::Result<u64> {
    Ok(server.ask(ADMITTED)?.saturating_sub(server.ask(OPEN)?))
}

/// Submits one transport after the other.
struct Submitter<'r> {
    client: TaskServiceClient<Channel>,
    requests: &'r [SubmitTaskRequest],
    submitted: usize,
}

impl Submitter<'_> {
    async fn submit(&mut self) -> anyhow::Result<()> {
        let mut request = self.requests[self.submitted % self.requests.len()].clone();
        request.request_id = format!("bench-{:08}", self.submitted);
        self.submitted += 1;
        self.client.submit_task(request).await?;
        Ok(())
    }
}

fn figures(args: &TaskArgs, engine: &Engine, rounds: &[Measured]) -> Vec<Figure> {
    let load = format!("{} robots, {}/s", args.robots, args.rate);
    let name = |what: &str| format!("a task, {what}, {load}{}", engine.suffix());
    let each = |of: fn(&Rates) -> f64, scale: f64| -> Vec<f64> {
        rounds.iter().map(|r| (of(&r.busy) - of(&r.idle)) * scale / r.tasks).collect()
    };
    let a_second = |of: fn(&Measured) -> f64| rounds.iter().map(of).collect::<Vec<_>>();
    let mut figures = vec![
        Figure::new("P5", name("over each second"), "1/s", &a_second(|r| r.tasks), None),
        Figure::new("P5", name("server CPU each, less idle"), "ms", &each(|u| u.cpu_s, 1e3), None),
        Figure::new("P5", name("the same robots idle"), "ms/s", &a_second(|r| r.idle.cpu_s * 1e3), None),
        Figure::new("P5", name("context switches each"), "", &each(|u| u.switches, 1.0), None),
        Figure::new("P5", name("commits each"), "", &each(|u| u.groups, 1.0), None),
    ];
    if engine.pid().is_none() {
        figures.push(Figure::new("P5", name("written each"), "KB", &each(|u| u.written_bytes, 1e-3), None));
    }
    let database: Vec<f64> = rounds
        .iter()
        .filter_map(|round| round.database.map(|(idle, busy)| (busy - idle) * 1e3 / round.tasks))
        .collect();
    if !database.is_empty() {
        figures.push(Figure::new("P5", name("CPU of the database each"), "ms", &database, None));
    }
    figures
}
