//! Statements that are run as one text, in one call: every call is a hop to SQLite's thread and back, which costs more than most statements.
//!
//! Invariant: any number of rows is one statement and one value, a JSON array of arrays, so that texts are few and stay prepared. Only table
//! and column names from closed lists are ever spliced into a text; every value is bound.

use serde::Serialize;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{Arguments, AssertSqlSafe, Either, Error, Executor, SqliteConnection};
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use tokio::sync::Notify;
use tokio_stream::{Stream, StreamExt};

/// When a transaction is looked at of which no word has come that its COMMIT began.
const LOOK_AFTER: Duration = Duration::from_millis(10);

/// The rows of one value. `json_each` would write each of them as text, which every column reads again.
pub(super) const EACH_ROW: &str = "jsonb_each(?)";

/// Statements with their values, in order.
#[derive(Default)]
pub(super) struct Batch {
    sql: String,
    values: SqliteArguments,
    statements: usize,
}

/// Why a transaction did not go through.
pub(super) struct Stopped {
    /// Whether all before its COMMIT was done: then nobody knows.
    pub(super) at_commit: bool,
    pub(super) error: Error,
}

impl Batch {
    /// A statement whose values are numbered in their order. Here they are plain `?`, which counts on from statement to statement.
    pub(super) fn push(&mut self, sql: &str) -> &mut Self {
        let mut parts = sql.split('$');
        self.sql.extend(parts.next());
        for part in parts {
            self.sql.push('?');
            self.sql.push_str(part.trim_start_matches(|c: char| c.is_ascii_digit()));
        }
        self.sql.push(';');
        self.statements += 1;
        self
    }

    /// The next value: a text.
    pub(super) fn bind(&mut self, text: &str) -> Result<&mut Self, Error> {
        self.values.add(text.to_owned()).map_err(Error::Encode)?;
        Ok(self)
    }

    /// The next value: a number.
    pub(super) fn bind_number(&mut self, number: i64) -> Result<&mut Self, Error> {
        self.values.add(number).map_err(Error::Encode)?;
        Ok(self)
    }

    /// The next value: what [`EACH_ROW`] makes rows of, or `json_each` of plain values.
    pub(super) fn bind_rows(&mut self, rows: impl IntoIterator<Item: Serialize>) -> Result<&mut Self, Error> {
        let rows: Vec<_> = rows.into_iter().collect();
        self.bind(&serde_json::to_string(&rows).map_err(|error| Error::Encode(error.into()))?)
    }

    /// Runs all of it. After an error some of it has been done.
    pub(super) async fn run(self, connection: &mut SqliteConnection) -> Result<(), Error> {
        sqlx::query_with(AssertSqlSafe(self.sql), self.values).execute(connection).await.map(drop)
    }

    /// Runs a transaction, of which COMMIT is the last statement. Each statement has a result, and whoever waits for it is woken by each: so nobody
    /// waits until `committing` says that only the disk is missing.
    pub(super) async fn run_transaction(
        mut self,
        connection: &mut SqliteConnection,
        committing: &Notify,
    ) -> Result<(), Stopped> {
        self.push("COMMIT");
        let (statements, mut done) = (self.statements, 0);
        let query = sqlx::query_with(AssertSqlSafe(self.sql), self.values);
        let mut results = pin!(connection.fetch_many(query));
        let mut is_looking = false;
        while done < statements {
            let polled = results.as_mut().poll_next(&mut Context::from_waker(Waker::noop()));
            let result = match polled {
                Poll::Ready(result) => result,
                Poll::Pending if is_looking => results.next().await,
                Poll::Pending => {
                    drop(tokio::time::timeout(LOOK_AFTER, committing.notified()).await);
                    is_looking = true;
                    continue;
                }
            };
            match result.unwrap_or(Err(Error::WorkerCrashed)) {
                Ok(Either::Left(_)) => done += 1,
                Ok(Either::Right(_)) => {}
                Err(error) => return Err(Stopped { at_commit: done + 1 == statements, error }),
            }
        }
        Ok(())
    }

    /// Runs all of it, and answers with the rows of every statement.
    pub(super) async fn fetch(self, connection: &mut SqliteConnection) -> Result<Vec<SqliteRow>, Error> {
        sqlx::query_with(AssertSqlSafe(self.sql), self.values).fetch_all(connection).await
    }
}

/// Tells when a COMMIT of the connection begins.
pub(super) async fn tell_commits(connection: &mut SqliteConnection) -> Result<Arc<Notify>, Error> {
    let told = Arc::new(Notify::new());
    let tell = told.clone();
    connection.lock_handle().await?.set_commit_hook(move || {
        tell.notify_one();
        true
    });
    Ok(told)
}

/// The first columns of [`EACH_ROW`].
pub(super) fn columns(count: usize) -> String {
    (0..count).map(|column| format!("value->>{column}")).collect::<Vec<_>>().join(", ")
}
