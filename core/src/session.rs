//! Sessions of robots: the newest of each, and how far its lanes are durable.

use crate::ids::RobotId;
use crate::robot::HeldPlace;
use crate::rows::{Index, Record, Table, body_is_json};
use serde::{Deserialize, Serialize};

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
    /// When the robot was enrolled, as this session found it, UTC unix ms: what was known of its machine holds for that
    /// enrolment. None: it showed no certificate.
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
