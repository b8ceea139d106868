//! The one writer of the folder: the latch, then the audit, then the audit's last hash into the latch.
//!
//! Invariant: what the disk refused is tried again each second and with each change; who waits for it hears after each turn how far it is.

use crate::audit::{Audit, Note, Tail};
use crate::changes;
use crate::engaged::SavedState;
use crate::holder::Holder;
use crate::inner::Inner;
use crate::threads::{blocking, lock};
use midshift_core::limits;
use midshift_core::time::Utc;
use midshift_latch::{Error, LatchFile};
use std::sync::Arc;
use std::time::Duration;

/// The files.
pub struct Writer {
    /// Says which process has the folder; let go of before the latch.
    pub _holder: Holder,
    /// The latch.
    pub file: LatchFile,
    /// The audit.
    pub audit: Audit,
    /// The last record that the latch file knows of.
    pub known: Tail,
}

/// What became of one turn.
struct Turn {
    latch: Result<(), Error>,
    audit: Result<(), (std::io::Error, Vec<Note>)>,
}

impl Writer {
    fn turn(&mut self, saved: Option<SavedState>, notes: Vec<Note>, now: Utc) -> Turn {
        let latch = match &saved {
            Some(saved) => self.file.write(saved).map(|()| self.known = saved.audit.clone()),
            None => Ok(()),
        };
        let audit = match notes.is_empty() {
            true => Ok(()),
            false => self.audit.append(&notes, now).map_err(|error| (error, notes)),
        };
        Turn { latch, audit }
    }
}

/// Which files refuse.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Refusing {
    latch: bool,
    audit: bool,
}

/// Writes until shutdown, and once more then; what was reset long ago goes at the start and each hour.
pub async fn write_until_end(inner: &Arc<Inner>, mut writer: Writer) {
    let mut refusing = Refusing::default();
    let mut forget = tokio::time::interval(Duration::from_millis(limits::RESETS_FORGOTTEN_EVERY.as_ms()));
    loop {
        // Whatever comes from now on wakes it again, or is refused.
        let (is_last, version) = {
            let _fan = lock(&inner.fan);
            (inner.shutdown.is_cancelled(), lock(&inner.engaged_stops).version())
        };
        let is_due = !inner.disk.holds(version);
        let tail_is_due = writer.audit.tail() != &writer.known;
        if is_due || tail_is_due || !inner.disk.is_empty() {
            let before = refusing;
            (writer, refusing) = turn(inner, writer, version, is_due || tail_is_due).await;
            log_refusing(before, refusing);
            if refusing == Refusing::default() && !is_last {
                continue;
            }
        }
        if is_last {
            return;
        }
        let again = Duration::from_millis(limits::STOP_DISK_AGAIN.as_ms());
        tokio::select! {
            () = inner.disk.woken() => {}
            () = inner.shutdown.cancelled() => {}
            _ = forget.tick() => lock(&inner.engaged_stops).forget(inner.clock.now().wall),
            () = tokio::time::sleep(again), if refusing != Refusing::default() => {}
        }
    }
}

async fn turn(inner: &Arc<Inner>, mut writer: Writer, version: u64, is_due: bool) -> (Writer, Refusing) {
    let now = inner.clock.now().wall;
    let saved = is_due.then(|| lock(&inner.engaged_stops).state_to_save(writer.audit.tail().clone()));
    let (notes, queued) = inner.disk.take_notes(now);
    let (back, turn) = blocking(move || {
        let turn = writer.turn(saved, notes, now);
        (writer, turn)
    })
    .await;
    let mut refusing = Refusing::default();
    if let Err(error) = &turn.latch {
        refusing.latch = true;
        tracing::debug!(%error, "the latch was not written");
        if matches!(error, Error::TooLarge { .. }) {
            tracing::error!("the latch does not fit its file: the older half of its resets is forgotten");
            lock(&inner.engaged_stops).shorten(now);
        }
    }
    if let Err((error, notes)) = turn.audit {
        refusing.audit = true;
        tracing::debug!(%error, "the audit was not written");
        inner.disk.put_back(notes);
    }
    changes::settle(inner, version);
    inner.disk.end_turn(version, is_due && !refusing.latch, (!refusing.audit).then_some(queued));
    inner.touch();
    (back, refusing)
}

/// One line a change.
fn log_refusing(before: Refusing, now: Refusing) {
    metrics::gauge!("midshift_stop_latch_durable").set(f64::from(u8::from(!now.latch)));
    metrics::gauge!("midshift_stop_audit_durable").set(f64::from(u8::from(!now.audit)));
    for (file, before, now) in [("latch", before.latch, now.latch), ("audit", before.audit, now.audit)] {
        match (before, now) {
            (false, true) => tracing::error!(
                file,
                "the disk refuses a file of the stop service; it goes on in memory and tries again"
            ),
            (true, false) => tracing::warn!(file, "the disk takes a file of the stop service again"),
            _ => {}
        }
    }
}
