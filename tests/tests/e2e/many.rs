//! Tasks by the list, as a person types them: what a list may set, what is refused before anything is sent, and verbs of many tasks.

use crate::harness::{Server, folder};
use crate::rolled_out::{call, done};
use anyhow::{Context, ensure};
use midshift_proto::task::v1::TaskState;
use serde_json::Value;

/// What a command printed as JSON.
fn printed(arguments: &[&str]) -> anyhow::Result<Value> {
    let output = call(&[arguments, &["-o", "json"]].concat())?;
    ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// Exit code and words of a command that must not succeed.
fn refused(arguments: &[&str]) -> anyhow::Result<(Option<i32>, String)> {
    let output = call(arguments)?;
    ensure!(!output.status.success(), "{arguments:?} succeeded");
    Ok((output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lists_flags_and_verbs_of_many_tasks_do_what_they_say() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let address = server.address.to_string();
    let at = |arguments: &[&'static str]| -> Vec<String> {
        arguments.iter().map(|a| (*a).to_owned()).chain(["--server".to_owned(), address.clone()]).collect()
    };
    fn words(line: &[String]) -> Vec<&str> {
        line.iter().map(String::as_str).collect()
    }

    // Both ways to say how long a task may wait.
    let list = dir.path().join("orders.csv");
    std::fs::write(
        &list,
        "task_type,to_waypoint,timeout_seconds,schedule_to_start_seconds,robot_id\n\
         patrol,A01,60,,\n\
         patrol,A02,60,1,\n",
    )?;
    let path = list.to_str().context("a plain path")?;
    done(&["task", "submit", "--file", path, "--server", &address])?;
    let flagged = at(&["task", "submit", "--to", "A01", "--task-id", "FLAGGED", "--schedule-to-start", "90m"]);
    done(&words(&flagged))?;
    let read = printed(&words(&at(&["task", "get", "FLAGGED"])))?;
    ensure!(read["task"]["spec"]["scheduleToStartTimeout"] == "5400s", "{read}");

    // The one that may wait for a second goes to a person; the others wait on.
    let asks = crate::harness::until("a person to be asked", crate::room::LIMIT, async || {
        let asking = server.in_states(&[TaskState::NeedsOperator]).await?.unwrap_or_default();
        Ok((!asking.is_empty()).then_some(asking))
    })
    .await?;
    ensure!(asks.len() == 1 && asks[0].spec.as_ref().is_some_and(|spec| spec.robot_id.is_empty()), "{asks:?}");

    // A robot of which nobody knows.
    let pinned = at(&["task", "submit", "--to", "A01", "--robot", "rbt-99", "--task-id", "PINNED"]);
    let (code, said) = refused(&words(&pinned))?;
    ensure!(code == Some(4) && said.contains("rbt-99") && said.contains("--unknown-robot"), "{code:?} {said}");
    std::fs::write(&list, "task_type,to_waypoint,timeout_seconds,robot_id\npatrol,A01,60,\npatrol,A02,60,rbt-98\n")?;
    let (code, said) = refused(&["task", "submit", "--file", path, "--server", &address])?;
    ensure!(code == Some(4) && said.contains("rbt-98"), "{code:?} {said}");
    ensure!(server.in_states(&[]).await?.unwrap_or_default().len() == 3, "nothing of a refused list is stored");
    done(&[&words(&pinned)[..], &["--unknown-robot"]].concat())?;

    // Attempts that a person takes from a robot are named in full.
    let (code, said) = refused(&words(&at(&["robot", "disown", "rbt-01", "FLAGGED", "--reason", "gone"])))?;
    ensure!(code == Some(2) && said.contains("SUBJECT/EPOCH"), "{code:?} {said}");
    let (code, said) = refused(&words(&at(&["robot", "disown", "rbt-01", "FLAGGED/7", "--reason", "gone"])))?;
    ensure!(code == Some(4) && said.contains("No robot"), "{code:?} {said}");

    // All that are meant, first counted, then done.
    let resolve = at(&["task", "resolve", "--all", "--state", "needs-operator", "--as", "failed", "--reason", "late"]);
    let counted = printed(&[&words(&resolve)[..], &["--dry-run"]].concat())?;
    ensure!(counted["matched"] == 1, "{counted}");
    ensure!(server.in_states(&[TaskState::NeedsOperator]).await?.unwrap_or_default().len() == 1, "only counted");
    done(&words(&resolve))?;
    ended(&server, TaskState::Failed, 1).await?;
    let cancel = at(&["task", "cancel", "--all", "--state", "queued", "--reason", "shift is over"]);
    let counted = printed(&words(&cancel))?;
    ensure!(counted["matched"] == 3 && counted["asked"] == 3, "{counted}");
    ended(&server, TaskState::Canceled, 3).await?;
    let counted = printed(&words(&cancel))?;
    ensure!(counted["matched"].is_null() || counted["matched"] == 0, "nobody is meant any more: {counted}");
    Ok(())
}

/// Waits until so many tasks are in this state.
async fn ended(server: &Server, state: TaskState, count: usize) -> anyhow::Result<()> {
    crate::harness::until("tasks to end", crate::room::LIMIT, async || {
        Ok((server.in_states(&[state]).await?.unwrap_or_default().len() == count).then_some(()))
    })
    .await
}
