//! The laws of roll-outs, held against what bodies and ledgers do: which set a robot's switch record names, what its ledger says, where
//! its body stands. Of rows only those count that order or permit something: directives, drains asked for, the word to stand still.
//!
//! Invariant: it takes part in nothing, like the [`crate::observer`] that calls it.

use midshift_agent::body::Body;
use midshift_agent::ledger::Holder;
use midshift_agent::switch::{FACTORY, Switch};
use midshift_agent::update::SoftwareRow;
use midshift_bundle::bugs::Bugs;
use midshift_bundle::digest::Digest;
use midshift_bundle::directive::{Directive, Expected};
use midshift_bundle::keys::{KeyId, PublicKey};
use midshift_bundle::set::SetManifest;
use midshift_core::drain_request::DrainRequest;
use midshift_core::fleet::rows::Drain;
use midshift_core::ids::{AreaId, DrainId, PlaceId, RobotId, RolloutId};
use midshift_core::limits;
use midshift_core::rollout::rows::{Phase, Rollout};
use midshift_core::rollout::spec::{AbortScope, Wave};
use midshift_core::time::Utc;
use midshift_core::update::{DesiredUpdate, UpdateState};
use midshift_sim::handle::SimHandle;
use std::collections::{BTreeMap, BTreeSet};

/// From a robot's decision to the new switch record: its ledger, its worker, and a start between them, microseconds.
const SWITCH_US: u64 = 150_000;
/// A stop that begins while the robot writes its decision down comes too late for it, microseconds.
const DECISION_US: u64 = 60_000;

/// One look at a law: its name, whether it holds, what was seen if not.
pub type Look = (&'static str, bool, String);

/// One roll-out as its row says, and since when nobody may activate it.
struct Seen {
    row: Rollout,
    still_since_us: Option<u64>,
}

/// What one robot did.
#[derive(Default)]
struct Robot {
    body: Option<SimHandle>,
    holder: bool,
    maintenance: Option<DrainId>,
    software: SoftwareRow,
    switch: Switch,
    /// Bundle that runs; none: what it came with.
    runs: Option<Digest>,
    /// What each directive was for, by generation; only those that are signed.
    told: BTreeMap<u64, (Digest, RolloutId)>,
    /// Drains in which it asked for permission.
    asked: BTreeSet<DrainId>,
    /// Of the newest roll-out that it activated: which, and what ran before.
    touched: Option<(RolloutId, String)>,
    stopped_us: Option<u64>,
    /// Places that its ledger says it is in or has set out for.
    places: BTreeSet<PlaceId>,
}

impl Robot {
    fn state(&self) -> Option<UpdateState> {
        self.software.update.as_ref().map(|u| u.state)
    }
    /// Where its update is over, its switch record says the same.
    fn agrees(&self) -> bool {
        let Some(update) = &self.software.update else { return true };
        let name = update.set_name();
        let is_current = name.as_ref() == Some(&self.switch.current) && self.switch.trial.is_none();
        match update.state {
            UpdateState::Committed => is_current,
            UpdateState::RolledBack => !is_current && self.switch.trial.is_none(),
            _ => true,
        }
    }
    /// It changes to something new and is not yet believed.
    fn goes_forward(&self) -> bool {
        matches!(self.state(), Some(UpdateState::Switching | UpdateState::Probation))
    }
    fn rollout(&self) -> Option<&RolloutId> {
        self.told.get(&self.software.directive_generation).map(|(_, rollout)| rollout)
    }
}

/// All that was seen of software.
#[derive(Default)]
pub struct Changes {
    keys: BTreeMap<KeyId, PublicKey>,
    signed: BTreeMap<Digest, BTreeSet<Digest>>,
    robots: BTreeMap<RobotId, Robot>,
    rollouts: BTreeMap<RolloutId, Seen>,
    asked: BTreeMap<DrainId, DrainRequest>,
    areas: BTreeMap<DrainId, AreaId>,
}

impl Changes {
    /// Whose word counts, and whose bodies these are.
    pub fn watch(
        &mut self,
        keys: BTreeMap<KeyId, PublicKey>,
        signed: BTreeMap<Digest, BTreeSet<Digest>>,
        robots: &[SimHandle],
    ) {
        (self.keys, self.signed) = (keys, signed);
        for body in robots {
            self.robot(body.robot_id()).body = Some(body.clone());
        }
    }
    fn robot(&mut self, robot_id: &RobotId) -> &mut Robot {
        self.robots.entry(robot_id.clone()).or_default()
    }
    /// A roll-out as it was committed last.
    pub fn rollout(&self, id: &str) -> Option<&Rollout> {
        self.rollouts.iter().find(|(known, _)| known.as_str() == id).map(|(_, seen)| &seen.row)
    }
    /// All roll-outs as they were committed last.
    pub fn rollouts(&self) -> impl Iterator<Item = &Rollout> {
        self.rollouts.values().map(|seen| &seen.row)
    }
    /// The ledger's state of a robot's update.
    pub fn state(&self, robot_id: &RobotId) -> Option<UpdateState> {
        self.robots.get(robot_id)?.state()
    }
    /// The drain that holds a robot, as its ledger says.
    pub fn held_by(&self, robot_id: &RobotId) -> Option<&DrainId> {
        self.robots.get(robot_id)?.maintenance.as_ref()
    }
    /// The bundle that a robot runs; none: what it came with.
    pub fn runs(&self, robot_id: &RobotId) -> Option<String> {
        self.robots.get(robot_id)?.runs.map(|digest| digest.to_string())
    }
    /// The set that a robot goes back to, and the one that is current, as its switch record says.
    pub fn record(&self, robot_id: &RobotId) -> Option<&Switch> {
        self.robots.get(robot_id).map(|robot| &robot.switch)
    }

    // --- rows that order and permit

    /// A roll-out was committed.
    pub fn put_rollout(&mut self, row: Rollout, us: u64) {
        let still = !row.pauses.is_empty() || row.phase.goes_back();
        let before = self.rollouts.get(&row.rollout_id).and_then(|seen| seen.still_since_us);
        let still_since_us = still.then(|| before.unwrap_or(us));
        self.rollouts.insert(row.rollout_id.clone(), Seen { row, still_since_us });
    }
    /// A drain was asked for.
    pub fn put_request(&mut self, row: DrainRequest) {
        self.asked.insert(row.drain_id.clone(), row);
    }
    /// A drain goes on.
    pub fn put_drain(&mut self, row: Drain) {
        if let Some(area_id) = row.area_id {
            self.areas.insert(row.drain_id, area_id);
        }
    }
    /// A robot was told something.
    pub fn put_desired(&mut self, row: &DesiredUpdate) -> Vec<Look> {
        let keys = self.keys.clone();
        let expected =
            Expected { robot_id: &row.robot_id, keys: &keys, generation: 0, now: Utc(0), bugs: Bugs::default() };
        let opened = Directive::verify(row.directive.as_bytes(), &expected);
        let robot = self.robot(&row.robot_id);
        if let Ok(directive) = opened
            && let Ok(rollout) = RolloutId::parse(&directive.rollout)
        {
            robot.told.insert(directive.generation, (directive.manifest, rollout));
        }
        let Some(grant) = &row.grant else { return Vec::new() };
        let asked = robot.asked.contains(&grant.drain_id);
        let ours = self.asked.get(&grant.drain_id).is_some_and(|r| r.robot_id == row.robot_id);
        let what = || format!("{} was given {grant:?}", row.robot_id);
        vec![("I19 permission follows the robot's own word in that drain", asked && ours, what())]
    }
    /// A robot asked for permission.
    pub fn ready(&mut self, robot_id: &RobotId, drain_id: DrainId) {
        self.robot(robot_id).asked.insert(drain_id);
    }

    // --- what robots write

    /// A robot's ledger has another holder.
    pub fn holder(&mut self, robot_id: &RobotId, holder: Option<&Holder>) -> Vec<Look> {
        let robot = self.robot(robot_id);
        let is_new = holder.is_some() && !robot.holder;
        robot.holder = holder.is_some();
        if !is_new {
            return Vec::new();
        }
        let changes =
            matches!(robot.state(), Some(UpdateState::Switching | UpdateState::Probation | UpdateState::RollingBack));
        let what = format!("{robot_id} took {holder:?} in {:?}, {:?}", robot.maintenance, robot.state());
        vec![("I19 no work on probation or in a drain", robot.maintenance.is_none() && !changes, what)]
    }
    /// Fleet gives a robot something to do.
    pub fn given(&mut self, robot_id: &RobotId) -> Vec<Look> {
        let robot = self.robot(robot_id);
        let what = format!("{robot_id} was given work in {:?}", robot.state());
        vec![("I19 nobody is given work on probation", !robot.goes_forward(), what)]
    }
    /// A body begins an action.
    pub fn acts(&mut self, robot_id: &RobotId) -> Vec<Look> {
        let robot = self.robot(robot_id);
        let holds = !robot.goes_forward() && robot.maintenance.is_none();
        let what = format!("{robot_id} acts in {:?}, {:?}", robot.maintenance, robot.state());
        vec![("I19 no work on probation or in a drain", holds, what)]
    }
    /// A robot's ledger says that a drain holds it, or none.
    pub fn maintenance(&mut self, robot_id: &RobotId, drain_id: Option<DrainId>) {
        self.robot(robot_id).maintenance = drain_id;
    }
    /// A robot's ledger says something new of its software.
    pub fn software(&mut self, robot_id: &RobotId, row: &SoftwareRow, now_us: u64) -> Vec<Look> {
        let robot = self.robot(robot_id);
        let before = robot.state();
        robot.software = row.clone();
        if !robot.goes_forward() || robot.state() == before {
            return Vec::new();
        }
        let mut looks = self.in_bounds(robot_id);
        if self.robot(robot_id).state() == Some(UpdateState::Switching) {
            looks.extend(self.may_switch(robot_id, now_us));
        }
        looks
    }

    /// I17: how many change at once, of one roll-out and of one area.
    fn in_bounds(&self, robot_id: &RobotId) -> Vec<Look> {
        let mut looks = Vec::new();
        let robot = &self.robots[robot_id];
        let changing = || self.robots.iter().filter(|(_, other)| other.goes_forward());
        if let Some(seen) = robot.rollout().and_then(|id| self.rollouts.get(id)) {
            let id = &seen.row.rollout_id;
            let of: Vec<&RobotId> =
                changing().filter(|(_, other)| other.rollout() == Some(id)).map(|(id, _)| id).collect();
            let most = most_of(&seen.row);
            let what = format!("{of:?} change in wave {} of {id}, which has {most}", seen.row.wave);
            looks.push(("I17 no more change than the wave has", of.len() <= most, what));
        }
        let area = |robot: &Robot| robot.maintenance.as_ref().and_then(|id| self.areas.get(id)).cloned();
        if let Some(here) = area(robot) {
            let of: Vec<&RobotId> =
                changing().filter(|(_, other)| area(other).as_ref() == Some(&here)).map(|(id, _)| id).collect();
            // One, or every tenth: never more than every robot there is would allow.
            let most = (self.robots.len() / 10).max(1);
            let what = format!("{of:?} of {here} change, {most} may");
            looks.push(("I17 no more change than the area spares", of.len() <= most, what));
        }
        looks
    }

    /// I19 and the drain, at the moment that the decision is durable.
    fn may_switch(&self, robot_id: &RobotId, now_us: u64) -> Vec<Look> {
        let robot = &self.robots[robot_id];
        let drain = robot.software.update.as_ref().and_then(|u| u.drain_id.as_ref());
        let request = drain.and_then(|id| self.asked.get(id));
        let own = request.is_some_and(|r| r.robot_id == *robot_id && Some(&r.rollout_id) == robot.rollout());
        let holds = drain.is_some() && robot.maintenance.as_ref() == drain;
        let what =
            format!("{robot_id} switches in {drain:?} for {:?}, held by {:?}", robot.rollout(), robot.maintenance);
        let mut looks = vec![("I19 a robot activates in the drain of its roll-out", own && holds, what)];
        if let Some(body) = &robot.body {
            let load = body.load();
            let here = body.stands_on();
            let passage = robot.places.iter().find(|place| !here.iter().any(|at| at.as_str() == place.as_str()));
            let stopped = robot.stopped_us.is_some_and(|at| now_us.saturating_sub(at) > DECISION_US);
            let free = !robot.holder && load.is_none() && passage.is_none() && !stopped;
            let what = format!(
                "{robot_id} switches with holder {}, load {load:?}, passage {passage:?} at {here:?}, stop since {:?}",
                robot.holder, robot.stopped_us
            );
            looks.push(("I19 no activation with work, load, passage or stop", free, what));
        }
        looks
    }
    /// A robot's ledger says which places it has beside nothing.
    pub fn places(&mut self, robot_id: &RobotId, places: impl Iterator<Item = PlaceId>) {
        self.robot(robot_id).places = places.collect();
    }

    // --- what runs

    /// A switch record was written, or is started from. The set is the one that it names.
    pub fn switched(
        &mut self,
        robot_id: &RobotId,
        switch: &Switch,
        set: Option<&SetManifest>,
        now_us: u64,
    ) -> Vec<Look> {
        let robot = self.robot(robot_id);
        let before = std::mem::replace(&mut robot.switch, switch.clone());
        robot.runs = set.and_then(|set| set.bundle);
        // It was back already, and what it was back on is gone back from in its turn.
        let undone = before.current != switch.current && before.previous.as_ref() == Some(&switch.current);
        robot.touched.take_if(|(_, kept)| undone && *kept == before.current);
        let robot = &self.robots[robot_id];
        let mut looks = vec![(
            "I15 the kept set is the one committed last",
            keeps(&before, switch),
            format!("{robot_id}: {before:?} became {switch:?}"),
        )];
        if before.running() == switch.running() {
            return looks;
        }
        looks.push(self.is_signed(robot_id, robot, switch, set));
        let Some(trial) = switch.trial.as_ref().filter(|trial| !trial.is_proven) else { return looks };
        let told = robot.told.get(&robot.software.directive_generation).cloned();
        let still = told.as_ref().and_then(|(_, id)| self.rollouts.get(id)).and_then(|seen| seen.still_since_us);
        let age_us = still.map_or(0, |since| now_us.saturating_sub(since));
        let what = format!(
            "{robot_id} switched to {} for {told:?}, {} ms after its roll-out stood still",
            trial.set,
            age_us / 1_000
        );
        let most_us = limits::ACTIVATION_VALID.as_ms() * 1_020 + SWITCH_US;
        looks.push(("I18 no activation after the word to stand still", age_us <= most_us, what));
        if let Some((_, rollout)) = told {
            self.robot(robot_id).touched = Some((rollout, switch.current.clone()));
        }
        looks
    }

    /// I16: what a robot runs was signed by release people and meant for it.
    fn is_signed(&self, robot_id: &RobotId, robot: &Robot, switch: &Switch, set: Option<&SetManifest>) -> Look {
        let factory = switch.running() == FACTORY;
        let holds = set.is_some_and(|set| {
            let told = set.bundle.is_some_and(|bundle| robot.told.values().any(|(told, _)| *told == bundle));
            let content = set.bundle.and_then(|bundle| self.signed.get(&bundle));
            told && content.is_some_and(|content| set.components.values().all(|c| content.contains(&c.digest)))
        });
        let what = format!("{robot_id} runs {} of {:?}", switch.running(), set.map(|set| &set.bundle));
        ("I16 only signed software runs that the robot was told to", factory || holds, what)
    }

    /// The maker's own safety system stops a robot, or lets it go.
    pub fn stopped(&mut self, robot_id: &RobotId, since_us: Option<u64>) {
        self.robot(robot_id).stopped_us = since_us;
    }

    // --- the end

    /// What must hold when faults are long over and every roll-out has ended.
    pub fn ended(&self) -> Vec<Look> {
        let mut looks = Vec::new();
        for seen in self.rollouts.values() {
            let row = &seen.row;
            let what = format!("{} is {:?} {:?}", row.rollout_id, row.phase, row.pauses);
            looks.push(("I8 every roll-out ends", row.phase.is_over(), what));
        }
        for (robot_id, robot) in &self.robots {
            let what = format!("{robot_id} is held by {:?}", robot.maintenance);
            looks.push(("I8 every drain is released", robot.maintenance.is_none(), what));
            let what = format!("{robot_id} says {:?} and runs by {:?}", robot.software.update, robot.switch);
            looks.push(("I15 ledger and switch record agree", robot.agrees(), what));
            let Some((rollout, kept)) = &robot.touched else { continue };
            let Some(seen) = self.rollouts.get(rollout) else { continue };
            let scope = seen.row.spec.abort_scope == AbortScope::All;
            if matches!(seen.row.phase, Phase::Aborted | Phase::Superseded) && scope {
                let back = robot.switch.running() == kept;
                let what = format!("{robot_id} was touched by {rollout} and runs {:?} instead of {kept}", robot.switch);
                looks.push(("I15 who was touched by what was aborted is back on what it kept", back, what));
            }
        }
        looks
    }
}

/// Robots that may change at once in the wave that a roll-out is in, counted from what was asked for.
fn most_of(row: &Rollout) -> usize {
    let all: usize = row.wave_sizes.iter().map(|size| *size as usize).sum();
    let asked = match row.spec.waves.get(row.wave as usize) {
        Some(Wave::Count(count)) => *count as usize,
        Some(Wave::Percent(percent)) => (all * *percent as usize).div_ceil(100),
        _ => all,
    };
    row.spec.max_in_flight.map_or(asked, |most| asked.min(most as usize)).max(1)
}

/// Whether what is current and kept changed in no way but by a commit, or by going back from one.
fn keeps(before: &Switch, after: &Switch) -> bool {
    if before.current == after.current {
        return before.previous == after.previous;
    }
    let tried = before.trial.as_ref().map(|trial| trial.set.as_str());
    let committed = tried == Some(after.current.as_str()) && after.previous.as_ref() == Some(&before.current);
    let undone = before.previous.as_ref() == Some(&after.current) && after.previous.is_none();
    committed || undone
}
