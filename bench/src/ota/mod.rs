//! P9: what software of robots costs. For the server: directives, ten thousand robots assigned, a kill in the middle of it, and the way back. For
//! a robot: what a download does to everything else on its line, how short the way to a release is, and what a download that was cut off costs.
//!
//! Called by `main`. Rooms: `server` measures the server, with robots of `hearers` and `swarm` in processes of their own, and samples signed by
//! `release`; `line` measures a shaped line and `device` the bytes, with releases of `noise`.

mod device;
mod heard;
pub mod hearers;
mod line;
mod netns;
pub mod noise;
pub mod parts;
mod programs;
mod release;
mod resume;
mod server;
pub mod swarm;

use crate::figure::Figure;
use std::path::PathBuf;
use tokio::signal::unix::{SignalKind, signal};

/// What to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum What {
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
    part: What,
    /// Rounds of each figure of the server.
    #[arg(long, default_value_t = 2)]
    rounds: usize,
    #[command(flatten)]
    server: server::ServerArgs,
    #[command(flatten)]
    line: line::LineArgs,
    #[command(flatten)]
    device: device::DeviceArgs,
    /// Where everything is made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    dir: Option<PathBuf>,
}

/// What was measured, and what could not be.
#[derive(Debug, Default)]
pub struct Told {
    /// Of the parts that could.
    pub figures: Vec<Figure>,
    /// Each part that could not, and why.
    pub failed: Vec<String>,
}

impl Told {
    /// Adds a part that was measured, or why it was not.
    pub fn add(&mut self, part: &str, measured: anyhow::Result<Vec<Figure>>) {
        match measured {
            Ok(figures) => self.figures.extend(figures),
            Err(error) => self.failed.push(format!("{part}: {error:#}")),
        }
    }
}

/// Runs the parts that were asked for. One that fails takes no other with it; Ctrl-C and SIGTERM end all of them, and what they made goes.
pub async fn run(args: OtaArgs, say: &dyn Fn(&str)) -> Told {
    let mut told = Told::default();
    let ended = unless_stopped(parts(&args, &mut told, say)).await;
    told.failed.extend(ended);
    told
}

async fn parts(args: &OtaArgs, told: &mut Told, say: &dyn Fn(&str)) {
    let dir = args.dir.as_ref();
    if matches!(args.part, What::Server | What::All) {
        told.add("server", server::run(args, say).await);
    }
    if matches!(args.part, What::Device | What::All) {
        told.add("device", device::run(&args.device, dir).await);
    }
    if matches!(args.part, What::Line | What::All) {
        told.add("line", line::run(&args.line, dir).await);
    }
}

/// Runs `all` to its end, or to that of somebody's patience; why it ended early.
pub async fn unless_stopped(all: impl Future<Output = ()>) -> Option<String> {
    tokio::select! {
        // First, so that it listens before anything is made.
        biased;
        why = stopped() => Some(why),
        () = all => None,
    }
}

/// Waits for somebody who wants an end.
async fn stopped() -> String {
    match signal(SignalKind::terminate()) {
        Err(error) => format!("SIGTERM cannot be heard: {error}"),
        Ok(mut terminated) => tokio::select! {
            _ = tokio::signal::ctrl_c() => "the rest: interrupted".to_owned(),
            _ = terminated.recv() => "the rest: terminated".to_owned(),
        },
    }
}
