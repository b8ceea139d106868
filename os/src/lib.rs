//! What a program asks of the system that it runs on: the time, whether it is to end, and where it lies.
//!
//! Invariant: nothing here decides anything. Robots have it as servers do, so it imports little.

pub mod clock;

use std::future::pending;
use std::io;
use std::path::PathBuf;
use tokio::signal::unix::{SignalKind, signal};

/// Returns when the program is told to end: by Ctrl-C or SIGTERM.
pub async fn told_to_end() {
    let mut term = match signal(SignalKind::terminate()) {
        Ok(term) => term,
        Err(error) => {
            tracing::warn!(%error, "SIGTERM is not heard");
            return pending().await;
        }
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        _ = term.recv() => {}
    }
}

/// This program as it was named when it was started, so that a link to another release leads there; else where it lies.
/// Of one that was replaced on the disk it is the new one.
///
/// # Errors
/// The system does not say where it lies.
pub fn program() -> io::Result<PathBuf> {
    let named = std::env::args_os().next().map(PathBuf::from);
    if let Some(named) = named.filter(|named| named.is_absolute() && named.is_file()) {
        return Ok(named);
    }
    let program = std::env::current_exe()?;
    let named = program.to_str().and_then(|name| name.strip_suffix(" (deleted)")).map(PathBuf::from);
    Ok(named.filter(|named| named.is_file()).unwrap_or(program))
}
