//! Snapshot files that other processes write into the stop service's folder: the roster of robots, the known
//! principals, and the stops that the store has as engaged.
//!
//! Invariant: a snapshot is written whole under another name and renamed, so a reader never sees half of it. One that
//! cannot be read is reported once, and the last good one stays in force.

use crate::changes;
use crate::inner::Inner;
use crate::threads::blocking;
use midshift_core::identity::Directory;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::stop::Stop;
use midshift_core::time::Utc;
use rustix::fs::{AtFlags, CWD, Timespec, Timestamps, UTIME_NOW, utimensat};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Read};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Its name in the folder.
const ROSTER: &str = "roster.snapshot";
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Names of 64 bytes, with room.
const BYTES_MAX: u64 = limits::STOP_ROBOTS_MAX as u64 * 80;

/// Who belongs to the fleet.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Roster {
    /// At most [`limits::STOP_ROBOTS_MAX`].
    pub robots: BTreeSet<RobotId>,
}

impl Roster {
    /// Writes it into the folder of a stop service, whole or not at all. Called by whoever knows the fleet.
    ///
    /// # Errors
    /// The disk.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        write(folder, ROSTER, &serde_json::to_vec(self)?)
    }
}

/// Stops that the store has as engaged and not reset: what the service has lost of them it takes from here.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Copied {
    /// By name, each as it was engaged.
    pub stops: Vec<Stop>,
}

impl Copied {
    /// Name of the file.
    pub const NAME: &str = "stops.snapshot";

    /// Writes it into the folder of a stop service, whole or not at all. Called by whoever has the store.
    ///
    /// # Errors
    /// The disk.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        write(folder, Self::NAME, &serde_json::to_vec(self)?)
    }
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> io::Result<()> {
    fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    midshift_durable::replace_with(&folder.join(name), bytes, midshift_durable::PRIVATE)
}

/// Who is known, and what the port proves itself with: all that a stop service needs of identity.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Principals {
    /// Tokens and keys that were taken out.
    pub directory: Directory,
    /// Certificate of the server and the root behind it, PEM.
    pub chain_pem: String,
    /// Its private key, PEM.
    pub key_pem: String,
    /// The root that robots are held against, PEM.
    pub authority_pem: String,
}

impl Principals {
    /// Name of the file.
    pub const NAME: &str = "principals.snapshot";

    /// Writes it into the folder of a stop service, whole or not at all, for its owner alone.
    ///
    /// # Errors
    /// The disk.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        write(folder, Self::NAME, &serde_json::to_vec(self)?)
    }

    /// Says that what stands in the folder is still so.
    ///
    /// # Errors
    /// The disk, or it is not there.
    pub fn affirm(folder: &Path) -> io::Result<()> {
        let now = Timespec { tv_sec: 0, tv_nsec: UTIME_NOW };
        let times = Timestamps { last_access: now, last_modification: now };
        Ok(utimensat(CWD, folder.join(Self::NAME), &times, AtFlags::empty())?)
    }

    /// When it was written, or affirmed since; none: it is not there. UTC of the machine that the folder is on.
    pub fn written_at(folder: &Path) -> Option<Utc> {
        let found = fs::metadata(folder.join(Self::NAME)).ok()?;
        Some(Utc(found.mtime() * 1_000 + found.mtime_nsec() / 1_000_000))
    }

    /// What stands in the folder; none: nothing was written yet.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn read(folder: &Path) -> io::Result<Option<Self>> {
        match fs::read(folder.join(Self::NAME)) {
            Ok(text) => Ok(Some(serde_json::from_slice(&text)?)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }
}

/// Which file it was.
type Mark = (u64, i64, i64, u64);

fn mark(path: &Path) -> Option<Mark> {
    let found = fs::metadata(path).ok()?;
    Some((found.ino(), found.mtime(), found.mtime_nsec(), found.len()))
}

/// What stands in a file, if it is another one than `before`; an error inside: it cannot be read.
fn read_changed<T: DeserializeOwned>(
    path: &Path,
    bytes_max: u64,
    before: Option<Mark>,
) -> (Option<Mark>, Option<Found<T>>) {
    let now = mark(path);
    if now == before || now.is_none() {
        return (before, None);
    }
    let read = || -> Found<T> {
        let mut text = Vec::new();
        let file = File::open(path).map_err(|e| e.to_string())?;
        file.take(bytes_max + 1).read_to_end(&mut text).map_err(|e| e.to_string())?;
        if text.len() as u64 > bytes_max {
            return Err(format!("it has more than {bytes_max} bytes"));
        }
        serde_json::from_slice(&text).map_err(|e| e.to_string())
    };
    (now, Some(read()))
}

type Found<T> = Result<T, String>;

/// What was read of both files.
struct Looked {
    marks: [Option<Mark>; 2],
    roster: Option<Found<Roster>>,
    copied: Option<Found<Copied>>,
}

fn look_at_both(folder: &Path, marks: [Option<Mark>; 2]) -> Looked {
    let (of_roster, roster) = read_changed(&folder.join(ROSTER), BYTES_MAX, marks[0]);
    let (of_copied, copied) = read_changed(&folder.join(Copied::NAME), limits::STOP_LATCH_BYTES as u64, marks[1]);
    Looked { marks: [of_roster, of_copied], roster, copied }
}

fn take_both(inner: &Inner, looked: Looked) -> [Option<Mark>; 2] {
    looked.roster.into_iter().for_each(|roster| apply_roster(inner, roster));
    match looked.copied {
        Some(Ok(copied)) => changes::take_copied(inner, copied.stops),
        Some(Err(error)) => tracing::error!(error, "the stops that the store has cannot be read; those here stay"),
        None => {}
    }
    looked.marks
}

/// Takes over what stands in the folder now: before anybody is answered.
pub fn look_first(inner: &Inner, folder: &Path) {
    take_both(inner, look_at_both(folder, [None, None]));
}

/// Follows the files until the task is ended.
pub async fn follow_files(inner: &Inner, folder: PathBuf) {
    let mut known = [None, None];
    loop {
        tokio::time::sleep(LOOK_EVERY).await;
        let at = folder.clone();
        let looked = blocking(move || look_at_both(&at, known)).await;
        known = take_both(inner, looked);
        if inner.robots.let_go(inner.clock.now().link) {
            inner.touch();
        }
    }
}

/// Puts a roster in force.
fn apply_roster(inner: &Inner, roster: Result<Roster, String>) {
    match roster {
        Ok(roster) => {
            inner.robots.list(&roster.robots, inner.clock.now().link);
            metrics::gauge!("midshift_stop_roster").set(roster.robots.len() as f64);
            tracing::info!(robots = roster.robots.len(), "roster taken over");
            inner.touch();
        }
        Err(error) => tracing::error!(error, "the roster cannot be read; the last good one stays in force"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, from_value, json, to_value};

    /// As a server of the next version may write it, which is there before the stop service is replaced.
    fn of_next_version(snapshot: &impl Serialize) -> Value {
        let mut value = to_value(snapshot).expect("JSON");
        value["of_next_version"] = json!({"some": ["thing"]});
        value
    }

    #[test]
    fn a_field_of_a_newer_server_hides_nothing_that_this_version_knows() {
        let roster = Roster { robots: [RobotId::parse("r1").expect("an id")].into() };
        assert_eq!(from_value::<Roster>(of_next_version(&roster)).expect("a roster"), roster);
        assert!(from_value::<Copied>(of_next_version(&Copied { stops: Vec::new() })).expect("stops").stops.is_empty());
        let text = |name: &str| name.to_owned();
        let principals = Principals {
            directory: Directory::default(),
            chain_pem: text("chain"),
            key_pem: text("key"),
            authority_pem: text("authority"),
        };
        let read: Principals = from_value(of_next_version(&principals)).expect("principals");
        assert_eq!((read.chain_pem, read.key_pem, read.authority_pem), (text("chain"), text("key"), text("authority")));
    }
}
