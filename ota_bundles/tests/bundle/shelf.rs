//! A repository in memory with all its keys, which tests sign anew, hold back, and tamper with.

use async_trait::async_trait;
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{
    FileTarget, Online, PEOPLE_LIFE_MS, RootDraft, Signers, sign_online, sign_root, sign_targets,
};
use midshift_bundle::trust::{Error, Reading, Refreshed, Source, Trusted};
use midshift_core::time::Utc;
use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;

/// When every test begins.
pub const START: Utc = Utc(1_800_000_000_000);

/// A key that is the same in every run.
pub fn key(seed: u8) -> SecretKey {
    SecretKey::of_seed([seed; 32])
}

pub fn signers(seeds: &[u8], threshold: u64) -> Signers {
    Signers { keys: seeds.iter().map(|s| key(*s).public()).collect(), threshold }
}

pub fn target(name: &str, content: &[u8]) -> FileTarget {
    FileTarget { name: name.to_owned(), digest: Digest::of_content(content), length: content.len() as u64 }
}

/// Documents by name.
#[derive(Clone, Debug, Default)]
pub struct Documents(pub BTreeMap<String, Vec<u8>>);

#[async_trait]
impl Source for Documents {
    async fn fetch(&self, name: &str) -> io::Result<Option<Vec<u8>>> {
        Ok(self.0.get(name).cloned())
    }
}

/// Seeds of the keys that sign now.
#[derive(Clone, Copy)]
pub struct Seeds {
    pub root: u8,
    pub targets: u8,
    pub snapshot: u8,
    pub timestamp: u8,
}

/// A repository and the people behind it.
#[derive(Clone)]
pub struct Shelf {
    pub documents: Documents,
    pub seeds: Seeds,
    pub first_root: Vec<u8>,
    pub root_version: u64,
    pub targets: Vec<u8>,
    pub targets_version: u64,
    pub online_version: u64,
    pub now: Utc,
}

impl Shelf {
    /// A repository with one file, `walk-1.0.0.manifest`.
    pub fn new() -> Self {
        let seeds = Seeds { root: 1, targets: 2, snapshot: 3, timestamp: 4 };
        let mut shelf = Self {
            documents: Documents::default(),
            seeds,
            first_root: Vec::new(),
            root_version: 0,
            targets: Vec::new(),
            targets_version: 0,
            online_version: 0,
            now: START,
        };
        shelf.rotate(seeds);
        shelf.first_root = shelf.documents.0["1.root.json"].clone();
        shelf.release(&[target("walk-1.0.0.manifest", b"one")]);
        shelf
    }
    /// A robot that has just been made.
    pub fn robot(&self) -> Trusted {
        Trusted::new(&self.first_root).expect("a root")
    }
    /// The next root, signed by the old root key and the new one.
    pub fn rotate(&mut self, seeds: Seeds) {
        let old = key(self.seeds.root);
        self.root_version += 1;
        self.seeds = seeds;
        let draft = RootDraft {
            version: self.root_version,
            expires: self.now.plus_ms(PEOPLE_LIFE_MS),
            root: signers(&[seeds.root], 1),
            targets: signers(&[seeds.targets], 1),
            snapshot: signers(&[seeds.snapshot], 1),
            timestamp: signers(&[seeds.timestamp], 1),
        };
        let root = sign_root(&draft, &[&old, &key(seeds.root)]).expect("a root");
        self.documents.0.insert(format!("{}.root.json", self.root_version), root);
    }
    /// Adds files, signs everything anew.
    pub fn release(&mut self, add: &[FileTarget]) {
        let previous = Some(self.targets.as_slice()).filter(|t| !t.is_empty());
        let expires = self.now.plus_ms(PEOPLE_LIFE_MS);
        self.targets = sign_targets(previous, add, &[], expires, &[&key(self.seeds.targets)]).expect("targets");
        self.targets_version += 1;
        self.documents.0.insert(format!("{}.targets.json", self.targets_version), self.targets.clone());
        self.freshen();
    }
    /// What the service does each half day.
    pub fn freshen(&mut self) {
        self.online_version += 1;
        self.publish(self.online_version);
    }
    /// Signs snapshot and timestamp with a version of the caller's choice.
    pub fn publish(&mut self, version: u64) {
        let (snapshot, timestamp) = (key(self.seeds.snapshot), key(self.seeds.timestamp));
        let Online { snapshot, timestamp } =
            sign_online(&self.targets, version, version, self.now, &snapshot, &timestamp).expect("online");
        self.online_version = version;
        self.documents.0.insert(format!("{version}.snapshot.json"), snapshot);
        self.documents.0.insert("timestamp.json".to_owned(), timestamp);
    }
    pub fn clock(&self) -> Reading {
        Reading { utc: self.now, is_synced: true }
    }
    /// What a robot makes of it.
    pub async fn shown_to(&self, robot: &Trusted) -> Result<Refreshed, Error> {
        robot.refresh(Arc::new(self.documents.clone()), self.clock()).await
    }
}
