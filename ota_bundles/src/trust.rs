//! A robot's side of TUF: what it believes of the repository, and how that may change.
//!
//! `tough` checks signatures and the chain; its disk, clock and downloads are not used. What was believed goes in as one value and comes
//! out as one value, so that it is on the disk whole or not at all.
//! Invariant: versions never go back unless a new root has changed the keys of that role; expiry is judged by a time floor that never falls. It rises with
//! signed times and with what a proven server tells, each signed document at most two days past what the robot knows of the time by itself. A new root that
//! was signed as the one before asks is believed though what comes after it in the same refresh is not.

use crate::bugs::Bugs;
use crate::digest::Digest;
use crate::repository::{ISSUED_AT, canonical, check_root, read, role_keys};
use async_trait::async_trait;
use midshift_core::time::Utc;
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use tough::schema::{RoleType, Root, Signed, Timestamp};
use tough::{
    Bytes, ExpirationEnforcement, Limits, RepositoryLoader, TransportError, TransportErrorKind, TransportStream,
};
use url::Url;

/// Bytes of one metadata document.
pub const METADATA_BYTES_MAX: u64 = midshift_core::limits::SIGNED_DOCUMENT_BYTES as u64;
/// New roots taken in one refresh.
const ROOTS_MAX: u64 = 64;
/// So far may the time that a server tells lie beyond the newest signed one, and a signed time beyond what the robot knows by itself. More than the day that a timestamp
/// lives, so that one that is withheld is seen to have expired; not much more, so that a clock that was years ahead keeps a robot from its updates for two days at most.
const AHEAD_MS: u64 = 2 * 24 * 3_600 * 1_000;
/// A floor that rises by less is not worth a write.
const TOLD_STEP_MS: i64 = 3_600 * 1_000;
/// Nothing is fetched from here: it gives documents their names.
const NOWHERE: &str = "https://metadata.invalid/";

/// Where metadata documents come from.
#[async_trait]
pub trait Source: std::fmt::Debug + Send + Sync {
    /// The document of this name, `timestamp.json` or `N.role.json`; none: there is none. Longer than [`METADATA_BYTES_MAX`] is an error.
    async fn fetch(&self, name: &str) -> io::Result<Option<Vec<u8>>>;
}

/// What a robot believes. Fields and roles of a newer version, which a robot may have gone back from, are not looked at.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Trusted {
    /// The newest root, as it was signed.
    root: String,
    /// The root that the robot came with, by what was signed of it; none: a version wrote this that did not note it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    origin: Option<Digest>,
    timestamp: Option<String>,
    snapshot: Option<String>,
    targets: Option<String>,
    /// Lowest version of each role that may be believed.
    #[serde(deserialize_with = "known_roles")]
    versions: BTreeMap<VersionedRole, u64>,
    /// It is at least this late, UTC ms.
    time_floor: Utc,
    /// It is about this late, as the robot knows by itself; 0: it knows nothing.
    #[serde(skip)]
    own_time: Utc,
    /// Naive rules, for twins of tests.
    #[serde(skip)]
    bugs: Bugs,
}

/// A role whose versions may only rise.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum VersionedRole {
    Root,
    Timestamp,
    Snapshot,
    Targets,
}

impl VersionedRole {
    const ALL: [(Self, &'static str); 4] = [
        (Self::Root, "root"),
        (Self::Timestamp, "timestamp"),
        (Self::Snapshot, "snapshot"),
        (Self::Targets, "targets"),
    ];
}

/// Whether versions of a role go on from one root to another: if its keys do.
fn keeps(old: &Root, new: &Root) -> BTreeMap<VersionedRole, bool> {
    let same = |role| role_keys(old, role) == role_keys(new, role);
    BTreeMap::from([
        (VersionedRole::Root, true),
        (VersionedRole::Timestamp, same(RoleType::Timestamp)),
        (VersionedRole::Snapshot, same(RoleType::Snapshot) && same(RoleType::Timestamp)),
        (VersionedRole::Targets, same(RoleType::Targets)),
    ])
}

fn parsed(root: &str) -> Result<Root, Error> {
    let root: Signed<Root> = serde_json::from_str(root).map_err(Error::NoRoot)?;
    Ok(root.signed)
}

fn shares_root_key(one: &Root, other: &Root) -> bool {
    let keys = role_keys(one, RoleType::Root);
    role_keys(other, RoleType::Root).iter().any(|key| keys.contains(key))
}

fn known_roles<'de, D: Deserializer<'de>>(from: D) -> Result<BTreeMap<VersionedRole, u64>, D::Error> {
    let mut named = BTreeMap::<String, u64>::deserialize(from)?;
    Ok(VersionedRole::ALL.into_iter().filter_map(|(role, name)| Some((role, named.remove(name)?))).collect())
}

/// Why nothing new is believed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The repository's documents do not hold.
    #[error("checking the repository: {0}")]
    Metadata(#[source] Box<tough::error::Error>),
    /// A document is older than one that was believed.
    #[error("{role} {offered} is older than {believed}, which was believed")]
    Older {
        /// The role whose document it is.
        role: &'static str,
        /// Version that was offered.
        offered: u64,
        /// Version that was believed.
        believed: u64,
    },
    /// A document is past its time.
    #[error("{role} expired at {expires}; it is {now} at least")]
    Expired {
        /// The role whose document it is.
        role: &'static str,
        /// When it expired, UTC.
        expires: String,
        /// The time it was held against.
        now: String,
    },
    /// What is believed cannot be read: nothing is believed until a person has looked.
    #[error("{doing} what is believed: {source}")]
    Store {
        /// What was being done.
        doing: &'static str,
        /// Why not.
        source: io::Error,
    },
    /// The first root is none.
    #[error("the root that came with the robot cannot be read: {0}")]
    NoRoot(serde_json::Error),
}

impl Error {
    /// The documents could not be had: nothing was wrong with them. Bytes that came and are not those that were signed, or too many of them, are
    /// wrong, though `tough` tells both as trouble of the line.
    pub fn is_unreachable(&self) -> bool {
        let Self::Metadata(error) = self else { return false };
        let tough::error::Error::Transport { source, .. } = &**error else { return false };
        let is_of_line = std::error::Error::source(source).is_some_and(|cause| cause.is::<io::Error>());
        is_of_line || matches!(source.kind(), TransportErrorKind::FileNotFound)
    }
}

/// A clock as a robot has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reading {
    /// What it says, UTC ms.
    pub utc: Utc,
    /// Whether it was set from the network: only then it counts.
    pub is_synced: bool,
}

/// A file that release people have signed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Of its bytes.
    pub digest: Digest,
    /// How many bytes it has.
    pub length: u64,
}

/// What a refresh came to.
#[derive(Clone, Debug)]
pub struct Refreshed {
    /// To be written down before anything is done with the rest.
    pub trusted: Trusted,
    /// Files by name.
    pub targets: BTreeMap<String, Listed>,
}

/// A refresh that failed.
#[derive(Debug)]
pub struct Unrefreshed {
    /// Why nothing of the documents below the root is believed.
    pub error: Error,
    /// With the newer root that came all the same, to be written down; none: none came.
    pub rooted: Option<Box<Trusted>>,
}

/// Documents as they came, by name.
type Heard = BTreeMap<String, Vec<u8>>;

impl Trusted {
    /// A robot that has only the root it came with.
    ///
    /// # Errors
    /// If it is none.
    pub fn new(root: &[u8]) -> Result<Self, Error> {
        let parsed: Signed<Root> = serde_json::from_slice(root).map_err(Error::NoRoot)?;
        Ok(Self {
            root: String::from_utf8_lossy(root).into_owned(),
            origin: Some(Digest::of_content(&canonical(&parsed.signed))),
            timestamp: None,
            snapshot: None,
            targets: None,
            versions: BTreeMap::from([(VersionedRole::Root, parsed.signed.version.get())]),
            time_floor: Utc(0),
            own_time: Utc(0),
            bugs: Bugs::default(),
        })
    }
    /// What is believed with `root` in the trust file. It is the root that the robot came with, nobody noted which that was, or it is an older one of the
    /// same people: what was believed. A person has put another one there: that one alone, with the versions of those roles whose keys it has not changed.
    ///
    /// # Errors
    /// If it is none.
    pub fn from_root(&self, root: &[u8]) -> Result<Self, Error> {
        let begun = Self::new(root)?;
        if self.origin.is_none_or(|origin| Some(origin) == begun.origin) {
            return Ok(Self { origin: begun.origin, ..self.clone() });
        }
        let (old, new) = (parsed(&self.root)?, parsed(&begun.root)?);
        if new.version <= old.version && shares_root_key(&old, &new) {
            return Ok(self.clone());
        }
        let keeps = keeps(&old, &new);
        let kept = self.versions.iter().filter(|(role, _)| **role != VersionedRole::Root && keeps[*role]);
        let versions = begun.versions.iter().chain(kept).map(|(role, version)| (*role, *version)).collect();
        Ok(Self { versions, time_floor: self.time_floor, bugs: self.bugs, ..begun })
    }
    /// Whether somebody who signs for one signs for the other.
    ///
    /// # Errors
    /// If a root cannot be read.
    pub fn shares_root_key(&self, other: &Self) -> Result<bool, Error> {
        Ok(shares_root_key(&parsed(&self.root)?, &parsed(&other.root)?))
    }
    /// Of which these naive rules count.
    #[must_use]
    pub fn with(self, bugs: Bugs) -> Self {
        Self { bugs, ..self }
    }
    /// With what the robot knows of the time by itself: its floor and its own monotonic time since, or what a proven server told. It bounds how far a signed
    /// time raises the floor, and is not kept.
    #[must_use]
    pub fn knowing(self, own_time: Utc) -> Self {
        Self { own_time, ..self }
    }
    /// The newest root and the newest list of targets, as they were signed; none: the repository was never asked.
    pub fn documents(&self) -> Option<(&str, &str)> {
        Some((&self.root, self.targets.as_deref()?))
    }
    /// It is at least this late.
    pub fn time_floor(&self) -> Utc {
        self.time_floor
    }
    /// Raises the time floor to the time that a proven server told, at most to two days beyond the time of the newest signed timestamp. It never
    /// falls. None: it would rise by less than an hour, or nothing signed has said any time yet.
    #[must_use]
    pub fn raise_time_floor(&self, time: Utc) -> Option<Self> {
        let is_later = |floor: Utc| floor.0.saturating_sub(self.time_floor.0) >= TOLD_STEP_MS;
        if !is_later(time) {
            return None;
        }
        let timestamp: Signed<Timestamp> = serde_json::from_str(self.timestamp.as_deref()?).ok()?;
        let time_floor = time.min(issued_at(&timestamp.signed)?.plus_ms(AHEAD_MS));
        is_later(time_floor).then(|| Self { time_floor, ..self.clone() })
    }
    /// As it is, with a time floor that is no lower than this.
    #[must_use]
    pub fn at_least(self, floor: Utc) -> Self {
        Self { time_floor: self.time_floor.max(floor), ..self }
    }
    /// The moment that expiry is held against.
    pub fn now(&self, clock: Reading) -> Utc {
        if clock.is_synced { clock.utc.max(self.time_floor) } else { self.time_floor }
    }
    /// The floor once a timestamp that was signed at `issued` is believed. The first time that a robot hears of counts whole; after that it is at most two days
    /// past what the robot knows, once for each timestamp: one that was believed before raises nothing.
    fn raised(&self, issued: Utc, is_new: bool, clock: Reading) -> Utc {
        let synced = if clock.is_synced { clock.utc } else { Utc(0) };
        let known = self.time_floor.max(self.own_time).max(synced);
        let most = match (known, is_new) {
            (Utc(0), _) => issued,
            (_, true) => known.plus_ms(AHEAD_MS),
            (_, false) => self.time_floor,
        };
        self.time_floor.max(issued.min(most))
    }
    /// Reads what was believed; none: nothing was ever written there.
    ///
    /// # Errors
    /// A file that is there and cannot be read: it is not taken for none.
    pub fn load(path: &Path) -> Result<Option<Self>, Error> {
        let store = |source| Error::Store { doing: "reading", source };
        match fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .map(Some)
                .map_err(|e| store(io::Error::new(io::ErrorKind::InvalidData, e))),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(store(e)),
        }
    }
    /// Writes it whole or not at all.
    ///
    /// # Errors
    /// If it could not be written; what was there is there still, or this is.
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        let write = || midshift_durable::replace(path, &serde_json::to_vec(self)?);
        write().map_err(|source| Error::Store { doing: "writing", source })
    }

    /// Asks the repository what there is. `self` stays as it is; what comes out replaces it once it is written down.
    ///
    /// # Errors
    /// Why nothing new is believed.
    pub async fn refresh(&self, source: Arc<dyn Source>, clock: Reading) -> Result<Refreshed, Error> {
        self.verify_repository(source, clock).await.map_err(|failed| failed.error)
    }

    /// As [`Self::refresh`], for whoever writes a new root down also when the rest fails: step 5.3.8 of the specification. Else keys that the
    /// new root has ended could sign for this robot again.
    ///
    /// # Errors
    /// Why nothing else is believed, with the new root.
    pub async fn verify_repository(&self, source: Arc<dyn Source>, clock: Reading) -> Result<Refreshed, Unrefreshed> {
        let heard = Arc::new(Mutex::new(Heard::new()));
        let asked = self.load_verified(source, clock, heard.clone()).await;
        asked.map_err(|error| {
            let heard = heard.lock().unwrap_or_else(PoisonError::into_inner);
            Unrefreshed { error, rooted: self.rooted(&heard).map(Box::new) }
        })
    }

    async fn load_verified(
        &self,
        source: Arc<dyn Source>,
        clock: Reading,
        heard: Arc<Mutex<Heard>>,
    ) -> Result<Refreshed, Error> {
        let store = |source| Error::Store { doing: "unpacking", source };
        let folder = tempfile::tempdir().map_err(store)?;
        for (name, document) in
            [("timestamp.json", &self.timestamp), ("snapshot.json", &self.snapshot), ("targets.json", &self.targets)]
        {
            if let Some(document) = document {
                fs::write(folder.path().join(name), document).map_err(store)?;
            }
        }
        let nowhere = || Url::parse(NOWHERE).unwrap_or_else(|e| unreachable!("a constant: {e}"));
        let repository = RepositoryLoader::new(&self.root, nowhere(), nowhere())
            .transport(Recorder { source, heard: heard.clone() })
            .limits(Limits {
                max_root_size: METADATA_BYTES_MAX,
                max_targets_size: METADATA_BYTES_MAX,
                max_timestamp_size: METADATA_BYTES_MAX,
                max_snapshot_size: METADATA_BYTES_MAX,
                max_root_updates: ROOTS_MAX,
            })
            .datastore(folder.path())
            // Judged below, by a time that a wrong clock cannot move.
            .expiration_enforcement(ExpirationEnforcement::Unsafe)
            .load()
            .await
            .map_err(|e| Error::Metadata(Box::new(e)))?;
        let heard = heard.lock().unwrap_or_else(PoisonError::into_inner);
        self.take_fresh(&repository, &heard, clock)
    }

    /// Checks versions and expiry of what was loaded, by a floor of time that its timestamp may raise; makes of it what is kept.
    fn take_fresh(&self, repository: &tough::Repository, heard: &Heard, clock: Reading) -> Result<Refreshed, Error> {
        let old = parsed(&self.root)?;
        let (root, timestamp) = (repository.root(), repository.timestamp());
        let (snapshot, targets) = (repository.snapshot(), repository.targets());
        let keeps = keeps(&old, &root.signed);
        let offered = [
            (VersionedRole::Root, "root", root.signed.version.get(), root.signed.expires),
            (VersionedRole::Timestamp, "timestamp", timestamp.signed.version.get(), timestamp.signed.expires),
            (VersionedRole::Snapshot, "snapshot", snapshot.signed.version.get(), snapshot.signed.expires),
            (VersionedRole::Targets, "targets", targets.signed.version.get(), targets.signed.expires),
        ];
        let text = |name: String| heard.get(&name).map(|bytes| String::from_utf8_lossy(bytes).into_owned());
        let stamp = text("timestamp.json".to_owned());
        let is_new = stamp.as_ref() != self.timestamp.as_ref();
        let time_floor = self.raised(issued_at(&timestamp.signed).unwrap_or(Utc(0)), is_new, clock);
        let now = Self { time_floor, ..self.clone() }.now(clock);
        let mut versions = BTreeMap::new();
        for (kept, role, version, expires) in offered {
            let believed = self.versions.get(&kept).copied().filter(|_| keeps[&kept]).unwrap_or(0);
            if version < believed {
                return Err(Error::Older { role, offered: version, believed });
            }
            if expires.as_millisecond() <= now.0 && !self.bugs.repositories_live_for_ever() {
                return Err(Error::Expired { role, expires: expires.to_string(), now: now.rfc3339() });
            }
            versions.insert(kept, version);
        }
        let trusted = Self {
            origin: self.origin,
            root: text(format!("{}.root.json", root.signed.version)).unwrap_or_else(|| self.root.clone()),
            timestamp: stamp,
            snapshot: text(format!("{}.snapshot.json", snapshot.signed.version)),
            targets: text(format!("{}.targets.json", targets.signed.version)),
            versions,
            time_floor,
            own_time: Utc(0),
            bugs: self.bugs,
        };
        let listed = targets.signed.targets.iter().filter_map(|(name, target)| {
            let digest = crate::keys::hex(&target.hashes.sha256).parse().ok()?;
            Some((name.raw().to_owned(), Listed { digest, length: target.length }))
        });
        Ok(Refreshed { trusted, targets: listed.collect() })
    }

    /// With the newest root that came, each signed as it and the one before ask; none: no newer one came. What was believed by keys that it
    /// has ended counts no more (5.3.11).
    fn rooted(&self, heard: &Heard) -> Option<Self> {
        let old = read::<Root>("root", self.root.as_bytes()).ok()?.signed;
        let (mut root, mut newest) = (self.root.as_bytes(), old.clone());
        loop {
            let number = newest.version.get().saturating_add(1);
            let Some(next) = heard.get(&format!("{number}.root.json")) else { break };
            let Ok(signed) = read::<Root>("root", next).map(|next| next.signed) else { break };
            if signed.version.get() != number || check_root(root, next).is_err() {
                break;
            }
            (root, newest) = (next.as_slice(), signed);
        }
        if newest.version == old.version {
            return None;
        }
        let keeps = keeps(&old, &newest);
        let has_same = |document: &Option<String>, kept: VersionedRole| document.clone().filter(|_| keeps[&kept]);
        let mut versions = self.versions.clone();
        versions.retain(|kept, _| keeps[kept]);
        versions.insert(VersionedRole::Root, newest.version.get());
        Some(Self {
            origin: self.origin,
            root: String::from_utf8_lossy(root).into_owned(),
            // It names a snapshot: it goes with that one.
            timestamp: has_same(&self.timestamp, VersionedRole::Snapshot),
            snapshot: has_same(&self.snapshot, VersionedRole::Snapshot),
            targets: has_same(&self.targets, VersionedRole::Targets),
            versions,
            time_floor: self.time_floor,
            own_time: Utc(0),
            bugs: self.bugs,
        })
    }
}

/// When it was signed, as its signer says.
fn issued_at(timestamp: &Timestamp) -> Option<Utc> {
    timestamp._extra.get(ISSUED_AT).and_then(serde_json::Value::as_i64).map(Utc)
}

/// Gives `tough` documents of a source and keeps them as they came.
#[derive(Clone, Debug)]
struct Recorder {
    source: Arc<dyn Source>,
    heard: Arc<Mutex<Heard>>,
}

#[async_trait]
impl tough::Transport for Recorder {
    async fn fetch(&self, url: Url) -> Result<TransportStream, TransportError> {
        let name = url.path().trim_start_matches('/').to_owned();
        let found = self.source.fetch(&name).await;
        let bytes = found.map_err(|e| TransportError::new_with_cause(TransportErrorKind::Other, &url, e))?;
        let bytes = bytes.ok_or_else(|| TransportError::new(TransportErrorKind::FileNotFound, &url))?;
        if bytes.len() as u64 > METADATA_BYTES_MAX {
            return Err(TransportError::new(TransportErrorKind::Other, &url));
        }
        self.heard.lock().unwrap_or_else(PoisonError::into_inner).insert(name, bytes.clone());
        Ok(Box::pin(tokio_stream::once(Ok(Bytes::from(bytes)))))
    }
}
