//! STATUS of all sessions on its way to the frame log: gathered for a while, so that one commit keeps the samples of many robots.
//!
//! Invariant: a write is called kept only after the commit that holds it; gaps come before frames, which move the mark that says what need not come
//! again. One process writes each sample that it kept once, also if a session brings again what the one before it had handed over. A write waits for
//! others for [`LINGER`] once the one before it is done, and not at all for who cannot wait. What the log refuses takes no other write with it.

use crate::status::Write;
use midshift_core::limits;
use midshift_store::{Error, FrameLog};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{Notify, oneshot};
use tokio::time::{Instant, sleep, sleep_until};

/// How long a write waits for others: an acknowledgement of STATUS may take two seconds.
const LINGER: Duration = Duration::from_millis(500);
/// With so many, what sessions that are over have left is let go: their robots bring it again.
const WAITING_BYTES_MAX: usize = 64 * 1024 * 1024;
/// After a failed write, robots are asked again not sooner than this.
const RETRY: Duration = Duration::from_millis(200);

/// One write, how far its ring has come once it is kept, and who hears whether it is.
struct Queued {
    write: Write,
    mark: Arc<AtomicU64>,
    done: oneshot::Sender<bool>,
}

impl Queued {
    fn answer(self, is_kept: bool) {
        if is_kept {
            // Nothing of what was left out is beyond the mark.
            self.mark.fetch_max(self.write.last_seq(), Relaxed);
        }
        // The session may be over; its mark is for the next one.
        let _ = self.done.send(is_kept);
    }
}

#[derive(Default)]
struct Waiting {
    queued: Vec<Queued>,
    bytes: usize,
    /// With so many bytes it is looked for what may be let go; twice what stayed, so that it is not looked for each time.
    is_full_at: usize,
    /// Somebody cannot wait for more.
    is_hurried: bool,
}

impl Waiting {
    fn is_due(&self) -> bool {
        self.is_hurried || self.bytes >= limits::GROUP_COMMIT_BYTES
    }
    /// Lets go what sessions that are over have left, once there is much.
    fn limit(&mut self) {
        if self.bytes <= self.is_full_at.max(WAITING_BYTES_MAX) {
            return;
        }
        self.queued.retain(|queued| !queued.done.is_closed());
        self.bytes = self.queued.iter().map(|queued| queued.write.bytes()).sum();
        self.is_full_at = 2 * self.bytes;
    }
    /// What is written next; the rest is due if it is as much again or somebody is in a hurry.
    fn take_group(&mut self) -> Vec<Queued> {
        let mut bytes = 0;
        let fits = |queued: &&Queued| {
            let is_first = bytes == 0;
            bytes += queued.write.bytes();
            is_first || bytes <= limits::GROUP_COMMIT_BYTES
        };
        let many = self.queued.iter().take_while(fits).count();
        let group: Vec<Queued> = self.queued.drain(..many).collect();
        self.bytes -= group.iter().map(|queued| queued.write.bytes()).sum::<usize>();
        self.is_hurried &= !self.queued.is_empty();
        group
    }
}

/// The way of STATUS to the frame log.
#[derive(Default)]
pub struct StatusWriter {
    waiting: Mutex<Waiting>,
    news: Notify,
}

impl StatusWriter {
    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Takes a write; `mark` rises to its last number once it is kept. The answer: whether it is.
    pub fn queue(&self, write: Write, mark: Arc<AtomicU64>) -> oneshot::Receiver<bool> {
        let (done, answer) = oneshot::channel();
        let mut waiting = self.waiting();
        let is_first = waiting.queued.is_empty();
        waiting.bytes += write.bytes();
        waiting.queued.push(Queued { write, mark, done });
        waiting.limit();
        if is_first || waiting.is_due() {
            self.news.notify_one();
        }
        answer
    }
    /// Ends the gathering: somebody waits.
    pub fn hurry(&self) {
        let mut waiting = self.waiting();
        if !waiting.queued.is_empty() {
            waiting.is_hurried = true;
            self.news.notify_one();
        }
    }
    /// Writes until it is dropped.
    pub async fn write_groups(&self, log: &dyn FrameLog) {
        loop {
            self.news.notified().await;
            while !self.waiting().queued.is_empty() {
                self.until_due(Instant::now() + LINGER).await;
                let group = self.waiting().take_group();
                // Each was told how it went.
                let _ = write_group(log, group).await;
            }
        }
    }
    /// Writes what waits at this moment, at the end of all, unless the log fails.
    pub async fn finish(&self, log: &dyn FrameLog) {
        let mut left = self.waiting().queued.len();
        while left > 0 {
            let group = self.waiting().take_group();
            left = left.saturating_sub(group.len().max(1));
            if write_group(log, group).await.is_err() {
                return;
            }
        }
    }
    async fn until_due(&self, due_at: Instant) {
        while !self.waiting().is_due() {
            tokio::select! {
                () = sleep_until(due_at) => return,
                () = self.news.notified() => {}
            }
        }
    }
}

/// Writes a group, and says so to each.
async fn write_group(log: &dyn FrameLog, mut group: Vec<Queued>) -> Result<(), Error> {
    leave_out_known(&mut group);
    let kept = write(log, &group).await;
    if let Err(error @ Error::BadFrame(_)) = &kept
        && group.len() > 1
    {
        tracing::warn!(%error, "status is stored one write at a time");
        for queued in group {
            let kept = write(log, std::slice::from_ref(&queued)).await;
            queued.answer(kept.is_ok());
        }
        return Ok(());
    }
    if let Err(error) = &kept {
        tracing::warn!(%error, "status was not stored");
        sleep(RETRY).await;
    }
    group.into_iter().for_each(|queued| queued.answer(kept.is_ok()));
    kept
}

/// Leaves out what is kept, or stands in the group before.
fn leave_out_known(group: &mut [Queued]) {
    let mut known: BTreeMap<*const AtomicU64, u64> = BTreeMap::new();
    for Queued { write, mark, .. } in group {
        let seq = known.entry(Arc::as_ptr(mark)).or_insert_with(|| mark.load(Relaxed));
        let last_seq = write.last_seq();
        write.leave_out(*seq);
        *seq = last_seq.max(*seq);
    }
}

async fn write(log: &dyn FrameLog, group: &[Queued]) -> Result<(), Error> {
    let gaps: Vec<_> = group.iter().flat_map(|queued| queued.write.gaps.iter().cloned()).collect();
    let frames: Vec<_> = group.iter().flat_map(|queued| queued.write.frames.iter().cloned()).collect();
    if !gaps.is_empty() {
        let count = gaps.len() as u64;
        log.report_gaps(gaps).await?;
        metrics::counter!("midshift_telemetry_status_gaps_total").increment(count);
    }
    if frames.is_empty() {
        return Ok(());
    }
    log.append(frames).await
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::RobotId;
    use midshift_core::time::{ScaledClock, Utc};
    use midshift_store::{Frame, MemoryFrames};

    fn write_of(ring: &str, bytes: usize) -> Write {
        let robot_id = RobotId::parse("r1").expect("an id");
        let frame = Frame { robot_id, ring: Arc::from(ring), first_seq: 1, last_seq: 3, bytes: vec![0; bytes].into() };
        Write { frames: vec![frame], gaps: Vec::new() }
    }

    #[tokio::test(start_paused = true)]
    async fn what_the_log_refuses_takes_no_other_write_with_it() {
        let log = MemoryFrames::new(Arc::new(ScaledClock::new(|| 0, Utc(0), 1000)), 1 << 20);
        let (writer, marks) = (StatusWriter::default(), [(); 3].map(|()| Arc::new(AtomicU64::new(0))));
        let rings = ["one", "no\0name", "other"];
        let kept: Vec<_> =
            rings.iter().zip(&marks).map(|(ring, mark)| writer.queue(write_of(ring, 9), mark.clone())).collect();
        writer.finish(&log).await;
        let mut answers = Vec::new();
        for kept in kept {
            answers.push(kept.await.expect("an answer"));
        }
        assert_eq!(answers, [true, false, true]);
        assert_eq!(marks.map(|mark| mark.load(Relaxed)), [3, 0, 3]);
        assert_eq!(log.read(0, usize::MAX).await.expect("frames").len(), 2);
    }

    #[test]
    fn what_sessions_that_are_over_have_left_does_not_grow_without_bound() {
        let (writer, mark) = (StatusWriter::default(), Arc::new(AtomicU64::new(0)));
        let living = writer.queue(write_of("living", 1024), mark.clone());
        for _ in 0..WAITING_BYTES_MAX / 1024 {
            drop(writer.queue(write_of("over", 1024), mark.clone()));
        }
        let waiting = writer.waiting();
        assert!(waiting.bytes <= 4096, "{} bytes", waiting.bytes);
        assert!(waiting.queued.iter().any(|queued| &*queued.write.frames[0].ring == "living"));
        drop((waiting, living));
    }
}
