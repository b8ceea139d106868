//! How old what is kept is, for each place that goes by age: the metric by which anybody sees that the purge works, and the test that it does.
//!
//! Invariant: nothing is taken away here. The list of places and ages is [`privacy::RETENTION_RULES`], by which the jobs go too.

use midshift_core::audit::AuditRow;
use midshift_core::privacy::{self, DataClass, Place, RetentionRule};
use midshift_core::rows::{Log, Row, Seq, Table};
use midshift_core::stop::record::StopRecord;
use midshift_core::task::{Phase, TaskState};
use midshift_core::time::{Clock, Now, Utc};
use midshift_store::{Error, FrameLog, Query, Store};

/// The oldest of one place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Oldest {
    /// The place that was looked into.
    pub place: Place,
    /// What the place is there for.
    pub class: DataClass,
    /// How old it is, milliseconds; 0: there is nothing.
    pub age_ms: u64,
    /// How old it may get, milliseconds.
    pub age_max_ms: u64,
}

/// Of each place that goes by age and can be asked. Attempts, requests and intakes of tasks go in the same turn as the state of their task, after it or before it, so
/// that the age of `task_state` is theirs; files of the stop service and of robots are looked after by those, and `stop_record` follows the first.
///
/// # Errors
/// If the store or the log of samples cannot be read.
pub async fn find_oldest(store: &dyn Store, frames: &dyn FrameLog, clock: &dyn Clock) -> Result<Vec<Oldest>, Error> {
    let (now, mut found) = (clock.now(), Vec::new());
    for rule in privacy::RETENTION_RULES {
        if let (Some(age_max_ms), Some(class)) = (rule.age_max_ms(), rule.holds.first())
            && let Some(age_ms) = age(store, frames, now, rule).await?
        {
            found.push(Oldest { place: rule.place, class: *class, age_ms, age_max_ms });
        }
    }
    Ok(found)
}

/// The same as metrics: `midshift_oldest_row_seconds` and, beside it, `midshift_retention_seconds`.
///
/// # Errors
/// As [`find_oldest`].
pub async fn publish_ages(store: &dyn Store, frames: &dyn FrameLog, clock: &dyn Clock) -> Result<(), Error> {
    for Oldest { place, class, age_ms, age_max_ms } in find_oldest(store, frames, clock).await? {
        let labels = [("class", class.as_str()), ("place", place.as_str())];
        metrics::gauge!("midshift_oldest_row_seconds", &labels).set(age_ms as f64 / 1_000.0);
        metrics::gauge!("midshift_retention_seconds", &labels).set(age_max_ms as f64 / 1_000.0);
    }
    Ok(())
}

/// Milliseconds; none: this place is not asked.
async fn age(store: &dyn Store, frames: &dyn FrameLog, now: Now, rule: &RetentionRule) -> Result<Option<u64>, Error> {
    let wall = |at: Option<i64>| Some(at.map_or(0, |at| now.wall.ms_since(Utc(at))));
    Ok(match rule.place {
        Place::Samples => wall(frames.oldest().await?.precise),
        Place::CoarseSamples => wall(frames.oldest().await?.any),
        Place::Log(log) => wall(first_entry(store, log).await?),
        Place::Table(Table::TaskState) => Some(ended(store).await?.map_or(0, |at| now.utc.ms_since(at))),
        Place::Table(Table::StopRecord) => wall(reset(store).await?.map(|at| at.0)),
        Place::Table(table) if table.is_audit() => wall(first_of_chain(store, table).await?),
        Place::Table(Table::RequestKey | Table::TaskRequest | Table::CommandKey | Table::OtaCommandKey) => {
            let Place::Table(table) = rule.place else { return Ok(None) };
            wall(first(store, table).await?.and_then(|row| row.index.order))
        }
        Place::Table(_) | Place::Gaps | Place::Heard | Place::File(_) | Place::Robot(_) => None,
    })
}

/// When the stop was reset that was reset longest ago; one that is engaged has no age.
async fn reset(store: &dyn Store) -> Result<Option<Utc>, Error> {
    let snapshot = store.snapshot(&[Table::StopRecord]).await?;
    let records = snapshot.rows.iter().filter_map(|row| row.decode::<StopRecord>().ok());
    Ok(records.filter_map(|record| record.reset).map(|reset| reset.reset_unix_ms).min())
}

async fn first(store: &dyn Store, table: Table) -> Result<Option<Row>, Error> {
    Ok(store.list(Query { limit: 1, ..Query::all(table) }).await?.pop())
}

/// When the row was written behind which nothing goes yet: the one before it stays until it is old itself, since it may have been quoted till then.
async fn first_of_chain(store: &dyn Store, table: Table) -> Result<Option<i64>, Error> {
    let rows = store.list(Query { limit: 2, ..Query::all(table) }).await?;
    Ok(rows.last().and_then(written))
}

fn written(row: &Row) -> Option<i64> {
    AuditRow::read(&row.body).map(|row| row.at_unix_ms)
}

async fn first_entry(store: &dyn Store, log: Log) -> Result<Option<i64>, Error> {
    let page = match store.feed(Seq(0), &[log], 1).await {
        Err(Error::CursorExpired { oldest, .. }) => store.feed(oldest, &[log], 1).await?,
        page => page?,
    };
    Ok(page.entries.first().map(|entry| entry.at_unix_ms))
}

/// When the task ended that ended longest ago, of the first page in the order of admission: what the purge looks at too.
async fn ended(store: &dyn Store) -> Result<Option<Utc>, Error> {
    let terminal = Phase::ALL.into_iter().filter(|phase| phase.is_terminal()).map(Phase::number);
    let rows = store.list(Query::all(Table::TaskState).in_states(terminal)).await?;
    Ok(rows.iter().filter_map(|row| row.decode::<TaskState>().ok()).map(|state| state.changed).min())
}
