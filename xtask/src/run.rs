//! Runs commands: shown before they start, their output passed on as it comes.
//!
//! Invariant: no command reads stdin, and a network command neither runs for ever nor is tried for ever.

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// One install command may take this long; a cold `go install` takes 2 minutes on 2 slow cores.
const INSTALL_LIMIT: Duration = Duration::from_secs(900);
/// Tries of one install command, with a growing pause between them.
const INSTALL_TRIES: u32 = 3;
const POLL: Duration = Duration::from_millis(100);
/// A command whose output is read may take this long; the longest is a sweep of whole nights, each of a quarter of an hour.
const READING_LIMIT: Duration = Duration::from_secs(3 * 3_600);
/// Tests that are named after a part of tests.
const SLOWEST_NAMED: usize = 10;

/// Tells the person at the terminal; data goes to [`print()`].
#[expect(clippy::print_stderr, reason = "the one place where xtask talks")]
pub fn tell_person(line: &str) {
    eprintln!("{line}");
}

/// Prints a line of output.
pub fn print(line: &str) {
    // A closed pipe is the reader's choice, not a failure of the suite.
    let _ = writeln!(std::io::stdout().lock(), "{line}");
}

/// Runs to the end; whether it succeeded.
pub fn succeeds(command: &mut Command) -> Result<bool> {
    tell_person(&format!("$ {}", shown(command)));
    Ok(command.status().with_context(|| format!("running {}", shown(command)))?.success())
}

/// Runs to the end, giving stdout to `read` line by line; whether it succeeded. After three hours it is ended, with all that it started.
pub fn reading(command: &mut Command, mut read: impl FnMut(&str)) -> Result<bool> {
    tell_person(&format!("$ {}", shown(command)));
    let mut child = command.stdout(Stdio::piped()).spawn().with_context(|| format!("running {}", shown(command)))?;
    let stdout = child.stdout.take().context("stdout was piped")?;
    let id = child.id();
    let (over, is_over) = std::sync::mpsc::sync_channel::<()>(0);
    let watch = std::thread::spawn(move || {
        let is_late = is_over.recv_timeout(READING_LIMIT) == Err(std::sync::mpsc::RecvTimeoutError::Timeout);
        if is_late {
            tell_person(&format!("no end after {} s", READING_LIMIT.as_secs()));
            end_tree(id);
        }
        !is_late
    });
    for line in BufReader::new(stdout).split(b'\n') {
        let line = line.context("reading output")?;
        read(&String::from_utf8_lossy(&line));
    }
    let succeeded = child.wait().context("waiting")?.success();
    drop(over);
    Ok(watch.join().unwrap_or(false) && succeeded)
}

/// What `what` came to, and how long it took by the wall.
#[expect(clippy::disallowed_methods, reason = "seconds by the wall, for a person")]
pub fn timed<T>(what: impl FnOnce() -> T) -> (T, Duration) {
    let started = std::time::Instant::now();
    let outcome = what();
    (outcome, started.elapsed())
}

/// Names the first few of a list that begins with the longest.
pub fn say_slowest(list: &[(Duration, String)]) {
    let lines: Vec<_> =
        list.iter().take(SLOWEST_NAMED).map(|(took, name)| format!("{:>6.1} s  {name}", took.as_secs_f64())).collect();
    tell_person(&format!("the slowest tests:\n{}", lines.join("\n")));
}

/// Whether the command starts and succeeds; silent.
pub fn quietly(command: &mut Command) -> bool {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}

/// Its stdout, if it starts and succeeds; silent.
pub fn output(command: &mut Command) -> Option<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Runs a command that needs the network: a limit on its time, and a few tries.
#[expect(clippy::disallowed_methods, reason = "a pause between tries, outside of any runtime")]
pub fn install(command: &mut Command) -> Result<()> {
    for attempt in 1..=INSTALL_TRIES {
        tell_person(&format!("$ {}", shown(command)));
        let child = command.stdout(std::io::stderr()).spawn();
        if within(child.with_context(|| format!("running {}", shown(command)))?, INSTALL_LIMIT, POLL)? {
            return Ok(());
        }
        if attempt < INSTALL_TRIES {
            let pause = Duration::from_secs(u64::from(attempt) * 5);
            tell_person(&format!("try {attempt} of {INSTALL_TRIES} failed; again in {} s", pause.as_secs()));
            std::thread::sleep(pause);
        }
    }
    bail!("`{}` failed {INSTALL_TRIES} times", shown(command))
}

/// Waits for the end of a child, looked at each `poll`; whether it succeeded. After `limit` it is ended, with all that it started.
#[expect(clippy::disallowed_methods, reason = "waiting for a child with a limit, outside of any runtime")]
pub fn within(mut child: Child, limit: Duration, poll: Duration) -> Result<bool> {
    let started = std::time::Instant::now();
    while started.elapsed() < limit {
        if let Some(status) = child.try_wait().context("waiting")? {
            return Ok(status.success());
        }
        std::thread::sleep(poll);
    }
    tell_person(&format!("no end after {} s", limit.as_secs()));
    end_tree(child.id());
    child.wait().context("waiting")?;
    Ok(false)
}

/// SIGKILL to a process and to all that it started and that they started, as far as the system still says whose they are.
fn end_tree(id: u32) {
    let mut tree = vec![id];
    let parents: Vec<(u32, u32)> = std::fs::read_dir("/proc")
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            let process = entry.file_name().to_str()?.parse().ok()?;
            let stat = std::fs::read_to_string(entry.path().join("stat")).ok()?;
            // A name in brackets may have anything in it; the state and the parent come behind.
            Some((process, stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()?))
        })
        .collect();
    let mut at = 0;
    while let Some(parent) = tree.get(at).copied() {
        tree.extend(parents.iter().filter(|(_, of)| *of == parent).map(|(process, _)| *process));
        at += 1;
    }
    for process in tree.into_iter().filter_map(|id| Pid::from_raw(i32::try_from(id).ok()?)) {
        // Whoever has ended by itself needs no signal.
        let _ = kill_process(process, Signal::KILL);
    }
}

/// The command as a person would type it.
fn shown(command: &Command) -> String {
    let program = std::path::Path::new(command.get_program()).file_name().unwrap_or(command.get_program());
    let words = std::iter::once(program).chain(command.get_args());
    words.map(|w| w.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::{POLL, within};
    use std::process::{Command, Stdio};
    use std::time::Duration;

    #[test]
    fn what_does_not_end_is_ended_with_all_that_it_started() {
        // The grandchild holds the pipe; its end is read when nobody holds it any more.
        let mut parent = Command::new("sh").args(["-c", "sleep 600 & wait"]).stdout(Stdio::piped()).spawn().unwrap();
        let mut pipe = parent.stdout.take().unwrap();
        let has_started = || std::fs::read_to_string(format!("/proc/{0}/task/{0}/children", parent.id()));
        while has_started().is_ok_and(|children| children.is_empty()) {
            std::thread::yield_now();
        }
        assert!(!within(parent, Duration::ZERO, POLL).unwrap());
        assert_eq!(std::io::Read::read(&mut pipe, &mut [0]).unwrap(), 0);
        assert!(within(Command::new("true").spawn().unwrap(), Duration::from_secs(60), POLL).unwrap());
    }
}
