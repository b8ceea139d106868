//! What a server must know of signed documents before it says that they are the newest: numbers, ends, who may sign.
//!
//! Invariant: nothing is signed here. A set of documents holds only if a robot that has the same root would take it, expiry aside.

use crate::digest::Digest;
use crate::keys::{PublicKey, hex};
use crate::repository::{Error, ISSUED_AT, Online, check_targets, read, role_keys, rule};
use midshift_core::time::Utc;
use tough::schema::{Metafile, RoleType, Root, Snapshot, Targets, Timestamp};

/// Number and end of a document that people sign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edition {
    /// From 1.
    pub version: u64,
    /// When it stops being accepted.
    pub expires: Utc,
}

/// What a timestamp says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// Its own number.
    pub version: u64,
    /// Number of the newest snapshot.
    pub snapshot_version: u64,
    /// When it was signed; 0 if it does not say.
    pub issued: Utc,
    /// When it stops being accepted.
    pub expires: Utc,
}

/// Roles that a server signs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnlineRole {
    /// Which targets document is the newest.
    Snapshot,
    /// That this is still so.
    Timestamp,
}

/// Number and end of a root document.
///
/// # Errors
/// If it is none.
pub fn root_edition(root: &[u8]) -> Result<Edition, Error> {
    let root = read::<Root>("root", root)?.signed;
    Ok(Edition { version: root.version.get(), expires: Utc(root.expires.as_millisecond()) })
}

/// Number and end of a targets document.
///
/// # Errors
/// If it is none.
pub fn targets_edition(targets: &[u8]) -> Result<Edition, Error> {
    let targets = read::<Targets>("targets", targets)?.signed;
    Ok(Edition { version: targets.version.get(), expires: Utc(targets.expires.as_millisecond()) })
}

/// What a timestamp says; whether it holds is for [`check_online`].
///
/// # Errors
/// If it is none, or names no snapshot.
pub fn stamp(timestamp: &[u8]) -> Result<Stamp, Error> {
    let timestamp = read::<Timestamp>("timestamp", timestamp)?.signed;
    let snapshot = timestamp.meta.get("snapshot.json").ok_or_else(|| rule("timestamp", "names no snapshot"))?;
    let issued = timestamp._extra.get(ISSUED_AT).and_then(serde_json::Value::as_i64);
    Ok(Stamp {
        version: timestamp.version.get(),
        snapshot_version: snapshot.version.get(),
        issued: Utc(issued.unwrap_or_default()),
        expires: Utc(timestamp.expires.as_millisecond()),
    })
}

/// Number of the targets document that a snapshot says is the newest.
///
/// # Errors
/// If it is none, or names no targets.
pub fn newest_targets(snapshot: &[u8]) -> Result<u64, Error> {
    let snapshot = read::<Snapshot>("snapshot", snapshot)?.signed;
    let targets = snapshot.meta.get("targets.json").ok_or_else(|| rule("snapshot", "names no targets"))?;
    Ok(targets.version.get())
}

/// Whether a root names this key for a role.
///
/// # Errors
/// If the root is none.
pub fn names(root: &[u8], role: OnlineRole, key: &PublicKey) -> Result<bool, Error> {
    let root = read::<Root>("root", root)?.signed;
    let role = match role {
        OnlineRole::Snapshot => RoleType::Snapshot,
        OnlineRole::Timestamp => RoleType::Timestamp,
    };
    Ok(role_keys(&root, role).contains(&key.id().to_string()))
}

/// Whether everything that a robot reads hangs together under this root: targets, snapshot and timestamp are signed as it asks, and
/// each names the one below by number, length and digest.
///
/// # Errors
/// What does not hold.
pub fn check_online(root: &[u8], targets: &[u8], online: &Online) -> Result<(), Error> {
    check_targets(root, targets)?;
    let root = read::<Root>("root", root)?.signed;
    let snapshot = read::<Snapshot>("snapshot", &online.snapshot)?;
    let timestamp = read::<Timestamp>("timestamp", &online.timestamp)?;
    root.verify_role(&snapshot).map_err(|e| rule("snapshot", e))?;
    root.verify_role(&timestamp).map_err(|e| rule("timestamp", e))?;
    let targets_version = read::<Targets>("targets", targets)?.signed.version.get();
    let below = snapshot.signed.meta.get("targets.json");
    check_named("snapshot", below, targets, targets_version)?;
    let below = timestamp.signed.meta.get("snapshot.json");
    check_named("timestamp", below, &online.snapshot, snapshot.signed.version.get())
}

fn check_named(role: &'static str, named: Option<&Metafile>, document: &[u8], version: u64) -> Result<(), Error> {
    let named = named.ok_or_else(|| rule(role, "names no document"))?;
    let digest = named.hashes.as_ref().map(|hashes| hex(&hashes.sha256));
    let other = named.version.get() != version
        || named.length.is_some_and(|length| length != document.len() as u64)
        || digest.is_some_and(|digest| digest != Digest::of_content(document).to_string());
    if other { Err(rule(role, "names another document")) } else { Ok(()) }
}
