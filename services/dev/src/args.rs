//! What `midshift dev` is asked for.

use super::report::Kind;
use super::scenario::{Release, Scenario};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

/// What `dev` was asked for.
#[derive(Clone, Debug, clap::Args)]
pub struct Dev {
    /// Simulated robots.
    #[arg(long, default_value_t = 12)]
    pub robots: usize,
    /// A site file instead of the built-in demo factory.
    #[arg(long, conflicts_with = "map")]
    pub site: Option<PathBuf>,
    /// A grid map (.map) or LIF layout (.json) instead of a site.
    #[arg(long)]
    pub map: Option<PathBuf>,
    /// Start cells of a grid map (.agents).
    #[arg(long, requires = "map")]
    pub agents: Option<PathBuf>,
    /// A task list: .tasks (grid), .csv or .jsonl. Without it transports are drawn.
    #[arg(long)]
    pub tasks: Option<PathBuf>,
    /// How many times as fast as real time the site runs.
    #[arg(long, default_value_t = 1.0)]
    pub speedup: f64,
    /// Seed of robots, faults and work. The run is seeded, not reproducible: threads and sockets have their own mind.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Stop after so much site time (e.g. 10m) instead of at Ctrl-C, and fail if the run was not good.
    ///
    /// Good is: no place ever too full, no item lost or doubled, no step done twice, every task accounted for, and at
    /// most twice the robots' number of tasks open (unless --keep-open or --rate). From 5m on also: at most 2 % of the
    /// tasks, or one, with an operator; and 8 tasks a robot succeeded in 10m, in the built-in factory with its own work
    /// and up to 20 robots.
    #[arg(long = "for", value_parser = midshift_cli::duration)]
    pub run_for: Option<Duration>,
    /// Keep everything in this directory instead of in memory.
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Write a JSON report at the end.
    #[arg(long)]
    pub report: Option<PathBuf>,
    /// Address to listen on, loopback only. Port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:7420")]
    pub listen: SocketAddr,
    /// UDP address to hear launchers of robots on whose agent does not run. By default 127.0.0.1:7422, if nobody else
    /// has it.
    #[arg(long, value_name = "ADDR")]
    pub beacon_listen: Option<SocketAddr>,
    /// Keep so many tasks open. The default with --for is twice the robots.
    #[arg(long, conflicts_with = "rate")]
    pub keep_open: Option<usize>,
    /// Submit so many tasks an hour of site time, e.g. 300/h.
    #[arg(long, value_parser = rate)]
    pub rate: Option<f64>,
    /// Play a story and fail if it did not go as it should. Five of the robots are launcher and agent processes;
    /// --speedup is that of bodies.
    #[arg(long, value_enum, conflicts_with_all = ["run_for", "map", "data", "rate"])]
    pub scenario: Option<Scenario>,
    /// Which bundles the story rolls out, in this order, each once. Robots must keep the good one and go back from
    /// every other.
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        requires = "scenario",
        default_values = ["good", "bad-at-start", "hangs", "bad-with-load"]
    )]
    pub bundles: Vec<Release>,
    /// How long the story's roll-outs keep a robot on probation and let a wave soak, e.g. 3s.
    #[arg(long, value_parser = midshift_cli::duration, requires = "scenario", default_value = "10s")]
    pub watched: Duration,
    /// Nothing goes wrong by itself. What is bad only with a load makes such faults more frequent, so a story does
    /// without that bundle then.
    #[arg(long)]
    pub no_faults: bool,
}

impl Dev {
    /// What the run is held to at its end.
    pub fn kind(&self) -> Kind {
        Kind {
            built_in: self.site.is_none() && self.map.is_none() && self.tasks.is_none(),
            own_backlog: self.keep_open.is_none() && self.rate.is_none(),
        }
    }
}

fn rate(text: &str) -> Result<f64, String> {
    let number = text.strip_suffix("/h").unwrap_or(text);
    number
        .parse::<f64>()
        .ok()
        .filter(|n| *n > 0.0 && n.is_finite())
        .ok_or_else(|| "must be a number above 0 with /h, e.g. 300/h".to_owned())
}
