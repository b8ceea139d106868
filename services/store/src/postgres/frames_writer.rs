//! The writer task of one process's frames: each group is one transaction that has the log's head row for itself.
//!
//! Invariant: `frame_head.marked_position` is the newest position of all processes, and `frame_mark` is written with the frames:
//! a robot may go on at another gateway, which must know at once how far it has come.

use super::connect::{Database, WRITE_PATIENCE, is_gone, is_undone_by_others, no_answer};
use crate::frames::Marks;
use crate::frames_queue::{COARSE_ROWS, FramesEngine, GAPS_KEPT, Packed, is_past_days, made_coarser, mark};
use crate::queue::unavailable;
use crate::{Coarsen, Error, Frame, FrameMark, FramesOldest, Gap, OpenError, sql};
use midshift_core::ids::SiteId;
use midshift_core::time::{Clock, Utc};
use sqlx::{PgConnection, Row};
use std::sync::Arc;
use tokio::time::Instant;

/// Rows that one slice of pruning takes.
const PRUNE_ROWS: i64 = 100;
/// How often a transaction is tried that the server undid because of others.
const ATTEMPTS: u32 = 24;

pub(super) struct FramesWriter {
    database: Database,
    /// None after a failure, until the next command.
    connection: Option<PgConnection>,
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    bytes_max: u64,
    /// Rows up to here go for their bytes in the slices of this pass; none: no pass is under way.
    surplus_end: Option<i64>,
}

/// What one transaction does.
enum Work<'w> {
    Append { rows: &'w [Packed], marks: Vec<FrameMark>, at_unix_ms: i64 },
    Forget(&'w [FrameMark]),
    Gaps(&'w [Gap]),
    Prune { surplus_end: i64, now: Utc },
    Coarsen { coarsen: Coarsen, now: Utc },
}

impl FramesWriter {
    pub(super) async fn open(
        database: Database,
        mut connection: PgConnection,
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        bytes_max: u64,
    ) -> Result<Self, OpenError> {
        sqlx::query(
            "INSERT INTO frame_head (site_id, marked_position) VALUES ($1, 0) ON CONFLICT (site_id) DO NOTHING",
        )
        .bind(site_id.as_str())
        .execute(&mut connection)
        .await
        .map_err(|source| OpenError::Sql { doing: "reading the head of the frame log", source })?;
        Ok(Self { database, connection: Some(connection), site_id, clock, bytes_max, surplus_end: None })
    }

    async fn connect(&mut self) -> Result<PgConnection, Error> {
        match self.connection.take() {
            Some(connection) => Ok(connection),
            None => self.database.writer().await.map_err(|e| Error::Unavailable(Arc::new(e))),
        }
    }

    /// Runs `work`; whatever fails, the connection is opened again: sending frames twice does no harm.
    async fn transaction(&mut self, work: &Work<'_>) -> Result<u64, Error> {
        let mut attempt = 0;
        loop {
            attempt += 1;
            let is_kept = self.connection.is_some();
            let mut connection = self.connect().await?;
            let done = tokio::time::timeout(WRITE_PATIENCE, once(&mut connection, &self.site_id, work)).await;
            match done.map_err(|_| Error::Unavailable(no_answer()))? {
                Ok(freed) => {
                    self.connection = Some(connection);
                    return Ok(freed);
                }
                Err(error) if (is_undone_by_others(&error) || is_kept && is_gone(&error)) && attempt < ATTEMPTS => {
                    metrics::counter!("midshift_store_retries_total").increment(1);
                }
                Err(error) => return Err(unavailable(error)),
            }
        }
    }
}

impl FramesEngine for FramesWriter {
    async fn append(&mut self, frames: &[Frame], rows: &[Packed]) -> Result<(), Error> {
        let mut marks = Marks::default();
        for frame in frames {
            marks.raise(&frame.robot_id, &frame.ring, frame.last_seq);
        }
        let started = Instant::now();
        let work = Work::Append { rows, marks: marks.list(), at_unix_ms: self.clock.now().wall.0 };
        self.transaction(&work).await?;
        metrics::histogram!("midshift_store_frames_commit_seconds").record(started.elapsed().as_secs_f64());
        Ok(())
    }

    async fn marks(&mut self) -> Result<Vec<FrameMark>, Error> {
        let mut connection = self.connect().await?;
        let select = sqlx::query(sql::FRAME_MARKS).bind(self.site_id.as_str()).fetch_all(&mut connection);
        let rows = tokio::time::timeout(WRITE_PATIENCE, select).await;
        let rows = rows.map_err(|_| Error::Unavailable(no_answer()))?.map_err(unavailable)?;
        self.connection = Some(connection);
        let mut marks: Vec<FrameMark> = rows.iter().map(mark).collect::<Result<_, _>>().map_err(unavailable)?;
        marks.sort_by(|a, b| (&a.robot_id, &a.ring).cmp(&(&b.robot_id, &b.ring)));
        Ok(marks)
    }

    async fn forget(&mut self, marks: &[FrameMark]) -> Result<u64, Error> {
        self.transaction(&Work::Forget(marks)).await
    }

    async fn gaps(&mut self, gaps: &[Gap]) -> Result<(), Error> {
        self.transaction(&Work::Gaps(gaps)).await.map(drop)
    }

    async fn prune(&mut self) -> Result<u64, Error> {
        // Outside the transaction, which every append waits for; a position, on which several processes agree.
        let surplus_end = match self.surplus_end {
            Some(end) => end,
            None => {
                let mut connection = self.connect().await?;
                let read =
                    tokio::time::timeout(WRITE_PATIENCE, surplus_end(&mut connection, &self.site_id, self.bytes_max));
                let end = read.await.map_err(|_| Error::Unavailable(no_answer()))?.map_err(unavailable)?;
                self.connection = Some(connection);
                end
            }
        };
        let freed = self.transaction(&Work::Prune { surplus_end, now: self.clock.now().steady_wall() }).await?;
        self.surplus_end = (freed > 0).then_some(surplus_end);
        Ok(freed)
    }

    async fn coarsen(&mut self, coarsen: Coarsen) -> Result<u64, Error> {
        self.transaction(&Work::Coarsen { coarsen, now: self.clock.now().steady_wall() }).await
    }

    async fn oldest(&mut self) -> Result<FramesOldest, Error> {
        let mut connection = self.connect().await?;
        let read = tokio::time::timeout(WRITE_PATIENCE, oldest(&mut connection, &self.site_id)).await;
        let oldest = read.map_err(|_| Error::Unavailable(no_answer()))?.map_err(unavailable)?;
        self.connection = Some(connection);
        Ok(oldest)
    }

    async fn close(self) -> Result<(), Error> {
        match self.connection {
            Some(connection) => sqlx::Connection::close(connection).await.map_err(unavailable),
            None => Ok(()),
        }
    }
}

async fn once(connection: &mut PgConnection, site_id: &SiteId, work: &Work<'_>) -> Result<u64, sqlx::Error> {
    sqlx::raw_sql("BEGIN").execute(&mut *connection).await?;
    let head = sqlx::query("SELECT marked_position FROM frame_head WHERE site_id = $1 FOR UPDATE");
    let position: i64 = head.bind(site_id.as_str()).fetch_one(&mut *connection).await?.try_get(0)?;
    let freed = match work {
        Work::Append { rows, marks, at_unix_ms } => {
            append(connection, site_id, position, rows, *at_unix_ms).await?;
            raise_marks(connection, site_id, marks).await?;
            0
        }
        Work::Forget(marks) => forget_marks(connection, site_id, marks).await?,
        Work::Gaps(gaps) => {
            report(connection, site_id, gaps).await?;
            0
        }
        Work::Prune { surplus_end, now } => prune(connection, site_id, *surplus_end, *now).await?,
        Work::Coarsen { coarsen, now } => make_coarser(connection, site_id, *coarsen, *now).await?,
    };
    sqlx::raw_sql("COMMIT").execute(connection).await?;
    Ok(freed)
}

async fn append(
    connection: &mut PgConnection,
    site_id: &SiteId,
    mut position: i64,
    rows: &[Packed],
    at_unix_ms: i64,
) -> Result<(), sqlx::Error> {
    for row in rows {
        position += 1;
        sqlx::query(sql::FRAME_INSERT)
            .bind(site_id.as_str())
            .bind(position)
            .bind(at_unix_ms)
            .bind(row.body.len() as i64)
            .bind(row.body.as_slice())
            .execute(&mut *connection)
            .await?;
    }
    let head = sqlx::query("UPDATE frame_head SET marked_position = $1 WHERE site_id = $2");
    head.bind(position).bind(site_id.as_str()).execute(connection).await.map(drop)
}

async fn raise_marks(connection: &mut PgConnection, site_id: &SiteId, marks: &[FrameMark]) -> Result<(), sqlx::Error> {
    sqlx::query(
        "INSERT INTO frame_mark (site_id, robot_id, ring, seq) \
         SELECT $1, mark.* FROM UNNEST($2::text[], $3::text[], $4::bigint[]) AS mark \
         ON CONFLICT (site_id, robot_id, ring) DO UPDATE SET seq = excluded.seq WHERE excluded.seq > frame_mark.seq",
    )
    .bind(site_id.as_str())
    .bind(marks.iter().map(|m| m.robot_id.as_str()).collect::<Vec<_>>())
    .bind(marks.iter().map(|m| &*m.ring).collect::<Vec<_>>())
    .bind(marks.iter().map(|m| m.seq.cast_signed()).collect::<Vec<_>>())
    .execute(connection)
    .await
    .map(drop)
}

async fn forget_marks(
    connection: &mut PgConnection,
    site_id: &SiteId,
    marks: &[FrameMark],
) -> Result<u64, sqlx::Error> {
    let mut gone = 0;
    for mark in marks {
        let delete = sqlx::query(sql::FRAME_MARK_FORGET)
            .bind(site_id.as_str())
            .bind(mark.robot_id.as_str())
            .bind(&*mark.ring)
            .bind(mark.seq.cast_signed());
        gone += delete.execute(&mut *connection).await?.rows_affected();
    }
    Ok(gone)
}

async fn report(connection: &mut PgConnection, site_id: &SiteId, gaps: &[Gap]) -> Result<(), sqlx::Error> {
    let newest = sqlx::query("SELECT COALESCE(MAX(position), 0) FROM gap WHERE site_id = $1").bind(site_id.as_str());
    let newest: i64 = newest.fetch_one(&mut *connection).await?.try_get(0)?;
    sqlx::query(
        "INSERT INTO gap (site_id, position, robot_id, ring, lane, from_seq, to_seq, reason, at_unix_ms) \
         SELECT $1, gap.* FROM UNNEST($2::bigint[], $3::text[], $4::text[], $5::text[], $6::bigint[], $7::bigint[], \
         $8::text[], $9::bigint[]) AS gap",
    )
    .bind(site_id.as_str())
    .bind((newest + 1..).take(gaps.len()).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| g.robot_id.as_str()).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| &*g.ring).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| &*g.lane).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| g.from_seq.cast_signed()).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| g.to_seq.cast_signed()).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| &*g.reason).collect::<Vec<_>>())
    .bind(gaps.iter().map(|g| g.at_unix_ms).collect::<Vec<_>>())
    .execute(&mut *connection)
    .await?;
    let kept = newest + gaps.len() as i64 - GAPS_KEPT;
    sqlx::query(sql::GAPS_PRUNE).bind(site_id.as_str()).bind(kept).execute(connection).await.map(drop)
}

/// The newest row that goes so that at most `bytes_max` stay; 0: none does.
async fn surplus_end(connection: &mut PgConnection, site_id: &SiteId, bytes_max: u64) -> Result<i64, sqlx::Error> {
    let end = sqlx::query(
        "SELECT COALESCE(MAX(position), 0) FROM (SELECT position, SUM(size) OVER (ORDER BY position DESC) AS kept \
         FROM frame_log WHERE site_id = $1) AS summed WHERE kept > $2",
    );
    let bytes_max = i64::try_from(bytes_max).unwrap_or(i64::MAX);
    end.bind(site_id.as_str()).bind(bytes_max).fetch_one(connection).await?.try_get(0)
}

async fn prune(
    connection: &mut PgConnection,
    site_id: &SiteId,
    surplus_end: i64,
    now: Utc,
) -> Result<u64, sqlx::Error> {
    let oldest = sqlx::query(sql::FRAME_SIZES).bind(site_id.as_str()).bind(0i64).bind(PRUNE_ROWS);
    let rows = oldest.fetch_all(&mut *connection).await?;
    let (mut up_to, mut freed) = (0, 0);
    for row in &rows {
        let (position, size, at_unix_ms): (i64, i64, i64) = (row.try_get(0)?, row.try_get(1)?, row.try_get(2)?);
        if position > surplus_end && !is_past_days(at_unix_ms, now) {
            break;
        }
        up_to = position;
        freed += size.cast_unsigned();
    }
    let delete = sqlx::query("DELETE FROM frame_log WHERE site_id = $1 AND position <= $2");
    delete.bind(site_id.as_str()).bind(up_to).execute(connection).await?;
    Ok(freed)
}

async fn coarse_head(connection: &mut PgConnection, site_id: &SiteId) -> Result<i64, sqlx::Error> {
    sqlx::query(sql::COARSE_HEAD).bind(site_id.as_str()).fetch_one(connection).await?.try_get(0)
}

/// Makes a slice coarser that is due. The head row is this transaction's, so of several processes one does it.
async fn make_coarser(
    connection: &mut PgConnection,
    site_id: &SiteId,
    coarsen: Coarsen,
    now: Utc,
) -> Result<u64, sqlx::Error> {
    let coarse = coarse_head(connection, site_id).await?;
    let next = sqlx::query(sql::FRAMES_NEXT).bind(site_id.as_str()).bind(coarse).bind(COARSE_ROWS);
    let rows = next.fetch_all(&mut *connection).await?;
    let rows = rows.iter().map(|row| Ok((row.try_get(0)?, row.try_get(1)?, row.try_get(2)?)));
    let rows = rows.collect::<Result<Vec<(i64, i64, Vec<u8>)>, sqlx::Error>>()?;
    let coarse = made_coarser(&rows, now, coarsen).map_err(|error| sqlx::Error::Decode(Box::new(error)))?;
    for (position, body) in &coarse {
        sqlx::query(sql::FRAME_REPLACE)
            .bind(site_id.as_str())
            .bind(position)
            .bind(body.len() as i64)
            .bind(body.as_slice())
            .execute(&mut *connection)
            .await?;
    }
    if let Some((position, _)) = coarse.last() {
        sqlx::query(sql::MOVE_COARSE_HEAD).bind(site_id.as_str()).bind(position).execute(connection).await?;
    }
    Ok(coarse.len() as u64)
}

async fn oldest(connection: &mut PgConnection, site_id: &SiteId) -> Result<FramesOldest, sqlx::Error> {
    let coarse = coarse_head(connection, site_id).await?;
    let row = sqlx::query(sql::FRAMES_OLDEST).bind(site_id.as_str()).bind(coarse).fetch_one(connection).await?;
    Ok(FramesOldest { any: row.try_get(0)?, precise: row.try_get(1)? })
}
