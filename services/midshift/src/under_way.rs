//! The parts of a run that must last as long as it does, and what it means when one of them does not.
//!
//! Invariant: a part is waited for once; after [`UnderWay::first_end`] has given an error nothing here is used again. Called by `dev`.

use anyhow::{Context, anyhow};
use tokio::task::{JoinError, JoinHandle};

/// One part, which ends when it is told to.
pub type Part = JoinHandle<anyhow::Result<()>>;

/// All of them.
pub struct UnderWay {
    /// The server.
    pub serving: Part,
    /// The picture of tasks.
    pub following: Part,
    /// The swarm.
    pub robots: Part,
    /// The client.
    pub working: Part,
}

impl UnderWay {
    /// Waits until one of them ends, which none should; why the run is over.
    pub async fn first_end(&mut self) -> anyhow::Error {
        tokio::select! {
            end = &mut self.serving => early("the server", end),
            end = &mut self.following => early("the picture of tasks", end),
            end = &mut self.robots => early("the robots", end),
            end = &mut self.working => early("the client", end),
        }
    }
}

/// The result of a part that was told to end.
pub async fn ended(part: Part) -> anyhow::Result<()> {
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
    use super::{Part, UnderWay};
    use anyhow::bail;

    fn lasts() -> Part {
        tokio::spawn(std::future::pending())
    }

    fn all() -> UnderWay {
        UnderWay { serving: lasts(), following: lasts(), robots: lasts(), working: lasts() }
    }

    #[tokio::test]
    async fn whichever_part_ends_early_ends_the_run_with_its_name_and_its_error() {
        let fails = || tokio::spawn(async { bail!("the disk is full") });
        let wholes = [
            (UnderWay { serving: fails(), ..all() }, "the server"),
            (UnderWay { following: fails(), ..all() }, "the picture of tasks"),
            (UnderWay { robots: fails(), ..all() }, "the robots"),
            (UnderWay { working: fails(), ..all() }, "the client"),
        ];
        for (mut whole, name) in wholes {
            let error = format!("{:#}", whole.first_end().await);
            assert_eq!(error, format!("{name} ended before the run was over: the disk is full"));
        }
    }

    #[tokio::test]
    async fn a_part_that_ends_without_an_error_ends_the_run_too() {
        let mut whole = UnderWay { robots: tokio::spawn(async { Ok(()) }), ..all() };
        assert_eq!(whole.first_end().await.to_string(), "the robots ended before the run was over, without an error");
    }
}
