//! Children: this same program started again in one role, so that a server's CPU and memory are its own, and the kernel can say them.
//!
//! Invariant: a child lives no longer than its parent: it ends when its stdin does. Called by every measurement but `plan`.

use anyhow::{Context, bail, ensure};
use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// A server that does not listen by then is not coming.
const UP_WITHIN: Duration = Duration::from_secs(30);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(10);

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
    },
    /// A bare tonic unary service that answers each SubmitTask with the same bytes.
    Unary {
        /// An encoded SubmitTaskResponse.
        #[arg(long)]
        answer: PathBuf,
    },
}

/// A child's arguments.
#[derive(Clone, Debug, clap::Args)]
pub struct ChildArgs {
    /// Only on this core.
    #[arg(long)]
    core: Option<usize>,
    #[command(subcommand)]
    role: Role,
}

/// Plays a role until stdin ends. On stdout: the address, then one number for each line of stdin that names a counter.
pub fn play(args: ChildArgs) -> anyhow::Result<()> {
    midshift::logs::start(midshift::logs::Format::Text, "error");
    if let Some(core) = args.core {
        let mut cores = rustix::thread::CpuSet::new();
        cores.set(core);
        rustix::thread::sched_setaffinity(None, &cores).context("taking a core")?;
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
        Role::Serve { data, site } => {
            answer_questions(address, stop.clone(), metric)?;
            let serve = midshift::serve::Serve { site, data, listen: address, insecure: false };
            midshift::serve::run(serve, stop).await
        }
        Role::Unary { answer } => {
            answer_questions(address, stop.clone(), |_| 0)?;
            crate::bare::unary(&answer, address, stop).await
        }
    }
}

/// Sum of the lines of a counter in this process' metrics.
fn metric(name: &str) -> u64 {
    let text = midshift::server::metrics_handle().map(|m| m.render()).unwrap_or_default();
    let lines = text.lines().filter(|l| l.starts_with(name));
    lines.filter_map(|l| l.rsplit(' ').next()?.parse::<f64>().ok()).sum::<f64>() as u64
}

/// Says the address, then answers each line of stdin with a number; the end of stdin is the end of all.
fn answer_questions(
    address: SocketAddr,
    stop: CancellationToken,
    answer: impl Fn(&str) -> u64 + Send + 'static,
) -> anyhow::Result<()> {
    say(&address.to_string())?;
    tokio::task::spawn_blocking(move || {
        let told = std::io::stdin().lines().map_while(Result::ok).try_for_each(|line| say(&answer(&line).to_string()));
        stop.cancel();
        told
    });
    Ok(())
}

fn say(line: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

/// Raises this process' limit of open files as far as it may go, and says how far that is.
pub fn files_max() -> anyhow::Result<u64> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let limit = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, maximum: limit.maximum })
        .context("raising RLIMIT_NOFILE")?;
    Ok(limit.maximum.unwrap_or(u64::MAX))
}

/// A child from its parent's side. Killed when it is let go.
pub struct Child {
    process: std::process::Child,
    stdout: BufReader<std::process::ChildStdout>,
    /// Where it listens, if it does.
    pub address: SocketAddr,
}

impl Child {
    /// Starts this program in a role, on one core if there is a second one for the parent.
    pub fn start(role: &[&str], core: Option<usize>) -> anyhow::Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("child");
        if let Some(core) = core.filter(|_| std::thread::available_parallelism().is_ok_and(|n| n.get() > 1)) {
            command.args(["--core", &core.to_string()]);
        }
        let mut process = command.args(role).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let stdout = process.stdout.take().context("a child without a stdout")?;
        let mut child =
            Self { process, stdout: BufReader::new(stdout), address: SocketAddr::from(([127, 0, 0, 1], 0)) };
        child.address = child.line()?.parse().context("a child that did not say its address")?;
        Ok(child)
    }
    /// A server of midshift on a data directory, once it listens.
    pub async fn serve(data: &Path, site: Option<&Path>, core: Option<usize>) -> anyhow::Result<Self> {
        let data = data.to_str().context("a path that is no text")?;
        let mut role = vec!["serve", "--data", data];
        if let Some(site) = site {
            role.extend(["--site", site.to_str().context("a path that is no text")?]);
        }
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
    /// CPU spent so far by all its threads, seconds, in whole clock ticks.
    pub fn cpu_s(&self) -> anyhow::Result<f64> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.process.id()))?;
        // The name of the program stands in brackets and may hold anything; utime and stime are fields 14 and 15.
        let (_, fields) = stat.rsplit_once(')').context("/proc/PID/stat without a name")?;
        let ticks: u64 = fields.split_whitespace().skip(11).take(2).filter_map(|f| f.parse::<u64>().ok()).sum();
        Ok(ticks as f64 / rustix::param::clock_ticks_per_second() as f64)
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
