//! The way to the one writer task of a frame log: one call is one transaction. Telemetry gathers the frames of a call.
//!
//! Invariant: nobody is told "durable" before the commit of the engine ([`FramesEngine`]) has returned.

use crate::frames::{DAYS_MS, is_aged};
use crate::frames_pack::{ROW_BYTES, RowCompressor, coarser, pack, unpack};
use crate::queue::closed;
use crate::{Coarsen, Error, Frame, FrameMark, FramesOldest, Gap, StoredFrame};
use midshift_core::ids::RobotId;
use midshift_core::privacy::PRECISE_MS;
use midshift_core::time::Utc;
use sqlx::{ColumnIndex, Decode, Type};
use std::io;
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};

/// Appends that may wait for the writer.
const QUEUE_COMMANDS: usize = 1_024;
/// Rows of one page of [`crate::FrameLog::read`].
pub(crate) const READ_ROWS: i64 = 64;
/// Samples of one `frame_log` row, about.
const ROW_SAMPLES: u64 = 2_000;
/// Gaps kept, newest first.
pub(crate) const GAPS_KEPT: i64 = 1_000_000;

type Reply<T> = oneshot::Sender<Result<T, Error>>;

pub(crate) enum Command {
    Append { frames: Vec<Frame>, reply: Reply<()> },
    Marks { reply: Reply<Vec<FrameMark>> },
    Forget { marks: Vec<FrameMark>, reply: Reply<u64> },
    Gaps { gaps: Vec<Gap>, reply: Reply<()> },
    Prune { reply: Reply<u64> },
    Coarsen { coarsen: Coarsen, reply: Reply<u64> },
    Oldest { reply: Reply<FramesOldest> },
    Close { reply: Reply<()> },
}

/// What the writer task drives: one engine's side of the log.
pub(crate) trait FramesEngine: Send + 'static {
    /// Appends frames in one transaction.
    fn append(&mut self, frames: &[Frame], rows: &[Packed]) -> impl Future<Output = Result<(), Error>> + Send;
    /// As [`crate::FrameLog::marks`].
    fn marks(&mut self) -> impl Future<Output = Result<Vec<FrameMark>, Error>> + Send;
    /// As [`crate::FrameLog::forget`].
    fn forget(&mut self, marks: &[FrameMark]) -> impl Future<Output = Result<u64, Error>> + Send;
    /// As [`crate::FrameLog::report_gaps`].
    fn gaps(&mut self, gaps: &[Gap]) -> impl Future<Output = Result<(), Error>> + Send;
    /// Takes a slice of the oldest rows out; returns the bytes freed, 0 when the kept ones are within their limit.
    fn prune(&mut self) -> impl Future<Output = Result<u64, Error>> + Send;
    /// Makes a slice of the oldest rows coarser that are due, in one transaction that also notes how far it came; returns how many, 0 when none is due.
    fn coarsen(&mut self, coarsen: Coarsen) -> impl Future<Output = Result<u64, Error>> + Send;
    /// As [`crate::FrameLog::oldest`].
    fn oldest(&mut self) -> impl Future<Output = Result<FramesOldest, Error>> + Send;
    /// Writes down what is only in memory and lets go of what is open.
    fn close(self) -> impl Future<Output = Result<(), Error>> + Send;
}

/// One `frame_log` row.
#[derive(Default)]
pub(crate) struct Packed {
    pub(crate) body: Vec<u8>,
    samples: u64,
}

/// Serves the queue until it is closed or nobody can ask any more.
pub(crate) async fn run(mut engine: impl FramesEngine, mut queue: mpsc::Receiver<Command>) {
    let mut compressor = None;
    while let Some(command) = queue.recv().await {
        // Who asked may have stopped waiting; the work is done all the same.
        match command {
            Command::Append { frames, reply } => {
                let outcome = match packed(&frames, &mut compressor) {
                    Ok(rows) => engine.append(&frames, &rows).await,
                    Err(error) => Err(error),
                };
                drop(reply.send(outcome));
            }
            Command::Marks { reply } => drop(reply.send(engine.marks().await)),
            Command::Forget { marks, reply } => drop(reply.send(engine.forget(&marks).await)),
            Command::Gaps { gaps, reply } => drop(reply.send(engine.gaps(&gaps).await)),
            Command::Prune { reply } => drop(reply.send(engine.prune().await)),
            Command::Coarsen { coarsen, reply } => drop(reply.send(engine.coarsen(coarsen).await)),
            Command::Oldest { reply } => drop(reply.send(engine.oldest().await)),
            Command::Close { reply } => {
                drop(reply.send(engine.close().await));
                return;
            }
        }
    }
}

fn packed(frames: &[Frame], compressor: &mut Option<RowCompressor>) -> Result<Vec<Packed>, Error> {
    let mut rows: Vec<Packed> = Vec::new();
    for frame in frames {
        if rows.last().is_none_or(|row| row.body.len() >= ROW_BYTES || row.samples >= ROW_SAMPLES) {
            rows.push(Packed::default());
        }
        if let Some(row) = rows.last_mut() {
            pack(frame, &mut row.body).map_err(|error| Error::Unavailable(Arc::new(error)))?;
            row.samples += frame.last_seq.saturating_sub(frame.first_seq) + 1;
        }
    }
    let no_row = |error: io::Error| Error::Unavailable(Arc::new(error));
    let compressor = match compressor {
        Some(compressor) => compressor,
        None => compressor.insert(RowCompressor::new().map_err(no_row)?),
    };
    for row in &mut rows {
        row.body = compressor.row(std::mem::take(&mut row.body)).map_err(no_row)?;
    }
    Ok(rows)
}

/// The callers' end.
pub(crate) struct FramesQueue(mpsc::Sender<Command>);

impl FramesQueue {
    /// Both ends.
    pub(crate) fn new() -> (Self, mpsc::Receiver<Command>) {
        let (commands, queue) = mpsc::channel(QUEUE_COMMANDS);
        (Self(commands), queue)
    }

    pub(crate) async fn ask<T>(
        &self,
        command: impl FnOnce(oneshot::Sender<Result<T, Error>>) -> Command,
    ) -> Result<T, Error> {
        let (reply, answer) = oneshot::channel();
        self.0.send(command(reply)).await.map_err(|_| Error::Unavailable(closed()))?;
        answer.await.map_err(|_| Error::Unavailable(closed()))?
    }

    /// Prunes slice by slice.
    pub(crate) async fn prune(&self) -> Result<u64, Error> {
        self.slices(|reply| Command::Prune { reply }).await
    }

    /// Makes what is due coarser, slice by slice.
    pub(crate) async fn coarsen(&self, coarsen: Coarsen) -> Result<u64, Error> {
        self.slices(|reply| Command::Coarsen { coarsen, reply }).await
    }

    async fn slices(&self, command: impl Fn(Reply<u64>) -> Command) -> Result<u64, Error> {
        let mut done = 0;
        loop {
            match self.ask(&command).await? {
                0 => return Ok(done),
                slice => done += slice,
            }
        }
    }
}

/// Rows that one slice makes coarser: a MiB or two of reading and writing.
pub(crate) const COARSE_ROWS: i64 = 16;

/// Whether a row goes for its age. What a wrong clock has stamped ahead of now is young enough to be kept.
pub(crate) fn is_past_days(at_unix_ms: i64, now: Utc) -> bool {
    now.ms_since(Utc(at_unix_ms)) >= DAYS_MS
}

/// Of the oldest rows ([`crate::sql::FRAME_SIZES`]), `kept` bytes in all, how many go for their age or for `bytes_max`: the position of the last one, and their
/// bytes.
pub(crate) fn surplus(rows: &[(i64, i64, i64)], kept: u64, bytes_max: u64, now: Utc) -> (i64, u64) {
    let (mut up_to, mut freed) = (0, 0);
    for (position, size, at_unix_ms) in rows {
        if kept.saturating_sub(freed) <= bytes_max && !is_past_days(*at_unix_ms, now) {
            break;
        }
        up_to = *position;
        freed += size.cast_unsigned();
    }
    (up_to, freed)
}

/// Of the oldest rows that are as they came ([`crate::sql::FRAMES_NEXT`]) those that are due, made coarser.
pub(crate) fn made_coarser(
    rows: &[(i64, i64, Vec<u8>)],
    now: Utc,
    coarsen: Coarsen,
) -> Result<Vec<(i64, Vec<u8>)>, Error> {
    let due = rows.iter().take_while(|(_, at_unix_ms, _)| is_aged(*at_unix_ms, now, PRECISE_MS));
    due.map(|(position, _, body)| match coarser(body, coarsen) {
        Ok(body) => Ok((*position, body)),
        Err(error) => Err(Error::Unavailable(Arc::new(error))),
    })
    .collect()
}

/// How many of the rows whose sizes these are belong to a page that holds `bytes` already: the position of the last one, and the
/// bytes with them.
pub(crate) fn page_end(sizes: &[(i64, i64)], mut bytes: usize, bytes_max: usize) -> Option<(i64, usize)> {
    let mut last = None;
    for (position, size) in sizes {
        if bytes > bytes_max {
            break;
        }
        bytes += *size as usize;
        last = Some((*position, bytes));
    }
    last
}

/// The frames of one row of [`crate::sql::FRAME_BODIES`].
pub(crate) fn stored<'r, R>(row: &'r R) -> Result<Vec<StoredFrame>, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r [u8]: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    let position = row.try_get::<i64, _>(0)?.cast_unsigned();
    let at_unix_ms = row.try_get(1)?;
    let frames = unpack(row.try_get(2)?).map_err(|error| sqlx::Error::Decode(Box::new(error)))?;
    Ok(frames.into_iter().map(|frame| StoredFrame { position, at_unix_ms, frame }).collect())
}

/// The mark of one row of [`crate::sql::FRAME_MARKS`].
pub(crate) fn mark<'r, R>(row: &'r R) -> Result<FrameMark, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r str: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    Ok(FrameMark {
        robot_id: RobotId::parse(row.try_get(0)?).map_err(|error| sqlx::Error::Decode(Box::new(error)))?,
        ring: Arc::from(row.try_get::<&str, _>(1)?),
        seq: row.try_get::<i64, _>(2)?.cast_unsigned(),
    })
}

/// One row of [`crate::sql::GAPS`].
pub(crate) fn gap<'r, R>(row: &'r R) -> Result<Gap, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r str: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    Ok(Gap {
        robot_id: RobotId::parse(row.try_get(0)?).map_err(|error| sqlx::Error::Decode(Box::new(error)))?,
        ring: Arc::from(row.try_get::<&str, _>(1)?),
        lane: Arc::from(row.try_get::<&str, _>(2)?),
        from_seq: row.try_get::<i64, _>(3)?.cast_unsigned(),
        to_seq: row.try_get::<i64, _>(4)?.cast_unsigned(),
        reason: Arc::from(row.try_get::<&str, _>(5)?),
        at_unix_ms: row.try_get(6)?,
    })
}
