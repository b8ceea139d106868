//! Children: this same program started again in one role, so that a server's CPU and memory are its own, and the kernel can say them.
//!
//! Invariant: a child lives no longer than its parent: it ends when its stdin does. Called by every measurement.

use crate::process_files::Memory;
use anyhow::{Context, bail, ensure};
use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::time::Instant;

/// A server that does not listen by then is not coming.
const UP_WITHIN: Duration = Duration::from_secs(30);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Sessions a server has now.
pub const SESSIONS: &str = "midshift_telemetry_sessions";
/// Messages with a heartbeat that a server has taken.
pub const MESSAGES: &str = "midshift_telemetry_heartbeats_total";

/// Raises this process' limit of open files as far as it may go, and says how far that is.
pub fn raise_files_max() -> anyhow::Result<u64> {
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
        Self::serve_at(None, data, site, store, core).await
    }
    /// As [`Child::serve`], at an address that it had before.
    pub async fn serve_at(
        listen: Option<SocketAddr>,
        data: &Path,
        site: Option<&Path>,
        store: Option<&str>,
        core: Option<usize>,
    ) -> anyhow::Result<Self> {
        let listen = listen.map(|listen| listen.to_string());
        let data = data.to_str().context("a path that is no text")?;
        let mut role = vec!["serve", "--data", data];
        if let Some(site) = site {
            role.extend(["--site", site.to_str().context("a path that is no text")?]);
        }
        role.extend(store.iter().flat_map(|url| ["--store", url]));
        role.extend(listen.iter().flat_map(|listen| ["--listen", listen]));
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
        Ok(Memory::read(self.pid())?.all_mib * 1_024.0)
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
