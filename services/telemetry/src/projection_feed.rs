//! Reads rows into the projection, and goes on with the feed.

use crate::inner::Inner;
use crate::projection::{Rows, Sections};
use midshift_core::fleet::rows::SiteRow;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::rows::{BadRow, Table};
use midshift_core::site::{Site, text};
use midshift_core::stop::record::StopRecord;
use midshift_store::{Change, Error, Fold, Projection, SkippedRows};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;
use tokio::time::Instant;

/// Pause before a store that failed is read again.
const STORE_RETRY: Duration = Duration::from_millis(200);
/// How often it is read anew how far other gateways have kept STATUS.
const MARKS_EVERY: Duration = Duration::from_secs(5);

struct RowReader {
    inner: Arc<Inner>,
    /// Rows with a word of a newer version: what they are about gets nothing new, and everything else goes on.
    skipped: SkippedRows,
}

fn sections<'a>(rows: &'a mut Rows, robot_id: &RobotId) -> &'a mut Sections {
    rows.desired.entry(robot_id.clone()).or_default()
}

impl Fold for RowReader {
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
        let mut rows = self.inner.projection.rows_mut();
        let status = std::mem::take(&mut rows.status);
        *rows = Rows { status, ..Rows::default() };
    }
    fn apply(&mut self, change: Change) -> Result<(), BadRow> {
        if change.key.table == Table::Site {
            self.inner.projection.rows_mut().site =
                self.skipped.read_change::<SiteRow>(&change)?.and_then(|row| map_of(&row));
            return Ok(());
        }
        let id = change.key.id.to_string();
        if change.key.table == Table::StopRecord {
            let Ok(stop_id) = StopId::parse(&id) else { return Ok(()) };
            let record = self.skipped.read_change::<StopRecord>(&change)?.map(Arc::new);
            set_or_remove(Arc::make_mut(&mut self.inner.projection.rows_mut().stops), stop_id, record);
            return Ok(());
        }
        let Ok(robot_id) = RobotId::parse(id.split('/').next().unwrap_or_default()) else { return Ok(()) };
        let mut rows = self.inner.projection.rows_mut();
        match change.key.table {
            Table::DesiredWork => {
                sections(&mut rows, &robot_id).work = self.skipped.read_change(&change)?.map(Arc::new)
            }
            Table::DesiredPolicy => {
                sections(&mut rows, &robot_id).policy = self.skipped.read_change(&change)?.map(Arc::new)
            }
            Table::DesiredUpdate => {
                sections(&mut rows, &robot_id).update = self.skipped.read_change(&change)?.map(Arc::new)
            }
            Table::Session => set_or_remove(&mut rows.sessions, robot_id.clone(), self.skipped.read_change(&change)?),
            Table::RobotControl => {
                set_or_remove(&mut rows.control, robot_id.clone(), self.skipped.read_change(&change)?)
            }
            Table::Presence => set_or_remove(&mut rows.presence, robot_id.clone(), self.skipped.read_change(&change)?),
            Table::LaneMark => set_or_remove(&mut rows.marks, id, self.skipped.read_change(&change)?),
            _ => {}
        }
        drop(rows);
        match change.key.table {
            Table::DesiredWork | Table::DesiredPolicy | Table::DesiredUpdate => {
                self.inner.projection.publish(&robot_id)
            }
            Table::Session => {
                let newest = self.inner.projection.rows().sessions.get(&robot_id).map(|s| s.session_epoch);
                self.inner.registry.fence(&robot_id, newest.unwrap_or(0));
                self.inner.projection.touch(&robot_id);
            }
            // A label may let it into what somebody watches, or out of it.
            Table::Presence | Table::RobotControl => self.inner.projection.touch(&robot_id),
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

fn set_or_remove<K: Ord, V>(map: &mut BTreeMap<K, V>, key: K, value: Option<V>) {
    match value {
        Some(value) => map.insert(key, value),
        None => map.remove(&key),
    };
}

/// Keeps the projection until the store's wakes end.
pub async fn follow_rows(inner: &Arc<Inner>) -> Result<(), Error> {
    let mut wake = inner.parts.store.wake();
    load_status(inner).await;
    let mut read_marks = Instant::now();
    let mut projection = Projection::new(RowReader { inner: inner.clone(), skipped: SkippedRows::default() });
    loop {
        wake.mark_unchanged();
        match projection.advance(inner.parts.store.as_ref()).await {
            Ok(_) => {
                inner.projection.publish_stops();
                inner.projection.absorbed.send_replace(projection.seq());
                inner.projection.ready.send_if_modified(|ready| !std::mem::replace(ready, true));
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
            let mut rows = inner.projection.rows_mut();
            for mark in marks {
                rows.status.entry((mark.robot_id, mark.ring)).or_default().fetch_max(mark.seq, Relaxed);
            }
        }
        Err(error) => {
            tracing::warn!(%error, "status marks cannot be read: robots will send from where they think best")
        }
    }
}
