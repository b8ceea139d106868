//! The robots' ends of a bare loop: as many sockets as there are robots, each of which acknowledges what it reads.
//!
//! Invariant: a socket that ends ends the process, so that no robot is left out of a figure. Called by children only.

use super::fan;
use super::moments::{Moments, now_ns};
use anyhow::Context;
use midshift_agent::dial::TcpDial;
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::Semaphore;

/// What is known of one socket.
#[derive(Default)]
struct Reader {
    is_open: bool,
    moments: Moments,
}

fn lock(reader: &Mutex<Reader>) -> MutexGuard<'_, Reader> {
    reader.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The sockets of one bare loop.
pub struct Readers(Vec<Mutex<Reader>>);

impl Readers {
    /// Makes one for each robot, none of them open yet.
    pub fn new(robots: usize) -> Self {
        Self((0..robots).map(|_| Mutex::default()).collect())
    }
    fn lock_each(&self) -> impl Iterator<Item = MutexGuard<'_, Reader>> {
        self.0.iter().map(lock)
    }
    /// Counts those that are open.
    pub fn count_open(&self) -> u64 {
        self.lock_each().filter(|reader| reader.is_open).count() as u64
    }
    /// Counts those that have the answer to what they wrote since their moments were taken.
    pub fn count_answered(&self) -> u64 {
        self.lock_each().filter(|reader| reader.moments.acked_ns > 0).count() as u64
    }
    /// Takes the moments and begins anew.
    pub fn take_moments(&self) -> Vec<Moments> {
        self.lock_each().map(|mut reader| std::mem::take(&mut reader.moments)).collect()
    }

    /// Opens one and reads it to its end.
    pub async fn read_frames(&self, at: usize, dial: TcpDial, opening: &Semaphore) -> anyhow::Result<()> {
        let permit = opening.acquire().await?;
        let mut socket = dial.wire().await?;
        drop(permit);
        let reader = &self.0[at];
        lock(reader).is_open = true;
        let (mut frame, mut answer) = ([0; fan::FRAME_BYTES], [0; fan::ANSWER_BYTES]);
        loop {
            socket.read_exact(&mut frame).await.context("the bare loop ended")?;
            let told_ns = now_ns();
            socket.write_all(&[1; fan::ACK_BYTES]).await?;
            socket.flush().await?;
            socket.read_exact(&mut answer).await?;
            lock(reader).moments = Moments { told_ns, acked_ns: now_ns() };
        }
    }
}
