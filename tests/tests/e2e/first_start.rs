//! What a new user does: starts a server, reads what it prints, signs in by that, and calls it by the line that is printed.

use crate::harness::{Running, folder, free_port, midshift, tool, until};
use anyhow::{Context, ensure};
use midshift_core::identity::Secret;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

const LIMIT: Duration = Duration::from_secs(60);
/// The last thing that is printed.
const NARROWER: &str = "Narrower tokens";

/// What stands behind a word at the begin of a line.
fn behind<'a>(said: &'a str, word: &str) -> anyhow::Result<&'a str> {
    let found = said.lines().find_map(|line| line.trim().strip_prefix(word));
    found.map(str::trim).with_context(|| format!("{word} is not in {said}"))
}

/// The command line of somebody whose sites are remembered in `dir`.
fn call(dir: &Path, token: Option<&str>, arguments: &[&str]) -> anyhow::Result<Output> {
    let mut command = Command::new(midshift()?);
    command.env("MIDSHIFT_CONTEXTS", dir.join("contexts.toml")).args(arguments);
    Ok(token.iter().fold(&mut command, |command, token| command.env("MIDSHIFT_TOKEN", token)).output()?)
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_first_start_prints_signs_in_and_calls_the_server() -> anyhow::Result<()> {
    let (dir, port) = (folder()?, free_port()?.port());
    let (mut command, log) = (Command::new(midshift()?), dir.path().join("server.log"));
    // On every address of the machine, of which none is in its certificate by itself.
    command.env("MIDSHIFT_NO_STOP", "true").args(["serve", "--listen", &format!("0.0.0.0:{port}"), "--data"]);
    let _running = Running::start(command.arg(dir.path().join("data")), &log)?;
    let printed = until("what it prints", LIMIT, async || {
        Ok(std::fs::read_to_string(&log).ok().filter(|said| said.contains(NARROWER)))
    })
    .await?;
    let token = printed.lines().map(str::trim).find(|line| line.starts_with(Secret::TOKEN)).context("a token")?;
    let login: Vec<&str> = behind(&printed, "Sign in:")?.split_whitespace().skip(1).collect();

    let output = call(dir.path(), Some(token), &login)?;
    ensure!(output.status.success() && !said(&output).contains(token), "{login:?}: {}", said(&output));
    let mode = std::fs::metadata(dir.path().join("contexts.toml"))?.permissions().mode();
    ensure!(mode & 0o777 == 0o600, "{mode:o}");
    let listed = call(dir.path(), None, &["robot", "ls"])?;
    ensure!(listed.status.success(), "signed in: {}", said(&listed));
    let contexts = call(dir.path(), None, &["context", "ls"])?;
    ensure!(said(&contexts).contains("default") && said(&contexts).contains(&port.to_string()), "{}", said(&contexts));
    ensure!(!said(&contexts).contains(token), "a token is never printed");

    let wrong = login.last().context("a digest")?.chars().rev().collect::<String>();
    let other = [&login[..login.len() - 1], &[&wrong, "--name", "other"]].concat();
    let refused = call(dir.path(), Some(token), &other)?;
    ensure!(!refused.status.success(), "it believes another root: {}", said(&refused));
    ensure!(!call(dir.path(), None, &["context", "use", "other"])?.status.success(), "it is remembered all the same");

    let tools = tool("MIDSHIFT_TEST_GRPCURL")?.parent().context("its folder")?.to_owned();
    let others = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([tools].into_iter().chain(std::env::split_paths(&others)))?;
    let mut called = Command::new("sh");
    called.arg("-c").arg(behind(&printed, "Or:")?).env("MIDSHIFT_TOKEN", token).env("PATH", path);
    let called = called.output()?;
    ensure!(called.status.success() && said(&called).contains("admin"), "{}", said(&called));

    ensure!(call(dir.path(), None, &["context", "rm", "default"])?.status.success(), "it is forgotten");
    ensure!(!call(dir.path(), None, &["robot", "ls"])?.status.success(), "nobody is signed in any more");
    // A file of tokens that others can read is told of.
    let again = call(dir.path(), Some(token), &login)?;
    ensure!(again.status.success(), "{}", said(&again));
    std::fs::set_permissions(dir.path().join("contexts.toml"), std::fs::Permissions::from_mode(0o644))?;
    let open = call(dir.path(), None, &["robot", "ls"])?;
    ensure!(open.status.success() && said(&open).contains("chmod 600"), "{}", said(&open));
    Ok(())
}
