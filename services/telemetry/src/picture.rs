//! What telemetry needs of the rows: desired state to push, sessions and presence to show. Built from a snapshot, kept by the feed.
//!
//! Invariant: telemetry only composes and sends desired state; it never changes or re-dates it.

use crate::Inner;
use crate::stops::SiteStops;
use midshift_core::fleet::rows::{RobotControl, SiteRow};
use midshift_core::ids::{AreaId, RobotId, StopId, WaypointId};
use midshift_core::rows::{BadRow, Seq, Table};
use midshift_core::site::{Site, text};
use midshift_core::stop::record::StopRecord;
use midshift_core::update::DesiredUpdate;
use midshift_core::work::{DesiredPolicy, DesiredWork, LaneMark, Live, PresenceRow, Session};
use midshift_store::{Change, Dirty, Error, Fold, LeftOut, LiveBoard, Projection};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::Instant;

/// Pause before a store that failed is read again.
const STORE_RETRY: Duration = Duration::from_millis(200);
/// How often it is read anew how far other gateways have kept STATUS.
const MARKS_EVERY: Duration = Duration::from_secs(5);

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
    pub status: BTreeMap<(RobotId, Arc<str>), u64>,
    desired: BTreeMap<RobotId, Sections>,
    stops: Arc<SiteStops>,
    /// The map, as fleet keeps it; none: every robot is somewhere on the site.
    site: Option<Arc<Site>>,
}

impl Rows {
    /// A label of a robot: what people said, or else what it says itself.
    pub fn label(&self, robot_id: &RobotId, key: &str) -> Option<&str> {
        RobotControl::label(self.control.get(robot_id), &self.sessions.get(robot_id)?.inventory, key)
    }
    /// The area in which a robot is by its newest heartbeat; none: not known.
    pub fn area_of(&self, live: Option<&Live>) -> Option<&AreaId> {
        live?.area(self.site.as_ref()?)
    }
    /// The area in which a waypoint lies; none: not known.
    pub fn area_at(&self, waypoint: Option<&WaypointId>) -> Option<&AreaId> {
        self.site.as_ref()?.area_at(waypoint)
    }
}

/// The picture, shared between sessions and RPCs.
#[derive(Default)]
pub struct Picture {
    rows: RwLock<Rows>,
    watchers: Mutex<BTreeMap<RobotId, watch::Sender<Sections>>>,
    stops: watch::Sender<Arc<SiteStops>>,
    ready: watch::Sender<bool>,
    /// Up to where the feed has been taken.
    absorbed: watch::Sender<Seq>,
    /// Robots that changed otherwise than by a heartbeat.
    touched: Arc<LiveBoard<()>>,
}

impl Picture {
    /// Rows as they are now.
    pub fn rows(&self) -> RwLockReadGuard<'_, Rows> {
        self.rows.read().unwrap_or_else(PoisonError::into_inner)
    }
    fn rows_mut(&self) -> RwLockWriteGuard<'_, Rows> {
        self.rows.write().unwrap_or_else(PoisonError::into_inner)
    }
    /// Notes durable STATUS.
    pub fn status_durable(&self, robot_id: &RobotId, ring: &Arc<str>, seq: u64) {
        let mut rows = self.rows_mut();
        let mark = rows.status.entry((robot_id.clone(), ring.clone())).or_default();
        *mark = (*mark).max(seq);
    }
    /// Highest durable STATUS number of a ring, 0 if none.
    pub fn durable_status(&self, robot_id: &RobotId, ring: &Arc<str>) -> u64 {
        self.rows().status.get(&(robot_id.clone(), ring.clone())).copied().unwrap_or(0)
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
    fn publish_stops(&self) {
        let newest = self.rows().stops.clone();
        self.stops.send_if_modified(|old| {
            let is_new = *old != newest;
            *old = newest;
            is_new
        });
    }
    /// Waits until the store was read once.
    pub async fn ready(&self) {
        // The sender lives as long as this picture.
        let _ = self.ready.subscribe().wait_for(|ready| *ready).await;
    }
    /// Waits until what the feed holds up to `seq` has been handed to sessions.
    pub async fn absorbed(&self, seq: Seq) {
        // The sender lives as long as this picture.
        let _ = self.absorbed.subscribe().wait_for(|absorbed| *absorbed >= seq).await;
    }
    /// Says that something other than its newest heartbeat changed about a robot.
    pub fn touch(&self, robot_id: &RobotId) {
        self.touched.put(robot_id, Arc::new(()));
    }
    /// A watcher of what changes otherwise than by heartbeats.
    pub fn touched(&self) -> Dirty<()> {
        self.touched.watch()
    }
    fn publish(&self, robot_id: &RobotId) {
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

struct Keeper {
    inner: Arc<Inner>,
    /// Rows with a word of a newer version: what they are about gets nothing new, and everything else goes on.
    left_out: LeftOut,
}

fn sections<'a>(rows: &'a mut Rows, robot_id: &RobotId) -> &'a mut Sections {
    rows.desired.entry(robot_id.clone()).or_default()
}

impl Fold for Keeper {
    fn tables() -> &'static [Table] {
        &[
            Table::DesiredWork,
            Table::DesiredPolicy,
            Table::DesiredUpdate,
            Table::Session,
            Table::RobotControl,
            Table::Presence,
            Table::LaneMark,
            Table::Site,
            Table::StopRecord,
        ]
    }
    fn reset(&mut self) {
        let mut rows = self.inner.picture.rows_mut();
        let status = std::mem::take(&mut rows.status);
        *rows = Rows { status, ..Rows::default() };
    }
    fn apply(&mut self, change: Change) -> Result<(), BadRow> {
        if change.key.table == Table::Site {
            self.inner.picture.rows_mut().site =
                self.left_out.read_change::<SiteRow>(&change)?.and_then(|row| map_of(&row));
            return Ok(());
        }
        let id = change.key.id.to_string();
        if change.key.table == Table::StopRecord {
            let Ok(stop_id) = StopId::parse(&id) else { return Ok(()) };
            let record = self.left_out.read_change::<StopRecord>(&change)?.map(Arc::new);
            put(Arc::make_mut(&mut self.inner.picture.rows_mut().stops), stop_id, record);
            return Ok(());
        }
        let Ok(robot_id) = RobotId::parse(id.split('/').next().unwrap_or_default()) else { return Ok(()) };
        let mut rows = self.inner.picture.rows_mut();
        match change.key.table {
            Table::DesiredWork => {
                sections(&mut rows, &robot_id).work = self.left_out.read_change(&change)?.map(Arc::new)
            }
            Table::DesiredPolicy => {
                sections(&mut rows, &robot_id).policy = self.left_out.read_change(&change)?.map(Arc::new)
            }
            Table::DesiredUpdate => {
                sections(&mut rows, &robot_id).update = self.left_out.read_change(&change)?.map(Arc::new)
            }
            Table::Session => put(&mut rows.sessions, robot_id.clone(), self.left_out.read_change(&change)?),
            Table::RobotControl => put(&mut rows.control, robot_id.clone(), self.left_out.read_change(&change)?),
            Table::Presence => put(&mut rows.presence, robot_id.clone(), self.left_out.read_change(&change)?),
            Table::LaneMark => put(&mut rows.marks, id, self.left_out.read_change(&change)?),
            _ => {}
        }
        drop(rows);
        match change.key.table {
            Table::DesiredWork | Table::DesiredPolicy | Table::DesiredUpdate => self.inner.picture.publish(&robot_id),
            Table::Session => {
                let newest = self.inner.picture.rows().sessions.get(&robot_id).map(|s| s.session_epoch);
                self.inner.registry.fence(&robot_id, newest.unwrap_or(0));
                self.inner.picture.touch(&robot_id);
            }
            // A label may let it into what somebody watches, or out of it.
            Table::Presence | Table::RobotControl => self.inner.picture.touch(&robot_id),
            _ => {}
        }
        Ok(())
    }
}

fn map_of(row: &SiteRow) -> Option<Arc<Site>> {
    let read = text::parse(&row.text);
    if read.is_err() {
        tracing::warn!(site_id = %row.site_id, "the map cannot be read: robots are shown to those only that see the whole site");
    }
    read.ok().map(Arc::new)
}

fn put<K: Ord, V>(map: &mut BTreeMap<K, V>, key: K, value: Option<V>) {
    match value {
        Some(value) => map.insert(key, value),
        None => map.remove(&key),
    };
}

/// Keeps the picture until the store's wakes end.
pub async fn keep(inner: &Arc<Inner>) -> Result<(), Error> {
    let mut wake = inner.parts.store.wake();
    load_status(inner).await;
    let mut read_marks = Instant::now();
    let mut projection = Projection::new(Keeper { inner: inner.clone(), left_out: LeftOut::default() });
    loop {
        wake.mark_unchanged();
        match projection.advance(inner.parts.store.as_ref()).await {
            Ok(_) => {
                inner.picture.publish_stops();
                inner.picture.absorbed.send_replace(projection.seq());
                inner.picture.ready.send_if_modified(|ready| !std::mem::replace(ready, true));
            }
            Err(error) => {
                tracing::warn!(%error, "telemetry cannot read the store, trying again");
                tokio::time::sleep(STORE_RETRY).await;
                continue;
            }
        }
        if wake.changed().await.is_err() {
            return Ok(());
        }
        // Other gateways keep STATUS too; for people only, since a session asks for its own ring when it begins.
        if inner.shared.is_some() && read_marks.elapsed() >= MARKS_EVERY {
            read_marks = Instant::now();
            load_status(inner).await;
        }
    }
}

async fn load_status(inner: &Inner) {
    match inner.parts.frames.marks().await {
        Ok(marks) => {
            let mut rows = inner.picture.rows_mut();
            for mark in marks {
                let known = rows.status.entry((mark.robot_id, mark.ring)).or_default();
                *known = mark.seq.max(*known);
            }
        }
        Err(error) => {
            tracing::warn!(%error, "status marks cannot be read: robots will send from where they think best")
        }
    }
}
