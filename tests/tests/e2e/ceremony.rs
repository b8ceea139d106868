//! docs/runbooks/keys.md as people follow it: its commands run as they stand there, from top to bottom, with OpenSSL among the signers, against a real
//! server; python-tuf, which began with the first root, goes along.

use crate::clients::text;
use crate::harness::{Server, command, midshift, sign_in};
use crate::secrets::heard;
use crate::tuf::{draft, python};
use anyhow::{Context, ensure};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::keys::{PublicKey, SecretKey};
use midshift_core::site::{DEMO, text as site_text};
use std::path::Path;
use std::process::Command;

const RUNBOOK: &str = include_str!("../../../docs/runbooks/keys.md");
const REPOSITORY: &str = "ann/repository";

/// Commands of a section, by the place where a reader does something else between them.
fn blocks(heading: &str) -> anyhow::Result<Vec<&'static str>> {
    let (_, rest) =
        RUNBOOK.split_once(&format!("\n## {heading}\n")).with_context(|| format!("no section {heading:?}"))?;
    let section = rest.split("\n## ").next().unwrap_or(rest);
    let blocks: Vec<_> = section.split("```sh\n").skip(1).filter_map(|block| block.split("```").next()).collect();
    ensure!(!blocks.is_empty(), "no commands in {heading:?}");
    Ok(blocks)
}

/// Types commands at a shell; with a server they are signed in to it.
fn follow(dir: &Path, server: Option<&Server>, block: &str) -> anyhow::Result<()> {
    let mut shell = Command::new("sh");
    shell.args(["-eu", "-c", block]).current_dir(dir);
    let program = midshift()?;
    let beside = program.parent().context("a program in a folder")?.to_owned();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let places = std::iter::once(beside).chain(std::env::split_paths(&path));
    shell.env("PATH", std::env::join_paths(places)?);
    shell.env("SITE", site_text::parse(DEMO)?.site_id().to_string());
    if let Some(server) = server {
        sign_in(&mut shell, server.address);
        shell.env("MIDSHIFT_SERVER", server.address.to_string());
    }
    let done = heard(&mut shell)?;
    ensure!(done.status.success(), "{block}\n{}", text(&done.stderr));
    Ok(())
}

/// Types all commands of a section.
fn story(dir: &Path, server: &Server, heading: &str) -> anyhow::Result<()> {
    blocks(heading)?.into_iter().try_for_each(|block| follow(dir, Some(server), block))
}

/// As [`story`], with the server started again after the first commands, so that it has read keys, and after the last, without the old ones.
async fn story_of_server_keys(dir: &Path, server: &mut Server, heading: &str) -> anyhow::Result<()> {
    let blocks = blocks(heading)?;
    let [first, rest @ ..] = &blocks[..] else { unreachable!("there are some") };
    follow(dir, Some(&*server), first)?;
    server.kill_and_restart().await?;
    rest.iter().try_for_each(|block| follow(dir, Some(&*server), block))?;
    server.kill_and_restart().await
}

/// A key that is not asked for is told so at once.
fn is_refused(dir: &Path, arguments: &[&str]) -> anyhow::Result<()> {
    let refused = heard(command(arguments)?.current_dir(dir))?;
    let said = text(&refused.stderr);
    ensure!(refused.status.code() == Some(2) && said.contains("is not asked for"), "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_runbook_of_keys_is_followed_from_their_making_through_the_loss_of_each() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let dir = dir.path();
    std::fs::create_dir(dir.join("work"))?;
    draft(dir, "1.0.0", "walks")?;
    for block in blocks("Making them")? {
        follow(dir, None, block)?;
    }
    let key = |name: &str| PublicKey::read(&dir.join("public").join(name));
    let first = TrustAnchors::read(&dir.join("trust.json"))?;
    assert_eq!(first.directive_keys.into_values().collect::<Vec<_>>(), [key("directive-1.pem")?]);

    let keys = dir.join("server-keys");
    let mut server = Server::start_with(dir, DEMO, &["--ota-keys", &keys.to_string_lossy()]).await?;
    let believes = |server: &Server| python(dir, server, "follows", REPOSITORY);
    story(dir, &server, "A release that two people sign")?;
    assert_eq!(believes(&server)?, ["root 1, targets 1"]);
    is_refused(dir, &["bundle", "sign", "--renew", "--repository", REPOSITORY, "--key", "ann/root-1.pem"])?;

    story(dir, &server, "Each year")?;
    assert_eq!(believes(&server)?, ["root 2, targets 2"]);
    story(dir, &server, "A root key is lost")?;
    assert_eq!(believes(&server)?, ["root 3, targets 3"]);
    story(dir, &server, "A targets key is lost")?;
    assert_eq!(believes(&server)?, ["root 4, targets 4"]);
    story_of_server_keys(dir, &mut server, "A key of the server is stolen").await?;
    assert_eq!(believes(&server)?, ["root 5, targets 5"]);
    story_of_server_keys(dir, &mut server, "A directive key is stolen or ends").await?;
    assert_eq!(believes(&server)?, ["root 5, targets 6"]);

    let trust = TrustAnchors::read(&dir.join("trust.json"))?;
    let held = SecretKey::read(&keys.join("directive-2.pem"))?.public();
    assert_eq!(trust.directive_keys.into_values().collect::<Vec<_>>(), [held], "the stolen key is not among them");
    let root: serde_json::Value = serde_json::from_slice(&trust.root)?;
    assert_eq!(root["signed"]["version"], 5, "a new robot begins where the others are");
    Ok(())
}
