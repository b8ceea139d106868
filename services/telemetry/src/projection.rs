//! What telemetry needs of the rows: desired state to push, sessions and presence to show. Built from a snapshot, kept by the feed.
//!
//! Invariant: telemetry only composes and sends desired state; it never changes or re-dates it.

use crate::stops::SiteStops;
use midshift_core::desired_state::{DesiredPolicy, DesiredWork};
use midshift_core::fleet::rows::RobotControl;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{AreaId, RobotId, WaypointId};
use midshift_core::presence::PresenceRow;
use midshift_core::rows::Seq;
use midshift_core::session::{LaneMark, Session};
use midshift_core::site::Site;
use midshift_core::update::DesiredUpdate;
use midshift_store::{Dirty, LiveBoard};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use tokio::sync::watch;

/// Desired state of one robot, section by section.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sections {
    /// Section work.
    pub work: Option<Arc<DesiredWork>>,
    /// Section policy.
    pub policy: Option<Arc<DesiredPolicy>>,
    /// Section update.
    pub update: Option<Arc<DesiredUpdate>>,
}

/// Rows by robot.
#[derive(Debug, Default)]
pub struct Rows {
    /// Newest sessions.
    pub sessions: BTreeMap<RobotId, Session>,
    /// What people decided about robots; here for the labels that they gave.
    pub control: BTreeMap<RobotId, RobotControl>,
    /// Whether each robot is heard.
    pub presence: BTreeMap<RobotId, PresenceRow>,
    /// Durable numbers, by row id.
    pub marks: BTreeMap<String, LaneMark>,
    /// Highest durable STATUS number by (robot, ring).
    pub status: BTreeMap<(RobotId, Arc<str>), Arc<AtomicU64>>,
    pub(crate) desired: BTreeMap<RobotId, Sections>,
    pub(crate) stops: Arc<SiteStops>,
    /// The map, as fleet keeps it; none: every robot is somewhere on the site.
    pub(crate) site: Option<Arc<Site>>,
}

impl Rows {
    /// A label of a robot: what people said, or else what it says itself.
    pub fn label(&self, robot_id: &RobotId, key: &str) -> Option<&str> {
        RobotControl::label(self.control.get(robot_id), &self.sessions.get(robot_id)?.inventory, key)
    }
    /// Highest durable STATUS number of a ring, 0 if none.
    pub fn durable_status(&self, robot_id: &RobotId, ring: &Arc<str>) -> u64 {
        self.status.get(&(robot_id.clone(), ring.clone())).map_or(0, |mark| mark.load(Relaxed))
    }
    /// The area in which a robot is by its newest heartbeat; none: not known.
    pub fn area_of(&self, live: Option<&NewestHeartbeat>) -> Option<&AreaId> {
        live?.area(self.site.as_ref()?)
    }
    /// The area in which a waypoint lies; none: not known.
    pub fn area_at(&self, waypoint: Option<&WaypointId>) -> Option<&AreaId> {
        self.site.as_ref()?.area_at(waypoint)
    }
}

/// The projection, shared between sessions and RPCs.
#[derive(Default)]
pub struct LinkProjection {
    rows: RwLock<Rows>,
    watchers: Mutex<BTreeMap<RobotId, watch::Sender<Sections>>>,
    stops: watch::Sender<Arc<SiteStops>>,
    pub(crate) ready: watch::Sender<bool>,
    /// Up to where the feed has been taken.
    pub(crate) absorbed: watch::Sender<Seq>,
    /// Robots that changed otherwise than by a heartbeat.
    touched: Arc<LiveBoard<()>>,
}

impl LinkProjection {
    /// Rows as they are now.
    pub fn rows(&self) -> RwLockReadGuard<'_, Rows> {
        self.rows.read().unwrap_or_else(PoisonError::into_inner)
    }
    pub(crate) fn rows_mut(&self) -> RwLockWriteGuard<'_, Rows> {
        self.rows.write().unwrap_or_else(PoisonError::into_inner)
    }
    /// Highest durable STATUS number of a ring, 0 if none.
    pub fn durable_status(&self, robot_id: &RobotId, ring: &Arc<str>) -> u64 {
        self.rows().durable_status(robot_id, ring)
    }
    /// The same, at least `known`, as it rises while more is kept.
    pub fn status_mark(&self, robot_id: &RobotId, ring: &Arc<str>, known: u64) -> Arc<AtomicU64> {
        let mark = self.rows_mut().status.entry((robot_id.clone(), ring.clone())).or_default().clone();
        mark.fetch_max(known, Relaxed);
        mark
    }
    /// A watch on a robot's desired state, with what stands now.
    pub fn watch(&self, robot_id: &RobotId) -> watch::Receiver<Sections> {
        let mut watchers = self.watchers.lock().unwrap_or_else(PoisonError::into_inner);
        let sections = self.rows().desired.get(robot_id).cloned().unwrap_or_default();
        let sender = watchers.entry(robot_id.clone()).or_insert_with(|| watch::Sender::new(sections));
        sender.subscribe()
    }
    /// The copy of the site's stops.
    pub fn watch_stops(&self) -> watch::Receiver<Arc<SiteStops>> {
        self.stops.subscribe()
    }
    /// Hands the copy of the stops to sessions, if it has changed: never half of one that is read anew.
    pub(crate) fn publish_stops(&self) {
        let newest = self.rows().stops.clone();
        self.stops.send_if_modified(|old| {
            let is_new = *old != newest;
            *old = newest;
            is_new
        });
    }
    /// Waits until the store was read once.
    pub async fn ready(&self) {
        // The sender lives as long as this projection.
        let _ = self.ready.subscribe().wait_for(|ready| *ready).await;
    }
    /// Waits until what the feed holds up to `seq` has been handed to sessions.
    pub async fn absorbed(&self, seq: Seq) {
        // The sender lives as long as this projection.
        let _ = self.absorbed.subscribe().wait_for(|absorbed| *absorbed >= seq).await;
    }
    /// Says that something other than its newest heartbeat changed about a robot.
    pub fn touch(&self, robot_id: &RobotId) {
        self.touched.publish(robot_id, Arc::new(()));
    }
    /// A watcher of what changes otherwise than by heartbeats.
    pub fn touched(&self) -> Dirty<()> {
        self.touched.watch()
    }
    pub(crate) fn publish(&self, robot_id: &RobotId) {
        let watchers = self.watchers.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(sender) = watchers.get(robot_id) else { return };
        let sections = self.rows().desired.get(robot_id).cloned().unwrap_or_default();
        sender.send_if_modified(|old| {
            let changed = *old != sections;
            *old = sections;
            changed
        });
    }
}
