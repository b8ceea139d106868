//! What of a body outlives its process: the file that says where it stands, with what in its battery and which fault.
//!
//! Invariant: the load and the places it is in come from the journal, which is written before this file, so a kill between the
//! two loses neither.

use super::{BodyConfig, SimBody};
use crate::energy::Stores;
use crate::faults::draw_next;
use crate::journal::{self, Effect};
use crate::world::{SharedWorld, World, WorldConfig};
use midshift_core::ids::{RobotId, TaskId, WaypointId};
use midshift_core::robot::Fault;
use midshift_core::site::Site;
use midshift_core::time::SiteTime;
use nalgebra::{Isometry2, Vector2};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Name of the journal in a body's directory.
pub const JOURNAL_FILE: &str = "journal.jsonl";
/// Name of the body's own file.
const BODY_FILE: &str = "body.json";

/// Why a body could not be made or brought back.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Its start is not on the map.
    #[error("start {0} is no waypoint of the site")]
    UnknownStart(WaypointId),
    /// Its journal could not be used.
    #[error(transparent)]
    Journal(#[from] journal::Error),
    /// Its file could not be read or written.
    #[error("body file {path}: {source}")]
    File {
        /// The file of the body.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
}

/// The body's file.
#[derive(Serialize, Deserialize)]
struct Kept {
    life: u32,
    x_m: f64,
    y_m: f64,
    theta_rad: f64,
    last: Option<WaypointId>,
    touching: Option<WaypointId>,
    lane: Option<(WaypointId, WaypointId)>,
    charging: bool,
    parked: bool,
    broken: Option<Fault>,
    stores: Stores,
    odometer_mm: f64,
    loaded_mm: f64,
}

#[derive(Debug)]
pub(super) struct Keeper {
    dir: PathBuf,
    life: u32,
}

impl SimBody {
    /// A body that lives in a directory, with a world of its own in the same journal: new, or as the last process left it.
    /// It stands without an order. Returns it with its world.
    pub fn restore(
        config: BodyConfig,
        site: Arc<Site>,
        world: WorldConfig,
        dir: &Path,
        now: SiteTime,
    ) -> Result<(Self, SharedWorld), Error> {
        let failed = |path: &Path, source| Error::File { path: path.to_owned(), source };
        std::fs::create_dir_all(dir).map_err(|e| failed(dir, e))?;
        let path = dir.join(BODY_FILE);
        let kept: Option<Kept> = match std::fs::read(&path) {
            Ok(bytes) => Some(serde_json::from_slice(&bytes).map_err(|e| failed(&path, e.into()))?),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
            Err(error) => return Err(failed(&path, error)),
        };
        let journal_path = dir.join(JOURNAL_FILE);
        let memory = Memory::read(&journal_path, &config.robot_id)?;
        let world = World::restore(world, &site, &journal_path)?.shared();
        let mut body = Self::at_rest(config, site, world.clone(), now)?;
        body.inside = memory.inside;
        body.recent = memory.recent;
        body.load = body.load_from_world();
        let life = kept.as_ref().map_or(0, |k| k.life + 1);
        if let Some(kept) = kept {
            body.take_up(kept, life, now);
        }
        body.keeper = Some(Keeper { dir: dir.to_owned(), life });
        body.occupy(now);
        body.note_software(now);
        body.keep();
        Ok((body, world))
    }
    fn take_up(&mut self, kept: Kept, life: u32, now: SiteTime) {
        self.frame = Isometry2::new(Vector2::new(kept.x_m, kept.y_m), kept.theta_rad);
        self.last = kept.last;
        self.touching = kept.touching;
        self.lane = kept.lane;
        self.charging = kept.charging;
        self.parked = kept.parked;
        self.broken = kept.broken;
        self.stores = Stores { drains: self.config.drains, ..kept.stores };
        self.odometer_mm = kept.odometer_mm;
        self.loaded_mm = kept.loaded_mm;
        self.rng = self.config.rng(life);
        self.drop_at = draw_next(&mut self.rng, now, self.config.faults.silence_per_hour);
        self.manual_at = draw_next(&mut self.rng, now, self.config.faults.manual_per_hour);
    }
    /// Writes the body's file, if it has one. A failure is logged: the body goes on.
    pub(super) fn keep(&self) {
        let Some(keeper) = &self.keeper else { return };
        let kept = Kept {
            life: keeper.life,
            x_m: self.frame.translation.x,
            y_m: self.frame.translation.y,
            theta_rad: self.frame.rotation.angle(),
            last: self.last.clone(),
            touching: self.touching.clone(),
            lane: self.lane.clone(),
            charging: self.charging,
            parked: self.parked,
            broken: self.broken.clone(),
            stores: self.stores,
            odometer_mm: self.odometer_mm,
            loaded_mm: self.loaded_mm,
        };
        let path = keeper.dir.join(BODY_FILE);
        let new = keeper.dir.join("body.json.new");
        let written = serde_json::to_vec(&kept).map_err(std::io::Error::from);
        if let Err(error) =
            written.and_then(|bytes| std::fs::write(&new, bytes)).and_then(|()| std::fs::rename(&new, &path))
        {
            tracing::error!(path = %path.display(), %error, "body file not written");
        }
    }
}

/// What a journal says about one robot.
struct Memory {
    inside: BTreeSet<midshift_core::ids::PlaceId>,
    recent: VecDeque<(TaskId, String)>,
}

impl Memory {
    fn read(path: &Path, robot: &RobotId) -> Result<Self, Error> {
        let mut memory = Self { inside: BTreeSet::new(), recent: VecDeque::new() };
        for entry in journal::read(path)?.into_iter().filter(|e| e.robot_id.as_ref() == Some(robot)) {
            let deed = match entry.effect {
                Effect::Entered { place_id } => {
                    memory.inside.insert(place_id);
                    continue;
                }
                Effect::Left { place_id } => {
                    memory.inside.remove(&place_id);
                    continue;
                }
                Effect::Picked { work: Some(work), .. } => (work.task_id, "pick".to_owned()),
                Effect::Placed { work: Some(work), .. } => (work.task_id, "place".to_owned()),
                _ => continue,
            };
            if memory.recent.len() == super::RECENT_MAX {
                memory.recent.pop_front();
            }
            memory.recent.push_back(deed);
        }
        Ok(memory)
    }
}
