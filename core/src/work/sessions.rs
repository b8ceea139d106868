//! What telemetry keeps of robots: newest sessions, whether each is heard, how far its lanes are durable, its newest heartbeat.

use crate::ids::{AreaId, RobotId, WaypointId};
use crate::robot::{HeldPlace, Lane, Presence};
use crate::rows::{Index, Record, Table, body_is_json, written};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// A robot's newest session, written by telemetry at each Hello.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Session {
    /// The robot whose session it is.
    pub robot_id: RobotId,
    /// max(old + 1, unix ms): sessions with less are fenced.
    pub session_epoch: u64,
    /// Proves succession in the next Hello.
    pub secret: crate::identity::SessionSecret,
    /// New for each start of the agent.
    pub boot_id: String,
    /// Random, made when the robot's ring was formatted.
    pub ring: String,
    /// What it said of itself.
    pub inventory: crate::robot::Inventory,
    /// Highest generation of section work the robot had applied.
    pub applied_work: u64,
    /// Highest generation of section update the robot had applied.
    #[serde(default)]
    pub applied_update: u64,
    /// Places it said it holds, at Hello.
    pub places: Vec<HeldPlace>,
    /// Robot clock minus server clock, milliseconds, as the sessions before this one measured it last; none: they did not.
    pub clock_offset_ms: Option<i64>,
    /// What it said it has installed, if the key of the robot's machine signed it; none: it said nothing that is believed.
    #[serde(default)]
    pub installed: Option<crate::update::Installed>,
    /// The key of the robot's machine, taken when it was first seen, 64 hexadecimal digits; none: it never said one.
    #[serde(default)]
    pub device_key: Option<String>,
    /// Another key signed what this session said of its software: it is another machine, or one that lost its memory.
    #[serde(default)]
    pub device_key_changed: bool,
    /// That other key, 64 hexadecimal digits; none: it did not change.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub other_device_key: Option<String>,
    /// When the robot was enrolled, as this session found it, UTC unix ms: what was known of its machine holds for that enrolment. None: it showed no
    /// certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enrolled_unix_ms: Option<i64>,
}

impl Session {
    /// One whose robot has said nothing but what it is.
    pub fn new(robot_id: RobotId, session_epoch: u64, inventory: crate::robot::Inventory) -> Self {
        Self {
            robot_id,
            session_epoch,
            secret: Default::default(),
            boot_id: String::new(),
            ring: String::new(),
            inventory,
            applied_work: 0,
            applied_update: 0,
            places: Vec::new(),
            clock_offset_ms: None,
            installed: None,
            device_key: None,
            device_key_changed: false,
            other_device_key: None,
            enrolled_unix_ms: None,
        }
    }
    /// The generation of section work that the server goes on from: none beyond what any server could have given.
    pub fn followed_work(&self) -> u64 {
        followed(self.applied_work)
    }
    /// The same of section update.
    pub fn followed_update(&self) -> u64 {
        followed(self.applied_update)
    }
}

/// What a robot says it has applied, as far as it is believed: whoever followed the largest number could never be answered with it again.
fn followed(said: u64) -> u64 {
    if said > crate::limits::GENERATION_FOLLOWED_MAX { 0 } else { said }
}

impl Record for Session {
    const TABLE: Table = Table::Session;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// Presence of a robot as telemetry sees it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PresenceRow {
    /// The robot whose presence it is.
    pub robot_id: RobotId,
    /// Heard or not.
    pub presence: Presence,
    /// UTC of the wall, since when.
    pub since_unix_ms: i64,
    /// What kept it from work by its own word when it was heard last, the gravest first: [`crate::robot::ReportedState::conditions`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conditions: Vec<Condition>,
    /// What it said when this row was written; none: it was never heard since rows keep that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_heard: Option<LastHeard>,
}

/// One thing that keeps a robot from work by its own word.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Condition {
    /// In words.
    pub what: String,
    /// UTC of the wall, receipt of the first heartbeat that said so.
    pub since_unix_ms: i64,
}

/// What is kept of a heartbeat, for people, until the robot is heard again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastHeard {
    /// UTC of the wall, its receipt.
    pub at_unix_ms: i64,
    /// State of charge.
    pub battery_permille: u16,
    /// Where it was. None: it did not know.
    pub waypoint: Option<WaypointId>,
}

impl PresenceRow {
    /// Of a robot that this store knows nothing else of.
    pub fn new(robot_id: RobotId, presence: Presence, since_unix_ms: i64) -> Self {
        Self { robot_id, presence, since_unix_ms, conditions: Vec::new(), last_heard: None }
    }
    /// The row of a robot after this one, at `wall`. `live`: its newest heartbeat; none: this server has not heard it.
    pub fn next(&self, presence: Presence, live: Option<&Live>, wall: crate::time::Utc) -> Self {
        let Some(live) = live else {
            let since_unix_ms = self.unheard_since_unix_ms();
            return Self { presence, since_unix_ms, ..self.clone() };
        };
        let since_unix_ms = if presence == self.presence { self.since_unix_ms } else { wall.0 };
        Self {
            robot_id: self.robot_id.clone(),
            presence,
            since_unix_ms,
            conditions: self.conditions_of(live),
            last_heard: Some(LastHeard {
                at_unix_ms: live.received_unix_ms,
                battery_permille: live.report.vitals.battery_permille,
                waypoint: live.report.vitals.waypoint.clone(),
            }),
        }
    }
    /// What keeps the robot from work by its newest heartbeat, since when as far as this row knows.
    pub fn conditions_of(&self, live: &Live) -> Vec<Condition> {
        let since =
            |what: &str| self.conditions.iter().find(|known| known.what == what).map(|known| known.since_unix_ms);
        let words = live.report.conditions().into_iter();
        words.map(|what| Condition { since_unix_ms: since(&what).unwrap_or(live.received_unix_ms), what }).collect()
    }
    /// When the robot was last known to be heard, for a server that has not heard it itself. UTC of the wall, unix ms.
    /// Unless the row says OFFLINE, it is the receipt of the heartbeat kept in it; else the moment since which
    /// `presence` holds.
    pub fn unheard_since_unix_ms(&self) -> i64 {
        let heard = self.last_heard.as_ref().filter(|_| self.presence != Presence::Offline);
        heard.map_or(self.since_unix_ms, |heard| heard.at_unix_ms)
    }
}

impl Record for PresenceRow {
    const TABLE: Table = Table::Presence;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// Highest durable numbers of one ring; guards each append to the inbox, so nothing is stored twice.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LaneMark {
    /// Whose ring.
    pub robot_id: RobotId,
    /// The ring.
    pub ring: String,
    /// Highest CRITICAL number stored.
    pub critical: u64,
    /// Highest EVENT number stored.
    pub event: u64,
    /// When it was written last, UTC of the wall, unix ms; 0: before this was noted.
    #[serde(default)]
    pub at_unix_ms: i64,
}

impl LaneMark {
    /// Of a ring of which nothing is stored.
    pub fn fresh(robot_id: RobotId, ring: &str) -> Self {
        Self { robot_id, ring: ring.to_owned(), critical: 0, event: 0, at_unix_ms: 0 }
    }
}

impl Record for LaneMark {
    const TABLE: Table = Table::LaneMark;
    body_is_json!();
    fn id(&self) -> String {
        format!("{}/{}", self.robot_id, self.ring)
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), order: Some(self.at_unix_ms), ..Index::default() }
    }
}

/// The newest heartbeat of a robot with what the server knows about it: the volatile face, never a row.
#[derive(Clone, Debug, PartialEq)]
pub struct Live {
    /// The robot that sent it.
    pub robot_id: RobotId,
    /// What it said.
    pub report: crate::robot::ReportedState,
    /// When the server had processed it.
    pub processed_at: crate::time::LinkTime,
    /// The same moment on the site clock.
    pub processed_site: crate::time::SiteTime,
    /// UTC of the wall at receipt.
    pub received_unix_ms: i64,
    /// When its progress number last changed, site clock.
    pub progress_at: crate::time::SiteTime,
    /// How far its clock is off. None: not measured yet.
    pub clock: Option<ClockOffset>,
}

/// How far the clock of a robot is off, as its gateway measured it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockOffset {
    /// Robot clock minus server clock, milliseconds.
    pub clock_offset_ms: i64,
    /// Largest error of that, milliseconds.
    pub clock_error_ms: u64,
}

impl Live {
    /// The area in which the robot is: that of the waypoint it was at last. None: not known.
    pub fn area<'s>(&self, site: &'s crate::site::Site) -> Option<&'s AreaId> {
        site.area_at(self.report.vitals.waypoint.as_ref())
    }
}

/// A heartbeat as its gateway shares it with other processes: without readings of clocks of one process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SharedHeartbeat {
    /// What the robot said.
    pub report: crate::robot::ReportedState,
    /// UTC of the gateway's wall at receipt, milliseconds.
    pub received_unix_ms: i64,
    /// As [`Live::clock`].
    pub clock: Option<ClockOffset>,
}

impl SharedHeartbeat {
    /// As text, for [`SharedHeartbeat::parse`].
    pub fn text(&self) -> Arc<str> {
        written(self)
    }
    /// From [`SharedHeartbeat::text`].
    ///
    /// # Errors
    /// If it is not such a text.
    pub fn parse(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }
    /// As this process knows it from `now` on, where it knew `before` of the robot; none if that is not older.
    pub fn into_live(self, robot_id: &RobotId, before: Option<&Live>, now: crate::time::Now) -> Option<Live> {
        let order = |report: &crate::robot::ReportedState| (report.session_epoch, report.hb);
        if before.is_some_and(|before| order(&before.report) >= order(&self.report)) {
            return None;
        }
        let progressed = before.is_none_or(|before| before.report.progress() != self.report.progress());
        let progress_at = before.filter(|_| !progressed).map_or(now.site, |before| before.progress_at);
        let Self { report, received_unix_ms, clock } = self;
        let (robot_id, processed_at, processed_site) = (robot_id.clone(), now.link, now.site);
        Some(Live { robot_id, report, processed_at, processed_site, received_unix_ms, progress_at, clock })
    }
}

impl From<&Live> for SharedHeartbeat {
    fn from(live: &Live) -> Self {
        Self { report: live.report.clone(), received_unix_ms: live.received_unix_ms, clock: live.clock }
    }
}

impl Live {
    /// Everything that the robot had written down when it sent this is stored, if its ring stands at `mark`.
    pub fn is_consumed(&self, mark: Option<&LaneMark>) -> bool {
        let done = |lane: Lane, have: u64| self.report.produced.get(&lane).is_none_or(|p| *p <= have);
        done(Lane::Event, mark.map_or(0, |m| m.event)) && done(Lane::Critical, mark.map_or(0, |m| m.critical))
    }
}
