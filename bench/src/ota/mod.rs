//! P9: what software of robots costs. For the server: directives, ten thousand robots assigned, a kill in the middle of it, and the way back. For
//! a robot: what a download does to everything else on its line, how short the way to a release is, and what a download that was cut off costs.
//!
//! Called by `main`. Rooms: `server` measures the server, with robots of `hearers` and `swarm` in processes of their own, and samples signed by
//! `release`; `line` measures a shaped line and `device` the bytes, with releases of `noise`.

mod args;
mod device;
mod heard;
pub mod hearers;
mod line;
mod netns;
pub mod noise;
pub mod parts;
mod programs;
pub mod release;
mod resume;
pub mod server;

pub use args::OtaArgs;

use crate::outcome::{RunOutcome, unless_stopped};
use args::What;

/// Runs the parts that were asked for. One that fails takes no other with it; Ctrl-C and SIGTERM end all of them, and what they made goes.
pub async fn run(args: OtaArgs, say: &dyn Fn(&str)) -> RunOutcome {
    let mut outcome = RunOutcome::default();
    let ended = unless_stopped(parts(&args, &mut outcome, say)).await;
    outcome.failed.extend(ended);
    outcome
}

async fn parts(args: &OtaArgs, outcome: &mut RunOutcome, say: &dyn Fn(&str)) {
    let dir = args.dir.as_ref();
    if matches!(args.part, What::Server | What::All) {
        outcome.add("server", server::run(args, say).await);
    }
    if matches!(args.part, What::Device | What::All) {
        outcome.add("device", device::run(&args.device, dir).await);
    }
    if matches!(args.part, What::Line | What::All) {
        outcome.add("line", line::run(&args.line, dir).await);
    }
}
