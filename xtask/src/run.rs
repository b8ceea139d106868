//! Runs commands: shown before they start, their output passed on as it comes.
//!
//! Invariant: no command reads stdin, and a network command neither runs for ever nor is tried for ever.

use anyhow::{Context, Result, bail};
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use std::time::Duration;

/// One install command may take this long; a cold `go install` takes 2 minutes on 2 slow cores.
const INSTALL_LIMIT: Duration = Duration::from_secs(900);
/// Tries of one install command, with a growing pause between them.
const INSTALL_TRIES: u32 = 3;
const POLL: Duration = Duration::from_millis(100);

/// Tells the person at the terminal; data goes to [`print()`].
#[expect(clippy::print_stderr, reason = "the one place where xtask talks")]
pub fn print_line(line: &str) {
    eprintln!("{line}");
}

/// Prints a line of output.
pub fn print(line: &str) {
    // A closed pipe is the reader's choice, not a failure of the suite.
    let _ = writeln!(std::io::stdout().lock(), "{line}");
}

/// Runs to the end; whether it succeeded.
pub fn succeeds(command: &mut Command) -> Result<bool> {
    print_line(&format!("$ {}", shown(command)));
    Ok(command.status().with_context(|| format!("running {}", shown(command)))?.success())
}

/// Runs to the end, passing stdout on line by line and showing each line to `read`; whether it succeeded.
pub fn reading(command: &mut Command, mut read: impl FnMut(&str)) -> Result<bool> {
    print_line(&format!("$ {}", shown(command)));
    let mut child = command.stdout(Stdio::piped()).spawn().with_context(|| format!("running {}", shown(command)))?;
    let stdout = child.stdout.take().context("stdout was piped")?;
    for line in BufReader::new(stdout).split(b'\n') {
        let line = line.context("reading output")?;
        let line = String::from_utf8_lossy(&line);
        read(&line);
        print(&line);
    }
    Ok(child.wait().context("waiting")?.success())
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
        print_line(&format!("$ {}", shown(command)));
        if within(command, INSTALL_LIMIT)? {
            return Ok(());
        }
        if attempt < INSTALL_TRIES {
            let pause = Duration::from_secs(u64::from(attempt) * 5);
            print_line(&format!("try {attempt} of {INSTALL_TRIES} failed; again in {} s", pause.as_secs()));
            std::thread::sleep(pause);
        }
    }
    bail!("`{}` failed {INSTALL_TRIES} times", shown(command))
}

#[expect(clippy::disallowed_methods, reason = "waiting for a child with a limit, outside of any runtime")]
fn within(command: &mut Command, limit: Duration) -> Result<bool> {
    let mut child = command.stdout(std::io::stderr()).spawn().with_context(|| format!("running {}", shown(command)))?;
    let started = std::time::Instant::now();
    while started.elapsed() < limit {
        if let Some(status) = child.try_wait().context("waiting")? {
            return Ok(status.success());
        }
        std::thread::sleep(POLL);
    }
    print_line(&format!("no end after {} s", limit.as_secs()));
    child.kill().context("ending a command that took too long")?;
    child.wait().context("waiting")?;
    Ok(false)
}

/// The command as a person would type it.
fn shown(command: &Command) -> String {
    let program = std::path::Path::new(command.get_program()).file_name().unwrap_or(command.get_program());
    let words = std::iter::once(program).chain(command.get_args());
    words.map(|w| w.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
}
