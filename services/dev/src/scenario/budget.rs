//! Whether robots are taken out of work for new software only as far as the rules of their area and of their roll-out allow.
//!
//! Fed by [`super::watch`] with the rows of drains and roll-outs in the order of their commits, and with what robots say. Invariant: no count of a
//! planner is read (`area_budget`, `in_flight`): who is out of work is counted from the drains that are on, and how many may be from the
//! robots that were heard in the area a moment ago and from its rules as the API shows them. What a planner sees at another moment than
//! the judge counts for the planner, so an objection is always one.

use midshift_core::fleet::rows::Drain;
use midshift_core::ids::{AreaId, DrainId, RobotId, RolloutId};
use midshift_core::limits;
use midshift_core::time::{LinkDuration, LinkTime};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// A planner may have seen a robot where it was so long ago.
const LATELY: LinkDuration = LinkDuration::from_secs(5);

/// What one robot reports that matters for the budget of its area.
#[derive(Clone, Debug)]
pub struct RobotReport {
    /// The robot that says it.
    pub robot_id: RobotId,
    /// When it was heard last.
    pub heard: LinkTime,
    /// The area that it is in.
    pub area_id: Option<AreaId>,
    /// It is stuck with its software: only a person brings it back to work.
    pub is_stuck: bool,
    /// It changes its software, or tries it without work.
    pub changes: bool,
    /// It goes back to what it kept, by itself or because it was told to.
    pub goes_back: bool,
}

/// What a roll-out says of how many may be out of work for it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pace {
    /// The wave that it is in, from 0.
    pub wave: u32,
    /// So many robots at once, if it was asked for less than a wave.
    pub max_in_flight: Option<u32>,
}

/// The fullest moment of an area.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Fullest {
    /// Which area.
    pub area_id: String,
    /// Robots that were out of work for software when one more had just been taken, that one with them.
    pub out: usize,
    /// As many might be, by the robots that were there.
    pub may: usize,
}

/// What was seen in one roll-out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Seen {
    /// Of each area from which a robot was taken.
    pub areas: Vec<Fullest>,
    /// As many robots as might ever be out of work at once, over all areas.
    pub may_at_once: usize,
    /// What was not as it must be.
    pub broken: Vec<String>,
}

/// Counts who is out of work, and objects.
#[derive(Debug, Default)]
pub struct Judge {
    /// Of a thousand robots of an area, so many may be out of work at once.
    permille: BTreeMap<AreaId, usize>,
    /// Drains that are on.
    on: BTreeMap<DrainId, Drain>,
    rollouts: BTreeMap<RolloutId, Pace>,
    /// The wave of each robot.
    waves: BTreeMap<RolloutId, BTreeMap<RobotId, u32>>,
    /// Robots that were written off: out of work for good, as far as anybody knows, they count in no budget until they are heard.
    written_off: BTreeMap<RolloutId, BTreeSet<RobotId>>,
    robots: BTreeMap<RobotId, Robot>,
    now: LinkTime,
    /// What is known was there when it began to look: nobody saw it begin.
    knows_all: bool,
    /// Robots that said outside of a drain that they change their software, and when they were heard with it last.
    suspects: BTreeMap<RobotId, LinkTime>,
    seen: BTreeMap<AreaId, Fullest>,
    may: BTreeMap<AreaId, usize>,
    broken: Vec<String>,
}

/// What is known of a robot.
#[derive(Debug)]
struct Robot {
    heard: LinkTime,
    /// When it was seen last in each area.
    areas: BTreeMap<AreaId, LinkTime>,
    stuck: Option<LinkTime>,
}

impl Judge {
    /// By rules of areas: of a thousand robots that are there, so many may be out of work at once, and one always may.
    pub fn new(permille: BTreeMap<AreaId, usize>) -> Self {
        Self { permille, ..Self::default() }
    }

    /// All rows follow once more, as they are now.
    pub fn forget_rows(&mut self) {
        self.on.clear();
        self.rollouts.clear();
        self.waves.clear();
        self.written_off.clear();
        self.knows_all = false;
    }

    /// What robots say now. To be told before each drain, so that no planner saw more.
    pub fn note_reports(&mut self, now: LinkTime, reports: &[RobotReport]) {
        self.now = now;
        for report in reports {
            let known = Robot { heard: report.heard, areas: BTreeMap::new(), stuck: None };
            let robot = self.robots.entry(report.robot_id.clone()).or_insert(known);
            robot.heard = report.heard;
            if let Some(area_id) = &report.area_id {
                robot.areas.insert(area_id.clone(), now);
            }
            if report.is_stuck {
                robot.stuck = Some(now);
            }
        }
    }

    /// What robots say now; all rows up to this moment were taken before.
    pub fn judge_reports(&mut self, now: LinkTime, reports: &[RobotReport]) {
        self.note_reports(now, reports);
        self.knows_all = true;
        let is_out = |robot_id: &RobotId| self.on.values().any(|d| d.robot_id == *robot_id);
        let mut suspects = BTreeMap::new();
        for report in reports.iter().filter(|s| s.changes && !is_out(&s.robot_id)) {
            let last = self.suspects.get(&report.robot_id).copied().unwrap_or(report.heard);
            // One heartbeat proves nothing: an event ends a drain before the next heartbeat says the same.
            if report.heard > last {
                self.broken
                    .push(format!("{} changed its software while no drain kept it out of work", report.robot_id));
            }
            suspects.insert(report.robot_id.clone(), report.heard);
        }
        self.suspects = suspects;
        for area_id in self.permille.keys() {
            let may = self.may_be_out(area_id);
            let most = self.may.entry(area_id.clone()).or_default();
            *most = may.max(*most);
        }
    }

    /// A roll-out as it became.
    pub fn rollout(&mut self, rollout_id: RolloutId, pace: Pace) {
        self.rollouts.insert(rollout_id, pace);
    }

    /// A robot of a roll-out as it became.
    pub fn robot(&mut self, rollout_id: RolloutId, robot_id: RobotId, wave: u32) {
        self.waves.entry(rollout_id).or_default().insert(robot_id, wave);
    }

    /// A robot of a roll-out was written off.
    pub fn write_off(&mut self, rollout_id: RolloutId, robot_id: RobotId) {
        self.written_off.entry(rollout_id).or_default().insert(robot_id);
    }

    /// A robot of a roll-out counts, as all do that were not written off.
    pub fn count(&mut self, rollout_id: &RolloutId, robot_id: &RobotId) {
        if let Some(robots) = self.written_off.get_mut(rollout_id) {
            robots.remove(robot_id);
        }
    }

    /// A drain as it became.
    pub fn drain(&mut self, drain: Drain) {
        let id = drain.drain_id.clone();
        if !drain.is_on() {
            self.on.remove(&id);
            return;
        }
        let begins = self.on.insert(id, drain.clone()).is_none();
        if begins && self.knows_all && drain.rollout_id.is_some() {
            self.area_allows(&drain);
            self.rollout_allows(&drain);
        }
    }

    /// A drain is no more.
    pub fn drain_is_gone(&mut self, id: &str) {
        self.on.retain(|known, _| known.as_str() != id);
    }

    /// Something could not be judged at all.
    pub fn cannot(&mut self, why: String) {
        self.broken.push(why);
    }

    /// What was seen since the last time.
    pub fn take_seen(&mut self) -> Seen {
        let may = std::mem::take(&mut self.may);
        Seen {
            areas: std::mem::take(&mut self.seen).into_values().collect(),
            may_at_once: may.values().sum(),
            broken: std::mem::take(&mut self.broken),
        }
    }

    /// Robots that may be out of work in an area at once: so many of a thousand that were heard there, at least one.
    fn may_be_out(&self, area_id: &AreaId) -> usize {
        let is_heard = |r: &Robot| self.ago(r.heard) <= limits::OFFLINE_AFTER.as_ms() + LATELY.as_ms();
        let was_there = |r: &Robot| r.areas.get(area_id).is_some_and(|at| self.is_lately(*at));
        let robots = self.robots.values().filter(|r| is_heard(r) && was_there(r)).count();
        (robots * self.permille.get(area_id).copied().unwrap_or(0) / 1_000).max(1)
    }

    fn ago(&self, at: LinkTime) -> u64 {
        self.now.since(at).as_ms()
    }

    fn is_lately(&self, at: LinkTime) -> bool {
        self.ago(at) <= LATELY.as_ms()
    }

    /// Its drain ends without a person: the robot is heard, and is not stuck with what it runs.
    fn comes_back(&self, robot_id: &RobotId) -> bool {
        let Some(robot) = self.robots.get(robot_id) else { return false };
        let is_heard = self.ago(robot.heard) + LATELY.as_ms() <= limits::OFFLINE_AFTER.as_ms();
        is_heard && !robot.stuck.is_some_and(|at| self.is_lately(at))
    }

    /// Its robot was written off in its roll-out.
    fn is_written_off(&self, drain: &Drain) -> bool {
        let of_it = drain.rollout_id.as_ref().and_then(|id| self.written_off.get(id));
        of_it.is_some_and(|robots| robots.contains(&drain.robot_id))
    }

    /// A robot that goes back from what was aborted waits for drains alone that end by themselves. An urgent one waits for nobody, and counts.
    fn area_allows(&mut self, drain: &Drain) {
        let Some(area_id) = &drain.area_id else { return };
        let waited_for = |d: &Drain| !self.is_written_off(d) && (!drain.is_way_back || self.comes_back(&d.robot_id));
        let counts = |d: &&Drain| d.drain_id == drain.drain_id || waited_for(d);
        let taken_here = self.on.values().filter(|d| d.area_id.as_ref() == Some(area_id));
        let out: BTreeSet<&RobotId> = taken_here.filter(counts).map(|d| &d.robot_id).collect();
        let may = self.may_be_out(area_id);
        let fullest = Fullest { area_id: area_id.to_string(), out: out.len(), may };
        if out.len() > may && !drain.urgent {
            let names = names(out);
            self.broken.push(format!("{area_id}: {} robots were out of work ({names}), {may} may be", fullest.out));
        }
        let over = |f: &Fullest| (f.out.saturating_sub(f.may), f.out);
        if !drain.urgent && self.seen.get(area_id).is_none_or(|known| over(known) < over(&fullest)) {
            self.seen.insert(area_id.clone(), fullest);
        }
    }

    /// Never more robots are out of work for a roll-out than its wave has, or than it was asked for.
    fn rollout_allows(&mut self, drain: &Drain) {
        let waits = |d: &Drain| !d.is_way_back && !d.urgent;
        let Some((id, pace)) = drain.rollout_id.as_ref().and_then(|id| self.rollouts.get_key_value(id)) else { return };
        if !waits(drain) {
            return;
        }
        let counts = |d: &&Drain| d.drain_id == drain.drain_id || !self.is_written_off(d);
        let of_it = self.on.values().filter(|d| d.rollout_id == drain.rollout_id && waits(d)).filter(counts);
        let out: BTreeSet<&RobotId> = of_it.map(|d| &d.robot_id).collect();
        let mut sizes: BTreeMap<u32, usize> = BTreeMap::new();
        for wave in self.waves.get(id).into_iter().flat_map(BTreeMap::values) {
            *sizes.entry(*wave).or_default() += 1;
        }
        // One that was asked for in an earlier wave may begin in this one.
        let largest = sizes.range(..=pace.wave).map(|(_, size)| *size).max().unwrap_or(1);
        let may = pace.max_in_flight.map_or(largest, |most| largest.min(most as usize)).max(1);
        if out.len() > may {
            let (count, names) = (out.len(), names(out));
            self.broken.push(format!("{count} robots were out of work for it at once ({names}), {may} may be"));
        }
    }
}

fn names(robots: BTreeSet<&RobotId>) -> String {
    robots.into_iter().map(RobotId::as_str).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests;
