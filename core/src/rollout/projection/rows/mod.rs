//! Rows that the rollout service alone writes, apart from drains ([`crate::drain_request`]): releases, roll-outs, robots
//! in them, what robots run and should run, what they must not run, and what the service keeps of itself.

mod robot;
mod rollout;

pub use robot::{GivenPermission, Lost, Moments, Quarantine, RobotSoftware, RolloutRobot, Step, WayBack};
pub use rollout::{Abort, Act, Bundle, Countdown, Ending, Outcome, Pause, Phase, Rollout, TaskBaseline, Verdict};

use crate::ids::{AreaId, RolloutId};
use crate::rows::{Index, Record, Seq, Table, body_is_json};
use crate::update::DesiredUpdate;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

impl Record for DesiredUpdate {
    const TABLE: Table = Table::DesiredUpdate;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.generation as i64), ..Index::default() }
    }
}

/// What robots get that come to an area later.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaBundle {
    /// Which area.
    pub area_id: AreaId,
    /// The newest completed roll-out, by hardware model.
    pub rollouts: BTreeMap<String, RolloutId>,
}

impl Record for AreaBundle {
    const TABLE: Table = Table::AreaBundle;
    body_is_json!();
    fn id(&self) -> String {
        self.area_id.to_string()
    }
}

/// How far the rollout service has consumed the feed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OtaMark {
    /// Every entry up to here has had its effect.
    pub seq: Seq,
}

impl Record for OtaMark {
    const TABLE: Table = Table::OtaMark;
    body_is_json!();
    fn id(&self) -> String {
        "ota".to_owned()
    }
}

/// Serving time of the rollout service, and the last number it gave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OtaClock {
    /// Milliseconds served on the site clock.
    pub site_ms: u64,
    /// Last number of a drain or permission.
    pub number: u64,
}

impl Record for OtaClock {
    const TABLE: Table = Table::OtaClock;
    body_is_json!();
    fn id(&self) -> String {
        "ota".to_owned()
    }
}

/// A used request_id of a command.
pub type CommandKey = crate::idempotency::CommandKey<super::requests::Command>;
