//! The frame log on SQLite: `telemetry.db`, a file of its own, so that bulk never waits for control and the other way round.
//!
//! Invariant: as [`FrameLog`]. A row holds many frames, because a row per sample costs more than the sample.

use super::file::{DataFile, TELEMETRY_DB};
use super::frames_writer::FramesWriter;
use crate::frames::{GAPS_MAX, frames_well_formed, gaps_well_formed};
use crate::frames_queue::{Command, FramesQueue, READ_ROWS, gap, page_end, run, stored};
use crate::migrations::TELEMETRY;
use crate::queue::unavailable;
use crate::{Coarsen, Error, Frame, FrameLog, FrameMark, FramesOldest, Gap, OpenError, StoredFrame, sql};
use async_trait::async_trait;
use midshift_core::Boxed;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::time::Clock;
use sqlx::{Row, SqlitePool};
use std::path::Path;
use std::sync::Arc;
use tokio::sync::oneshot;

/// A [`FrameLog`] in `telemetry.db` of a data directory.
pub struct SqliteFrames {
    site_id: SiteId,
    commands: FramesQueue,
    readers: SqlitePool,
}

impl SqliteFrames {
    /// Opens the log of `site_id` in `dir`, which is created if need be, and starts its writer on the current runtime. Keeps
    /// about `bytes_max` bytes of frames.
    ///
    /// # Errors
    /// If another server has the directory, the file is newer than this binary, or cannot be durable.
    pub fn open(
        dir: &Path,
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        bytes_max: u64,
    ) -> Boxed<'_, Result<Self, OpenError>> {
        Box::pin(async move {
            let (file, _) = DataFile::open(dir, TELEMETRY_DB, TELEMETRY).await?;
            let readers = file.readers().await?;
            let writer = FramesWriter::open(file.clone(), site_id.clone(), clock, bytes_max).await?;
            let (commands, queue) = FramesQueue::new();
            let (ended_sender, ended) = oneshot::channel();
            tokio::spawn(async move {
                run(writer, queue).await;
                drop(ended_sender);
            });
            tokio::spawn(file.checkpoint(ended));
            Ok(Self { site_id, commands, readers })
        })
    }

    /// Finishes what is queued and closes the file. Everything asked afterwards is refused.
    pub fn close(&self) -> Boxed<'_, ()> {
        Box::pin(async move {
            // An error means that it is closed already.
            let _ = self.commands.ask(|reply| Command::Close { reply }).await;
            self.readers.close().await;
        })
    }
}

#[async_trait]
impl FrameLog for SqliteFrames {
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error> {
        frames_well_formed(&frames)?;
        self.commands.ask(|reply| Command::Append { frames, reply }).await
    }

    async fn marks(&self) -> Result<Vec<FrameMark>, Error> {
        self.commands.ask(|reply| Command::Marks { reply }).await
    }

    async fn forget(&self, marks: Vec<FrameMark>) -> Result<u64, Error> {
        self.commands.ask(|reply| Command::Forget { marks, reply }).await
    }

    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error> {
        let mut transaction = self.readers.begin().await.map_err(unavailable)?;
        let (mut page, mut bytes, mut after) = (Vec::new(), 0, after.cast_signed());
        loop {
            // Sizes first: a page of bodies must not be fetched to find that it is too much.
            let sizes = sqlx::query(sql::FRAME_SIZES).bind(self.site_id.as_str()).bind(after).bind(READ_ROWS);
            let rows = sizes.fetch_all(&mut *transaction).await.map_err(unavailable)?;
            let sizes: Result<Vec<_>, _> = rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get(1)?))).collect();
            let Some((last, sum)) = page_end(&sizes.map_err(unavailable)?, bytes, bytes_max) else { return Ok(page) };
            bytes = sum;
            let bodies = sqlx::query(sql::FRAME_BODIES).bind(self.site_id.as_str()).bind(after).bind(last);
            for row in bodies.fetch_all(&mut *transaction).await.map_err(unavailable)? {
                page.extend(stored(&row).map_err(unavailable)?);
            }
            after = last;
        }
    }

    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error> {
        gaps_well_formed(&gaps)?;
        self.commands.ask(|reply| Command::Gaps { gaps, reply }).await
    }

    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error> {
        let limit = limit.min(GAPS_MAX) as i64;
        let columns = if robot_id.is_some() { sql::GAPS_OF_ROBOT } else { sql::GAPS };
        let mut select = sqlx::query(columns).bind(self.site_id.as_str()).bind(limit);
        if let Some(robot_id) = robot_id {
            select = select.bind(robot_id.as_str());
        }
        let rows = select.fetch_all(&self.readers).await.map_err(unavailable)?;
        rows.iter().map(gap).collect::<Result<_, _>>().map_err(unavailable)
    }

    async fn prune(&self) -> Result<u64, Error> {
        self.commands.prune().await
    }

    async fn coarsen(&self, coarsen: Coarsen) -> Result<u64, Error> {
        self.commands.coarsen(coarsen).await
    }

    async fn oldest(&self) -> Result<FramesOldest, Error> {
        self.commands.ask(|reply| Command::Oldest { reply }).await
    }
}
