//! What the rest of the service knows of its disk: what waits for it, and how far it is.
//!
//! Invariant: who engages or resets waits for a turn of the disk and no longer than [`limits::STOP_DURABLE_WITHIN`]. Records that wait are bounded, and those
//! left out are counted.

use crate::audit::{Action, Note};
use crate::threads::lock;
use midshift_core::limits;
use midshift_core::time::Utc;
use std::collections::VecDeque;
use std::sync::Mutex;
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
    /// Waits until there is.
    pub fn woken(&self) -> impl Future<Output = ()> {
        self.wake.notified()
    }
    /// It had its turn with `version`, and holds it if `is_kept`; `recorded`: it holds so many of the records that were ever queued. None: it refuses the audit.
    pub fn end_turn(&self, version: u64, is_kept: bool, recorded: Option<u64>) {
        self.outcome.send_modify(|outcome| {
            outcome.tried = outcome.tried.max(version);
            outcome.refuses_audit = recorded.is_none();
            outcome.recorded = outcome.recorded.max(recorded.unwrap_or_default());
            if is_kept {
                outcome.kept = outcome.kept.max(version);
            }
        });
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
    pub fn take_notes(&self, now: Utc) -> (Vec<Note>, u64) {
        let mut queue = lock(&self.queue);
        let queued = queue.queued;
        let mut notes: Vec<Note> = queue.notes.drain(..).collect();
        let dropped = std::mem::take(&mut queue.dropped);
        if dropped > 0 {
            notes.push(Note::own(now, Action::Dropped).with("records", dropped));
        }
        (notes, queued)
    }
    /// What was not written is to be written still, before all else.
    pub fn put_back(&self, notes: Vec<Note>) {
        let mut queue = lock(&self.queue);
        for note in notes.into_iter().rev() {
            match note.fields.get("records").filter(|_| note.action == Action::Dropped) {
                Some(records) => queue.dropped += records.parse::<u64>().unwrap_or(1),
                None => queue.notes.push_front(note),
            }
        }
    }
    /// No record waits.
    pub fn is_empty(&self) -> bool {
        let queue = lock(&self.queue);
        queue.notes.is_empty() && queue.dropped == 0
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
        assert_eq!(disk.take_notes(Utc(1_000)).0.len() as u64, most);
        denied(61_000);
        let next = disk.take_notes(Utc(61_000)).0;
        assert_eq!(next[0].fields.get("left_out").map(String::as_str), Some("40"));
        (0..limits::STOP_AUDIT_QUEUE / 2).for_each(|_| disk.note(Note::own(Utc(0), Action::Engaged)));
        denied(121_000);
        let notes = disk.take_notes(Utc(121_000)).0;
        assert!(notes.iter().all(|note| note.action == Action::Engaged), "none while stops wait for the disk");
    }
}
