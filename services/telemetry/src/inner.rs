//! What the service is built from, and what sessions, RPCs and the tasks beside them share.

use crate::beacons::BeaconListener;
use crate::bugs::Bugs;
use crate::event_rate::EventRates;
use crate::hellos::Hellos;
use crate::misreads::Misreads;
use crate::projection::LinkProjection;
use crate::registry::Registry;
use crate::shared_heartbeats::Shared;
use crate::status_writer::StatusWriter;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::time::Clock;
use midshift_store::{FrameLog, HeartbeatLog, LiveBoard, Store};
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

/// What the service is built from.
pub struct Parts {
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// Where STATUS is kept.
    pub frames: Arc<dyn FrameLog>,
    /// Newest heartbeats, read by fleet.
    pub board: Arc<LiveBoard<NewestHeartbeat>>,
    /// Where other processes read them, if any may open the store too.
    pub heard: Option<Arc<dyn HeartbeatLog>>,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
}

/// What its parts share.
pub(crate) struct Inner {
    pub parts: Parts,
    pub projection: LinkProjection,
    pub registry: Registry,
    pub event_rates: EventRates,
    /// Robots that are refused because of what they say.
    pub misreads: Misreads,
    pub beacons: BeaconListener,
    pub shared: Option<Shared>,
    pub status_writer: StatusWriter,
    /// Room for robots that say hello.
    pub hellos: Hellos,
    /// Robots are asked to go to another gateway, and no new one is taken.
    pub moving: CancellationToken,
    pub shutdown: CancellationToken,
}
