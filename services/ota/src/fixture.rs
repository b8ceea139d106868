//! Release people in a test: their keys, bundles, documents, and a robot that looks at what the server shows.

use crate::content::{Completeness, Content, DiskContent, FileRef, Room as Space};
use crate::folder::Owner;
use crate::repository::{Act, OnlineKeys, Repository};
use crate::{OtaService, Parts};
use async_trait::async_trait;
use bytes::Bytes;
use midshift_bundle::digest::Digest;
use midshift_bundle::key_set::KeySet;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::manifest::{Component, ComponentKind, FORMAT, Manifest};
use midshift_bundle::repository::{FileTarget, PEOPLE_LIFE_MS, RootDraft, Signers, sign_root, sign_targets};
use midshift_bundle::trust::{Error, Reading, Refreshed, Source, Trusted};
use midshift_core::time::{ScaledClock, Utc};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tempfile::TempDir;

/// When every test begins.
pub const START: Utc = Utc(1_800_000_000_000);

pub fn key(seed: u8) -> SecretKey {
    SecretKey::of_seed([seed; 32])
}

/// Seeds of the keys that sign now.
#[derive(Clone, Copy)]
pub struct Seeds {
    pub root: u8,
    pub targets: u8,
    pub snapshot: u8,
    pub timestamp: u8,
}

/// The keys that a test begins with.
pub const SEEDS: Seeds = Seeds { root: 1, targets: 2, snapshot: 3, timestamp: 4 };

/// A root of these keys, signed by `signers`.
pub fn root(version: u64, seeds: Seeds, expires: Utc, signers: &[u8]) -> Vec<u8> {
    let one = |seed: u8| Signers { keys: vec![key(seed).public()], threshold: 1 };
    let draft = RootDraft {
        version,
        expires,
        root: one(seeds.root),
        targets: one(seeds.targets),
        snapshot: one(seeds.snapshot),
        timestamp: one(seeds.timestamp),
    };
    let signers: Vec<SecretKey> = signers.iter().map(|seed| key(*seed)).collect();
    sign_root(&draft, &signers.iter().collect::<Vec<_>>()).expect("a root")
}

/// Root 1 of [`SEEDS`].
pub fn first_root() -> Vec<u8> {
    root(1, SEEDS, START.plus_ms(PEOPLE_LIFE_MS), &[SEEDS.root])
}

/// A bundle of one component: the manifest and the component's bytes.
pub fn bundle(name: &str, version: &str) -> (Manifest, Vec<u8>) {
    let content = format!("{name} {version} walks").into_bytes();
    let component = Component {
        hardware: BTreeSet::from(["h1".to_owned()]),
        ..Component::new(&format!("{name}-gait"), version, ComponentKind::Process, &content)
    };
    let manifest = Manifest {
        format: FORMAT,
        name: name.to_owned(),
        version: version.to_owned(),
        description: String::new(),
        hard_stop_codes: BTreeSet::new(),
        raises_floor: false,
        components: vec![component],
    };
    (manifest, content)
}

/// The two files of such a bundle, with their names.
pub fn files(name: &str, version: &str) -> Vec<(String, Vec<u8>)> {
    let (manifest, content) = bundle(name, version);
    vec![(manifest.target(), manifest.to_bytes()), (manifest.components[0].target(), content)]
}

/// Bytes that do not become shorter by themselves.
pub fn noise(seed: u64, length: usize) -> Vec<u8> {
    let mut state = seed;
    let step = |_| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    (0..length).map(step).collect()
}

/// A set of directive keys of these seeds as a file of the repository, signed by the key of seed `by`.
pub fn key_set(number: u64, seeds: &[u8], by: u8) -> (String, Vec<u8>) {
    let set = KeySet { number, keys: seeds.iter().map(|seed| key(*seed).public()).collect() };
    (set.target(), set.sign(&key(by)).expect("a set"))
}

pub fn target(name: &str, content: &[u8]) -> FileTarget {
    FileTarget { name: name.to_owned(), digest: Digest::of_content(content), length: content.len() as u64 }
}

/// The targets document after `previous` with these files more, signed by the key of `seed`.
pub fn targets(previous: Option<&[u8]>, add: &[(String, Vec<u8>)], seed: u8) -> Vec<u8> {
    let add: Vec<FileTarget> = add.iter().map(|(name, content)| target(name, content)).collect();
    sign_targets(previous, &add, &[], START.plus_ms(PEOPLE_LIFE_MS), &[&key(seed)]).expect("targets")
}

/// Writes the online keys of [`SEEDS`] and their successors, which a root may name later.
pub fn write_keys(folder: &Path) {
    std::fs::create_dir_all(folder).expect("a folder");
    for (name, seed) in [
        ("snapshot-1", 3),
        ("snapshot-2", 13),
        ("timestamp-1", 4),
        ("timestamp-2", 14),
        ("directive-1", 5),
        ("directive-2", 15),
    ] {
        key(seed).write(&folder.join(format!("{name}.pem"))).expect("a key");
    }
}

/// Makes a file unreadable, also for root: a folder stands in its place.
pub fn hide(file: &Path) {
    std::fs::rename(file, beside(file)).expect("moved");
    std::fs::create_dir(file).expect("a folder");
}

/// Puts a file back that was hidden.
pub fn give_back(file: &Path) {
    std::fs::remove_dir(file).expect("the folder");
    std::fs::rename(beside(file), file).expect("moved back");
}

/// Not in its own folder: what nobody knows is taken out of that at a start.
fn beside(file: &Path) -> PathBuf {
    let name = file.file_name().expect("a name").to_string_lossy();
    file.ancestors().nth(2).expect("a folder").join(format!("hidden-{name}"))
}

/// A repository in a folder of its own.
pub struct Room {
    pub dir: TempDir,
    pub content: Arc<DiskContent>,
    pub repository: Arc<Repository>,
}

impl Room {
    pub async fn new() -> Self {
        let dir = TempDir::new().expect("a folder");
        write_keys(&dir.path().join("keys"));
        Self::open(dir).await
    }
    async fn open(dir: TempDir) -> Self {
        let keys = OnlineKeys::read(&dir.path().join("keys")).expect("keys");
        let content = DiskContent::open(&dir.path().join("content"), Space::with_quota(1 << 30)).expect("a store");
        let content = Arc::new(content);
        let repository = Repository::open(&dir.path().join("metadata"), keys, content.clone()).await;
        Self { content, repository: Arc::new(repository.expect("a repository")), dir }
    }
    /// What a new process finds.
    pub async fn restarted(self) -> Self {
        drop(self.repository);
        Self::open(self.dir).await
    }
    pub fn metadata(&self) -> PathBuf {
        self.dir.path().join("metadata")
    }
    /// Brings files whole.
    pub async fn bring(&self, files: &[(String, Vec<u8>)]) {
        for (_, content) in files {
            let file = FileRef { digest: Digest::of_content(content), length: content.len() as u64 };
            if self.content.settle(file).await.expect("asked") != Completeness::Whole {
                self.content.append(file, 0, Bytes::copy_from_slice(content)).await.expect("room");
                assert_eq!(self.content.settle(file).await.expect("whole"), Completeness::Whole);
            }
        }
    }
    /// What a robot makes of what is shown.
    pub async fn shown_to(&self, robot: &Trusted, now: Utc) -> Result<Refreshed, Error> {
        let source = Arc::new(Shown(self.repository.clone()));
        robot.refresh(source, Reading { utc: now, is_synced: true }).await
    }
}

/// A robot that has just been made.
pub fn robot() -> Trusted {
    Trusted::new(&first_root()).expect("a root")
}

struct Shown(Arc<Repository>);

impl std::fmt::Debug for Shown {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Shown")
    }
}

#[async_trait]
impl Source for Shown {
    async fn fetch(&self, name: &str) -> std::io::Result<Option<Vec<u8>>> {
        self.0.document(name).await.map_err(std::io::Error::other)
    }
}

/// The service on a folder, by a clock that stands still at [`START`].
pub async fn service(dir: &TempDir) -> OtaService {
    let keys = dir.path().join("keys");
    if !keys.exists() {
        write_keys(&keys);
    }
    let clock = Arc::new(ScaledClock::new(|| 0, START, 1000));
    let parts =
        Parts { folder: dir.path().join("ota"), keys, room: Space::with_quota(1 << 30), clock, owner: Owner::Nobody };
    OtaService::open(parts).await.expect("a service")
}

/// Brings files and publishes the targets document that lists them as the first.
pub async fn release(service: &OtaService, files: &[(String, Vec<u8>)]) {
    let opened = service.opened().expect("keys");
    for (_, content) in files {
        let file = FileRef { digest: Digest::of_content(content), length: content.len() as u64 };
        opened.content.append(file, 0, Bytes::copy_from_slice(content)).await.expect("room");
        opened.content.settle(file).await.expect("whole");
    }
    let document = targets(None, files, SEEDS.targets);
    opened.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect("published");
}
