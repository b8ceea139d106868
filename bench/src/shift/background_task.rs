//! Work beside a shift that goes on until it is told to end: what ends it early ends the shift.
//!
//! Invariant: a panic or an error of such work is never dropped.

use anyhow::anyhow;
use tokio::task::{JoinError, JoinHandle};
use tokio_util::sync::CancellationToken;

/// A task that runs until it is told to end.
pub struct BackgroundTask {
    name: &'static str,
    ends: CancellationToken,
    task: JoinHandle<anyhow::Result<()>>,
}

impl BackgroundTask {
    /// Starts `work`, which ends by itself once the token that it gets is cancelled.
    pub fn spawn<W>(name: &'static str, work: impl FnOnce(CancellationToken) -> W) -> Self
    where
        W: Future<Output = anyhow::Result<()>> + Send + 'static,
    {
        let ends = CancellationToken::new();
        Self { name, task: tokio::spawn(work(ends.clone())), ends }
    }

    /// Resolves with why, if the work ends although nobody told it to.
    pub async fn await_failure(&mut self) -> anyhow::Error {
        let ended = (&mut self.task).await;
        explain_end(self.name, ended).err().unwrap_or_else(|| anyhow!("{} ended by itself", self.name))
    }

    /// Tells the work to end, and waits until it has.
    ///
    /// # Errors
    /// What it ended with instead, if it had ended before.
    pub async fn stop(self) -> anyhow::Result<()> {
        self.ends.cancel();
        explain_end(self.name, self.task.await)
    }
}

fn explain_end(name: &str, ended: Result<anyhow::Result<()>, JoinError>) -> anyhow::Result<()> {
    match ended {
        Ok(result) => result.map_err(|error| error.context(format!("{name} failed"))),
        Err(error) => Err(anyhow!("{name} panicked: {}", panic_message(error))),
    }
}

/// What a panic said, as far as it said it in words.
fn panic_message(error: JoinError) -> String {
    let Ok(panic) = error.try_into_panic() else { return "it was aborted".to_owned() };
    let words = panic.downcast_ref::<String>().cloned();
    words.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned())).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::ensure;

    #[tokio::test]
    async fn a_panic_or_an_error_is_told_whether_or_not_the_work_was_to_end() {
        let mut task = BackgroundTask::spawn("the planner", |_| async { panic!("no such row") });
        let told = task.await_failure().await.to_string();
        assert_eq!(told, "the planner panicked: no such row");
        let fails = |ends: CancellationToken| async move {
            ends.cancelled().await;
            ensure!(!ends.is_cancelled(), "its map is outdated");
            Ok(())
        };
        let told = BackgroundTask::spawn("the planner", fails).stop().await.expect_err("it failed");
        assert_eq!(format!("{told:#}"), "the planner failed: its map is outdated");
        let mut task = BackgroundTask::spawn("the planner", |_| async { Ok(()) });
        assert_eq!(task.await_failure().await.to_string(), "the planner ended by itself");
        let waits = |ends: CancellationToken| async move {
            ends.cancelled().await;
            Ok(())
        };
        assert!(BackgroundTask::spawn("the planner", waits).stop().await.is_ok(), "as it was told to");
    }
}
