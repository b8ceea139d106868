//! A real agent under a real launcher is killed with SIGKILL at each step of an update that its ledger writes down, while a real server rolls
//! the update out.
//!
//! `strace` stops the agent after each call that makes its ledger or its switch record durable; what the ledger says then decides whether it is killed.

use crate::harness::{Running, Server, midshift, until};
use crate::robots::enrolment;
use crate::rolled_out::{begin_rollout, call, done};
use anyhow::{Context, ensure};
use midshift_agent::launcher::SWITCH;
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::Store;
use midshift_agent::switch::{FACTORY, Switch};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::SecretKey;
use midshift_cli::samples::{Signer, make};
use midshift_core::site::{DEMO, text};
use midshift_core::update::UpdateState;
use midshift_process::clock::clock;
use midshift_sim::swarm::AGENT_FILE;
use std::collections::VecDeque;
use std::ffi::OsString;
use std::fs;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;
use std::time::Duration;
use tokio::time::Instant;

/// An update comes to its end within this, on a machine that is busy.
const LIMIT: Duration = Duration::from_secs(90);
/// How often it is looked whether the agent stands.
const LOOK_EVERY: Duration = Duration::from_millis(3);
/// Robots at once, each with a server of its own: no area spares more than one of them.
const ROBOTS: usize = 4;
/// Steps of an update that is kept, and of one that is gone back from, as the ledger writes them down.
const KEPT: [UpdateState; 8] = [
    UpdateState::Directed,
    UpdateState::Downloading,
    UpdateState::Staged,
    UpdateState::Switching,
    UpdateState::Probation,
    UpdateState::Trial,
    UpdateState::Committing,
    UpdateState::Committed,
];
const BACK: [UpdateState; 2] = [UpdateState::RollingBack, UpdateState::RolledBack];
/// The two releases that follow each other.
const VERSIONS: [&str; 2] = ["1.5.0", "1.5.1"];

/// When the agent is killed.
#[derive(Clone, Copy, Debug)]
struct Cut {
    step: UpdateState,
    /// The step is on the disk and nothing of it is done; else at what is made durable next: the switch record, or the ledger again.
    at_once: bool,
    /// A set that was on trial at the kill ends at each start from then on: the launcher puts it away.
    dies: bool,
}

impl Cut {
    /// Both moments of each step, and once more with a set that dies where one is on trial.
    fn all() -> VecDeque<Self> {
        let steps = KEPT.into_iter().chain(BACK);
        let moments = steps.flat_map(|step| [true, false].map(|at_once| Self { step, at_once, dies: false }));
        moments
            .flat_map(|cut| [Some(cut), cut.step.is_active().then_some(Self { dies: true, ..cut })])
            .flatten()
            .collect()
    }
    fn goes_back(self) -> bool {
        BACK.contains(&self.step)
    }
}

/// A robot and its server. All of it goes with this.
struct Station {
    server: Server,
    launcher: Running,
    updates: usize,
    /// Last: what the others said lies in it.
    home: tempfile::TempDir,
}

impl Drop for Station {
    fn drop(&mut self) {
        if self.launcher.has_ended().is_ok_and(|ended| !ended) {
            let _ = self.launcher.signal_group("KILL");
        }
    }
}

/// What the agent is started with: under strace while a file asks for that, else alone. Its set and its process are written down.
fn script(home: &Path) -> String {
    let strace = std::env::var_os("MIDSHIFT_TEST_STRACE").unwrap_or_else(|| OsString::from("strace"));
    let (home, strace) = (home.display(), strace.display());
    let durable = "fsync,fdatasync,rename";
    format!(
        "cd {home}; echo $MIDSHIFT_SET >> starts; grep -qsx $MIDSHIFT_SET dying && exit 1
         echo $$ > plain; test -e armed || exec \"$@\"
         exec {strace} -f -qq -o trace -P {home}/data/{AGENT_FILE}-wal -P {home}/sets/{SWITCH}.new \
         -e trace={durable} -e inject={durable}:signal=SIGSTOP sh -c 'echo $$ > pid; exec \"$@\"' sh \"$@\""
    )
}

impl Station {
    async fn open(samples: &Path) -> anyhow::Result<Self> {
        let home = tempfile::tempdir()?;
        let keys = samples.join("keys");
        let server = Server::start_with(home.path(), DEMO, &["--ota-keys", &keys.display().to_string()]).await?;
        let address = server.address.to_string();
        done(&["bundle", "push", "--server", &address, &samples.join("repository").display().to_string()])?;
        let key = SecretKey::read(&keys.join("directive-1.pem"))?.public();
        let root = fs::read(samples.join("repository/metadata/1.root.json"))?;
        let site = text::parse(DEMO)?.site_id().clone();
        let robot = home.path().join("robot");
        fs::create_dir(&robot)?;
        TrustAnchors { root, directive_keys: [(key.id(), key)].into(), site }.write(&robot.join("trust.json"))?;
        let mut command = Command::new(midshift()?);
        command.arg("launcher").arg("--record").arg(robot.join("tries")).arg("--sets").arg(robot.join("sets"));
        command.args(["--", "sh", "-c", &script(&robot), "sh"]).arg(midshift()?);
        command.args(["agent", "run", "--robot-id", "rbt-01", "--no-faults", "--no-stop", "--server", &address]);
        command.arg("--data").arg(robot.join("data")).arg("--sets").arg(robot.join("sets"));
        command.arg("--trust").arg(robot.join("trust.json")).process_group(0);
        if let Some(secret) = enrolment(server.address, "rbt-01").await? {
            command.env("MIDSHIFT_ENROLL", secret);
        }
        let launcher = Running::start(&mut command, &robot.join("log"))?;
        let this = Self { home, server, launcher, updates: 0 };
        until("the robot is known", LIMIT, async || {
            Ok(call(&["robot", "get", "--server", &address, "rbt-01"])?.status.success().then_some(()))
        })
        .await?;
        Ok(this)
    }
    fn path(&self, name: &str) -> PathBuf {
        self.home.path().join("robot").join(name)
    }
    fn said(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_default()
    }
    fn switch(&self) -> anyhow::Result<Switch> {
        Ok(Switch::read(&self.path("sets").join(SWITCH))?)
    }
    fn version(&self, set: &str) -> anyhow::Result<Option<String>> {
        Ok(DiskSets::open(&self.path("sets"))?.holdings()?.version(set))
    }
    /// What the ledger of an agent that stands says of its update to this version. The agent has the file, so a copy is read.
    async fn state(&self, version: &str) -> anyhow::Result<Option<UpdateState>> {
        let copy = tempfile::tempdir()?;
        for name in [AGENT_FILE.to_owned(), format!("{AGENT_FILE}-wal")] {
            let from = self.path("data").join(&name);
            if from.exists() {
                fs::copy(from, copy.path().join(&name))?;
            }
        }
        let kept = SqliteStore::open(&copy.path().join(AGENT_FILE)).await?.load("").await?;
        let update = kept.ledger.software.update;
        let ours = update.filter(|u| u.set.as_ref().is_none_or(|set| set.version.ends_with(version)));
        Ok(ours.map(|u| u.state))
    }
    /// Waits until the agent stands once more than `stops` times in its process; which process, and the stops so far.
    async fn stands(&self, (process, stops): (u32, usize)) -> anyhow::Result<(u32, usize)> {
        let end = Instant::now() + LIMIT;
        let mut look = tokio::time::interval(LOOK_EVERY);
        while Instant::now() < end {
            look.tick().await;
            let Ok(now) = self.said("pid").trim().parse::<u32>() else { continue };
            let trace = self.said("trace");
            let is_stop = |line: &&str| {
                line.split_whitespace().next() == Some(&now.to_string()) && line.ends_with("--- stopped by SIGSTOP ---")
            };
            let seen = trace.lines().filter(is_stop).count();
            if seen > if now == process { stops } else { 0 } {
                return Ok((now, seen));
            }
        }
        anyhow::bail!("waited {LIMIT:?} in vain for the next thing that the agent makes durable")
    }
    /// Rolls a release out and kills the agent at the cut; the update ends all the same.
    async fn survives(&mut self, cut: Cut) -> anyhow::Result<()> {
        self.updates += 1;
        let before = self.switch()?;
        let old = self.version(&before.current)?;
        let version = VERSIONS.into_iter().find(|v| old.as_deref() != Some(v)).context("no other version")?;
        let (id, address) = (format!("update-{}", self.updates), self.server.address.to_string());
        self.begins_under_strace()?;
        let bundle = format!("walk-{version}");
        let soak = if cut.goes_back() { "1h" } else { "0s" };
        let all = ["--bundle", &bundle, "--waves", "rest", "--allow-full-push", "--soak", soak, "--probation", "1s"];
        done(&[&["rollout", "create", "--server", &address, &id, "--exposure-tasks", "0"][..], &all].concat())?;
        begin_rollout(&address, &id)?;
        let (starts, falls) = self.killed_at(cut, version, &id).await?;
        // What is started now is whole.
        let name = until("the launcher to start the agent again", LIMIT, async || {
            Ok(self.said("starts").lines().nth(starts).map(str::to_owned))
        })
        .await?;
        // One that dies may have been put away and deleted since.
        let started = Some(name).filter(|_| !falls);
        let names = [started, Some(before.current.clone()), self.switch()?.kept().map(str::to_owned)];
        for set in names.into_iter().flatten().filter(|name| name != FACTORY) {
            self.is_whole(&set)?;
        }
        let waited = call(&["rollout", "wait", "--server", &address, &id, "--for", "ended", "--timeout", "90s"])?;
        // A set may fall after its wave was judged: then the roll-out was completed with it.
        let codes = if falls { [Some(12), Some(0)] } else { [Some(if cut.goes_back() { 12 } else { 0 }); 2] };
        ensure!(codes.contains(&waited.status.code()), "{}", String::from_utf8_lossy(&waited.stderr));
        until("the switch record to be that of the end", LIMIT, async || {
            Ok(self.switch()?.trial.is_none().then_some(()))
        })
        .await?;
        let after = self.switch()?;
        let now = self.version(&after.current)?;
        let end = if cut.goes_back() || falls { UpdateState::RolledBack } else { UpdateState::Committed };
        if end == UpdateState::RolledBack {
            ensure!(
                (&after.current, &after.previous) == (&before.current, &before.previous),
                "{before:?} became {after:?}"
            );
        } else {
            ensure!(now.as_deref() == Some(version), "{version} was to be kept and {now:?} is");
            ensure!(after.previous.as_ref() == Some(&before.current), "{before:?} became {after:?}");
        }
        if after.current != FACTORY {
            self.is_whole(&after.current)?;
        }
        until("the ledger to say what the server was told", LIMIT, async || {
            // The agent runs: a copy that is torn is made again.
            Ok((self.state(version).await.ok().flatten() == Some(end)).then_some(()))
        })
        .await?;
        if falls {
            fs::remove_file(self.path("dying"))?;
        }
        if falls && !cut.goes_back() {
            // It counts against the bundle, which this robot would not be given again.
            until("the quarantine to be lifted", LIMIT, async || {
                let lifted = call(&["quarantine", "lift", "--server", &address, "rbt-01", &bundle])?;
                Ok(lifted.status.success().then_some(()))
            })
            .await?;
        }
        Ok(())
    }
    fn is_whole(&self, set: &str) -> anyhow::Result<()> {
        let id: Digest = set.parse().map_err(|e| anyhow::anyhow!("{set}: {e:?}"))?;
        DiskSets::open(&self.path("sets"))?.verify(&id).with_context(|| format!("{set} cannot be started"))
    }
    /// The agent that runs without it is killed, and its launcher starts it under strace.
    fn begins_under_strace(&self) -> anyhow::Result<()> {
        fs::write(self.path("pid"), "")?;
        fs::write(self.path("armed"), "")?;
        kill("KILL", self.said("plain").trim().parse()?)
    }
    /// Lets the agent go on from stop to stop up to the cut; how often it had been started then, and whether its set dies from then on.
    async fn killed_at(&self, cut: Cut, version: &str, id: &str) -> anyhow::Result<(usize, bool)> {
        let (mut at, mut is_there, mut is_aborted, mut has_begun) = ((0, 0), false, false, false);
        loop {
            at = self.stands(at).await?;
            let state = self.state(version).await?;
            // Before its first step the ledger may say how the last update to the same version ended.
            has_begun |= state == Some(UpdateState::Directed);
            let comes = has_begun && state == Some(cut.step);
            if is_there || (comes && cut.at_once) {
                break;
            }
            is_there = comes;
            kill("CONT", at.0)?;
            if cut.goes_back() && !is_aborted && state == Some(UpdateState::Trial) {
                is_aborted = true;
                done(&["rollout", "abort", "--server", &self.server.address.to_string(), id])?;
            }
        }
        let starts = self.said("starts").lines().count();
        fs::remove_file(self.path("armed"))?;
        let trial = self.switch()?.trial.filter(|_| cut.dies);
        if let Some(trial) = &trial {
            fs::write(self.path("dying"), format!("{}\n", trial.set))?;
        }
        kill("KILL", at.0)?;
        Ok((starts, trial.is_some()))
    }
}

fn kill(signal: &str, process: u32) -> anyhow::Result<()> {
    let sent = Command::new("kill").args(["-s", signal, &process.to_string()]).output()?;
    ensure!(sent.status.success(), "kill -s {signal} {process}: {}", String::from_utf8_lossy(&sent.stderr));
    Ok(())
}

/// One robot's part of the cuts; how many.
async fn suffers(samples: &Path, cuts: &Mutex<VecDeque<Cut>>) -> anyhow::Result<usize> {
    let mut station = Station::open(samples).await?;
    let next = || cuts.lock().expect("nobody panics with it").pop_front();
    let mut survived = 0;
    while let Some(cut) = next() {
        let outcome = station.survives(cut).await;
        outcome.with_context(|| format!("killed at {cut:?}: {}", station.said("log")))?;
        survived += 1;
    }
    Ok(survived)
}

#[test]
fn killed_at_each_step_that_its_ledger_writes_down_an_agent_starts_from_a_whole_set_and_its_update_ends() {
    let dir = tempfile::tempdir().expect("a folder");
    let samples = dir.path().join("samples");
    // Settings only: the program stays the one that the script starts.
    make(&samples, None, Signer::Throwaway, clock(1000).now().wall).expect("makes samples");
    let cuts = Mutex::new(Cut::all());
    let robot = || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(suffers(&samples, &cuts))
    };
    let survived = std::thread::scope(|scope| {
        let robots: Vec<_> = (0..ROBOTS).map(|_| scope.spawn(robot)).collect();
        let ends = robots.into_iter().map(|robot| robot.join().expect("does not panic"));
        ends.collect::<anyhow::Result<Vec<usize>>>()
    });
    let survived: usize = survived.unwrap_or_else(|e| panic!("{e:?}")).into_iter().sum();
    println!("{survived} of {} cuts at steps of the ledger: each update ended", Cut::all().len());
    assert_eq!(survived, Cut::all().len());
}
