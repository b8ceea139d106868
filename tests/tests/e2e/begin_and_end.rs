//! How the two servers begin and end: what they refuse to begin with, what they print, and that they leave when asked to.

use crate::harness::{Running, Server, channel, midshift, until};
use crate::rolled_out::{call, done};
use anyhow::Context;
use midshift_proto::task::v1::WatchTasksRequest;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::telemetry::v1::WatchRobotsRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::fs::Permissions;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

const LIMIT: Duration = Duration::from_secs(60);

/// The exit code of a command that must end by itself, and what it said.
async fn refused(dir: &Path, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String)> {
    let log = dir.join("refused.log");
    let mut running = Running::start(Command::new(midshift()?).current_dir(dir).args(arguments), &log)?;
    let code = running.ends().await?;
    Ok((code, std::fs::read_to_string(log)?))
}

/// Where a `dev` says that it listens.
async fn printed_address(log: &Path) -> anyhow::Result<SocketAddr> {
    until("dev to print where it listens", LIMIT, || async {
        let said = std::fs::read_to_string(log).unwrap_or_default();
        let address = said.split("gRPC http://").nth(1).and_then(|rest| rest.split_whitespace().next());
        Ok(address.and_then(|a| a.parse().ok()))
    })
    .await
}

#[tokio::test]
async fn a_second_server_on_the_same_data_is_refused_and_the_first_goes_on() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let first = Server::start(dir.path()).await?;
    let data = dir.path().join("data");
    let data = data.to_str().context("a plain path")?;
    let (code, said) = refused(dir.path(), &["serve", "--data", data, "--listen", "127.0.0.1:0"]).await?;
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("is in use by another server; stop it first, or choose another directory"), "{said}");
    assert!(first.in_states(&[]).await?.is_some(), "the first one answers");
    Ok(())
}

#[tokio::test]
async fn a_data_folder_that_others_may_read_is_refused_with_what_to_type_and_serves_once_it_is_closed()
-> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let mut server = Server::start(dir.path()).await?;
    let data = dir.path().join("data");
    assert_eq!(data.metadata()?.permissions().mode() & 0o777, 0o700, "as it was made");
    server.kill()?;
    std::fs::set_permissions(&data, Permissions::from_mode(0o755))?;
    let path = data.to_str().context("a plain path")?;
    let of_both = ["--data", path, "--listen", "127.0.0.1:0"];
    for program in [&["serve", "--no-stop"][..], &["stop", "serve"]] {
        let (code, said) = refused(dir.path(), &[program, &of_both].concat()).await?;
        assert_eq!(code, Some(1), "{said}");
        assert!(said.contains("(mode 755)") && said.contains(&format!("`chmod go= {path}`")), "{said}");
    }
    std::fs::set_permissions(&data, Permissions::from_mode(0o700))?;
    server.restart().await?;
    assert!(server.in_states(&[]).await?.is_some(), "it answers");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dev_prints_its_ports_and_ends_cleanly_at_a_signal_while_streams_are_open() -> anyhow::Result<()> {
    for signal in ["INT", "TERM"] {
        let dir = tempfile::tempdir()?;
        let log = dir.path().join("dev.log");
        let mut command = Command::new(midshift()?);
        command.args(["dev", "--robots", "2", "--keep-open", "4", "--listen", "127.0.0.1:0"]);
        let mut dev = Running::start(&mut command, &log)?;
        let address = printed_address(&log).await?;
        let said = std::fs::read_to_string(&log)?;
        for part in [&*format!("metrics http://{address}/metrics"), "task submit", "robot ls", "Ctrl-C ends it."] {
            assert!(said.contains(part), "no {part} in {said}");
        }
        let mut robots = TelemetryServiceClient::new(channel(address)?);
        let mut robots = robots.watch_robots(WatchRobotsRequest::default()).await?.into_inner();
        let mut tasks = TaskServiceClient::new(channel(address)?);
        let mut tasks = tasks.watch_tasks(WatchTasksRequest::default()).await?.into_inner();
        assert!(robots.message().await?.is_some() && tasks.message().await?.is_some(), "the streams flow");
        dev.signal(signal)?;
        // Somebody who goes on reading must come to an end.
        while let Ok(Some(_)) = tasks.message().await {}
        while let Ok(Some(_)) = robots.message().await {}
        assert_eq!(dev.ends().await?, Some(0), "{signal}: {}", std::fs::read_to_string(&log)?);
        let said = std::fs::read_to_string(&log)?;
        assert!(!said.contains("error") && !said.contains("panicked"), "{signal}: {said}");
    }
    Ok(())
}

#[tokio::test]
async fn dev_ends_at_once_with_an_error_when_its_own_work_is_refused() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let list = "task_type,from_waypoint,to_waypoint,timeout_seconds\ntransport,A01,nowhere,300\n";
    std::fs::write(dir.path().join("list.csv"), list)?;
    let asked = ["dev", "--robots", "2", "--tasks", "list.csv", "--listen", "127.0.0.1:0"];
    let (code, said) = refused(dir.path(), &asked).await?;
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("the client ended before the run was over: background task refused"), "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dev_takes_the_sample_releases_with_the_keys_that_its_first_lines_name() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let log = dir.path().join("dev.log");
    let mut command = Command::new(midshift()?);
    let dev = command.args(["dev", "--robots", "2", "--keep-open", "4", "--listen", "127.0.0.1:0"]);
    let _dev = Running::start(dev, &log)?;
    let address = printed_address(&log).await?.to_string();
    let flag = async |name: &str| {
        let said = async || {
            let log = std::fs::read_to_string(&log)?;
            Ok(log.split_whitespace().skip_while(|word| *word != name).nth(1).map(str::to_owned))
        };
        until("dev to name its keys", LIMIT, said).await
    };
    let (repository, key) = (flag("--repository").await?, flag("--key").await?);
    let samples = dir.path().join("samples").display().to_string();
    done(&["bundle", "samples", &samples, "--config-only", "--repository", &repository, "--key", &key])?;
    done(&["bundle", "push", "--server", &address, &repository])?;
    let known = async || {
        let listed = call(&["bundle", "ls", "--server", &address])?;
        Ok(String::from_utf8_lossy(&listed.stdout).contains("1.5.0").then_some(()))
    };
    until("the release is known", LIMIT, known).await
}
