//! P8: from an engaged stop to its acknowledgement by every robot, in turn with bare loops that write to as many sockets under the same load: one over TLS, as
//! robots' lines are, and one in plain text.
//!
//! Invariant: the stop service is a process of its own on the first core, as is each bare loop; robots are on the others; robots' check-ins go on in the turns of all.
//! Called by `main`. Rooms: `turns` has the turns and their figures; `simulators` the processes of robots; `disturbance` and `scene` are what goes on beside; `site`
//! who may come in; `robots` with `readers`, `fan` and `pull` are children; `moments` is what they measure.

mod disturbance;
mod fan;
mod moments;
mod pull;
mod readers;
mod robots;
mod scene;
mod simulators;
mod site;
mod turns;

pub use turns::StopArgs;

use crate::link;
use crate::outcome::{RunOutcome, unless_stopped};
use disturbance::Disturbance;
use midshift_core::limits::CONNECTIONS_MAX;
use midshift_process::door::Share;
use site::Site;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

/// Sizes of the fleet unless told otherwise, or as many as the limit of open files allows.
const ROBOTS: [usize; 2] = [1_000, 10_000];

/// Children of this measurement.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Part {
    /// `midshift-stop` on a data directory.
    StopServe {
        /// The data directory.
        #[arg(long)]
        data: PathBuf,
    },
    /// A bare loop.
    Fan {
        /// The data directory of the stop service whose TLS it speaks. Without it plain text.
        #[arg(long)]
        data: Option<PathBuf>,
    },
    /// Robots on all of them.
    Attend(robots::AttendArgs),
    /// Downloads without an end.
    Pull(pull::PullArgs),
}

/// Plays a part until `stop`. `address` is one that nobody has.
pub async fn play(part: Part, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    match part {
        Part::StopServe { data } => {
            crate::questions::answer_questions(address, stop.clone(), |_| 0)?;
            let serve = midshift_stop::program::Args {
                site: None,
                data,
                listen: address,
                insecure: false,
                // All robots of a run come from one address.
                share: Share { connections_per_address: Some(CONNECTIONS_MAX), ..Share::default() },
                log: Default::default(),
                follows: false,
            };
            midshift_stop::program::run(serve, stop).await
        }
        Part::Fan { data } => {
            let tls = data.as_deref().map(site::make_acceptor).transpose()?;
            fan::serve(address, tls, stop).await
        }
        Part::Attend(args) => {
            let all = Arc::new(robots::All::new(args));
            let asked = all.clone();
            crate::questions::answer_questions(address, stop.clone(), move |question| asked.answer(question))?;
            robots::run(all, stop).await
        }
        Part::Pull(args) => pull::run(args, address, stop).await,
    }
}

/// Runs every size and situation. What cannot be made here is named and takes no other with it; Ctrl-C and SIGTERM end all, and what was made goes.
pub async fn run(args: StopArgs, say: &dyn Fn(&str)) -> RunOutcome {
    let mut outcome = RunOutcome::default();
    let ended = unless_stopped(all(&args, &mut outcome, say)).await;
    outcome.failed.extend(ended);
    outcome
}

async fn all(args: &StopArgs, outcome: &mut RunOutcome, say: &dyn Fn(&str)) {
    let sizes = if args.robots.is_empty() { ROBOTS.to_vec() } else { args.robots.clone() };
    for wanted in sizes {
        let robots = match link::allowed(Some(wanted)) {
            Ok((robots, note)) => {
                note.iter().for_each(|note| say(note));
                robots
            }
            Err(error) => return outcome.failed.push(format!("{error:#}")),
        };
        let site = match proven(args, robots).await {
            Ok(site) => site,
            Err(error) => return outcome.failed.push(format!("{robots} robots are not enrolled: {error:#}")),
        };
        for disturbance in Disturbance::all(&args.beside) {
            let name = format!("{robots} robots, {}", disturbance.words());
            say(&name);
            outcome.add(
                &name,
                scene::measure(args, &site, robots, disturbance, say).await.map(|turns| turns.figures(&name)),
            );
        }
    }
}

/// A site with so many robots.
async fn proven(args: &StopArgs, robots: usize) -> anyhow::Result<Site> {
    let room = crate::fsync::place(args.dir.as_ref())?;
    Site::with(robots, room.path()).await
}
