//! What this program does as a child: one role, until its stdin ends. Called by `main`.

use crate::child::{SESSIONS, raise_files_max};
use crate::ota::parts::insecure_server;
use crate::questions::answer_questions;
use crate::session_baseline::Seen;
use anyhow::Context;
use midshift::robots::{IdentityFlags, SimRun, StopFlags};
use midshift_core::site::{DEMO, text};
use midshift_server::serve::Serve;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use tokio_util::sync::CancellationToken;

/// What a child is.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Role {
    /// `midshift serve` on a data directory.
    Serve {
        /// The data directory.
        #[arg(long)]
        data: PathBuf,
        /// The site file; without it the demo site.
        #[arg(long)]
        site: Option<PathBuf>,
        /// Where it listens; without it on a free port.
        #[arg(long)]
        listen: Option<SocketAddr>,
        /// A PostgreSQL database for its rows; without it they are in the data directory.
        #[arg(long)]
        store: Option<String>,
        /// Its online keys; without them it takes no software.
        #[arg(long)]
        ota_keys: Option<PathBuf>,
    },
    /// A bare tonic unary service that answers each SubmitTask with the same bytes.
    Unary {
        /// An encoded SubmitTaskResponse.
        #[arg(long)]
        answer: PathBuf,
    },
    /// A bare tonic session that takes every message and keeps none.
    Sink {
        /// Answers each message, as an echo would.
        #[arg(long)]
        answers: bool,
    },
    /// Real agents with simulated bodies that stand, some of all robots of the site.
    Robots {
        #[arg(long)]
        server: String,
        #[arg(long)]
        site: PathBuf,
        /// Robots of the whole site.
        #[arg(long)]
        robots: usize,
        /// First of this process, from 0.
        #[arg(long)]
        from: usize,
        /// One past the last.
        #[arg(long)]
        to: usize,
    },
    /// Robots that hear what software they should have, and fetch none.
    Hearers(crate::ota::hearers::HearersArgs),
    /// Real agents with simulated bodies, who take software if they know whose.
    Swarm(crate::swarm::SwarmArgs),
    /// Robots that do in no time what they are given, on the demo site.
    Workers {
        #[arg(long)]
        server: String,
        #[arg(long)]
        robots: usize,
    },
    /// Robots that send as fast as they may.
    Flood {
        #[arg(long)]
        server: String,
        #[arg(long)]
        robots: usize,
        /// Nobody acknowledges, so nothing is waited for.
        #[arg(long)]
        unacknowledged: bool,
    },
    /// One of the measurements of software.
    #[command(flatten)]
    Ota(crate::ota::parts::Part),
    /// One of the measurements of stops.
    #[command(flatten)]
    Stop(crate::stop::Part),
    /// One of the measurements of hostile peers.
    #[command(flatten)]
    Edge(crate::edge::Part),
}

/// A child's arguments.
#[derive(Clone, Debug, clap::Args)]
pub struct ChildArgs {
    /// Only on this one of the cores there are: 0 is the first, the others are counted round the rest.
    #[arg(long)]
    core: Option<usize>,
    #[command(subcommand)]
    role: Role,
}

/// Plays a role until stdin ends. On stdout: the address, then one number for each line of stdin that names a counter.
pub fn play(args: ChildArgs) -> anyhow::Result<()> {
    midshift_process::logs::start(midshift_process::logs::Format::Text, "error");
    if let Some(core) = args.core {
        take_core(core)?;
    }
    raise_files_max()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let stop = CancellationToken::new();
    let ended = runtime.block_on(runtime.spawn(role(args.role, stop)));
    runtime.shutdown_background();
    ended?
}

async fn role(role: Role, stop: CancellationToken) -> anyhow::Result<()> {
    let address = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    match role {
        Role::Serve { data, site, listen, store, ota_keys } => {
            let listen = listen.unwrap_or(address);
            answer_questions(listen, stop.clone(), metric)?;
            let database = midshift_server::storage::Database { store };
            let serve = Serve { site, database, ..insecure_server(data, listen, ota_keys, 1) };
            midshift_server::serve::run(serve, stop, &|_| ()).await
        }
        Role::Unary { answer } => {
            answer_questions(address, stop.clone(), |_| 0)?;
            crate::unary_baseline::serve(&answer, address, stop).await
        }
        Role::Sink { answers } => {
            let seen = Arc::new(Seen::default());
            let counted = seen.clone();
            let count = move |name: &str| match name {
                SESSIONS => counted.sessions.load(Relaxed),
                _ => counted.messages.load(Relaxed),
            };
            answer_questions(address, stop.clone(), count)?;
            crate::session_baseline::serve(seen, answers, address, stop).await
        }
        Role::Robots { server, site, robots, from, to } => {
            answer_questions(address, stop.clone(), |_| 0)?;
            let swarm = SimRun {
                robots,
                only: Some((from, to)),
                server,
                site: Some(site),
                seed: 1,
                prefix: "rbt-".to_owned(),
                crowded: false,
                data: None,
                no_faults: true,
                listen: None,
                trust: None,
                replace: false,
                identity: IdentityFlags::default(),
                stop: StopFlags::default(),
            };
            midshift::robots::swarm(swarm, None, stop).await
        }
        Role::Hearers(args) => {
            let heard = Arc::new(crate::ota::hearers::Heard::new(args.robots));
            let asked = heard.clone();
            answer_questions(address, stop.clone(), move |question| asked.answer(question))?;
            crate::ota::hearers::run(args, heard, stop).await
        }
        Role::Swarm(args) => {
            answer_questions(address, stop.clone(), |_| 0)?;
            crate::swarm::run(args, stop).await
        }
        Role::Workers { server, robots } => {
            answer_questions(address, stop.clone(), |_| 0)?;
            crate::worker::run(server, text::parse(DEMO)?, robots, stop).await
        }
        Role::Flood { server, robots, unacknowledged } => {
            let acked = Arc::new(AtomicU64::new(0));
            let counted = acked.clone();
            answer_questions(address, stop.clone(), move |_| counted.load(Relaxed))?;
            tokio::select! {
                flooded = crate::saturation::run(&server, robots, !unacknowledged, acked) => flooded,
                () = stop.cancelled() => Ok(()),
            }
        }
        Role::Ota(part) => crate::ota::parts::play(part, address, stop).await,
        Role::Stop(part) => crate::stop::play(part, address, stop).await,
        Role::Edge(part) => crate::edge::play(part, address, stop).await,
    }
}

/// Keeps this process on one of the cores it may use: number 0 on the first alone, the others share the rest.
fn take_core(number: usize) -> anyhow::Result<()> {
    use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
    let may = sched_getaffinity(None).context("asking for the cores")?;
    let cores: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|core| may.is_set(*core)).collect();
    let mut mine = CpuSet::new();
    let at = if number == 0 || cores.len() < 2 { 0 } else { 1 + (number - 1) % (cores.len() - 1) };
    mine.set(*cores.get(at).context("no core")?);
    sched_setaffinity(None, &mine).context("taking a core")
}

/// Sum of the lines of a counter in this process' metrics.
fn metric(name: &str) -> u64 {
    let text = midshift_process::recorder::handle().map(|m| m.render()).unwrap_or_default();
    let lines = text.lines().filter(|l| l.starts_with(name));
    lines.filter_map(|l| l.rsplit(' ').next()?.parse::<f64>().ok()).sum::<f64>() as u64
}
