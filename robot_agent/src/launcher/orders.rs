//! The command line of the launcher.
//!
//! Invariant: it is read whole or refused. Called by the launcher when it begins.

use super::start_policy::{ENVIRONMENT_WAIT, HANG_SECONDS};
use std::path::PathBuf;
use std::time::Duration;

/// What the command line says.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Orders {
    pub(super) record: PathBuf,
    pub(super) sets: Option<PathBuf>,
    pub(super) hang: Duration,
    /// So long a set on trial may be failed by its environment before the kept set is started in its place.
    pub(super) patience: Duration,
    pub(super) beacon: Option<(String, String)>,
    pub(super) program: String,
    pub(super) arguments: Vec<String>,
}

impl Orders {
    /// Reads it, without the name of the program.
    pub(super) fn read(arguments: impl Iterator<Item = String>) -> Result<Self, String> {
        let mut arguments = arguments;
        let (mut record, mut sets, mut hang, mut beacon, mut robot_id) = (None, None, HANG_SECONDS, None, None);
        while let Some(argument) = arguments.next() {
            let mut value = |what: &str| arguments.next().ok_or(format!("{argument} needs {what}"));
            match argument.as_str() {
                "--record" => record = Some(PathBuf::from(value("a file")?)),
                "--sets" => sets = Some(PathBuf::from(value("a folder")?)),
                "--beacon" => beacon = Some(value("HOST:PORT")?),
                "--robot-id" => robot_id = Some(value("a name")?),
                "--hang" => {
                    let seconds = value("seconds")?.parse().ok().filter(|s| *s > 0);
                    hang = seconds.ok_or("--hang needs whole seconds, at least 1")?;
                }
                "--" => {
                    let beacon = match (beacon, robot_id) {
                        (None, None) => None,
                        (Some(to), Some(robot_id)) => Some((to, robot_id)),
                        _ => return Err("--beacon and --robot-id go together".to_owned()),
                    };
                    return Ok(Self {
                        record: record.ok_or("--record is required")?,
                        sets,
                        hang: Duration::from_secs(hang),
                        patience: ENVIRONMENT_WAIT,
                        beacon,
                        program: arguments.next().ok_or("a program is required after --")?,
                        arguments: arguments.collect(),
                    });
                }
                other => return Err(format!("unknown argument {other}")),
            }
        }
        Err("a program is required after --".to_owned())
    }
}
