//! Whom a stop is for.

use crate::ids::{AreaId, PlaceId, RobotId};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Whom a stop is for. Ordered from narrow to wide.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// One robot, wherever it is.
    Robot(RobotId),
    /// Every robot in or near one passage or standing place.
    Zone(PlaceId),
    /// Every robot in or near one area.
    Area(AreaId),
    /// Every robot of the site.
    Fleet,
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Robot(id) => write!(f, "robot {id}"),
            Self::Zone(id) => write!(f, "zone {id}"),
            Self::Area(id) => write!(f, "area {id}"),
            Self::Fleet => f.write_str("fleet"),
        }
    }
}
