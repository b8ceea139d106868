//! Starts the agent of one robot, listens whether it lives, kills it if it hangs, and starts it again; goes back to the
//! kept set of software when a new one cannot live.
//!
//! `midshift-launcher --record FILE [--sets DIR] [--hang SECONDS] [--beacon HOST:PORT --robot-id ID] -- PROGRAM ARGS…`
//!
//! Standard library only: nothing that the agent's updates replace is needed to start the agent. The number of tries
//! since the program last ran well stands in FILE and is on the disk before each start, so that a machine that loses
//! its power while it starts still counts. The program's pulse is one marked line a second on its standard output; all
//! other lines pass through. Rooms: here a child is run, watched and started again; `orders` is the command line,
//! `choose` what starts next by `start_policy`, `beacon` the sign of life, `lock` keeps a second launcher of the same
//! robot away; `switch`, `boot` and `record` are its files, and `terms` is what it has agreed on with the program. With
//! `--sets` the program is the one of the set that the switch record names, and PROGRAM for a set that brings none. For
//! a set with another base it starts the machine again, as far as there is one: the boot loader is simulated.
//! Invariant: at most one child at a time; the switch record is written only while no child runs; a record that cannot
//! be written, on a full disk, keeps no robot from being started: what would be in it holds for this launcher, which
//! tries again. Ended by a signal, the launcher leaves the child to whoever sent it: a service manager signals the
//! whole group, and an agent of ours asks for a signal at its parent's death.

#![expect(clippy::disallowed_methods, reason = "a program of its own without a runtime and without simulated time")]

mod beacon;
pub mod boot;
mod choose;
mod lock;
mod orders;
mod record;
pub mod start_policy;
pub mod switch;
mod terms;

use beacon::{BEACON_EVERY, Beacon};
use choose::{Start, Unwritten, choose, is_trusted, machine_starts, number, tries_before, write_held};
use lock::LauncherLock;
use orders::Orders;
use record::{keep_tries, report};
use start_policy::{Environment, Tries};
use std::io::{self, BufRead, BufReader, Write};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

pub use terms::{ENVIRONMENT, PROGRAM, PULSE_ASKED, PULSE_LINE, SET, SWITCH, SWITCHED};

/// The end that no restart mends: wrong arguments.
const USAGE: u8 = 2;
/// How it is called.
const USAGE_TEXT: &str = "usage: midshift-launcher --record FILE [--sets DIR] [--hang SECONDS] [--beacon HOST:PORT --robot-id ID] -- PROGRAM ARGS…";

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
    /// By itself, to be started again from the switch record.
    Switched,
    /// Its environment failed it: no fault of its set.
    Environment(String),
    /// By itself, otherwise.
    Failed(String),
    /// Killed: no pulse.
    Hung,
}

/// The whole program: `arguments` without its name.
pub fn main(arguments: impl Iterator<Item = String>) -> ExitCode {
    let mut arguments = arguments.peekable();
    if let Some(told) = arguments.peek().and_then(|first| of_itself(first)) {
        // Who does not want to hear it may close the pipe.
        let _ = writeln!(io::stdout(), "{told}");
        return ExitCode::SUCCESS;
    }
    let orders = match Orders::read(arguments) {
        Ok(orders) => orders,
        Err(problem) => {
            report(&format!("{problem}\n{USAGE_TEXT}"));
            return ExitCode::from(USAGE);
        }
    };
    match keep_running(&orders) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            report(&error.to_string());
            ExitCode::FAILURE
        }
    }
}

/// What a first argument that asks about the program itself is answered.
fn of_itself(first: &str) -> Option<&'static str> {
    match first {
        "--version" | "-V" => Some(concat!("midshift-launcher ", env!("CARGO_PKG_VERSION"))),
        "--help" | "-h" => Some(USAGE_TEXT),
        _ => None,
    }
}

fn keep_running(orders: &Orders) -> io::Result<()> {
    let _lock = LauncherLock::acquire(orders)?;
    let begun = Instant::now();
    let mut beacon = Beacon::new(orders);
    if let Some(sets) = &orders.sets {
        machine_starts(sets)?;
    }
    let mut tries = tries_before(orders);
    let mut unwritten = Unwritten::default();
    let mut environment = Environment::default();
    loop {
        let start = choose(orders, &tries, &mut unwritten, &mut environment, begun.elapsed())?;
        let before = std::mem::replace(&mut tries, start.tries.clone());
        keep_tries(&orders.record, &tries);
        beacon.begins(&start, now_unix_s());
        let run = Run { orders, start: &start, tries: &mut tries, environment: &mut environment, beacon: &mut beacon };
        let ending = run_once(run)?;
        if !matches!(ending, Ending::Environment(_)) {
            environment.passed();
        }
        let pause = match ending {
            Ending::Finished => {
                write_held(orders, &mut unwritten)?;
                // A set on probation has proven nothing by ending.
                if is_trusted(orders, &start) {
                    tries.clear();
                    keep_tries(&orders.record, &tries);
                }
                return Ok(());
            }
            Ending::Switched if number(orders)? != start.number => {
                tries.clear();
                keep_tries(&orders.record, &tries);
                continue;
            }
            Ending::Environment(how) => {
                if environment.failed(begun.elapsed()) {
                    unwritten.forget();
                }
                if tries == start.tries {
                    tries = before;
                    keep_tries(&orders.record, &tries);
                }
                report(&format!("set {} was failed by its environment ({how}): no try is counted", start.set));
                environment.pause()
            }
            Ending::Switched => next_try(&start, &tries, "ended to switch and did not"),
            Ending::Failed(how) => next_try(&start, &tries, &format!("ended: {how}")),
            Ending::Hung => {
                next_try(&start, &tries, &format!("gave no sign for {} s and was killed", orders.hang.as_secs()))
            }
        };
        beacon.pause(pause);
    }
}

/// Says how a start ended that counts as a try; the time before the next one.
fn next_try(start: &Start, tries: &Tries, how: &str) -> Duration {
    let pause = tries.pause();
    report(&format!("{} of set {} {how}", start.program, start.set));
    report(&format!("try {} in {} ms", tries.plus_one(&start.set).count_of(&start.set), pause.as_millis()));
    pause
}

/// One run of the program, and what is noted of it.
struct Run<'a> {
    orders: &'a Orders,
    start: &'a Start,
    tries: &'a mut Tries,
    environment: &'a mut Environment,
    beacon: &'a mut Beacon,
}

/// Runs the program until it ends or hangs.
fn run_once(run: Run<'_>) -> io::Result<Ending> {
    let (orders, start) = (run.orders, run.start);
    let started = Command::new(&start.program)
        .args(&orders.arguments)
        .env(PULSE_ASKED, "1")
        .env(SET, &start.set)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn();
    let mut child = match started {
        Ok(child) => ChildGuard(child),
        Err(error) => {
            let how = format!("cannot be started: {error}");
            let is_environment = start_policy::is_of_environment(&error);
            return Ok(if is_environment { Ending::Environment(how) } else { Ending::Failed(how) });
        }
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
    let ending = watch(&mut child.0, &heard, run)?;
    drop(heard);
    drop(child);
    // A grandchild may keep the pipe open; it is not waited for.
    drop(listener);
    Ok(ending)
}

fn watch(child: &mut Child, heard: &Receiver<Sign>, run: Run<'_>) -> io::Result<Ending> {
    let Run { orders, start, tries, environment, beacon } = run;
    let mut pulses = 0;
    let mut sign_by = Instant::now() + orders.hang;
    loop {
        let left = sign_by.saturating_duration_since(Instant::now());
        match heard.recv_timeout(if pulses == 0 { left.min(BEACON_EVERY) } else { left }) {
            Ok(Sign::Pulse) => {
                pulses += 1;
                sign_by = Instant::now() + orders.hang;
                if start_policy::is_well(pulses) {
                    environment.passed();
                    if is_trusted(orders, start) {
                        tries.clear();
                        keep_tries(&orders.record, tries);
                    }
                }
            }
            Ok(Sign::Ended) | Err(RecvTimeoutError::Disconnected) => return Ok(how_it_ended(child.wait()?)),
            Err(RecvTimeoutError::Timeout) => {
                if let Some(status) = child.try_wait()? {
                    return Ok(how_it_ended(status));
                }
                if Instant::now() < sign_by {
                    beacon.send();
                    continue;
                }
                child.kill()?;
                child.wait()?;
                return Ok(Ending::Hung);
            }
        }
    }
}

fn now_unix_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

fn how_it_ended(status: ExitStatus) -> Ending {
    match status.code() {
        Some(0) => Ending::Finished,
        Some(code) if code == i32::from(SWITCHED) => Ending::Switched,
        Some(code) if code == i32::from(ENVIRONMENT) => Ending::Environment(status.to_string()),
        _ => Ending::Failed(status.to_string()),
    }
}

/// Kills its child process when it is dropped.
struct ChildGuard(Child);

impl Drop for ChildGuard {
    fn drop(&mut self) {
        // Already ended is what is wanted.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn pass_on(line: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(line)?;
    out.write_all(b"\n")?;
    out.flush()
}

#[cfg(test)]
mod tests;
