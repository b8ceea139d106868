//! The agent's bond with its launcher: a sign of life, one line a second on standard output, and an end in order when
//! the launcher is gone.
//!
//! Invariant: silent unless the launcher asked for it in the environment. Called by binaries that run one agent.

use crate::launcher::{PULSE_ASKED, PULSE_LINE};
use rustix::process::{Signal, getpid, kill_process, set_parent_process_death_signal};
use std::io::{self, Write};

/// Asks for SIGTERM at the death of the launcher, if one asked for the pulse. To be called by the first thread before
/// there are others. Where another program stands between the two, as a shell that waits, the next pulse finds that
/// nobody reads it, and does the same.
///
/// # Errors
/// The signal is not to be had, or the launcher died before it was asked for: nobody reads the pulse.
pub fn follow_launcher() -> io::Result<()> {
    if !is_asked() {
        return Ok(());
    }
    set_parent_process_death_signal(Some(Signal::TERM))?;
    beat()
}

/// What to put into `AgentConfig::pulse`; none if no launcher asked.
pub fn for_launcher() -> Option<Box<dyn FnMut() + Send>> {
    is_asked().then(|| {
        Box::new(|| {
            if beat().is_err_and(|error| error.kind() == io::ErrorKind::BrokenPipe) {
                // The launcher is gone: the agent ends in order, as if it had been told to. It cannot be told twice too
                // often.
                let _ = kill_process(getpid(), Signal::TERM);
            }
        }) as Box<dyn FnMut() + Send>
    })
}

fn is_asked() -> bool {
    std::env::var_os(PULSE_ASKED).is_some_and(|value| value == "1")
}

fn beat() -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{PULSE_LINE}")?;
    out.flush()
}
