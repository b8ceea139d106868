//! What watches that nobody reads cost: memory of the server with thousands of them on the robots of a site, beside its memory without; and what of it is
//! given back when they have ended.

use crate::child::{Child, SESSIONS};
use crate::engine::{Engine, EngineArgs};
use crate::figure::Figure;
use crate::grid_map;
use anyhow::{Context, ensure};
use midshift_core::limits;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{WatchRobotsRequest, WatchRobotsResponse};
use std::time::Duration;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};
use tonic::Streaming;
use tonic::transport::{Channel, Endpoint};

/// Robots are attached by then.
const ATTACH_WITHIN: Duration = Duration::from_secs(60);
/// Between two looks at the memory.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Before the first look: what a server does once is done.
const SETTLE: Duration = Duration::from_secs(5);

/// Watches that were not read are read to their end by then.
const ENDS_WITHIN: Duration = Duration::from_secs(20);
/// Bytes that a client takes unread, of a watch and of a connection: HTTP/2's own default, RFC 9113 section 6.9.2.
const WINDOW: u32 = 65_535;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct WatchArgs {
    /// Robots that are watched.
    #[arg(long, default_value_t = 200)]
    robots: usize,
    /// Watches of all of them.
    #[arg(long, default_value_t = limits::WATCHES_MAX)]
    watches: usize,
    /// Rounds, each of a new server.
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Memory of a server, KiB.
#[derive(Default)]
struct Memory {
    without: Vec<f64>,
    most: Vec<f64>,
    after: Vec<f64>,
}

/// Runs rounds on each engine.
pub async fn run(args: WatchArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    for engine in args.engine.engines(say) {
        let mut memory = Memory::default();
        for _ in 0..args.rounds {
            round(&args, &engine, &mut memory).await?;
        }
        let what = |what: &str| {
            let (watches, robots) = (args.watches, args.robots);
            format!("{watches} unread watches of {robots} robots: {what}{}", engine.suffix())
        };
        let without: Option<(&str, &[f64])> = Some(("without them", &memory.without));
        let more: Vec<f64> = memory.most.iter().zip(&memory.without).map(|(most, without)| most - without).collect();
        figures.push(Figure::new("watch", what("memory of the server, at most"), "KiB", &memory.most, without));
        figures.push(Figure::new("watch", what("of it more than before"), "KiB", &more, without));
        figures.push(Figure::new("watch", what("memory when they have ended"), "KiB", &memory.after, without));
    }
    Ok(figures)
}

async fn round(args: &WatchArgs, engine: &Engine, memory: &mut Memory) -> anyhow::Result<()> {
    let bed = engine.bed(args.engine.dir.as_ref())?;
    let map = grid_map::write(bed.path(), (args.robots as f64).sqrt() as usize + 2)?;
    let mut server = bed.serve(Some(&map), None).await?;
    let (address, robots) = (server.address.to_string(), args.robots.to_string());
    let map = map.to_str().context("a path that is no text")?;
    let role = ["robots", "--server", &address, "--site", map, "--robots", &robots, "--from", "0", "--to", &robots];
    let _robots = Child::start(&role, None)?;
    let end = Instant::now() + ATTACH_WITHIN;
    while (server.ask(SESSIONS)? as usize) < args.robots {
        ensure!(Instant::now() < end, "{} of {robots} robots are attached", server.ask(SESSIONS)?);
        sleep(LOOK_EVERY).await;
    }
    sleep(SETTLE).await;
    memory.without.push(server.rss_kib()?);
    let watches = open(&server, args.watches).await?;
    let end = Instant::now() + Duration::from_millis(limits::WATCH_UNREAD.as_ms());
    let mut most_kib = 0.0_f64;
    while Instant::now() < end {
        most_kib = most_kib.max(server.rss_kib()?);
        sleep(LOOK_EVERY).await;
    }
    memory.most.push(most_kib);
    sleep(SETTLE * 4).await;
    memory.after.push(server.rss_kib()?);
    // All at once: what one has not read takes the room of the others of its connection.
    let mut reading: JoinSet<()> = watches.into_iter().map(ends).collect();
    let all = async { while reading.join_next().await.is_some() {} };
    timeout(ENDS_WITHIN, all).await.context("a watch that nobody read goes on")?;
    server.end()
}

/// Reads a watch to its end.
async fn ends(mut watch: Streaming<WatchRobotsResponse>) {
    while watch.message().await.is_ok_and(|message| message.is_some()) {}
}

/// Opens so many watches, as many on a connection as one takes; none of them is read.
async fn open(server: &Child, watches: usize) -> anyhow::Result<Vec<Streaming<WatchRobotsResponse>>> {
    let mut open: Vec<Streaming<WatchRobotsResponse>> = Vec::new();
    let mut client: Option<TelemetryServiceClient<Channel>> = None;
    for nth in 0..watches {
        if nth % limits::STREAMS_PER_CONNECTION as usize == 0 {
            let endpoint = Endpoint::from_shared(format!("http://{}", server.address))?;
            let endpoint = endpoint.initial_stream_window_size(WINDOW).initial_connection_window_size(WINDOW);
            client = Some(TelemetryServiceClient::new(endpoint.connect().await?));
        }
        let client = client.as_mut().context("no connection")?;
        open.push(client.watch_robots(WatchRobotsRequest::default()).await?.into_inner());
    }
    Ok(open)
}
