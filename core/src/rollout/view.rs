//! The rollout service's picture of the rows: built from a snapshot, kept by the feed, and already holding what it is about to commit.
//!
//! Called by every room of `rollout`. Invariants:
//! 1. As [`crate::picture`] says; after a conflict the whole view is built again, never patched.
//! 2. A roll-out is here with all its robots, or not at all. Of those that have ended only what is still named is here ([`past`](super::past)),
//!    and used request_ids are those that were just asked for.

use super::rows::{
    AreaBundle, Bundle, CommandKey, OtaClock, OtaMark, Quarantine, RobotSoftware, Rollout, RolloutRobot,
};
use super::turns::waits_out;
use crate::fleet::Board;
use crate::fleet::liveness;
use crate::fleet::rows::{AreaBudget, Drain, RobotAuthority, RobotControl, RobotCounter, RobotHolder};
use crate::ids::{AreaId, DrainId, RobotId, RolloutId};
use crate::limits;
use crate::maintenance::{DrainRelease, DrainRequest};
use crate::picture::{Picture, Viewed};
pub use crate::picture::{Rowed, Slot};
use crate::policy::AreaPolicy;
use crate::reason::Code;
use crate::robot::{Duty, Lane, Presence};
use crate::rows::{BadRow, Key, Revision, Row, Seq, Table, Writer};
use crate::site::Site;
use crate::time::{LinkTime, Now};
use crate::unknown_rows::UnknownRows;
use crate::update::DesiredUpdate;
use crate::work::{LaneMark, Live, Session};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The picture.
pub struct View {
    /// The site, which never changes while the service runs.
    pub site: Arc<Site>,
    /// Bundles of releases.
    pub bundles: Slot<Bundle>,
    /// Roll-outs: those that have not ended, and what is named of the others.
    pub rollouts: Slot<Rollout>,
    /// Robots in them.
    pub robots: Slot<RolloutRobot>,
    /// Drains that were asked for.
    pub requests: Slot<DrainRequest>,
    /// Drains that may end.
    pub releases: Slot<DrainRelease>,
    /// Section `update` of each robot.
    pub desired: Slot<DesiredUpdate>,
    /// What robots run.
    pub software: Slot<RobotSoftware>,
    /// What they must not run.
    pub quarantines: Slot<Quarantine>,
    /// What newcomers get.
    pub area_bundles: Slot<AreaBundle>,
    /// Consumed position.
    pub marks: Slot<OtaMark>,
    /// Serving time and numbers.
    pub clocks: Slot<OtaClock>,
    /// Used request_ids that were asked for.
    pub command_keys: Slot<CommandKey>,
    /// Drains (fleet's).
    pub drains: Slot<Drain>,
    /// Who of an area is out of work (fleet's).
    pub budgets: Slot<AreaBudget>,
    /// Robots' mutexes (fleet's).
    pub authority: Slot<RobotAuthority>,
    /// Cordons, breakers, retired robots (fleet's).
    pub control: Slot<RobotControl>,
    /// Work done (fleet's).
    pub counters: Slot<RobotCounter>,
    /// Rules of areas (fleet's).
    pub policies: Slot<AreaPolicy>,
    /// Newest sessions (telemetry's).
    pub sessions: Slot<Session>,
    /// Durable lane numbers (telemetry's).
    pub lane_marks: Slot<LaneMark>,
    /// Roll-outs that have a robot.
    pub of_robot: BTreeMap<RobotId, BTreeSet<RolloutId>>,
    /// Ids of robots' rows that something may still be due for.
    pub open: BTreeSet<String>,
    /// Ids of robots' rows that are skipped until a while is over that the robot told.
    pub waiting_out: BTreeSet<String>,
    /// Roll-outs that the feed spoke of while they were not here. Volatile.
    pub spoken_of: BTreeSet<RolloutId>,
    /// Roll-outs that are named and that the store does not have. Volatile.
    pub absent: BTreeSet<RolloutId>,
    /// Robots of each wave.
    pub wave_sizes: BTreeMap<(RolloutId, u32), u32>,
    /// Robots that came or changed since they were last looked at as newcomers. Volatile.
    pub arrived: BTreeSet<RobotId>,
    /// Last entry of the feed that was taken.
    pub absorbed: Seq,
    /// Last entry of the robot inbox that changed nothing. It must not be taken again once something else was decided. Volatile.
    pub passed: Seq,
    /// Entries that the store refuses to have obeyed, whatever is tried. Volatile: found again after a start.
    pub unusable: BTreeSet<Seq>,
    /// Rows were read at this entry: what older entries say of rows is in the picture already.
    pub read_at: Seq,
    /// Reading of the clocks when the service started: everybody counts as heard then.
    pub started: Now,
    /// Reading of the clocks when the rows were read: serving time goes on from there.
    pub read: Now,
    /// Serving time at that moment.
    pub served: OtaClock,
    /// How long robots are in contact without a break. Volatile: it begins anew with the process.
    pub contacts: BTreeMap<RobotId, Contact>,
    /// Why nothing can be signed for robots at this moment. Volatile: known where directives are signed, at the last cycle.
    pub keyless: Option<Code>,
    /// Rows with a value of a newer version.
    pub unknown_rows: UnknownRows,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: super::bugs::Bugs,
}

/// A stretch of heartbeats without a break long enough to be missed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contact {
    /// The first of them.
    pub since: LinkTime,
    /// The newest.
    pub last: LinkTime,
}

impl Picture for View {
    const WRITER: Writer = Writer::Ota;
    fn unknown_rows(&mut self) -> &mut UnknownRows {
        &mut self.unknown_rows
    }
}

macro_rules! viewed {
    ($($record:ty => $slot:ident;)*) => { $(impl Viewed<View> for $record {
        fn slot(view: &mut View) -> &mut Slot<Self> { &mut view.$slot }
    })* };
}

viewed! {
    Bundle => bundles;
    Rollout => rollouts;
    DrainRequest => requests;
    DrainRelease => releases;
    DesiredUpdate => desired;
    OtaMark => marks;
    OtaClock => clocks;
    CommandKey => command_keys;
    Drain => drains;
    AreaBudget => budgets;
    RobotAuthority => authority;
    RobotCounter => counters;
    AreaPolicy => policies;
    LaneMark => lane_marks;
}

impl Viewed<View> for RolloutRobot {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.robots
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        let new = view.robots.get(id).map(|r| &r.row);
        let size = |sizes: &mut BTreeMap<(RolloutId, u32), u32>, row: &Self, by: i32| {
            let wave = (row.rollout_id.clone(), row.wave);
            let size = sizes.get(&wave).copied().unwrap_or_default().saturating_add_signed(by);
            if size > 0 {
                sizes.insert(wave, size)
            } else {
                sizes.remove(&wave)
            };
        };
        if let Some(old) = old {
            size(&mut view.wave_sizes, old, -1);
        }
        if new.and_then(waits_out).is_some() {
            view.waiting_out.insert(id.to_owned());
        } else {
            view.waiting_out.remove(id);
        }
        match new {
            Some(row) => {
                size(&mut view.wave_sizes, row, 1);
                view.of_robot.entry(row.robot_id.clone()).or_default().insert(row.rollout_id.clone());
                if row.step.is_over() {
                    view.open.remove(id);
                    // It is free for a roll-out that was completed meanwhile.
                    view.arrived.insert(row.robot_id.clone());
                } else {
                    view.open.insert(id.to_owned());
                }
            }
            None => {
                view.open.remove(id);
                if let Some(old) = old
                    && let Some(rollouts) = view.of_robot.get_mut(&old.robot_id)
                {
                    rollouts.remove(&old.rollout_id);
                }
            }
        }
    }
}

impl Viewed<View> for RobotSoftware {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.software
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        let Some(new) = view.software.get(id).map(|s| &s.row) else { return };
        if old.is_none_or(|old| old.area != new.area || old.pin.is_some() != new.pin.is_some()) {
            view.arrived.insert(new.robot_id.clone());
        }
    }
}

impl Viewed<View> for RobotControl {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.control
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        let Some(new) = view.control.get(id).map(|c| &c.row) else { return };
        if old.is_some_and(|old| old.retired.is_some()) && new.retired.is_none() {
            view.arrived.insert(new.robot_id.clone());
        }
    }
}

impl Viewed<View> for Quarantine {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.quarantines
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        if let Some(lifted) = old.filter(|_| !view.quarantines.contains_key(id)) {
            view.arrived.insert(lifted.robot_id.clone());
        }
    }
}

impl Viewed<View> for AreaBundle {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.area_bundles
    }
    /// Robots that came while the roll-out ran had no part in it.
    fn changed(view: &mut View, _id: &str, _old: Option<&Self>) {
        let all: Vec<RobotId> = view.sessions.values().map(|s| s.row.robot_id.clone()).collect();
        view.arrived.extend(all);
    }
}

impl Viewed<View> for Session {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.sessions
    }
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        view.arrived.extend(view.sessions.get(id).map(|s| s.row.robot_id.clone()));
    }
}

/// Tables that hold only what is there now, or that are bounded by count.
pub const WHOLE: &[Table] = &[
    Table::Bundle,
    Table::DrainRequest,
    Table::DrainRelease,
    Table::DesiredUpdate,
    Table::RobotSoftware,
    Table::Quarantine,
    Table::AreaBundle,
    Table::OtaMark,
    Table::OtaClock,
    Table::Drain,
    Table::AreaBudget,
    Table::RobotAuthority,
    Table::RobotControl,
    Table::RobotCounter,
    Table::AreaPolicy,
    Table::Session,
    Table::LaneMark,
];

impl View {
    /// An empty picture of `site`.
    pub fn new(site: Arc<Site>, started: Now, read: Now) -> Self {
        Self {
            site,
            bundles: Slot::new(),
            rollouts: Slot::new(),
            robots: Slot::new(),
            requests: Slot::new(),
            releases: Slot::new(),
            desired: Slot::new(),
            software: Slot::new(),
            quarantines: Slot::new(),
            area_bundles: Slot::new(),
            marks: Slot::new(),
            clocks: Slot::new(),
            command_keys: Slot::new(),
            drains: Slot::new(),
            budgets: Slot::new(),
            authority: Slot::new(),
            control: Slot::new(),
            counters: Slot::new(),
            policies: Slot::new(),
            sessions: Slot::new(),
            lane_marks: Slot::new(),
            of_robot: BTreeMap::new(),
            open: BTreeSet::new(),
            waiting_out: BTreeSet::new(),
            spoken_of: BTreeSet::new(),
            absent: BTreeSet::new(),
            wave_sizes: BTreeMap::new(),
            arrived: BTreeSet::new(),
            absorbed: Seq(0),
            passed: Seq(0),
            unusable: BTreeSet::new(),
            read_at: Seq(0),
            started,
            read,
            served: OtaClock::default(),
            contacts: BTreeMap::new(),
            keyless: None,
            unknown_rows: UnknownRows::default(),
            bugs: super::bugs::Bugs::default(),
        }
    }

    /// Takes every row of a snapshot read at `seq`.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn load(&mut self, rows: &[Row], seq: Seq) -> Result<(), BadRow> {
        for row in rows {
            self.absorb(&row.key, row.revision, Some(row))?;
        }
        self.read_at = seq;
        self.absorbed = self.marks.get("ota").map_or(Seq(0), |m| m.row.seq);
        self.served = self.clocks.get("ota").map(|c| c.row).unwrap_or_default();
        Ok(())
    }

    /// Takes one row as the store has it; none: deleted.
    ///
    /// # Errors
    /// A body that is not what its table holds.
    pub fn absorb(&mut self, key: &Key, revision: Revision, row: Option<&Row>) -> Result<(), BadRow> {
        macro_rules! take {
            ($($table:ident => $record:ty,)*) => {
                match key.table {
                    $(Table::$table => crate::picture::take::<Self, $record>(self, &key.id, revision, row),)*
                    _ => Ok(()),
                }
            };
        }
        take! {
            Bundle => Bundle,
            Rollout => Rollout,
            RolloutRobot => RolloutRobot,
            DrainRequest => DrainRequest,
            DrainRelease => DrainRelease,
            DesiredUpdate => DesiredUpdate,
            RobotSoftware => RobotSoftware,
            Quarantine => Quarantine,
            AreaBundle => AreaBundle,
            OtaMark => OtaMark,
            OtaClock => OtaClock,
            OtaCommandKey => CommandKey,
            Drain => Drain,
            AreaBudget => AreaBudget,
            RobotAuthority => RobotAuthority,
            RobotControl => RobotControl,
            RobotCounter => RobotCounter,
            AreaPolicy => AreaPolicy,
            Session => Session,
            LaneMark => LaneMark,
        }
    }

    /// A robot was heard.
    pub fn keep_contact(&mut self, live: &Live) {
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
        let (from, to) = (format!("{id}/"), format!("{id}0"));
        self.robots.range(from..to).map(|(_, r)| &r.row)
    }
    /// A robot in a roll-out.
    pub fn robot_of(&self, rollout: &RolloutId, robot: &RobotId) -> Option<&RolloutRobot> {
        self.robots.get(&RolloutRobot::id_of(rollout, robot)).map(|r| &r.row)
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
    /// Whether a robot is heard. After a start of the service everybody counts as heard for as long as a robot may take to come back.
    pub fn is_heard(&self, board: &Board, now: &Now, robot: &RobotId) -> bool {
        let begun = now.link.since(self.started.link) <= limits::OFFLINE_AFTER;
        begun || liveness::presence(board, robot, now) != Presence::Offline
    }
    /// The area in which a robot is.
    pub fn area_of(&self, live: &Live) -> Option<AreaId> {
        live.area(&self.site).cloned()
    }
    /// Everything that the robot had said when it sent this heartbeat was consumed, nothing that it said since, and it belongs to the newest
    /// session.
    pub fn is_settled(&self, live: &Live) -> bool {
        let id = live.robot_id.as_str();
        let Some(session) = self.sessions.get(id) else { return false };
        let mark = self.lane_marks.get(&format!("{id}/{}", session.row.ring)).map(|m| &m.row);
        let said = live.report.produced.get(&Lane::Event).copied().unwrap_or(0);
        let is_fresh = said >= mark.map_or(0, |m| m.event);
        session.row.session_epoch == live.report.session_epoch && live.is_consumed(mark) && is_fresh
    }
}
