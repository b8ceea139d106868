//! Statements that are run as one text, in one call: every call is a hop to SQLite's thread and back, which costs more than most statements.
//!
//! Invariant: any number of rows is one statement and one value, a JSON array of arrays, so that texts are few and stay prepared. Only table
//! and column names from closed lists are ever spliced into a text; every value is bound.

use serde::Serialize;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{Arguments, AssertSqlSafe, Error, SqliteConnection};

/// Statements with their values, in order.
#[derive(Default)]
pub(super) struct Batch {
    sql: String,
    values: SqliteArguments,
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

    /// The next value: what `json_each` makes rows of.
    pub(super) fn bind_rows(&mut self, rows: impl IntoIterator<Item: Serialize>) -> Result<&mut Self, Error> {
        let rows: Vec<_> = rows.into_iter().collect();
        self.bind(&serde_json::to_string(&rows).map_err(|error| Error::Encode(error.into()))?)
    }

    /// Runs all of it. After an error some of it has been done.
    pub(super) async fn run(self, connection: &mut SqliteConnection) -> Result<(), Error> {
        sqlx::query_with(AssertSqlSafe(self.sql), self.values).execute(connection).await.map(drop)
    }

    /// Runs all of it, and answers with the rows of every statement.
    pub(super) async fn fetch(self, connection: &mut SqliteConnection) -> Result<Vec<SqliteRow>, Error> {
        sqlx::query_with(AssertSqlSafe(self.sql), self.values).fetch_all(connection).await
    }
}

/// The first columns of a row of `json_each`.
pub(super) fn columns(count: usize) -> String {
    (0..count).map(|column| format!("value->>{column}")).collect::<Vec<_>>().join(", ")
}
