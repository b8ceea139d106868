//! A small factory at work for programs that are not ours: in one process, in memory, with robots of its own; or in processes of their own on
//! PostgreSQL behind the proxy, with robots as programs too.

use crate::harness::{Running, channel, free_port, midshift, until};
use crate::robots::enrolment;
use crate::rolled_out::{Robot, call, done};
use crate::room::LIMIT;
use crate::stack::Stack;
use anyhow::Context;
use midshift_core::site::DEMO;
use midshift_proto::telemetry::v1::ListRobotsRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// Robots of a factory.
const ROBOTS: usize = 4;

/// It ends with this.
pub struct Factory {
    /// Where people and programs go.
    pub address: SocketAddr,
    _one_box: Option<Running>,
    _split: Option<(Stack, Vec<Robot>)>,
}

impl Factory {
    /// `midshift dev`, which says in `dev.log` of `dir` how to go on.
    pub async fn one_box(dir: &Path) -> anyhow::Result<Self> {
        let address = free_port()?;
        let mut command = Command::new(midshift()?);
        command.args(["dev", "--speedup", "10", "--seed", "3", "--listen", &address.to_string()]);
        let running = Running::start(command.args(["--robots", &ROBOTS.to_string()]), &dir.join("dev.log"))?;
        until("the robots", Duration::from_secs(30), || async {
            let answer = TelemetryServiceClient::new(channel(address)?).list_robots(ListRobotsRequest::default()).await;
            Ok(answer.ok().filter(|page| page.get_ref().robots.len() == ROBOTS).map(|_| ()))
        })
        .await?;
        Ok(Self { address, _one_box: Some(running), _split: None })
    }

    /// The same services as processes of their own, with the sample releases.
    pub async fn split(dir: &Path) -> anyhow::Result<Self> {
        let split = with_software(dir, ROBOTS).await?;
        Ok(Self { address: split.0.public, _one_box: None, _split: Some(split) })
    }

    /// Takes the sample releases into a factory of one process with its throw-away keys, as its first lines say.
    pub fn bring_samples(&self, dir: &Path) -> anyhow::Result<()> {
        let log = std::fs::read_to_string(dir.join("dev.log"))?;
        let flag = |name: &str| {
            let mut words = log.split_whitespace().skip_while(|word| *word != name);
            words.nth(1).with_context(|| format!("dev did not say its {name}")).map(str::to_owned)
        };
        let (repository, key) = (flag("--repository")?, flag("--key")?);
        let samples = dir.join("samples").display().to_string();
        done(&["bundle", "samples", &samples, "--config-only", "--repository", &repository, "--key", &key])?;
        done(&["bundle", "push", "--server", &self.address.to_string(), &repository])
    }
}

/// A split stack that every process of knows the sample releases, with robots under launchers, `rbt-01` and so on, that believe who signed them.
pub async fn with_software(dir: &Path, robots: usize) -> anyhow::Result<(Stack, Vec<Robot>)> {
    let samples = dir.join("samples");
    let keys = samples.join("keys").display().to_string();
    done(&["bundle", "samples", &samples.display().to_string()])?;
    let stack = Stack::start(dir, DEMO, &[], &["--ota-keys", &keys]).await?;
    let (public, door) = (stack.public.to_string(), stack.robots.to_string());
    let ids: Vec<String> = (1..=robots).map(|number| format!("rbt-{number:02}")).collect();
    let mut launched = Vec::with_capacity(robots);
    for (number, id) in ids.iter().enumerate() {
        let (start, enrolment) = (format!("park-{}", number + 1), enrolment(stack.public, id).await?);
        launched.push(Robot::launch(id, &start, &dir.join(id), &samples, &door, None, enrolment.as_deref())?);
    }
    done(&["bundle", "push", "--server", &public, &samples.join("repository").display().to_string()])?;
    for id in &ids {
        until("the robot is known", LIMIT, async || {
            Ok(call(&["robot", "get", "--server", &public, id])?.status.success().then_some(()))
        })
        .await?;
    }
    // Rows of a release are its leader's, a moment after it was published.
    until("the release is known to whoever is asked", LIMIT, async || {
        let listed = (0..4).map(|_| call(&["bundle", "ls", "--server", &public]));
        let listed = listed.collect::<anyhow::Result<Vec<_>>>()?;
        Ok(listed.iter().all(|l| String::from_utf8_lossy(&l.stdout).contains("1.5.1")).then_some(()))
    })
    .await?;
    Ok((stack, launched))
}
