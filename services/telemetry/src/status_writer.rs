//! STATUS of all sessions on its way to the frame log: gathered for a while, so that one commit keeps the samples of many robots.
//!
//! Invariant: a write is called kept only after the commit that holds it; gaps come before frames, which move the mark that says what need not come
//! again. Each number is written once, also if a session brings again what the one before it had handed over. Nothing is gathered for longer than
//! [`LINGER`], and not at all for who cannot wait.

use crate::status::Write;
use midshift_store::{Error, FrameLog};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{Notify, oneshot};
use tokio::time::{Instant, sleep, sleep_until};

/// How long a write waits for others: an acknowledgement of STATUS may take two seconds.
pub const LINGER: Duration = Duration::from_millis(500);
/// So many bytes are written at once, and do not wait for more.
const GROUP_BYTES: usize = 1024 * 1024;
/// After a failed write, robots are asked again not sooner than this.
const RETRY: Duration = Duration::from_millis(200);

/// One write, how far its ring has come once it is kept, and who hears whether it is.
struct Queued {
    write: Write,
    mark: Arc<AtomicU64>,
    done: oneshot::Sender<bool>,
}

#[derive(Default)]
struct Waiting {
    queued: Vec<Queued>,
    bytes: usize,
    /// Somebody cannot wait for more.
    is_hurried: bool,
}

impl Waiting {
    fn is_due(&self) -> bool {
        self.is_hurried || self.bytes >= GROUP_BYTES
    }
    /// What is written next; the rest is due if it is as much again or somebody is in a hurry.
    fn take_group(&mut self) -> Vec<Queued> {
        let mut bytes = 0;
        let fits = |queued: &&Queued| {
            let is_first = bytes == 0;
            bytes += queued.write.bytes();
            is_first || bytes <= GROUP_BYTES
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
    /// Takes a write; `mark` rises to its last number once it is kept. The answer: whether it is; none: nobody writes any more.
    pub fn queue(&self, write: Write, mark: Arc<AtomicU64>) -> oneshot::Receiver<bool> {
        let (done, answer) = oneshot::channel();
        let mut waiting = self.waiting();
        let is_first = waiting.queued.is_empty();
        waiting.bytes += write.bytes();
        waiting.queued.push(Queued { write, mark, done });
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
                self.write_group(log).await;
            }
        }
    }
    /// Writes what waits, at the end of all.
    pub async fn finish(&self, log: &dyn FrameLog) {
        while !self.waiting().queued.is_empty() {
            self.write_group(log).await;
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
    async fn write_group(&self, log: &dyn FrameLog) {
        let mut group = self.waiting().take_group();
        leave_out_known(&mut group);
        let kept = write(log, &mut group).await;
        if let Err(error) = &kept {
            tracing::warn!(%error, "status was not stored");
            sleep(RETRY).await;
        }
        for queued in group {
            if kept.is_ok() {
                // Nothing of what was left out is beyond the mark.
                queued.mark.fetch_max(queued.write.last_seq(), Relaxed);
            }
            // The session may be over; its mark is for the next one.
            let _ = queued.done.send(kept.is_ok());
        }
    }
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

async fn write(log: &dyn FrameLog, group: &mut [Queued]) -> Result<(), Error> {
    let gaps: Vec<_> = group.iter_mut().flat_map(|queued| std::mem::take(&mut queued.write.gaps)).collect();
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
