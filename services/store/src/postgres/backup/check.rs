//! What is wrong with a copy, found without a database: the format of its files, the kinds of its columns, its counts, and its numbers.

use super::copied::{PostgresCopy, SCHEMAS, file};
use super::tables::{Column, Kind, TableShape, tables};
use crate::postgres::connect::{CONTROL_SCHEMA, TELEMETRY_SCHEMA};
use midshift_core::rows::Log;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

/// How a file begins: PostgreSQL's mark, then no flags and no extension.
const BEGIN: &[u8] = b"PGCOPY\n\xff\r\n\0\0\0\0\0\0\0\0\0";
/// A field has at most so many bytes: 64 times what one commit may have.
const FIELD_BYTES_MAX: u64 = 64 << 20;
/// What a row that ends the file says of its columns.
const END: i16 = -1;

/// What a file holds.
#[derive(Debug, Default, PartialEq, Eq)]
struct Found {
    rows: u64,
    /// Highest number in each column of numbers.
    highest: BTreeMap<&'static str, i64>,
}

/// By schema and name.
type Tables = BTreeMap<(&'static str, &'static str), Found>;

impl PostgresCopy {
    /// What is wrong with the files of a copy in `folder`; nothing: a database can be made of it. Blocks.
    pub fn check(&self, folder: &Path) -> Vec<String> {
        let mut wrong = Vec::new();
        let mut found: Tables = BTreeMap::new();
        for (schema, migrations) in SCHEMAS {
            let (version, known) = (self.version(schema), migrations.len());
            let Some(made) = migrations.get(..version as usize) else {
                wrong.push(format!("schema {schema} is {version}, this release knows {known}: use the newer release"));
                continue;
            };
            if made.is_empty() {
                wrong.push(format!("schema {schema} was not copied"));
                continue;
            }
            let shapes = tables(schema, made);
            let counted = self.schemas.get(schema).map(|copied| &copied.tables);
            let strange = counted.into_iter().flat_map(BTreeMap::keys);
            let strange = strange.filter(|name| shapes.iter().all(|table| table.name != name.as_str()));
            wrong.extend(strange.map(|name| format!("schema {schema} {version} has no table {name}")));
            for table in &shapes {
                let name = format!("{schema}.{}", table.name);
                let Some(copied) = counted.and_then(|tables| tables.get(table.name)) else {
                    wrong.push(format!("{name} was not copied"));
                    continue;
                };
                match File::open(file(folder, table)).and_then(|file| read(table, BufReader::new(file))) {
                    Ok(read) if read.rows != *copied => {
                        wrong.push(format!("{name} has {} rows, {copied} were copied", read.rows));
                    }
                    Ok(read) => drop(found.insert((schema, table.name), read)),
                    Err(error) => wrong.push(format!("{name}: {error}")),
                }
            }
        }
        wrong.extend(self.behind(&found));
        wrong
    }

    /// Heads that are behind a number which was given: it would be given again.
    fn behind(&self, found: &Tables) -> Vec<String> {
        let highest = |schema: &'static str, table: &'static str, column: &'static str| {
            found.get(&(schema, table))?.highest.get(column).copied()
        };
        let mut wrong = Vec::new();
        type Of = (&'static str, &'static str);
        let mut judge = |schema: &'static str, (head, of): Of, (table, column): Of| {
            if !found.contains_key(&(schema, head)) {
                return;
            }
            let (Some(given), head_at) = (highest(schema, table, column), highest(schema, head, of)) else { return };
            if head_at.is_none_or(|head_at| head_at < given) {
                wrong.push(format!(
                    "{schema}.{table} has number {given}, and {schema}.{head} is at {}",
                    head_at.unwrap_or(0)
                ));
            }
        };
        for log in Log::ALL {
            judge(CONTROL_SCHEMA, ("store_head", "seq"), (log.name(), "seq"));
        }
        judge(CONTROL_SCHEMA, ("robot_last_head", "position"), ("robot_last", "position"));
        judge(TELEMETRY_SCHEMA, ("frame_head", "marked_position"), ("frame_log", "position"));
        let head = highest(CONTROL_SCHEMA, "store_head", "seq");
        let heads = found.get(&(CONTROL_SCHEMA, "store_head")).map(|found| found.rows);
        if heads.is_some_and(|rows| rows != 1) || head.is_some_and(|head| head.cast_unsigned() != self.head.0) {
            wrong.push(format!("{CONTROL_SCHEMA}.store_head is not the one row at {} that was copied", self.head.0));
        }
        wrong
    }
}

fn bad(text: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, text)
}

/// Reads all rows of a table. Holds one field at a time.
fn read(table: &TableShape, mut source: impl Read) -> io::Result<Found> {
    let mut begin = [0; BEGIN.len()];
    if source.read_exact(&mut begin).is_err() || begin != BEGIN {
        return Err(bad("it is no copy of PostgreSQL"));
    }
    let (mut found, mut field) = (Found::default(), Vec::new());
    loop {
        let row = found.rows + 1;
        let mut count = [0; 2];
        source.read_exact(&mut count).map_err(|_| bad(&format!("it ends before row {row}")))?;
        match i16::from_be_bytes(count) {
            END => break,
            count if usize::try_from(count) == Ok(table.columns.len()) => {}
            count => return Err(bad(&format!("row {row} has {count} columns, not {}", table.columns.len()))),
        }
        for column in &table.columns {
            let at = |error: io::Error| bad(&format!("row {row}, column {}: {error}", column.name));
            if !next_field(&mut source, &mut field).map_err(at)? {
                if !column.is_nullable {
                    return Err(at(bad("nothing is there")));
                }
            } else if let Some(number) = value(column, &field).map_err(at)? {
                let highest = found.highest.entry(column.name).or_insert(number);
                *highest = number.max(*highest);
            }
        }
        found.rows = row;
    }
    match source.read(&mut [0])? {
        0 => Ok(found),
        _ => Err(bad("something is behind its end")),
    }
}

/// Reads one field; false: it is null.
fn next_field(source: &mut impl Read, field: &mut Vec<u8>) -> io::Result<bool> {
    let mut length = [0; 4];
    source.read_exact(&mut length).map_err(|_| bad("the file ends"))?;
    let length = i32::from_be_bytes(length);
    field.clear();
    let Ok(length) = u64::try_from(length) else {
        return if length == -1 { Ok(false) } else { Err(bad("its length is negative")) };
    };
    if length > FIELD_BYTES_MAX {
        return Err(bad("it is too large"));
    }
    if source.take(length).read_to_end(field)? as u64 != length {
        return Err(bad("the file ends"));
    }
    Ok(true)
}

/// Its number, if it is one.
fn value(column: &Column, field: &[u8]) -> io::Result<Option<i64>> {
    match column.kind {
        Kind::Bytes => Ok(None),
        Kind::Number => {
            field.try_into().map(|bytes| Some(i64::from_be_bytes(bytes))).map_err(|_| bad("it is no bigint"))
        }
        Kind::Text if field.contains(&0) => Err(bad("it has a NUL byte")),
        Kind::Text => std::str::from_utf8(field).map(|_| None).map_err(|_| bad("it is no UTF-8")),
    }
}
