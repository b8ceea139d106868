//! P6: a server at a site where much is over, beside one on an empty store: how soon it is ready and offers after a start, a takeover, and its memory;
//! and how long commands and explanations take that this process asks while the server plans.
//!
//! Invariant: an old store is written once for each engine, and each start is one of a server that ended as it was asked to.

use crate::child::Child;
use crate::engine::{Bed, Engine, EngineArgs};
use crate::figure::{Figure, percentile};
use crate::grid_map;
use crate::offer::{Idle, one};
use crate::old_sites::old_site::OldSite;
use crate::old_sites::old_tables;
use crate::submit::transports;
use anyhow::{Context, ensure};
use midshift_agent::clock::wall;
use midshift_core::site::{Site, grid};
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{CordonRobotRequest, ExplainRobotRequest, ExplainTaskRequest, UncordonRobotRequest};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{
    CancelTasksRequest, SubmitTaskRequest, SubmitTasksRequest, submit_task_result::Outcome,
};
use midshift_server::storage::Database;
use std::path::{Path, PathBuf};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tonic::transport::Channel;

/// Side of the free grid that robots stand on.
const SIDE: usize = 40;
/// Tasks of one batch.
const BATCH: usize = 1_000;

/// What to measure of a server.
#[derive(Clone, Debug, clap::Args)]
pub struct OldArgs {
    /// Tasks that are over in the old store.
    #[arg(long, default_value_t = 1_000_000)]
    ended: u64,
    /// Robots at work while commands and explanations are asked.
    #[arg(long, default_value_t = 50)]
    robots: usize,
    /// Tasks that wait for them.
    #[arg(long, default_value_t = 5_000)]
    live: usize,
    /// Commands and explanations of a round, of each.
    #[arg(long, default_value_t = 300)]
    asks: usize,
    /// Rounds of each.
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Figures of several rounds.
#[derive(Default)]
struct Rounds {
    ready_ms: Vec<f64>,
    offer_ms: Vec<f64>,
    rss_mib: Vec<f64>,
    takeover_ms: Vec<f64>,
    raw_ms: Vec<f64>,
    /// Explanations of a robot and of a task, and commands.
    asked_ms: [Vec<Vec<f64>>; 3],
}

/// Runs rounds on an empty and on an old store of each engine.
pub async fn run(args: &OldArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    for engine in args.engine.engines(say) {
        let empty = rounds(args, &engine, 0, say).await?;
        let old = rounds(args, &engine, args.ended, say).await?;
        figures.extend(figures_of(args, &engine, 0, &empty, &empty));
        figures.extend(figures_of(args, &engine, args.ended, &old, &empty));
    }
    Ok(figures)
}

fn figures_of(args: &OldArgs, engine: &Engine, ended: u64, rounds: &Rounds, empty: &Rounds) -> Vec<Figure> {
    let name = |what: &str| format!("{ended} ended tasks, {what}{}", engine.suffix());
    let raw = Some((engine.limit(), rounds.raw_ms.as_slice()));
    let beside = |of: fn(&Rounds) -> &Vec<f64>| Some(("of an empty store", of(empty).as_slice()));
    let of_server =
        |what: &str, unit, of: fn(&Rounds) -> &Vec<f64>| Figure::new("P6", name(what), unit, of(rounds), beside(of));
    let mut figures = vec![
        of_server("start to a port that listens", "ms", |r| &r.ready_ms),
        of_server("from there to a robot's first offer", "ms", |r| &r.offer_ms),
        of_server("memory after it", "MiB", |r| &r.rss_mib),
    ];
    if !rounds.takeover_ms.is_empty() {
        figures.push(of_server("kill -9 of the one that plans to the next first offer", "ms", |r| &r.takeover_ms));
    }
    let (robots, live) = (args.robots, args.live);
    for (what, asked) in ["explain robot", "explain task", "cordon, uncordon"].iter().zip(&rounds.asked_ms) {
        for (share, of) in [(0.5, "p50"), (0.99, "p99"), (1.0, "max")] {
            let values: Vec<f64> = asked.iter().map(|round| percentile(round, share)).collect();
            let name = name(&format!("{robots} robots, {live} tasks, {what}, {of}"));
            figures.push(Figure::new("P6", name, "ms", &values, raw));
        }
    }
    figures
}

async fn rounds(args: &OldArgs, engine: &Engine, ended: u64, say: &dyn Fn(&str)) -> anyhow::Result<Rounds> {
    let bed = engine.bed(args.engine.dir.as_ref())?;
    let map = grid_map::write(bed.path(), SIDE)?;
    let site = grid::parse_map("bench", &std::fs::read_to_string(&map)?)?;
    let loaded = midshift_cli::site_file::load(Some(&map), None, None)?;
    if ended > 0 {
        let begun = Instant::now();
        let database = Database { store: bed.url().map(str::to_owned) };
        let old = OldSite::with_ended(ended, wall());
        old_tables::make(&old, &database, &data(&bed, 0), loaded.site.site_id()).await?;
        say(&format!("{ended} ended tasks{} written in {:.1} s", engine.suffix(), begun.elapsed().as_secs_f64()));
    }
    let mut rounds = Rounds::default();
    for round in 0..args.rounds {
        let (server, ready_ms) = started(&bed, &map, 0).await?;
        rounds.ready_ms.push(ready_ms);
        rounds.offer_ms.push(first_offer_ms(&server, &site, &format!("first-{round}")).await?);
        rounds.rss_mib.push(server.rss_kib()? / 1_024.0);
        rounds.raw_ms.extend(bed_raw_ms(&bed, round).await?);
        for (rounds, asked) in rounds.asked_ms.iter_mut().zip(measure_answers(args, &server, &site, round).await?) {
            rounds.push(asked);
        }
        match bed.url() {
            Some(_) => rounds.takeover_ms.push(takeover_ms(&bed, &map, &site, server, round).await?),
            None => server.end()?,
        }
    }
    Ok(rounds)
}

/// The directory of one of the servers here.
fn data(bed: &Bed<'_>, nth: usize) -> PathBuf {
    bed.path().join(if nth == 0 { "data".to_owned() } else { format!("data-{nth}") })
}

async fn started(bed: &Bed<'_>, map: &Path, nth: usize) -> anyhow::Result<(Child, f64)> {
    let begun = Instant::now();
    let server = Child::serve(&data(bed, nth), Some(map), bed.url(), None).await?;
    Ok((server, begun.elapsed().as_secs_f64() * 1e3))
}

/// From a new robot that comes to its first offer, milliseconds.
async fn first_offer_ms(server: &Child, site: &Site, name: &str) -> anyhow::Result<f64> {
    let begun = Instant::now();
    let here = site.waypoints().first().context("an empty site")?.waypoint_id.clone();
    let mut robot = Idle::attach(&server.address.to_string(), name, here).await?;
    let mut client = TaskServiceClient::new(server.channel().await?);
    let request = transports(site, 1)?.remove(0);
    let before_ms = begun.elapsed().as_secs_f64() * 1e3;
    let (offer_ms, _) =
        one(&mut client, &mut robot, SubmitTaskRequest { request_id: name.to_owned(), ..request }).await?;
    Ok(before_ms + offer_ms)
}

/// The raw limit beside it. PostgreSQL keeps its table from the first round.
async fn bed_raw_ms(bed: &Bed<'_>, round: usize) -> anyhow::Result<Vec<f64>> {
    const APPENDS: usize = 50;
    if round > 0 {
        return Ok(Vec::new());
    }
    bed.baseline().await?.several_ms(APPENDS).await
}

/// Ends the server that plans as if its power went, beside one that stands by: until that one gives its first offer.
async fn takeover_ms(bed: &Bed<'_>, map: &Path, site: &Site, plans: Child, round: usize) -> anyhow::Result<f64> {
    let (stands_by, _) = started(bed, map, 1).await?;
    let begun = Instant::now();
    drop(plans);
    first_offer_ms(&stands_by, site, &format!("next-{round}")).await?;
    let took_ms = begun.elapsed().as_secs_f64() * 1e3;
    stands_by.end()?;
    Ok(took_ms)
}

/// Milliseconds of explanations of a robot and of a task, and of commands, asked one at a time while robots are given work.
async fn measure_answers(args: &OldArgs, server: &Child, site: &Site, round: usize) -> anyhow::Result<[Vec<f64>; 3]> {
    let address = server.address.to_string();
    let mut robots = JoinSet::new();
    for number in 0..args.robots {
        let here = site.waypoints()[number * 7 % site.waypoints().len()].waypoint_id.clone();
        let robot = Idle::attach(&address, &format!("rbt-{round}-{number}"), here).await?;
        robots.spawn(robot.work());
    }
    let mut tasks = TaskServiceClient::new(server.channel().await?);
    let requests: Vec<SubmitTasksRequest> = transports(site, args.live)?
        .into_iter()
        .enumerate()
        .map(|(n, item)| SubmitTaskRequest { request_id: format!("live-{round}-{n}"), ..item })
        .map(|item| SubmitTasksRequest { item: Some(item) })
        .collect();
    let mut last = String::new();
    for batch in requests.chunks(BATCH) {
        let answer = tasks.submit_tasks(tokio_stream::iter(batch.to_vec())).await?.into_inner();
        if let Some(Outcome::TaskId(id)) = answer.results.into_iter().next_back().and_then(|result| result.outcome) {
            last = id;
        }
    }
    ensure!(!last.is_empty(), "no task was admitted");
    let mut fleet = FleetServiceClient::new(server.channel().await?);
    let robot_id = format!("rbt-{round}-0");
    let mut took_ms: [Vec<f64>; 3] = Default::default();
    for n in 0..args.asks {
        let begun = Instant::now();
        fleet.explain_robot(ExplainRobotRequest { robot_id: robot_id.clone() }).await?;
        took_ms[0].push(begun.elapsed().as_secs_f64() * 1e3);
        let begun = Instant::now();
        fleet.explain_task(ExplainTaskRequest { task_id: last.clone() }).await?;
        took_ms[1].push(begun.elapsed().as_secs_f64() * 1e3);
        let begun = Instant::now();
        let robot_id = robot_id.clone();
        if n % 2 == 0 {
            let reason = "asked by a measurement".to_owned();
            fleet.cordon_robot(CordonRobotRequest { robot_id, reason, ..CordonRobotRequest::default() }).await?;
        } else {
            fleet.uncordon_robot(UncordonRobotRequest { robot_id, ..UncordonRobotRequest::default() }).await?;
        }
        took_ms[2].push(begun.elapsed().as_secs_f64() * 1e3);
    }
    cancel_all(&mut tasks).await?;
    Ok(took_ms)
}

/// Takes back what is left, so that the next robot is offered what is submitted for it.
async fn cancel_all(tasks: &mut TaskServiceClient<Channel>) -> anyhow::Result<()> {
    let mut page_token = String::new();
    loop {
        let reason = "the measurement is over".to_owned();
        let request =
            CancelTasksRequest { reason, force: true, all: true, page_token, ..CancelTasksRequest::default() };
        page_token = tasks.cancel_tasks(request).await?.into_inner().outcome.context("no outcome")?.next_page_token;
        if page_token.is_empty() {
            return Ok(());
        }
    }
}
