//! The writer task of `telemetry.db`: frames queue while one fsync runs, and the next transaction takes them all.
//!
//! Invariant: nobody is told "durable" before the COMMIT has returned. Marks are kept in memory, written down every 5 s, and after
//! a start folded again from the log's tail: a keyed write per frame would cost more than the frame.

use super::file::DataFile;
use super::write_sql::placeholders;
use crate::frames::Marks;
use crate::frames_pack::unpack;
use crate::frames_queue::{COARSE_ROWS, FramesEngine, GAPS_KEPT, Packed, made_coarser, mark, surplus};
use crate::queue::unavailable;
use crate::{Coarsen, Error, Frame, FrameMark, FramesOldest, Gap, OpenError, sql};
use midshift_core::ids::SiteId;
use midshift_core::time::Clock;
use sqlx::{AssertSqlSafe, Connection, Row, SqliteConnection};
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// Marks are written down this often while frames arrive.
const MARKS_PERIOD: Duration = Duration::from_secs(5);
/// Rows of one statement of marks or gaps, and rows one slice of pruning takes.
const SLICE_ROWS: usize = 100;

/// What is known of the open file; none of it outlives a failure.
struct Open {
    connection: SqliteConnection,
    marks: Marks,
    /// Marks that moved since they were last written down.
    moved: Marks,
    marked_at: Instant,
    position: i64,
    bytes: u64,
    gap_position: i64,
}

pub(super) struct FramesWriter {
    file: DataFile,
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    bytes_max: u64,
    open: Option<Open>,
}

impl FramesWriter {
    pub(super) async fn open(
        file: DataFile,
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        bytes_max: u64,
    ) -> Result<Self, OpenError> {
        let mut writer = Self { file, site_id, clock, bytes_max, open: None };
        writer.open = Some(writer.load().await?);
        Ok(writer)
    }

    async fn load(&self) -> Result<Open, OpenError> {
        let mut connection = self.file.writer().await?;
        let (marks, position, bytes, gap_position) = tail(&mut connection, &self.site_id)
            .await
            .map_err(|source| OpenError::Sql { doing: "reading the tail of the frame log", source })?;
        let marked_at = Instant::now();
        // What was folded from the tail is not written down yet.
        let moved = marks.clone();
        Ok(Open { connection, marks, moved, marked_at, position, bytes, gap_position })
    }

    async fn ready(&mut self) -> Result<(), Error> {
        if self.open.is_none() {
            self.open = Some(self.load().await.map_err(|e| Error::Unavailable(Arc::new(e)))?);
        }
        Ok(())
    }

    /// What is beyond the bytes or days that are kept, of the oldest rows: the position of the last, and their bytes.
    async fn surplus(&self, open: &mut Open) -> Result<(i64, u64), sqlx::Error> {
        let oldest = sqlx::query(sql::FRAME_SIZES).bind(self.site_id.as_str()).bind(0).bind(SLICE_ROWS as i64);
        let rows = oldest.fetch_all(&mut open.connection).await?;
        let sizes = rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get(1)?, row.try_get(2)?)));
        let sizes = sizes.collect::<Result<Vec<_>, sqlx::Error>>()?;
        Ok(surplus(&sizes, open.bytes, self.bytes_max, self.clock.now().steady_wall()))
    }

    async fn write_marks(&mut self) -> Result<(), Error> {
        self.ready().await?;
        let Some(mut open) = self.open.take() else { return Ok(()) };
        write(&mut open, &self.site_id, &[], 0, true).await.map_err(unavailable)?;
        self.open = Some(open);
        Ok(())
    }
}

impl FramesEngine for FramesWriter {
    async fn append(&mut self, frames: &[Frame], rows: &[Packed]) -> Result<(), Error> {
        let at_unix_ms = self.clock.now().wall.0;
        let started = Instant::now();
        self.ready().await?;
        // Whatever fails, the file is opened again and read: sending frames twice does no harm.
        let Some(mut open) = self.open.take() else { return Ok(()) };
        for frame in frames {
            open.moved.raise(&frame.robot_id, &frame.ring, frame.last_seq);
        }
        let write_marks = open.marked_at.elapsed() >= MARKS_PERIOD;
        write(&mut open, &self.site_id, rows, at_unix_ms, write_marks).await.map_err(unavailable)?;
        for frame in frames {
            open.marks.raise(&frame.robot_id, &frame.ring, frame.last_seq);
        }
        self.open = Some(open);
        metrics::histogram!("midshift_store_frames_commit_seconds").record(started.elapsed().as_secs_f64());
        Ok(())
    }

    async fn marks(&mut self) -> Result<Vec<FrameMark>, Error> {
        self.ready().await?;
        Ok(self.open.as_ref().map_or_else(Vec::new, |open| open.marks.list()))
    }

    async fn forget(&mut self, marks: &[FrameMark]) -> Result<u64, Error> {
        // What is not written down would be folded from the log's tail again.
        self.write_marks().await?;
        let Some(mut open) = self.open.take() else { return Ok(0) };
        let gone: Vec<&FrameMark> = marks.iter().filter(|mark| open.marks.forget(mark)).collect();
        forget_marks(&mut open.connection, &self.site_id, &gone).await.map_err(unavailable)?;
        self.open = Some(open);
        Ok(gone.len() as u64)
    }

    async fn close(mut self) -> Result<(), Error> {
        let outcome = self.write_marks().await;
        if let Some(open) = self.open.take() {
            drop(open.connection.close().await);
        }
        outcome
    }

    async fn gaps(&mut self, gaps: &[Gap]) -> Result<(), Error> {
        self.ready().await?;
        let Some(mut open) = self.open.take() else { return Ok(()) };
        write_gaps(&mut open, &self.site_id, gaps).await.map_err(unavailable)?;
        self.open = Some(open);
        Ok(())
    }

    async fn prune(&mut self) -> Result<u64, Error> {
        self.ready().await?;
        let Some(mut open) = self.open.take() else { return Ok(0) };
        let (up_to, freed) = self.surplus(&mut open).await.map_err(unavailable)?;
        self.open = Some(open);
        if freed == 0 {
            return Ok(0);
        }
        // What is pruned is no longer there to fold marks from.
        self.write_marks().await?;
        let Some(mut open) = self.open.take() else { return Ok(0) };
        prune(&mut open, &self.site_id, up_to).await.map_err(unavailable)?;
        open.bytes -= freed;
        self.open = Some(open);
        Ok(freed)
    }

    async fn coarsen(&mut self, coarsen: Coarsen) -> Result<u64, Error> {
        let now = self.clock.now().steady_wall();
        self.ready().await?;
        let Some(mut open) = self.open.take() else { return Ok(0) };
        let next = precise(&mut open.connection, &self.site_id).await.map_err(unavailable)?;
        let coarse = made_coarser(&next, now, coarsen)?;
        if !coarse.is_empty() {
            let sizes = |rows: &mut dyn Iterator<Item = usize>| rows.sum::<usize>() as u64;
            let before = sizes(&mut next.iter().take(coarse.len()).map(|(_, _, body)| body.len()));
            replace(&mut open.connection, &self.site_id, &coarse).await.map_err(unavailable)?;
            open.bytes = open.bytes - before + sizes(&mut coarse.iter().map(|(_, body)| body.len()));
        }
        self.open = Some(open);
        Ok(coarse.len() as u64)
    }

    async fn oldest(&mut self) -> Result<FramesOldest, Error> {
        self.ready().await?;
        let Some(mut open) = self.open.take() else { return Ok(FramesOldest::default()) };
        let oldest = oldest(&mut open.connection, &self.site_id).await.map_err(unavailable)?;
        self.open = Some(open);
        Ok(oldest)
    }
}

async fn write(
    open: &mut Open,
    site_id: &SiteId,
    rows: &[Packed],
    at_unix_ms: i64,
    with_marks: bool,
) -> Result<(), sqlx::Error> {
    let mut transaction = open.connection.begin_with("BEGIN IMMEDIATE").await?;
    for row in rows {
        open.position += 1;
        open.bytes += row.body.len() as u64;
        sqlx::query(sql::FRAME_INSERT)
            .bind(site_id.as_str())
            .bind(open.position)
            .bind(at_unix_ms)
            .bind(row.body.len() as i64)
            .bind(row.body.as_slice())
            .execute(&mut *transaction)
            .await?;
    }
    if with_marks {
        save_marks(&mut transaction, site_id, &open.moved.list(), open.position).await?;
    }
    transaction.commit().await?;
    if with_marks {
        open.moved = Marks::default();
        open.marked_at = Instant::now();
    }
    Ok(())
}

async fn save_marks(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    marks: &[FrameMark],
    position: i64,
) -> Result<(), sqlx::Error> {
    for slice in marks.chunks(SLICE_ROWS) {
        let mut upsert = sqlx::query(AssertSqlSafe(format!(
            "INSERT INTO frame_mark (site_id, robot_id, ring, seq) VALUES {} \
             ON CONFLICT (site_id, robot_id, ring) DO UPDATE SET seq = excluded.seq WHERE excluded.seq > frame_mark.seq",
            placeholders(slice.len(), 4)
        )));
        for mark in slice {
            upsert = upsert
                .bind(site_id.as_str())
                .bind(mark.robot_id.as_str())
                .bind(mark.ring.clone())
                .bind(mark.seq.cast_signed());
        }
        upsert.execute(&mut *connection).await?;
    }
    sqlx::query(
        "INSERT INTO frame_head (site_id, marked_position) VALUES ($1, $2) \
         ON CONFLICT (site_id) DO UPDATE SET marked_position = excluded.marked_position",
    )
    .bind(site_id.as_str())
    .bind(position)
    .execute(connection)
    .await?;
    Ok(())
}

async fn forget_marks(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    marks: &[&FrameMark],
) -> Result<(), sqlx::Error> {
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    for mark in marks {
        sqlx::query(sql::FRAME_MARK_FORGET)
            .bind(site_id.as_str())
            .bind(mark.robot_id.as_str())
            .bind(mark.ring.clone())
            .bind(mark.seq.cast_signed())
            .execute(&mut *transaction)
            .await?;
    }
    transaction.commit().await
}

async fn write_gaps(open: &mut Open, site_id: &SiteId, gaps: &[Gap]) -> Result<(), sqlx::Error> {
    let mut transaction = open.connection.begin_with("BEGIN IMMEDIATE").await?;
    for slice in gaps.chunks(SLICE_ROWS) {
        let mut insert = sqlx::query(AssertSqlSafe(format!(
            "INSERT INTO gap (site_id, position, robot_id, ring, lane, from_seq, to_seq, reason, at_unix_ms) VALUES {}",
            placeholders(slice.len(), 9)
        )));
        for gap in slice {
            open.gap_position += 1;
            insert = insert
                .bind(site_id.as_str())
                .bind(open.gap_position)
                .bind(gap.robot_id.as_str())
                .bind(gap.ring.clone())
                .bind(gap.lane.clone())
                .bind(gap.from_seq.cast_signed())
                .bind(gap.to_seq.cast_signed())
                .bind(gap.reason.clone())
                .bind(gap.at_unix_ms);
        }
        insert.execute(&mut *transaction).await?;
    }
    sqlx::query(sql::GAPS_PRUNE)
        .bind(site_id.as_str())
        .bind(open.gap_position - GAPS_KEPT)
        .execute(&mut *transaction)
        .await?;
    transaction.commit().await
}

async fn prune(open: &mut Open, site_id: &SiteId, up_to: i64) -> Result<(), sqlx::Error> {
    sqlx::query("DELETE FROM frame_log WHERE site_id = $1 AND position <= $2")
        .bind(site_id.as_str())
        .bind(up_to)
        .execute(&mut open.connection)
        .await
        .map(drop)
}

async fn coarse_head(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<i64, sqlx::Error> {
    sqlx::query(sql::COARSE_HEAD).bind(site_id.as_str()).fetch_one(connection).await?.try_get(0)
}

/// The oldest rows that are as they came: position, moment, body.
async fn precise(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<Vec<(i64, i64, Vec<u8>)>, sqlx::Error> {
    let coarse = coarse_head(connection, site_id).await?;
    let next = sqlx::query(sql::FRAMES_NEXT).bind(site_id.as_str()).bind(coarse).bind(COARSE_ROWS);
    let rows = next.fetch_all(connection).await?;
    rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get(1)?, row.try_get(2)?))).collect()
}

/// Puts coarser rows in the place of those that came, and notes how far that is.
async fn replace(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    coarse: &[(i64, Vec<u8>)],
) -> Result<(), sqlx::Error> {
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    for (position, body) in coarse {
        sqlx::query(sql::FRAME_REPLACE)
            .bind(site_id.as_str())
            .bind(position)
            .bind(body.len() as i64)
            .bind(body.as_slice())
            .execute(&mut *transaction)
            .await?;
    }
    sqlx::query(sql::MOVE_COARSE_HEAD)
        .bind(site_id.as_str())
        .bind(coarse.last().map_or(0, |(position, _)| *position))
        .execute(&mut *transaction)
        .await?;
    transaction.commit().await
}

async fn oldest(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<FramesOldest, sqlx::Error> {
    let coarse = coarse_head(connection, site_id).await?;
    let row = sqlx::query(sql::FRAMES_OLDEST).bind(site_id.as_str()).bind(coarse).fetch_one(connection).await?;
    Ok(FramesOldest { any: row.try_get(0)?, precise: row.try_get(1)? })
}

/// Marks as written down and folded forward from the log's tail; the last position; the bytes kept; the last gap.
async fn tail(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<(Marks, i64, u64, i64), sqlx::Error> {
    let mut marks = Marks::default();
    for row in sqlx::query(sql::FRAME_MARKS).bind(site_id.as_str()).fetch_all(&mut *connection).await? {
        let FrameMark { robot_id, ring, seq } = mark(&row)?;
        marks.raise(&robot_id, &ring, seq);
    }
    let head = "SELECT COALESCE(MAX(marked_position), 0) FROM frame_head WHERE site_id = $1";
    let mut position: i64 = sqlx::query(head).bind(site_id.as_str()).fetch_one(&mut *connection).await?.try_get(0)?;
    loop {
        let newer = sqlx::query(
            "SELECT position, body FROM frame_log WHERE site_id = $1 AND position > $2 ORDER BY position LIMIT $3",
        );
        let rows = newer.bind(site_id.as_str()).bind(position).bind(SLICE_ROWS as i64);
        let rows = rows.fetch_all(&mut *connection).await?;
        if rows.is_empty() {
            break;
        }
        for row in rows {
            position = row.try_get(0)?;
            for frame in unpack(row.try_get(1)?).map_err(|error| sqlx::Error::Decode(Box::new(error)))? {
                marks.raise(&frame.robot_id, &frame.ring, frame.last_seq);
            }
        }
    }
    let sum = "SELECT COALESCE(SUM(size), 0) FROM frame_log WHERE site_id = $1";
    let bytes: i64 = sqlx::query(sum).bind(site_id.as_str()).fetch_one(&mut *connection).await?.try_get(0)?;
    let gap = "SELECT COALESCE(MAX(position), 0) FROM gap WHERE site_id = $1";
    let gap_position: i64 = sqlx::query(gap).bind(site_id.as_str()).fetch_one(connection).await?.try_get(0)?;
    Ok((marks, position, bytes.cast_unsigned(), gap_position))
}
