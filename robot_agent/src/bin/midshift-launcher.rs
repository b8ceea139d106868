//! Starts the agent of one robot, listens whether it lives, kills it if it hangs, and starts it again.
//!
//! `midshift-launcher --record FILE [--hang SECONDS] -- PROGRAM ARGS…`
//!
//! Standard library only: nothing that the agent's updates replace is needed to start the agent. The number of tries since the
//! program last ran well stands in FILE and is on the disk before each start, so that a machine that loses its power while it
//! starts still counts. The program's pulse is one marked line a second on its standard output; all other lines pass through.
//! Invariant: at most one child at a time. Ended by a signal, the launcher leaves the child to whoever sent it: a service manager
//! signals the whole group.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

/// Environment variable that asks the program for its pulse; the same as `midshift_agent::pulse::ASKED`.
const PULSE_ASKED: &str = "MIDSHIFT_PULSE";
/// The pulse; the same line as `midshift_agent::pulse::LINE`, without its end.
const PULSE_LINE: &str = "\u{1}midshift-hb";
/// Without a pulse for so many seconds the program hangs.
const HANG_SECONDS: u64 = 15;
/// After so many pulses the program runs well and its tries count from 0 again.
const WELL_AFTER_PULSES: u32 = 30;
/// First and longest pause before the next start, milliseconds.
const PAUSE_MS: (u64, u64) = (250, 30_000);
/// The end that no restart mends: wrong arguments.
const USAGE: u8 = 2;

/// What the command line says.
#[derive(Debug, PartialEq, Eq)]
struct Orders {
    record: PathBuf,
    hang: Duration,
    program: String,
    arguments: Vec<String>,
}

/// What the child's output says.
enum Sign {
    Pulse,
    Ended,
}

/// How one run of the program ended.
#[derive(Debug, PartialEq, Eq)]
enum Ending {
    /// By itself, with success: it was asked to end.
    Finished,
    /// By itself, otherwise.
    Failed(String),
    /// Killed: no pulse.
    Hung,
}

fn main() -> ExitCode {
    let orders = match orders(std::env::args().skip(1)) {
        Ok(orders) => orders,
        Err(problem) => {
            say(&format!("{problem}\nusage: midshift-launcher --record FILE [--hang SECONDS] -- PROGRAM ARGS…"));
            return ExitCode::from(USAGE);
        }
    };
    match keep_running(&orders) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            say(&format!("{}: {error}", orders.record.display()));
            ExitCode::FAILURE
        }
    }
}

fn orders(arguments: impl Iterator<Item = String>) -> Result<Orders, String> {
    let mut arguments = arguments;
    let (mut record, mut hang) = (None, HANG_SECONDS);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--record" => record = Some(PathBuf::from(arguments.next().ok_or("--record needs a file")?)),
            "--hang" => {
                let seconds = arguments.next().and_then(|s| s.parse().ok()).filter(|s| *s > 0);
                hang = seconds.ok_or("--hang needs whole seconds, at least 1")?;
            }
            "--" => {
                return Ok(Orders {
                    record: record.ok_or("--record is required")?,
                    hang: Duration::from_secs(hang),
                    program: arguments.next().ok_or("a program is required after --")?,
                    arguments: arguments.collect(),
                });
            }
            other => return Err(format!("unknown argument {other}")),
        }
    }
    Err("a program is required after --".to_owned())
}

fn keep_running(orders: &Orders) -> io::Result<()> {
    loop {
        let tries = read_tries(&orders.record).saturating_add(1);
        write_tries(&orders.record, tries)?;
        match run_once(orders)? {
            Ending::Finished => {
                write_tries(&orders.record, 0)?;
                return Ok(());
            }
            Ending::Failed(how) => say(&format!("{} ended: {how}", orders.program)),
            Ending::Hung => {
                say(&format!("{} gave no sign for {} s and was killed", orders.program, orders.hang.as_secs()))
            }
        }
        let pause = pause_before(read_tries(&orders.record));
        say(&format!("try {} in {} ms", read_tries(&orders.record).saturating_add(1), pause.as_millis()));
        #[expect(
            clippy::disallowed_methods,
            reason = "a program of its own without a runtime and without simulated time"
        )]
        std::thread::sleep(pause);
    }
}

fn pause_before(tries: u32) -> Duration {
    let (first, longest) = PAUSE_MS;
    Duration::from_millis(first.saturating_mul(1 << tries.saturating_sub(1).min(16)).min(longest))
}

/// Runs the program until it ends or hangs.
fn run_once(orders: &Orders) -> io::Result<Ending> {
    let started = Command::new(&orders.program)
        .args(&orders.arguments)
        .env(PULSE_ASKED, "1")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn();
    let mut child = match started {
        Ok(child) => Kept(child),
        Err(error) => return Ok(Ending::Failed(format!("cannot be started: {error}"))),
    };
    let Some(output) = child.0.stdout.take() else { return Ok(Ending::Failed("has no output".to_owned())) };
    let (signs, heard) = sync_channel(16);
    let listener = std::thread::spawn(move || {
        for line in BufReader::new(output).split(b'\n') {
            let Ok(line) = line else { break };
            let is_pulse = line == PULSE_LINE.as_bytes();
            let gone = if is_pulse { signs.send(Sign::Pulse).is_err() } else { pass_on(&line).is_err() };
            if gone {
                return;
            }
        }
        // The other end is gone only if the program was already given up.
        let _ = signs.send(Sign::Ended);
    });
    let ending = watch(&mut child.0, &heard, orders)?;
    drop(heard);
    drop(child);
    // A grandchild may keep the pipe open; it is not waited for.
    drop(listener);
    Ok(ending)
}

fn watch(child: &mut Child, heard: &Receiver<Sign>, orders: &Orders) -> io::Result<Ending> {
    let mut pulses = 0;
    loop {
        match heard.recv_timeout(orders.hang) {
            Ok(Sign::Pulse) => {
                pulses += 1;
                if pulses == WELL_AFTER_PULSES {
                    write_tries(&orders.record, 0)?;
                }
            }
            Ok(Sign::Ended) | Err(RecvTimeoutError::Disconnected) => return Ok(how_it_ended(child.wait()?)),
            Err(RecvTimeoutError::Timeout) => {
                if let Some(status) = child.try_wait()? {
                    return Ok(how_it_ended(status));
                }
                child.kill()?;
                child.wait()?;
                return Ok(Ending::Hung);
            }
        }
    }
}

fn how_it_ended(status: ExitStatus) -> Ending {
    if status.success() { Ending::Finished } else { Ending::Failed(status.to_string()) }
}

/// A child that never outlives this.
struct Kept(Child);

impl Drop for Kept {
    fn drop(&mut self) {
        // Already ended is what is wanted.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn read_tries(record: &Path) -> u32 {
    fs::read_to_string(record).ok().and_then(|text| text.trim().strip_prefix("tries ")?.parse().ok()).unwrap_or(0)
}

/// On the disk when this returns: a new file with the name of the old one, both synced.
fn write_tries(record: &Path, tries: u32) -> io::Result<()> {
    let new = record.with_extension("new");
    let mut file = File::create(&new)?;
    writeln!(file, "tries {tries}")?;
    file.sync_all()?;
    fs::rename(&new, record)?;
    let folder = record.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

fn pass_on(line: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(line)?;
    out.write_all(b"\n")?;
    out.flush()
}

fn say(text: &str) {
    // Nobody to tell is no reason to stop a robot.
    let _ = writeln!(io::stderr().lock(), "midshift-launcher: {text}");
}

#[cfg(test)]
mod tests {
    use super::*;

    fn given(text: &str) -> Result<Orders, String> {
        orders(text.split(' ').map(str::to_owned))
    }

    fn record(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("midshift-launcher-{}-{name}", std::process::id()));
        fs::create_dir_all(&folder).expect("a folder");
        folder.join("record")
    }

    fn shell(record: PathBuf, script: &str) -> Orders {
        let arguments = vec!["-c".to_owned(), script.to_owned()];
        Orders { record, hang: Duration::from_secs(1), program: "sh".to_owned(), arguments }
    }

    #[test]
    fn the_command_line_is_read_whole_or_refused() {
        let orders = given("--record r --hang 3 -- agent run --robot x").expect("reads");
        assert_eq!(
            (orders.hang, orders.program.as_str(), orders.arguments.len()),
            (Duration::from_secs(3), "agent", 3)
        );
        for wrong in ["--record r", "-- agent", "--record r --", "--hang 0 --record r -- agent", "--what"] {
            assert!(given(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn pauses_grow_to_a_limit() {
        let pauses: Vec<_> = [1, 2, 3, 40].map(|tries| pause_before(tries).as_millis()).into();
        assert_eq!(pauses, [250, 500, 1_000, 30_000]);
    }

    #[test]
    fn a_program_that_fails_is_started_again_until_it_ends_well_and_its_tries_are_on_the_disk_before_it_runs() {
        let record = record("again");
        let seen = record.with_extension("seen");
        let script =
            format!("cat {} >> {}; test $(wc -l < {}) -ge 3", record.display(), seen.display(), seen.display());
        keep_running(&shell(record.clone(), &script)).expect("runs");
        assert_eq!(fs::read_to_string(&seen).expect("was written"), "tries 1\ntries 2\ntries 3\n");
        assert_eq!(read_tries(&record), 0);
        fs::remove_dir_all(record.parent().expect("a folder")).expect("removes");
    }

    #[test]
    fn a_program_without_a_pulse_is_killed() {
        let record = record("hang");
        let ending = run_once(&shell(record.clone(), "echo a line is no pulse; exec sleep 600")).expect("runs");
        assert_eq!(ending, Ending::Hung);
        fs::remove_dir_all(record.parent().expect("a folder")).expect("removes");
    }

    #[test]
    fn the_pulse_is_the_line_that_the_agent_writes() {
        assert_eq!(midshift_agent::pulse::LINE, format!("{PULSE_LINE}\n"));
        assert_eq!(midshift_agent::pulse::ASKED, PULSE_ASKED);
    }
}
