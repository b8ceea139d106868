//! Batches of ten thousand small items, as grpcurl, Python and Go send them: one frame an item, faster than a store commits.

use crate::clients::text;
use crate::harness::{Server, authority, sign_in, token, tool};
use crate::languages::Language;
use anyhow::{Context, ensure};
use midshift_core::limits;
use std::fmt::Write as _;
use std::fs::File;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;

/// Batches of each client.
const ROUNDS: usize = 5;

/// grpcurl with all items on its standard input.
fn grpcurl(dir: &Path, address: SocketAddr, prefix: &str) -> anyhow::Result<Command> {
    let mut items = String::new();
    for i in 0..limits::SUBMIT_ITEMS_MAX {
        writeln!(
            items,
            r#"{{"item":{{"request_id":"{prefix}-{i}","flat":{{"task_type":"transport","to_waypoint":"B03","timeout_seconds":600}}}}}}"#
        )?;
    }
    let path = dir.join(format!("{prefix}.json"));
    std::fs::write(&path, items)?;
    let mut command = Command::new(tool("MIDSHIFT_TEST_GRPCURL")?);
    command.arg("-cacert").arg(authority(address)?);
    command.args(["-H", &format!("authorization: Bearer {}", token(address).context("a login")?)]);
    command.args(["-max-time", "60", "-d", "@", &address.to_string(), "midshift.task.v1.TaskService/SubmitTasks"]);
    command.stdin(File::open(path)?);
    Ok(command)
}

/// Runs a client to its end; what it printed.
fn said(what: &str, command: &mut Command) -> anyhow::Result<String> {
    let ran = command.output().with_context(|| what.to_owned())?;
    ensure!(ran.status.success(), "{what}: {}", text(&ran.stderr));
    Ok(text(&ran.stdout))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_thousand_small_items_are_admitted_from_each_foreign_client_every_time() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let server = Server::start(dir.path()).await?;
    let (address, all) = (server.address, limits::SUBMIT_ITEMS_MAX);
    for round in 0..ROUNDS {
        let prefix = format!("grpcurl-{round}");
        let answer = said(&prefix, &mut grpcurl(dir.path(), address, &prefix)?)?;
        assert_eq!(answer.matches(r#""taskId""#).count(), all, "{prefix}");
        for language in [Language::Python, Language::Go] {
            let prefix = format!("{language:?}-{round}");
            let mut command = language.batch(&[&address.to_string(), &prefix, &all.to_string()])?;
            sign_in(&mut command, address);
            assert_eq!(said(&prefix, &mut command)?.trim(), format!("admitted {all}"), "{prefix}");
        }
    }
    Ok(())
}
