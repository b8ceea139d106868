//! `dev --scenario update-midshift`: a fleet at work gets a good release in waves, and then three bad ones that must not get past their canary.
//!
//! Some of the robots are real launcher and agent processes, the others live in this process. Bodies work `--speedup` times as fast as real; clocks
//! are real in all processes, so their journals can be judged together. Invariant: what is judged comes from the robots themselves (heartbeats,
//! journals, switch records) wherever they can tell it; the report says where each figure is from.

mod budget;
mod played;
mod watch;

pub use played::Story;

use crate::task_summary::{SharedTasks, read_tasks};
use anyhow::{Context, ensure};
use midshift_agent::switch::Switch;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_cli::samples::{self, Signer};
use midshift_core::ids::{AreaId, RobotId, WaypointId};
use midshift_core::time::Utc;
use midshift_proto::fleet::v1::GetAreaPolicyRequest;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::rollout_wave::Size;
use played::{Played, all, evidence, medians, short, verdict};
use rustix::process::{Pid, Signal, kill_process_group};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;
use tokio::process::{Child, Command};
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
pub use watch::Sight;
use watch::{FirstRuns, LOOK_EVERY, Watcher};

/// Robots that are processes of their own, unless the fleet is too small for it.
pub const LAUNCHED: usize = 5;
/// A roll-out that takes longer is given up, real time.
const LONGEST: Duration = Duration::from_secs(1_200);
/// All robots must be at work within this, real time.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// Software that was permitted within a permission's life begins to run so much later at most, milliseconds.
const START_TAKES_MS: i64 = 2_000;
/// Robots must come to what the end of a roll-out tells them to run within this, real time.
const SETTLES_WITHIN: Duration = Duration::from_secs(60);
/// What a robot runs that may still go back.
const ON_TRIAL: &str = "on trial";
/// The fleet works so long before the first roll-out, real time: what it does meanwhile stands beside what it does later.
const WORKS_BEFORE: Duration = Duration::from_secs(20);
/// A launched robot that was asked to end has so long, real time.
const ENDS_WITHIN: Duration = Duration::from_secs(10);
/// A launched robot that gives no sign for so many seconds is killed by its launcher.
const HANG_S: &str = "8";

/// Which story `dev` plays.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Scenario {
    /// A good release over the whole fleet, then one bad at its start, one that hangs on probation, one bad only with a load.
    UpdateMidshift,
}

/// A bundle that a story rolls out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Release {
    /// All robots keep it.
    Good,
    /// Its program ends at its start.
    BadAtStart,
    /// Its program hangs on probation.
    Hangs,
    /// It goes wrong only while it carries something.
    BadWithLoad,
}

impl Release {
    const fn version(self) -> &'static str {
        match self {
            Self::Good => "1.5.0",
            Self::BadAtStart => "1.6.0-bad-at-start",
            Self::Hangs => "1.6.1-hangs",
            Self::BadWithLoad => "1.6.2-bad-with-load",
        }
    }
    fn is_good(self) -> bool {
        self == Self::Good
    }
    /// Tasks on trial that a robot is judged by. What is bad only now and then needs more than the breaker's three.
    const fn exposure_tasks(self) -> u64 {
        if matches!(self, Self::BadWithLoad) { 12 } else { 2 }
    }
    fn label(self) -> String {
        format!("{}-{}", samples::NAME, self.version())
    }
}

/// What the stage needs.
pub struct Stage {
    /// Host and port of the server.
    pub server: String,
    /// Host and port of the stop service.
    pub stop_server: String,
    /// The way to it.
    pub channel: Channel,
    /// What is looked at.
    pub sight: Sight,
    /// Its tasks as their rows say it.
    pub tasks: SharedTasks,
    /// What is rolled out, in this order.
    pub releases: Vec<Release>,
    /// Probation and soak of each roll-out, milliseconds of site time, which is real time here.
    pub watched_ms: u64,
    /// Nothing goes wrong with bodies by itself.
    pub no_faults: bool,
    /// Where everything lies that the launched robots keep.
    pub folder: PathBuf,
    /// Robots in this process.
    pub in_process: usize,
    /// Robots to launch, and where each starts.
    pub launched: Vec<(RobotId, WaypointId)>,
    /// Whom they believe.
    pub trust: TrustAnchors,
    /// The repository to sign in, and its targets key.
    pub repository: (PathBuf, PathBuf),
    /// Decides bodies.
    pub seed: u64,
    /// How many times as fast as real bodies work.
    pub body_speed: f64,
    /// Journals of all its bodies.
    pub journals: Vec<PathBuf>,
    /// The file of the site, if it is not the built-in one.
    pub site: Option<PathBuf>,
}

/// Launched robots; all end with this.
pub struct Launched(Vec<Child>);

impl Stage {
    fn robots(&self) -> usize {
        self.in_process + self.launched.len()
    }

    /// Plays all acts with the robots that were launched, which end with it.
    ///
    /// # Errors
    /// A step that could not be taken at all; what went wrong on stage is in the story.
    pub async fn play(
        &self,
        mut launched: Launched,
        stop: CancellationToken,
        say: &(dyn Fn(&str) + Sync),
    ) -> anyhow::Result<Story> {
        let story = tokio::select! {
            () = stop.cancelled() => Err(anyhow::anyhow!("ended before the story was over")),
            story = self.acts(say) => story,
        };
        launched.end().await;
        story
    }

    async fn acts(&self, say: &(dyn Fn(&str) + Sync)) -> anyhow::Result<Story> {
        self.until_at_work().await?;
        say(&format!("{} robots at work, {} of them processes of their own", self.robots(), self.launched.len()));
        let (at_work, rest) = (self.sight.clock.now().utc, tokio::time::sleep(WORKS_BEFORE));
        self.publish().await?;
        rest.await;
        let before = self.per_hour(at_work);
        say(&format!("{before:.0} tasks an hour before the first roll-out"));
        let mut story = Story {
            robots_in_process: self.in_process,
            robots_launched: self.launched.len(),
            body_speed: self.body_speed,
            tasks_per_hour_before: before,
            acts: Vec::new(),
        };
        let watcher = Watcher::begin(self.sight.clone(), self.permille().await?);
        for release in &self.releases {
            let bad = if release.is_good() { "" } else { ", which is bad" };
            say(&format!("rolling out {}{bad}", release.label()));
            let played = self.act(*release, &watcher).await?;
            played.lines().iter().for_each(|line| say(line));
            story.acts.push(played);
        }
        Ok(story)
    }

    /// Tasks that succeeded since then, as so many an hour.
    fn per_hour(&self, since: Utc) -> f64 {
        read_tasks(&self.tasks, |tasks| tasks.per_hour(since, self.sight.clock.now().utc))
    }

    /// Starts the robots that are processes of their own: before there is work, which waits for them too.
    ///
    /// # Errors
    /// A process that cannot be started.
    pub fn launch(&self) -> anyhow::Result<Launched> {
        let program = std::env::current_exe().context("finding this program")?;
        let mut launched = Launched(Vec::new());
        for (robot_id, start) in &self.launched {
            let home = self.home(robot_id);
            std::fs::create_dir_all(&home).with_context(|| format!("making {}", home.display()))?;
            self.trust.write(&home.join("trust.json"))?;
            let log = std::fs::File::create(home.join("log")).context("making a robot's log")?;
            let mut command = Command::new(&program);
            command.arg("launcher").arg("--record").arg(home.join("tries")).arg("--sets").arg(home.join("sets"));
            command.args(["--hang", HANG_S, "--"]).arg(&program).args([
                "agent",
                "run",
                "--robot-id",
                robot_id.as_str(),
            ]);
            command.args(["--server", &self.server, "--stop-server", &self.stop_server]);
            command.args(["--start", start.as_str(), "--person"]);
            command.args(["--seed", &self.seed.to_string(), "--body-speed", &self.body_speed.to_string()]);
            if self.no_faults {
                command.arg("--no-faults");
            }
            command.arg("--data").arg(&home).arg("--sets").arg(home.join("sets"));
            command.arg("--trust").arg(home.join("trust.json"));
            if let Some(site) = &self.site {
                command.arg("--site").arg(site);
            }
            let errors = log.try_clone().context("sharing a robot's log")?;
            command.stdin(Stdio::null()).stdout(log).stderr(errors).process_group(0);
            launched.0.push(command.spawn().with_context(|| format!("starting {}", program.display()))?);
        }
        Ok(launched)
    }

    /// Folder of a launched robot; its journal is in it, as one of this process would be.
    fn home(&self, robot_id: &RobotId) -> PathBuf {
        self.folder.join(robot_id.as_str())
    }

    async fn until_at_work(&self) -> anyhow::Result<()> {
        let all = self.robots();
        let ready = async {
            loop {
                let heard = self.sight.board.all();
                if heard.len() == all && heard.iter().filter(|(_, l)| l.report.vitals.odometer_mm > 0).count() * 2 > all
                {
                    return;
                }
                tokio::time::sleep(LOOK_EVERY).await;
            }
        };
        let heard = || self.sight.board.all().len();
        let waited = tokio::time::timeout(READY_WITHIN, ready).await;
        waited.map_err(|_| anyhow::anyhow!("only {} of {all} robots were heard at work", heard()))
    }

    /// Builds, signs and pushes the samples, the last with the program that a person would use.
    async fn publish(&self) -> anyhow::Result<()> {
        let (repository, key) = (self.repository.0.clone(), self.repository.1.clone());
        let (folder, now) = (self.folder.join("samples"), self.sight.clock.now().wall);
        let signed = repository.clone();
        let make =
            move || samples::make(&folder, None, Signer::Named { repository: &signed, key: &key }, now).map(drop);
        tokio::task::spawn_blocking(make).await.context("making the samples")??;
        let program = std::env::current_exe().context("finding this program")?;
        let mut push = Command::new(program);
        push.args(["bundle", "push", "--server", &self.server]).arg(&repository).stdin(Stdio::null());
        let pushed = push.output().await.context("pushing the samples")?;
        ensure!(pushed.status.success(), "pushing the samples: {}", String::from_utf8_lossy(&pushed.stderr));
        Ok(())
    }

    /// Of a thousand robots of each area, so many may be out of work at once.
    async fn permille(&self) -> anyhow::Result<BTreeMap<AreaId, usize>> {
        let mut client = FleetServiceClient::new(self.channel.clone());
        let mut permille = BTreeMap::new();
        for area in self.sight.site.areas() {
            let request = GetAreaPolicyRequest { area_id: area.area_id.to_string() };
            let policy = client.get_area_policy(request).await?.into_inner().policy.unwrap_or_default();
            let software = policy.software.unwrap_or_default().off_work_permille;
            let software =
                software.with_context(|| format!("the rules of {} do not say their budget", area.area_id))?;
            permille.insert(area.area_id.clone(), software as usize);
        }
        Ok(permille)
    }

    async fn act(&self, release: Release, watcher: &Watcher) -> anyhow::Result<Played> {
        let mut client = RolloutServiceClient::new(self.channel.clone());
        let rollout_id = release.label();
        let before = self.versions().await?;
        let watched = duration(self.watched_ms);
        let wave = |size| v1::RolloutWave { size: Some(size) };
        let spec = v1::RolloutSpec {
            bundle: rollout_id.clone(),
            waves: vec![wave(Size::Count(1)), wave(Size::Percent(25)), wave(Size::Rest(true))],
            soak: Some(watched),
            probation: Some(watched),
            exposure_tasks: Some(release.exposure_tasks()),
            ..v1::RolloutSpec::default()
        };
        let (begun, begun_utc) = (tokio::time::Instant::now(), self.sight.clock.now().utc);
        let id = rollout_id.clone();
        client.create_rollout(v1::CreateRolloutRequest { rollout_id: id.clone(), spec: Some(spec) }).await?;
        let (etag, reason) = (String::new(), "the story".to_owned());
        let submit = v1::SubmitRolloutRequest { rollout_id: id.clone(), etag: etag.clone(), reason: reason.clone() };
        client.submit_rollout(submit).await?;
        let approve = v1::ApproveRolloutRequest { rollout_id: id.clone(), etag: etag.clone(), reason: reason.clone() };
        client.approve_rollout(approve).await?;
        client
            .start_rollout(v1::StartRolloutRequest { rollout_id: id.clone(), etag, reason, supersede: false })
            .await?;
        let ended = tokio::time::timeout(LONGEST, self.until(&rollout_id, has_ended)).await;
        ended.with_context(|| format!("{rollout_id} did not end within {} s", LONGEST.as_secs()))??;
        let (wall_s, tasks_per_hour) = (begun.elapsed().as_secs_f64(), self.per_hour(begun_utc));
        // Its end says what every robot is to run. One that does not come to it is seen by what it runs.
        let settled = tokio::time::timeout(SETTLES_WITHIN, self.until(&rollout_id, is_settled)).await;
        let rollout = match settled {
            Ok(rollout) => rollout?,
            Err(_) => self.until(&rollout_id, has_ended).await?,
        };
        let (seen, most) = watcher.seen().await;
        self.judge(release, &rollout, &before, Played { tasks_per_hour, ..Played::from_seen(seen, most, wall_s) }).await
    }

    /// The roll-out, as soon as it is so.
    async fn until(&self, rollout_id: &str, is_so: fn(&v1::Rollout) -> bool) -> Result<v1::Rollout, tonic::Status> {
        let mut client = RolloutServiceClient::new(self.channel.clone());
        loop {
            let request = v1::GetRolloutRequest { rollout_id: rollout_id.to_owned() };
            let rollout = client.get_rollout(request).await?.into_inner().rollout.unwrap_or_default();
            if is_so(&rollout) {
                return Ok(rollout);
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    async fn robots_of(&self, rollout_id: &str) -> anyhow::Result<Vec<v1::RolloutRobot>> {
        let mut client = RolloutServiceClient::new(self.channel.clone());
        let request =
            v1::ListRolloutRobotsRequest { rollout_id: rollout_id.to_owned(), page_size: 1_000, ..Default::default() };
        Ok(client.list_rollout_robots(request).await?.into_inner().robots)
    }

    /// `played` has what was seen meanwhile, and `before` what each robot ran.
    async fn judge(
        &self,
        release: Release,
        rollout: &v1::Rollout,
        before: &BTreeMap<String, String>,
        played: Played,
    ) -> anyhow::Result<Played> {
        let counts = rollout.counts.unwrap_or_default();
        let abort = rollout.abort.as_ref();
        let runs = FirstRuns::read(self.journals.iter().map(PathBuf::as_path), release.version())?;
        let late_ms = midshift_core::limits::ACTIVATION_VALID.as_ms() as i64 + START_TAKES_MS;
        let aborted = abort.and_then(|a| a.time).map(|t| t.seconds * 1_000 + i64::from(t.nanos / 1_000_000));
        let canary = rollout.waves.first().and_then(|w| w.counts).map_or(0, |c| all(&c) - c.skipped);
        let after = self.versions().await?;
        let should = |robot_id: &str| match release.is_good() {
            true => release.version(),
            false => before.get(robot_id).map_or("", String::as_str),
        };
        let elsewhere = after.iter().filter(|(id, version)| *version != should(id));
        Ok(Played {
            bundle: rollout.bundle_label.clone(),
            is_good: release.is_good(),
            phase: short(rollout.phase().as_str_name(), "ROLLOUT_PHASE_"),
            robots_that_ran_it: runs.robots(),
            activated_after_abort: aborted.map_or(0, |at| runs.after(at + late_ms)),
            begun_at_once_most: runs.most_within(self.watched_ms as i64),
            touched_at_abort: abort.map(|a| a.touched),
            touched: counts.attempted,
            canary: canary.max(1),
            kept_by: after.values().filter(|version| *version == release.version()).count(),
            elsewhere: elsewhere.map(|(id, version)| format!("{id} ({version})")).collect(),
            verdicts: rollout.verdicts.iter().map(verdict).collect(),
            abort: abort.map(evidence),
            off_work: medians(&self.robots_of(&rollout.rollout_id).await?),
            ..played
        })
    }

    /// What each robot keeps. A launched robot is asked by its switch record, one of this process by what it said.
    async fn versions(&self) -> anyhow::Result<BTreeMap<String, String>> {
        let mut client = RolloutServiceClient::new(self.channel.clone());
        let request = v1::ListRobotSoftwareRequest { page_size: 1_000, ..Default::default() };
        let software = client.list_robot_software(request).await?.into_inner().software;
        let launched: BTreeSet<&str> = self.launched.iter().map(|(id, _)| id.as_str()).collect();
        let version = |row: v1::RobotSoftware| {
            let version = match launched.contains(row.robot_id.as_str()) {
                true => self.recorded(&row.robot_id)?,
                false if row.on_trial.is_empty() => row.version,
                false => ON_TRIAL.to_owned(),
            };
            Ok((row.robot_id, version))
        };
        software.into_iter().map(version).collect()
    }

    /// Version of the set that a launched robot's switch record names, which must be committed.
    fn recorded(&self, robot_id: &str) -> anyhow::Result<String> {
        let sets = self.folder.join(robot_id).join("sets");
        let switch = Switch::read(&sets.join(midshift_agent::launcher::SWITCH))?;
        if switch.trial.is_some() {
            return Ok(ON_TRIAL.to_owned());
        }
        let holdings = midshift_agent::sets::Sets::holdings(&mut midshift_agent::sets::disk::DiskSets::open(&sets)?)?;
        Ok(holdings.version(&switch.current).unwrap_or_else(|| switch.current.clone()))
    }
}

impl Launched {
    /// Asks every launcher and what it started to end, and waits.
    async fn end(&mut self) {
        self.signal(Signal::TERM);
        for child in &mut self.0 {
            let _ = tokio::time::timeout(ENDS_WITHIN, child.wait()).await;
        }
    }
    fn signal(&self, signal: Signal) {
        // A child that was not waited for keeps its number, so nobody else's group can be meant.
        let running = self.0.iter().filter_map(Child::id).filter_map(|id| i32::try_from(id).ok());
        for group in running.filter_map(Pid::from_raw) {
            // One that has just ended cannot be told anything, and need not be.
            let _ = kill_process_group(group, signal);
        }
    }
}

/// However the story ends, no robot goes on without it.
impl Drop for Launched {
    fn drop(&mut self) {
        self.signal(Signal::KILL);
    }
}

fn has_ended(rollout: &v1::Rollout) -> bool {
    use v1::RolloutPhase::{Aborted, Completed, Review, Superseded};
    matches!(rollout.phase(), Completed | Aborted | Superseded | Review)
}

/// Nobody is on the way to what it is to run.
fn is_settled(rollout: &v1::Rollout) -> bool {
    let c = rollout.counts.unwrap_or_default();
    has_ended(rollout) && c.draining + c.activating + c.trial + c.committing + c.reverting == 0
}

fn duration(ms: u64) -> prost_types::Duration {
    midshift_proto::convert::duration(ms)
}

/// Journals of launched robots.
pub fn journals(folder: &Path, launched: &[(RobotId, WaypointId)]) -> Vec<PathBuf> {
    launched.iter().map(|(id, _)| folder.join(id.as_str()).join(midshift_sim::body::JOURNAL_FILE)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::AsyncReadExt;

    #[tokio::test]
    async fn whatever_a_launcher_started_ends_with_the_story() -> anyhow::Result<()> {
        let mut command = Command::new("sh");
        command.args(["-c", "sleep 1000 & echo started; wait"]).stdout(Stdio::piped()).process_group(0);
        let mut child = command.spawn()?;
        let mut said = child.stdout.take().context("no pipe")?;
        let mut started = [0; 8];
        said.read_exact(&mut started).await?;
        drop(Launched(vec![child]));
        // Both processes hold the pipe: it ends when the last of them does.
        assert_eq!(said.read_to_end(&mut Vec::new()).await?, 0);
        Ok(())
    }
}
