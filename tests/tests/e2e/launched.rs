//! A robot as it is started in earnest: `midshift launcher` keeps `midshift agent run` running from a folder of sets.

use crate::harness::{Running, Server, midshift, until};
use crate::robots::enrolment;
use crate::room::LIMIT;
use crate::secrets::heard;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::{FileRef, Sets};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::{Op, Store};
use midshift_agent::switch::{FACTORY, FailedTrial, Switch};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_agent::update::{SoftwareRow, Update};
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::manifest::{Component, ComponentKind};
use midshift_bundle::repository::{RootDraft, Signers, sign_root};
use midshift_bundle::set::SetManifest;
use midshift_core::ids::SiteId;
use midshift_core::site::{DEMO, text};
use midshift_core::time::Utc;
use midshift_core::update::UpdateState;
use midshift_durable::record as records;
use midshift_proto::telemetry::v1::GetRobotRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_sim::swarm::AGENT_FILE;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, Row};
use std::fs::File;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Seconds without a pulse after which the launcher kills.
const HANG_S: &str = "4";
/// What an agent of the next version adds to a ledger; to each kind of row it does in robot_agent/tests/agent/successor.rs.
const ADDED: &str = r#"
CREATE TABLE mood (robot TEXT PRIMARY KEY, level INTEGER NOT NULL) STRICT;
INSERT INTO mood VALUES ('rbt-01', 7);
ALTER TABLE fact ADD COLUMN mood TEXT;
ALTER TABLE lane ADD COLUMN mood TEXT;
UPDATE fact SET value = json_set(value, '$.next_version', 7, '$.update.next_version', 7), mood = 'curious' WHERE key = 'software';
INSERT INTO fact (key, value) VALUES ('mood', '{"level":7}');
"#;
/// What became of the update, and of what was added.
const LEFT: &str =
    "SELECT json_extract(value, '$.update.state') || ' ' || mood || ' ' || (SELECT level FROM mood) || ' ' ||
    (SELECT value FROM fact WHERE key = 'mood') FROM fact WHERE key = 'software'";

/// One robot's folder.
struct Machine {
    dir: tempfile::TempDir,
    site: SiteId,
}

/// A launcher and what it started; all of it is gone when the test lets it go.
struct Launched(Running);

impl Drop for Launched {
    fn drop(&mut self) {
        // A launcher that has ended has no child; its number may be another's by now.
        if self.0.has_ended().is_ok_and(|ended| !ended) {
            let _ = self.0.signal_group("KILL");
        }
    }
}

impl Machine {
    fn new() -> anyhow::Result<Self> {
        let machine = Self { dir: tempfile::tempdir()?, site: text::parse(DEMO)?.site_id().clone() };
        let key = SecretKey::of_seed([1; 32]);
        let one = || Signers { keys: vec![key.public()], threshold: 1 };
        let expires = Utc(4_000_000_000_000);
        let draft = RootDraft { version: 1, expires, root: one(), targets: one(), snapshot: one(), timestamp: one() };
        let root = sign_root(&draft, &[&key])?;
        let directive_keys = [key.public()].into_iter().map(|k| (k.id(), k)).collect();
        TrustAnchors { root, directive_keys, site: machine.site.clone() }.write(&machine.path("trust.json"))?;
        Ok(machine)
    }
    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }
    /// A set with these settings in the robot's folder.
    fn stage(&self, version: &str, behaviour: &str) -> anyhow::Result<SetManifest> {
        let mut sets = DiskSets::open(&self.path("sets"))?;
        let wanted = FileRef { digest: Digest::of_content(behaviour.as_bytes()), length: behaviour.len() as u64 };
        sets.write(&wanted, 0, behaviour.as_bytes())?;
        sets.sync(&wanted)?;
        sets.seal(&wanted)?;
        let component = Component::new("behaviour", version, ComponentKind::Config, behaviour.as_bytes());
        let set = SetManifest {
            bundle: Some(Digest::of_content(version.as_bytes())),
            version: format!("walk {version}"),
            components: [(component.name.clone(), component)].into(),
        };
        sets.stage(&set)?;
        Ok(set)
    }
    fn switch(&self, change: impl FnOnce(&mut Switch)) -> anyhow::Result<()> {
        let mut sets = DiskSets::open(&self.path("sets"))?;
        let mut switch = sets.holdings()?.switch;
        change(&mut switch);
        Ok(sets.write_switch(&mut switch)?)
    }
    /// The ledger of an agent that has just switched to this set, or has committed it.
    async fn remember(&self, set: &SetManifest, state: UpdateState) -> anyhow::Result<()> {
        let update = Update {
            state,
            bundle: Digest::of_content(b"bundle"),
            manifest_length: 1,
            rollback_floor: 0,
            set: Some(set.clone()),
            raises_floor: false,
            is_irreversible: false,
            drain_id: None,
            tries: 0,
            probation_ms: 600_000,
            reason: None,
        };
        std::fs::create_dir_all(self.path("data"))?;
        let mut store = SqliteStore::open(&self.path("data").join(AGENT_FILE)).await?;
        store.load("ring").await?;
        let row = SoftwareRow { update: Some(update), ..SoftwareRow::default() };
        Ok(store.commit(&[Op::Software(Box::new(row))]).await?)
    }
    /// Adds what an agent of the next version might have: to the ledger, the switch record and the trust file.
    async fn add_what_is_new(&self) -> anyhow::Result<()> {
        let ledger = SqliteConnectOptions::new().filename(self.path("data").join(AGENT_FILE));
        let mut ledger = ledger.connect().await?;
        sqlx::raw_sql(ADDED).execute(&mut ledger).await?;
        ledger.close().await?;
        let switch = self.path("sets").join(midshift_agent::launcher::SWITCH);
        let text = records::read(&switch)?.unwrap_or_default();
        records::write(&switch, &format!("{text}mood curious\n"))?;
        let mut trust: serde_json::Value = serde_json::from_slice(&std::fs::read(self.path("trust.json"))?)?;
        trust["next_version"] = serde_json::json!({"level": 7});
        Ok(std::fs::write(self.path("trust.json"), trust.to_string())?)
    }
    /// The launcher with an agent that dials `server`; what the robot came with ends at once and well.
    fn launch(&self, server: &str, enrolment: Option<&str>) -> anyhow::Result<Launched> {
        self.launch_by("exec ", server, enrolment)
    }
    /// As [`Machine::launch`], by a shell that becomes the agent, or waits for it.
    fn launch_by(&self, exec: &str, server: &str, enrolment: Option<&str>) -> anyhow::Result<Launched> {
        let midshift = midshift()?;
        let script = format!("test $MIDSHIFT_SET = {FACTORY} || {exec}\"$0\" \"$@\"; exit $?");
        let mut command = Command::new(&midshift);
        if let Some(secret) = enrolment {
            command.env("MIDSHIFT_ENROLL", secret);
        }
        command.arg("launcher").arg("--record").arg(self.path("tries")).arg("--sets").arg(self.path("sets"));
        command.args(["--hang", HANG_S, "--", "sh", "-c", &script]).arg(&midshift);
        command.args(["agent", "run", "--robot-id", "rbt-01", "--no-faults", "--no-stop", "--server", server]);
        command.arg("--data").arg(self.path("data")).arg("--sets").arg(self.path("sets"));
        command.arg("--trust").arg(self.path("trust.json")).process_group(0);
        Ok(Launched(Running::start(&mut command, &self.log())?))
    }
    fn log(&self) -> PathBuf {
        self.path("log")
    }
}

fn record(machine: &Machine) -> anyhow::Result<Switch> {
    Ok(Switch::read(&machine.path("sets").join(midshift_agent::launcher::SWITCH))?)
}

fn text_of(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_default()
}

/// Runs a set on probation until its launcher has put it away; what was said meanwhile.
async fn put_away(behaviour: &str) -> anyhow::Result<String> {
    let machine = Machine::new()?;
    let set = machine.stage("1.5.0", behaviour)?;
    let name = set.id().to_string();
    machine.switch(|switch| switch.try_out(&name))?;
    machine.remember(&set, UpdateState::Probation).await?;
    // Nobody listens there: what a set does to its program needs no server.
    let mut launched = machine.launch("127.0.0.1:1", None)?;
    let code = launched.0.ends().await?;
    let (said, switch) = (text_of(&machine.log()), record(&machine)?);
    anyhow::ensure!(code == Some(0), "the launcher ended with {code:?}: {said}");
    anyhow::ensure!(switch.running() == FACTORY, "{switch:?}: {said}");
    anyhow::ensure!(switch.fallen == Some(FailedTrial { set: name, tries: 2 }), "{switch:?}: {said}");
    Ok(said)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_set_that_crashes_at_its_start_is_put_away() -> anyhow::Result<()> {
    let said = put_away("crash_on_start = true\n").await?;
    assert_eq!(said.matches("crashes at its start").count(), 2, "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_set_that_hangs_on_probation_is_killed_and_put_away() -> anyhow::Result<()> {
    let said = put_away("hang_in_probation_after_ms = 1500\n").await?;
    assert_eq!(said.matches("gave no sign").count(), 2, "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_launched_robot_says_the_version_of_the_set_it_runs() -> anyhow::Result<()> {
    let machine = Machine::new()?;
    let server_dir = tempfile::tempdir()?;
    let server = Server::start(server_dir.path()).await?;
    let set = machine.stage("1.5.0", "speed_permille = 900\n")?;
    machine.switch(|switch| {
        switch.try_out(&set.id().to_string());
        switch.commit();
    })?;
    machine.remember(&set, UpdateState::Committed).await?;
    let _launched =
        machine.launch(&server.address.to_string(), enrolment(server.address, "rbt-01").await?.as_deref())?;
    assert_eq!(version_at(&server).await?, "1.5.0", "{}", text_of(&machine.log()));
    Ok(())
}

/// The version that the robot says, once it says one.
async fn version_at(server: &Server) -> anyhow::Result<String> {
    let version = until("the robot's version", LIMIT, || async {
        let mut client = TelemetryServiceClient::new(server.channel()?);
        let asked = client.get_robot(GetRobotRequest { robot_id: "rbt-01".to_owned() }).await;
        Ok(asked.ok().and_then(|robot| robot.into_inner().robot?.inventory).map(|inventory| inventory.software))
    });
    version.await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_falls_from_the_next_version_goes_on_with_the_files_that_it_left() -> anyhow::Result<()> {
    let machine = Machine::new()?;
    let server_dir = tempfile::tempdir()?;
    let server = Server::start(server_dir.path()).await?;
    let kept = machine.stage("1.5.0", "speed_permille = 900\n")?;
    let next = machine.stage("1.6.0", "crash_on_start = true\n")?;
    machine.switch(|switch| {
        switch.try_out(&kept.id().to_string());
        switch.commit();
        switch.try_out(&next.id().to_string());
    })?;
    machine.remember(&next, UpdateState::Probation).await?;
    machine.add_what_is_new().await?;
    let _launched =
        machine.launch(&server.address.to_string(), enrolment(server.address, "rbt-01").await?.as_deref())?;
    assert_eq!(version_at(&server).await?, "1.5.0", "{}", text_of(&machine.log()));
    let left = until("the ledger to say that it went back", LIMIT, || async {
        let mut ledger = SqliteConnectOptions::new().filename(machine.path("data").join(AGENT_FILE)).connect().await?;
        let left: Option<String> = sqlx::query(LEFT).fetch_one(&mut ledger).await?.try_get(0)?;
        ledger.close().await?;
        Ok(left.filter(|left| left.starts_with("rolled_back")))
    });
    assert_eq!(left.await?, "rolled_back curious 7 {\"level\":7}", "{}", text_of(&machine.log()));
    let switch = record(&machine)?;
    assert_eq!((switch.running(), switch.trial.as_ref()), (kept.id().to_string().as_str(), None));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_ends_when_its_launcher_is_killed_and_a_second_launcher_is_refused() -> anyhow::Result<()> {
    for exec in ["exec ", ""] {
        let machine = Machine::new()?;
        let set = machine.stage("1.5.0", "speed_permille = 900\n")?;
        machine.switch(|switch| {
            switch.try_out(&set.id().to_string());
            switch.commit();
        })?;
        machine.remember(&set, UpdateState::Committed).await?;
        let mut launched = machine.launch_by(exec, "127.0.0.1:1", None)?;
        // Who has the lock of its data folder lives.
        let lock = machine.path("data").join(AGENT_FILE).with_extension("lock");
        let is_free = || Ok::<_, anyhow::Error>(File::open(&lock)?.try_lock().is_ok());
        until("the agent to run", LIMIT, || async { Ok((lock.exists() && !is_free()?).then_some(())) }).await?;
        let mut second = machine.launch("127.0.0.1:1", None)?;
        assert_eq!(second.0.ends().await?, Some(1));
        launched.0.signal("KILL")?;
        launched.0.ends().await?;
        until("the agent to end", LIMIT, || async { Ok(is_free()?.then_some(())) }).await?;
        let said = text_of(&machine.log());
        assert!(said.contains("another launcher of this robot runs"), "{said}");
    }
    Ok(())
}

#[test]
fn sets_and_trust_go_together_and_a_trust_file_of_another_site_is_refused() -> anyhow::Result<()> {
    let machine = Machine::new()?;
    let run = |arguments: &[&str]| -> anyhow::Result<(Option<i32>, String)> {
        let mut command = Command::new(midshift()?);
        command.args(["agent", "run", "--robot-id", "rbt-01", "--server", "127.0.0.1:1", "--data"]);
        let ended = heard(command.arg(machine.path("data")).args(arguments))?;
        Ok((ended.status.code(), String::from_utf8_lossy(&ended.stderr).into_owned()))
    };
    let (sets, trust) = (machine.path("sets"), machine.path("trust.json"));
    let (sets, trust) = (sets.to_string_lossy(), trust.to_string_lossy());
    for half in [vec!["--sets", &*sets], vec!["--trust", &*trust], vec!["--clock-unsynced"]] {
        assert_eq!(run(&half)?.0, Some(2), "{half:?}");
    }
    let mut foreign = TrustAnchors::read(&machine.path("trust.json"))?;
    foreign.site = SiteId::parse("elsewhere")?;
    foreign.write(&machine.path("trust.json"))?;
    let (code, said) = run(&["--sets", &sets, "--trust", &trust])?;
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("elsewhere") && said.contains(machine.site.as_str()), "{said}");
    Ok(())
}
