//! What hostile peers cost a client that does no harm: its calls beside idle in the same run, in turn; memory of the server; and what became of the peers.
//!
//! Invariant: the server is a process of its own on the first core, with the door and the limits of every port of midshift; hostile peers are another process, on
//! the other cores, and come from another address. Plain text, so that a peer can break HTTP/2 itself. Called by `main`.

mod hostile;
mod load;

use crate::child::Child;
use crate::figure::{Figure, percentile};
use crate::outcome::{RunOutcome, unless_stopped};
use anyhow::{Context, ensure};
use hostile::{ANSWERED, REFUSED, THERE, TURNED_AWAY};
use load::Load;
use midshift_process::door;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Descriptors of the server that runs out of them.
const FILES: usize = 256;
/// Peers are all there, and all turned away once, by then.
const WITHIN: Duration = Duration::from_secs(60);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct EdgeArgs {
    /// Hostile peers.
    #[arg(long, default_value_t = 1_000)]
    peers: usize,
    /// What they do; more than once: each by itself. Without it all of them.
    #[arg(long, value_enum)]
    load: Vec<Load>,
    /// Turns of each: idle, and with the peers.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=100))]
    rounds: u64,
    /// Calls of a turn.
    #[arg(long, default_value_t = 1_000)]
    calls: u64,
    /// Milliseconds between two calls.
    #[arg(long, default_value_t = 5)]
    gap_ms: u64,
    /// Not used: nothing is written.
    #[arg(long, hide = true)]
    dir: Option<PathBuf>,
}

/// Children of this measurement.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Part {
    /// A port with the limits of midshift's ports, and health behind it.
    EdgeServe {
        /// As many descriptors; without it as many as may be.
        #[arg(long)]
        files: Option<u64>,
    },
    /// Hostile peers.
    Hostile(hostile::HostileArgs),
}

/// Plays a part until `stop`. `address` is one that nobody has.
pub async fn play(part: Part, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    match part {
        Part::EdgeServe { files } => {
            if let Some(files) = files {
                use rustix::process::{Resource, Rlimit, setrlimit};
                let limit = Rlimit { current: Some(files), maximum: Some(files) };
                setrlimit(Resource::Nofile, limit).context("lowering RLIMIT_NOFILE")?;
            }
            crate::questions::answer_questions(address, stop.clone(), |_| 0)?;
            let (_, health) = tonic_health::server::health_reporter();
            // However few descriptors there are: that is what is measured.
            let config = midshift_edge::Config { port: "bench", ..midshift_edge::Config::default() };
            door::serve(config, None, Routes::new(health), TcpListener::bind(address).await?, stop).await
        }
        Part::Hostile(args) => {
            let seen = Arc::new(hostile::Seen::default());
            let asked = seen.clone();
            crate::questions::answer_questions(address, stop.clone(), move |question| asked.answer(question))?;
            hostile::run(args, seen, stop).await
        }
    }
}

/// Runs every load. What cannot be made here is named and takes no other with it; Ctrl-C and SIGTERM end all.
pub async fn run(args: EdgeArgs, say: &dyn Fn(&str)) -> RunOutcome {
    let mut outcome = RunOutcome::default();
    let ended = unless_stopped(all(&args, &mut outcome, say)).await;
    outcome.failed.extend(ended);
    outcome
}

async fn all(args: &EdgeArgs, outcome: &mut RunOutcome, say: &dyn Fn(&str)) {
    let loads = if args.load.is_empty() { Load::ALL.to_vec() } else { args.load.clone() };
    for load in loads {
        let name = format!("{} {}", peers(args, load), load.words());
        say(&name);
        outcome.add(&name, measure(args, load).await.map(|turns| turns.figures(&name)));
    }
}

/// As many as were asked for; to take all descriptors at least twice as many as there are.
fn peers(args: &EdgeArgs, load: Load) -> usize {
    if load == Load::Descriptors { args.peers.max(2 * FILES) } else { args.peers }
}

/// What the client saw in one turn, milliseconds a call.
struct Calls {
    p50_ms: f64,
    p99_ms: f64,
}

/// All turns of one load.
#[derive(Default)]
struct Turns {
    idle: Vec<Calls>,
    loaded: Vec<Calls>,
    /// Memory of the server at the end of idle turns, and while the peers are there, KiB.
    idle_kib: Vec<f64>,
    loaded_kib: Vec<f64>,
    /// Peers, or requests of a flood, and those of them that were turned away.
    there: Vec<f64>,
    turned_away: Vec<f64>,
}

impl Turns {
    fn figures(&self, name: &str) -> Vec<Figure> {
        let of = |value: fn(&Calls) -> f64| -> [Vec<f64>; 2] {
            [&self.loaded, &self.idle].map(|turns| turns.iter().map(value).collect())
        };
        let ([p50, idle_p50], [p99, idle_p99]) = (of(|calls| calls.p50_ms), of(|calls| calls.p99_ms));
        let figure = |what: &str, unit: &'static str, values: &[f64], limit: &str, beside: &[f64]| {
            Figure::new("edge", format!("{name}: {what}"), unit, values, Some((limit, beside)))
        };
        vec![
            figure("a call of somebody else, p50", "ms", &p50, "idle, p50", &idle_p50),
            figure("a call of somebody else, p99", "ms", &p99, "idle, p99", &idle_p99),
            figure("memory of the server", "KiB", &self.loaded_kib, "idle, before and between", &self.idle_kib),
            figure("turned away", "times", &self.turned_away, "peers, or requests", &self.there),
        ]
    }
}

async fn measure(args: &EdgeArgs, load: Load) -> anyhow::Result<Turns> {
    let files = FILES.to_string();
    let role: &[&str] = if load == Load::Descriptors { &["edge-serve", "--files", &files] } else { &["edge-serve"] };
    let server = Child::start(role, Some(0))?.listening().await?;
    let mut client = HealthClient::new(server.channel().await?);
    // What the first calls cost is nobody's figure.
    calls(args, &mut client).await?;
    let mut turns = Turns::default();
    for _ in 0..args.rounds {
        turns.idle.push(calls(args, &mut client).await?);
        turns.idle_kib.push(server.rss_kib()?);
        let (address, count) = (server.address.to_string(), peers(args, load).to_string());
        let role = ["hostile", "--server", &address, "--load", load.flag(), "--peers", &count];
        let mut hostile = Child::start(&role, Some(1))?;
        let end = Instant::now() + WITHIN;
        let wanted = if load == Load::Flood { 1 } else { peers(args, load) as u64 };
        until(&mut hostile, THERE, wanted, end).await?;
        turns.loaded.push(calls(args, &mut client).await?);
        turns.loaded_kib.push(server.rss_kib()?);
        let (there, away) = match load {
            Load::Flood => {
                until(&mut hostile, REFUSED, 1, end).await?;
                let refused = hostile.ask(REFUSED)?;
                (hostile.ask(ANSWERED)? + refused, refused)
            }
            // Also those that were turned away between: each dials again.
            _ => (wanted, until(&mut hostile, TURNED_AWAY, wanted, end).await?),
        };
        turns.there.push(there as f64);
        turns.turned_away.push(away as f64);
    }
    Ok(turns)
}

/// Waits until the answer is at least `least`, and gives it.
async fn until(child: &mut Child, question: &str, least: u64, end: Instant) -> anyhow::Result<u64> {
    loop {
        let count = child.ask(question)?;
        if count >= least {
            return Ok(count);
        }
        ensure!(Instant::now() < end, "{question}: {count} of {least}");
        sleep(LOOK_EVERY).await;
    }
}

/// Calls one after the other.
async fn calls(args: &EdgeArgs, client: &mut HealthClient<Channel>) -> anyhow::Result<Calls> {
    let mut took_ms = Vec::new();
    for _ in 0..args.calls {
        let begun = Instant::now();
        client.check(HealthCheckRequest::default()).await.context("a call of a client that does no harm")?;
        took_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        sleep(Duration::from_millis(args.gap_ms)).await;
    }
    Ok(Calls { p50_ms: percentile(&took_ms, 0.5), p99_ms: percentile(&took_ms, 0.99) })
}
