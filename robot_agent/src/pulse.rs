//! The agent's sign of life to its launcher: one line a second on standard output.
//!
//! Invariant: silent unless the launcher asked for it in the environment. Called by binaries that run one agent.

use std::io::Write;

/// Set to `1` by the launcher.
pub const ASKED: &str = "MIDSHIFT_PULSE";
/// The whole line; any other line is the program's own and passes through.
pub const LINE: &str = "\u{1}midshift-hb\n";

/// What to put into `AgentConfig::pulse`; none if no launcher asked.
pub fn for_launcher() -> Option<Box<dyn FnMut() + Send>> {
    let asked = std::env::var_os(ASKED).is_some_and(|value| value == "1");
    asked.then(|| {
        Box::new(|| {
            let mut out = std::io::stdout().lock();
            // A launcher that is gone is no reason for a robot to stop.
            let _ = out.write_all(LINE.as_bytes()).and_then(|()| out.flush());
        }) as Box<dyn FnMut() + Send>
    })
}
