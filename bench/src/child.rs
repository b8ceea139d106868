//! Children: this same program started again in one role, so that a server's CPU and memory are its own, and the kernel can say them.
//!
//! Invariant: a child lives no longer than its parent: it ends when its stdin does. Called by every measurement.

use crate::ota::parts::insecure_server;
use crate::questions::answer_questions;
use crate::sink::Seen;
use anyhow::{Context, bail, ensure};
use midshift::robots::{IdentityFlags, SimRun, StopFlags};
use midshift::serve::Serve;
use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// A server that does not listen by then is not coming.
const UP_WITHIN: Duration = Duration::from_secs(30);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Sessions a server has now.
pub const SESSIONS: &str = "midshift_telemetry_sessions";
/// Messages with a heartbeat that a server has taken.
pub const MESSAGES: &str = "midshift_telemetry_heartbeats_total";

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
    /// Real agents with simulated bodies that take software.
    Swarm(crate::ota::swarm::SwarmArgs),
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
    midshift::logs::start(midshift::logs::Format::Text, "error");
    if let Some(core) = args.core {
        take_core(core)?;
    }
    files_max()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let stop = CancellationToken::new();
    let ended = runtime.block_on(role(args.role, stop));
    runtime.shutdown_background();
    ended
}

async fn role(role: Role, stop: CancellationToken) -> anyhow::Result<()> {
    let address = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    match role {
        Role::Serve { data, site, listen, store, ota_keys } => {
            let listen = listen.unwrap_or(address);
            answer_questions(listen, stop.clone(), metric)?;
            let database = midshift::storage::Database { store };
            let serve = Serve { site, database, ..insecure_server(data, listen, ota_keys, 1) };
            midshift::serve::run(serve, stop, &|_| ()).await
        }
        Role::Unary { answer } => {
            answer_questions(address, stop.clone(), |_| 0)?;
            crate::bare::unary(&answer, address, stop).await
        }
        Role::Sink { answers } => {
            let seen = Arc::new(Seen::default());
            let counted = seen.clone();
            let count = move |name: &str| match name {
                SESSIONS => counted.sessions.load(Relaxed),
                _ => counted.messages.load(Relaxed),
            };
            answer_questions(address, stop.clone(), count)?;
            crate::sink::serve(seen, answers, address, stop).await
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
                identity: IdentityFlags::default(),
                replace: false,
                stop: StopFlags::default(),
            };
            midshift::robots::swarm(swarm, None, stop).await
        }
        Role::Hearers(args) => {
            let heard = Arc::new(crate::ota::hearers::Heard::of(args.robots));
            let asked = heard.clone();
            answer_questions(address, stop.clone(), move |question| asked.answer(question))?;
            crate::ota::hearers::run(args, heard, stop).await
        }
        Role::Swarm(args) => {
            answer_questions(address, stop.clone(), |_| 0)?;
            crate::ota::swarm::run(args, stop).await
        }
        Role::Flood { server, robots, unacknowledged } => {
            let acked = Arc::new(AtomicU64::new(0));
            let counted = acked.clone();
            answer_questions(address, stop.clone(), move |_| counted.load(Relaxed))?;
            tokio::select! {
                flooded = crate::flood::run(&server, robots, !unacknowledged, acked) => flooded,
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
    let text = midshift::recorder::handle().map(|m| m.render()).unwrap_or_default();
    let lines = text.lines().filter(|l| l.starts_with(name));
    lines.filter_map(|l| l.rsplit(' ').next()?.parse::<f64>().ok()).sum::<f64>() as u64
}

/// Raises this process' limit of open files as far as it may go, and says how far that is.
pub fn files_max() -> anyhow::Result<u64> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let limit = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, maximum: limit.maximum })
        .context("raising RLIMIT_NOFILE")?;
    Ok(limit.maximum.unwrap_or(u64::MAX))
}

/// What the kernel counts CPU in, seconds.
fn tick_s() -> f64 {
    1.0 / rustix::param::clock_ticks_per_second() as f64
}

/// CPU spent so far by all threads of a process, seconds, in whole clock ticks.
pub fn cpu_of_s(pid: u32) -> anyhow::Result<f64> {
    // Its utime and stime.
    ticks_s(pid, 14)
}

/// CPU that those children of a process spent which have ended, with their own, seconds, in whole clock ticks.
pub fn cpu_of_ended_s(pid: u32) -> anyhow::Result<f64> {
    // Its cutime and cstime.
    ticks_s(pid, 16)
}

/// Sum of two fields of clock ticks in /proc/PID/stat, counted from 1, seconds.
fn ticks_s(pid: u32, first: usize) -> anyhow::Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat"))?;
    // The name of the program, field 2, stands in brackets and may hold anything.
    let (_, fields) = stat.rsplit_once(')').context("/proc/PID/stat without a name")?;
    let ticks = fields.split_whitespace().skip(first - 3).take(2);
    let ticks: Vec<u64> = ticks.map(str::parse).collect::<Result<_, _>>().context("/proc/PID/stat without ticks")?;
    Ok(ticks.iter().sum::<u64>() as f64 * tick_s())
}

/// A child from its parent's side. Killed when it is let go.
pub struct Child {
    process: std::process::Child,
    stdout: BufReader<std::process::ChildStdout>,
    /// Where it listens, if it does.
    pub address: SocketAddr,
}

impl Child {
    /// Starts this program in a role, on one core or on all.
    pub fn start(role: &[&str], core: Option<usize>) -> anyhow::Result<Self> {
        Self::start_in(&[], role, core)
    }
    /// As [`Child::start`], by a command that becomes this program somewhere else.
    pub fn start_in(entry: &[&str], role: &[&str], core: Option<usize>) -> anyhow::Result<Self> {
        let this = std::env::current_exe()?;
        let mut command = match entry.split_first() {
            None => Command::new(this),
            Some((first, rest)) => {
                let mut command = Command::new(first);
                command.args(rest).arg(this);
                command
            }
        };
        command.arg("child");
        if let Some(core) = core {
            command.args(["--core", &core.to_string()]);
        }
        let mut process = command.args(role).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let stdout = process.stdout.take().context("a child without a stdout")?;
        let mut child =
            Self { process, stdout: BufReader::new(stdout), address: SocketAddr::from(([127, 0, 0, 1], 0)) };
        child.address = child.line()?.parse().context("a child that did not say its address")?;
        Ok(child)
    }
    /// A server of midshift on a data directory, with its rows there or in a `store`, once it listens.
    pub async fn serve(
        data: &Path,
        site: Option<&Path>,
        store: Option<&str>,
        core: Option<usize>,
    ) -> anyhow::Result<Self> {
        let data = data.to_str().context("a path that is no text")?;
        let mut role = vec!["serve", "--data", data];
        if let Some(site) = site {
            role.extend(["--site", site.to_str().context("a path that is no text")?]);
        }
        role.extend(store.iter().flat_map(|url| ["--store", url]));
        Self::start(&role, core)?.listening().await
    }
    /// Waits until it takes connections.
    pub async fn listening(mut self) -> anyhow::Result<Self> {
        let end = Instant::now() + UP_WITHIN;
        while TcpStream::connect(self.address).await.is_err() {
            if let Some(status) = self.process.try_wait()? {
                bail!("a child ended before it listened: {status}");
            }
            ensure!(Instant::now() < end, "a child does not listen");
            tokio::time::sleep(LOOK_EVERY).await;
        }
        Ok(self)
    }
    /// What a counter of the child stands at.
    pub fn ask(&mut self, counter: &str) -> anyhow::Result<u64> {
        let stdin = self.process.stdin.as_mut().context("a child without a stdin")?;
        writeln!(stdin, "{counter}").context("asking a child")?;
        Ok(self.line()?.parse()?)
    }
    fn line(&mut self) -> anyhow::Result<String> {
        let mut line = String::new();
        ensure!(self.stdout.read_line(&mut line)? > 0, "a child ended");
        Ok(line.trim().to_owned())
    }
    /// A channel of its own connection.
    pub async fn channel(&self) -> anyhow::Result<tonic::transport::Channel> {
        let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{}", self.address))?;
        Ok(endpoint.tcp_nodelay(true).connect().await?)
    }
    /// Its number.
    pub fn pid(&self) -> u32 {
        self.process.id()
    }
    /// CPU spent so far by all its threads, seconds, in whole clock ticks.
    pub fn cpu_s(&self) -> anyhow::Result<f64> {
        cpu_of_s(self.pid())
    }
    /// CPU spent since then, seconds; less than a clock tick counts as one.
    pub fn cpu_since_s(&self, then_s: f64) -> anyhow::Result<f64> {
        Ok((self.cpu_s()? - then_s).max(tick_s()))
    }

    /// Lets it end as one that is asked to.
    pub fn end(mut self) -> anyhow::Result<()> {
        drop(self.process.stdin.take());
        let status = self.process.wait()?;
        ensure!(status.success(), "a child did not end well: {status}");
        Ok(())
    }

    /// Memory in RAM, KiB.
    pub fn rss_kib(&self) -> anyhow::Result<f64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id()))?;
        let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:")).context("no VmRSS")?;
        Ok(line.trim().trim_end_matches(" kB").trim().parse()?)
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
