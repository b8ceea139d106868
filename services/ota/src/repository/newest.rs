//! What the repository says: its newest documents, the bundles that they list, and who published them.

use super::cannot_sign::SetLost;
use midshift_bundle::digest::Digest;
use midshift_bundle::encoded_target::EncodedTarget;
use midshift_bundle::freshness::{Edition, Stamp};
use midshift_bundle::key_set::KeySet;
use midshift_bundle::manifest::Manifest;
use midshift_bundle::repository::FileTarget;
use midshift_core::identity::{Actor, TokenId};
use midshift_core::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// A signed document of the repository, with its number and end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SignedDocument {
    /// As it was signed.
    pub bytes: Vec<u8>,
    /// Its number and end.
    pub edition: Edition,
}

/// A bundle of the newest targets document.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Release {
    /// Of its manifest.
    pub digest: Digest,
    /// What it holds.
    pub manifest: Manifest,
    /// When the server saw it first.
    pub seen: Utc,
}

/// Who published what: nothing that robots see. Of a publication by an older release nobody is known.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Publishers {
    /// The newest targets document.
    newest: Option<String>,
    /// The token that was shown for it.
    newest_token: Option<TokenId>,
    /// Each bundle of it, since it was listed.
    bundles: BTreeMap<Digest, String>,
    /// The token that was shown for each of them.
    tokens: BTreeMap<Digest, TokenId>,
}

impl Publishers {
    /// After a publication of these.
    pub(super) fn after(mut self, by: &Actor, releases: &[Release]) -> Self {
        let is_listed = |digest: &Digest| releases.iter().any(|release| release.digest == *digest);
        self.bundles.retain(|digest, _| is_listed(digest));
        self.tokens.retain(|digest, _| is_listed(digest));
        for release in releases.iter().filter(|release| !self.bundles.contains_key(&release.digest)) {
            self.tokens.extend(by.token().map(|token| (release.digest, token.clone())));
        }
        for release in releases {
            self.bundles.entry(release.digest).or_insert_with(|| by.to_string());
        }
        Self { newest: Some(by.to_string()), newest_token: by.token().cloned(), ..self }
    }
    /// Who published the newest document.
    pub fn newest(&self) -> Option<Actor> {
        self.newest.as_ref().map(|name| Actor::new(name, self.newest_token.clone()))
    }
    /// Who listed this bundle.
    pub fn bundle(&self, digest: &Digest) -> Option<Actor> {
        self.bundles.get(digest).map(|name| Actor::new(name, self.tokens.get(digest).cloned()))
    }
}

/// What the repository says now.
#[derive(Clone, Debug)]
pub struct Newest {
    /// Who may sign.
    pub root: SignedDocument,
    /// Which files there are.
    pub targets: SignedDocument,
    /// How fresh that is.
    pub stamp: Stamp,
    /// Files that may be handed out, by name.
    pub files: BTreeMap<String, FileTarget>,
    /// Bundles by name and version.
    pub releases: Vec<Release>,
    /// Who published them.
    pub by: Publishers,
    /// The newest set of keys that sign directives; none: robots have them from their trust files alone, or it is listed and cannot be read.
    pub key_set: Option<KeySet>,
    /// Manifests that are listed and that the disk did not give, though they are there, and the newest set of directive keys if it could not be
    /// read for whatever reason. They are tried again each second; nobody may conclude from it that they are gone.
    pub unread: BTreeSet<Digest>,
    /// The newest set of directive keys is gone or damaged, and what it was is not known.
    pub set_lost: Option<SetLost>,
    pub(super) digests: BTreeSet<Digest>,
    pub(super) timestamp: Vec<u8>,
}

impl Newest {
    /// What these documents say, without what is kept beside them.
    pub(super) fn new(
        root: SignedDocument,
        targets: SignedDocument,
        stamp: Stamp,
        files: Vec<FileTarget>,
        releases: Vec<Release>,
        timestamp: Vec<u8>,
    ) -> Self {
        let digests = files.iter().map(|file| file.digest).collect();
        let files = files.into_iter().map(|file| (file.name.clone(), file)).collect();
        Self {
            root,
            targets,
            stamp,
            files,
            releases,
            by: Publishers::default(),
            key_set: None,
            unread: BTreeSet::new(),
            set_lost: None,
            digests,
            timestamp,
        }
    }
    /// Every file of the newest targets document.
    pub const fn digests(&self) -> &BTreeSet<Digest> {
        &self.digests
    }
    /// Whether sets of directive keys are listed, readable or not.
    pub(super) fn lists_sets(&self) -> bool {
        self.files.keys().any(|name| KeySet::number_of(name).is_some())
    }
    /// The shortest listed encoded target of a file for a robot that has `bases`, the best first, and the one of them that it leads from.
    pub fn find_encoded(&self, to: Digest, bases: &[Digest]) -> Option<(Option<Digest>, &FileTarget)> {
        let mut froms = bases.iter().copied().map(Some).chain([None]);
        froms.find_map(|from| Some((from, self.files.get(&EncodedTarget { to, from }.target())?)))
    }
    /// Bytes of all listed encoded targets.
    pub fn encoded_bytes(&self) -> u64 {
        let encoded = self.files.iter().filter(|(name, _)| EncodedTarget::of_target(name).is_some());
        encoded.map(|(_, file)| file.length).sum()
    }
    /// Whether a signed release has this file.
    pub fn lists(&self, digest: Digest) -> bool {
        self.digests.contains(&digest)
    }
}
