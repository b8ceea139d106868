//! Brings a body back from its files as its last process left it, and writes them.
//!
//! Invariant: the load and the places it is in come from the journal, which is written before this file, so a kill
//! between the two loses neither.

use super::files::{BodyFile, Error, JOURNAL_FILE, Keeper};
use super::{BodyConfig, SimBody};
use crate::energy::Stores;
use crate::faults::draw_next;
use crate::journal::{self, Effect};
use crate::world::{SharedWorld, World, WorldConfig};
use midshift_core::ids::{PlaceId, RobotId, TaskId};
use midshift_core::site::Site;
use midshift_core::time::SiteTime;
use nalgebra::{Isometry2, Vector2};
use std::collections::{BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;

impl SimBody {
    /// A body that lives in a directory, with a world of its own in the same journal: new, or as the last process left
    /// it. It stands without an order. Returns it with its world.
    pub fn restore(
        config: BodyConfig,
        site: Arc<Site>,
        world: WorldConfig,
        dir: &Path,
        now: SiteTime,
    ) -> Result<(Self, SharedWorld), Error> {
        std::fs::create_dir_all(dir).map_err(|source| Error::File { path: dir.to_owned(), source })?;
        let kept = BodyFile::read(dir)?;
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
        body.write_file();
        Ok((body, world))
    }
    fn take_up(&mut self, kept: BodyFile, life: u32, now: SiteTime) {
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
    pub(super) fn write_file(&self) {
        let Some(keeper) = &self.keeper else { return };
        let kept = BodyFile {
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
        kept.write(&keeper.dir);
    }
}

/// What a journal says about one robot.
struct Memory {
    inside: BTreeSet<PlaceId>,
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
