//! What a run of several measurements comes to, and the end that somebody puts to it.

use crate::figure::Figure;
use tokio::signal::unix::{SignalKind, signal};

/// What was measured, and what could not be.
#[derive(Debug, Default)]
pub struct RunOutcome {
    /// Of the parts that could.
    pub figures: Vec<Figure>,
    /// Each part that could not, and why.
    pub failed: Vec<String>,
}

impl RunOutcome {
    /// Adds a part that was measured, or why it was not.
    pub fn add(&mut self, part: &str, measured: anyhow::Result<Vec<Figure>>) {
        match measured {
            Ok(figures) => self.figures.extend(figures),
            Err(error) => self.failed.push(format!("{part}: {error:#}")),
        }
    }
}

/// Runs `all` to its end, or to that of somebody's patience; why it ended early.
pub async fn unless_stopped(all: impl Future<Output = ()>) -> Option<String> {
    tokio::select! {
        // First, so that it listens before anything is made.
        biased;
        why = stopped() => Some(why),
        () = all => None,
    }
}

/// Waits for somebody who wants an end.
async fn stopped() -> String {
    match signal(SignalKind::terminate()) {
        Err(error) => format!("SIGTERM cannot be heard: {error}"),
        Ok(mut terminated) => tokio::select! {
            _ = tokio::signal::ctrl_c() => "the rest: interrupted".to_owned(),
            _ = terminated.recv() => "the rest: terminated".to_owned(),
        },
    }
}
