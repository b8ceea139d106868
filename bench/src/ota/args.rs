//! What to measure of software of robots.

use super::device::DeviceArgs;
use super::line::LineArgs;
use std::path::PathBuf;

/// What to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum What {
    /// Directives, robots assigned, a kill, the way back.
    Server,
    /// A robot's words beside its download on a shaped line. Needs root and iproute2.
    Line,
    /// Sizes of patches, and downloads that are cut off.
    Device,
    /// All of it.
    All,
}

/// What to measure of it.
#[derive(Clone, Debug, clap::Args)]
pub struct OtaArgs {
    /// Which part.
    #[arg(long, value_enum, default_value_t = What::All)]
    pub part: What,
    /// Rounds of each figure of the server.
    #[arg(long, default_value_t = 2)]
    pub rounds: usize,
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub line: LineArgs,
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Where everything is made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    pub dir: Option<PathBuf>,
}

/// What to measure of the server.
#[derive(Clone, Debug, clap::Args)]
pub struct ServerArgs {
    /// Robots that are assigned a roll-out. Without it 10,000, or as many as the limit of open files allows. 0: none is assigned.
    #[arg(long)]
    pub robots: Option<usize>,
    /// Robots of its first wave, at most a tenth of all.
    #[arg(long, default_value_t = 100)]
    pub canary: u32,
    /// Seconds before each start in which what idle robots cost is measured.
    #[arg(long, default_value_t = 10)]
    pub idle_seconds: u64,
    /// Simulated robots that go back from a release. 0: none does.
    #[arg(long, default_value_t = 100)]
    pub back_robots: usize,
    /// Directives signed in each round.
    #[arg(long, default_value_t = 5_000)]
    pub directives: usize,
}
