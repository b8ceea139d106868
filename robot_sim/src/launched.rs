//! Stands in for the launcher of each robot of a swarm, and for what a robot's program does with the set that it is
//! started from.
//!
//! Which set starts, its tries and its end on trial are decided as for a real robot ([`midshift_agent::start_policy`]);
//! of the set only `behaviour.toml` is read. Invariant: the switch record is written here only while no agent of that
//! robot runs. Called by [`crate::swarm`] and by simulations.

use crate::behaviour::{Behaviour, COMPONENT, FILE_BYTES_MAX};
use crate::handle::SimHandle;
use midshift_agent::bulk::Bulk;
use midshift_agent::session::Updates;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::sets::{self, Holdings, Sets};
use midshift_agent::start_policy::{self, Tries};
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_agent::update::UpdateConfig;
use midshift_agent::update::io::UpdateWorker;
use midshift_agent::update::remote::GrpcRemote;
use midshift_core::time::SiteTime;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Bytes of software that one robot of a swarm keeps in memory: settings, not programs.
pub const MEMORY_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// Opens the sets of one robot, in memory or in a folder, as often as needed.
#[derive(Clone, Debug)]
enum SetStorage {
    Memory(MemorySets),
    Dir(PathBuf),
}

/// The launcher of one robot.
pub struct Launched {
    storage: SetStorage,
    tries: Arc<Mutex<Tries>>,
    /// What it does and says with what it came with.
    factory: (Behaviour, String),
}

/// How a start went.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Start {
    /// The program ended at once.
    Dead(String),
    /// It runs, and hangs after so long, real time.
    Runs {
        /// None: it does not.
        hangs_after: Option<Duration>,
    },
}

fn lock(tries: &Mutex<Tries>) -> MutexGuard<'_, Tries> {
    tries.lock().unwrap_or_else(PoisonError::into_inner)
}

impl SetStorage {
    fn open(&self) -> Result<Box<dyn Sets>, sets::Error> {
        Ok(match self {
            Self::Memory(sets) => Box::new(sets.clone()),
            Self::Dir(dir) => Box::new(DiskSets::open(dir)?),
        })
    }
}

impl Launched {
    /// For a robot whose sets are in the folder `dir`, or in memory; its body is as it came.
    pub fn new(dir: Option<&Path>, robot: &SimHandle) -> Self {
        let storage = match dir {
            Some(dir) => SetStorage::Dir(dir.to_owned()),
            None => {
                let sets = MemorySets::new();
                sets.limit(MEMORY_BYTES_MAX);
                SetStorage::Memory(sets)
            }
        };
        let body = robot.lock();
        let (behaviour, version) = body.software();
        Self { storage, tries: Arc::default(), factory: (behaviour.clone(), version.to_owned()) }
    }

    /// Begins a start: counts it, and lets the body behave and call itself as the set that runs says.
    ///
    /// # Errors
    /// Sets that cannot be read: nothing is started.
    pub fn start(&self, robot: &SimHandle, now: SiteTime) -> Result<Start, sets::Error> {
        let mut sets = self.storage.open()?;
        let mut holdings = sets.holdings()?;
        let mut tries = lock(&self.tries);
        let tried = holdings.switch.running().to_owned();
        if let Some(had) = start_policy::put_away(&mut holdings.switch, &tries) {
            tracing::warn!(robot_id = %robot.robot_id(), set = tried, tries = had, "set did not live and was put away");
            sets.write_switch(&mut holdings.switch)?;
        }
        let running = holdings.switch.running();
        *tries = tries.plus_one(running);
        let behaviour = match self.behaviour(&mut *sets, &holdings) {
            Ok(behaviour) => behaviour,
            Err(why) => return Ok(Start::Dead(why)),
        };
        let on_probation = holdings.switch.trial.as_ref().is_some_and(|trial| !trial.is_proven);
        let hangs_after = behaviour.hang_in_probation_after_ms.filter(|_| on_probation).map(Duration::from_millis);
        let crashes = behaviour.crash_on_start;
        let version = holdings.version(running).unwrap_or_else(|| self.factory.1.clone());
        robot.lock().run_software(now, behaviour, version);
        if crashes {
            return Ok(Start::Dead(format!("set {running} crashes at its start, as its {COMPONENT} says")));
        }
        Ok(Start::Runs { hangs_after })
    }

    /// What the set that runs says. An error ends a program at its start.
    fn behaviour(&self, sets: &mut dyn Sets, holdings: &Holdings) -> Result<Behaviour, String> {
        let running = holdings.switch.running();
        if holdings.set(running).is_none() {
            return Err(format!("set {running} is not there"));
        }
        let Some(file) = holdings.settings(running, COMPONENT) else {
            // A set without one, as the factory's: the body behaves as it came.
            return Ok(self.factory.0.clone());
        };
        let bytes = sets.read(&file.digest, FILE_BYTES_MAX).map_err(|e| e.to_string())?;
        let text = String::from_utf8(bytes).map_err(|e| e.to_string())?;
        Behaviour::parse(&text).map_err(|refusal| refusal.to_string())
    }

    /// What the agent changes its software with.
    ///
    /// # Errors
    /// Sets that cannot be opened.
    pub fn updates(&self, trust: &TrustAnchors, bulk: Bulk) -> Result<Updates, sets::Error> {
        let config = UpdateConfig { is_launched: true, ..trust.config() };
        let worker = UpdateWorker::new(self.storage.open()?, Arc::new(GrpcRemote::new(bulk)));
        Ok(Updates { config, worker: Box::new(worker) })
    }

    /// What lies on its disk.
    ///
    /// # Errors
    /// Sets that cannot be read.
    pub fn holdings(&self) -> Result<Holdings, sets::Error> {
        self.storage.open()?.holdings()
    }

    /// The set that runs has had its tries: one on trial is put away at the next start.
    ///
    /// # Errors
    /// Sets that cannot be read.
    pub fn use_up_tries(&self) -> Result<(), sets::Error> {
        let holdings = self.holdings()?;
        *lock(&self.tries) = Tries::new(holdings.switch.running(), start_policy::TRIES_MAX);
        Ok(())
    }

    /// The power goes: what was not synced is gone. A folder on a real disk knows no such thing.
    pub fn lose_power(&self) {
        if let SetStorage::Memory(sets) = &self.storage {
            sets.lose_power();
        }
    }

    /// Hears the agent's pulse: one that runs well clears its tries.
    pub fn pulse(&self) -> Box<dyn FnMut() + Send> {
        let (kept, tries) = (self.storage.clone(), self.tries.clone());
        let mut pulses = 0_u32;
        Box::new(move || {
            pulses = pulses.saturating_add(1);
            if start_policy::is_well(pulses)
                && let Ok(holdings) = kept.open().and_then(|mut sets| sets.holdings())
                && start_policy::is_trusted(&holdings.switch)
            {
                *lock(&tries) = Tries::default();
            }
        })
    }

    /// The agent ended to be started again from the switch record.
    pub fn switched(&self) {
        *lock(&self.tries) = Tries::default();
    }

    /// Time before the next start of a program that did not end well.
    pub fn pause(&self) -> Duration {
        lock(&self.tries).pause()
    }
}
