//! `midshift stop …`: asks the stop service that runs, checks its files, or becomes one.

use clap::{Args, Subcommand};
use midshift_cli::Command;
use midshift_cli::client::Exit;
use midshift_cli::out::{Format, Out};
use midshift_cli::stop::{self, Engage, Request};
use midshift_core::stop::FOLDER;
use std::path::{Path, PathBuf};

/// Stops robots, at once and without asking back: an operational stop request; not a safety function, no performance level; the independent emergency stop is the robot
/// maker's and the integrator's hardware.
///
/// A stop stays until it is reset by its name; a reset makes nothing move. Exit code 13: not every robot has confirmed.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct Stop {
    #[command(subcommand)]
    verb: Option<Verb>,
    #[command(flatten)]
    engage: Engage,
}

/// What is done with stops besides engaging them.
#[derive(Subcommand)]
enum Verb {
    /// Ask the stop service that runs.
    #[command(flatten)]
    Ask(stop::Verb),
    /// Check that nobody has changed the audit of stops. Exit code 1 if somebody has.
    Verify {
        /// The data folder of the stop service, on this machine.
        #[arg(long, default_value = "midshift-data")]
        data: PathBuf,
    },
    /// Become the stop service: the program midshift-stop that lies beside this one, with these arguments.
    #[command(disable_help_flag = true)]
    Serve {
        /// As for the program midshift-stop.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
}

impl Stop {
    /// Arguments of the stop service, if that is what is to run.
    pub fn serves(&self) -> Option<&[String]> {
        match &self.verb {
            Some(Verb::Serve { arguments }) => Some(arguments),
            _ => None,
        }
    }
}

/// Runs one verb.
pub async fn run(stop: Stop, out: &Out) -> Result<(), Exit> {
    let request = match stop.verb {
        None => Request::Engage(stop.engage),
        Some(Verb::Ask(verb)) => Request::Of(verb),
        Some(Verb::Verify { data }) => return verify(&data.join(FOLDER), out),
        Some(Verb::Serve { .. }) => unreachable!("runs before the runtime"),
    };
    midshift_cli::run(Command::Stop(Box::new(request)), out).await
}

fn verify(folder: &Path, out: &Out) -> Result<(), Exit> {
    let verified = midshift_stop::verify(folder).map_err(|broken| {
        Exit::new(1, format!("{}: {broken}\n  try: compare it with a backup", folder.join("audit.jsonl").display()))
    })?;
    match out.format {
        Format::Table => {
            out.line(&format!("{} records hold together, the last is {}", verified.records, verified.hash))
        }
        Format::Name => out.line(&verified.hash),
        Format::Json | Format::Jsonl => {
            out.value(&serde_json::json!({"records": verified.records, "hash": verified.hash}))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        stop: Stop,
    }

    #[test]
    fn verbs_need_nobody_to_stop() {
        let parse = |words: &str| Line::try_parse_from(["stop"].into_iter().chain(words.split_whitespace()));
        assert!(parse("--all --reason drill").is_ok_and(|line| line.stop.verb.is_none()));
        let watches = |line: Line| matches!(line.stop.verb, Some(Verb::Ask(stop::Verb::Status { watch: true, .. })));
        assert!(parse("status --watch").is_ok_and(watches));
        let serves = ["--site", "a.toml", "--help"];
        assert!(
            parse("serve --site a.toml --help").is_ok_and(|line| line.stop.serves().is_some_and(|all| all == serves))
        );
        assert!(parse("").is_err() && parse("--all status").is_err());
    }
}
