//! What people ask of fleet directly, as it is kept with its request_id. What comes of it is in `commands`.

use crate::idempotency::IdempotentRequest;
use crate::ids::{AttemptId, PlaceId, RobotId};
use crate::planner_policy::PlannerPolicy;
use crate::policy::AreaPolicy;
use crate::rows::Table;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// One request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// No new work; what it does now, it finishes.
    Cordon {
        /// The robot that gets no new work.
        robot_id: RobotId,
        /// Why, in a person's words.
        reason: String,
    },
    /// Back to work; also resets the breaker.
    Uncordon {
        /// The robot that works again.
        robot_id: RobotId,
    },
    /// Out of the fleet: no work, and no roll-out or drain waits for it. Uncordon brings it back.
    Retire {
        /// The robot that leaves the fleet.
        robot_id: RobotId,
        /// Why, in a person's words.
        reason: String,
    },
    /// Ignores an attempt that the robot lists and no row knows. Frees no place and no load.
    Disown {
        /// The robot that lists the attempt.
        robot_id: RobotId,
        /// The attempt that is ignored from then on.
        attempt: AttemptId,
        /// What the person saw.
        reason: String,
    },
    /// A person's word that the robot carries nothing: holds until the robot says something newer.
    SettleLoad {
        /// The robot that carries nothing.
        robot_id: RobotId,
        /// What the person saw.
        reason: String,
    },
    /// Labels that go before what the robot says itself.
    Label {
        /// The robot that has them.
        robot_id: RobotId,
        /// Labels that it gets.
        labels: BTreeMap<String, String>,
        /// Keys whose labels by people go: the robot's own word counts again.
        removed: BTreeSet<String>,
    },
    /// Out of work for maintenance: what it does ends or waits, then it parks.
    Drain {
        /// The robot that is taken out of work.
        robot_id: RobotId,
        /// What for.
        reason: String,
        /// Milliseconds of site time until it is given up.
        within_ms: u64,
    },
    /// Ends the drains that people asked for.
    Undrain {
        /// The robot whose drains end.
        robot_id: RobotId,
    },
    /// New rules of an area, pushed to every robot.
    PutPolicy(AreaPolicy),
    /// New rules of the site's planner, from its next turn on.
    PutPlanner(PlannerPolicy),
    /// A person has looked: nobody and nothing is inside.
    ClearPlace {
        /// The place that is empty.
        place_id: PlaceId,
        /// What the person saw.
        reason: String,
    },
    /// Nobody is let into a place for a while.
    BlockPlace {
        /// The place into which nobody is let.
        place_id: PlaceId,
        /// Why, in a person's words.
        reason: String,
        /// Milliseconds of site time until that ends by itself; none: a person ends it.
        lasts_ms: Option<u64>,
    },
    /// Ends the block of a place.
    UnblockPlace {
        /// The place that is open again.
        place_id: PlaceId,
        /// Why, in a person's words.
        reason: String,
    },
    /// A person has looked into it.
    CloseIncident {
        /// The incident that is closed.
        incident_id: String,
        /// What was found.
        reason: String,
    },
}

impl IdempotentRequest for Command {
    const KEYS: Table = Table::CommandKey;
}
