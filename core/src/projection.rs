//! Rows as a service's projection of them, and one decision being written into both the projection and an item of a commit.
//!
//! Called by `fleet` and `rollout`. Invariants: a row in a projection is at the revision it has in the store, or one that
//! an item of the running cycle will write; a row written twice in one decision stands in its item once, with the first
//! expectation and the last body.

use crate::audit::Note;
use crate::identity::Actor;
use crate::ids::RobotId;
use crate::item::{Expect, Fact, Item, RowChange, Silent, Write};
use crate::reason::Reason;
use crate::rows::{BadRow, Entry, Key, Log, Record, Revision, Row, Table, Writer};
use crate::time::Now;
use crate::unknown_rows::UnknownRows;
use smol_str::SmolStr;
use std::collections::{BTreeMap, BTreeSet};

/// A row of a projection, with its revision.
#[derive(Clone, Debug, PartialEq)]
pub struct RevisedRow<R> {
    /// Writes so far.
    pub revision: Revision,
    /// The row.
    pub row: R,
}

/// Rows of one table by id.
pub type RowMap<R> = BTreeMap<SmolStr, RevisedRow<R>>;

/// A projection: what one service knows of the rows.
pub trait Projection: 'static {
    /// Who decides on it.
    const WRITER: Writer;
    /// Rows with a value of a newer version, which stand aside.
    fn unknown_rows(&mut self) -> &mut UnknownRows;
}

/// A record that a projection keeps.
pub trait Projected<P: Projection>: Record {
    /// The rows of this record in the projection.
    fn rows(projection: &mut P) -> &mut RowMap<Self>;
    /// What else changes with it: indices and what must be looked at again. Called after the rows changed.
    fn changed(_projection: &mut P, _id: &str, _old: Option<&Self>) {}
}

/// Applies one row of the store to the projection; none: the row is deleted. An older revision is passed over. A row with
/// a value that this build does not know is kept aside.
///
/// # Errors
/// A body that is damaged.
pub fn apply_row<P: Projection, R: Projected<P>>(
    projection: &mut P,
    id: &str,
    revision: Revision,
    row: Option<&Row>,
) -> Result<(), BadRow> {
    let key = Key::new(R::TABLE, id);
    let is_known = R::rows(projection).get(id).is_some_and(|known| known.revision >= revision);
    if is_known || projection.unknown_rows().has(&key, revision) {
        return Ok(());
    }
    projection.unknown_rows().forget(&key);
    let old = match row.map(|row| (row, row.decode())) {
        Some((_, Ok(row))) => R::rows(projection).insert(id.into(), RevisedRow { revision, row }),
        Some((row, Err(error))) if error.is_unknown() => {
            projection.unknown_rows().keep_aside(row, &error);
            R::rows(projection).remove(id)
        }
        Some((_, Err(error))) => return Err(error),
        None => R::rows(projection).remove(id),
    };
    R::changed(projection, id, old.as_ref().map(|r| &r.row));
    Ok(())
}

/// Rows that an item touches, each once.
pub fn touched(items: &[Item]) -> Vec<Key> {
    let keys: BTreeSet<&Key> = items.iter().flat_map(|item| &item.rows).map(|row| &row.key).collect();
    keys.into_iter().cloned().collect()
}

/// Entries that an item leaves in the log of its writer and the inbox once it is applied.
pub fn entries_of(item: &Item) -> u64 {
    let tells_marks = item.tells_marks();
    let rows = item.rows.iter().filter(|row| row.is_told(tells_marks)).count();
    (rows + item.facts.len()) as u64
}

/// The one row of a table that an item puts; none if it puts none.
pub fn written<R: Record>(item: &Item) -> Option<R> {
    let row = item.rows.iter().find(|row| row.key.table == R::TABLE)?;
    let Write::Put { body, .. } = &row.write else { return None };
    serde_json::from_str(body).ok()
}

/// What happens to the first row of an item.
pub fn kind_of(item: &Item) -> &'static str {
    item.rows.first().map_or("", |row| row.kind)
}

/// Identifies a decision by its kind and the keys of its rows. Marks, clocks and incidents do not count: they are others
/// each time.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct DecisionKey {
    /// What happens to its first row.
    pub kind: &'static str,
    /// Its rows, in order.
    pub keys: Vec<Key>,
}

impl DecisionKey {
    /// The key of the decision that an item carries out.
    pub fn from_item(item: &Item) -> Self {
        Self::new(kind_of(item), item.rows.iter().map(|row| &row.key))
    }
    /// The key of a decision of this kind on these rows.
    pub fn new<'a>(kind: &'static str, keys: impl Iterator<Item = &'a Key>) -> Self {
        let is_fixed = |key: &&Key| !matches!(key.table, Table::FleetMark | Table::ServiceClock | Table::Incident);
        let mut keys: Vec<Key> = keys.filter(is_fixed).cloned().collect();
        keys.sort();
        Self { kind, keys }
    }
}

/// Puts a row of a projection back to what it was.
fn put_back<P: Projection, R: Projected<P>>(projection: &mut P, id: &str, old: Option<RevisedRow<R>>) {
    let was = match old {
        Some(old) => R::rows(projection).insert(id.into(), old),
        None => R::rows(projection).remove(id),
    };
    R::changed(projection, id, was.as_ref().map(|r| &r.row));
}

/// Brings one row of a projection back to what it was.
type Undo<P> = Box<dyn FnOnce(&mut P) + Send>;

/// A decision under way.
pub struct Tx<'a, P: Projection> {
    /// The projection it is made on.
    pub view: &'a mut P,
    /// When it is made.
    pub now: Now,
    item: Item,
    at: BTreeMap<Key, usize>,
    /// What brings the projection back to before it, newest last.
    undo: Vec<Undo<P>>,
}

impl<'a, P: Projection> Tx<'a, P> {
    /// Begins a decision on behalf of `actor`.
    pub fn new(view: &'a mut P, now: Now, actor: impl Into<Actor>) -> Self {
        Self { view, now, item: Item::new(P::WRITER, actor), at: BTreeMap::new(), undo: Vec::new() }
    }
    /// Notes the request behind it.
    pub fn on_request(mut self, request_id: Option<&str>) -> Self {
        self.item.request_id = request_id.map(Into::into);
        self
    }
    /// Rows written so far.
    pub fn rows(&self) -> usize {
        self.item.rows.len()
    }
    /// Creates or changes a row.
    pub fn put_row<R: Projected<P>>(&mut self, record: R, kind: &'static str) {
        let key = record.key();
        let known = R::rows(self.view).get(&*key.id).map_or(Revision(0), |r| r.revision);
        let write = Write::Put { index: record.index(), body: record.body() };
        let revision = match self.note(key.clone(), known, write, kind) {
            Expect::Absent => Revision(1),
            Expect::At(known) => known.next(),
        };
        let old = R::rows(self.view).insert((&*key.id).into(), RevisedRow { revision, row: record });
        R::changed(self.view, &key.id, old.as_ref().map(|r| &r.row));
        self.undo.push(Box::new(move |view| put_back::<P, R>(view, &key.id, old)));
    }
    /// Guards a row that is only relied upon: if somebody else changes it first, this decision is not made.
    pub fn rely<R: Projected<P>>(&mut self, id: &str) {
        let key = Key::new(R::TABLE, id);
        if self.at.contains_key(&key) {
            return;
        }
        let known = R::rows(self.view).get(id).map(|r| r.revision);
        self.at.insert(key.clone(), self.item.rows.len());
        self.item.keep_row(key, known.map_or(Expect::Absent, Expect::At));
    }
    /// Guards the silence of a robot: if anybody hears it first, this decision is not made.
    pub fn rely_on_silence(&mut self, robot_id: &RobotId) {
        self.item.silent = Some(Silent { robot_id: robot_id.clone(), position: 0 });
    }
    /// Leaves this in the audit.
    pub fn audit(&mut self, note: Note) {
        self.item.audit(note);
    }
    /// States a fact beside the rows.
    pub fn add_fact(&mut self, subject: &str, kind: &'static str, body: &impl serde::Serialize) {
        let body = serde_json::to_string(body).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        self.item.facts.push(Fact { log: Log::of_writer(P::WRITER), subject: subject.into(), kind, body: body.into() });
    }
    /// Deletes a row, if there is one.
    pub fn delete<R: Projected<P>>(&mut self, id: &str, kind: &'static str) {
        let Some(old) = R::rows(self.view).remove(id) else { return };
        self.note(Key::new(R::TABLE, id), old.revision, Write::Delete, kind);
        R::changed(self.view, id, Some(&old.row));
        let id = id.to_owned();
        self.undo.push(Box::new(move |view| put_back::<P, R>(view, &id, Some(old))));
    }
    /// Writes `write`, and says what the row is expected to be before this decision.
    fn note(&mut self, key: Key, known: Revision, write: Write, kind: &'static str) -> Expect {
        if let Some(&i) = self.at.get(&key) {
            let row = &mut self.item.rows[i];
            row.write = match (row.expect, write) {
                (Expect::Absent, Write::Delete) => Write::Keep,
                (_, write) => write,
            };
            row.kind = kind;
            return row.expect;
        }
        let expect = if known == Revision(0) { Expect::Absent } else { Expect::At(known) };
        self.at.insert(key.clone(), self.item.rows.len());
        self.item.rows.push(RowChange { key, expect, write, kind });
        expect
    }
    /// The key of this decision.
    pub fn decision_key(&self) -> DecisionKey {
        DecisionKey::from_item(&self.item)
    }
    /// Why it is not decided: it touches a row that is kept aside.
    pub fn unknown_row(&mut self) -> Option<Reason> {
        let rows = self.item.rows.iter().map(|row| &row.key);
        self.view.unknown_rows().refusal_of(rows).cloned()
    }
    /// Whether it is larger than any store takes.
    pub fn is_too_large(&self) -> bool {
        self.item.is_too_large()
    }
    /// Gives the decision up: the rows of the projection are as they were before it.
    pub fn take_back(self) -> &'a mut P {
        for undo in self.undo.into_iter().rev() {
            undo(self.view);
        }
        self.view
    }
    /// The item, if the decision changed anything. Attempts stand before all else in it: whoever follows the feed knows
    /// the attempt when the change of its task comes.
    pub fn finish(mut self) -> Option<Item> {
        self.item.rows.sort_by_key(|row| row.key.table != Table::Attempt);
        (!self.item.is_empty()).then_some(self.item)
    }
}

/// What a projection derives from the rows of one table.
pub trait Indexed<R>: Sized {
    /// A row of it changed: brings what is derived from it up to date. Called after the change.
    fn changed(projection: &mut Self, id: &str, old: Option<&R>);
}

/// The projection of a service, with one line for each table: the field, its record, its table, and `Indexed` where
/// something is derived from it. It makes the struct, `new`, `WHOLE`, `carry_over`, and the ways of rows into it.
///
/// 1. `whole`: tables that hold only what is there now, or that are bounded by count. They are read whole, in this
///    order.
/// 2. `part`: tables of which it holds what something names.
/// 3. `kept`: what only this process knows, and what a rebuild leaves alone.
/// 4. `anew`: what begins anew with each reading of the rows.
macro_rules! projection {
    (
        $(#[$about:meta])*
        pub struct $name:ident of $writer:ident;
        new($($arg:ident: $arg_type:ty),*);
        whole {
            $($(#[$whole_doc:meta])* $whole:ident: $whole_record:ident = $whole_table:ident $($whole_index:ident)?;)*
        }
        part { $($(#[$part_doc:meta])* $part:ident: $part_record:ident = $part_table:ident $($part_index:ident)?;)* }
        kept { $($(#[$kept_doc:meta])* $kept:ident: $kept_type:ty = $kept_begin:expr;)* }
        anew { $($(#[$anew_doc:meta])* $anew:ident: $anew_type:ty = $anew_begin:expr;)* }
    ) => {
        $(#[$about])*
        pub struct $name {
            $($(#[$whole_doc])* pub $whole: $crate::projection::RowMap<$whole_record>,)*
            $($(#[$part_doc])* pub $part: $crate::projection::RowMap<$part_record>,)*
            $($(#[$kept_doc])* pub $kept: $kept_type,)*
            $($(#[$anew_doc])* pub $anew: $anew_type,)*
        }

        impl $name {
            /// Tables that are read whole.
            pub const WHOLE: &'static [$crate::rows::Table] = &[$($crate::rows::Table::$whole_table),*];

            /// An empty projection of the site. `started`: when the service began; `read`: when its rows are read.
            pub fn new($($arg: $arg_type),*) -> Self {
                Self {
                    $($whole: $crate::projection::RowMap::new(),)*
                    $($part: $crate::projection::RowMap::new(),)*
                    $($kept: $kept_begin,)*
                    $($anew: $anew_begin,)*
                }
            }

            /// Takes over what only this process knows from the projection before it, ahead of the rows.
            pub fn carry_over(&mut self, before: &mut Self) {
                $(std::mem::swap(&mut self.$kept, &mut before.$kept);)*
            }

            /// Whether it has the row.
            pub fn has_row(&self, key: &$crate::rows::Key) -> bool {
                match key.table {
                    $($crate::rows::Table::$whole_table => self.$whole.contains_key(&*key.id),)*
                    $($crate::rows::Table::$part_table => self.$part.contains_key(&*key.id),)*
                    _ => false,
                }
            }

            /// Takes one row as the store has it; none: deleted. What the projection already has is passed over.
            ///
            /// # Errors
            /// A body that is not what its table holds.
            pub fn take_row(
                &mut self,
                key: &$crate::rows::Key,
                revision: $crate::rows::Revision,
                row: Option<&$crate::rows::Row>,
            ) -> Result<(), $crate::rows::BadRow> {
                use $crate::projection::apply_row;
                match key.table {
                    $($crate::rows::Table::$whole_table => apply_row::<Self, $whole_record>(self, &key.id, revision, row),)*
                    $($crate::rows::Table::$part_table => apply_row::<Self, $part_record>(self, &key.id, revision, row),)*
                    _ => Ok(()),
                }
            }
        }

        impl $crate::projection::Projection for $name {
            const WRITER: $crate::rows::Writer = $crate::rows::Writer::$writer;
            fn unknown_rows(&mut self) -> &mut $crate::unknown_rows::UnknownRows {
                &mut self.unknown_rows
            }
        }

        $($crate::projection::viewed!($name $whole $whole_record $($whole_index)?);)*
        $($crate::projection::viewed!($name $part $part_record $($part_index)?);)*
    };
}
pub(crate) use projection;

/// Says which field of a projection keeps a record, and whether something is derived from it.
macro_rules! viewed {
    ($name:ident $rows:ident $record:ident $($index:ident)?) => {
        impl $crate::projection::Projected<$name> for $record {
            fn rows(projection: &mut $name) -> &mut $crate::projection::RowMap<Self> {
                &mut projection.$rows
            }
            $(fn changed(projection: &mut $name, id: &str, old: Option<&Self>) {
                <$name as $index<Self>>::changed(projection, id, old);
            })?
        }
    };
}
pub(crate) use viewed;

/// A row as a projection takes it, from an entry of a log.
pub fn row_of(entry: &Entry, table: Table) -> Option<Row> {
    let key = Key { table, id: entry.subject.clone() };
    entry.body.clone().map(|body| Row { key, revision: entry.revision, index: entry.index.clone(), body })
}
