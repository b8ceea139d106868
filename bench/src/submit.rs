//! P5: what one durable SubmitTask costs the server and how long it takes, beside a bare tonic call of the same
//! messages and the raw limits of the engine that keeps it.

use crate::child::Child;
use crate::engine::{Bed, Engine, EngineArgs};
use crate::figure::{Figure, percentile};
use crate::fsync::place;
use anyhow::Context;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{SubmitTaskRequest, SubmitTaskResponse};
use midshift_sim::workload::{Workload, WorkloadConfig};
use prost::Message;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tonic::transport::Channel;

/// The bare service is asked so many times as often: its CPU is counted in whole clock ticks too.
const BARE_TIMES: usize = 4;
/// Different transports that are submitted over and over.
const TRANSPORTS: usize = 1_000;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct SubmitArgs {
    /// Durable submits of one round; a tenth more come first to warm up.
    #[arg(long, default_value_t = 20_000)]
    requests: usize,
    /// Calls under way at once, on one connection.
    #[arg(long, default_value_t = 50)]
    in_flight: usize,
    /// Rounds of each: midshift on each engine with its raw limits, bare tonic.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Appends to the disk, or single commits, of one round, half of them before midshift and half after.
    #[arg(long, default_value_t = 300)]
    fsyncs: usize,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Transports of the demo site.
pub fn transports(site: &Site, count: usize) -> anyhow::Result<Vec<SubmitTaskRequest>> {
    let mut workload = Workload::new(WorkloadConfig::background(1), site).context("the site has no two stations")?;
    Ok((0..count).map(|_| midshift_cli::task_list::request(&workload.next_transport())).collect())
}

/// What one load on one server came to.
struct Load {
    cpu_us: f64,
    per_s: f64,
    p50_ms: f64,
    p99_ms: f64,
}

/// One round of midshift on one engine.
struct Round {
    load: Load,
    /// Milliseconds of the raw limit, before and after.
    raw_ms: Vec<f64>,
    /// CPU of the database's own processes for each call, microseconds, if it has any.
    database_us: Option<f64>,
    /// Rows of the same size a second by COPY, if the engine has it.
    copied_per_s: Option<f64>,
}

/// Runs rounds of midshift on each engine, its raw limits, and bare tonic, in turn.
pub async fn run(args: SubmitArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let requests = Arc::new(transports(&text::parse(DEMO)?, TRANSPORTS)?);
    let engines = args.engine.engines(say);
    let (mut ours, mut bare): (Vec<Vec<Round>>, _) = (engines.iter().map(|_| Vec::new()).collect(), Vec::new());
    for number in 0..args.rounds {
        let mut answer = None;
        for (engine, rounds) in engines.iter().zip(&mut ours) {
            let bed = engine.bed(args.engine.dir.as_ref())?;
            let server = bed.serve(None, None).await?;
            let first = one(server.channel().await?, &requests, number).await?.encode_to_vec();
            rounds.push(round(&args, engine, &bed, &server, &requests, first.len()).await?);
            answer = Some(first);
        }
        let dir = place(args.engine.dir.as_ref())?;
        let path = dir.path().join("answer");
        std::fs::write(&path, answer.context("no engine")?)?;
        let path = path.to_str().context("a path that is no text")?;
        let server = Child::start(&["unary", "--answer", path], None)?.listening().await?;
        bare.push(load(&server, &requests, args.requests * BARE_TIMES, args.in_flight).await?);
    }
    Ok(engines.iter().zip(&ours).flat_map(|(engine, rounds)| figures(args.in_flight, engine, rounds, &bare)).collect())
}

async fn round(
    args: &SubmitArgs,
    engine: &Engine,
    bed: &Bed<'_>,
    server: &Child,
    requests: &Arc<Vec<SubmitTaskRequest>>,
    bytes: usize,
) -> anyhow::Result<Round> {
    let mut baseline = bed.baseline().await?;
    let mut raw_ms = baseline.several_ms(args.fsyncs / 2).await?;
    let before_s = engine.cpu_s()?;
    let load = load(server, requests, args.requests, args.in_flight).await?;
    let calls = (args.requests + warm(args.requests)) as f64;
    let database_us = engine.cpu_s()?.zip(before_s).map(|(after_s, before_s)| (after_s - before_s) * 1e6 / calls);
    raw_ms.extend(baseline.several_ms(args.fsyncs / 2).await?);
    let copied_per_s = bed.copied_per_s(args.requests, bytes, args.in_flight).await?;
    Ok(Round { load, raw_ms, database_us, copied_per_s })
}

fn figures(in_flight: usize, engine: &Engine, ours: &[Round], bare: &[Load]) -> Vec<Figure> {
    let name = |name: &str| format!("durable SubmitTask, {in_flight} in flight, {name}{}", engine.suffix());
    let each = |what: fn(&Load) -> f64| ours.iter().map(|round| what(&round.load)).collect::<Vec<_>>();
    let beside_bare = |what: &str, unit, of: fn(&Load) -> f64| {
        let limit: Vec<f64> = bare.iter().map(of).collect();
        Figure::new("P5", name(what), unit, &each(of), Some(("bare tonic unary, same messages", &limit)))
    };
    let beside_raw = |what: &str, share: f64, of: fn(&Load) -> f64| {
        let limit: Vec<f64> = ours.iter().map(|round| percentile(&round.raw_ms, share)).collect();
        let told = format!("{}, {what}", engine.limit());
        Figure::new("P5", name(&format!("{what}, by the raw limit")), "ms", &each(of), Some((&told, &limit)))
    };
    let mut figures = vec![
        beside_bare("server CPU each", "us", |l| l.cpu_us),
        beside_bare("per server CPU-second", "1/CPU-s", |l| 1e6 / l.cpu_us),
        beside_bare("rate", "1/s", |l| l.per_s),
        beside_bare("p50", "ms", |l| l.p50_ms),
        beside_bare("p99", "ms", |l| l.p99_ms),
        beside_raw("p50", 0.5, |l| l.p50_ms),
        beside_raw("p99", 0.99, |l| l.p99_ms),
    ];
    let copied: Vec<f64> = ours.iter().filter_map(|round| round.copied_per_s).collect();
    if !copied.is_empty() {
        let told = format!("COPY of rows of that size, {in_flight} a commit");
        figures.push(Figure::new("P5", name("rate, by COPY"), "1/s", &each(|l| l.per_s), Some((&told, &copied))));
    }
    let database_us: Vec<f64> = ours.iter().filter_map(|round| round.database_us).collect();
    if !database_us.is_empty() {
        let limit = ("midshift's own", each(|l| l.cpu_us));
        figures.push(Figure::new(
            "P5",
            name("CPU of the database each"),
            "us",
            &database_us,
            Some((limit.0, &limit.1)),
        ));
    }
    figures
}

/// How many calls come first.
fn warm(requests: usize) -> usize {
    requests / 10 + 1
}

/// One call by itself, for the size of its answer.
async fn one(channel: Channel, requests: &[SubmitTaskRequest], round: usize) -> anyhow::Result<SubmitTaskResponse> {
    let request = SubmitTaskRequest { request_id: format!("bench-first-{round}"), ..requests[0].clone() };
    Ok(TaskServiceClient::new(channel).submit_task(request).await?.into_inner())
}

async fn load(
    server: &Child,
    requests: &Arc<Vec<SubmitTaskRequest>>,
    count: usize,
    in_flight: usize,
) -> anyhow::Result<Load> {
    let client = TaskServiceClient::new(server.channel().await?);
    calls(&client, requests, "warm", warm(count), in_flight).await?;
    let (cpu_s, begun) = (server.cpu_s()?, Instant::now());
    let took_ms = calls(&client, requests, "bench", count, in_flight).await?;
    let (wall_s, cpu_s) = (begun.elapsed().as_secs_f64(), server.cpu_since_s(cpu_s)?);
    Ok(Load {
        cpu_us: cpu_s * 1e6 / count as f64,
        per_s: count as f64 / wall_s,
        p50_ms: percentile(&took_ms, 0.5),
        p99_ms: percentile(&took_ms, 0.99),
    })
}

/// Makes `count` calls, each with a request id of its own, so many at once; milliseconds of each.
async fn calls(
    client: &TaskServiceClient<Channel>,
    requests: &Arc<Vec<SubmitTaskRequest>>,
    name: &'static str,
    count: usize,
    in_flight: usize,
) -> anyhow::Result<Vec<f64>> {
    let next = Arc::new(AtomicUsize::new(0));
    let mut callers = JoinSet::new();
    for _ in 0..in_flight.max(1) {
        let (mut client, requests, next) = (client.clone(), requests.clone(), next.clone());
        callers.spawn(async move {
            let mut took_ms = Vec::new();
            loop {
                let number = next.fetch_add(1, Relaxed);
                if number >= count {
                    return anyhow::Ok(took_ms);
                }
                let mut request = requests[number % requests.len()].clone();
                request.request_id = format!("{name}-{number:08}");
                let begun = Instant::now();
                client.submit_task(request).await?;
                took_ms.push(begun.elapsed().as_secs_f64() * 1e3);
            }
        });
    }
    let mut took_ms = Vec::with_capacity(count);
    while let Some(caller) = callers.join_next().await {
        took_ms.extend(caller??);
    }
    Ok(took_ms)
}
