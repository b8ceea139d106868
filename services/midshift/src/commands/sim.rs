//! `midshift sim …`: runs simulated robots, or asks those that run.

use super::interrupts::interrupts;
use crate::robots::{SimRun, swarm};
use clap::Subcommand;
use midshift_cli::client::{Exit, Login};
use midshift_cli::out::Out;
use midshift_cli::{Command, sim};

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
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Run { run, login } => {
            let resolved = login.resolve(Some(&run.server))?;
            let signed_in = match resolved.is_secure() {
                true => Some([resolved.endpoint(run.identity.address(&run.server))?, resolved.endpoint(&run.server)?]),
                false => None,
            };
            Ok(swarm(*run, signed_in, interrupts()).await?)
        }
        Verb::Ask(verb) => midshift_cli::run(Command::Sim(verb), out).await,
    }
}
