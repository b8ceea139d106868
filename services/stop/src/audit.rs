//! The audit of stops: one line a record, each with the hash of the one before it, durable before the answer when the disk lets it be.
//!
//! A hash is SHA-256 over the line up to `,"hash":`, which has the hash of the line before it as `prev`. So a line of a
//! newer version, with a word or a field more, holds here too.
//!
//! Invariant: nothing of it is ever changed or taken away by the service; where it had to leave records out it says how many. The hash of the last
//! record is also kept in the latch file, so that a file whose end was cut off shows. Called by the one writer of the folder, and by `verify`.

use midshift_core::identity::Actor;
use midshift_core::time::Utc;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Its name in the folder.
pub const NAME: &str = "audit.jsonl";
/// What the first record has for the hash before it.
const FIRST_PREV: &str = "0000000000000000000000000000000000000000000000000000000000000000";
/// Bytes of a line at most: a request of 64 KiB is refused long before.
const LINE_BYTES_MAX: u64 = 64 * 1024;

/// What was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Action {
    /// The service began.
    Started,
    /// Another process is ready to follow this one.
    Followed,
    /// A stop was engaged.
    Engaged,
    /// A stop was reset.
    Reset,
    /// A stop of the service's own making that it had lost was taken from a robot.
    Adopted,
    /// The latch could not be read: everything was stopped.
    LatchLost,
    /// The key could not be read: stops that robots bring back are not known again.
    KeyLost,
    /// The end of this file was gone or not whole.
    AuditLost,
    /// Somebody asked for what it may not.
    Denied,
    /// Records were left out, because the disk refused them and memory for them is limited.
    Dropped,
}

/// What is to be written.
#[derive(Clone, Debug)]
pub struct Note {
    /// When, UTC of the wall.
    pub at: Utc,
    /// The actor that did it, by name.
    pub actor: String,
    /// What was done.
    pub action: Action,
    /// Ids, levels, reasons.
    pub fields: BTreeMap<String, String>,
}

/// Field of the token that was shown.
const TOKEN: &str = "token_id";
/// What the service does by itself is done under this name.
pub const MIDSHIFT: &str = "midshift";

impl Note {
    /// Of the service itself.
    pub fn own(at: Utc, action: Action) -> Self {
        Self { at, actor: MIDSHIFT.to_owned(), action, fields: BTreeMap::new() }
    }
    /// Of somebody, with the token that was shown.
    pub fn by_actor(at: Utc, action: Action, by: &Actor) -> Self {
        let note = Self { actor: by.to_string(), ..Self::own(at, action) };
        by.token().iter().fold(note, |note, token| note.with(TOKEN, token))
    }
    /// With one more field.
    pub fn with(mut self, name: &str, value: impl ToString) -> Self {
        self.fields.insert(name.to_owned(), value.to_string());
        self
    }
}

/// One record as it is written, but for its hash.
#[derive(Serialize)]
struct Record<'n> {
    n: u64,
    at_unix_ms: i64,
    actor: &'n str,
    action: Action,
    fields: &'n BTreeMap<String, String>,
    prev: &'n str,
}

/// What of a record chains it to the others. A newer version may say more in it than this one knows.
#[derive(Clone, Debug, Deserialize)]
struct Link {
    n: u64,
    prev: String,
    hash: String,
}

impl Link {
    /// The record of a line; none if it is not as it was written.
    fn read(line: &[u8]) -> Option<Self> {
        let link: Self = serde_json::from_slice(line).ok()?;
        let end = format!("{HASH}{}\"}}", link.hash);
        let hashed = line.strip_suffix(end.as_bytes())?;
        (link.hash == hash(hashed)).then_some(link)
    }
}

/// Between what is hashed and the hash.
const HASH: &str = ",\"hash\":\"";

/// SHA-256, hexadecimal.
fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::with_capacity(64), |mut hex, byte| {
        let _ = write!(hex, "{byte:02x}");
        hex
    })
}

/// The line of a record, and its hash.
fn line_of(record: &Record<'_>) -> (Vec<u8>, String) {
    // Text, numbers and maps of text: nothing that JSON cannot hold.
    let mut line = serde_json::to_vec(record).unwrap_or_else(|e| unreachable!("plain values: {e}"));
    line.pop();
    let hash = hash(&line);
    line.extend(format!("{HASH}{hash}\"}}\n").bytes());
    (line, hash)
}

/// The last record of an audit.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tail {
    /// Its number, from 1. 0: there is none.
    pub n: u64,
    /// Its hash. Empty: there is none.
    pub hash: String,
}

/// The file, open for its one writer.
#[derive(Debug)]
pub struct Audit {
    path: PathBuf,
    file: Option<File>,
    length: u64,
    tail: Tail,
}

impl Audit {
    /// Opens the file behind the record that the latch knows as the last. What is wrong with its end comes back as a note; a file that cannot be opened is
    /// tried again with each append.
    pub fn open(folder: &Path, known: Tail, now: Utc) -> (Self, Vec<Note>) {
        let mut audit = Self { path: folder.join(NAME), file: None, length: 0, tail: known };
        let notes = audit.reopen(now).unwrap_or_default();
        (audit, notes)
    }

    /// The last record that is durable.
    pub fn tail(&self) -> &Tail {
        &self.tail
    }

    fn reopen(&mut self, now: Utc) -> io::Result<Vec<Note>> {
        let mut options = OpenOptions::new();
        let file = options.read(true).write(true).create(true).truncate(false).mode(0o600).open(&self.path)?;
        let bytes = file.metadata()?.len();
        let (length, last) = last_line(&file, bytes)?;
        let mut notes = Vec::new();
        if length < bytes {
            // Nobody was answered for it: it is not whole.
            file.set_len(length)?;
            notes.push(Note::own(now, Action::AuditLost).with("bytes_not_whole", bytes - length));
        }
        let found = last.map(|r| Tail { n: r.n, hash: r.hash }).unwrap_or_default();
        if found.n < self.tail.n {
            notes.push(Note::own(now, Action::AuditLost).with("last", found.n).with("known", self.tail.n));
        } else {
            self.tail = found;
        }
        (self.length, self.file) = (length, Some(file));
        Ok(notes)
    }

    /// Appends records, all or none of them. Durable when this returns.
    pub fn append(&mut self, notes: &[Note], now: Utc) -> io::Result<()> {
        let mut found = Vec::new();
        if self.file.is_none() {
            found = self.reopen(now)?;
        }
        let Some(file) = &self.file else { return Err(io::ErrorKind::NotFound.into()) };
        let (mut bytes, mut tail) = (Vec::new(), self.tail.clone());
        for note in found.iter().chain(notes) {
            let prev = if tail.hash.is_empty() { FIRST_PREV } else { &tail.hash };
            let Note { at, actor, action, fields } = note;
            let (n, at_unix_ms) = (tail.n + 1, at.0);
            let (line, hash) = line_of(&Record { n, at_unix_ms, actor, action: *action, fields, prev });
            bytes.extend(line);
            tail = Tail { n, hash };
        }
        if let Err(error) = file.write_all_at(&bytes, self.length).and_then(|()| file.sync_data()) {
            // Making a file shorter needs no room.
            if file.set_len(self.length).is_err() {
                self.file = None;
            }
            return Err(error);
        }
        self.length += bytes.len() as u64;
        self.tail = tail;
        Ok(())
    }
}

/// Length up to the end of the last whole line, and its record.
fn last_line(file: &File, bytes: u64) -> io::Result<(u64, Option<Link>)> {
    let from = bytes.saturating_sub(2 * LINE_BYTES_MAX);
    let mut end = vec![0; (bytes - from) as usize];
    file.read_exact_at(&mut end, from)?;
    let Some(last) = end.iter().rposition(|b| *b == b'\n') else { return Ok((from, None)) };
    let line = end[..last].rsplit(|b| *b == b'\n').next().unwrap_or_default();
    Ok((from + last as u64 + 1, Link::read(line)))
}

/// What is wrong with an audit.
#[derive(Debug, thiserror::Error)]
pub enum Broken {
    /// It cannot be read.
    #[error("reading {path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The last record that should be there is not known.
    #[error("the latch file cannot be read, so nobody knows whether the end of the audit is there: {0}")]
    Latch(#[from] midshift_latch::Error),
    /// A line is not as it was written.
    #[error("line {line} was altered")]
    Altered {
        /// From 1.
        line: u64,
    },
    /// A record stands where another belongs.
    #[error("line {line} has record {found} where {expected} belongs: lines were taken away, put in or moved")]
    Order {
        /// From 1.
        line: u64,
        /// Which is there.
        found: u64,
        /// Which should be.
        expected: u64,
    },
    /// The last records are gone.
    #[error("it ends with record {last} and the latch knows of {known}: its end was cut off")]
    Truncated {
        /// The last that is there.
        last: u64,
        /// The last that should be.
        known: u64,
    },
    /// All lines hold together, and are not those that were written.
    #[error("record {n} is not the one that the latch knows: the lines were written anew")]
    Rewritten {
        /// Number of the record that the latch knows with another hash.
        n: u64,
    },
}

/// An audit that holds together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verified {
    /// How many records it has.
    pub records: u64,
    /// The hash of the last one; empty: there is none. Who notes it elsewhere can tell later whether the file still begins with these records.
    pub hash: String,
}

/// Reads a whole audit and the record that the latch knows as its last, also while the service runs.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn verify(folder: &Path, known: &Tail) -> Result<Verified, Broken> {
    let path = folder.join(NAME);
    let failed = |source| Broken::Io { path: path.clone(), source };
    let file = match File::open(&path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound && known.n == 0 => {
            return Ok(Verified { records: 0, hash: String::new() });
        }
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(Broken::Truncated { last: 0, known: known.n }),
        Err(e) => return Err(failed(e)),
    };
    let mut reader = BufReader::new(file);
    let (mut last, mut text) = (Tail::default(), Vec::new());
    loop {
        text.clear();
        let read = io::Read::take(&mut reader, LINE_BYTES_MAX).read_until(b'\n', &mut text).map_err(failed)?;
        // A last line that is not whole was never answered for; the service cuts it off when it begins.
        if read == 0 || (text.last() != Some(&b'\n') && reader.fill_buf().map_err(failed)?.is_empty()) {
            break;
        }
        let expected = last.n + 1;
        let line = text.strip_suffix(b"\n").unwrap_or(&text);
        let record = Link::read(line).ok_or(Broken::Altered { line: expected })?;
        if record.n != expected {
            return Err(Broken::Order { line: expected, found: record.n, expected });
        }
        let prev = if expected == 1 { FIRST_PREV } else { &last.hash };
        if record.prev != prev {
            return Err(Broken::Altered { line: expected });
        }
        if record.n == known.n && record.hash != known.hash {
            return Err(Broken::Rewritten { n: record.n });
        }
        last = Tail { n: record.n, hash: record.hash };
    }
    if last.n < known.n {
        return Err(Broken::Truncated { last: last.n, known: known.n });
    }
    Ok(Verified { records: last.n, hash: last.hash })
}

/// Moves what cannot be read out of the way, and keeps it.
pub fn set_aside(path: &Path, now: Utc) -> io::Result<PathBuf> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".broken-{}", now.0));
    let aside = path.with_file_name(name);
    midshift_durable::rename(path, &aside)?;
    Ok(aside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn notes(n: u64) -> Vec<Note> {
        (0..n).map(|i| Note::own(Utc(i as i64), Action::Engaged).with("stop_id", format!("STOP-{i}"))).collect()
    }

    fn written(folder: &Path, n: u64) -> Tail {
        let (mut audit, found) = Audit::open(folder, Tail::default(), Utc(0));
        assert!(found.is_empty());
        for note in notes(n) {
            audit.append(&[note], Utc(0)).unwrap();
        }
        audit.tail().clone()
    }

    fn lines(folder: &Path) -> Vec<String> {
        fs::read_to_string(folder.join(NAME)).unwrap().lines().map(str::to_owned).collect()
    }

    fn write(folder: &Path, lines: &[String]) {
        fs::write(folder.join(NAME), lines.iter().map(|l| format!("{l}\n")).collect::<String>()).unwrap();
    }

    #[test]
    fn what_was_written_holds_and_goes_on_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let tail = written(folder.path(), 3);
        let (mut audit, found) = Audit::open(folder.path(), tail.clone(), Utc(0));
        assert!(found.is_empty());
        audit.append(&notes(2), Utc(0)).unwrap();
        assert_eq!(verify(folder.path(), &tail).unwrap().records, 5);
        assert_eq!(verify(folder.path(), audit.tail()).unwrap().hash, audit.tail().hash);
    }

    #[test]
    fn a_line_that_is_altered_deleted_moved_doubled_or_cut_off_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let tail = written(folder.path(), 5);
        let good = lines(folder.path());
        let broken = |change: &dyn Fn(&mut Vec<String>)| {
            let mut lines = good.clone();
            change(&mut lines);
            write(folder.path(), &lines);
            verify(folder.path(), &tail).expect_err("it was tampered with")
        };
        assert!(matches!(broken(&|l| l[1] = l[1].replace("STOP-1", "STOP-9")), Broken::Altered { line: 2 }));
        assert!(matches!(broken(&|l| l[1] = l[1].replace("\"actor\"", " \"actor\"")), Broken::Altered { line: 2 }));
        assert!(matches!(broken(&|l| l[2] = "{}".to_owned()), Broken::Altered { line: 3 }));
        assert!(matches!(broken(&|l| drop(l.remove(0))), Broken::Order { line: 1, found: 2, expected: 1 }));
        assert!(matches!(broken(&|l| drop(l.remove(2))), Broken::Order { line: 3, found: 4, expected: 3 }));
        assert!(matches!(broken(&|l| l.swap(1, 2)), Broken::Order { line: 2, .. }));
        assert!(matches!(broken(&|l| l.insert(1, l[0].clone())), Broken::Order { line: 2, .. }));
        assert!(matches!(broken(&|l| l.truncate(4)), Broken::Truncated { last: 4, known: 5 }));
        assert!(matches!(broken(&|l| l.clear()), Broken::Truncated { last: 0, known: 5 }));
        fs::remove_file(folder.path().join(NAME)).unwrap();
        assert!(matches!(verify(folder.path(), &tail), Err(Broken::Truncated { last: 0, known: 5 })));
        written(folder.path(), 4);
        let (mut audit, _) = Audit::open(folder.path(), Tail::default(), Utc(0));
        audit.append(&[Note::own(Utc(0), Action::Started)], Utc(0)).unwrap();
        assert!(matches!(verify(folder.path(), &tail), Err(Broken::Rewritten { n: 5 })), "all lines anew");
        write(folder.path(), &good);
        assert_eq!(verify(folder.path(), &tail).unwrap().records, 5);
    }

    #[test]
    fn a_line_of_a_newer_version_holds_and_is_followed() {
        let folder = tempfile::tempdir().unwrap();
        let tail = written(folder.path(), 1);
        let text = format!("{{\"n\":2,\"action\":\"PRAISED\",\"more\":[7],\"prev\":\"{}\"", tail.hash);
        let line = format!("{text},\"hash\":\"{}\"}}", hash(text.as_bytes()));
        let good: Vec<String> = lines(folder.path()).into_iter().chain([line]).collect();
        write(folder.path(), &good);
        let (mut audit, found) = Audit::open(folder.path(), tail.clone(), Utc(0));
        assert!(found.is_empty(), "nothing is lost: {found:?}");
        audit.append(&notes(1), Utc(0)).unwrap();
        assert_eq!(verify(folder.path(), audit.tail()).unwrap().records, 3);
        write(folder.path(), &[good[0].clone(), good[1].replace("PRAISED", "BLAMED")]);
        assert!(matches!(verify(folder.path(), &tail), Err(Broken::Altered { line: 2 })));
    }

    #[test]
    fn a_line_that_was_cut_in_its_middle_is_said_and_the_next_one_follows_the_last_whole_one() {
        let folder = tempfile::tempdir().unwrap();
        let tail = written(folder.path(), 2);
        let path = folder.path().join(NAME);
        let mut text = fs::read(&path).unwrap();
        text.extend(b"{\"n\":3,\"at");
        fs::write(&path, text).unwrap();
        assert_eq!(verify(folder.path(), &tail).unwrap().records, 2, "nobody was answered for it");
        let (mut audit, found) = Audit::open(folder.path(), tail, Utc(0));
        assert_eq!(found[0].action, Action::AuditLost);
        audit.append(&found, Utc(0)).unwrap();
        assert_eq!(verify(folder.path(), audit.tail()).unwrap().records, 3);
    }

    #[test]
    fn an_end_that_is_gone_at_the_start_stays_visible_for_ever() {
        let folder = tempfile::tempdir().unwrap();
        let tail = written(folder.path(), 5);
        let good = lines(folder.path());
        write(folder.path(), &good[..3]);
        let (mut audit, found) = Audit::open(folder.path(), tail, Utc(0));
        audit.append(&found, Utc(0)).unwrap();
        let broken = verify(folder.path(), audit.tail()).expect_err("a hole");
        assert!(matches!(broken, Broken::Order { line: 4, found: 6, expected: 4 }), "{broken}");
    }

    #[test]
    fn a_disk_without_room_takes_nothing_and_loses_nothing() {
        let folder = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink("/dev/full", folder.path().join(NAME)).unwrap();
        let (mut audit, _) = Audit::open(folder.path(), Tail::default(), Utc(0));
        assert!(audit.append(&notes(1), Utc(0)).is_err());
        fs::remove_file(folder.path().join(NAME)).unwrap();
        let mut audit = Audit { file: None, ..audit };
        audit.append(&notes(1), Utc(0)).unwrap();
        assert_eq!(verify(folder.path(), audit.tail()).unwrap().records, 1);
    }
}
