//! The frame log on PostgreSQL: schema `telemetry` of the same database, by connections of its own.
//!
//! Invariant: as [`FrameLog`]. Positions rise in the order of commits over all processes, so that a reader passes nothing over.

use super::connect::{Database, PostgresConfig, TELEMETRY_SCHEMA, patiently};
use super::frames_writer::FramesWriter;
use super::{migrate, read};
use crate::frames::{GAPS_MAX, frames_well_formed, gaps_well_formed};
use crate::frames_queue::{Command, FramesQueue, READ_ROWS, gap, page_end, run, stored};
use crate::migrations::TELEMETRY;
use crate::queue::unavailable;
use crate::{Coarsen, Error, Frame, FrameLog, FrameMark, FramesOldest, Gap, OpenError, StoredFrame, sql};
use async_trait::async_trait;
use midshift_core::Boxed;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::time::Clock;
use sqlx::{PgPool, Row};
use std::sync::Arc;

/// A [`FrameLog`] in schema `telemetry` of a PostgreSQL database.
pub struct PostgresFrames {
    site_id: SiteId,
    commands: FramesQueue,
    readers: PgPool,
}

impl PostgresFrames {
    /// Opens the log of `site_id` and starts its writer on the current runtime. Keeps about `bytes_max` bytes of frames. Other
    /// processes may have it open.
    ///
    /// # Errors
    /// If the database cannot be reached, is newer than this binary, or cannot be durable.
    pub fn open(
        config: &PostgresConfig,
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        bytes_max: u64,
    ) -> Boxed<'_, Result<Self, OpenError>> {
        Box::pin(async move {
            let database = Database::new(config, TELEMETRY_SCHEMA)?;
            let connection = database.writer().await?;
            migrate::apply(&database, TELEMETRY, None).await?;
            let readers = database.readers();
            let writer = FramesWriter::open(database, connection, site_id.clone(), clock, bytes_max).await?;
            let (commands, queue) = FramesQueue::new();
            tokio::spawn(run(writer, queue));
            Ok(Self { site_id, commands, readers })
        })
    }

    /// Finishes what is queued and closes the connections. Everything asked afterwards is refused.
    pub fn close(&self) -> Boxed<'_, ()> {
        Box::pin(async move {
            // An error means that it is closed already.
            let _ = self.commands.ask(|reply| Command::Close { reply }).await;
            self.readers.close().await;
        })
    }

    async fn page(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, sqlx::Error> {
        let mut transaction = read::begin(&self.readers).await?;
        let (mut page, mut bytes, mut after) = (Vec::new(), 0, after.cast_signed());
        loop {
            // Sizes first: a page of bodies must not be fetched to find that it is too much.
            let sizes = sqlx::query(sql::FRAME_SIZES).bind(self.site_id.as_str()).bind(after).bind(READ_ROWS);
            let rows = sizes.fetch_all(&mut *transaction).await?;
            let sizes: Result<Vec<_>, sqlx::Error> =
                rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get(1)?))).collect();
            let Some((last, sum)) = page_end(&sizes?, bytes, bytes_max) else { return Ok(page) };
            bytes = sum;
            let bodies = sqlx::query(sql::FRAME_BODIES).bind(self.site_id.as_str()).bind(after).bind(last);
            for row in bodies.fetch_all(&mut *transaction).await? {
                page.extend(stored(&row)?);
            }
            after = last;
        }
    }

    async fn newest_gaps(&self, robot_id: Option<&RobotId>, limit: i64) -> Result<Vec<Gap>, sqlx::Error> {
        let columns = if robot_id.is_some() { sql::GAPS_OF_ROBOT } else { sql::GAPS };
        let mut select = sqlx::query(columns).bind(self.site_id.as_str()).bind(limit);
        if let Some(robot_id) = robot_id {
            select = select.bind(robot_id.as_str());
        }
        select.fetch_all(&self.readers).await?.iter().map(gap).collect()
    }
}

#[async_trait]
impl FrameLog for PostgresFrames {
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

    async fn mark(&self, robot_id: &RobotId, ring: &str) -> Result<u64, Error> {
        let select = sqlx::query("SELECT seq FROM frame_mark WHERE site_id = $1 AND robot_id = $2 AND ring = $3")
            .bind(self.site_id.as_str())
            .bind(robot_id.as_str())
            .bind(ring.split('\0').next());
        let row = patiently(async { select.fetch_optional(&self.readers).await.map_err(unavailable) }).await?;
        let seq = row.map(|row| row.try_get::<i64, _>(0)).transpose().map_err(unavailable)?;
        Ok(seq.map_or(0, i64::cast_unsigned))
    }

    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error> {
        patiently(async { self.page(after, bytes_max).await.map_err(unavailable) }).await
    }

    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error> {
        gaps_well_formed(&gaps)?;
        self.commands.ask(|reply| Command::Gaps { gaps, reply }).await
    }

    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error> {
        let limit = limit.min(GAPS_MAX) as i64;
        patiently(async { self.newest_gaps(robot_id, limit).await.map_err(unavailable) }).await
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
