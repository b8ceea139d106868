//! The fleet of simulated robots of one process: who stands where at the start, who can be laid hands on, what
//! came of it.
//!
//! Invariant: with everything in memory all bodies share one world and one journal; in a directory each body has its
//! own, so that its process may die alone. Called by the swarm, the simulator's service and the report of `dev`.

use crate::body::{self, BodyConfig, Counts, JOURNAL_FILE, SimBody};
use crate::energy::EnergyScale;
use crate::faults::{FaultRates, Injected};
use crate::handle::SimHandle;
use crate::journal;
use crate::judge::{Judge, Verdict};
use crate::person::{Deed, Person};
use crate::world::{SharedWorld, World, WorldConfig, lock};
use midshift_core::ids::{RobotId, TaskId, WaypointId};
use midshift_core::site::{Kind, Site, Source, WaypointIx};
use midshift_core::time::{Now, SiteTime};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Why a fleet could not be opened or judged.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// More robots than seats.
    #[error("site {site} has seats for {found} robots, not for {asked}")]
    TooFewSeats {
        /// Id of the site.
        site: String,
        /// Robots wanted.
        asked: usize,
        /// Seats there are.
        found: usize,
    },
    /// The prefix makes no robot id.
    #[error("prefix {prefix:?}: {source}")]
    Prefix {
        /// As given.
        prefix: String,
        /// Why ids cannot begin so.
        source: midshift_core::ids::Error,
    },
    /// A body could not be made.
    #[error(transparent)]
    Body(#[from] body::Error),
    /// A journal could not be read.
    #[error(transparent)]
    Journal(#[from] journal::Error),
}

/// Where bodies keep what outlives the process.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Persistence {
    /// Nowhere: it ends with the process.
    Memory,
    /// In `<dir>/<robot_id>/`.
    Dir(PathBuf),
}

/// What fleet.
#[derive(Clone, Debug)]
pub struct FleetConfig {
    /// The site.
    pub site: Arc<Site>,
    /// Robots of the whole site: decides who starts where.
    pub count: usize,
    /// Which of them live here; `None`: all. Several processes take a part each.
    pub only: Option<std::ops::Range<usize>>,
    /// Decides all that is drawn.
    pub seed: u64,
    /// Names are the prefix and a number from 1.
    pub prefix: String,
    /// How often things go wrong.
    pub faults: FaultRates,
    /// Batteries empty by work.
    pub drains: bool,
    /// State of charge of every robot when it is made, permille; none: 600..=1000, drawn for each.
    pub battery_permille: Option<u16>,
    /// How fast they do, and how fast a charger fills them.
    pub energy: EnergyScale,
    /// Turning on the spot takes time.
    pub turns: bool,
    /// What a pick does not find is made on the spot.
    pub auto_stock: bool,
    /// More robots than seats stand in each other, and places are not judged.
    pub crowded: bool,
    /// Where to start, instead of the seats of the site.
    pub starts: Option<Vec<WaypointIx>>,
    /// Where bodies are kept.
    pub persistence: Persistence,
    /// How fast bodies work, thousandths; clocks are not touched.
    pub pace_permille: u32,
}

impl FleetConfig {
    /// A fleet for `dev`: all in memory, shelves that never run out, default faults, `rbt-01`, `rbt-02`, …
    pub fn new(site: Arc<Site>, count: usize, seed: u64) -> Self {
        Self {
            site,
            count,
            only: None,
            seed,
            prefix: "rbt-".to_owned(),
            faults: FaultRates::default(),
            drains: true,
            battery_permille: None,
            energy: EnergyScale::default(),
            turns: true,
            auto_stock: true,
            crowded: false,
            starts: None,
            persistence: Persistence::Memory,
            pace_permille: 1_000,
        }
    }
    /// The name of robot `index`, from 0: at least two digits, as many as the last one needs.
    pub fn robot_id(&self, index: usize) -> Result<RobotId, Error> {
        let digits = self.count.to_string().len().max(2);
        let name = format!("{}{:0digits$}", self.prefix, index + 1);
        RobotId::parse(&name).map_err(|source| Error::Prefix { prefix: self.prefix.clone(), source })
    }
    /// Where each robot of the site starts. On a grid: seeded, each on a cell of its own that is no charger.
    pub fn starting_waypoints(&self) -> Result<Vec<WaypointId>, Error> {
        let site = &self.site;
        let mut seats = match &self.starts {
            Some(starts) => starts.clone(),
            None if site.source() == Source::Grid && site.starts().is_empty() => {
                let cells = (0..site.waypoints().len() as u32).map(WaypointIx);
                let mut cells: Vec<_> = cells.filter(|at| site.waypoint(*at).kind != Kind::Charger).collect();
                cells.shuffle(&mut ChaCha8Rng::seed_from_u64(self.seed ^ 0x6772_6964));
                cells
            }
            None => {
                let robots = (0..self.count).map(|index| self.robot_id(index)).collect::<Result<Vec<_>, _>>()?;
                site.starts_of(&robots)
            }
        };
        let found = seats.len();
        if found < self.count && (!self.crowded || found == 0) {
            return Err(Error::TooFewSeats { site: site.site_id().to_string(), asked: self.count, found });
        }
        seats = seats.into_iter().cycle().take(self.count).collect();
        Ok(seats.into_iter().map(|at| site.name_of(at).clone()).collect())
    }
}

/// What a fleet reports at the end of a run.
#[derive(Clone, Debug, serde::Serialize)]
pub struct FleetReport {
    /// How many robots it had.
    pub robots: usize,
    /// What the journals say.
    pub verdict: Verdict,
    /// False: bodies may drive through each other, and places say nothing.
    pub collisions_modelled: bool,
    /// Millimetres driven by all.
    pub path_mm: u64,
    /// Of these, with a load.
    pub loaded_path_mm: u64,
    /// Milliwatt-hours spent by all.
    pub energy_mwh: u64,
    /// Sums over all.
    pub counts: Counts,
    /// Faults by the maker's code.
    pub faults_by_code: BTreeMap<u32, u64>,
    /// Journal entries that did not reach their file.
    pub journal_entries_lost: u64,
}

/// The fleet.
#[derive(Debug)]
pub struct Fleet {
    site: Arc<Site>,
    robots: Vec<SimHandle>,
    worlds: Vec<SharedWorld>,
    journals: Vec<PathBuf>,
    crowded: bool,
    person: Mutex<Person>,
}

impl Fleet {
    /// Makes or brings back every body that lives here.
    pub fn open(config: &FleetConfig, now: &Now) -> Result<Self, Error> {
        let starts = config.starting_waypoints()?;
        let part = config.only.clone().unwrap_or(0..config.count);
        let world = |tag: &str| WorldConfig {
            tag: tag.to_owned(),
            auto_stock: config.auto_stock,
            utc_base_ms: now.utc.0 - now.site.0 as i64,
            crowded: config.crowded,
        };
        let shared = World::new(world(""), &config.site).shared();
        let mut fleet = Self {
            site: config.site.clone(),
            robots: Vec::new(),
            worlds: Vec::new(),
            journals: Vec::new(),
            crowded: config.crowded,
            person: Mutex::new(Person::new(config.seed)),
        };
        for (index, start) in starts.into_iter().enumerate().filter(|(i, _)| part.contains(i)) {
            let robot_id = config.robot_id(index)?;
            let FleetConfig { faults, drains, battery_permille, energy, turns, pace_permille, .. } = *config;
            let of_body = BodyConfig {
                faults,
                drains,
                battery_permille,
                energy,
                turns,
                pace_permille,
                ..BodyConfig::new(robot_id.clone(), config.seed, start)
            };
            let body = match &config.persistence {
                Persistence::Memory => SimBody::new(of_body, config.site.clone(), shared.clone(), now.site)?,
                Persistence::Dir(dir) => {
                    let dir = dir.join(robot_id.as_str());
                    let own = world(robot_id.as_str());
                    let (body, world) = SimBody::restore(of_body, config.site.clone(), own, &dir, now.site)?;
                    fleet.worlds.push(world);
                    fleet.journals.push(dir.join(JOURNAL_FILE));
                    body
                }
            };
            fleet.robots.push(SimHandle::new(body));
        }
        if config.persistence == Persistence::Memory {
            fleet.worlds.push(shared);
        }
        Ok(fleet)
    }
    /// The site.
    pub fn site(&self) -> &Arc<Site> {
        &self.site
    }
    /// Every robot, by name.
    pub fn robots(&self) -> &[SimHandle] {
        &self.robots
    }
    /// One robot.
    pub fn robot(&self, robot_id: &RobotId) -> Option<&SimHandle> {
        self.robots.binary_search_by(|r| r.robot_id().cmp(robot_id)).ok().map(|i| &self.robots[i])
    }
    /// The worlds: one for all, or one a robot.
    pub fn worlds(&self) -> &[SharedWorld] {
        &self.worlds
    }
    /// Makes something go wrong. False: no such robot here.
    pub fn inject(&self, now: SiteTime, robot_id: &RobotId, what: Injected) -> bool {
        let robot = self.robot(robot_id);
        robot.inspect(|r| r.inject(now, what)).is_some()
    }
    /// The person goes round once; see [`Person::round`].
    pub fn person_round(&self, now: SiteTime, live: &dyn Fn(&TaskId) -> bool) -> Vec<Deed> {
        self.person.lock().unwrap_or_else(PoisonError::into_inner).round(now, &self.robots, live)
    }
    /// Files of the bodies' journals; empty while everything stays in memory.
    pub fn journals(&self) -> &[PathBuf] {
        &self.journals
    }
    /// What these journals of other processes say together with those of this fleet, which must have its own in files.
    ///
    /// # Errors
    /// A journal that cannot be read.
    pub fn verdict_with(&self, others: &[PathBuf]) -> Result<Verdict, Error> {
        let all = self.journals.iter().chain(others).map(PathBuf::as_path);
        Ok(Judge::read(&self.site, all)?.verdict())
    }
    /// What the journals say now. Several journals are read from their files.
    pub fn verdict(&self) -> Result<Verdict, Error> {
        match &self.worlds[..] {
            [world] => Ok(lock(world).judge().verdict()),
            _ if self.crowded => Ok(Verdict::default()),
            _ => Ok(Judge::read(&self.site, self.journals.iter().map(PathBuf::as_path))?.verdict()),
        }
    }
    /// All that can be said of the bodies at `now`.
    pub fn report(&self, now: SiteTime) -> Result<FleetReport, Error> {
        let mut report = FleetReport {
            robots: self.robots.len(),
            verdict: Verdict::default(),
            collisions_modelled: self.site.collisions_modelled(),
            path_mm: 0,
            loaded_path_mm: 0,
            energy_mwh: 0,
            counts: Counts::default(),
            faults_by_code: BTreeMap::new(),
            journal_entries_lost: self.worlds.iter().map(|w| lock(w).journal().lost()).sum(),
        };
        for robot in &self.robots {
            let mut body = robot.lock();
            body.advance(now);
            let (path_mm, loaded_mm) = body.odometers_mm();
            report.path_mm += path_mm;
            report.loaded_path_mm += loaded_mm;
            report.energy_mwh += body.energy_mwh();
            report.counts += body.counts();
            for (code, times) in body.faults_by_code() {
                *report.faults_by_code.entry(*code).or_insert(0) += times;
            }
        }
        report.verdict = self.verdict()?;
        Ok(report)
    }
}
