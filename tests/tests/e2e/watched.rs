//! Whoever watches from a terminal goes on watching when the server is killed and starts again: nothing is missed, and no change is said twice.

use crate::harness::{Running, Server, command, folder, until};
use crate::robots::{Robots, with_robots};
use crate::rolled_out::done;
use crate::room::LIMIT;
use anyhow::ensure;
use midshift_core::site::DEMO;
use std::path::Path;

/// What a command line says when its stream was cut.
const CUT: &str = "the server ended the stream";

/// Lines that begin with this word, before the stream was cut first and behind it.
fn lines(log: &Path, word: &str) -> anyhow::Result<(Vec<String>, Vec<String>)> {
    let said = std::fs::read_to_string(log)?;
    let (before, behind) = said.split_once(CUT).unwrap_or((&said, ""));
    let of = |part: &str| part.lines().filter(|line| line.starts_with(word)).map(str::to_owned).collect();
    Ok((of(before), of(behind)))
}

/// Waits until the log at this path has a line that begins with `word`, behind the cut or not.
async fn says(log: &Path, word: &str, behind: bool) -> anyhow::Result<()> {
    until(&format!("{word} in {}, behind the cut: {behind}", log.display()), LIMIT, async || {
        let (early, late) = lines(log, word)?;
        let said = if behind { late } else { early };
        Ok((!said.is_empty()).then_some(()))
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn watches_of_the_command_line_go_on_after_the_server_was_killed_without_a_change_said_twice()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, 1)?;
    let mut server = Server::start_for(dir.path(), &site).await?;
    let address = server.address.to_string();
    let _robots = Robots::start(dir.path(), server.address, server.address, &site).await?;
    done(&["robot", "cordon", "rbt-01", "--reason", "waits", "--server", &address])?;
    done(&["task", "submit", "--server", &address, "--task-id", "T1", "--from", "A01", "--to", "B03"])?;
    let (tasks, robots) = (dir.path().join("tasks.log"), dir.path().join("robots.log"));
    let _task_watch = Running::start(&mut command(&["task", "watch", "--server", &address])?, &tasks)?;
    let _robot_watch = Running::start(&mut command(&["robot", "watch", "rbt-01", "--server", &address])?, &robots)?;
    says(&tasks, "T1", false).await?;
    says(&robots, "rbt-01", false).await?;
    // Said after the tasks that were there, so that from here on it has something to go on from.
    done(&["task", "submit", "--server", &address, "--task-id", "T2", "--from", "A01", "--to", "B03"])?;
    says(&tasks, "T2", false).await?;
    server.kill()?;
    for log in [&tasks, &robots] {
        until("word of the cut", LIMIT, async || Ok(std::fs::read_to_string(log)?.contains(CUT).then_some(()))).await?;
    }
    server.restart().await?;
    done(&["task", "cancel", "T1", "--reason", "not needed", "--server", &address])?;
    // It is canceled when fleet has heard of it, which may be after the answer.
    says(&tasks, "T1", true).await?;
    // What is said twice is said before this.
    done(&["task", "submit", "--server", &address, "--task-id", "T3", "--from", "A01", "--to", "B03"])?;
    says(&tasks, "T3", true).await?;
    says(&robots, "rbt-01", true).await?;
    let (early, late) = lines(&tasks, "T")?;
    ensure!(early.len() == 2 && late.len() == 2, "each change once: {early:?} and then {late:?}");
    ensure!(late[0].starts_with("T1") && late[0].contains("CANCELED"), "{late:?}");
    Ok(())
}
