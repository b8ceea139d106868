//! A real server with honest robots at work, beside which others may behave badly: what goes on there by public calls
//! alone, and a person who looks after what the others leave.
//!
//! Invariant: a law is judged by what anybody may ask the server, by the bodies' own journals, and by the process from
//! outside. Called by `played`.

use crate::harness::{Server, folder, until};
use crate::room::LIMIT;
use crate::stack::page;
use anyhow::{Context, ensure};
use midshift::enrol_simulated::{Machines, Replaced};
use midshift_cli::endpoint::Line;
use midshift_cli::task_list::request;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::site::{DEMO, Site, text};
use midshift_core::time::Clock;
use midshift_proto::common::v1::Reason;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{
    ClearPlaceRequest, ExplainRobotRequest, ExplainTaskRequest, Incident, ListIncidentsRequest, ListPlacesRequest,
    Place, PlaceHolderState, RetireRobotRequest,
};
use midshift_proto::task::v1::{CancelTaskRequest, GetTaskRequest, Task, TaskState};
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig};
use midshift_sim::swarm::{Swarm, SwarmConfig};
use midshift_sim::workload::{Workload, WorkloadConfig};
use midshift_tests::metrics::Metrics;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::Duration;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Honest robots of an arena.
const HONEST: usize = 3;
/// How many times as fast as real their bodies work.
const PACE_PERMILLE: u32 = 8_000;
/// Tasks that are open at once while others play; every second one is for an honest robot by name.
const OPEN: usize = 6;
/// Tasks that a player has heard of: the newest, and as many that nobody has asked for yet.
const HEARD_OF: usize = 16;
/// What stands for so long must have a reason: the bound of the server's own counter.
const STANDS: Duration = Duration::from_secs(10);
/// What only a person solves must have its incident when it has been told for so long.
const TOLD_FOR: Duration = Duration::from_secs(4);
/// What a server may have more in memory at the end than when its honest robots worked alone, KiB: a server of 200
/// robots has less in all.
const GROWTH_KIB: u64 = 96 * 1024;
/// Every state in which a task goes on or waits.
const ALIVE: [TaskState; 8] = [
    TaskState::Queued,
    TaskState::Assigned,
    TaskState::Running,
    TaskState::Held,
    TaskState::Suspended,
    TaskState::Stopping,
    TaskState::RetryWait,
    TaskState::NeedsOperator,
];
/// What a robot's explanation says that only a person solves, and the incident that tells a person so.
const OF_PEOPLE: [(&str, &str); 9] = [
    ("ROBOT_DOES_NOT_ANSWER", "ROBOT_DOES_NOT_ANSWER"),
    ("ROBOT_BROKEN_OFF", "ROBOT_BREAKER_OPENED"),
    ("REPORT_IMPLAUSIBLE", "REPORT_IMPLAUSIBLE"),
    ("PLACES_IMPLAUSIBLE", "PLACES_IMPLAUSIBLE"),
    ("GOAL_NOT_ENTERED", "GOAL_NOT_ENTERED"),
    ("ATTEMPT_UNKNOWN", "ATTEMPT_UNKNOWN"),
    ("EXCLUSION_BROKEN", "EXCLUSION_BROKEN"),
    ("DECISION_PUT_ASIDE", "DECISION_PUT_ASIDE"),
    ("MAP_DIFFERS", "MAP_DIFFERS"),
];

/// One server and who works there.
pub struct Arena {
    server: Server,
    /// Its site.
    pub site: Arc<Site>,
    /// The clock of all robots of this program.
    pub clock: Arc<dyn Clock>,
    hall: Arc<Fleet>,
    workload: Workload,
    asked: Arc<AtomicUsize>,
    /// Memory of the server while its honest robots worked alone, KiB.
    before_kib: u64,
    /// Since when each living task is as it is.
    standing: BTreeMap<String, (String, Instant)>,
    /// Since when something that a person must solve is told and has no incident.
    owed: BTreeMap<String, Instant>,
    /// What broke a law, in words.
    findings: BTreeSet<String>,
    /// How often each law was looked at.
    checks: BTreeMap<&'static str, u64>,
    _dir: tempfile::TempDir,
    _robots: AbortOnDropHandle<()>,
}

/// The name of the `nth` task.
fn task_name(nth: usize) -> String {
    format!("TASK-{nth:03}")
}

impl Arena {
    /// Starts the server and its honest robots, and waits until they have done something.
    pub async fn open(seed: u64) -> anyhow::Result<Self> {
        let (dir, site, clock) = (folder()?, Arc::new(text::parse(DEMO)?), midshift_process::clock::clock(1000));
        let server = Server::start(dir.path()).await?;
        let of_hall = FleetConfig {
            faults: FaultRates::none(),
            drains: false,
            pace_permille: PACE_PERMILLE,
            ..FleetConfig::new(site.clone(), HONEST, seed)
        };
        let hall = Arc::new(Fleet::open(&of_hall, &clock.now())?);
        let ids: Vec<RobotId> = hall.robots().iter().map(|robot| robot.robot_id().clone()).collect();
        let machines =
            Machines::enrol(&server.way()?, &server.address.to_string(), ids, None, &Replaced::default()).await?;
        let uri = format!("https://{}", server.address);
        let swarm = SwarmConfig::over(hall.clone(), clock.clone(), &uri, Arc::new(machines.tls()), seed);
        let swarm = Swarm::new(SwarmConfig { person: None, ..swarm });
        let robots = AbortOnDropHandle::new(tokio::spawn(async move {
            // It ends with the arena.
            let _ = swarm.run(CancellationToken::new()).await;
        }));
        let drawn = WorkloadConfig { timeout_ms: 400_000, ..WorkloadConfig::background(seed) };
        let mut arena = Self {
            workload: Workload::new(drawn, &site).context("no stations")?,
            server,
            site,
            clock,
            hall,
            asked: Arc::default(),
            before_kib: 0,
            standing: BTreeMap::new(),
            owed: BTreeMap::new(),
            findings: BTreeSet::new(),
            checks: BTreeMap::new(),
            _dir: dir,
            _robots: robots,
        };
        let all = arena.honest();
        until("every honest robot in its place", LIMIT, async || {
            let places = arena.places().await?;
            let stand: BTreeSet<&String> = places.iter().flat_map(|p| &p.holders).map(|h| &h.robot_id).collect();
            Ok(all.iter().all(|id| stand.contains(id)).then_some(()))
        })
        .await?;
        arena.ask().await?;
        until("something was done", LIMIT, async || {
            Ok(arena.server.in_states(&[TaskState::Succeeded]).await?.filter(|done| !done.is_empty()))
        })
        .await?;
        arena.before_kib = arena.memory_kib()?;
        Ok(arena)
    }
    /// Where it is.
    pub fn address(&self) -> SocketAddr {
        self.server.address
    }
    /// Names of the honest robots.
    pub fn honest(&self) -> Vec<String> {
        self.hall.robots().iter().map(|robot| robot.robot_id().to_string()).collect()
    }
    /// Tells of tasks at the moment at which it is asked.
    pub fn rumours(&self) -> impl Fn() -> Vec<TaskId> + Send + use<> {
        let asked = self.asked.clone();
        move || {
            let asked = asked.load(Relaxed);
            let names = (asked.saturating_sub(HEARD_OF)..asked + HEARD_OF).map(task_name);
            names.filter_map(|name| TaskId::parse(&name).ok()).collect()
        }
    }
    /// How often each law was looked at, and what broke one.
    pub fn verdict(self) -> (BTreeMap<&'static str, u64>, BTreeSet<String>) {
        (self.checks, self.findings)
    }

    fn fleet(&self) -> anyhow::Result<FleetServiceClient<Line>> {
        Ok(FleetServiceClient::new(self.server.channel()?))
    }
    async fn places(&self) -> anyhow::Result<Vec<Place>> {
        let request = ListPlacesRequest { in_use: true, page_size: 1_000, ..ListPlacesRequest::default() };
        Ok(self.fleet()?.list_places(request).await?.into_inner().places)
    }
    async fn incidents(&self) -> anyhow::Result<Vec<Incident>> {
        let request = ListIncidentsRequest { page_size: 1_000, ..ListIncidentsRequest::default() };
        Ok(self.fleet()?.list_incidents(request).await?.into_inner().incidents)
    }
    async fn alive(&self) -> anyhow::Result<Vec<Task>> {
        self.server.in_states(&ALIVE).await?.context("the server does not answer")
    }
    /// What the server's process has in memory.
    fn memory_kib(&self) -> anyhow::Result<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.server.id()))?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("it has no memory")?;
        Ok(line.trim().trim_end_matches(" kB").parse()?)
    }
    fn check(&mut self, law: &'static str, holds: bool, found: impl FnOnce() -> String) {
        *self.checks.entry(law).or_default() += 1;
        if !holds {
            self.findings.insert(format!("{law}: {}", found()));
        }
    }

    // --- work

    /// Asks for tasks until so many are open.
    pub async fn ask(&mut self) -> anyhow::Result<()> {
        let open = self.alive().await?.len();
        for _ in open..OPEN {
            let (nth, mut transport) = (self.asked.load(Relaxed), self.workload.next_transport());
            if nth.is_multiple_of(2) {
                transport.robot_id = self.hall.robots()[nth / 2 % HONEST].robot_id().to_string();
            }
            let (name, mut task) = (task_name(nth), request(&transport));
            (task.task_id, task.request_id) = (name.clone(), name);
            self.server.tasks()?.submit_task(task).await?;
            self.asked.store(nth + 1, Relaxed);
        }
        Ok(())
    }

    // --- laws that hold all the time

    /// Looks at everything once; `playing` behave badly meanwhile.
    pub async fn look_around(&mut self, playing: &BTreeSet<String>) -> anyhow::Result<()> {
        let tasks = self.alive().await?;
        for task in self.unmoved(&tasks) {
            self.is_explained(&task).await?;
        }
        let robots = self.honest().into_iter().chain(playing.iter().cloned());
        let mut told: Vec<(String, Reason)> = Vec::new();
        for robot_id in robots {
            told.extend(self.robot(&robot_id).await?.map(|verdict| (robot_id, verdict)));
        }
        let places = self.places().await?;
        let incidents = self.incidents().await?;
        self.people_are_told(told, &places, &incidents);
        let ended = self.server.has_ended()?;
        self.check("the server lives", !ended, || "its process has ended".to_owned());
        Ok(())
    }
    /// Tasks that are as they were for so long that somebody would ask.
    fn unmoved(&mut self, tasks: &[Task]) -> Vec<Task> {
        let now = Instant::now();
        self.standing.retain(|id, _| tasks.iter().any(|task| task.task_id == *id));
        let is_old = |task: &&Task| {
            let attempt = task.attempt.as_ref().map(|a| (a.epoch, a.state, a.step_index));
            let is = format!("{} {:?} {attempt:?}", task.etag, task.state());
            let known = self.standing.entry(task.task_id.clone()).or_insert_with(|| (is.clone(), now));
            if known.0 != is {
                *known = (is, now);
            }
            now.duration_since(known.1) >= STANDS
        };
        tasks.iter().filter(is_old).cloned().collect()
    }
    async fn is_explained(&mut self, task: &Task) -> anyhow::Result<()> {
        const LAW: &str = "what does not move is explained";
        let ask = ExplainTaskRequest { task_id: task.task_id.clone() };
        let said = self.fleet()?.explain_task(ask).await;
        // It may have ended a moment ago.
        let Ok(said) = said else { return Ok(()) };
        let verdict = said.into_inner().explanation.and_then(|explanation| explanation.verdict);
        self.check(LAW, verdict.as_ref().is_some_and(is_told), || format!("{task:?} {verdict:?}"));
        if ![TaskState::Assigned, TaskState::Running, TaskState::Stopping].contains(&task.state()) {
            return Ok(());
        }
        let verdict = self.robot(&task.robot_id).await?;
        self.check(LAW, verdict.as_ref().is_some_and(is_told), || format!("robot of {task:?} {verdict:?}"));
        Ok(())
    }
    async fn robot(&self, robot_id: &str) -> anyhow::Result<Option<Reason>> {
        let ask = ExplainRobotRequest { robot_id: robot_id.to_owned() };
        match self.fleet()?.explain_robot(ask).await {
            Ok(said) => Ok(said.into_inner().explanation.and_then(|explanation| explanation.verdict)),
            Err(status) if status.code() == tonic::Code::NotFound => Ok(None),
            Err(status) => Err(status.into()),
        }
    }
    /// What only a person solves has an incident soon after it is told.
    fn people_are_told(&mut self, told: Vec<(String, Reason)>, places: &[Place], incidents: &[Incident]) {
        const LAW: &str = "what a person must solve has an incident";
        let open: Vec<(String, &Incident)> = incidents.iter().map(|i| (code_of(i), i)).collect();
        let mut owed = Vec::new();
        for (robot_id, verdict) in told {
            let Some((_, wanted)) = OF_PEOPLE.iter().find(|(code, _)| *code == verdict.code) else { continue };
            *self.checks.entry(LAW).or_default() += 1;
            let place = verdict.metadata.get("place_id");
            let is_it = |i: &Incident| i.robot_id == robot_id || (place.is_some() && fact(i, "place_id") == place);
            if !open.iter().any(|(code, i)| code == wanted && is_it(i)) {
                owed.push(format!("{wanted} of {robot_id}"));
            }
        }
        let inside = |place: &Place| place.holders.iter().filter(|h| h.state() == PlaceHolderState::Inside).count();
        for place in places.iter().filter(|place| inside(place) > place.capacity as usize) {
            *self.checks.entry(LAW).or_default() += 1;
            let is_it = |i: &Incident| fact(i, "place_id").is_some_and(|id| *id == place.place_id);
            if !open.iter().any(|(code, i)| code == "EXCLUSION_BROKEN" && is_it(i)) {
                owed.push(format!("EXCLUSION_BROKEN at {}", place.place_id));
            }
        }
        let now = Instant::now();
        self.owed.retain(|what, _| owed.contains(what));
        for what in owed {
            let since = *self.owed.entry(what.clone()).or_insert(now);
            if now.duration_since(since) >= TOLD_FOR {
                self.findings.insert(format!("{LAW}: {what}"));
            }
        }
    }

    // --- a person

    /// A person takes robots that behave badly out of the fleet, looks into their places, and gives up what they had.
    /// True: no task is left.
    pub async fn look_after(&mut self, gone: &BTreeSet<String>) -> anyhow::Result<bool> {
        let (mut fleet, mut intake) = (self.fleet()?, self.server.tasks()?);
        for robot_id in gone {
            let reason = "it behaves badly".to_owned();
            let request = RetireRobotRequest { robot_id: robot_id.clone(), reason, ..RetireRobotRequest::default() };
            answered(fleet.retire_robot(request).await)?;
        }
        let is_gone = |id: &String| gone.contains(id);
        for place in self.places().await?.into_iter().filter(|p| p.holders.iter().any(|h| is_gone(&h.robot_id))) {
            let (place_id, etag, reason) = (place.place_id, place.etag, "looked, nobody is there".to_owned());
            let request = ClearPlaceRequest { place_id, etag, reason, ..ClearPlaceRequest::default() };
            answered(fleet.clear_place(request).await)?;
        }
        let alive = self.alive().await?;
        let left = alive.iter().filter(|task| {
            let theirs = is_gone(&task.robot_id) || is_gone(&task.opened_robot_id);
            theirs || task.state() == TaskState::NeedsOperator
        });
        for task in left {
            let request = CancelTaskRequest {
                task_id: task.task_id.clone(),
                request_id: format!("give-up-{}-{}", task.task_id, task.etag),
                reason: "its robot behaves badly".to_owned(),
                force: true,
                ..CancelTaskRequest::default()
            };
            answered(intake.cancel_task(request).await)?;
        }
        Ok(alive.is_empty())
    }

    // --- laws at the end

    /// Looks at what must hold once everything is over; `players` behaved badly.
    pub async fn judge(&mut self, players: &BTreeSet<String>) -> anyhow::Result<()> {
        let open: Vec<String> =
            self.alive().await?.iter().map(|t| format!("{} {:?} {}", t.task_id, t.state(), t.robot_id)).collect();
        self.check("every task ends", open.is_empty(), || format!("{open:?}"));
        let verdict = self.hall.verdict()?;
        let drops = midshift_sim::world::lock(&self.hall.worlds()[0]).judge().drops_by_task();
        self.check("no step is done twice", verdict.steps_done_twice == 0, || format!("{verdict:?}"));
        self.check("no place was too full", verdict.exclusion_violations == 0, || format!("{verdict:?}"));
        for (task_id, times) in &drops {
            let found = || format!("the item of {task_id} was put down {times} times");
            self.check("nobody's work is given twice", *times <= 1, found);
        }
        let asked = self.asked.load(Relaxed);
        let mut succeeded = 0;
        for nth in 0..asked {
            let name = task_name(nth);
            let asked = GetTaskRequest { task_id: name.clone() };
            let got = self.server.tasks()?.get_task(asked).await?.into_inner();
            let (task, attempts) = (got.task.context("an answer without a task")?, got.attempts);
            succeeded += u64::from(task.state() == TaskState::Succeeded);
            if attempts.iter().any(|attempt| players.contains(&attempt.robot_id)) {
                continue;
            }
            let times = drops.iter().find(|(id, _)| id.as_str() == name).map_or(0, |(_, times)| *times);
            let is_done = task.state() == TaskState::Succeeded && times == 1;
            self.check("honest robots' tasks go on", is_done, || format!("put down {times} times: {task:?}"));
        }
        let metrics = Metrics(page(self.server.address, "/metrics").await.context("the server has no metrics")?);
        ensure!(metrics.sum("midshift_telemetry_heartbeats_total", "") > 0, "the metrics count nothing");
        let counted = metrics.sum("midshift_fleet_tasks_ended_total", "state=\"SUCCEEDED\"");
        self.check("what is done is counted once", counted == succeeded, || format!("{counted} of {succeeded}"));
        let unexplained = metrics.sum("midshift_fleet_unexplained_total", "");
        self.check("nothing stands unexplained", unexplained == 0, || format!("{unexplained} robots and tasks"));
        let lost = metrics.sum("midshift_fleet_items_lost_total", "conflict=\"false\"");
        self.check("what the store refuses for good is not composed again", lost == 0, || format!("{lost} items"));
        let grown = self.memory_kib()?.saturating_sub(self.before_kib);
        let before_kib = self.before_kib;
        self.check("memory is bounded", grown <= GROWTH_KIB, || format!("{grown} KiB more than {before_kib}"));
        let log = std::fs::read_to_string(self._dir.path().join("server.log"))?;
        self.check("nothing panics", !log.contains("panicked at"), || "see the server's log".to_owned());
        say!("{asked} tasks, memory {before_kib} KiB and {grown} more, {verdict:?}");
        Ok(())
    }
    /// Notes what is known of a session's end: one that the server ended without a reason breaks a law.
    pub fn ended(&mut self, robot_id: &str, ends: &BTreeMap<String, (u64, bool)>) {
        for (end, (times, is_told)) in ends {
            self.check("the server says why it ends a session", *is_told, || {
                format!("{robot_id}, {times} times: {end}")
            });
        }
    }
}

/// It works on a step, or names what it waits for.
fn is_told(reason: &Reason) -> bool {
    reason.code == "WORKS_ON_STEP" || reason.metadata.get("waits_for").is_some_and(|what| !what.is_empty())
}

fn code_of(incident: &Incident) -> String {
    incident.reason.as_ref().map(|reason| reason.code.clone()).unwrap_or_default()
}

fn fact<'i>(incident: &'i Incident, key: &str) -> Option<&'i String> {
    incident.reason.as_ref().and_then(|reason| reason.metadata.get(key))
}

/// "Not now", "not any more" and "somebody was faster" are answers; a person looks again.
fn answered<T>(result: Result<T, tonic::Status>) -> anyhow::Result<()> {
    use tonic::Code::{Aborted, AlreadyExists, FailedPrecondition, NotFound};
    match result {
        Err(status) if ![Aborted, AlreadyExists, FailedPrecondition, NotFound].contains(&status.code()) => {
            Err(status.into())
        }
        _ => Ok(()),
    }
}
