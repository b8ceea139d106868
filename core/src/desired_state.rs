//! Desired state of a robot: what goes down to it, in sections.
//!
//! Robots get desired state, not commands. Each section has the generation of its one writer and never moves backwards.
//! Written by fleet, composed and sent by telemetry, obeyed by the agent. Section `update` is in [`crate::update`].

use crate::authority::Authority;
use crate::ids::{AreaId, AttemptId, DrainId, PlaceId, RobotId, StopId, WaypointId};
use crate::policy::AreaPolicy;
use crate::rows::{Index, Record, Table, body_is_json};
use crate::step::WorkStep;
use serde::{Deserialize, Serialize};

/// Section `work` of a robot's desired state: whole, newest wins.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DesiredWork {
    /// The robot that is to have it.
    pub robot_id: RobotId,
    /// max(previous + 1, unix ms): rises also across a restore of the store.
    pub generation: u64,
    /// What to do. None: no work; what runs under an attempt not named here is to be stopped and confirmed.
    pub assignment: Option<Assignment>,
    /// Every place it may enter or stay in.
    pub grants: Vec<GrantedPlace>,
    /// Hold tokens of robot or task scope stand: stand still where it is safe and keep the work.
    pub held: bool,
    /// Permission to move again after a hold. Needed once per hold; a buffered one is refused.
    pub resume: Option<Authority>,
    /// Attempts whose end the server has stored: the robot may forget them from its report.
    pub closed: Vec<AttemptId>,
    /// The drain that holds the robot: no work, and its software may change.
    #[serde(default)]
    pub maintenance: Option<DrainId>,
    /// Stops that people resumed for it, as long as it says that it waits for that. One whose reset it has not heard of waits on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub resumed: Vec<StopId>,
    /// A person's word that it carries nothing, while it says that it does and knows that by its memory alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load_word: Option<LoadWord>,
}

/// A person has looked: a load that this heartbeat listed, and that has not changed since, is not on the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadWord {
    /// Session of the heartbeat.
    pub session_epoch: u64,
    /// Its number.
    pub hb: u64,
}

impl Record for DesiredWork {
    const TABLE: Table = Table::DesiredWork;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.generation as i64), ..Index::default() }
    }
}

/// One attempt as it is given to a robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// Which attempt.
    pub attempt: AttemptId,
    /// Permission to accept it. Going on with it afterwards lives from the echo of heartbeats.
    pub offer: Authority,
    /// Milliseconds of site time from acceptance until the agent itself ends it (5 % before the server does).
    pub timeout_ms: u64,
    /// All steps of the task.
    pub steps: Vec<WorkStep>,
    /// Where to begin: steps before it are done. A goto if the robot must first drive to where `resume_step` is done.
    pub from_step: u32,
    /// Where to go on after the goto at `from_step`: steps between them are done and must not be done again. Equal to
    /// `from_step` if there is no such goto.
    pub resume_step: u32,
    /// Rises when the server chose another way; `released_index` counts in this route.
    pub route_number: u32,
    /// The whole way through all goto steps that are left.
    pub route: Vec<RoutePoint>,
    /// Index in `route` up to which the robot may drive: always a standing place or the end. None: stay.
    pub released_index: Option<u32>,
    /// Stop at the next point where it is safe and give it back; stays here until the stop is confirmed.
    pub stop: bool,
    /// Stop at the next step boundary without a load and give it back.
    pub suspend: bool,
    /// Millimetres per second for this task. None: the area's.
    pub speed_limit_mm_s: Option<u32>,
}

impl Assignment {
    /// Whether its numbers lie within its steps and its route, in order: what a robot can read.
    pub fn is_lawful(&self) -> bool {
        let (steps, points) = (self.steps.len() as u64, self.route.len() as u64);
        let lies = self.from_step <= self.resume_step && u64::from(self.resume_step) <= steps;
        steps > 0 && lies && self.released_index.is_none_or(|at| u64::from(at) < points)
    }
}

/// One waypoint of a route.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RoutePoint {
    /// The waypoint, as the site file names it.
    pub waypoint: WaypointId,
    /// Millimetres to the east, in the site's frame.
    pub x_mm: i32,
    /// Millimetres to the north, in the site's frame.
    pub y_mm: i32,
    /// The goto step that ends here, if one does.
    pub ends_step: Option<u32>,
    /// A standing place the robot must hold before it enters.
    pub standing: Option<PlaceId>,
    /// Passages the lane that leads here crosses; each must be held before it is entered.
    pub passages: Vec<PlaceId>,
    /// Limit of the lane that leads here, millimetres per second. None: none of its own.
    pub speed_limit_mm_s: Option<u32>,
    /// Area of this point, whose policy holds here.
    pub area_id: AreaId,
}

/// Permission to enter one place. Single use: after leaving, another is needed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GrantedPlace {
    /// The place that may be entered.
    pub place_id: PlaceId,
    /// Never used again.
    pub grant_id: u64,
    /// Permission to *enter*; a robot inside stays, whatever this says. None: it is inside already.
    pub entry: Option<Authority>,
}

/// Section `policy`: limits and rules of the areas, whole.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredPolicy {
    /// The robot that is to have it.
    pub robot_id: RobotId,
    /// max(previous + 1, unix ms).
    pub generation: u64,
    /// One entry an area.
    pub areas: Vec<AreaRules>,
}

/// Rules of one area as a robot obeys them. What no robot obeys stays in [`AreaPolicy`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaRules {
    /// Which area.
    pub area_id: AreaId,
    /// Millimetres per second; the lowest of all layers wins. None: this layer sets none.
    pub speed_limit_mm_s: Option<u32>,
    /// Millimetres kept to people and things; the largest of all layers wins. None: this layer sets none.
    pub avoidance_distance_mm: Option<u32>,
    /// Charging ends here, permille.
    pub charge_stop_permille: u16,
    /// No people walk here, as the site says: a robot bears the silence of the stop service longer.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub without_people: bool,
}

impl From<AreaPolicy> for AreaRules {
    /// Where people may walk: a policy says nothing of that.
    fn from(policy: AreaPolicy) -> Self {
        Self {
            area_id: policy.area_id,
            speed_limit_mm_s: policy.speed_limit_mm_s,
            avoidance_distance_mm: policy.avoidance_distance_mm,
            charge_stop_permille: policy.charge_stop_permille,
            without_people: false,
        }
    }
}

impl Record for DesiredPolicy {
    const TABLE: Table = Table::DesiredPolicy;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}
