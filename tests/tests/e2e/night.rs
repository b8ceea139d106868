//! A night at a site of somebody who has the programs and nothing else: `serve`, robots under launchers, tasks without
//! end, a good release and bad ones. The server, launchers and agents are killed at work, and a freeze and a pause come
//! in the middle of a wave. In the whole night the disk of one robot is full too, and another falls silent for ever: a
//! silent robot is lost after a minute at the earliest.
//!
//! Invariant: it is judged by what bodies wrote of themselves and by what launchers start next. `MIDSHIFT_SEED` decides
//! who is killed and when; `MIDSHIFT_NIGHT=all` plays the whole night instead of a short one.

use crate::harness::{Server, folder, in_states, until};
use crate::identity::{incidents, json};
use crate::kill::{all_over, judge_each, submit};
use crate::proxy::Proxy;
use crate::robots::{enrolment, remembered};
use crate::rolled_out::{Robot, begin_rollout, call, done, until_known};
use anyhow::{Context, ensure};
use midshift_agent::switch::FACTORY;
use midshift_core::ids::RobotId;
use midshift_core::reason::Code;
use midshift_core::site::{DEMO, text};
use midshift_process::clock::clock;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{ListRolloutRobotsRequest, RolloutRobot, RolloutStep};
use midshift_proto::task::v1::TaskState;
use midshift_sim::body::MODEL;
use midshift_sim::journal::{self, Effect, Entry, Journal};
use midshift_sim::swarm::AGENT_FILE;
use rand::rngs::StdRng;
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{RngExt, SeedableRng};
use serde_json::Value;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, File};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Longest wait for one thing, on a machine that is busy.
const LIMIT: Duration = Duration::from_secs(180);
/// How often it is looked whether there is work enough, and how many tasks come at once then.
const LOOK: Duration = Duration::from_millis(500);
const BATCH: usize = 4;
/// Areas of the site.
const AREAS: [&str; 3] = ["hall", "packing", "quality"];
/// The release that everybody keeps who can have it.
const GOOD: &str = "1.5.0";
/// What all releases are called.
const NAME: &str = "walk";
/// How each roll-out watches, and whom it gives up.
const PACE: [&str; 8] = ["--soak", "1s", "--drain-within", "120s", "--lost-after", "60s", "--complete-percent", "80"];
/// Work that is not over.
const ALIVE: [TaskState; 7] = [
    TaskState::Queued,
    TaskState::Assigned,
    TaskState::Running,
    TaskState::Held,
    TaskState::Suspended,
    TaskState::Stopping,
    TaskState::RetryWait,
];

/// A bad release.
struct Bad {
    version: &'static str,
    /// How it is watched.
    flags: &'static [&'static str],
    /// Nothing fails: the gate asks a person, who aborts it.
    asks: bool,
}

const AT_START: Bad =
    Bad { version: "1.6.0-bad-at-start", flags: &["--probation", "2s", "--exposure-tasks", "0"], asks: false };
const HANGS: Bad = Bad { version: "1.6.1-hangs", flags: &["--probation", "5s", "--exposure-tasks", "0"], asks: false };
/// Bad under work, and no sample: its robots need three times as long.
const SLOW: Bad = Bad {
    version: "1.6.3-slow",
    flags: &["--probation", "2s", "--exposure-tasks", "6", "--max-slower", "30"],
    asks: true,
};

/// Who is killed with SIGKILL.
#[derive(Clone, Copy, Debug)]
enum Blow {
    Server,
    Launcher,
    Agent,
}

/// What keeps robots from changing, as a person says it.
#[derive(Clone, Copy, Debug)]
enum Stay {
    Freeze,
    Pause,
}

impl Stay {
    fn apply(self, address: &str, id: &str, stands: bool) -> anyhow::Result<()> {
        match self {
            Self::Freeze => {
                let frozen = if stands { "true" } else { "false" };
                AREAS
                    .into_iter()
                    .try_for_each(|area| done(&["area", "put", "--server", address, area, "--frozen", frozen]))
            }
            Self::Pause => {
                let verb = if stands { "pause" } else { "resume" };
                done(&["rollout", verb, "--server", address, id, "--reason", "somebody looks"])
            }
        }
    }
}

/// How long a night is.
struct Plot {
    robots: usize,
    /// Of a hundred robots of an area, so many may be out of work at once.
    off_work: &'static str,
    waves: &'static str,
    /// Robots out of work for the good release at once.
    max_in_flight: &'static str,
    /// Permissions between the end of the freeze and the pause.
    between_stays: usize,
    bad: &'static [Bad],
    /// Who is killed how often.
    blows: [(Blow, usize); 3],
    /// So many of these kills come with each bad release.
    blows_each: usize,
    /// With a full disk and a robot that falls silent.
    is_whole: bool,
}

const SHORT: Plot = Plot {
    robots: 5,
    off_work: "50",
    waves: "1,rest",
    max_in_flight: "2",
    between_stays: 0,
    bad: &[AT_START],
    blows: [(Blow::Server, 3), (Blow::Launcher, 1), (Blow::Agent, 1)],
    blows_each: 1,
    is_whole: false,
};

const WHOLE: Plot = Plot {
    robots: 12,
    off_work: "25",
    waves: "1,50%,rest",
    max_in_flight: "12",
    between_stays: 1,
    bad: &[AT_START, HANGS, SLOW],
    blows: [(Blow::Server, 9), (Blow::Launcher, 3), (Blow::Agent, 2)],
    blows_each: 3,
    is_whole: true,
};

/// A robot's place in the night.
struct Post {
    id: String,
    start: String,
    home: PathBuf,
    line: Proxy,
    robot: Robot,
}

impl Post {
    /// The task of a step that must not be done twice and that it is inside of, by its own ledger. Its agent must
    /// stand, or be gone.
    async fn inside(&self) -> anyhow::Result<Option<String>> {
        let holder = remembered(&self.home.join("data")).await?.holder;
        let inside = holder.filter(|holder| holder.intent.is_some() || holder.unknown);
        Ok(inside.and_then(|holder| holder.attempt.subject.task_id().map(ToString::to_string)))
    }
    fn journal(&self) -> PathBuf {
        self.home.join("data/journal.jsonl")
    }
    /// Each version that its body wrote it runs, and when, in their order.
    fn ran(&self) -> anyhow::Result<Vec<(String, i64)>> {
        let entries = journal::read(&self.journal())?.into_iter();
        let ran = entries.filter_map(|entry| match entry.effect {
            Effect::Ran { version } => Some((version, entry.utc_ms)),
            _ => None,
        });
        Ok(ran.collect())
    }
}

/// A time in which no robot begins to run a version, but for those that had permission before.
struct Hold {
    what: String,
    version: &'static str,
    from_ms: i64,
    to_ms: i64,
    permitted: BTreeSet<String>,
}

/// Everything that runs.
struct Night {
    plot: &'static Plot,
    server: Server,
    address: String,
    samples: PathBuf,
    posts: Vec<Post>,
    rng: StdRng,
    /// The next is the last.
    blows: Vec<Blow>,
    /// Whom nobody kills: killed before, on a full disk, or silent.
    spared: BTreeSet<String>,
    full: Option<String>,
    silent: Option<String>,
    /// Tasks about which a person may be asked.
    inside: BTreeSet<String>,
    holds: Vec<Hold>,
}

/// The samples, and a release of the site's own people beside them.
fn make_releases(samples: &Path) -> anyhow::Result<()> {
    let at = |name: &str| samples.join(name).display().to_string();
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    let version = SLOW.version;
    let (draft, out) = (at("draft"), at(&format!("bundles/{NAME}-{version}")));
    fs::create_dir(&draft)?;
    fs::write(samples.join("draft/behaviour.toml"), "speed_permille = 300\n")?;
    let text = format!(
        "name = \"{NAME}\"\nversion = \"{version}\"\ndescription = \"Takes its time.\"\n\n\
         [[component]]\nname = \"behaviour\"\nversion = \"{version}\"\nkind = \"config\"\nfile = \"behaviour.toml\"\n\
         hardware = [\"{MODEL}\"]\nneeds = \"restart\"\n"
    );
    fs::write(samples.join("draft/bundle.toml"), text)?;
    done(&["bundle", "build", &draft, "--out", &out])?;
    done(&["bundle", "sign", &out, "--repository", &at("repository"), "--key", &at("keys/targets-1.pem")])
}

/// The same robot on a disk without room: no byte goes into what it fetches of these releases.
fn on_full_disk(command: &Command, home: &Path, samples: &Path) -> anyhow::Result<Command> {
    let strace = std::env::var_os("MIDSHIFT_TEST_STRACE").unwrap_or_else(|| OsString::from("strace"));
    let mut full = Command::new(strace);
    full.args(["-f", "--seccomp-bpf", "-qq", "-o"]).arg(home.join("trace"));
    full.args(["-e", "trace=write", "-e", "inject=write:error=ENOSPC"]);
    for file in fs::read_dir(samples.join("repository/targets"))? {
        let name = file?.file_name();
        let name = name.to_string_lossy();
        let digest = name.split('.').next().context("a file of a release is called by its digest")?;
        full.arg("-P").arg(home.join("sets/content").join(format!("{digest}.part")));
    }
    full.arg(command.get_program()).args(command.get_args());
    full.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    Ok(full)
}

fn now_ms() -> i64 {
    clock(1000).now().wall.0
}

fn signal(process: u32, name: &str) -> anyhow::Result<()> {
    let sent = Command::new("kill").args(["-s", name, &process.to_string()]).status()?;
    ensure!(sent.success(), "kill -s {name} {process}: {sent}");
    Ok(())
}

/// Asks for tasks again and again until it is enough; how many.
async fn ask(server: SocketAddr, seed: u64, open: usize, enough: CancellationToken) -> anyhow::Result<usize> {
    let site = text::parse(DEMO)?;
    let (mut batches, mut look) = (0, tokio::time::interval(LOOK));
    while enough.run_until_cancelled(look.tick()).await.is_some() {
        let Some(alive) = in_states(server, &ALIVE).await? else { continue };
        if alive.len() < open {
            submit(server, &site, seed.wrapping_mul(10_000).wrapping_add(batches), BATCH).await?;
            batches += 1;
        }
    }
    Ok(usize::try_from(batches)? * BATCH)
}

fn permitted(rows: &[RolloutRobot]) -> BTreeSet<String> {
    rows.iter().filter(|row| row.attempted).map(|row| row.robot_id.clone()).collect()
}

/// It may come to a permission by itself: it is being taken out of work, or stands and waits for it.
fn is_on_its_way(row: &RolloutRobot) -> bool {
    matches!(row.step(), RolloutStep::Draining | RolloutStep::Activating) && !row.attempted
}

/// So many have had permission, and so many are still to come.
fn is_amid(rows: &[RolloutRobot], had: usize, left: usize) -> bool {
    let waits = [RolloutStep::Waiting, RolloutStep::Staging, RolloutStep::Staged];
    let comes = |row: &&RolloutRobot| waits.contains(&row.step()) || is_on_its_way(row);
    permitted(rows).len() >= had && rows.iter().filter(comes).count() >= left
}

impl Night {
    /// A server with its releases and all robots, which people can ask for.
    async fn open(dir: &Path, plot: &'static Plot, mut rng: StdRng) -> anyhow::Result<Self> {
        let site = text::parse(DEMO)?;
        let samples = dir.join("samples");
        make_releases(&samples)?;
        let keys = samples.join("keys").display().to_string();
        let server = Server::start_with(dir, DEMO, &["--ota-keys", &keys]).await?;
        let address = server.address.to_string();
        for area in AREAS {
            done(&["area", "put", "--server", &address, area, "--off-work", plot.off_work])?;
        }
        let full = plot.is_whole.then(|| format!("rbt-{:02}", rng.random_range(1..=plot.robots)));
        let mut posts = Vec::new();
        for (number, at) in (1..).zip(site.starting_places(plot.robots)) {
            let (id, start) = (format!("rbt-{number:02}"), site.name_of(at).to_string());
            let (home, line) = (dir.join(&id), Proxy::before(server.address).await?);
            let (door, enrolment) = (line.address.to_string(), enrolment(server.address, &id).await?);
            let mut command = Robot::command(&id, &start, &home, &samples, &door, None, enrolment.as_deref())?;
            if full.as_ref() == Some(&id) {
                command = on_full_disk(&command, &home, &samples)?;
            }
            let robot = Robot::start(command, &home)?;
            posts.push(Post { id, start, home, line, robot });
        }
        done(&["bundle", "push", "--server", &address, &samples.join("repository").display().to_string()])?;
        for post in &posts {
            until_known(&address, &post.id, &post.home).await?;
        }
        let mut blows: Vec<Blow> =
            plot.blows.into_iter().flat_map(|(blow, count)| std::iter::repeat_n(blow, count)).collect();
        blows.shuffle(&mut rng);
        let spared = full.iter().cloned().collect();
        let (silent, inside, holds) = (None, BTreeSet::new(), Vec::new());
        Ok(Self { plot, server, address, samples, posts, rng, blows, spared, full, silent, inside, holds })
    }

    // --- what is seen

    /// How far each robot is; none while nobody answers.
    async fn rows(&self, id: &str) -> anyhow::Result<Option<Vec<RolloutRobot>>> {
        let request = ListRolloutRobotsRequest { rollout_id: id.to_owned(), page_size: 1_000, ..Default::default() };
        let page = RolloutServiceClient::new(self.server.channel()?).list_rollout_robots(request).await;
        Ok(page.ok().map(|page| page.into_inner().robots))
    }
    /// Who has ever run this version.
    fn ran(&self, version: &str) -> anyhow::Result<BTreeSet<&str>> {
        let mut ran = BTreeSet::new();
        for post in &self.posts {
            if post.ran()?.iter().any(|(ran, _)| ran == version) {
                ran.insert(post.id.as_str());
            }
        }
        Ok(ran)
    }
    /// It can have no release any more, or could have none.
    fn is_out(&self, post: &Post) -> bool {
        [&self.full, &self.silent].into_iter().flatten().any(|id| *id == post.id)
    }
    /// How many tasks are done; none while nobody answers.
    async fn succeeded(&self) -> anyhow::Result<Option<usize>> {
        Ok(self.server.in_states(&[TaskState::Succeeded]).await?.map(|tasks| tasks.len()))
    }
    /// Waits until so many tasks more are done.
    async fn until_done(&self, more: usize) -> anyhow::Result<()> {
        let before = until("what is done", LIMIT, || self.succeeded()).await?;
        until("more tasks done", LIMIT, async || {
            Ok(self.succeeded().await?.filter(|now| *now >= before + more).map(drop))
        })
        .await
    }
    /// Waits until everybody runs what it keeps, and nothing on trial.
    async fn until_kept(&self) -> anyhow::Result<()> {
        until("everybody on what it keeps", LIMIT, async || {
            for post in &self.posts {
                let keeps = if self.is_out(post) {
                    post.robot.switch()?.running() == FACTORY
                } else {
                    !post.robot.is_on_trial() && post.robot.committed()?.as_deref() == Some(GOOD)
                };
                if !keeps {
                    return Ok(None);
                }
            }
            Ok(Some(()))
        })
        .await
    }

    // --- blows

    /// Kills somebody after some tasks more.
    async fn strike(&mut self) -> anyhow::Result<()> {
        let blow = self.blows.pop().context("nobody is left to be killed")?;
        let more = self.rng.random_range(1..=2);
        self.until_done(more).await?;
        say!("kill -9: {blow:?}, {} to come", self.blows.len());
        match blow {
            Blow::Server => self.server.kill_and_restart().await,
            Blow::Launcher => self.kill_launcher().await,
            Blow::Agent => self.kill_agent().await,
        }
    }
    /// A robot at work that nobody has killed and that tries no release out.
    async fn victim(&mut self) -> anyhow::Result<usize> {
        let found = until("a robot at work that was not killed", LIMIT, async || {
            let running = self.server.in_states(&[TaskState::Running]).await?.unwrap_or_default();
            let works = |post: &Post| running.iter().any(|task| task.robot_id == post.id);
            let may = |post: &Post| !self.spared.contains(&post.id) && !post.robot.is_on_trial() && works(post);
            let found: Vec<usize> = (0..).zip(&self.posts).filter(|&(_, post)| may(post)).map(|(nth, _)| nth).collect();
            Ok((!found.is_empty()).then_some(found))
        })
        .await?;
        let nth = *found.choose(&mut self.rng).context("nobody is at work")?;
        self.spared.insert(self.posts[nth].id.clone());
        Ok(nth)
    }
    /// SIGKILL to an agent, which its launcher starts again.
    async fn kill_agent(&mut self) -> anyhow::Result<()> {
        let nth = self.victim().await?;
        let post = &self.posts[nth];
        let agent = until("the agent", LIMIT, async || post.robot.agent()).await?;
        // What it is inside of is read while it stands.
        signal(agent, "STOP")?;
        until("the agent to stand", LIMIT, async || {
            Ok(fs::read_to_string(format!("/proc/{agent}/stat"))?.contains(") T ").then_some(()))
        })
        .await?;
        let inside = post.inside().await?;
        signal(agent, "KILL")?;
        say!("{} was killed, inside of {inside:?}", post.id);
        until("the launcher to start another", LIMIT, async || {
            Ok(post.robot.agent()?.filter(|next| *next != agent).map(drop))
        })
        .await?;
        self.inside.extend(inside);
        Ok(())
    }
    /// SIGKILL to a launcher. Its agent ends by itself, and then a person starts both.
    async fn kill_launcher(&mut self) -> anyhow::Result<()> {
        let nth = self.victim().await?;
        let post = &mut self.posts[nth];
        post.robot.kill_launcher()?;
        let lock = post.home.join("data").join(AGENT_FILE).with_extension("lock");
        until("its agent to end as well", LIMIT, async || Ok(File::open(&lock)?.try_lock().is_ok().then_some(())))
            .await?;
        let inside = post.inside().await?;
        say!("the launcher of {} was killed, inside of {inside:?}", post.id);
        let door = post.line.address.to_string();
        let command = Robot::command(&post.id, &post.start, &post.home, &self.samples, &door, None, None)?;
        post.robot = Robot::start(command, &post.home)?;
        self.inside.extend(inside);
        Ok(())
    }

    // --- releases

    /// Begins to roll a release out; the roll-out's id.
    fn begin(&self, version: &str, waves: &str, flags: &[&str]) -> anyhow::Result<String> {
        let id = format!("{NAME}-{version}");
        let create = ["rollout", "create", "--server", &self.address, &id, "--waves", waves];
        done(&[&create[..], &PACE, flags].concat())?;
        begin_rollout(&self.address, &id)?;
        say!("{id} begins");
        Ok(id)
    }
    /// Waits for this, which must end with this code.
    fn wait(&self, id: &str, what: &str, code: i32) -> anyhow::Result<()> {
        let wait = ["rollout", "wait", "--server", &self.address, id, "--for", what, "--timeout", "900s"];
        let waited = tokio::task::block_in_place(|| call(&wait))?;
        let said = String::from_utf8_lossy(&waited.stderr);
        ensure!(waited.status.code() == Some(code), "{id} ended with {:?}: {said}", waited.status.code());
        Ok(())
    }
    /// Holds the roll-out in the middle of a wave while somebody is killed and tasks go on; how many had permission.
    async fn stay(&mut self, stay: Stay, id: &str, version: &'static str, had: usize) -> anyhow::Result<usize> {
        let left = self.plot.robots / 4;
        until("the middle of a wave", LIMIT, async || {
            Ok(self.rows(id).await?.filter(|rows| is_amid(rows, had, left)).map(drop))
        })
        .await?;
        stay.apply(&self.address, id, true)?;
        let from_ms = now_ms();
        // The item that permits relies on what was just said: who has no permission now gets none.
        let rows = until("its robots", LIMIT, async || self.rows(id).await).await?;
        let before = permitted(&rows);
        ensure!(is_amid(&rows, had, 1), "{stay:?} of {id} holds nobody back: {before:?} have had permission");
        say!("{stay:?} of {id}: {before:?} have had permission");
        until("nobody on the way to a permission", LIMIT, async || {
            Ok(self.rows(id).await?.filter(|rows| !rows.iter().any(is_on_its_way)).map(drop))
        })
        .await?;
        self.strike().await?;
        self.until_done(1).await?;
        let to_ms = now_ms();
        let after = permitted(&until("its robots", LIMIT, async || self.rows(id).await).await?);
        ensure!(after.is_subset(&before), "{stay:?} of {id}: {before:?} had permission, and now {after:?}");
        stay.apply(&self.address, id, false)?;
        let had = before.len();
        self.holds.push(Hold { what: format!("{stay:?}"), version, from_ms, to_ms, permitted: before });
        Ok(had)
    }
    /// Cuts the line of a robot at work that is to change next, for ever. It is named, and a person who is told gives
    /// it up.
    async fn fall_silent(&mut self, id: &str) -> anyhow::Result<()> {
        let nth = until("a robot at work that is to change", LIMIT, async || {
            let rows = self.rows(id).await?.unwrap_or_default();
            let running = self.server.in_states(&[TaskState::Running]).await?.unwrap_or_default();
            // So early in its task that it does not come to its permission before the cut.
            let begins = |post: &Post| {
                let mut its = running.iter().filter(|task| task.robot_id == post.id);
                its.any(|task| task.attempt.as_ref().is_some_and(|attempt| attempt.step_index <= 1))
            };
            let drains = |row: &RolloutRobot, post: &Post| {
                row.robot_id == post.id && row.step() == RolloutStep::Draining && !row.attempted
            };
            let is_one = |post: &Post| begins(post) && rows.iter().any(|row| drains(row, post));
            Ok(self.posts.iter().position(|post| self.full.as_ref() != Some(&post.id) && is_one(post)))
        })
        .await?;
        self.posts[nth].line.sever();
        let robot = self.posts[nth].id.clone();
        say!("{robot} is silent from now on");
        let alive = until("its task", LIMIT, async || self.server.in_states(&ALIVE).await).await?;
        self.inside.extend(alive.into_iter().filter(|task| task.robot_id == robot).map(|task| task.task_id));
        self.spared.insert(robot.clone());
        self.silent = Some(robot.clone());

        let code = Code::BlockedBySilence.as_str();
        until("the silent robot to be named", LIMIT, async || {
            let rows = self.rows(id).await?.unwrap_or_default();
            let row = rows.into_iter().find(|row| row.robot_id == robot);
            let is_named = |row: &RolloutRobot| row.blocked_by.as_ref().is_some_and(|why| why.code == code);
            Ok(row.filter(|row| row.lost.is_some() && is_named(row)).map(drop))
        })
        .await?;
        let explained = call(&["rollout", "explain", "--server", &self.address, id, &robot, "-o", "json"])?;
        let said = String::from_utf8_lossy(&explained.stdout);
        ensure!(explained.status.success() && said.contains(code), "{explained:?}");
        let told = incidents(self.server.address)?;
        let is_told = told.iter().any(|i| i["robotId"] == robot.as_str() && i["reason"]["code"] == code);
        ensure!(is_told, "no incident of {robot}: {told:?}");
        done(&["rollout", "write-off", "--server", &self.address, id, &robot, "--reason", "nobody finds it"])?;
        let rows = until("its robots", LIMIT, async || self.rows(id).await).await?;
        let is_given_up = |row: &RolloutRobot| row.robot_id == robot && row.written_off.is_some();
        ensure!(rows.iter().any(is_given_up), "{robot} holds others up: {rows:?}");
        self.carry_away(nth).await
    }
    /// People carry the silent robot off the floor, and open the places that the site kept for it.
    async fn carry_away(&mut self, nth: usize) -> anyhow::Result<()> {
        let post = &mut self.posts[nth];
        post.robot.end()?;
        leave_places(&post.journal(), &post.id)?;
        let (id, address) = (post.id.clone(), self.server.address);
        until("nothing to be kept for who is away", LIMIT, async || {
            let zones = json(address, &["zone", "ls", "--in-use"])?;
            let zones = zones["places"].as_array().cloned().unwrap_or_default();
            let holds = |zone: &Value| {
                zone["holders"].as_array().is_some_and(|all| all.iter().any(|h| h["robotId"] == id.as_str()))
            };
            let kept: Vec<&Value> = zones.iter().filter(|zone| holds(zone)).collect();
            for zone in &kept {
                let [place, etag] = ["placeId", "etag"].map(|field| zone[field].as_str().unwrap_or_default());
                let clear = ["zone", "clear", place, "--reason", "carried away", "--if-match", etag, "--server"];
                call(&[&clear[..], &[&self.address]].concat())?;
            }
            Ok(kept.is_empty().then_some(()))
        })
        .await
    }
    /// The good release, in the middle of which all the rest happens.
    async fn good(&mut self) -> anyhow::Result<()> {
        let at_once = ["--max-in-flight", self.plot.max_in_flight];
        let flags = [&at_once[..], &["--probation", "1s", "--exposure-tasks", "0"]].concat();
        let id = self.begin(GOOD, self.plot.waves, &flags)?;
        until("its canary on trial", LIMIT, async || {
            Ok(self.posts.iter().any(|post| post.robot.is_on_trial()).then_some(()))
        })
        .await?;
        self.strike().await?;
        let had = self.stay(Stay::Freeze, &id, GOOD, 2).await?;
        self.stay(Stay::Pause, &id, GOOD, had + self.plot.between_stays).await?;
        if self.plot.is_whole {
            self.fall_silent(&id).await?;
            self.strike().await?;
        }
        self.strike().await?;
        self.wait(&id, "completed", 0)?;
        self.until_kept().await?;
        let rows = until("its robots", LIMIT, async || self.rows(&id).await).await?;
        if let Some(full) = &self.full {
            let why = rows.iter().find(|row| row.robot_id == *full).and_then(|row| row.why.as_ref());
            ensure!(why.is_some_and(|why| why.code == Code::NoRoom.as_str()), "{full} has no room: {rows:?}");
        }
        let ran = self.ran(GOOD)?;
        let has_it = |post: &&Post| !self.is_out(post);
        let should: BTreeSet<&str> = self.posts.iter().filter(has_it).map(|post| post.id.as_str()).collect();
        ensure!(ran == should, "{GOOD} ran on {ran:?}");
        Ok(())
    }
    /// A bad release, which ends with its canary.
    async fn bad(&mut self, bad: &'static Bad) -> anyhow::Result<()> {
        let version = bad.version;
        let id = self.begin(version, "1,rest", bad.flags)?;
        until("it to run somewhere", LIMIT, async || Ok((!self.ran(version)?.is_empty()).then_some(()))).await?;
        for _ in 0..self.plot.blows_each {
            self.strike().await?;
        }
        if bad.asks {
            self.wait(&id, "completed", 11)?;
            done(&["rollout", "abort", "--server", &self.address, &id, "--reason", "too slow for us"])?;
        }
        self.wait(&id, "ended", 12)?;
        let what = format!("the end of {id}");
        self.holds.push(Hold { what, version, from_ms: now_ms(), to_ms: i64::MAX, permitted: BTreeSet::new() });
        self.until_kept().await?;
        let ran = self.ran(version)?;
        ensure!(ran.len() == 1, "{id}: its canary alone runs it, and {ran:?} did");
        Ok(())
    }
    /// By the journals: nobody without permission began to run a version while it was held.
    fn judge_holds(&self) -> anyhow::Result<()> {
        for hold in &self.holds {
            let Hold { what, version, from_ms, to_ms, permitted } = hold;
            for post in self.posts.iter().filter(|post| !permitted.contains(&post.id)) {
                let begun = post.ran()?.into_iter().find(|(ran, at)| ran == version && (*from_ms..*to_ms).contains(at));
                ensure!(begun.is_none(), "{} began {begun:?} after {what} at {from_ms}", post.id);
            }
        }
        Ok(())
    }
    /// By the journals: everybody runs what it keeps, which is the good release, or what it came with without that.
    fn judge_kept(&self) -> anyhow::Result<()> {
        for post in &self.posts {
            let ran = post.ran()?;
            let runs = ran.last().map(|(version, _)| version.as_str());
            let came_with = ran.first().map(|(version, _)| version.as_str());
            let keeps = if self.is_out(post) { came_with } else { Some(GOOD) };
            ensure!(runs.is_some() && runs == keeps, "{} runs {runs:?} and keeps {keeps:?}", post.id);
        }
        Ok(())
    }
}

/// The body of this journal is in no place any more.
fn leave_places(path: &Path, robot: &str) -> anyhow::Result<()> {
    let (mut inside, entries) = (BTreeSet::new(), journal::read(path)?);
    for entry in &entries {
        match &entry.effect {
            Effect::Entered { place_id } => drop(inside.insert(place_id.clone())),
            Effect::Left { place_id } => drop(inside.remove(place_id)),
            _ => {}
        }
    }
    let mut journal = Journal::open(path)?;
    for place_id in inside {
        let (utc_ms, robot_id) = (now_ms(), Some(RobotId::parse(robot)?));
        let site_ms = entries.last().map_or(0, |entry| entry.site_ms);
        journal.append(Entry { utc_ms, site_ms, robot_id, effect: Effect::Left { place_id } });
    }
    ensure!(journal.lost() == 0, "{} cannot be written", path.display());
    Ok(())
}

async fn played(dir: &Path, plot: &'static Plot, seed: u64) -> anyhow::Result<()> {
    let mut night = Night::open(dir, plot, StdRng::seed_from_u64(seed)).await?;
    let (enough, address) = (CancellationToken::new(), night.server.address);
    let asking = tokio::spawn(ask(address, seed, plot.robots, enough.clone()));
    let asking = AbortOnDropHandle::new(asking);
    night.until_done(2).await?;
    night.good().await?;
    for bad in plot.bad {
        night.bad(bad).await?;
    }
    ensure!(night.blows.is_empty(), "{} were not killed", night.blows.len());
    enough.cancel();
    let asked = asking.await??;
    let ended = all_over(address, asked).await?;
    night.until_kept().await?;
    night.judge_kept()?;
    night.judge_holds()?;
    let journals: Vec<PathBuf> = night.posts.iter().map(Post::journal).collect();
    say!("{asked} tasks; a person may be asked about {:?}", night.inside);
    judge_each(&ended, &night.inside, &text::parse(DEMO)?, &journals)
}

/// What a night leaves behind; kept, and named, unless it was good.
struct Traces(Option<TempDir>);

impl Drop for Traces {
    fn drop(&mut self) {
        if let Some(dir) = self.0.take() {
            say!("journals, ledgers and logs of this night: {}", dir.keep().display());
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_night_of_releases_and_kills_loses_no_task_and_starts_nothing_that_is_held() -> anyhow::Result<()> {
    let seed: u64 = std::env::var("MIDSHIFT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(20_261_125);
    let is_whole = std::env::var("MIDSHIFT_NIGHT").is_ok_and(|night| night == "all");
    say!("a night with MIDSHIFT_SEED={seed}");
    let dir = folder()?;
    let path = dir.path().to_owned();
    let mut traces = Traces(Some(dir));
    played(&path, if is_whole { &WHOLE } else { &SHORT }, seed).await?;
    drop(traces.0.take());
    Ok(())
}
