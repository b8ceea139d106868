//! Identifiers as types, parsed once on receipt. Called by every crate; nothing here allocates ids at random by itself.
//!
//! Short ones lie in their place, so that a map by identifiers is searched without a look elsewhere for each.

use serde::{Deserialize, Serialize};
use smol_str::SmolStr;
use std::fmt;

/// An identifier that broke its rule.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{kind} {rule}")]
pub struct Error {
    kind: &'static str,
    rule: &'static str,
}

macro_rules! text_id {
    ($(#[$doc:meta])* $name:ident, $kind:literal, $max:literal, $allowed:expr, $rule:literal) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(SmolStr);

        impl $name {
            /// Parses and checks one identifier; the error says the whole rule.
            pub fn parse(text: &str) -> Result<Self, Error> {
                let allowed: fn(char) -> bool = $allowed;
                if text.is_empty() || text.len() > $max || !text.chars().all(allowed) {
                    return Err(Error { kind: $kind, rule: $rule });
                }
                Ok(Self(SmolStr::new(text)))
            }
            /// The identifier as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }
        impl TryFrom<String> for $name {
            type Error = Error;
            fn try_from(text: String) -> Result<Self, Error> {
                Self::parse(&text)
            }
        }
        impl From<$name> for String {
            fn from(id: $name) -> Self {
                id.0.to_string()
            }
        }
        impl std::str::FromStr for $name {
            type Err = Error;
            fn from_str(text: &str) -> Result<Self, Error> {
                Self::parse(text)
            }
        }
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }
        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }
    };
}

fn lower(c: char) -> bool {
    c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-'
}
fn mixed(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.')
}

text_id!(/// A task, `TASK-YYYYMMDD-` and 10 base-32 characters unless the client chose one.
    TaskId, "task_id", 64, mixed, "must be 1-64 of [A-Za-z0-9-_.]");
text_id!(/// A robot.
    RobotId, "robot_id", 64, lower, "must be 1-64 of [a-z0-9-]");
text_id!(/// A site: one factory, warehouse or shop.
    SiteId, "site_id", 64, lower, "must be 1-64 of [a-z0-9-]");
text_id!(/// An area of a site, the unit of policy.
    AreaId, "area_id", 64, mixed, "must be 1-64 of [A-Za-z0-9-_.]");
text_id!(/// A waypoint of a site.
    WaypointId, "waypoint", 64, mixed, "must be 1-64 of [A-Za-z0-9-_.]");
text_id!(/// A passage or a standing place of a site.
    PlaceId, "place_id", 64, mixed, "must be 1-64 of [A-Za-z0-9-_.]");
text_id!(/// A drain: one taking of a robot out of work, `op:` before it if a person asked for it. Never used again.
    DrainId, "drain_id", 64, |c| lower(c) || matches!(c, ':' | '.'), "must be 1-64 of [a-z0-9-:.]");
text_id!(/// A roll-out, chosen by whoever creates it. Never used again.
    RolloutId, "rollout_id", 64, |c| lower(c) || c == '.', "must be 1-64 of [a-z0-9-.]");
text_id!(/// A set of software by its digest, or `factory`.
    SetId, "set", 64, |c| c.is_ascii_lowercase() || c.is_ascii_digit(), "must be 1-64 of [a-z0-9]");
text_id!(/// A bundle by the digest of its manifest.
    BundleId, "bundle", 64, |c| matches!(c, '0'..='9' | 'a'..='f'), "must be 64 lower-case hexadecimal digits");
text_id!(/// A fleet stop, `STOP-YYYYMMDD-` and 10 base-32 characters (`STOP-LOST-` before the day: the stop service's own), or a robot's own name for a silence that stood it. Never used again.
    StopId, "stop_id", 128, mixed, "must be 1-128 of [A-Za-z0-9-_.]");
text_id!(/// A client's protection against a double call.
    RequestId, "request_id", 128, |c| c.is_ascii_graphic(), "must be 1-128 printable characters without spaces");

/// What an attempt is about: a task, or an errand (charge, park) that fleet itself asked for.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, Debug)]
#[serde(rename_all = "snake_case")]
pub enum Subject {
    /// A task by its id.
    Task(TaskId),
    /// An errand of one robot; `number` rises and is never used again.
    Errand {
        /// The robot that runs it.
        robot_id: RobotId,
        /// Rises by one per errand of that robot.
        number: u64,
    },
}

impl Subject {
    /// The task, if it is one.
    pub fn task_id(&self) -> Option<&TaskId> {
        match self {
            Self::Task(id) => Some(id),
            Self::Errand { .. } => None,
        }
    }
    /// Reads the text form back.
    pub fn parse(text: &str) -> Result<Self, Error> {
        if let Some(rest) = text.strip_prefix("errand:") {
            let bad = Error { kind: "subject", rule: "must be a task_id or errand:<robot_id>:<number>" };
            let (robot, number) = rest.rsplit_once(':').ok_or(bad.clone())?;
            return Ok(Self::Errand { robot_id: RobotId::parse(robot)?, number: number.parse().map_err(|_| bad)? });
        }
        Ok(Self::Task(TaskId::parse(text)?))
    }
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Task(id) => f.write_str(id.as_str()),
            Self::Errand { robot_id, number } => write!(f, "errand:{robot_id}:{number}"),
        }
    }
}

/// One grant of a subject to one robot. Epochs of a task rise strictly; an errand has the single epoch 1.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, Debug)]
pub struct AttemptId {
    /// What is to be done.
    pub subject: Subject,
    /// The fence.
    pub epoch: u64,
}

impl fmt::Display for AttemptId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.subject, self.epoch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_subject_reads_back_from_its_text() {
        for text in ["TASK-20260601-ABCDEFGHJK", "errand:rbt-01:17"] {
            assert_eq!(Subject::parse(text).map(|s| s.to_string()).as_deref(), Ok(text));
        }
        assert!(Subject::parse("errand:rbt-01:x").is_err());
    }

    #[test]
    fn an_id_over_its_rule_is_refused_also_by_serde() {
        assert!(RobotId::parse("Rbt").is_err());
        assert!(serde_json::from_str::<RobotId>("\"\"").is_err());
    }
}
