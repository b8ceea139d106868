//! Presence: ONLINE, SUSPECT or OFFLINE, by the age of a robot's newest heartbeat, and what is kept of a robot meanwhile.
//!
//! Decided by [`Presence::since`]; written by telemetry.

use crate::heartbeat::NewestHeartbeat;
use crate::ids::{RobotId, WaypointId};
use crate::limits;
use crate::rows::{Record, Table, body_is_json};
use crate::time::LinkTime;
use serde::{Deserialize, Serialize};

/// Whether a robot is heard, by the age of its newest heartbeat alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Presence {
    /// A heartbeat within 3 s.
    Online,
    /// None for 3 s: no new work.
    Suspect,
    /// None for 31 s: its authority is over.
    Offline,
}

impl Presence {
    /// Of a robot whose newest heartbeat was processed at `heard`; none: nothing was heard of it.
    pub fn since(heard: Option<LinkTime>, now: LinkTime) -> Self {
        match heard.map(|at| now.since(at)) {
            Some(age) if age <= limits::SUSPECT_AFTER => Self::Online,
            Some(age) if age <= limits::OFFLINE_AFTER => Self::Suspect,
            _ => Self::Offline,
        }
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
    pub fn next(&self, presence: Presence, live: Option<&NewestHeartbeat>, wall: crate::time::Utc) -> Self {
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
    pub fn conditions_of(&self, live: &NewestHeartbeat) -> Vec<Condition> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presence_follows_the_age_of_the_newest_heartbeat() {
        let now = LinkTime(100_000);
        let at = |age_ms: u64| Presence::since(Some(LinkTime(100_000 - age_ms)), now);
        assert_eq!(
            [at(3_000), at(3_001), at(31_000), at(31_001)],
            [Presence::Online, Presence::Suspect, Presence::Suspect, Presence::Offline]
        );
        assert_eq!(Presence::since(None, now), Presence::Offline);
    }
}
