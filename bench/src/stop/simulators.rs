//! The processes in which the robots are, and what they wrote down of a turn.

use super::moments::Moments;
use super::site::Site;
use crate::child::Child;
use anyhow::{Context, ensure};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// Processes that the robots are split over. A robot has three connections: so no process needs more descriptors than there are robots.
const SIMULATORS: usize = 3;
/// How often it is looked whether robots are as far as they should be.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// What one turn came to, milliseconds from the moment of asking.
pub struct Turn {
    /// Each robot had read it.
    pub told_ms: Vec<f64>,
    /// Each robot had the answer to its acknowledgement.
    pub acked_ms: Vec<f64>,
    /// Who asked was told that all have acknowledged.
    pub known_ms: f64,
}

/// A path for a command line.
pub fn text(path: &Path) -> anyhow::Result<&str> {
    path.to_str().context("a path that is no text")
}

/// All robots.
pub struct Simulators {
    robots: usize,
    /// Each with the file that it writes.
    children: Vec<(Child, PathBuf)>,
}

impl Simulators {
    /// Starts them on the stop service and on both bare loops. What they read and write is below `room`.
    pub fn start(
        site: &Site,
        robots: usize,
        room: &Path,
        [stop, tls_fan, plain_fan]: [&Child; 3],
    ) -> anyhow::Result<Self> {
        let [stop, tls_fan, plain_fan] = [stop, tls_fan, plain_fan].map(|child| child.address.to_string());
        let mut children = Vec::new();
        let parts = SIMULATORS.min(robots);
        for part in 0..parts {
            let [out, proofs] = ["moments", "proofs"].map(|name| room.join(format!("{name}-{part}.json")));
            let [from, to] = [part, part + 1].map(|n| robots * n / parts);
            site.hand_out(from..to, &proofs)?;
            let [from, to] = [from, to].map(|n| n.to_string());
            let dialed = ["--stop", &stop, "--tls-fan", &tls_fan, "--plain-fan", &plain_fan];
            let own = ["--from", &from, "--to", &to, "--out", text(&out)?, "--proofs", text(&proofs)?];
            children.push((Child::start(&[&["attend"], &dialed[..], &own].concat(), Some(1 + part))?, out));
        }
        Ok(Self { robots, children })
    }

    /// How many robots there are.
    pub fn robots(&self) -> usize {
        self.robots
    }

    /// Waits until that is so of every robot.
    pub async fn until(&mut self, what: &str, within: Duration) -> anyhow::Result<()> {
        let end = Instant::now() + within;
        loop {
            let counts = self.children.iter_mut().map(|(child, _)| child.ask(what));
            let count = counts.sum::<anyhow::Result<u64>>()? as usize;
            if count >= self.robots {
                return Ok(());
            }
            ensure!(Instant::now() < end, "of {} robots {count} are {what}", self.robots);
            sleep(LOOK_EVERY).await;
        }
    }

    /// Takes what the robots wrote down since `begun_ns`.
    pub fn take_turn(&mut self, what: &str, begun_ns: u64, known_ns: u64) -> anyhow::Result<Turn> {
        let ms = |at_ns: u64| at_ns.saturating_sub(begun_ns) as f64 / 1e6;
        let mut turn = Turn { told_ms: Vec::new(), acked_ms: Vec::new(), known_ms: ms(known_ns) };
        for (child, out) in &mut self.children {
            ensure!(child.ask(what)? > 0, "moments could not be written to {}", out.display());
            let moments: Vec<Moments> = serde_json::from_slice(&std::fs::read(out)?)?;
            ensure!(moments.iter().all(|m| m.told_ns > begun_ns && m.acked_ns > m.told_ns), "a robot was left out");
            turn.told_ms.extend(moments.iter().map(|m| ms(m.told_ns)));
            turn.acked_ms.extend(moments.iter().map(|m| ms(m.acked_ns)));
        }
        Ok(turn)
    }
}
