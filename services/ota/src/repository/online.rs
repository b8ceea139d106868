//! The keys of the server: they say which release is the newest, and sign orders to robots.
//!
//! Invariant: only a key that the newest root, or the newest set of directive keys, names signs anything.

use super::cannot_sign::CannotSign;
use super::error::{Error, io};
use super::newest::{Newest, SignedDocument};
use midshift_bundle::freshness::{self, OnlineRole, check_online};
use midshift_bundle::key_set::KeySet;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{Online, sign_online};
use midshift_core::time::Utc;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};

/// Keys that say which release is the newest. More than one of a role may lie ready; the root says which counts.
pub struct OnlineKeys {
    folder: PathBuf,
    snapshot: Vec<SecretKey>,
    timestamp: Vec<SecretKey>,
    /// Read again when none of them may sign.
    directive: RwLock<Vec<Arc<SecretKey>>>,
}

impl OnlineKeys {
    /// Reads `snapshot-*.pem`, `timestamp-*.pem` and `directive-*.pem` of a folder. Blocks.
    ///
    /// # Errors
    /// If one cannot be read, or a role has none.
    pub fn read(folder: &Path) -> Result<Self, Error> {
        let (snapshot, timestamp) = (keys_of(folder, "snapshot")?, keys_of(folder, "timestamp")?);
        let directive = RwLock::new(directive_keys(folder)?);
        Ok(Self { folder: folder.to_owned(), snapshot, timestamp, directive })
    }

    /// The key that orders to robots are signed with: the first that the newest set names and that is here; without a set the first by name.
    ///
    /// # Errors
    /// Robots take no orders of any key that is here.
    pub(super) fn directive(&self, newest: Option<&Newest>) -> Result<Arc<SecretKey>, CannotSign> {
        match newest.and_then(|newest| newest.key_set.as_ref()) {
            Some(set) => self.named_by(set).ok_or(CannotSign::Ended { number: set.number }),
            None if newest.is_some_and(Newest::lists_sets) => {
                Err(newest.and_then(|newest| newest.set_lost).map_or(CannotSign::Unknown, CannotSign::Lost))
            }
            // Read: every role has one.
            None => Ok(self.directives()[0].clone()),
        }
    }

    /// Reads the keys that orders are signed with again. Blocks.
    pub(super) fn read_directives(&self) -> Result<(), Error> {
        *self.directive.write().unwrap_or_else(PoisonError::into_inner) = directive_keys(&self.folder)?;
        Ok(())
    }

    pub(super) fn directives(&self) -> Vec<Arc<SecretKey>> {
        self.directive.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn named_by(&self, set: &KeySet) -> Option<Arc<SecretKey>> {
        let here = self.directives();
        set.keys.iter().find_map(|key| here.iter().find(|own| own.public() == *key)).cloned()
    }

    /// Signs that `targets` is the newest, with the keys that `root` names, and holds the result against it.
    pub(super) fn sign(
        &self,
        root: &SignedDocument,
        targets: &[u8],
        versions: (u64, u64),
        now: Utc,
    ) -> Result<Online, Error> {
        let named = |keys: &'_ [SecretKey], role, name| -> Result<usize, Error> {
            for (index, key) in keys.iter().enumerate() {
                if freshness::names(&root.bytes, role, &key.public())? {
                    return Ok(index);
                }
            }
            Err(Error::NotNamed { root_version: root.edition.version, role: name })
        };
        let snapshot = &self.snapshot[named(&self.snapshot, OnlineRole::Snapshot, "snapshot")?];
        let timestamp = &self.timestamp[named(&self.timestamp, OnlineRole::Timestamp, "timestamp")?];
        let online = sign_online(targets, versions.0, versions.1, now, snapshot, timestamp)?;
        check_online(&root.bytes, targets, &online)?;
        Ok(online)
    }
}

/// Every key file of a role, by name. Never none.
fn keys_of(folder: &Path, role: &'static str) -> Result<Vec<SecretKey>, Error> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(io("reading", folder))? {
        names.extend(entry.map_err(io("reading", folder))?.file_name().into_string());
    }
    names.sort();
    let prefix = format!("{role}-");
    let files = names.iter().filter(|name| name.starts_with(&prefix) && name.ends_with(".pem"));
    let keys: Vec<SecretKey> = files.map(|name| SecretKey::read(&folder.join(name))).collect::<Result<_, _>>()?;
    if keys.is_empty() {
        return Err(Error::NoKeyFile { folder: folder.to_owned(), role });
    }
    Ok(keys)
}

fn directive_keys(folder: &Path) -> Result<Vec<Arc<SecretKey>>, Error> {
    Ok(keys_of(folder, "directive")?.into_iter().map(Arc::new).collect())
}
