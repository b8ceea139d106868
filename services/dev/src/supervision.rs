//! Watches over the tasks of a run that must last as long as it does: one that ends early ends the run with its name
//! and its error.
//!
//! Invariant: a part is waited for once; after [`RunningTasks::first_end`] has given an error nothing here is used
//! again. Called by `dev`.

use anyhow::{Context, anyhow};
use tokio::task::{JoinError, JoinHandle};

/// One part, which ends when it is told to.
pub type Running = JoinHandle<anyhow::Result<()>>;

/// All of them.
pub struct RunningTasks {
    /// The server.
    pub serving: Running,
    /// The summary of tasks.
    pub following: Running,
    /// The swarm.
    pub robots: Running,
    /// The client.
    pub working: Running,
}

impl RunningTasks {
    /// Waits until one of them ends, which none should; why the run is over.
    pub async fn first_end(&mut self) -> anyhow::Error {
        tokio::select! {
            end = &mut self.serving => early("the server", end),
            end = &mut self.following => early("the summary of tasks", end),
            end = &mut self.robots => early("the robots", end),
            end = &mut self.working => early("the client", end),
        }
    }
}

/// The result of a part that was told to end.
pub async fn result_of(part: Running) -> anyhow::Result<()> {
    part.await.context("a part of the run broke off")?
}

fn early(what: &str, end: Result<anyhow::Result<()>, JoinError>) -> anyhow::Error {
    match end {
        Err(broke) => anyhow!(broke).context(format!("{what} broke off before the run was over")),
        Ok(Err(error)) => error.context(format!("{what} ended before the run was over")),
        Ok(Ok(())) => anyhow!("{what} ended before the run was over, without an error"),
    }
}

#[cfg(test)]
mod tests {
    use super::{Running, RunningTasks};
    use anyhow::bail;

    fn lasts() -> Running {
        tokio::spawn(std::future::pending())
    }

    fn all() -> RunningTasks {
        RunningTasks { serving: lasts(), following: lasts(), robots: lasts(), working: lasts() }
    }

    #[tokio::test]
    async fn whichever_part_ends_early_ends_the_run_with_its_name_and_its_error() {
        let fails = || tokio::spawn(async { bail!("the disk is full") });
        let wholes = [
            (RunningTasks { serving: fails(), ..all() }, "the server"),
            (RunningTasks { following: fails(), ..all() }, "the summary of tasks"),
            (RunningTasks { robots: fails(), ..all() }, "the robots"),
            (RunningTasks { working: fails(), ..all() }, "the client"),
        ];
        for (mut whole, name) in wholes {
            let error = format!("{:#}", whole.first_end().await);
            assert_eq!(error, format!("{name} ended before the run was over: the disk is full"));
        }
    }

    #[tokio::test]
    async fn a_part_that_ends_without_an_error_ends_the_run_too() {
        let mut whole = RunningTasks { robots: tokio::spawn(async { Ok(()) }), ..all() };
        assert_eq!(whole.first_end().await.to_string(), "the robots ended before the run was over, without an error");
    }
}
