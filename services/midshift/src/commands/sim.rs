//! `midshift sim …`: runs simulated robots, or asks those that run.

use crate::robots::{SimRun, swarm};
use clap::Subcommand;
use midshift_cli::client::{Exit, Login};
use midshift_cli::out::Out;
use midshift_cli::{Command, sim};
use tokio_util::sync::CancellationToken;

/// Verbs of the simulator.
#[derive(Subcommand)]
pub enum Verb {
    /// Run simulated robots against a server.
    Run {
        #[command(flatten)]
        run: Box<SimRun>,
        /// As whom they are enrolled: somebody who may administer the site. Signed in nowhere, they speak plain text.
        #[command(flatten)]
        login: Login,
    },
    /// Ask those that run.
    #[command(flatten)]
    Ask(sim::Verb),
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out, stop: CancellationToken) -> Result<(), Exit> {
    match verb {
        Verb::Run { run, login } => {
            let resolved = login.resolve(Some(&run.server))?;
            let way = if resolved.is_secure() { Some(resolved.way(run.identity.address(&run.server))?) } else { None };
            Ok(swarm(*run, way, stop).await?)
        }
        Verb::Ask(verb) => midshift_cli::run(Command::Sim(verb), out).await,
    }
}
