//! The audit as its reader has it: what was asked for stands there with who asked, and what somebody changes in the database shows.

use crate::harness::{Server, command, folder, second, until};
use crate::secrets::heard;
use anyhow::{Context, bail, ensure};
use midshift_core::audit::{Head, Mark, link};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

/// Runs one statement after another on a file of SQLite that nobody uses.
const STATEMENTS: &str = "import sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
for statement in sys.argv[2:]:
    assert connection.execute(statement).rowcount >= 1, statement
connection.commit()
connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')";

fn sql(file: &Path, statements: &[&str]) -> anyhow::Result<()> {
    let python = std::env::var_os("MIDSHIFT_TEST_PYTHON")
        .context("MIDSHIFT_TEST_PYTHON is not set: run `cargo xtask test --install`")?;
    let output = Command::new(python).args(["-c", STATEMENTS]).arg(file).args(statements).output()?;
    ensure!(output.status.success(), "{statements:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}

fn call(server: &Server, arguments: &[&str]) -> anyhow::Result<Output> {
    let address = server.address.to_string();
    heard(&mut command(&[arguments, &["--server", &address]].concat())?)
}

/// What a command prints that must succeed.
fn said(server: &Server, arguments: &[&str]) -> anyhow::Result<String> {
    let output = call(server, arguments)?;
    ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

fn submit(server: &Server, task_id: &str) -> anyhow::Result<String> {
    said(server, &["task", "submit", "--task-id", task_id, "--from", "A01", "--to", "B03"])
}

/// Rows that fit, the newest first.
fn rows(server: &Server, filter: &[&str]) -> anyhow::Result<Vec<Value>> {
    let listed: Value = serde_json::from_str(&said(server, &[&["audit", "ls", "-o", "json"], filter].concat())?)?;
    Ok(listed["rows"].as_array().cloned().unwrap_or_default())
}

/// Number of the one row of task intake that fits.
fn number(server: &Server, filter: &[&str]) -> anyhow::Result<u64> {
    let rows = rows(server, &[&["--service", "task"], filter].concat())?;
    let [row] = rows.as_slice() else { bail!("{filter:?}: {rows:?}") };
    Ok(row["n"].as_str().context("a number")?.parse()?)
}

/// Actions of the rows that fit, the newest first, without those that nobody asked for.
fn actions(server: &Server, filter: &[&str]) -> anyhow::Result<Vec<String>> {
    let rows = rows(server, filter)?;
    let words = rows.iter().filter_map(|row| row["action"].as_str()).filter(|word| *word != "audit.anchor");
    Ok(words.map(str::to_owned).collect())
}

/// What `audit verify` says against it.
fn objection(server: &Server, arguments: &[&str]) -> anyhow::Result<String> {
    let output = call(server, &[&["audit", "verify"], arguments].concat())?;
    ensure!(output.status.code() == Some(1), "{output:?}");
    Ok(String::from_utf8(output.stderr)?)
}

/// Asks for this and that.
fn decide(server: &Server) -> anyhow::Result<()> {
    for task in ["T1", "T2", "T3"] {
        submit(server, task)?;
    }
    said(server, &["task", "cancel", "T1", "--reason", "not wanted", "--request-id", "c1"])?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_asked_for_stands_in_the_audit_and_an_export_of_it_holds_without_a_server() -> anyhow::Result<()> {
    let dir = folder()?;
    let mut server = Server::start(dir.path()).await?;
    decide(&server)?;
    assert_eq!(actions(&server, &["--service", "task"])?, ["task.cancel", "task.submit", "task.submit", "task.submit"]);
    assert_eq!(actions(&server, &["--subject", "task:T1"])?, ["task.cancel", "task.submit"]);
    assert_eq!(actions(&server, &["--action", "task.c", "--since", "1h"])?, ["task.cancel"]);
    assert_eq!(actions(&server, &["--actor", "nobody"])?, [""; 0]);
    assert_eq!(actions(&server, &["--robot", "r1"])?, [""; 0]);
    let heads = said(&server, &["audit", "verify", "-o", "name"])?;
    let noted: Vec<&str> = heads.lines().flat_map(|head| ["--head", head]).collect();
    let file = dir.path().join("audit.jsonl").to_string_lossy().into_owned();
    said(&server, &["audit", "export", "--out", &file])?;
    ensure!(call(&server, &["audit", "export", "--out", &file])?.status.code() == Some(1), "it wrote over an export");
    // A kill takes nothing of it away, and the chains go on.
    server.kill_and_restart().await?;
    submit(&server, "T4")?;
    said(&server, &[&["audit", "verify"], &*noted].concat())?;
    said(&server, &[&["audit", "verify", "--file", &file], &*noted].concat())?;
    let text = std::fs::read_to_string(&file)?;
    std::fs::write(&file, text.replace("not wanted", "wanted by nobody"))?;
    let objection = objection(&server, &["--file", &file])?;
    ensure!(objection.contains("task: row ") && objection.contains("was altered"), "{objection}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_changed_in_the_database_is_named_by_verify_after_the_next_start() -> anyhow::Result<()> {
    let dir = folder()?;
    let mut server = Server::start(dir.path()).await?;
    decide(&server)?;
    // The rows that nobody asks for are written at the start and then each hour.
    until("a row of each service that quotes the others", Duration::from_secs(30), || async {
        Ok((rows(&server, &["--action", "audit.anchor"])?.len() >= 3).then_some(()))
    })
    .await?;
    let heads = said(&server, &["audit", "verify", "-o", "name"])?;
    let (two, three) = (number(&server, &["--subject", "task:T2"])?, number(&server, &["--subject", "task:T3"])?);
    let last: u64 =
        heads.lines().find_map(|head| head.strip_prefix("task:")?.split_once(':')?.0.parse().ok()).context("a head")?;
    let file = server.data().join("control.db");
    let ways = [
        (
            "altered",
            vec![format!("UPDATE task_audit SET body = replace(body, 'T2', 'T9') WHERE ord = {two}")],
            format!("task: row {two} was altered"),
        ),
        (
            "deleted",
            vec![format!("DELETE FROM task_audit WHERE ord = {three}")],
            format!("task: row {three} is not there, row {} is in its place", three + 1),
        ),
        (
            "moved",
            vec![
                format!("UPDATE task_audit SET ord = -1 WHERE ord = {two}"),
                format!("UPDATE task_audit SET ord = {two} WHERE ord = {three}"),
                format!("UPDATE task_audit SET ord = {three} WHERE ord = -1"),
            ],
            format!("task: row {two} is not there, row {three} is in its place"),
        ),
        (
            "cut off",
            vec![format!("DELETE FROM task_audit WHERE ord = {last}")],
            format!("task: it ends with row {}, and the store's note of its newest row has row {last}", last - 1),
        ),
    ];
    for (how, statements, expected) in ways {
        server.kill()?;
        let kept = dir.path().join("kept.db");
        sql(&file, &[])?;
        std::fs::copy(&file, &kept)?;
        sql(&file, &statements.iter().map(String::as_str).collect::<Vec<_>>())?;
        server.restart().await?;
        let objection = objection(&server, &[])?;
        ensure!(objection.contains(&expected), "{how}: {objection}");
        server.kill()?;
        for leftover in ["control.db-wal", "control.db-shm"] {
            let _ = std::fs::remove_file(server.data().join(leftover));
        }
        std::fs::copy(&kept, &file)?;
        server.restart().await?;
        said(&server, &["audit", "verify"])?;
    }
    Ok(())
}

/// Statements that put one row in the place of a whole chain: it says of itself that all before it was old and cut.
fn forged(head: &Head) -> Vec<String> {
    let Head { n, hash: prev } = head;
    let (next, at) = (n + 1, midshift_agent::clock::wall().0);
    let said = format!(
        r#"{{"service":"identity","n":{next},"at_unix_ms":{at},"actor":"identity","action":"audit.cut","outcome":"DONE","cut":{{"n":{n},"hash":"{prev}"}}}}"#
    );
    let hash = link(prev, &said);
    let open = said.strip_suffix('}').unwrap_or(&said);
    let body = format!(r#"{open},"prev":"{prev}","hash":"{hash}"}}"#);
    let (id, columns) = (format!("{next:016}"), "site_id, id, revision, state, parent, ord, body");
    vec![
        "DELETE FROM identity_audit".to_owned(),
        format!(
            "INSERT INTO identity_audit ({columns}) SELECT site_id, '{id}', 1, 2, NULL, {next}, '{body}' FROM audit_head WHERE chain = 'identity'"
        ),
        format!("UPDATE audit_head SET n = {next}, hash = '{hash}' WHERE chain = 'identity'"),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_changed_to_look_as_if_it_was_old_and_cut_is_named_by_the_head_that_somebody_noted()
-> anyhow::Result<()> {
    let dir = folder()?;
    let mut server = Server::start(dir.path()).await?;
    until("a row of each service that quotes the others", Duration::from_secs(30), || async {
        Ok((rows(&server, &["--action", "audit.anchor"])?.len() >= 4).then_some(()))
    })
    .await?;
    let heads = said(&server, &["audit", "verify", "-o", "name"])?;
    let noted = heads.lines().find(|head| head.starts_with("identity:")).context("a head")?;
    let head = Mark::parse(noted).context("a head")?.head;
    server.kill()?;
    let file = server.data().join("control.db");
    sql(&file, &forged(&head).iter().map(String::as_str).collect::<Vec<_>>())?;
    server.restart().await?;
    let told = objection(&server, &["--head", noted])?;
    // Another chain may have quoted an earlier row, which is named first.
    let expected = format!("identity: it begins with row {}, and ", head.n + 1);
    ensure!(told.contains(&expected), "{told}");
    // An export says the same without a server.
    let file = dir.path().join("audit.jsonl").to_string_lossy().into_owned();
    said(&server, &["audit", "export", "--out", &file])?;
    let told = objection(&server, &["--file", &file, "--head", noted])?;
    ensure!(told.contains(&expected), "{told}");
    // Nobody needs to have noted anything where other chains quote it.
    let told = objection(&server, &[])?;
    ensure!(told.contains(&expected) && !told.contains("your note"), "{told}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_is_denied_stands_in_the_audit_of_the_service_that_was_asked() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let address = server.address.to_string();
    // It may approve roll-outs and see things, and bring no task in.
    let submit = ["task", "submit", "--task-id", "T1", "--from", "A01", "--to", "B03", "--server", &address];
    let denied = heard(&mut second(&submit)?)?;
    let said = String::from_utf8_lossy(&denied.stderr).into_owned();
    ensure!(denied.status.code() == Some(6) && said.contains("second may not"), "{said}");
    let list = ["audit", "ls", "-o", "json", "--action", "request.deny", "--server", &address];
    let row = until("a row of the denial", Duration::from_secs(20), async || {
        let listed: Value = serde_json::from_slice(&heard(&mut command(&list)?)?.stdout)?;
        Ok(listed["rows"].as_array().and_then(|rows| rows.first()).cloned())
    });
    let row = row.await?;
    let told = ["service", "actor", "outcome"].map(|field| row[field].as_str().unwrap_or_default());
    assert_eq!(told, ["task", "second", "NOT_PERMITTED"], "{row}");
    assert_eq!(row["with"]["path"], "/midshift.task.v1.TaskService/SubmitTask", "{row}");
    let verified = heard(&mut command(&["audit", "verify", "--server", &address])?)?;
    ensure!(verified.status.success(), "{}", String::from_utf8_lossy(&verified.stderr));
    Ok(())
}
