//! What the service is built from, and what its face asks of the reconciler.

use midshift_core::fleet::Board;
use midshift_core::fleet::commands::Command;
use midshift_core::fleet::maps::MapChange;
use midshift_core::fleet::projection::FleetProjection;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::identity::Caller;
use midshift_core::reason::{Reason, Refusal};
use midshift_core::rows::Revision;
use midshift_core::site::Site;
use midshift_core::time::{Clock, Now};
use midshift_store::{LiveBoard, Store};
use std::fmt;
use std::sync::Arc;
use tokio::sync::oneshot;

/// What the service is built from.
pub struct Parts {
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// Newest heartbeats, written by telemetry.
    pub board: Arc<LiveBoard<NewestHeartbeat>>,
    /// The site.
    pub site: Arc<Site>,
    /// Its text, kept in the store.
    pub site_text: String,
    /// What became of the map that this process was started with.
    pub map: MapChange,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: midshift_core::fleet::bugs::Bugs,
}

/// The reconciler began to lead, and the map that its process chose at its start is none to plan on any more: another one was stored since,
/// or something came in its way. The process chooses anew when it is started again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MapOutdated(pub Reason);

impl fmt::Display for MapOutdated {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the map that was chosen at the start is outdated, start again: {} {:?}",
            self.0.code, self.0.metadata
        )
    }
}

impl std::error::Error for MapOutdated {}

/// A question about the projection as it is now.
pub(crate) type Look = Box<dyn FnOnce(&FleetProjection, &Board, &Now) + Send>;

/// Something a person asks of the reconciler.
pub(crate) enum Request {
    /// Change something; answered after the commit.
    Do(Box<PendingCommand>),
    /// Look at something.
    Look(Look),
}

/// A command, until it is answered.
pub(crate) struct PendingCommand {
    pub command: Command,
    pub seen: Option<Revision>,
    pub validate_only: bool,
    pub by: Caller,
    pub request_id: Option<String>,
    pub reply: oneshot::Sender<Result<(), Refusal>>,
    /// How often it was decided and lost, because what it is about had been changed meanwhile.
    pub lost: u32,
}
