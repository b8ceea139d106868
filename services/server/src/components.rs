//! What a server is built from.

use crate::keep_limits::KeepLimits;
use midshift_cli::roles::Roles;
use midshift_core::fleet::maps::MapChange;
use midshift_core::site::Site;
use midshift_core::time::{Clock, Utc};
use midshift_identity::IdentityService;
use midshift_ota::{OtaReader, OtaService};
use midshift_sim::service::SimFace;
use midshift_store::{FrameLog, HeartbeatLog, Store};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Naive rules of the services, for twins of tests. None by default.
#[derive(Clone, Copy, Debug, Default)]
pub struct NaiveRules {
    /// Of the link.
    pub telemetry: midshift_telemetry::Bugs,
    /// Of fleet.
    pub fleet: midshift_core::fleet::bugs::Bugs,
    /// Of the intake.
    pub task: midshift_core::task::bugs::Bugs,
    /// Of roll-outs.
    pub rollouts: midshift_core::rollout::bugs::Bugs,
}

impl NaiveRules {
    /// Whether any naive rule of a service is compiled in. Without a test none can be switched on.
    pub const ARE_BUILT_IN: bool =
        midshift_core::task::bugs::Bugs::ARE_BUILT_IN || midshift_telemetry::Bugs::ARE_BUILT_IN;
}

/// What a server is built from.
pub struct Components {
    /// Which services it has.
    pub roles: Roles,
    /// How long robots have to move to another gateway before this one ends; zero: there is no other.
    pub drain: Duration,
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// Where STATUS is kept.
    pub frames: Arc<dyn FrameLog>,
    /// Where several processes share newest heartbeats, if the store is one for several.
    pub heard: Option<Arc<dyn HeartbeatLog>>,
    /// The site.
    pub site: Arc<Site>,
    /// Its text.
    pub site_text: String,
    /// What became of the map that this process was started with.
    pub map: MapChange,
    /// How much of samples and logs is kept.
    pub keep: KeepLimits,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// What the wall jumped at last before this run, milliseconds ahead, and UTC when it had.
    pub jumped_before: Option<(i64, Utc)>,
    /// Software of robots, of a process with role ota.
    pub ota: OtaService,
    /// Software of robots, of a gateway beside such processes.
    pub reader: Option<OtaReader>,
    /// The simulator's face, if bodies live in this process.
    pub sim: Option<SimFace>,
    /// Naive rules for twins of tests; none outside them.
    pub naive: NaiveRules,
    /// Where the stop service beside this process keeps its files, if there is one.
    pub stops: Option<PathBuf>,
    /// The port of the stop service, if it is on this host.
    pub stop_port: Option<u16>,
    /// Who is who, with TLS; none: no login, plain text.
    pub identity: Option<IdentityService>,
    /// Limits of the port.
    pub port: midshift_edge::Config,
    /// Where fleet plans; see [`crate::planning`].
    pub planning: tokio::runtime::Handle,
}
