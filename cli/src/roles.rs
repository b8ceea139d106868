//! Which services a process has: all of them, or some, where others have the rest over the same PostgreSQL database.

use std::collections::BTreeSet;
use std::fmt;

/// One service, which is also the name of its flag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum Role {
    /// Intake of tasks, lists and watches of them.
    Task,
    /// Plans, drains, places, explanations.
    Fleet,
    /// A gateway: sessions of robots, their events and live state, and the bytes of their software.
    Telemetry,
    /// Releases and roll-outs.
    Ota,
    /// The site's authority: who is who. One process of a site.
    Identity,
    /// Beside a stop service, on the same data folder: copies its stops into the store, and tells it who is known and who the robots are. Of several on one
    /// folder one does, and the others wait for its end.
    StopFollower,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Task, Self::Fleet, Self::Telemetry, Self::Ota, Self::Identity, Self::StopFollower];

    /// gRPC services of this role, as health names them.
    pub const fn services(self) -> &'static [&'static str] {
        match self {
            Self::Task => &["midshift.task.v1.TaskService", "midshift.identity.v1.AuditService"],
            Self::Fleet => &["midshift.fleet.v1.FleetService"],
            Self::Telemetry => &[
                "midshift.telemetry.v1.TelemetryService",
                "midshift.link.v1.LinkService",
                "midshift.link.v1.ReplayService",
                "midshift.ota.v1.ChunkService",
            ],
            Self::Ota => {
                &["midshift.ota.v1.BundleService", "midshift.ota.v1.ChunkService", "midshift.ota.v1.RolloutService"]
            }
            Self::Identity => &["midshift.identity.v1.IdentityService", "midshift.identity.v1.EnrolmentService"],
            Self::StopFollower => &[],
        }
    }
    /// As it is written behind --roles.
    const fn name(self) -> &'static str {
        match self {
            Self::Task => "task",
            Self::Fleet => "fleet",
            Self::Telemetry => "telemetry",
            Self::Ota => "ota",
            Self::Identity => "identity",
            Self::StopFollower => "stop-follower",
        }
    }
}

/// The roles of one process, at least one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Roles(BTreeSet<Role>);

impl Default for Roles {
    fn default() -> Self {
        Self(Role::ALL.into())
    }
}

impl Roles {
    /// These; all if none is named.
    pub fn from_names(named: &[Role]) -> Self {
        if named.is_empty() { Self::default() } else { Self(named.iter().copied().collect()) }
    }
    /// Whether this process has it.
    pub fn has(&self, role: Role) -> bool {
        self.0.contains(&role)
    }
    /// Whether other processes are needed for the rest.
    pub fn are_split(&self) -> bool {
        self.0.len() < Role::ALL.len()
    }
    /// Names under which health knows this process; the empty one is the whole.
    pub fn services(&self) -> BTreeSet<&'static str> {
        self.0.iter().flat_map(|role| role.services()).copied().chain([""]).collect()
    }
}

impl fmt::Display for Roles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> = self.0.iter().map(|role| role.name()).collect();
        f.write_str(&names.join(","))
    }
}

#[cfg(test)]
mod tests {
    use super::{Role, Roles};
    use clap::ValueEnum;

    #[test]
    fn roles_are_shown_as_they_are_written() {
        for role in Role::ALL {
            assert_eq!(role.to_possible_value().map(|value| value.get_name().to_owned()).as_deref(), Some(role.name()));
        }
        assert!(Roles::from_names(&[Role::StopFollower]).are_split() && !Roles::default().are_split());
    }
}
