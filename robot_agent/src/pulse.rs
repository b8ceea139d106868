//! The agent's sign of life to its launcher: one line a second on standard output.
//!
//! Invariant: silent unless the launcher asked for it in the environment. Called by binaries that run one agent.

use crate::launcher::{PULSE_ASKED, PULSE_LINE};
use std::io::Write;

/// What to put into `AgentConfig::pulse`; none if no launcher asked.
pub fn for_launcher() -> Option<Box<dyn FnMut() + Send>> {
    let asked = std::env::var_os(PULSE_ASKED).is_some_and(|value| value == "1");
    asked.then(|| {
        Box::new(|| {
            let mut out = std::io::stdout().lock();
            // A launcher that is gone is no reason for a robot to stop.
            let _ = writeln!(out, "{PULSE_LINE}").and_then(|()| out.flush());
        }) as Box<dyn FnMut() + Send>
    })
}
