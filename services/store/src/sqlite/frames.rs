//! The frame log on SQLite: `telemetry.db`, a file of its own, so that bulk never waits for control and the other way round.
//!
//! Invariant: as [`FrameLog`]. A row holds many frames, because a row per sample costs more than the sample.

use super::file::DataFile;
use super::frames_pack::unpack;
use super::frames_writer::{Command, FramesWriter};
use super::{OpenError, TELEMETRY_DB, closed, schema, unavailable};
use crate::frames::{GAPS_MAX, frames_well_formed, gaps_well_formed};
use crate::{Error, Frame, FrameLog, FrameMark, Gap, StoredFrame};
use async_trait::async_trait;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::time::Clock;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqlitePool};
use std::path::Path;
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};

/// Appends that may wait for the writer.
const QUEUE_COMMANDS: usize = 1_024;
/// Rows of one page of [`FrameLog::read`].
const READ_ROWS: i64 = 64;

/// A [`FrameLog`] in `telemetry.db` of a data directory.
pub struct SqliteFrames {
    site_id: SiteId,
    commands: mpsc::Sender<Command>,
    readers: SqlitePool,
}

impl SqliteFrames {
    /// Opens the log of `site_id` in `dir`, which is created if need be, and starts its writer on the current runtime. Keeps
    /// about `bytes_max` bytes of frames.
    ///
    /// # Errors
    /// If another server has the directory, the file is newer than this binary, or cannot be durable.
    pub async fn open(dir: &Path, site_id: SiteId, clock: Arc<dyn Clock>, bytes_max: u64) -> Result<Self, OpenError> {
        let (file, _) = DataFile::open(dir, TELEMETRY_DB, schema::TELEMETRY).await?;
        let readers = file.readers().await?;
        let writer = FramesWriter::open(file.clone(), site_id.clone(), clock, bytes_max).await?;
        let (commands, queue) = mpsc::channel(QUEUE_COMMANDS);
        let (ended_sender, ended) = oneshot::channel();
        tokio::spawn(async move {
            writer.run(queue).await;
            drop(ended_sender);
        });
        tokio::spawn(file.checkpoint(ended));
        Ok(Self { site_id, commands, readers })
    }

    /// Finishes what is queued and closes the file. Everything asked afterwards is refused.
    pub async fn close(&self) {
        // An error means that it is closed already.
        let _ = self.ask(|reply| Command::Close { reply }).await;
        self.readers.close().await;
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<Result<T, Error>>) -> Command) -> Result<T, Error> {
        let (reply, answer) = oneshot::channel();
        self.commands.send(command(reply)).await.map_err(|_| Error::Unavailable(closed()))?;
        answer.await.map_err(|_| Error::Unavailable(closed()))?
    }
}

#[async_trait]
impl FrameLog for SqliteFrames {
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error> {
        frames_well_formed(&frames)?;
        self.ask(|reply| Command::Append { frames, reply }).await
    }

    async fn marks(&self) -> Result<Vec<FrameMark>, Error> {
        self.ask(|reply| Command::Marks { reply }).await
    }

    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error> {
        let mut transaction = self.readers.begin().await.map_err(unavailable)?;
        let (mut page, mut bytes, mut after) = (Vec::new(), 0, after.cast_signed());
        loop {
            // Sizes first: a page of bodies must not be fetched to find that it is too much.
            let sizes = sqlx::query(
                "SELECT position, size FROM frame_log WHERE site_id = $1 AND position > $2 ORDER BY position LIMIT $3",
            )
            .bind(self.site_id.as_str())
            .bind(after)
            .bind(READ_ROWS);
            let rows = sizes.fetch_all(&mut *transaction).await.map_err(unavailable)?;
            let mut last = None;
            for row in &rows {
                if bytes > bytes_max {
                    break;
                }
                last = Some(row.try_get::<i64, _>(0).map_err(unavailable)?);
                bytes += row.try_get::<i64, _>(1).map_err(unavailable)? as usize;
            }
            let Some(last) = last else { return Ok(page) };
            let bodies = sqlx::query(
                "SELECT position, at_unix_ms, body FROM frame_log \
                 WHERE site_id = $1 AND position > $2 AND position <= $3 ORDER BY position",
            )
            .bind(self.site_id.as_str())
            .bind(after)
            .bind(last);
            for row in bodies.fetch_all(&mut *transaction).await.map_err(unavailable)? {
                page.extend(stored(&row).map_err(unavailable)?);
            }
            after = last;
        }
    }

    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error> {
        gaps_well_formed(&gaps)?;
        self.ask(|reply| Command::Gaps { gaps, reply }).await
    }

    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error> {
        let limit = limit.min(GAPS_MAX) as i64;
        let columns = match robot_id {
            Some(_) => {
                "SELECT robot_id, ring, lane, from_seq, to_seq, reason, at_unix_ms FROM gap \
                 WHERE site_id = $1 AND robot_id = $3 ORDER BY position DESC LIMIT $2"
            }
            None => {
                "SELECT robot_id, ring, lane, from_seq, to_seq, reason, at_unix_ms FROM gap \
                 WHERE site_id = $1 ORDER BY position DESC LIMIT $2"
            }
        };
        let mut select = sqlx::query(columns).bind(self.site_id.as_str()).bind(limit);
        if let Some(robot_id) = robot_id {
            select = select.bind(robot_id.as_str());
        }
        let rows = select.fetch_all(&self.readers).await.map_err(unavailable)?;
        rows.iter().map(gap).collect::<Result<_, _>>().map_err(unavailable)
    }

    async fn prune(&self) -> Result<u64, Error> {
        let mut freed = 0;
        loop {
            match self.ask(|reply| Command::Prune { reply }).await? {
                0 => return Ok(freed),
                slice => freed += slice,
            }
        }
    }
}

fn stored(row: &SqliteRow) -> Result<Vec<StoredFrame>, sqlx::Error> {
    let position = row.try_get::<i64, _>(0)?.cast_unsigned();
    let at_unix_ms = row.try_get(1)?;
    let frames = unpack(row.try_get(2)?).map_err(|error| sqlx::Error::Decode(Box::new(error)))?;
    Ok(frames.into_iter().map(|frame| StoredFrame { position, at_unix_ms, frame }).collect())
}

fn gap(row: &SqliteRow) -> Result<Gap, sqlx::Error> {
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
