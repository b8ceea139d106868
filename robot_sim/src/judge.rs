//! Judges a run by the bodies' own journals: are the items conserved, was a place ever too full, was a step done twice.
//!
//! Invariant: it knows no row and no grant; the only thing taken from the site is how many a place holds.
//! Fed entry by entry by a [`crate::world::World`], or from files of several processes after a run.

use crate::journal::{self, Effect, Entry, Work};
use midshift_core::ids::{PlaceId, RobotId, TaskId, WaypointId};
use midshift_core::site::Site;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

/// Steps of tasks that are remembered to find one done twice; the oldest are forgotten first.
const STEPS_REMEMBERED: usize = 200_000;
/// Stays of one place kept open for judgement before those long over are judged and dropped.
const STAYS_KEPT: usize = 256;
/// A stay that ended this long before the newest is over for good, milliseconds.
const SETTLED_AFTER_MS: i64 = 600_000;
/// Findings of each kind kept in words.
const WORDS_MAX: usize = 100;

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Verdict {
    /// Items that came into the world.
    pub items_made: u64,
    /// Of these, now at places.
    pub items_at_places: u64,
    /// Of these, now on robots.
    pub items_on_robots: u64,
    /// Of these, gone from full places.
    pub items_shipped: u64,
    /// Effects that no honest world can show: an item made twice, picked where it was not, put down by nobody who had
    /// it.
    pub items_broken: u64,
    /// Entries into a place that was full at that moment.
    pub exclusion_violations: u64,
    /// Of these, by the robot that entered. Robots without one are left out.
    pub violations_by_robot: BTreeMap<RobotId, u64>,
    /// Picks and drops of a task's step that had been done before.
    pub steps_done_twice: u64,
    /// Findings in words, at most 100 of each kind.
    pub findings: Vec<String>,
}

impl Verdict {
    /// Every item is at exactly one place, on one robot, or gone.
    pub fn items_conserved(&self) -> bool {
        self.items_broken == 0 && self.items_made == self.items_at_places + self.items_on_robots + self.items_shipped
    }
    /// Nothing was found.
    pub fn is_clean(&self) -> bool {
        self.items_conserved() && self.exclusion_violations == 0 && self.steps_done_twice == 0
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Spot {
    At(WaypointId),
    On(RobotId),
}

#[derive(Clone, Debug)]
struct Stay {
    robot_id: RobotId,
    from_ms: i64,
    to_ms: Option<i64>,
    judged: bool,
}

#[derive(Clone, Debug)]
struct Room {
    capacity: u32,
    stays: Vec<Stay>,
    violations: BTreeMap<RobotId, u64>,
    words: Vec<String>,
}

/// The judge. Entries of one journal must come in their order; journals of different worlds in any.
#[derive(Clone, Debug, Default)]
pub struct Judge {
    rooms: BTreeMap<PlaceId, Room>,
    items: BTreeMap<String, Spot>,
    hands: BTreeSet<RobotId>,
    made: u64,
    shipped: u64,
    broken: u64,
    done: BTreeMap<(Work, bool), u32>,
    done_order: VecDeque<(Work, bool)>,
    twice: u64,
    words: Vec<String>,
    entries: u64,
}

impl Judge {
    /// For a site whose places have these capacities. Places not named are not judged.
    pub fn new(capacities: impl IntoIterator<Item = (PlaceId, u32)>) -> Self {
        let room = |capacity| Room { capacity, stays: Vec::new(), violations: BTreeMap::new(), words: Vec::new() };
        Self { rooms: capacities.into_iter().map(|(id, n)| (id, room(n))).collect(), ..Self::default() }
    }
    /// For the places of a site; none are judged where the site says that bodies may drive through each other.
    pub fn of_site(site: &Site) -> Self {
        let judged = site.places().iter().filter(|_| site.collisions_modelled());
        Self::new(judged.map(|p| (p.place_id.clone(), p.capacity)))
    }
    /// Judges the journals of several bodies together: each file in its order, places by the times in the entries.
    pub fn read<'a>(site: &Site, journals: impl IntoIterator<Item = &'a Path>) -> Result<Self, journal::Error> {
        let mut judge = Self::of_site(site);
        for path in journals {
            journal::read(path)?.iter().for_each(|entry| judge.judge_entry(entry));
        }
        Ok(judge)
    }
    /// Entries taken so far.
    pub fn entries(&self) -> u64 {
        self.entries
    }
    /// Takes one entry.
    pub fn judge_entry(&mut self, entry: &Entry) {
        self.entries += 1;
        let robot_id = entry.robot_id.as_ref();
        match (&entry.effect, robot_id) {
            (Effect::Made { item, waypoint }, _) => {
                self.made += 1;
                if self.items.insert(item.clone(), Spot::At(waypoint.clone())).is_some() {
                    self.broke(entry, "made twice");
                }
            }
            (Effect::Picked { item, waypoint, work }, Some(robot)) => {
                self.carry(entry, item, &Spot::At(waypoint.clone()), Spot::On(robot.clone()));
                self.did(entry, work.as_ref(), true);
            }
            (Effect::Placed { item, waypoint, work }, Some(robot)) => {
                self.carry(entry, item, &Spot::On(robot.clone()), Spot::At(waypoint.clone()));
                self.did(entry, work.as_ref(), false);
            }
            (Effect::Returned { item, waypoint, work }, Some(robot)) => {
                self.carry(entry, item, &Spot::On(robot.clone()), Spot::At(waypoint.clone()));
                if let Some(work) = work {
                    self.done.remove(&(work.clone(), true));
                }
            }
            (Effect::Shipped { item, waypoint }, _) => {
                self.shipped += 1;
                if self.items.remove(item) != Some(Spot::At(waypoint.clone())) {
                    self.broke(entry, "shipped from where it was not");
                }
            }
            (Effect::Entered { place_id }, Some(robot)) => self.entered(place_id, robot, entry.utc_ms),
            (Effect::Left { place_id }, Some(robot)) => self.left(place_id, robot, entry.utc_ms),
            // What a stop allows is judged by who knows when it was engaged.
            (Effect::Ran { .. } | Effect::Obeys { .. } | Effect::Stood { .. } | Effect::Moved { .. }, Some(_)) => {}
            (_, None) => self.broke(entry, "done by nobody"),
        }
    }
    /// What was found so far.
    pub fn verdict(&self) -> Verdict {
        let mut findings = self.words.clone();
        let mut by_robot = BTreeMap::new();
        for (place_id, room) in &self.rooms {
            let mut open = room.clone();
            open.judge(place_id, |_| true);
            for (robot, times) in open.violations {
                *by_robot.entry(robot).or_insert(0) += times;
            }
            findings.extend(open.words);
        }
        let on_robots = self.items.values().filter(|s| matches!(s, Spot::On(_))).count() as u64;
        findings.truncate(2 * WORDS_MAX);
        Verdict {
            items_made: self.made,
            items_at_places: self.items.len() as u64 - on_robots,
            items_on_robots: on_robots,
            items_shipped: self.shipped,
            items_broken: self.broken,
            exclusion_violations: by_robot.values().sum(),
            violations_by_robot: by_robot,
            steps_done_twice: self.twice,
            findings,
        }
    }
    /// How often each task's item was put down, as far as remembered.
    pub fn drops_by_task(&self) -> BTreeMap<TaskId, u32> {
        let mut drops = BTreeMap::new();
        for ((work, _), times) in self.done.iter().filter(|((_, picked), _)| !picked) {
            *drops.entry(work.task_id.clone()).or_insert(0) += times;
        }
        drops
    }

    fn note_finding(&mut self, text: String) {
        if self.words.len() < WORDS_MAX {
            self.words.push(text);
        }
    }
    fn broke(&mut self, entry: &Entry, how: &str) {
        self.broken += 1;
        self.note_finding(format!("{how}: {entry:?}"));
    }
    fn carry(&mut self, entry: &Entry, item: &str, from: &Spot, to: Spot) {
        let full_handed = match &to {
            Spot::On(robot) => !self.hands.insert(robot.clone()),
            Spot::At(_) => false,
        };
        if let Spot::On(robot) = from {
            self.hands.remove(robot);
        }
        let was = self.items.insert(item.to_owned(), to);
        if was.as_ref() != Some(from) {
            self.broke(entry, "taken from where it was not");
        } else if full_handed {
            self.broke(entry, "taken by a robot that carries another");
        }
    }
    fn did(&mut self, entry: &Entry, work: Option<&Work>, picked: bool) {
        let Some(work) = work else { return };
        let key = (work.clone(), picked);
        let times = self.done.entry(key.clone()).or_insert(0);
        *times += 1;
        if *times > 1 {
            self.twice += 1;
            self.note_finding(format!("step done twice: {entry:?}"));
        } else {
            self.done_order.push_back(key);
        }
        if self.done_order.len() > STEPS_REMEMBERED
            && let Some(oldest) = self.done_order.pop_front()
        {
            self.done.remove(&oldest);
        }
    }
    fn entered(&mut self, place_id: &PlaceId, robot: &RobotId, at_ms: i64) {
        let Some(room) = self.rooms.get_mut(place_id) else { return };
        if room.stays.iter().any(|s| s.robot_id == *robot && s.to_ms.is_none()) {
            return;
        }
        room.stays.push(Stay { robot_id: robot.clone(), from_ms: at_ms, to_ms: None, judged: false });
        if room.stays.len() > STAYS_KEPT {
            room.forget(place_id, at_ms - SETTLED_AFTER_MS);
        }
    }
    fn left(&mut self, place_id: &PlaceId, robot: &RobotId, at_ms: i64) {
        let Some(room) = self.rooms.get_mut(place_id) else { return };
        if let Some(stay) = room.stays.iter_mut().rfind(|s| s.robot_id == *robot && s.to_ms.is_none()) {
            stay.to_ms = Some(at_ms.max(stay.from_ms));
        }
    }
}

impl Room {
    /// Counts each stay that began while the place was full. Bodies of one process are asked at different moments, so
    /// entries may come late; what counts are the times in them.
    fn judge(&mut self, place_id: &PlaceId, which: impl Fn(&Stay) -> bool) {
        for i in 0..self.stays.len() {
            let stay = &self.stays[i];
            if stay.judged || !which(stay) {
                continue;
            }
            let at = stay.from_ms;
            let lasts = |s: &Stay| s.to_ms.is_none_or(|to| to > at);
            let before = |j: usize, s: &Stay| s.from_ms < at || (s.from_ms == at && j < i);
            let others = self.stays.iter().enumerate().filter(|(j, s)| *j != i && before(*j, s) && lasts(s));
            let others: Vec<&RobotId> = others.map(|(_, s)| &s.robot_id).collect();
            if lasts(stay) && others.len() >= self.capacity as usize {
                *self.violations.entry(stay.robot_id.clone()).or_insert(0) += 1;
                if self.words.len() < WORDS_MAX {
                    let robot = &stay.robot_id;
                    self.words.push(format!("{robot} entered {place_id} at {at} while {others:?} were inside"));
                }
            }
            self.stays[i].judged = true;
        }
    }
    /// Judges what began before `before_ms` and drops what also ended before it.
    fn forget(&mut self, place_id: &PlaceId, before_ms: i64) {
        self.judge(place_id, |s| s.from_ms < before_ms);
        self.stays.retain(|s| !s.judged || s.to_ms.is_none_or(|to| to >= before_ms));
    }
}
