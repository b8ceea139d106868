//! One robot's machine: its launcher, the agent that it starts, and what outlives both.
//!
//! Invariant: ledger, sets and tries outlive the process; everything else dies with it.

use crate::body::WatchedBody;
use crate::clock::{MachineClock, Skew, TrueTime};
use crate::disk::RobotDisk;
use crate::net::{Ear, SERVER, SimDial, Wire, machine};
use crate::newer::{Newer, Voice};
use crate::observer::Shared;
use crate::stops;
use crate::worker::SlowWorker;
use midshift_agent::body::Body;
use midshift_agent::bugs::Bugs;
use midshift_agent::bulk::Bulk;
use midshift_agent::core::ExitReason;
use midshift_agent::memory::MemoryStore as RobotMemoryStore;
use midshift_agent::session::{self, AgentConfig, Lines, Updates};
use midshift_agent::start_policy::HANG_SECONDS;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_core::robot::StopLevel;
use midshift_core::time::Clock;
use midshift_sim::handle::SimHandle;
use midshift_sim::launched::{Launched, Start};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// What one robot's processes are made of, each time they start.
#[derive(Clone)]
pub struct Agent {
    /// Its number.
    pub robot: usize,
    /// Of the run.
    pub seed: u64,
    /// Its body.
    pub body: SimHandle,
    /// True time.
    pub time: TrueTime,
    /// The witness.
    pub observer: Shared,
    /// How wrong its clocks are.
    pub skew: Skew,
    /// What it hears with.
    pub ear: Ear,
    /// Who counts what is lost.
    pub wire: Wire,
    /// Its line to the stop service, and what it keeps of stops; none: it has no such line.
    pub stop: Option<stops::RobotLine>,
    /// Ledger and ring.
    pub memory: RobotMemoryStore,
    /// Its sets, and who starts them.
    pub launched: Arc<Launched>,
    /// What it believes.
    pub trust: TrustAnchors,
    /// Naive rules.
    pub bugs: Bugs,
    /// Which of its programs are of the next version; none: nobody asks.
    pub newer: Option<Newer>,
    /// Processes so far.
    pub lives: Arc<AtomicU64>,
}

/// How a process ended.
enum Ended {
    /// To be started again from the switch record.
    Switched,
    /// Its launcher killed it.
    Killed,
}

impl Agent {
    /// The launcher of a machine that was just switched on: starts the agent again and again.
    pub async fn live(self) -> anyhow::Result<()> {
        let number = self.number(self.lives.load(Relaxed));
        // Machines are not switched on in the same moment.
        let mut pause = Duration::from_millis(number % 700);
        loop {
            tokio::time::sleep(pause).await;
            let life = self.lives.fetch_add(1, Relaxed);
            self.observer.lock().restarted(self.body.robot_id());
            let start = self.launched.start(&self.body, self.time.site())?;
            self.note_start()?;
            let Start::Runs { hangs_after } = start else {
                self.observer.lock().count("program died at its start");
                pause = self.launched.pause();
                continue;
            };
            pause = match self.run(life, hangs_after).await? {
                Ended::Switched => {
                    self.launched.switched();
                    Duration::ZERO
                }
                Ended::Killed => self.launched.pause(),
            };
            let mut body = self.body.clone();
            body.stop(self.time.site(), StopLevel::Halt);
            body.poll(self.time.site());
        }
    }

    /// The witness looks at what is started.
    fn note_start(&self) -> anyhow::Result<()> {
        let holdings = self.launched.holdings()?;
        let running = holdings.set(holdings.switch.running());
        self.observer.starts(self.body.robot_id(), &holdings.switch, running.as_ref());
        Ok(())
    }

    fn number(&self, life: u64) -> u64 {
        self.seed.wrapping_mul(1_000_003) + self.robot as u64 * 1_009 + life
    }

    async fn run(&self, life: u64, hangs_after: Option<Duration>) -> anyhow::Result<Ended> {
        let (robot_id, number) = (self.body.robot_id().clone(), self.number(life));
        let voice = self.voice()?;
        let bulk = Bulk::new(Arc::new(self.dial(voice.clone())));
        let updates = self.launched.updates(&self.trust, bulk.clone())?;
        let worker = SlowWorker::new(updates.worker, self.launched.clone(), &robot_id, &self.observer, number);
        let config = AgentConfig {
            stop: self.stop.as_ref().map(|line| line.dial(machine(self.robot), voice.clone())),
            update: Some(Updates { worker: Box::new(worker), ..updates }),
            robot_id: robot_id.clone(),
            boot_id: format!("boot-{}-{life}", self.robot),
            new_ring_id: format!("ring-{}-{life}", self.robot),
            seed: number,
            bugs: self.bugs,
            pulse: Some(self.launched.pulse()),
        };
        let witness = WatchedBody::new(self.body.clone(), self.observer.clone());
        let disk = RobotDisk::open(self.memory.clone(), robot_id.clone(), self.observer.clone(), number);
        let clock: Arc<dyn Clock> = MachineClock::boot(&self.time, self.skew);
        let never = CancellationToken::new();
        let lines = Lines { link: Arc::new(self.dial(voice)), bulk };
        let agent = session::run(config, Box::new(witness), Box::new(disk), clock, lines, never);
        tokio::pin!(agent);
        let hang = async {
            match hangs_after {
                Some(after) => tokio::time::sleep(after).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            ended = &mut agent => match ended? {
                ExitReason::Switched => return Ok(Ended::Switched),
                end => {
                    self.observer.lock().find(format!("the agent of {robot_id} ended: {end:?}"));
                    std::future::pending::<()>().await;
                }
            },
            () = hang => {}
        }
        // It is left where it is, with its connection, until its launcher kills it.
        self.observer.lock().count("program hung");
        tokio::time::sleep(Duration::from_secs(HANG_SECONDS)).await;
        Ok(Ended::Killed)
    }

    /// Of the program that runs now.
    fn voice(&self) -> anyhow::Result<Option<Voice>> {
        let Some(newer) = &self.newer else { return Ok(None) };
        let holdings = self.launched.holdings()?;
        let bundle = holdings.set(holdings.switch.running()).and_then(|set| set.bundle);
        Ok(Some(newer.voice(self.robot, bundle.map(|bundle| bundle.to_string()))))
    }

    fn dial(&self, voice: Option<Voice>) -> SimDial {
        SimDial { to: SERVER, ear: self.ear.clone(), machine: machine(self.robot), wire: self.wire.clone(), voice }
    }
}
