//! The rollout service's projection of the rows: built from a snapshot, kept by the feed, and already holding what it is
//! about to commit.
//!
//! Called by every room of `rollout`. Invariants:
//! 1. As [`crate::projection`] says; after a conflict the whole view is built again, never patched.
//! 2. A roll-out is here with all its robots, or not at all. Of those that have ended only what is still named is here
//!    ([`ended`](super::ended)), and used request_ids are those that were just asked for.

use super::rows::{
    AreaBundle, Bundle, CommandKey, OtaClock, OtaMark, Quarantine, RobotSoftware, Rollout, RolloutRobot,
};
use crate::drain_request::{DrainRelease, DrainRequest};
use crate::fleet::Board;
use crate::fleet::liveness;
use crate::fleet::rows::{AreaBudget, Drain, RobotAuthority, RobotControl, RobotCounter, RobotHolder};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AreaId, DrainId, RobotId, RolloutId};
use crate::limits;
use crate::policy::AreaPolicy;
use crate::presence::Presence;
use crate::projection::{Indexed, projection};
use crate::reason::Code;
use crate::robot::{Duty, Lane};
use crate::rollout::bugs::Bugs;
use crate::rows::{BadRow, Row, Seq};
use crate::session::{LaneMark, Session};
use crate::site::Site;
use crate::time::{LinkTime, Now};
use crate::unknown_rows::UnknownRows;
use crate::update::{DesiredUpdate, UpdateReport};
use smol_str::format_smolstr;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

projection! {
    /// What the rollout service knows.
    pub struct RolloutProjection of Ota;
    new(site: Arc<Site>, started: Now, read: Now);
    whole {
        /// Bundles of releases.
        bundles: Bundle = Bundle;
        /// Drains that were asked for.
        requests: DrainRequest = DrainRequest;
        /// Drains that may end.
        releases: DrainRelease = DrainRelease;
        /// Section `update` of each robot.
        desired: DesiredUpdate = DesiredUpdate;
        /// What robots run.
        software: RobotSoftware = RobotSoftware Indexed;
        /// What they must not run.
        quarantines: Quarantine = Quarantine Indexed;
        /// What newcomers get.
        area_bundles: AreaBundle = AreaBundle Indexed;
        /// Consumed position.
        marks: OtaMark = OtaMark;
        /// Serving time and numbers.
        clocks: OtaClock = OtaClock;
        /// Drains (fleet's).
        drains: Drain = Drain;
        /// Who of an area is out of work (fleet's).
        budgets: AreaBudget = AreaBudget;
        /// Robots' mutexes (fleet's).
        authority: RobotAuthority = RobotAuthority;
        /// Cordons, breakers, retired robots (fleet's).
        control: RobotControl = RobotControl Indexed;
        /// Work done (fleet's).
        counters: RobotCounter = RobotCounter;
        /// Rules of areas (fleet's).
        policies: AreaPolicy = AreaPolicy;
        /// Newest sessions (telemetry's).
        sessions: Session = Session Indexed;
        /// Durable lane numbers (telemetry's).
        lane_marks: LaneMark = LaneMark;
    }
    part {
        /// Roll-outs: those that have not ended, and what is named of the others.
        rollouts: Rollout = Rollout;
        /// Robots in them.
        robots: RolloutRobot = RolloutRobot Indexed;
        /// Used request_ids that were asked for.
        command_keys: CommandKey = OtaCommandKey;
    }
    kept {
        /// Entries that the store refuses to have obeyed, whatever is tried. Found again after a start.
        unusable: BTreeSet<Seq> = BTreeSet::new();
        /// How long robots are in contact without a break. It begins anew with the process.
        contacts: BTreeMap<RobotId, Contact> = BTreeMap::new();
    }
    anew {
        /// The site, which never changes while the service runs.
        site: Arc<Site> = site;
        /// Roll-outs that have a robot.
        of_robot: BTreeMap<RobotId, BTreeSet<RolloutId>> = BTreeMap::new();
        /// Ids of robots' rows that something may still be due for.
        open: BTreeSet<String> = BTreeSet::new();
        /// Ids of robots' rows that are skipped until a while is over that the robot told.
        waiting_out: BTreeSet<String> = BTreeSet::new();
        /// Roll-outs that the feed spoke of while they were not here. Volatile.
        spoken_of: BTreeSet<RolloutId> = BTreeSet::new();
        /// Roll-outs that are named and that the store does not have. Volatile.
        absent: BTreeSet<RolloutId> = BTreeSet::new();
        /// Robots of each wave.
        wave_sizes: BTreeMap<(RolloutId, u32), u32> = BTreeMap::new();
        /// Robots that came or changed since they were last looked at as newcomers. Volatile.
        arrived: BTreeSet<RobotId> = BTreeSet::new();
        /// Last entry of the feed that was taken.
        absorbed: Seq = Seq(0);
        /// Last entry of the robot inbox that changed nothing. It must not be taken again once something else was
        /// decided. Volatile.
        passed: Seq = Seq(0);
        /// Rows were read at this entry: what older entries say of rows is in the projection already.
        read_at: Seq = Seq(0);
        /// Reading of the clocks when the service started: everybody counts as heard then.
        started: Now = started;
        /// Reading of the clocks when the rows were read: serving time goes on from there.
        read: Now = read;
        /// Serving time at that moment.
        served: OtaClock = OtaClock::default();
        /// Why nothing can be signed for robots at this moment. Volatile: known where directives are signed, at the
        /// last cycle.
        keyless: Option<Code> = None;
        /// Rows with a value of a newer version.
        unknown_rows: UnknownRows = UnknownRows::default();
        /// Naive rules for twins of tests; none outside them.
        bugs: Bugs = Bugs::default();
    }
}

/// A stretch of heartbeats without a break long enough to be missed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contact {
    /// The first of them.
    pub since: LinkTime,
    /// The newest.
    pub last: LinkTime,
}

impl RolloutProjection {
    /// Takes every row of a snapshot read at `seq`.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn load(&mut self, rows: &[Row], seq: Seq) -> Result<(), BadRow> {
        for row in rows {
            self.take_row(&row.key, row.revision, Some(row))?;
        }
        self.read_at = seq;
        self.absorbed = self.marks.get("ota").map_or(Seq(0), |m| m.row.seq);
        self.served = self.clocks.get("ota").map(|c| c.row).unwrap_or_default();
        Ok(())
    }

    /// A robot was heard.
    pub fn keep_contact(&mut self, live: &NewestHeartbeat) {
        let at = live.processed_at;
        let contact = self.contacts.entry(live.robot_id.clone()).or_insert(Contact { since: at, last: at });
        if at.since(contact.last) > limits::OFFLINE_AFTER {
            contact.since = at;
        }
        contact.last = at.max(contact.last);
    }
    /// Forgets since when robots were heard that are not there any more, or that a person has retired.
    pub fn forget_contacts(&mut self, board: &Board) {
        let mut contacts = std::mem::take(&mut self.contacts);
        contacts.retain(|robot_id, _| board.contains_key(robot_id) && self.duty(robot_id) != Duty::Retired);
        self.contacts = contacts;
    }
    /// Milliseconds served on the site clock by `now`.
    pub fn served_ms(&self, now: &Now) -> u64 {
        self.served.site_ms + now.site.since(self.read.site).as_ms()
    }
    /// A roll-out.
    pub fn rollout(&self, id: &RolloutId) -> Option<&Rollout> {
        self.rollouts.get(id.as_str()).map(|r| &r.row)
    }
    /// Robots of a roll-out, by id.
    pub fn robots_of<'a>(&'a self, id: &RolloutId) -> impl Iterator<Item = &'a RolloutRobot> + use<'a> {
        let (from, to) = (format_smolstr!("{id}/"), format_smolstr!("{id}0"));
        self.robots.range(from..to).map(|(_, r)| &r.row)
    }
    /// A robot in a roll-out.
    pub fn robot_of(&self, rollout: &RolloutId, robot: &RobotId) -> Option<&RolloutRobot> {
        self.robots.get(RolloutRobot::id_of(rollout, robot).as_str()).map(|r| &r.row)
    }
    /// A robot in all roll-outs that it is in.
    pub fn rows_of_robot<'a>(&'a self, robot_id: &'a RobotId) -> impl Iterator<Item = &'a RolloutRobot> {
        self.of_robot.get(robot_id).into_iter().flatten().filter_map(move |id| self.robot_of(id, robot_id))
    }
    /// What a robot said of its update to this bundle, the newest that may be believed.
    pub fn report_of<'a>(&'a self, board: &'a Board, robot: &RolloutRobot) -> Option<&'a UpdateReport> {
        let bundle = &self.rollout(&robot.rollout_id)?.spec.bundle;
        let known = self.software.get(robot.robot_id.as_str()).and_then(|s| s.row.report.as_ref());
        let settled = board.get(&robot.robot_id).filter(|live| self.is_settled(live));
        settled.and_then(|live| live.report.update.as_ref()).or(known).filter(|r| r.bundle == *bundle)
    }
    /// What a robot runs, as far as it said.
    pub fn software_of(&self, robot: &RobotId) -> RobotSoftware {
        self.software.get(robot.as_str()).map_or_else(|| RobotSoftware::new(robot.clone()), |s| s.row.clone())
    }
    /// How far the drain is, if fleet knows it.
    pub fn drain(&self, id: &DrainId) -> Option<&Drain> {
        self.drains.get(id.as_str()).map(|d| &d.row)
    }
    /// Whether the drain holds the robot.
    pub fn is_held(&self, robot: &RobotId, drain: &DrainId) -> bool {
        let holder = self.authority.get(robot.as_str()).map(|a| &a.row.holder);
        matches!(holder, Some(RobotHolder::Maintenance(id)) if id == drain)
    }
    /// Whether some drain holds the robot.
    pub fn is_held_by_any(&self, robot: &RobotId) -> bool {
        let holder = self.authority.get(robot.as_str()).map(|a| &a.row.holder);
        matches!(holder, Some(RobotHolder::Maintenance(_)))
    }
    /// Whether a robot works as far as people and the breaker are concerned.
    pub fn duty(&self, robot: &RobotId) -> Duty {
        self.control.get(robot.as_str()).map_or(Duty::InWork, |c| c.row.duty())
    }
    /// Rules of an area.
    pub fn policy(&self, area: &AreaId) -> AreaPolicy {
        let file = || self.site.find_area(area).map(|at| self.site.area(at).policy());
        let known = self.policies.get(area.as_str()).map(|p| p.row.clone());
        known.or_else(file).unwrap_or_else(|| AreaPolicy::default_of(area.clone()))
    }
    /// Whether a robot is heard. After a start of the service everybody counts as heard for as long as a robot may take
    /// to come back.
    pub fn is_heard(&self, board: &Board, now: &Now, robot: &RobotId) -> bool {
        let begun = now.link.since(self.started.link) <= limits::OFFLINE_AFTER;
        begun || liveness::presence(board, robot, now) != Presence::Offline
    }
    /// The area in which a robot is.
    pub fn area_of(&self, live: &NewestHeartbeat) -> Option<AreaId> {
        live.area(&self.site).cloned()
    }
    /// Everything that the robot had said when it sent this heartbeat was consumed, nothing that it said since, and it
    /// belongs to the newest session.
    pub fn is_settled(&self, live: &NewestHeartbeat) -> bool {
        let id = live.robot_id.as_str();
        let Some(session) = self.sessions.get(id) else { return false };
        let mark = self.lane_marks.get(format!("{id}/{}", session.row.ring).as_str()).map(|m| &m.row);
        let said = live.report.produced.get(&Lane::Event).copied().unwrap_or(0);
        let is_fresh = said >= mark.map_or(0, |m| m.event);
        session.row.session_epoch == live.report.session_epoch && live.is_consumed(mark) && is_fresh
    }
}
