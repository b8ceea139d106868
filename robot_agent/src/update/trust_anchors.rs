//! What a robot believes from the day it was set up, as a file beside its ledger: `trust.json`.
//!
//! Invariant: a file that breaks a rule is refused whole with all its broken rules; nothing of it is believed. Written
//! once, by `dev` and by whoever enrols robots, and read by the binary at each start.

use super::updater::UpdateConfig;
use midshift_bundle::keys::{KeyId, PublicKey};
use midshift_bundle::repository::check_root;
use midshift_core::ids::SiteId;
use midshift_core::reason::{Refusal, Violations};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// Bytes of the file: a root document, and keys.
const TRUST_BYTES_MAX: u64 = 1024 * 1024;
/// Keys whose directives a robot takes: the one in use and those that will follow.
const DIRECTIVE_KEYS_MAX: usize = 8;

/// What a robot believes before it has heard anything.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrustAnchors {
    /// The first root of the repository of its site. The robot finds newer ones from there.
    pub root: Vec<u8>,
    /// Keys whose directives it takes.
    pub directive_keys: BTreeMap<KeyId, PublicKey>,
    /// Whose robot it is.
    pub site: SiteId,
}

/// A trust file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file.
    #[error("{doing} {path}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With which file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Its content.
    #[error("{path}: {refusal}")]
    Refused {
        /// Which file.
        path: PathBuf,
        /// Every broken rule.
        refusal: Box<Refusal>,
    },
}

/// The file as it stands there. A newer version's fields are not looked at: the server may be one.
#[derive(Serialize, Deserialize)]
struct Page {
    /// A TUF root document.
    root: serde_json::Value,
    /// Keys as TUF writes them.
    directive_keys: Vec<serde_json::Value>,
    site: String,
}

impl TrustAnchors {
    /// Reads a file.
    ///
    /// # Errors
    /// If it cannot be read; or everything that is wrong with it.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let read = || {
            let mut bytes = Vec::new();
            File::open(path)?.take(TRUST_BYTES_MAX + 1).read_to_end(&mut bytes)?;
            if bytes.len() as u64 > TRUST_BYTES_MAX { Err(io::ErrorKind::FileTooLarge.into()) } else { Ok(bytes) }
        };
        let bytes = read().map_err(|source| Error::Io { doing: "reading", path: path.to_owned(), source })?;
        Self::from_bytes(&bytes).map_err(|refusal| Error::Refused { path: path.to_owned(), refusal: Box::new(refusal) })
    }

    /// Writes a file, whole or not at all.
    ///
    /// # Errors
    /// If it breaks a rule, so that no robot would take it; or cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let refused = |refusal| Error::Refused { path: path.to_owned(), refusal: Box::new(refusal) };
        let bytes = self.to_bytes().map_err(refused)?;
        Self::from_bytes(&bytes).map_err(refused)?;
        midshift_durable::replace(path, &bytes).map_err(|source| Error::Io {
            doing: "writing",
            path: path.to_owned(),
            source,
        })
    }

    /// From the bytes of a file.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Refusal> {
        let page: Page = serde_json::from_slice(bytes).map_err(|e| Refusal::field("trust", e.to_string()))?;
        let mut bad = Violations::default();
        let root = page.root.to_string().into_bytes();
        bad.accept("root", check_root(&root, &root));
        let mut directive_keys = BTreeMap::new();
        for (at, key) in page.directive_keys.iter().enumerate() {
            let field = format!("directive_keys[{at}]");
            let Some(key) = PublicKey::from_tuf(key) else {
                bad.add(field, "is no ed25519 key as TUF writes it");
                continue;
            };
            if directive_keys.insert(key.id(), key).is_some() {
                bad.add(field, "stands there twice");
            }
        }
        if !(1..=DIRECTIVE_KEYS_MAX).contains(&page.directive_keys.len()) {
            bad.add("directive_keys", format!("must be 1 to {DIRECTIVE_KEYS_MAX}"));
        }
        let site = bad.accept("site", SiteId::parse(&page.site));
        bad.finish()?;
        match site {
            Some(site) => Ok(Self { root, directive_keys, site }),
            None => unreachable!("would have been noted"),
        }
    }

    fn to_bytes(&self) -> Result<Vec<u8>, Refusal> {
        let root = serde_json::from_slice(&self.root).map_err(|e| Refusal::field("root", e.to_string()))?;
        let directive_keys = self.directive_keys.values().map(PublicKey::tuf).collect();
        let page = Page { root, directive_keys, site: self.site.to_string() };
        serde_json::to_vec_pretty(&page).map_err(|e| Refusal::field("trust", e.to_string()))
    }

    /// What its updater believes: a clock that is set from the network, no components that bear on a safety function,
    /// and nobody who starts the program again.
    pub fn config(&self) -> UpdateConfig {
        UpdateConfig {
            root: self.root.clone(),
            directive_keys: self.directive_keys.clone(),
            clock_synced: true,
            allows_safety_related: false,
            is_launched: false,
        }
    }
}
