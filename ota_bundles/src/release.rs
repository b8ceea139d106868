//! The documents by which a bundle was believed, as a robot keeps them: what it runs is held against them at each start.
//!
//! Invariant: they hold as they were signed on the day that they were believed. That they have expired since, or that others sign now, does
//! not count: it gates what is accepted, never what runs. Called by agents.

use crate::digest::Digest;
use crate::manifest::Manifest;
use crate::repository::{self, check_root, check_targets, listed};
use midshift_core::reason::Refusal;
use serde::{Deserialize, Serialize};

/// Root, targets and manifest of one bundle, each as it was signed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Release {
    root: String,
    targets: String,
    manifest: String,
}

/// Why the documents do not make a release.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// They are not signed as they must be.
    #[error("checking the documents of a release: {0}")]
    Documents(#[from] repository::Error),
    /// The manifest is none.
    #[error("reading the manifest of a release: {0}")]
    Manifest(Box<Refusal>),
    /// The targets say nothing of a file.
    #[error("{0} is not listed")]
    Unlisted(String),
}

impl Release {
    /// Of documents and a manifest, once all hold together.
    ///
    /// # Errors
    /// If they are no release.
    pub fn verified(root: &str, targets: &str, manifest: &[u8]) -> Result<Self, Error> {
        let manifest = String::from_utf8_lossy(manifest).into_owned();
        let release = Self { root: root.to_owned(), targets: targets.to_owned(), manifest };
        release.check().map(|_| release)
    }

    /// Digest of the manifest: the bundle's name.
    pub fn bundle(&self) -> Digest {
        Digest::of_content(self.manifest.as_bytes())
    }

    /// The manifest, if the targets are signed as the root asks, and list it and all of its components.
    ///
    /// # Errors
    /// What does not hold.
    pub fn check(&self) -> Result<Manifest, Error> {
        check_root(self.root.as_bytes(), self.root.as_bytes())?;
        check_targets(self.root.as_bytes(), self.targets.as_bytes())?;
        let files = listed(self.targets.as_bytes())?;
        let is_listed = |digest, length| files.iter().any(|file| file.digest == digest && file.length == length);
        let read = Manifest::from_bytes(self.manifest.as_bytes());
        let manifest = read.map_err(|refusal| Error::Manifest(Box::new(refusal)))?;
        if !is_listed(self.bundle(), self.manifest.len() as u64) {
            return Err(Error::Unlisted(manifest.target()));
        }
        match manifest.components.iter().find(|c| !is_listed(c.digest, c.length)) {
            Some(component) => Err(Error::Unlisted(component.target())),
            None => Ok(manifest),
        }
    }
}
