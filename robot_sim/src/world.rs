//! The world of items that bodies of one process share: what lies where, who carries what, and the journal of it all.
//!
//! Invariant: each item is at one place, on one robot, or shipped; nothing changes without an entry in the journal.
//! Called by bodies and by the simulated person, under one lock.

use crate::journal::{self, Effect, Entry, Journal, Work};
use crate::judge::Judge;
use midshift_core::ids::{PlaceId, RobotId, WaypointId};
use midshift_core::site::Site;
use midshift_core::time::SiteTime;
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// Items that lie at one waypoint before the oldest is shipped.
pub const ITEMS_PER_PLACE_MAX: usize = 256;
/// Name of what a pick finds that names nothing.
pub const UNNAMED_SKU: &str = "ITEM";

/// How a world begins.
#[derive(Clone, Debug, Default)]
pub struct WorldConfig {
    /// Part of every item's name, so that items of several worlds differ. Empty: one world only.
    pub tag: String,
    /// What a pick does not find is made on the spot: shelves that never run out.
    pub auto_stock: bool,
    /// UTC on the site clock at site time 0, milliseconds.
    pub utc_base_ms: i64,
    /// More robots than the site has seats stand in each other: places are not judged.
    pub crowded: bool,
}

/// An item in somebody's hands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Carried {
    /// Its name, unique in the world.
    pub item: String,
    /// Where it was picked.
    pub from: WaypointId,
    /// For whom.
    pub work: Option<Work>,
}

/// What kind of thing an item is: its name without the number.
pub fn sku_of(item: &str) -> &str {
    item.rsplit_once('#').map_or(item, |(sku, _)| sku)
}

/// The world. Shared by [`SharedWorld`].
#[derive(Debug)]
pub struct World {
    config: WorldConfig,
    next_number: u64,
    lying: BTreeMap<WaypointId, VecDeque<String>>,
    carried: BTreeMap<RobotId, Carried>,
    journal: Journal,
    judge: Judge,
}

/// A world behind its lock.
pub type SharedWorld = Arc<Mutex<World>>;

impl World {
    /// An empty world whose journal stays in memory.
    pub fn new(config: WorldConfig, site: &Site) -> Self {
        let judge = if config.crowded { Judge::default() } else { Judge::of_site(site) };
        Self {
            config,
            next_number: 1,
            lying: BTreeMap::new(),
            carried: BTreeMap::new(),
            journal: Journal::memory(),
            judge,
        }
    }
    /// The world as its journal's file tells it, going on in the same file.
    pub fn restore(config: WorldConfig, site: &Site, path: &Path) -> Result<Self, journal::Error> {
        let mut world = Self::new(config, site);
        let entries = journal::read(path)?;
        world.journal = Journal::open(path)?;
        for entry in &entries {
            world.judge.judge_entry(entry);
            world.replay(entry);
        }
        Ok(world)
    }
    /// Behind a lock.
    pub fn shared(self) -> SharedWorld {
        Arc::new(Mutex::new(self))
    }
    /// Puts new items of a kind down at a waypoint.
    pub fn stock(&mut self, now: SiteTime, waypoint: &WaypointId, sku: &str, count: u32) {
        for _ in 0..count {
            let tag = &self.config.tag;
            let dot = if tag.is_empty() { "" } else { "." };
            let item = format!("{sku}#{tag}{dot}{}", self.next_number);
            self.record(now, None, Effect::Made { item, waypoint: waypoint.clone() });
            self.ship_surplus(now, waypoint);
        }
    }
    /// A robot takes up an item of this kind, or any if none is named. None: nothing of that kind lies here.
    pub fn pick(
        &mut self,
        now: SiteTime,
        robot: &RobotId,
        at: &WaypointId,
        sku: &str,
        work: Option<Work>,
    ) -> Option<String> {
        if self.carried.contains_key(robot) {
            return None;
        }
        if self.find(at, sku).is_none() && self.config.auto_stock {
            self.stock(now, at, if sku.is_empty() { UNNAMED_SKU } else { sku_of(sku) }, 1);
        }
        let item = self.find(at, sku)?.to_owned();
        self.record(now, Some(robot), Effect::Picked { item: item.clone(), waypoint: at.clone(), work });
        Some(item)
    }
    /// A robot puts its item down. None: it carries nothing.
    pub fn place(&mut self, now: SiteTime, robot: &RobotId, at: &WaypointId, work: Option<Work>) -> Option<String> {
        let item = self.carried.get(robot)?.item.clone();
        self.record(now, Some(robot), Effect::Placed { item: item.clone(), waypoint: at.clone(), work });
        self.ship_surplus(now, at);
        Some(item)
    }
    /// A person takes a robot's item and carries it back to where it was picked. None: it carries nothing.
    pub fn put_back(&mut self, now: SiteTime, robot: &RobotId) -> Option<Carried> {
        let carried = self.carried.get(robot)?.clone();
        let Carried { item, from, work } = carried.clone();
        self.record(now, Some(robot), Effect::Returned { item, waypoint: from.clone(), work });
        self.ship_surplus(now, &from);
        Some(carried)
    }
    /// A robot's contour reached into a place.
    pub fn enter(&mut self, at: SiteTime, robot: &RobotId, place_id: PlaceId) {
        self.record(at, Some(robot), Effect::Entered { place_id });
    }
    /// A robot's contour is out of a place.
    pub fn leave(&mut self, at: SiteTime, robot: &RobotId, place_id: PlaceId) {
        self.record(at, Some(robot), Effect::Left { place_id });
    }
    /// A robot stands, moves or obeys otherwise by an operational stop.
    pub fn stop(&mut self, at: SiteTime, robot: &RobotId, effect: Effect) {
        self.record(at, Some(robot), effect);
    }
    /// Software began to run on a robot.
    pub fn run(&mut self, at: SiteTime, robot: &RobotId, version: String) {
        self.record(at, Some(robot), Effect::Ran { version });
    }
    /// What a robot carries.
    pub fn carried_by(&self, robot: &RobotId) -> Option<&Carried> {
        self.carried.get(robot)
    }
    /// What lies where, oldest first.
    pub fn lying(&self) -> impl Iterator<Item = (&WaypointId, &str)> {
        self.lying.iter().flat_map(|(at, items)| items.iter().map(move |i| (at, i.as_str())))
    }
    /// Who carries what.
    pub fn carrying(&self) -> impl Iterator<Item = (&RobotId, &Carried)> {
        self.carried.iter()
    }
    /// Its journal.
    pub fn journal(&self) -> &Journal {
        &self.journal
    }
    /// The judge of its journal.
    pub fn judge(&self) -> &Judge {
        &self.judge
    }
    /// UTC on the site clock, milliseconds.
    pub fn utc_ms(&self, now: SiteTime) -> i64 {
        self.config.utc_base_ms.saturating_add(now.0 as i64)
    }

    fn find(&self, at: &WaypointId, sku: &str) -> Option<&str> {
        let wanted = |item: &&String| sku.is_empty() || sku_of(item) == sku || item.as_str() == sku;
        self.lying.get(at)?.iter().find(wanted).map(String::as_str)
    }
    fn ship_surplus(&mut self, now: SiteTime, at: &WaypointId) {
        let surplus = self.lying.get(at).filter(|items| items.len() > ITEMS_PER_PLACE_MAX);
        if let Some(item) = surplus.and_then(|items| items.front()).cloned() {
            self.record(now, None, Effect::Shipped { item, waypoint: at.clone() });
        }
    }
    fn record(&mut self, now: SiteTime, robot: Option<&RobotId>, effect: Effect) {
        let entry = Entry { utc_ms: self.utc_ms(now), site_ms: now.0, robot_id: robot.cloned(), effect };
        self.replay(&entry);
        self.judge.judge_entry(&entry);
        self.journal.append(entry);
    }
    /// The one place where the world changes.
    fn replay(&mut self, entry: &Entry) {
        let take = |lying: &mut BTreeMap<WaypointId, VecDeque<String>>, at: &WaypointId, item: &String| {
            if let Some(items) = lying.get_mut(at)
                && let Some(index) = items.iter().position(|i| i == item)
            {
                items.remove(index);
            }
        };
        match &entry.effect {
            Effect::Made { item, waypoint } => {
                self.next_number += 1;
                self.lying.entry(waypoint.clone()).or_default().push_back(item.clone());
            }
            Effect::Picked { item, waypoint, work } => {
                take(&mut self.lying, waypoint, item);
                if let Some(robot) = &entry.robot_id {
                    let carried = Carried { item: item.clone(), from: waypoint.clone(), work: work.clone() };
                    self.carried.insert(robot.clone(), carried);
                }
            }
            Effect::Placed { item, waypoint, .. } | Effect::Returned { item, waypoint, .. } => {
                if let Some(robot) = &entry.robot_id {
                    self.carried.remove(robot);
                }
                self.lying.entry(waypoint.clone()).or_default().push_back(item.clone());
            }
            Effect::Shipped { item, waypoint } => take(&mut self.lying, waypoint, item),
            Effect::Entered { .. } | Effect::Left { .. } | Effect::Ran { .. } => {}
            Effect::Obeys { .. } | Effect::Stood { .. } | Effect::Moved { .. } => {}
        }
    }
}

/// The world behind its lock, also after a panic elsewhere.
pub fn lock(world: &SharedWorld) -> std::sync::MutexGuard<'_, World> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}
