//! The one writer of the folder: the latch, then the audit, then the audit's last hash into the latch.
//!
//! Invariant: who engages or resets waits for a turn of this writer and no longer than [`limits::STOP_DURABLE_WITHIN`]; what the disk refused is tried again
//! each second and with each change. Records that wait are bounded, and those left out are counted.

use crate::audit::{Action, Audit, Note, Tail};
use crate::holder::Holder;
use crate::law::Kept;
use crate::{Inner, acts, blocking, lock};
use midshift_core::limits;
use midshift_core::time::Utc;
use midshift_latch::{Error, LatchFile};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::{Notify, watch};

/// How far the disk is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Outcome {
    /// It had its turn with this.
    tried: u64,
    /// It holds this.
    kept: u64,
    /// It refuses the audit.
    refuses_audit: bool,
    /// It holds so many of the records that were ever queued.
    recorded: u64,
}

#[derive(Default)]
struct Queue {
    notes: VecDeque<Note>,
    /// Records that were ever queued.
    queued: u64,
    dropped: u64,
    denials: Denials,
}

impl Queue {
    fn push(&mut self, note: Note) {
        self.notes.push_back(note);
        self.queued += 1;
    }
}

/// How many denials were recorded in this minute, and how many since the last of them were not.
#[derive(Default)]
struct Denials {
    minute: i64,
    recorded: u32,
    left_out: u64,
}

/// What the rest of the service knows of the disk.
#[derive(Default)]
pub struct Disk {
    queue: Mutex<Queue>,
    wake: Notify,
    outcome: watch::Sender<Outcome>,
}

impl Disk {
    /// A record to write.
    pub fn note(&self, note: Note) {
        let mut queue = lock(&self.queue);
        if queue.notes.len() < limits::STOP_AUDIT_QUEUE {
            queue.push(note);
        } else {
            queue.dropped += 1;
            metrics::counter!("midshift_stop_audit_dropped_total").increment(1);
        }
    }
    /// Queues this record, and waits until the disk holds it and all before it, but no longer than for a stop. Whether it does.
    pub async fn record(&self, note: Note) -> bool {
        self.note(note);
        let queued = lock(&self.queue).queued;
        self.wake();
        let mut outcome = self.outcome.subscribe();
        let within = Duration::from_millis(limits::STOP_DURABLE_WITHIN.as_ms());
        let turn = outcome.wait_for(|outcome| outcome.recorded >= queued);
        matches!(tokio::time::timeout(within, turn).await, Ok(Ok(_)))
    }
    /// A denial to record, if those of this minute and half of the queue leave room: stops themselves need it more. What is left out is counted in
    /// the next one.
    pub fn denied(&self, note: Note, also_left_out: u64) {
        let mut queue = lock(&self.queue);
        let has_room = queue.notes.len() < limits::STOP_AUDIT_QUEUE / 2;
        let denials = &mut queue.denials;
        denials.left_out += also_left_out;
        let minute = note.at.0.div_euclid(60_000);
        if denials.minute != minute {
            (denials.minute, denials.recorded) = (minute, 0);
        }
        if !has_room || denials.recorded >= limits::STOP_DENIALS_PER_MINUTE {
            denials.left_out += 1;
            metrics::counter!("midshift_stop_denials_left_out_total").increment(1);
            return;
        }
        denials.recorded += 1;
        let left_out = std::mem::take(&mut denials.left_out);
        queue.push(if left_out > 0 { note.with("left_out", left_out) } else { note });
        drop(queue);
        self.wake();
    }
    /// There is something to do.
    pub fn wake(&self) {
        self.wake.notify_one();
    }
    /// Waits for the disk's turn with `version`. Whether it is durable.
    pub async fn turn(&self, version: u64) -> bool {
        let mut outcome = self.outcome.subscribe();
        let within = Duration::from_millis(limits::STOP_DURABLE_WITHIN.as_ms());
        let turn = outcome.wait_for(|outcome| outcome.tried >= version);
        matches!(tokio::time::timeout(within, turn).await, Ok(Ok(outcome)) if outcome.kept >= version)
    }
    /// Whether it holds `version`.
    pub fn holds(&self, version: u64) -> bool {
        self.outcome.borrow().kept >= version
    }
    /// Whether it refuses the audit.
    pub fn refuses_audit(&self) -> bool {
        self.outcome.borrow().refuses_audit
    }
    /// What is to be written, and how many were ever queued with it.
    fn take(&self, now: Utc) -> (Vec<Note>, u64) {
        let mut queue = lock(&self.queue);
        let queued = queue.queued;
        let mut notes: Vec<Note> = queue.notes.drain(..).collect();
        let dropped = std::mem::take(&mut queue.dropped);
        if dropped > 0 {
            notes.push(Note::own(now, Action::Dropped).with("records", dropped));
        }
        (notes, queued)
    }
    fn put_back(&self, notes: Vec<Note>) {
        let mut queue = lock(&self.queue);
        for note in notes.into_iter().rev() {
            match note.fields.get("records").filter(|_| note.action == Action::Dropped) {
                Some(records) => queue.dropped += records.parse::<u64>().unwrap_or(1),
                None => queue.notes.push_front(note),
            }
        }
    }
    fn is_empty(&self) -> bool {
        let queue = lock(&self.queue);
        queue.notes.is_empty() && queue.dropped == 0
    }
}

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
    fn turn(&mut self, kept: Option<Kept>, notes: Vec<Note>, now: Utc) -> Turn {
        let latch = match &kept {
            Some(kept) => self.file.write(kept).map(|()| self.known = kept.audit.clone()),
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
pub async fn keep(inner: &Arc<Inner>, mut writer: Writer) {
    let mut refusing = Refusing::default();
    let mut forget = tokio::time::interval(Duration::from_millis(limits::RESETS_FORGOTTEN_EVERY.as_ms()));
    loop {
        // Whatever comes from now on wakes it again, or is refused.
        let (is_last, version) = {
            let _fan = lock(&inner.fan);
            (inner.shutdown.is_cancelled(), lock(&inner.law).version())
        };
        let is_due = !inner.disk.holds(version);
        let tail_is_due = writer.audit.tail() != &writer.known;
        if is_due || tail_is_due || !inner.disk.is_empty() {
            let before = refusing;
            (writer, refusing) = turn(inner, writer, version, is_due || tail_is_due).await;
            said(before, refusing);
            if refusing == Refusing::default() && !is_last {
                continue;
            }
        }
        if is_last {
            return;
        }
        let again = Duration::from_millis(limits::STOP_DISK_AGAIN.as_ms());
        tokio::select! {
            () = inner.disk.wake.notified() => {}
            () = inner.shutdown.cancelled() => {}
            _ = forget.tick() => lock(&inner.law).forget(inner.clock.now().wall),
            () = tokio::time::sleep(again), if refusing != Refusing::default() => {}
        }
    }
}

async fn turn(inner: &Arc<Inner>, mut writer: Writer, version: u64, is_due: bool) -> (Writer, Refusing) {
    let now = inner.clock.now().wall;
    let kept = is_due.then(|| lock(&inner.law).kept(writer.audit.tail().clone()));
    let (notes, queued) = inner.disk.take(now);
    let (back, turn) = blocking(move || {
        let turn = writer.turn(kept, notes, now);
        (writer, turn)
    })
    .await;
    let mut refusing = Refusing::default();
    if let Err(error) = &turn.latch {
        refusing.latch = true;
        tracing::debug!(%error, "the latch was not written");
        if matches!(error, Error::TooLarge { .. }) {
            tracing::error!("the latch does not fit its file: the older half of its resets is forgotten");
            lock(&inner.law).shorten(now);
        }
    }
    if let Err((error, notes)) = turn.audit {
        refusing.audit = true;
        tracing::debug!(%error, "the audit was not written");
        inner.disk.put_back(notes);
    }
    acts::settle(inner, version);
    inner.disk.outcome.send_modify(|outcome| {
        outcome.tried = outcome.tried.max(version);
        outcome.refuses_audit = refusing.audit;
        if !refusing.audit {
            outcome.recorded = outcome.recorded.max(queued);
        }
        if is_due && !refusing.latch {
            outcome.kept = outcome.kept.max(version);
        }
    });
    inner.touch();
    (back, refusing)
}

/// One line a change.
fn said(before: Refusing, now: Refusing) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn denials_are_recorded_as_far_as_stops_leave_room_and_counted_beyond() {
        let disk = Disk::default();
        let denied = |at_ms| disk.denied(Note::own(Utc(at_ms), Action::Denied), 0);
        let most = u64::from(limits::STOP_DENIALS_PER_MINUTE);
        (0..most + 40).for_each(|_| denied(1_000));
        assert_eq!(disk.take(Utc(1_000)).0.len() as u64, most);
        denied(61_000);
        let next = disk.take(Utc(61_000)).0;
        assert_eq!(next[0].fields.get("left_out").map(String::as_str), Some("40"));
        (0..limits::STOP_AUDIT_QUEUE / 2).for_each(|_| disk.note(Note::own(Utc(0), Action::Engaged)));
        denied(121_000);
        let notes = disk.take(Utc(121_000)).0;
        assert!(notes.iter().all(|note| note.action == Action::Engaged), "none while stops wait for the disk");
    }
}
