//! A network of one robot: a namespace behind a pair of interfaces, each way shaped to a rate.
//!
//! Invariant: it goes with its value, however the measurement ends; what a killed bench left behind goes with the next one.
//! Called by [`super::line`].

use anyhow::{Context, bail};
use std::ffi::OsStr;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::{Command, Stdio};

/// Begin of a namespace's name; the number of the process that made it follows.
const PREFIX: &str = "midshift-bench-";
/// Bytes that go out at once before the rate is kept; 13 ms of 20 Mbit/s.
const BURST: &str = "32kb";
/// How long a byte may stand in a queue of the line before it is dropped, a usual access point's.
const QUEUE: &str = "200ms";
/// Networks of four addresses in 198.18.0.0/15, which RFC 2544 keeps for measurements.
const NETWORKS: u32 = 1 << 15;

/// A namespace with its line to this machine.
#[derive(Debug)]
pub struct Namespace {
    name: String,
    /// This machine's end of the line.
    interface: String,
    /// Address of this machine on the line.
    pub here: Ipv4Addr,
}

/// What is missing here to make one; empty: nothing.
pub fn missing() -> Vec<&'static str> {
    let runs = |program: &str| {
        let mut asked = Command::new(program);
        asked.arg("-V").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        asked.status().is_ok_and(|status| status.success())
    };
    let mut missing = Vec::new();
    if !rustix::process::geteuid().is_root() {
        missing.push("root");
    }
    missing.extend(["ip", "tc"].into_iter().filter(|program| !runs(program)));
    missing
}

/// Runs a program to its end; what it said is the error.
fn done<S: AsRef<OsStr>>(program: &str, arguments: impl IntoIterator<Item = S>) -> anyhow::Result<String> {
    let mut command = Command::new(program);
    let output =
        command.args(arguments).stdin(Stdio::null()).output().with_context(|| format!("starting {program}"))?;
    if !output.status.success() {
        bail!("{command:?}: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn words(program: &str, line: &str) -> anyhow::Result<String> {
    done(program, line.split_whitespace())
}

impl Namespace {
    /// Makes one, shaped to so many Mbit/s in both directions.
    pub fn make(mbit: u32) -> anyhow::Result<Self> {
        sweep()?;
        let pid = std::process::id();
        let (here, there) = addresses(pid);
        let (name, interface) = (format!("{PREFIX}{pid}"), format!("msb{pid}a"));
        let inner = format!("msb{pid}b");
        words("ip", &format!("netns add {name}"))?;
        let made = Self { name, interface, here };
        let (name, interface) = (&made.name, &made.interface);
        words("ip", &format!("link add {interface} type veth peer name {inner} netns {name}"))?;
        words("ip", &format!("addr add {here}/30 dev {interface}"))?;
        words("ip", &format!("link set {interface} up"))?;
        words("ip", &format!("-n {name} addr add {there}/30 dev {inner}"))?;
        words("ip", &format!("-n {name} link set lo up"))?;
        words("ip", &format!("-n {name} link set {inner} up"))?;
        let shape = format!("root tbf rate {mbit}mbit burst {BURST} latency {QUEUE}");
        words("tc", &format!("qdisc add dev {interface} {shape}"))?;
        words("tc", &format!("-n {name} qdisc add dev {inner} {shape}"))?;
        Ok(made)
    }

    /// What a command begins with to run inside.
    pub fn entry(&self) -> [&str; 4] {
        ["ip", "netns", "exec", &self.name]
    }

    /// Bytes that went to the robot so far, with the headers of every layer.
    pub fn bytes_down(&self) -> anyhow::Result<u64> {
        let path = format!("/sys/class/net/{}/statistics/tx_bytes", self.interface);
        let text = std::fs::read_to_string(&path).with_context(|| format!("reading {path}"))?;
        Ok(text.trim().parse()?)
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        // The line goes first: a namespace lives as long as a process in it. What is not there cannot be removed.
        let _ = words("ip", &format!("link del {}", self.interface));
        let _ = words("ip", &format!("netns del {}", self.name));
    }
}

/// This machine's address and the robot's, for a process.
fn addresses(pid: u32) -> (Ipv4Addr, Ipv4Addr) {
    let network = u32::from(Ipv4Addr::new(198, 18, 0, 0)) + (pid % NETWORKS) * 4;
    (Ipv4Addr::from(network + 1), Ipv4Addr::from(network + 2))
}

/// Removes namespaces of processes that are no more. Their line went with their last process, or goes with them.
fn sweep() -> anyhow::Result<()> {
    let listed = words("ip", "netns list")?;
    let names = listed.lines().filter_map(|line| line.split_whitespace().next());
    for (name, pid) in names.filter_map(|name| Some((name, name.strip_prefix(PREFIX)?))) {
        if !Path::new("/proc").join(pid).exists() {
            words("ip", &format!("netns del {name}"))?;
        }
    }
    Ok(())
}
