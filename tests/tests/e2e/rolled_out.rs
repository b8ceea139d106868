//! Software from the release people to a robot, with nothing but what they have: the command line, a server, a launcher and its agent. The server is
//! killed on the way.

use crate::harness::{Running, Server, command, midshift, second, until};
use crate::robots::BODY_SPEED;
use crate::robots::{enrolment, keep_secrets};
use crate::room::LIMIT;
use crate::secrets::heard;
use crate::stack::tell_identity;
use anyhow::{Context, ensure};
use midshift_agent::launcher::SWITCH;
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::switch::{FACTORY, Switch};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::keys::SecretKey;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{GetRolloutRequest, ListQuarantinesRequest};
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// A launcher with what it started; all of it goes with this.
pub struct Robot {
    running: Running,
    sets: PathBuf,
}

impl Drop for Robot {
    fn drop(&mut self) {
        if self.running.has_ended().is_ok_and(|ended| !ended) {
            let _ = self.running.signal_group("KILL");
        }
    }
}

impl Robot {
    /// A robot in `home` that believes the release people of `samples`, with a line to the stop service at `stops`.
    pub fn launch(
        id: &str,
        start: &str,
        home: &Path,
        samples: &Path,
        server: &str,
        stops: Option<SocketAddr>,
        enrolment: Option<&str>,
    ) -> anyhow::Result<Self> {
        Self::start(Self::command(id, start, home, samples, server, stops, enrolment)?, home)
    }
    /// What [`Robot::launch`] starts.
    pub fn command(
        id: &str,
        start: &str,
        home: &Path,
        samples: &Path,
        server: &str,
        stops: Option<SocketAddr>,
        enrolment: Option<&str>,
    ) -> anyhow::Result<Command> {
        std::fs::create_dir_all(home)?;
        trust(samples, &text::parse(DEMO)?)?.write(&home.join("trust.json"))?;
        Self::command_in(id, start, home, server, stops, enrolment)
    }
    /// Starts what lies in `home` again, at a server without login.
    pub fn relaunch(id: &str, start: &str, home: &Path, server: &str, stops: SocketAddr) -> anyhow::Result<Self> {
        Self::start(Self::command_in(id, start, home, server, Some(stops), None)?, home)
    }
    fn command_in(
        id: &str,
        start: &str,
        home: &Path,
        server: &str,
        stops: Option<SocketAddr>,
        enrolment: Option<&str>,
    ) -> anyhow::Result<Command> {
        let (program, sets) = (midshift()?, home.join("sets"));
        let mut command = Command::new(&program);
        if let Some(secret) = enrolment {
            command.env("MIDSHIFT_ENROLL", secret);
        }
        command.arg("launcher").arg("--record").arg(home.join("tries")).arg("--sets").arg(&sets).arg("--");
        command.arg(&program).args(["agent", "run", "--robot-id", id, "--no-faults", "--server", server]);
        command.args(["--start", start, "--body-speed", BODY_SPEED]);
        command.arg("--data").arg(home.join("data")).arg("--sets").arg(&sets);
        command.arg("--trust").arg(home.join("trust.json"));
        match stops {
            Some(stops) => command.args(["--stop-server", &stops.to_string()]),
            None => command.arg("--no-stop"),
        };
        tell_identity(&mut command, server);
        Ok(command)
    }
    /// Starts what [`Robot::command`] made, or what starts that.
    pub fn start(mut command: Command, home: &Path) -> anyhow::Result<Self> {
        let running = Running::start(command.process_group(0), &home.join("log"))?;
        Ok(Self { running, sets: home.join("sets") })
    }
    /// SIGKILL to the launcher alone.
    pub fn kill_launcher(&mut self) -> anyhow::Result<()> {
        self.running.kill()
    }
    /// SIGKILL to the launcher and its agent.
    pub fn end(&mut self) -> anyhow::Result<()> {
        self.running.signal_group("KILL")?;
        self.running.kill()
    }
    /// Process id of the agent; none: the launcher is about to start it.
    pub fn agent(&self) -> anyhow::Result<Option<u32>> {
        let launcher = self.running.id();
        let children = std::fs::read_to_string(format!("/proc/{launcher}/task/{launcher}/children"))?;
        Ok(children.split_whitespace().next().map(str::parse::<u32>).transpose()?)
    }
    /// Its switch record.
    pub fn switch(&self) -> anyhow::Result<Switch> {
        Ok(Switch::read(&self.sets.join(SWITCH))?)
    }
    /// It runs a set that it has not committed.
    pub fn is_on_trial(&self) -> bool {
        // Before its first change of software there is no record.
        self.switch().is_ok_and(|switch| switch.trial.is_some())
    }
    /// Waits until it has committed this version.
    pub async fn keeps(&self, version: &str) -> anyhow::Result<()> {
        until("the robot to keep it", LIMIT, async || Ok((self.committed()?.as_deref() == Some(version)).then_some(())))
            .await
    }
    /// Version of the set that is committed.
    pub fn committed(&self) -> anyhow::Result<Option<String>> {
        let switch = self.switch()?;
        Ok(DiskSets::open(&self.sets)?.holdings()?.version(&switch.current))
    }
}

/// Where a fleet goes.
pub struct Doors {
    /// People and programs.
    pub people: SocketAddr,
    /// Where robots have their sessions.
    pub robots: SocketAddr,
    /// Their stop lines, if they have one.
    pub stops: Option<SocketAddr>,
}

/// `count` robots under launchers, each enrolled, at a site that has the releases of `samples` and knows all of them; `rbt-01` and so on, with the journals of
/// their bodies.
pub async fn fleet(
    dir: &Path,
    doors: &Doors,
    samples: &Path,
    count: usize,
) -> anyhow::Result<(Vec<Robot>, Vec<PathBuf>)> {
    let (people, door) = (doors.people.to_string(), doors.robots.to_string());
    let ids: Vec<String> = (1..=count).map(|number| format!("rbt-{number:02}")).collect();
    let mut robots = Vec::new();
    for (number, id) in ids.iter().enumerate() {
        let (start, enrolment) = (format!("park-{}", number + 1), enrolment(doors.people, id).await?);
        robots.push(Robot::launch(id, &start, &dir.join(id), samples, &door, doors.stops, enrolment.as_deref())?);
    }
    done(&["bundle", "push", "--server", &people, &samples.join("repository").display().to_string()])?;
    for id in &ids {
        until_known(&people, id, &dir.join(id)).await?;
    }
    Ok((robots, ids.iter().map(|id| dir.join(id).join("data/journal.jsonl")).collect()))
}

/// Waits until people can ask for a robot; nobody may be told its secrets from then on.
pub async fn until_known(people: &str, id: &str, home: &Path) -> anyhow::Result<()> {
    until("the robot is known", LIMIT, async || {
        Ok(call(&["robot", "get", "--server", people, id])?.status.success().then_some(()))
    })
    .await?;
    keep_secrets(&home.join("data")).await
}

/// What a robot of `site` believes that believes the release people of `samples`.
pub fn trust(samples: &Path, site: &Site) -> anyhow::Result<TrustAnchors> {
    let key = SecretKey::read(&samples.join("keys/directive-1.pem"))?.public();
    let root = std::fs::read(samples.join("repository/metadata/1.root.json"))?;
    Ok(TrustAnchors { root, directive_keys: [(key.id(), key)].into(), site: site.site_id().clone() })
}

/// The command line.
pub fn call(arguments: &[&str]) -> anyhow::Result<Output> {
    heard(&mut command(arguments)?)
}

/// Begins a roll-out that is written down: somebody else approves it.
pub fn begin_rollout(address: &str, id: &str) -> anyhow::Result<()> {
    done(&["rollout", "submit", "--server", address, id])?;
    let approved = heard(&mut second(&["rollout", "approve", "--server", address, id, "--reason", "tried at home"])?)?;
    ensure!(approved.status.success(), "{}", String::from_utf8_lossy(&approved.stderr));
    done(&["rollout", "start", "--server", address, id])
}

/// The command line, which must succeed.
pub fn done(arguments: &[&str]) -> anyhow::Result<()> {
    let output = call(arguments)?;
    ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}

#[tokio::test]
async fn a_release_reaches_a_robot_and_a_bad_one_goes_back_though_the_server_is_killed_on_the_way() -> anyhow::Result<()>
{
    let dir = tempfile::tempdir()?;
    let samples = dir.path().join("samples");
    let (folder, keys) = (samples.display().to_string(), samples.join("keys").display().to_string());
    done(&["bundle", "samples", &folder])?;
    let mut server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    let address = server.address.to_string();
    let enrolment = enrolment(server.address, "rbt-01").await?;
    let robot =
        Robot::launch("rbt-01", "park-1", &dir.path().join("robot"), &samples, &address, None, enrolment.as_deref())?;
    done(&["bundle", "push", "--server", &address, &samples.join("repository").display().to_string()])?;
    until("the robot is known", LIMIT, async || {
        Ok(call(&["robot", "get", "--server", &address, "rbt-01"])?.status.success().then_some(()))
    })
    .await?;
    let begin = |id: &str| {
        let all =
            ["--waves", "rest", "--allow-full-push", "--soak", "0s", "--probation", "1s", "--exposure-tasks", "0"];
        done(&[&["rollout", "create", "--server", &address, id][..], &all].concat())?;
        begin_rollout(&address, id)
    };
    begin("walk-1.5.0")?;
    let wait = |id: &str| call(&["rollout", "wait", "--server", &address, id, "--timeout", "120s"]);
    let waited = wait("walk-1.5.0")?;
    assert_eq!(waited.status.code(), Some(0), "{}", String::from_utf8_lossy(&waited.stderr));
    // It is told to keep it when the roll-out is completed, and does so at once.
    robot.keeps("1.5.0").await?;
    assert_eq!(robot.switch()?.previous.as_deref(), Some(FACTORY));

    begin("walk-1.6.0-bad-at-start")?;
    let mut client = RolloutServiceClient::new(server.channel()?);
    let request = GetRolloutRequest { rollout_id: "walk-1.6.0-bad-at-start".to_owned() };
    until("it was permitted to activate", LIMIT, async || {
        let rollout = client.clone().get_rollout(request.clone()).await?.into_inner().rollout.unwrap_or_default();
        Ok((rollout.counts.unwrap_or_default().attempted > 0).then_some(()))
    })
    .await?;
    // Who watches is told that the server is gone, and goes on when it is back.
    let watch = ["rollout", "watch", "--server", &address, "walk-1.6.0-bad-at-start"];
    let mut watching = command(&watch)?.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    let mut said = BufReader::new(watching.stdout.take().context("no pipe")?).lines();
    ensure!(said.next().is_some(), "nothing was said of the roll-out");
    server.kill_and_restart().await?;
    ensure!(said.all(|line| line.is_ok()), "what it said cannot be read");
    let waited = watching.wait_with_output()?;
    assert_eq!(waited.status.code(), Some(12), "{}", String::from_utf8_lossy(&waited.stderr));
    assert_eq!(robot.committed()?.as_deref(), Some("1.5.0"), "it is back on what it kept");
    assert!(robot.switch()?.trial.is_none());
    client = RolloutServiceClient::new(server.channel()?);
    let rollout = client.get_rollout(request).await?.into_inner().rollout.unwrap_or_default();
    let evidence = rollout.abort.unwrap_or_default();
    assert_eq!(evidence.reason.map(|r| r.code).as_deref(), Some("FAILURE_AMONG_FEW"));
    let quarantines = client.list_quarantines(ListQuarantinesRequest::default()).await?.into_inner().quarantines;
    assert_eq!(quarantines.len(), 1, "the robot does not get it again");
    // The same robot takes the next good one.
    begin("walk-1.5.1")?;
    let waited = wait("walk-1.5.1")?;
    assert_eq!(waited.status.code(), Some(0), "{}", String::from_utf8_lossy(&waited.stderr));
    robot.keeps("1.5.1").await?;
    Ok(())
}
