//! One seed from its first fault to the end of every task, and what came of it.

use crate::client::Wish;
use crate::disk::Mood;
use crate::net::{SERVER, Way};
use crate::plan::{Fault, Plan, ROBOTS};
use crate::room::{CLIENT, Naive, Room, RoomConfig, machine, site};
use midshift_core::task::machine::Phase;
use midshift_proto::task::v1::CancelTaskRequest;
use midshift_sim::faults::FaultRates;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// When the faults are over every task must end within this, milliseconds: longer than a task waits for the one robot that has its
/// item and that the breaker took out of dispatch.
const END_WITHIN_MS: u64 = 1_800_000;

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
    let run = catch_unwind(AssertUnwindSafe(|| Shift::open(seed, naive).map(Shift::run)));
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
    ways: Vec<Way>,
    server_down: bool,
    agents_down: Vec<bool>,
    mood: Mood,
    begun: usize,
    wished: usize,
    planned: BTreeMap<&'static str, u64>,
    hits: BTreeMap<&'static str, u64>,
}

impl Shift {
    fn open(seed: u64, naive: Naive) -> anyhow::Result<Self> {
        let plan = Plan::draw(seed, &*site()?)?;
        let faults = FaultRates { jam_per_action: 0.0, silence_per_hour: 0.0, ..FaultRates::default() };
        let config = RoomConfig { seed, skews: plan.skews.clone(), latency_ms: plan.latency_ms, faults, naive };
        Ok(Self {
            room: Room::open(&config)?,
            plan,
            ways: vec![Way::Open; ROBOTS + 1],
            server_down: false,
            agents_down: vec![false; ROBOTS],
            mood: Mood::GOOD,
            begun: 0,
            wished: 0,
            planned: BTreeMap::new(),
            hits: BTreeMap::new(),
        })
    }

    fn run(mut self) -> Outcome {
        if let Err(error) = self.shift() {
            let mut seen = self.room.observer.look();
            if seen.findings().is_empty() {
                seen.find(format!("{error:#}"));
            }
        }
        self.hits.extend(self.room.disk.hits());
        self.hits.extend(self.room.wire.hits());
        self.hits.insert("answer a client never got", self.room.desk.unanswered.get());
        let seen = self.room.observer.look();
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
            anyhow::ensure!(self.room.observer.look().findings().is_empty(), "a law is broken");
        }
        self.suffer();
        let tasks = self.plan.tasks.len();
        let ended = self.room.until("the end of every task", END_WITHIN_MS, |room| {
            let seen = room.observer.look();
            let over = |p: Phase| p.is_terminal() || p == Phase::NeedsOperator;
            room.desk.is_empty() && seen.tasks().len() == tasks && seen.tasks().values().all(|t| over(t.phase))
        });
        if ended.is_err() {
            self.say_open();
        }
        ended?;
        self.judge()
    }

    /// I8: what is still open, in words.
    fn say_open(&self) {
        let mut seen = self.room.observer.look();
        let over = |p: Phase| p.is_terminal() || p == Phase::NeedsOperator;
        let open: Vec<String> = seen.tasks().values().filter(|t| !over(t.phase)).map(|t| format!("{t:?}")).collect();
        if seen.findings().is_empty() {
            seen.find(format!("I8 every task ends: {} are open: {}", open.len(), open.join("; ")));
        }
    }

    fn judge(&self) -> anyhow::Result<()> {
        let verdict = self.room.hall.verdict()?;
        let refused = self.room.desk.refused.borrow();
        let drops = midshift_sim::world::lock(&self.room.hall.worlds()[0]).oracle().drops_by_task();
        let mut seen = self.room.observer.look();
        seen.check("I8 every task ends", true, String::new);
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
        while let Some(window) = self.plan.windows.get(self.begun).filter(|w| w.from_ms <= now_ms).cloned() {
            self.begun += 1;
            self.count(&window.fault);
        }
        let now: Vec<Fault> =
            self.plan.windows[..self.begun].iter().filter(|w| w.to_ms > now_ms).map(|w| w.fault.clone()).collect();
        for robot in 0..ROBOTS {
            self.set_way(robot, way(&now, robot));
            let deaf = now.iter().any(|f| matches!(f, Fault::HoldDown(r) if r.contains(&robot)));
            self.room.ears[robot].hold(deaf);
            self.room.wire.set_deaf(&machine(robot), deaf);
        }
        self.set_way(ROBOTS, if now.contains(&Fault::ClientCut) { Way::Cut } else { way(&now, ROBOTS) });
        let down = now.iter().any(|f| matches!(f, Fault::ServerCrash { .. }));
        if down != self.server_down {
            self.server_down = down;
            if down { self.room.crash_server() } else { self.room.restart_server() }
        }
        for robot in 0..ROBOTS {
            let down = now.iter().any(|f| matches!(f, Fault::AgentCrash { robot: r, .. } if *r == robot));
            if down != self.agents_down[robot] {
                self.agents_down[robot] = down;
                if down { self.room.crash_agent(robot) } else { self.room.restart_agent(robot) }
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

    /// Counts a fault as planned, and as a hit if a process dies at work.
    fn count(&mut self, fault: &Fault) {
        let hit = {
            let seen = self.room.observer.look();
            match fault {
                Fault::AgentCrash { robot, .. } => seen
                    .is_held(self.room.hall.robots()[*robot].robot_id())
                    .then_some("agent crash with work in progress"),
                Fault::ServerCrash { .. } => seen.live().next().map(|_| "server crash with work in progress"),
                _ => None,
            }
        };
        *self.planned.entry(fault.name()).or_insert(0) += 1;
        if let Some(hit) = hit {
            *self.hits.entry(hit).or_insert(0) += 1;
        }
    }

    fn set_way(&mut self, index: usize, way: Way) {
        let old = std::mem::replace(&mut self.ways[index], way);
        if old == way {
            return;
        }
        let other = if index == ROBOTS { CLIENT.to_owned() } else { machine(index) };
        let (sim, other) = (&self.room.sim, other.as_str());
        self.room.wire.set_way(other, way);
        match old {
            Way::Open => {}
            Way::Cut => sim.repair(SERVER, other),
            Way::CutDown => sim.repair_oneway(SERVER, other),
            Way::CutUp => sim.repair_oneway(other, SERVER),
            Way::Held => sim.release(SERVER, other),
        }
        match way {
            Way::Open => {}
            Way::Cut => sim.partition(SERVER, other),
            Way::CutDown => sim.partition_oneway(SERVER, other),
            Way::CutUp => sim.partition_oneway(other, SERVER),
            Way::Held => sim.hold(SERVER, other),
        }
    }
}

/// The worst of what is under way for one machine.
fn way(now: &[Fault], index: usize) -> Way {
    let of_one = |fault: &Fault| match fault {
        Fault::ServerCrash { power: true } => Way::Cut,
        Fault::Partition(robots) if robots.contains(&index) => Way::Cut,
        Fault::AgentCrash { robot, power: true } if *robot == index => Way::Cut,
        Fault::Deaf(robot) if *robot == index => Way::CutDown,
        Fault::Mute(robot) if *robot == index => Way::CutUp,
        Fault::Hold(robot) if *robot == index => Way::Held,
        _ => Way::Open,
    };
    let ways: Vec<Way> = now.iter().map(of_one).collect();
    let worst = [Way::Cut, Way::CutDown, Way::CutUp, Way::Held];
    worst.into_iter().find(|w| ways.contains(w)).unwrap_or_default()
}

fn mood(now: &[Fault]) -> Mood {
    Mood {
        slow_ms: if now.contains(&Fault::DiskSlow) { 600 } else { Mood::GOOD.slow_ms },
        unknown_permille: if now.contains(&Fault::DiskUnknown) { 150 } else { 0 },
        gone: now.contains(&Fault::DiskGone),
    }
}
