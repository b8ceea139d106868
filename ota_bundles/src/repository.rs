//! The release people's side of TUF: who may sign what, which bundles there are, and how fresh that is.
//!
//! Invariant: a document is signed over exactly the canonical form that clients check; `expires` has whole seconds; target names are
//! flat; there are no delegations. Root and targets are signed by people, snapshot and timestamp by the rollout service.

use crate::digest::Digest;
use crate::keys::{PublicKey, SecretKey, hex};
use midshift_core::time::Utc;
use olpc_cjson::CanonicalFormatter;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use std::collections::{BTreeMap, HashMap};
use std::num::NonZeroU64;
use tough::schema::{Metafile, Role, RoleType, Root, Signed, Snapshot, Target, Targets, Timestamp};

/// The version of TUF that is spoken.
const SPEC: &str = "1.0.0";
/// A day.
pub const DAY_MS: u64 = 24 * 3_600_000;
/// Life of a root or targets document.
pub const PEOPLE_LIFE_MS: u64 = 365 * DAY_MS;
/// Life of a snapshot.
pub const SNAPSHOT_LIFE_MS: u64 = 7 * DAY_MS;
/// Life of a timestamp.
pub const TIMESTAMP_LIFE_MS: u64 = DAY_MS;
/// Where a timestamp says when it was signed, UTC ms: what robots take as the time that has at least come.
pub const ISSUED_AT: &str = "x-midshift-issued-at";

/// Why a document was not signed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Not a document of this role.
    #[error("reading {role}: {source}")]
    Read {
        /// The role whose document it should be.
        role: &'static str,
        /// Why not.
        source: serde_json::Error,
    },
    /// It breaks a rule of TUF.
    #[error("{role}: {text}")]
    Rule {
        /// The role whose document it is.
        role: &'static str,
        /// The rule that it breaks, in words.
        text: String,
    },
}

pub(crate) fn rule(role: &'static str, text: impl std::fmt::Display) -> Error {
    Error::Rule { role, text: text.to_string() }
}

/// Who may sign a role.
#[derive(Clone, Debug)]
pub struct Signers {
    /// Their keys.
    pub keys: Vec<PublicKey>,
    /// How many of them must.
    pub threshold: u64,
}

/// Who signs in a project of this size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Profile {
    /// One person, one key.
    Solo,
    /// Two keys of which one is enough, and a spare in a safe.
    Team,
    /// Three people of whom two must.
    Release,
}

impl Profile {
    /// Keys of root, and of targets.
    pub fn keys(self) -> usize {
        match self {
            Self::Solo => 1,
            Self::Team | Self::Release => 3,
        }
    }
    /// How many of them must sign.
    pub fn threshold(self) -> u64 {
        match self {
            Self::Solo | Self::Team => 1,
            Self::Release => 2,
        }
    }
}

/// Who signs what from now on.
#[derive(Clone, Debug)]
pub struct RootDraft {
    /// 1, or one more than the root before.
    pub version: u64,
    /// When it stops being accepted.
    pub expires: Utc,
    /// Signs the next root.
    pub root: Signers,
    /// Signs what bundles there are.
    pub targets: Signers,
    /// Signs which targets document is the newest.
    pub snapshot: Signers,
    /// Signs that this is still so.
    pub timestamp: Signers,
}

fn seconds(utc: Utc) -> Result<jiff::Timestamp, Error> {
    jiff::Timestamp::from_second(utc.0.div_euclid(1000)).map_err(|e| rule("expires", e))
}

fn version(role: &'static str, number: u64) -> Result<NonZeroU64, Error> {
    NonZeroU64::new(number).ok_or_else(|| rule(role, "versions begin with 1"))
}

pub(crate) fn canonical(role: &impl Serialize) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut serializer = serde_json::Serializer::with_formatter(&mut bytes, CanonicalFormatter::new());
    role.serialize(&mut serializer).unwrap_or_else(|e| unreachable!("metadata is plain JSON: {e}"));
    bytes
}

/// Signs a document with all of `keys`, beside the signatures it has.
pub(crate) fn sign<T: Role + Serialize>(mut document: Signed<T>, keys: &[&SecretKey]) -> Result<Vec<u8>, Error> {
    let message = canonical(&document.signed);
    for key in keys {
        let signature = json!({"keyid": key.public().id().to_string(), "sig": hex(&key.sign(&message))});
        let signature: tough::schema::Signature =
            serde_json::from_value(signature).map_err(|source| Error::Read { role: "a signature", source })?;
        document.signatures.retain(|s| s.keyid != signature.keyid);
        document.signatures.push(signature);
    }
    let mut bytes =
        serde_json::to_vec_pretty(&document).unwrap_or_else(|e| unreachable!("metadata is plain JSON: {e}"));
    bytes.push(b'\n');
    Ok(bytes)
}

pub(crate) fn read<T: DeserializeOwned>(role: &'static str, bytes: &[u8]) -> Result<Signed<T>, Error> {
    serde_json::from_slice(bytes).map_err(|source| Error::Read { role, source })
}

/// A root document. A root that replaces another is signed by enough keys of both.
///
/// # Errors
/// A role that nobody, or not enough, could sign.
pub fn sign_root(draft: &RootDraft, keys: &[&SecretKey]) -> Result<Vec<u8>, Error> {
    let roles = [
        ("root", &draft.root),
        ("targets", &draft.targets),
        ("snapshot", &draft.snapshot),
        ("timestamp", &draft.timestamp),
    ];
    let mut listed = BTreeMap::new();
    let mut who = BTreeMap::new();
    for (role, signers) in roles {
        if signers.threshold == 0 || signers.threshold > signers.keys.len() as u64 {
            return Err(rule(role, format!("{} of {} keys cannot sign", signers.threshold, signers.keys.len())));
        }
        let ids: Vec<String> = signers.keys.iter().map(|key| key.id().to_string()).collect();
        listed.extend(signers.keys.iter().map(|key| (key.id().to_string(), key.tuf())));
        who.insert(role, json!({"keyids": ids, "threshold": signers.threshold}));
    }
    let root = json!({
        "_type": "root", "spec_version": SPEC, "consistent_snapshot": true, "version": draft.version,
        "expires": seconds(draft.expires)?.to_string(), "keys": listed, "roles": who,
    });
    let root: Root = serde_json::from_value(root).map_err(|source| Error::Read { role: "root", source })?;
    sign(Signed { signed: root, signatures: Vec::new() }, keys)
}

/// Adds signatures to a root or targets document that somebody handed over.
///
/// # Errors
/// If it is neither.
pub fn add_signatures(document: &[u8], keys: &[&SecretKey]) -> Result<Vec<u8>, Error> {
    match read::<Targets>("targets", document) {
        Ok(targets) => sign(targets, keys),
        Err(_) => sign(read::<Root>("root or targets", document)?, keys),
    }
}

/// A file that is a target, or is to become one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileTarget {
    /// Flat: no `/`.
    pub name: String,
    /// Of its bytes.
    pub digest: Digest,
    /// How many bytes it has.
    pub length: u64,
}

/// The targets document after `previous` (none: the first), with more and fewer targets.
///
/// # Errors
/// A name that is taken by other bytes: what a name stands for never changes.
pub fn sign_targets(
    previous: Option<&[u8]>,
    add: &[FileTarget],
    remove: &[String],
    expires: Utc,
    keys: &[&SecretKey],
) -> Result<Vec<u8>, Error> {
    let mut targets = match previous {
        Some(bytes) => read::<Targets>("targets", bytes)?.signed,
        None => Targets::new(SPEC.to_owned(), NonZeroU64::MIN, seconds(expires)?),
    };
    if previous.is_some() {
        targets.version = version("targets", targets.version.get() + 1)?;
    }
    targets.expires = seconds(expires)?;
    for name in remove {
        targets.remove_target(&target_name(name)?);
    }
    for new in add {
        let target = json!({"length": new.length, "hashes": {"sha256": new.digest.to_string()}});
        let target: Target =
            serde_json::from_value(target).map_err(|source| Error::Read { role: "targets", source })?;
        let name = target_name(&new.name)?;
        if targets.targets.get(&name).is_some_and(|known| *known != target) {
            return Err(rule("targets", format!("{} stands for other bytes already; raise its version", new.name)));
        }
        targets.add_target(name, target);
    }
    sign(Signed { signed: targets, signatures: Vec::new() }, keys)
}

fn target_name(name: &str) -> Result<tough::TargetName, Error> {
    let flat = !name.is_empty() && !name.starts_with('.') && !name.contains(['/', '\\']);
    if !flat {
        return Err(rule("targets", format!("{name:?} is no flat name")));
    }
    tough::TargetName::new(name).map_err(|e| rule("targets", e))
}

/// Snapshot and timestamp of a repository.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Online {
    /// The document `N.snapshot.json`.
    pub snapshot: Vec<u8>,
    /// The document `timestamp.json`.
    pub timestamp: Vec<u8>,
}

/// What the service signs by itself: `targets` is the newest as of `now`. Both versions must be higher than those before.
///
/// # Errors
/// If `targets` is none.
pub fn sign_online(
    targets: &[u8],
    snapshot_version: u64,
    timestamp_version: u64,
    now: Utc,
    snapshot_key: &SecretKey,
    timestamp_key: &SecretKey,
) -> Result<Online, Error> {
    let newest = read::<Targets>("targets", targets)?.signed.version;
    let mut snapshot =
        Snapshot::new(SPEC.to_owned(), version("snapshot", snapshot_version)?, seconds(now.plus_ms(SNAPSHOT_LIFE_MS))?);
    snapshot.meta.insert("targets.json".to_owned(), metafile(targets, newest)?);
    let snapshot_version = snapshot.version;
    let snapshot = sign(Signed { signed: snapshot, signatures: Vec::new() }, &[snapshot_key])?;
    let mut timestamp = Timestamp::new(
        SPEC.to_owned(),
        version("timestamp", timestamp_version)?,
        seconds(now.plus_ms(TIMESTAMP_LIFE_MS))?,
    );
    timestamp.meta = HashMap::from([("snapshot.json".to_owned(), metafile(&snapshot, snapshot_version)?)]);
    timestamp._extra.insert(ISSUED_AT.to_owned(), json!(now.0));
    let timestamp = sign(Signed { signed: timestamp, signatures: Vec::new() }, &[timestamp_key])?;
    Ok(Online { snapshot, timestamp })
}

fn metafile(bytes: &[u8], version: NonZeroU64) -> Result<Metafile, Error> {
    let meta =
        json!({"length": bytes.len(), "hashes": {"sha256": Digest::of_content(bytes).to_string()}, "version": version});
    serde_json::from_value(meta).map_err(|source| Error::Read { role: "snapshot", source })
}

/// Whether `document` is signed as `root` asks: for people who put signatures together, and for robots that check what runs.
///
/// # Errors
/// What is missing, or that one of the two cannot be read.
pub fn check_targets(root: &[u8], document: &[u8]) -> Result<(), Error> {
    let root = read::<Root>("root", root)?;
    root.signed.verify_role(&read::<Targets>("targets", document)?).map_err(|e| rule("targets", e))
}

/// Whether `next` is signed by enough keys of `root` and of itself; a first root is held against itself.
///
/// # Errors
/// What is missing, or that one of the two cannot be read.
pub fn check_root(root: &[u8], next: &[u8]) -> Result<(), Error> {
    let (root, next) = (read::<Root>("root", root)?, read::<Root>("root", next)?);
    root.signed.verify_role(&next).and_then(|()| next.signed.verify_role(&next)).map_err(|e| rule("root", e))
}

/// Number of a targets document.
///
/// # Errors
/// If it is none.
pub fn version_of(targets: &[u8]) -> Result<u64, Error> {
    Ok(read::<Targets>("targets", targets)?.signed.version.get())
}

/// What a targets document lists, by name.
///
/// # Errors
/// If it is none.
pub fn listed(targets: &[u8]) -> Result<Vec<FileTarget>, Error> {
    let targets = read::<Targets>("targets", targets)?.signed;
    let mut listed = Vec::new();
    for (name, target) in &targets.targets {
        let digest = hex(&target.hashes.sha256).parse().map_err(|e| rule("targets", e))?;
        listed.push(FileTarget { name: name.raw().to_owned(), digest, length: target.length });
    }
    listed.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(listed)
}

/// Keys that sign a role by this root document, by id.
pub(crate) fn role_keys(root: &Root, role: RoleType) -> Vec<String> {
    let mut ids: Vec<String> =
        root.roles.get(&role).map(|keys| keys.keyids.iter().map(|id| hex(id)).collect()).unwrap_or_default();
    ids.sort_unstable();
    ids
}
