//! The verbs of the store, what they are given and what they answer. Each engine implements [`Store`].

use async_trait::async_trait;
use midshift_core::audit::Head;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::rows::{BadRow, Entry, Key, Log, Naming, Record, Revision, Row, RowSelection, Seq, Table, Writer};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;
use tokio::sync::watch;

/// Most entries one feed page holds, whatever the caller asks for.
pub const FEED_PAGE_MAX: usize = 5_000;
/// Bytes of an id, subject, parent, actor or request id. An index of PostgreSQL holds about 2,700 bytes of an id and its parent.
pub const ID_BYTES_MAX: usize = 1_024;
/// Most keys of one [`Store::get`].
pub const GET_KEYS_MAX: usize = 10_000;
/// Highest number [`Store::raise_head`] believes: as unix ms it is the year 287396. A number above it is a lie or a defect, and
/// following it would leave the store without numbers to give.
pub const SEQ_PLAUSIBLE_MAX: Seq = Seq(1 << 53);

/// Random text, made when a store is created or restored. A cursor of another store means: rebuild.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct StoreId(pub Arc<str>);

impl StoreId {
    /// The id of a store that is made or restored now: nobody else has it.
    pub fn fresh() -> Self {
        Self(format!("{:032x}", rand::random::<u128>()).into())
    }
}

impl fmt::Display for StoreId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A failure below the store, shared by everyone who waited for it.
pub type Cause = Arc<dyn std::error::Error + Send + Sync>;

/// Why nothing could be read.
#[derive(Clone, Debug, thiserror::Error)]
pub enum Error {
    /// The log no longer (or, after a restore, not yet) reaches the cursor: read a snapshot and go on from its number.
    #[error("cursor {} is outside the log, whose oldest is {}", asked.0, oldest.0)]
    CursorExpired {
        /// The cursor.
        asked: Seq,
        /// The oldest cursor that would have worked.
        oldest: Seq,
    },
    /// More was asked in one call than its limit.
    #[error("{asked} keys asked in one call, at most {GET_KEYS_MAX}")]
    TooManyKeys {
        /// How many.
        asked: usize,
    },
    /// A number that no store can have given.
    #[error("number {} is beyond what any store has given", asked.0)]
    ImplausibleSeq {
        /// The number.
        asked: Seq,
    },
    /// A frame or gap that cannot be kept; nothing of its call was.
    #[error("frame {0}")]
    BadFrame(&'static str),
    /// A row that this binary cannot read.
    #[error(transparent)]
    BadRow(#[from] BadRow),
    /// The store cannot answer now.
    #[error("store unavailable")]
    Unavailable(#[source] Cause),
}

/// Why an item was not applied.
#[derive(Clone, Debug, thiserror::Error)]
pub enum CommitError {
    /// A row was not as expected: plan again from what is there.
    #[error("row {key:?} is at {found:?}, not as expected")]
    Conflict {
        /// The first such row.
        key: Key,
        /// Its revision; none if there is no such row.
        found: Option<Revision>,
    },
    /// A robot that had to be silent was heard meanwhile: plan again from what it says.
    #[error("{robot_id} was heard meanwhile")]
    Heard {
        /// Which robot.
        robot_id: RobotId,
    },
    /// A service tried to write what another one owns. A defect of the caller.
    #[error("{} may not write {owned}", writer.as_str())]
    NotTheWriter {
        /// Who tried.
        writer: Writer,
        /// Name of the table or log.
        owned: &'static str,
    },
    /// More rows, facts or bytes than one item may hold, or an id over [`ID_BYTES_MAX`].
    #[error(
        "item over its limit of {} rows or {} bytes, or an id over {ID_BYTES_MAX}",
        limits::ITEM_ROWS_MAX,
        limits::GROUP_COMMIT_BYTES
    )]
    TooLarge,
    /// A NUL byte in a text. A defect of the caller: JSON writes it as an escape, and ids never have one.
    #[error("item has a NUL byte in a text")]
    NulByte,
    /// A row named twice in one item. A defect of the caller.
    #[error("row {key:?} is named twice in one item")]
    DuplicateKey {
        /// The row.
        key: Key,
    },
    /// Nobody knows whether it was applied: read before you act again.
    #[error("commit outcome unknown")]
    Unknown(#[source] Cause),
    /// It was not applied; the store cannot write now.
    #[error("store unavailable")]
    Unavailable(#[source] Cause),
}

impl CommitError {
    /// The same item will be refused whenever it is committed.
    pub const fn is_final(&self) -> bool {
        matches!(self, Self::NotTheWriter { .. } | Self::TooLarge | Self::NulByte | Self::DuplicateKey { .. })
    }
}

/// An item that was applied.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Applied {
    /// Number of its last entry; of the newest entry of the store if it wrote none.
    pub seq: Seq,
    /// Revision of every row it put, in the item's order. Deleted and kept rows are left out.
    pub revisions: Vec<(Key, Revision)>,
}

/// Position of a row in a list.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cursor {
    /// Its sort key; rows without one come before all others.
    pub order: i64,
    /// Its id.
    pub id: Arc<str>,
}

impl Cursor {
    /// Where `row` stands.
    pub fn of_row(row: &Row) -> Self {
        Self { order: row.index.order.unwrap_or(i64::MIN), id: row.key.id.clone() }
    }
}

/// Which rows of one table to list. Sorted by (order, id), or by id alone where the beginning of the id is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Query {
    /// The table.
    pub table: Table,
    /// Only rows in one of these states; empty = any.
    pub states: Vec<i64>,
    /// Only rows of this owner.
    pub parent: Option<Arc<str>>,
    /// Only rows whose id begins with this, read as a range of the key. None: any.
    pub id_prefix: Option<Arc<str>>,
    /// Only rows behind this one, in the direction of the list.
    pub after: Option<Cursor>,
    /// From the highest order downwards.
    pub newest_first: bool,
    /// At most so many rows; never more than [`limits::PAGE_MAX`].
    pub limit: usize,
}

impl Query {
    /// The first page of all rows of `table`, lowest order first.
    pub fn all(table: Table) -> Self {
        Self {
            table,
            states: Vec::new(),
            parent: None,
            id_prefix: None,
            after: None,
            newest_first: false,
            limit: limits::PAGE_MAX,
        }
    }
    /// Only rows of `parent`.
    #[must_use]
    pub fn of_parent(mut self, parent: impl AsRef<str>) -> Self {
        self.parent = Some(Arc::from(parent.as_ref()));
        self
    }
    /// Only rows in one of `states`.
    #[must_use]
    pub fn in_states(mut self, states: impl IntoIterator<Item = i64>) -> Self {
        self.states = states.into_iter().collect();
        self
    }
    /// Only rows whose id begins with `prefix`, by id.
    #[must_use]
    pub fn of_prefix(mut self, prefix: impl AsRef<str>) -> Self {
        self.id_prefix = Some(Arc::from(prefix.as_ref()));
        self
    }
    /// The first text behind all that begin with the prefix; none: there is no prefix, or nothing is behind it.
    pub(crate) fn behind_prefix(&self) -> Option<String> {
        let mut behind = self.id_prefix.as_deref()?.to_owned();
        while let Some(last) = behind.pop() {
            // Ids are ordered by their bytes, and UTF-8 keeps the order of characters.
            if let Some(next) = (last..=char::MAX).nth(1) {
                behind.push(next);
                return Some(behind);
            }
        }
        None
    }
    pub(crate) fn rows_max(&self) -> usize {
        self.limit.min(limits::PAGE_MAX)
    }
}

/// Rows of some tables, all at one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// The moment: everything up to this entry is in, nothing after it. The feed goes on from here.
    pub seq: Seq,
    /// The rows, sorted by key.
    pub rows: Vec<Row>,
}

/// A stretch of the feed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FeedPage {
    /// Entries in commit order.
    pub entries: Vec<Entry>,
    /// The cursor to go on from. It may stand inside a commit; nothing is lost by that.
    pub next: Seq,
    /// Newest entry of the store, of whatever log. `next == head`: the reader is up to date.
    pub head: Seq,
}

/// Which entries of the logs are kept. An entry goes when it is too old *or* too many, but never past `floor`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retention {
    /// Entries committed before this moment may go, UTC unix ms.
    pub before_unix_ms: i64,
    /// Entries a log keeps at most.
    pub entries_max: u64,
    /// Position of the slowest consumer: nothing after it goes.
    pub floor: Seq,
}

/// The memory that services share. All its calls may be made from many tasks at once.
#[async_trait]
pub trait Store: Send + Sync + 'static {
    /// Which store this is. Constant while it is open.
    fn id(&self) -> &StoreId;
    /// The site whose rows these are; it is in every key.
    fn site_id(&self) -> &SiteId;
    /// Whether other processes may write to it too while it is open.
    fn is_shared(&self) -> bool;
    /// Applies items in order, each for itself; results in the same order. Returns after the fsync that holds them. A later
    /// item may expect the revision that an earlier one writes. Dropping the future takes nothing back.
    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>>;
    /// The rows of `keys` that exist, in the order of `keys`. At most [`GET_KEYS_MAX`].
    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error>;
    /// One page of a table.
    async fn list(&self, query: Query) -> Result<Vec<Row>, Error>;
    /// Rows of `parts`, and those that they name, all at one moment. Costs what these rows cost, whatever else the tables hold.
    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error>;
    /// Tables whole, at one moment: of tables that are small.
    async fn snapshot(&self, tables: &[Table]) -> Result<Snapshot, Error> {
        let parts: Vec<RowSelection> = tables.iter().map(|table| RowSelection::Whole(*table)).collect();
        self.read(&parts, |_| Vec::new()).await
    }
    /// Entries of `logs` after a cursor, in commit order, without holes.
    ///
    /// # Errors
    /// [`Error::CursorExpired`] if entries after the cursor are gone, or the cursor is ahead of the store.
    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error>;
    /// Entries about some subjects alone; like [`Store::feed`] otherwise.
    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error>;
    /// A hint: the newest number committed. May skip values, never the last one. Carries no data; read the feed.
    fn wake(&self) -> watch::Receiver<Seq>;
    /// Makes the next number higher than `at_least`: someone has seen a number that this store never gave (it was restored
    /// from an old backup). Returns the head; a number above [`SEQ_PLAUSIBLE_MAX`] is refused.
    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error>;
    /// The newest row of each chain of the audit that has rows, as it was noted when that row was written.
    async fn audit_heads(&self) -> Result<BTreeMap<Writer, Head>, Error>;
    /// Takes old entries out of the logs, in small slices that let commits pass. Returns how many went.
    async fn prune(&self, keep: Retention) -> Result<u64, Error>;
}

/// Subjects whose entries can be asked for: those that an index serves.
#[derive(Clone, Copy, Debug)]
pub enum Subjects<'a> {
    /// What robots of these ids said, in their inbox.
    Robots(&'a [Arc<str>]),
    /// Changes of request ids.
    RequestKeys(&'a [Arc<str>]),
    /// Changes of attempts.
    Attempts(&'a [Arc<str>]),
}

/// Entries of a feed that are wanted.
pub(crate) struct Wanted {
    pub(crate) logs: BTreeSet<Log>,
    /// Ids of subjects, and the table whose changes are meant; no table: facts. None: all entries.
    pub(crate) about: Option<(Option<Table>, BTreeSet<Arc<str>>)>,
}

impl Wanted {
    pub(crate) fn from_logs(logs: &[Log]) -> Self {
        Self { logs: logs.iter().copied().collect(), about: None }
    }
    pub(crate) fn from_subjects(subjects: Subjects<'_>) -> Result<Self, Error> {
        let (log, table, ids) = match subjects {
            Subjects::Robots(ids) => (Log::RobotInbox, None, ids),
            Subjects::RequestKeys(ids) => (Log::Task, Some(Table::RequestKey), ids),
            Subjects::Attempts(ids) => (Log::Fleet, Some(Table::Attempt), ids),
        };
        if ids.len() > GET_KEYS_MAX {
            return Err(Error::TooManyKeys { asked: ids.len() });
        }
        Ok(Self { logs: BTreeSet::from([log]), about: Some((table, ids.iter().cloned().collect())) })
    }
    pub(crate) fn holds(&self, entry: &Entry) -> bool {
        let is_about =
            |(table, ids): &(Option<Table>, BTreeSet<_>)| entry.table == *table && ids.contains(&entry.subject);
        self.logs.contains(&entry.log) && self.about.as_ref().is_none_or(is_about)
    }
}

/// A page of at most `limit` entries; a short one means that there are no more up to `head`.
pub(crate) fn page_of(mut entries: Vec<Entry>, limit: usize, head: Seq) -> FeedPage {
    entries.truncate(limit);
    let next = match entries.last() {
        Some(last) if entries.len() == limit => last.seq,
        _ => head,
    };
    FeedPage { entries, next, head }
}

/// Reads one record with its revision.
///
/// # Errors
/// As [`Store::get`]; [`Error::BadRow`] if the row does not decode.
pub async fn load<R: Record>(store: &dyn Store, id: &str) -> Result<Option<(R, Revision)>, Error> {
    Ok(find_record(&store.get(vec![Key::new(R::TABLE, id)]).await?)?)
}

/// The first record of its kind among rows that were read together, with its revision.
///
/// # Errors
/// The row does not decode.
pub fn find_record<R: Record>(rows: &[Row]) -> Result<Option<(R, Revision)>, BadRow> {
    let row = rows.iter().find(|row| row.key.table == R::TABLE);
    row.map(|row| Ok((row.decode()?, row.revision))).transpose()
}

/// Hands over what `logs` hold after `cursor`, page by page to their head, and moves the cursor with each page. A cursor that never read
/// anything begins at the oldest entry that is kept.
///
/// # Errors
/// As [`Store::feed`].
pub async fn follow(
    store: &dyn Store,
    cursor: &mut Seq,
    logs: &[Log],
    mut take: impl FnMut(&[Entry]),
) -> Result<(), Error> {
    loop {
        let page = match store.feed(*cursor, logs, FEED_PAGE_MAX).await {
            Err(Error::CursorExpired { asked, oldest }) if asked < oldest && *cursor == Seq(0) => {
                *cursor = oldest;
                continue;
            }
            page => page?,
        };
        take(&page.entries);
        *cursor = page.next;
        if page.next >= page.head {
            return Ok(());
        }
    }
}
