//! A small factory at work for programs that are not ours, over TLS and with enrolled robots that are programs of their own: in one process, or in several on
//! PostgreSQL behind the proxy.

use crate::harness::{Server, until};
use crate::rolled_out::{Doors, Robot, call, done, fleet};
use crate::room::LIMIT;
use crate::stack::Stack;
use midshift_core::site::DEMO;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Robots of a factory.
const ROBOTS: usize = 4;

/// It ends with this.
pub struct Factory {
    /// Where people and programs go.
    pub address: SocketAddr,
    _one_box: Option<(Server, Vec<Robot>)>,
    _split: Option<(Stack, Vec<Robot>)>,
}

impl Factory {
    /// One server, with the sample releases.
    pub async fn one_box(dir: &Path) -> anyhow::Result<Self> {
        let samples = dir.join("samples");
        let keys = samples.join("keys").display().to_string();
        done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
        let server = Server::start_with(dir, DEMO, &["--ota-keys", &keys]).await?;
        let doors = Doors { people: server.address, robots: server.address, stops: None };
        let (robots, _) = fleet(dir, &doors, &samples, ROBOTS).await?;
        Ok(Self { address: server.address, _one_box: Some((server, robots)), _split: None })
    }

    /// The same services as processes of their own, with the sample releases.
    pub async fn split(dir: &Path) -> anyhow::Result<Self> {
        let (stack, robots, _) = with_software(dir, ROBOTS).await?;
        Ok(Self { address: stack.public, _one_box: None, _split: Some((stack, robots)) })
    }
}

/// A split stack that every process of knows the sample releases, with robots under launchers, `rbt-01` and so on, that believe who signed them, and the journals
/// of their bodies.
pub async fn with_software(dir: &Path, robots: usize) -> anyhow::Result<(Stack, Vec<Robot>, Vec<PathBuf>)> {
    let samples = dir.join("samples");
    let keys = samples.join("keys").display().to_string();
    done(&["bundle", "samples", &samples.display().to_string()])?;
    let stack = Stack::start(dir, DEMO, &[], &["--ota-keys", &keys]).await?;
    let doors = Doors { people: stack.public, robots: stack.robots, stops: None };
    let (launched, journals) = fleet(dir, &doors, &samples, robots).await?;
    let public = stack.public.to_string();
    // Rows of a release are its leader's, a moment after it was published.
    until("the release is known to whoever is asked", LIMIT, async || {
        let listed = (0..4).map(|_| call(&["bundle", "ls", "--server", &public]));
        let listed = listed.collect::<anyhow::Result<Vec<_>>>()?;
        Ok(listed.iter().all(|l| String::from_utf8_lossy(&l.stdout).contains("1.5.1")).then_some(()))
    })
    .await?;
    Ok((stack, launched, journals))
}
