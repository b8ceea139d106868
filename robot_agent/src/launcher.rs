//! Starts the agent of one robot, listens whether it lives, kills it if it hangs, and starts it again; goes back to the kept set of
//! software when a new one cannot live.
//!
//! `midshift-launcher --record FILE [--sets DIR] [--hang SECONDS] [--beacon HOST:PORT --robot-id ID] -- PROGRAM ARGS…`
//!
//! Standard library only: nothing that the agent's updates replace is needed to start the agent. The number of tries since the
//! program last ran well stands in FILE and is on the disk before each start, so that a machine that loses its power while it
//! starts still counts. The program's pulse is one marked line a second on its standard output; all other lines pass through.
//! With `--sets` the program is the one of the set that the switch record names, and PROGRAM for a set that brings none. For a set with
//! another base it starts the machine again, as far as there is one: the boot loader is simulated.
//! Invariant: at most one child at a time; the switch record is written only while no child runs; a record that cannot be written, on a
//! full disk, keeps no robot from being started: what would be in it holds for this launcher, which tries again. Ended by a signal, the launcher
//! leaves the child to whoever sent it: a service manager signals the whole group.

#![expect(clippy::disallowed_methods, reason = "a program of its own without a runtime and without simulated time")]

use crate::boot::{BASE, BOOT, Boot, Image, Slot};
use crate::starts::{self, HANG_SECONDS, Tries};
use crate::switch::{self, Switch};
use std::fs;
use std::io::{self, BufRead, BufReader, Write};
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Environment variable that names the set to the program that is started.
pub const SET: &str = "MIDSHIFT_SET";
/// File of a set that is its program; no component has a name with a dot.
pub const PROGRAM: &str = "set.program";
/// The switch record in the folder of the sets.
pub const SWITCH: &str = "switch";
/// The program ends with this to be started again at once: it has written the switch record.
pub const SWITCHED: u8 = 75;
/// Environment variable that asks the program for its pulse.
pub const PULSE_ASKED: &str = "MIDSHIFT_PULSE";
/// The pulse.
pub const PULSE_LINE: &str = "\u{1}midshift-hb";
/// Time between two beacons.
const BEACON_EVERY: Duration = Duration::from_secs(1);
/// The end that no restart mends: wrong arguments.
const USAGE: u8 = 2;
/// How it is called.
const USAGE_TEXT: &str = "usage: midshift-launcher --record FILE [--sets DIR] [--hang SECONDS] [--beacon HOST:PORT --robot-id ID] -- PROGRAM ARGS…";

/// What the command line says.
#[derive(Debug, PartialEq, Eq)]
struct Orders {
    record: PathBuf,
    sets: Option<PathBuf>,
    hang: Duration,
    beacon: Option<(String, String)>,
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
    /// By itself, to be started again from the switch record.
    Switched,
    /// By itself, otherwise.
    Failed(String),
    /// Killed: no pulse.
    Hung,
}

/// The whole program: `arguments` without its name.
pub fn main(arguments: impl Iterator<Item = String>) -> ExitCode {
    let orders = match orders(arguments) {
        Ok(orders) => orders,
        Err(problem) => {
            say(&format!("{problem}\n{USAGE_TEXT}"));
            return ExitCode::from(USAGE);
        }
    };
    match keep_running(&orders) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            say(&error.to_string());
            ExitCode::FAILURE
        }
    }
}

fn orders(arguments: impl Iterator<Item = String>) -> Result<Orders, String> {
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
                return Ok(Orders {
                    record: record.ok_or("--record is required")?,
                    sets,
                    hang: Duration::from_secs(hang),
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

fn keep_running(orders: &Orders) -> io::Result<()> {
    let mut beacon = Beacon::new(orders);
    if let Some(sets) = &orders.sets {
        machine_starts(sets)?;
    }
    let mut tries = read_tries(&orders.record);
    let mut unwritten = Unwritten::default();
    loop {
        let start = choose(orders, &tries, &mut unwritten)?;
        tries = start.tries.clone();
        keep_tries(&orders.record, &tries);
        beacon.begins(&start);
        match run_once(orders, &start, &mut tries, &mut beacon)? {
            Ending::Finished => {
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
            Ending::Switched => say(&format!("{} of set {} ended to switch and did not", start.program, start.set)),
            Ending::Failed(how) => say(&format!("{} of set {} ended: {how}", start.program, start.set)),
            Ending::Hung => {
                say(&format!("{} gave no sign for {} s and was killed", start.program, orders.hang.as_secs()))
            }
        }
        let pause = tries.pause();
        say(&format!("try {} in {} ms", tries.plus_one(&start.set).of(&start.set), pause.as_millis()));
        beacon.pause(pause);
    }
}

/// What is started next.
#[derive(Debug, PartialEq, Eq)]
struct Start {
    set: String,
    program: String,
    /// Counts this start.
    tries: Tries,
    /// Of the switch record that lies on the disk.
    number: u64,
}

/// A switch record that this launcher could not write: it holds as long as the one on the disk is the one that it was to follow.
#[derive(Default)]
struct Unwritten(Option<Switch>);

impl Unwritten {
    /// The record that holds, and the number of the one on the disk. One that could not be written is tried again.
    fn read(&mut self, path: &Path) -> io::Result<(Switch, u64)> {
        let on_disk = Switch::read(path).map_err(|e| named(e, path))?;
        let follows = |ours: &Switch| ours.number == on_disk.number + 1;
        let Some(mut ours) = self.0.take().filter(follows) else { return Ok((on_disk.clone(), on_disk.number)) };
        ours.number = on_disk.number;
        let number = self.write(&mut ours, path);
        Ok((ours, number))
    }
    /// Writes a record that follows the one on the disk, or keeps it; the number of the one that lies there then.
    fn write(&mut self, switch: &mut Switch, path: &Path) -> u64 {
        let before = switch.number;
        let Err(error) = switch.write(path) else { return switch.number };
        say(&format!("{} cannot be written: {error}; set {} is started without it", path.display(), switch.running()));
        self.0 = Some(switch.clone());
        before
    }
}

/// The set that the record names; one on trial that has had its tries is put away first.
fn choose(orders: &Orders, tries: &Tries, unwritten: &mut Unwritten) -> io::Result<Start> {
    let Some(sets) = &orders.sets else {
        let set = switch::FACTORY.to_owned();
        return Ok(Start { tries: tries.plus_one(&set), program: orders.program.clone(), set, number: 0 });
    };
    let path = sets.join(SWITCH);
    let (mut switch, mut number) = unwritten.read(&path)?;
    let tried = switch.running().to_owned();
    if let Some(had) = starts::put_away(&mut switch, tries) {
        say(&format!("set {tried} did not live in {had} tries; back to {}", switch.current));
        number = unwritten.write(&mut switch, &path);
    }
    let had = tries.of(switch.running());
    if !boot_into(sets, &switch, had)? {
        if switch.trial.is_some() {
            say(&format!("set {} has a base that does not start; back to {}", switch.running(), switch.current));
            switch.fall_back(had.max(1));
            switch.number = number;
            number = unwritten.write(&mut switch, &path);
            boot_into(sets, &switch, had)?;
        } else {
            say(&format!("set {} has no base that starts: it runs on the one that does", switch.running()));
        }
    }
    let set = switch.running().to_owned();
    let own = sets.join(&set).join(PROGRAM);
    let program = if own.exists() { own.to_string_lossy().into_owned() } else { orders.program.clone() };
    Ok(Start { tries: tries.plus_one(&set), program, set, number })
}

/// Number of the switch record; it rises with each change.
fn number(orders: &Orders) -> io::Result<u64> {
    let Some(sets) = &orders.sets else { return Ok(0) };
    let path = sets.join(SWITCH);
    Ok(Switch::read(&path).map_err(|e| named(e, &path))?.number)
}

fn named(error: io::Error, path: &Path) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

/// Reads the boot record, changes it, and writes it if it became another. The record that lies there then: the one before, if it could not
/// be written.
fn change_boot(sets: &Path, change: impl FnOnce(&mut Boot)) -> io::Result<Boot> {
    let path = sets.join(BOOT);
    let before = Boot::read(&path).map_err(|e| named(e, &path))?;
    let mut boot = before.clone();
    change(&mut boot);
    let Err(error) = boot.write_over(&before, &path) else { return Ok(boot) };
    say(&format!("{} cannot be written: {error}; the machine stays on the base that it runs on", path.display()));
    Ok(before)
}

/// Whether a slot has the bytes that the record says. The factory's base is the machine itself.
fn starts_well(sets: &Path, slot: Slot, image: &Image) -> bool {
    image.name == switch::FACTORY || fs::metadata(sets.join(slot.file())).is_ok_and(|file| file.len() == image.length)
}

/// The launcher stands for the machine: when it starts, so does the boot loader.
fn machine_starts(sets: &Path) -> io::Result<()> {
    change_boot(sets, |boot| boot.start(|slot, image| starts_well(sets, slot, image))).map(drop)
}

/// Starts the machine again if it runs on another base than the set that is to run. Whether it runs on that base now.
fn boot_into(sets: &Path, switch: &Switch, tries: u32) -> io::Result<bool> {
    let named = fs::read_to_string(sets.join(switch.running()).join(BASE));
    let base = match named {
        Ok(name) => name.trim().to_owned(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => switch::FACTORY.to_owned(),
        Err(error) => return Err(error),
    };
    let boot = change_boot(sets, |boot| {
        match &switch.trial {
            None => boot.settle(&base),
            Some(_) => boot.try_out(&base),
        }
        let slot = boot.slot_of(&base);
        if slot == Some(boot.booted) {
            if tries == 0 {
                boot.ran_well();
            }
        } else if slot.is_some() {
            say(&format!("the machine starts again, for the base {base}"));
            boot.start(|slot, image| starts_well(sets, slot, image));
        }
    })?;
    Ok(boot.slot_of(&base) == Some(boot.booted))
}

/// Whether a program that runs well clears its tries: a set on probation is not believed before it is proven.
fn is_trusted(orders: &Orders, start: &Start) -> bool {
    let Some(sets) = &orders.sets else { return true };
    // The record may name one on trial that was put away and could not be written so.
    Switch::read(&sets.join(SWITCH)).is_ok_and(|switch| starts::is_trusted(&switch) || switch.running() != start.set)
}

/// Runs the program until it ends or hangs.
fn run_once(orders: &Orders, start: &Start, tries: &mut Tries, beacon: &mut Beacon) -> io::Result<Ending> {
    let started = Command::new(&start.program)
        .args(&orders.arguments)
        .env(PULSE_ASKED, "1")
        .env(SET, &start.set)
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
    let ending = watch(&mut child.0, &heard, orders, start, tries, beacon)?;
    drop(heard);
    drop(child);
    // A grandchild may keep the pipe open; it is not waited for.
    drop(listener);
    Ok(ending)
}

fn watch(
    child: &mut Child,
    heard: &Receiver<Sign>,
    orders: &Orders,
    start: &Start,
    tries: &mut Tries,
    beacon: &mut Beacon,
) -> io::Result<Ending> {
    let mut pulses = 0;
    let mut sign_by = Instant::now() + orders.hang;
    loop {
        let left = sign_by.saturating_duration_since(Instant::now());
        match heard.recv_timeout(if pulses == 0 { left.min(BEACON_EVERY) } else { left }) {
            Ok(Sign::Pulse) => {
                pulses += 1;
                sign_by = Instant::now() + orders.hang;
                if starts::is_well(pulses) && is_trusted(orders, start) {
                    tries.clear();
                    keep_tries(&orders.record, tries);
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

fn how_it_ended(status: ExitStatus) -> Ending {
    match status.code() {
        Some(0) => Ending::Finished,
        Some(code) if code == i32::from(SWITCHED) => Ending::Switched,
        _ => Ending::Failed(status.to_string()),
    }
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

/// Tells the server once a second that the robot is there while no agent runs. A hint for people: sent blind, believed by nobody.
struct Beacon {
    socket: Option<(UdpSocket, String)>,
    robot_id: String,
    /// What runs, and the second since which no agent is heard.
    text: String,
}

impl Beacon {
    fn new(orders: &Orders) -> Self {
        let Some((to, robot_id)) = orders.beacon.clone() else {
            return Self { socket: None, robot_id: String::new(), text: String::new() };
        };
        let socket = UdpSocket::bind("[::]:0").or_else(|_| UdpSocket::bind("0.0.0.0:0"));
        Self { socket: socket.ok().map(|socket| (socket, to)), robot_id, text: String::new() }
    }

    fn begins(&mut self, start: &Start) {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
        self.text =
            format!("midshift-beacon 1 {} {} {} {since}\n", self.robot_id, start.set, start.tries.of(&start.set));
    }

    fn send(&self) {
        if let Some((socket, to)) = &self.socket {
            // Nobody has to hear it.
            let _ = socket.send_to(self.text.as_bytes(), to.as_str());
        }
    }

    fn pause(&self, pause: Duration) {
        let mut left = pause;
        loop {
            self.send();
            let part = left.min(BEACON_EVERY);
            std::thread::sleep(part);
            left -= part;
            if left.is_zero() {
                return;
            }
        }
    }
}

/// Starts that did not run well. A record that cannot be read counts none.
fn read_tries(record: &Path) -> Tries {
    Tries::parse(&fs::read_to_string(record).unwrap_or_default())
}

/// A record that cannot be written is no reason to stop a robot, or not to start it: this launcher counts on without it.
fn keep_tries(record: &Path, tries: &Tries) {
    if let Err(error) = write_tries(record, tries) {
        say(&format!("{} cannot be written: {error}", record.display()));
    }
}

/// On the disk when this returns.
fn write_tries(record: &Path, tries: &Tries) -> io::Result<()> {
    switch::replace(record, tries.text().as_bytes())
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
mod tests;
