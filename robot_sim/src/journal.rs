//! The effects journal: each physical pick and drop, and each place a body's contour entered or left, in the order it
//! happened.
//!
//! Invariant: an entry is written by the body that did it, with one write call, and never changed; a killed process
//! leaves all it has written. It is what runs are judged by ([`crate::judge`]).

use midshift_core::ids::{PlaceId, RobotId, TaskId, WaypointId};
use midshift_core::robot::StopLevel;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

/// Newest entries that stay in memory.
pub const TAIL_MAX: usize = 4_096;

/// What failed at a journal's file.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file could not be opened, read or cut.
    #[error("journal {path}: {source}")]
    File {
        /// The file of the journal.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A line in the middle is no entry.
    #[error("journal {path} line {line}: {source}")]
    Line {
        /// The file of the journal.
        path: PathBuf,
        /// From 1.
        line: usize,
        /// What the reader of JSON says.
        source: serde_json::Error,
    },
}

/// Whose work an effect was.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Work {
    /// The task.
    pub task_id: TaskId,
    /// Index of its step.
    pub step_index: u32,
}

/// What happened in the world.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "what")]
pub enum Effect {
    /// An item came into the world.
    Made {
        /// The item, unique in the world.
        item: String,
        /// The waypoint where it lies.
        waypoint: WaypointId,
    },
    /// The robot took an item up.
    Picked {
        /// The item that was taken up.
        item: String,
        /// Where from.
        waypoint: WaypointId,
        /// For whom; none: the order named nobody.
        work: Option<Work>,
    },
    /// The robot put its item down.
    Placed {
        /// The item that was put down.
        item: String,
        /// The waypoint where it lies now.
        waypoint: WaypointId,
        /// For whom.
        work: Option<Work>,
    },
    /// A person took the item off the robot and carried it back.
    Returned {
        /// The item that was carried back.
        item: String,
        /// Where it was picked.
        waypoint: WaypointId,
        /// For whom it was picked.
        work: Option<Work>,
    },
    /// An item left the world because its place was full.
    Shipped {
        /// The item that left the world.
        item: String,
        /// From where.
        waypoint: WaypointId,
    },
    /// The robot's contour reached into a place.
    Entered {
        /// The place that it reached into.
        place_id: PlaceId,
    },
    /// The robot's contour is out of a place.
    Left {
        /// The place that it is out of.
        place_id: PlaceId,
    },
    /// The robot obeys another level of operational stop from now on.
    Obeys {
        /// The level that it obeys from then on.
        level: StopLevel,
        /// Millimetres driven so far.
        odometer_mm: u64,
    },
    /// While it obeys a stop that it has to stand by, the robot came to a standstill.
    Stood {
        /// Millimetres driven so far: what it drives until it is released, it drives while it is stopped.
        odometer_mm: u64,
    },
    /// While it obeys a stop that it has to stand by, and after it stood, the robot began to move.
    Moved {
        /// Millimetres driven so far.
        odometer_mm: u64,
    },
    /// Software began to run on the robot, however short it lived.
    Ran {
        /// What it calls itself.
        version: String,
    },
}

/// One line of a journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// UTC on the site clock, milliseconds: comparable between processes that run in real time.
    pub utc_ms: i64,
    /// Site clock of the process, milliseconds.
    pub site_ms: u64,
    /// Who did it; none: the world itself.
    pub robot_id: Option<RobotId>,
    /// What happened in the world.
    #[serde(flatten)]
    pub effect: Effect,
}

/// Where entries go: the newest stay in memory, and all of them in a file if there is one.
#[derive(Debug, Default)]
pub struct Journal {
    file: Option<(PathBuf, File)>,
    tail: VecDeque<Entry>,
    written: u64,
    lost: u64,
}

impl Journal {
    /// In memory only.
    pub fn memory() -> Self {
        Self::default()
    }
    /// Appends to a file, made if it is not there. A last line that was cut off by a crash is removed first.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let failed = |source| Error::File { path: path.to_owned(), source };
        let file = OpenOptions::new().create(true).append(true).open(path).map_err(failed)?;
        let text = std::fs::read(path).map_err(failed)?;
        let whole = text.iter().rposition(|b| *b == b'\n').map_or(0, |i| i + 1);
        if whole < text.len() {
            OpenOptions::new().write(true).open(path).and_then(|f| f.set_len(whole as u64)).map_err(failed)?;
        }
        Ok(Self { file: Some((path.to_owned(), file)), ..Self::default() })
    }
    /// Adds one entry. A file that cannot be written is counted in [`Journal::lost`] and logged.
    pub fn append(&mut self, entry: Entry) {
        if let Some((path, file)) = &mut self.file {
            let line = serde_json::to_vec(&entry).map_err(std::io::Error::from).and_then(|mut line| {
                line.push(b'\n');
                file.write_all(&line)
            });
            if let Err(error) = line {
                self.lost += 1;
                tracing::error!(path = %path.display(), %error, "journal entry not written");
            }
        }
        if self.tail.len() == TAIL_MAX {
            self.tail.pop_front();
        }
        self.tail.push_back(entry);
        self.written += 1;
    }
    /// The newest entries, oldest first, at most [`TAIL_MAX`].
    pub fn tail(&self) -> impl DoubleEndedIterator<Item = &Entry> {
        self.tail.iter()
    }
    /// Entries ever appended by this process.
    pub fn written(&self) -> u64 {
        self.written
    }
    /// Entries that did not reach the file.
    pub fn lost(&self) -> u64 {
        self.lost
    }
}

/// Reads a journal's file whole, oldest first. A cut-off last line is left out; no file is an empty journal.
pub fn read(path: &Path) -> Result<Vec<Entry>, Error> {
    let failed = |source| Error::File { path: path.to_owned(), source };
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(failed(error)),
    };
    let mut entries = Vec::new();
    let mut reader = BufReader::new(file);
    let mut text = String::new();
    for line in 1.. {
        text.clear();
        if reader.read_line(&mut text).map_err(failed)? == 0 || !text.ends_with('\n') {
            break;
        }
        let entry = serde_json::from_str(&text);
        entries.push(entry.map_err(|source| Error::Line { path: path.to_owned(), line, source })?);
    }
    Ok(entries)
}
