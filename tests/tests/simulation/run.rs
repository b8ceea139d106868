//! One seed from its first fault to the end of every task, and what came of it.

use crate::client::Wish;
use crate::counted;
use crate::disk::Mood;
use crate::incidents;
use crate::net::{LineState, SERVER, machine};
use crate::orders::Order;
use crate::plan::{Deed, Fault, Plan, ROBOTS};
use crate::room::{CLIENT, Naive, Room, RoomConfig, site};
use midshift_core::site::DEMO;
use midshift_core::task::TaskState;
use midshift_core::task::machine::Phase;
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_proto::ota::v1::{RolloutSelector, RolloutSpec, RolloutWave};
use midshift_proto::task::v1::CancelTaskRequest;
use midshift_sim::faults::FaultRates;
use std::collections::{BTreeMap, BTreeSet};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// When the faults are over every task must end within this, milliseconds: longer than a task waits for the one robot that has its
/// item and that the breaker took out of dispatch.
const END_WITHIN_MS: u64 = 1_800_000;
/// People look after what waits for them this often, milliseconds.
const LOOK_AFTER_MS: u64 = 20_000;

/// What came of one seed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// What was broken.
    pub findings: Vec<String>,
    /// One number of everything that happened.
    pub hash: u64,
    /// True time, milliseconds.
    pub lasted_ms: u64,
    /// How often each law was looked at.
    pub checks: BTreeMap<&'static str, u64>,
    /// What was seen, by name.
    pub counts: BTreeMap<String, u64>,
    /// What was to go wrong, by name.
    pub planned: BTreeMap<&'static str, u64>,
    /// What was really hit, by name.
    pub hits: BTreeMap<&'static str, u64>,
}

/// Runs a seed.
pub fn run(seed: u64, naive: Naive) -> Outcome {
    outcome_of(|| Shift::open(seed, naive).map(Shift::run))
}

/// Plays a seed to its end; a room that does not open and a panic are findings.
pub fn outcome_of(play: impl FnOnce() -> anyhow::Result<Outcome>) -> Outcome {
    let run = catch_unwind(AssertUnwindSafe(play));
    let broken = |what: String| Outcome { findings: vec![what], ..Outcome::default() };
    match run {
        Ok(Ok(outcome)) => outcome,
        Ok(Err(error)) => broken(format!("the room could not be opened: {error:#}")),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()));
            broken(format!("panicked: {}", text.unwrap_or_default()))
        }
    }
}

struct Shift {
    room: Room,
    plan: Plan,
    server_down: bool,
    agents_down: Vec<bool>,
    mood: Mood,
    begun: usize,
    wished: usize,
    /// Deeds done, and roll-outs among them.
    done: usize,
    rollouts: usize,
    /// Robots that a person must let go on, and how often somebody did.
    stopped: BTreeSet<usize>,
    let_go: u64,
    planned: BTreeMap<&'static str, u64>,
    hits: BTreeMap<&'static str, u64>,
}

impl Shift {
    fn open(seed: u64, naive: Naive) -> anyhow::Result<Self> {
        // Counters are counted from the first on.
        midshift_process::recorder::handle();
        let plan = Plan::draw(seed, &*site()?)?;
        let faults = FaultRates { jam_per_action: 0.0, silence_per_hour: 0.0, ..FaultRates::default() };
        let config = RoomConfig {
            seed,
            robots: ROBOTS,
            skews: plan.skews.clone(),
            latency_ms: plan.latency_ms,
            faults,
            naive,
            planners: 1,
            stops: false,
            site: DEMO.to_owned(),
            players: Vec::new(),
            newer: None,
        };
        Ok(Self {
            room: Room::open(&config)?,
            plan,
            server_down: false,
            agents_down: vec![false; ROBOTS],
            mood: Mood::GOOD,
            begun: 0,
            wished: 0,
            done: 0,
            rollouts: 0,
            stopped: BTreeSet::new(),
            let_go: 0,
            planned: BTreeMap::new(),
            hits: BTreeMap::new(),
        })
    }

    fn run(mut self) -> Outcome {
        if let Err(error) = self.shift() {
            let mut seen = self.room.observer.lock();
            if seen.findings().is_empty() {
                seen.find(format!("{error:#}"));
            }
        }
        self.hits.extend(self.room.disk.hits());
        self.hits.extend(self.room.wire.hits());
        self.hits.insert("answer a client never got", self.room.desk.unanswered.get());
        self.hits.insert("status sent beside a session", replayed());
        let seen = self.room.observer.lock();
        Outcome {
            findings: seen.findings().to_vec(),
            hash: seen.hash(),
            lasted_ms: self.room.now_ms(),
            checks: seen.checks().clone(),
            counts: seen.counts().clone(),
            planned: self.planned,
            hits: self.hits,
        }
    }

    fn shift(&mut self) -> anyhow::Result<()> {
        let quiet_ms = self.plan.quiet_from_ms();
        while self.room.now_ms() <= quiet_ms {
            self.suffer();
            self.room.step()?;
            anyhow::ensure!(self.room.observer.lock().findings().is_empty(), "a law is broken");
        }
        self.suffer();
        let ended = self.end();
        if ended.is_err() {
            self.say_open();
        }
        ended?;
        self.judge()
    }

    /// Waits for the end of everything; people look after what waits for them.
    fn end(&mut self) -> anyhow::Result<()> {
        let tasks = self.plan.tasks.len();
        let end_ms = self.room.now_ms() + END_WITHIN_MS;
        loop {
            self.look_after();
            let round_ms = self.room.now_ms() + LOOK_AFTER_MS;
            let mut is_over = false;
            self.room.until("one round", 2 * LOOK_AFTER_MS, |room| {
                let mut seen = room.observer.lock();
                let over = |p: Phase| p.is_terminal() || p == Phase::NeedsOperator;
                is_over = room.desk.is_empty()
                    && seen.tasks().len() == tasks
                    && seen.tasks().values().all(|t| over(t.phase))
                    && seen.changes().ended().iter().all(|(_, holds, _)| *holds);
                is_over || room.now_ms() >= round_ms
            })?;
            if is_over {
                return Ok(());
            }
            anyhow::ensure!(
                self.room.now_ms() < end_ms,
                "{} s passed in vain for the end of everything",
                END_WITHIN_MS / 1_000
            );
        }
    }

    /// A person lets robots go on that were stopped or broken off with a task that is theirs, and settles roll-outs that wait for one.
    fn look_after(&mut self) {
        self.let_go += 1;
        for robot in self.stopped.clone() {
            let robot_id = self.room.robot_id(robot).to_string();
            self.order(Order::LetGo { robot_id, request_id: format!("go-{robot}-{}", self.let_go) });
        }
        let waits = |t: &&TaskState| matches!(t.phase, Phase::Queued | Phase::NeedsOperator);
        let bound: BTreeSet<String> = self
            .room
            .observer
            .lock()
            .tasks()
            .values()
            .filter(waits)
            .filter_map(|t| t.opened_robot_id.as_ref())
            .map(|r| r.to_string())
            .collect();
        bound.into_iter().for_each(|robot_id| self.order(Order::Uncordon(robot_id)));
        let rollouts: Vec<String> =
            self.room.observer.lock().changes().rollouts().map(|r| r.rollout_id.to_string()).collect();
        rollouts.into_iter().for_each(|id| self.order(Order::Settle(id)));
    }
    fn order(&self, order: Order) {
        self.room.desk.wish(Wish::Order(Box::new(order)));
    }

    /// I8: what is still open, in words.
    fn say_open(&self) {
        let mut seen = self.room.observer.lock();
        let over = |p: Phase| p.is_terminal() || p == Phase::NeedsOperator;
        let open: Vec<String> = seen.tasks().values().filter(|t| !over(t.phase)).map(|t| format!("{t:?}")).collect();
        if seen.findings().is_empty() && open.is_empty() {
            seen.changes_ended();
        }
        if seen.findings().is_empty() {
            seen.find(format!("I8 every task ends: {} are open: {}", open.len(), open.join("; ")));
        }
    }

    fn judge(&self) -> anyhow::Result<()> {
        let verdict = self.room.hall.verdict()?;
        let refused = self.room.desk.refused.borrow();
        let drops = midshift_sim::world::lock(&self.room.hall.worlds()[0]).judge().drops_by_task();
        let mut seen = self.room.observer.lock();
        counted::nothing_stands_unexplained(&counted::counted(), &mut seen);
        incidents::nobody_is_blamed(&self.room.store, &mut seen);
        seen.check("I8 every task ends", true, String::new);
        seen.changes_ended();
        seen.check("I3 items are conserved", verdict.items_conserved(), || format!("{verdict:?}"));
        seen.check("I4 no step is done twice", verdict.steps_done_twice == 0, || format!("{verdict:?}"));
        seen.check("I7 no place was too full", verdict.exclusion_violations == 0, || format!("{verdict:?}"));
        seen.check("I1 no client is refused", refused.is_empty(), || format!("{refused:?}"));
        let tasks = seen.tasks().values().filter(|t| t.phase == Phase::Succeeded);
        let done: Vec<_> = tasks.map(|t| (t.task_id.clone(), drops.get(&t.task_id).copied().unwrap_or(0))).collect();
        for (task_id, times) in done {
            seen.check("I3 what succeeded was put down once", times == 1, || {
                format!("{task_id} succeeded and its item was put down {times} times")
            });
        }
        Ok(())
    }

    // --- faults

    /// Begins and ends what is due.
    fn suffer(&mut self) {
        let now_ms = self.room.now_ms();
        self.wish(now_ms);
        self.do_deeds(now_ms);
        while let Some(window) = self.plan.windows.get(self.begun).filter(|w| w.from_ms <= now_ms).cloned() {
            self.begun += 1;
            self.count(&window.fault);
            if let Fault::HardwareStop(robot) = window.fault {
                self.room.stop_body(robot, window.to_ms - window.from_ms);
                self.stopped.insert(robot);
            }
        }
        let now: Vec<Fault> =
            self.plan.windows[..self.begun].iter().filter(|w| w.to_ms > now_ms).map(|w| w.fault.clone()).collect();
        for robot in 0..ROBOTS {
            self.set_way(robot, way(&now, robot));
            let deaf = now.iter().any(|f| matches!(f, Fault::HoldDown(r) if r.contains(&robot)));
            self.room.ears[robot].hold(deaf);
            self.room.wire.set_deaf(&machine(robot), deaf);
        }
        self.set_way(ROBOTS, if now.contains(&Fault::ClientCut) { LineState::Cut } else { way(&now, ROBOTS) });
        let down = now.iter().any(|f| matches!(f, Fault::ServerCrash { .. }));
        if down != self.server_down {
            self.server_down = down;
            if down { self.room.crash_server() } else { self.room.restart_server() }
        }
        for robot in 0..ROBOTS {
            let down = now.iter().any(|f| matches!(f, Fault::AgentCrash { robot: r, .. } if *r == robot));
            if down != self.agents_down[robot] {
                self.agents_down[robot] = down;
                let power = now.contains(&Fault::AgentCrash { robot, power: true });
                if down { self.room.crash_agent(robot, power) } else { self.room.restart_agent(robot) }
            }
        }
        let mood = mood(&now);
        if mood != self.mood {
            self.mood = mood;
            self.room.disk.set(mood);
        }
    }

    fn wish(&mut self, now_ms: u64) {
        while let Some((_, request)) = self.plan.tasks.get(self.wished).filter(|(at, _)| *at <= now_ms) {
            self.room.desk.wish(Wish::Submit(Box::new(request.clone())));
            self.wished += 1;
        }
        let tasks = &self.plan.tasks[..self.wished];
        let (due, later): (Vec<_>, Vec<_>) =
            self.plan.cancels.drain(..).partition(|(at, task)| *at <= now_ms && *task < tasks.len());
        self.plan.cancels = later;
        for (_, task) in due {
            let request = CancelTaskRequest {
                task_id: tasks[task].1.task_id.clone(),
                request_id: format!("cancel-{task}"),
                reason: "not wanted any more".to_owned(),
                ..CancelTaskRequest::default()
            };
            self.room.desk.wish(Wish::Cancel(request));
        }
    }

    fn do_deeds(&mut self, now_ms: u64) {
        while let Some((_, deed)) = self.plan.deeds.get(self.done).filter(|(at, _)| *at <= now_ms).cloned() {
            self.done += 1;
            let id = |number: usize| format!("rollout-{number}");
            let name = |robot: usize| self.room.robot_id(robot).to_string();
            let order = match deed {
                Deed::Begin { version, robots, supersede } => {
                    self.rollouts += 1;
                    let spec = Box::new(spec(&self.room, version, &robots));
                    Order::Begin { id: id(self.rollouts - 1), spec, supersede }
                }
                Deed::Rollback => Order::Rollback { of: id(0), id: "rollback-0".to_owned() },
                Deed::Pause(number) => Order::Pause(id(number)),
                Deed::Resume(number) => Order::Resume(id(number)),
                Deed::Abort(number) => Order::Abort(id(number)),
                Deed::Exclude(number, robot) => Order::Exclude(id(number), name(robot)),
                Deed::Pin(robot) => Order::Pin(name(robot)),
                Deed::Unpin(robot) => Order::Unpin(name(robot)),
                Deed::Block(place_id, lasts_ms) => Order::Block { place_id: place_id.to_owned(), lasts_ms },
            };
            self.order(order);
        }
    }

    /// Counts a fault as planned, and as a hit if a process dies at work.
    fn count(&mut self, fault: &Fault) {
        let mut hits = Vec::new();
        {
            let mut seen = self.room.observer.lock();
            let rolls = seen.changes().rollouts().any(|r| r.started.is_some() && !r.phase.is_over());
            match fault {
                Fault::AgentCrash { robot, .. } => {
                    let robot_id = self.room.hall.robots()[*robot].robot_id();
                    let works = seen.is_held(robot_id).then_some("agent crash with work in progress");
                    let state = seen.changes().state(robot_id).filter(|state| !state.is_over());
                    hits.extend(works.into_iter().chain(state.map(|_| "agent crash in a change of software")));
                }
                Fault::ServerCrash { .. } => {
                    let works = seen.live().next().map(|_| "server crash with work in progress");
                    hits.extend(works.into_iter().chain(rolls.then_some("server crash in a roll-out")));
                }
                Fault::HardwareStop(_) => hits.extend(rolls.then_some("hardware stop in a roll-out")),
                _ => {}
            }
        }
        *self.planned.entry(fault.name()).or_insert(0) += 1;
        hits.into_iter().for_each(|hit| *self.hits.entry(hit).or_insert(0) += 1);
    }

    fn set_way(&mut self, index: usize, way: LineState) {
        steer(&mut self.room, index, way);
    }
}

/// STATUS that the servers of this process took beside sessions, samples.
fn replayed() -> u64 {
    let metrics = midshift_process::recorder::handle().map(|handle| handle.render()).unwrap_or_default();
    let line = metrics.lines().find_map(|line| line.strip_prefix("midshift_telemetry_status_replayed_total "));
    line.and_then(|number| number.parse().ok()).unwrap_or(0)
}

/// Makes the way between the server and a machine so; the clients come after the robots.
pub fn steer(room: &mut Room, index: usize, way: LineState) {
    let other = if index == room.ears.len() { CLIENT.to_owned() } else { machine(index) };
    let (sim, other) = (&room.sim, other.as_str());
    let old = room.wire.set_way(other, way);
    if old == way {
        return;
    }
    match old {
        LineState::Open => {}
        LineState::Cut => sim.repair(SERVER, other),
        LineState::CutDown => sim.repair_oneway(SERVER, other),
        LineState::CutUp => sim.repair_oneway(other, SERVER),
        LineState::Held => sim.release(SERVER, other),
    }
    match way {
        LineState::Open => {}
        LineState::Cut => sim.partition(SERVER, other),
        LineState::CutDown => sim.partition_oneway(SERVER, other),
        LineState::CutUp => sim.partition_oneway(other, SERVER),
        LineState::Held => sim.hold(SERVER, other),
    }
}

/// A roll-out to these robots: one, then the others.
pub fn spec(room: &Room, version: &str, robots: &BTreeSet<usize>) -> RolloutSpec {
    let seconds = |s: i64| Some(prost_types::Duration { seconds: s, nanos: 0 });
    let robot_ids = robots.iter().map(|robot| room.robot_id(*robot).to_string()).collect();
    RolloutSpec {
        bundle: room.software.bundle(version).to_string(),
        selector: Some(RolloutSelector { robot_ids, ..RolloutSelector::default() }),
        waves: [Size::Count(1), Size::Rest(true)].map(|size| RolloutWave { size: Some(size) }).into(),
        drain_within: seconds(60),
        probation: seconds(3),
        soak: seconds(2),
        exposure_tasks: Some(0),
        exposure_within: seconds(30),
        ..RolloutSpec::default()
    }
}

/// The worst of what is under way for one machine.
fn way(now: &[Fault], index: usize) -> LineState {
    let of_one = |fault: &Fault| match fault {
        Fault::ServerCrash { power: true } => LineState::Cut,
        Fault::Partition(robots) if robots.contains(&index) => LineState::Cut,
        Fault::AgentCrash { robot, power: true } if *robot == index => LineState::Cut,
        Fault::Deaf(robot) if *robot == index => LineState::CutDown,
        Fault::Mute(robot) if *robot == index => LineState::CutUp,
        Fault::Hold(robot) if *robot == index => LineState::Held,
        _ => LineState::Open,
    };
    let ways: Vec<LineState> = now.iter().map(of_one).collect();
    let worst = [LineState::Cut, LineState::CutDown, LineState::CutUp, LineState::Held];
    worst.into_iter().find(|w| ways.contains(w)).unwrap_or_default()
}

fn mood(now: &[Fault]) -> Mood {
    Mood {
        slow_ms: if now.contains(&Fault::DiskSlow) { 600 } else { Mood::GOOD.slow_ms },
        unknown_permille: if now.contains(&Fault::DiskUnknown) { 150 } else { 0 },
        gone: now.contains(&Fault::DiskGone),
    }
}
