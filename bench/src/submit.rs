//! P5: what one durable SubmitTask costs the server and how long it takes, beside a bare tonic call of the same messages and the disk.

use crate::child::Child;
use crate::figure::{Figure, percentile};
use crate::fsync::Disk;
use anyhow::Context;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{SubmitTaskRequest, SubmitTaskResponse};
use midshift_sim::workload::{Workload, WorkloadConfig};
use prost::Message;
use std::path::PathBuf;
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
    /// Rounds of each: midshift, bare tonic, disk.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Appends to the disk of one round, half of them before midshift and half after.
    #[arg(long, default_value_t = 300)]
    fsyncs: usize,
    /// Where the databases are made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    dir: Option<PathBuf>,
}

/// A directory for one round, below `dir` or the temporary one.
pub fn place(dir: Option<&PathBuf>) -> anyhow::Result<tempfile::TempDir> {
    let made = dir.map_or_else(tempfile::tempdir, tempfile::tempdir_in);
    made.context("making a directory for the databases")
}

/// Transports of the demo site.
pub fn transports(site: &Site, count: usize) -> anyhow::Result<Vec<SubmitTaskRequest>> {
    let mut workload = Workload::new(WorkloadConfig::background(1), site).context("the site has no two stations")?;
    Ok((0..count).map(|_| midshift::background::request(&workload.next_transport())).collect())
}

/// What one load on one server came to.
struct Load {
    cpu_us: f64,
    per_s: f64,
    p50_ms: f64,
    p99_ms: f64,
}

/// Runs rounds of midshift, bare tonic and disk, in turn.
pub async fn run(args: SubmitArgs) -> anyhow::Result<Vec<Figure>> {
    let requests = Arc::new(transports(&text::parse(DEMO)?, TRANSPORTS)?);
    let (mut ours, mut bare, mut syncs) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..args.rounds {
        let dir = place(args.dir.as_ref())?;
        let server = Child::serve(&dir.path().join("data"), None, None).await?;
        let answer = one(server.channel().await?, &requests, round).await?;
        let mut disk = Disk::beside(dir.path())?;
        let mut sync_ms = disk.appends_ms(args.fsyncs / 2)?;
        ours.push(load(&server, &requests, args.requests, args.in_flight).await?);
        sync_ms.extend(disk.appends_ms(args.fsyncs / 2)?);
        syncs.push(sync_ms);
        drop(server);
        let path = dir.path().join("answer");
        std::fs::write(&path, answer.encode_to_vec())?;
        let path = path.to_str().context("a path that is no text")?;
        let server = Child::start(&["unary", "--answer", path], None)?.listening().await?;
        bare.push(load(&server, &requests, args.requests * BARE_TIMES, args.in_flight).await?);
    }
    let sync = |share: f64| syncs.iter().map(|s| percentile(s, share)).collect::<Vec<_>>();
    let (sync_p50, sync_p99) = (sync(0.5), sync(0.99));
    let of = |loads: &[Load], what: fn(&Load) -> f64| loads.iter().map(what).collect::<Vec<_>>();
    let beside_bare = |name: &str, unit, what: fn(&Load) -> f64| {
        let name = format!("durable SubmitTask, {} in flight, {name}", args.in_flight);
        Figure::of("P5", name, unit, &of(&ours, what), Some(("bare tonic unary, same messages", &of(&bare, what))))
    };
    let beside_disk = |name: &str, what: fn(&Load) -> f64, limit: &str, syncs: &[f64]| {
        let name = format!("durable SubmitTask, {} in flight, {name}", args.in_flight);
        Figure::of("P5", name, "ms", &of(&ours, what), Some((limit, syncs)))
    };
    Ok(vec![
        beside_bare("server CPU each", "us", |l| l.cpu_us),
        beside_bare("per server CPU-second", "1/CPU-s", |l| 1e6 / l.cpu_us),
        beside_bare("rate", "1/s", |l| l.per_s),
        beside_bare("p50", "ms", |l| l.p50_ms),
        beside_bare("p99", "ms", |l| l.p99_ms),
        beside_disk("p50, by the disk", |l| l.p50_ms, "fdatasync of 4 KiB, p50", &sync_p50),
        beside_disk("p99, by the disk", |l| l.p99_ms, "fdatasync of 4 KiB, p99", &sync_p99),
    ])
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
    calls(&client, requests, "warm", count / 10 + 1, in_flight).await?;
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
