//! The record of tries, and what the launcher tells whoever reads its errors.
//!
//! Invariant: a record that cannot be written keeps no robot from being started.

use super::start_policy::Tries;
use std::fs;
use std::io::{self, Write};
use std::path::Path;

/// Starts that did not run well. Without a record there were none.
pub(super) fn read_tries(record: &Path) -> io::Result<Tries> {
    match fs::read_to_string(record) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        text => Ok(Tries::parse(&text.unwrap_or_default())),
    }
}

/// A record that cannot be written is no reason to stop a robot, or not to start it: this launcher counts on without
/// it.
pub(super) fn keep_tries(record: &Path, tries: &Tries) {
    if let Err(error) = write_tries(record, tries) {
        report(&format!("{} cannot be written: {error}", record.display()));
    }
}

/// On the disk when this returns.
pub(super) fn write_tries(record: &Path, tries: &Tries) -> io::Result<()> {
    midshift_durable::replace(record, tries.text().as_bytes())
}

pub(super) fn report(text: &str) {
    // Nobody to tell is no reason to stop a robot.
    let _ = writeln!(io::stderr().lock(), "midshift-launcher: {text}");
}
