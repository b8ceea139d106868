//! Releases for a robot on the bench: a repository with throw-away keys, and the bytes of its bundles.

use async_trait::async_trait;
use midshift_agent::sets::FileRef;
use midshift_agent::update::UpdateConfig;
use midshift_agent::update::io::{DownloadPlan, Pieces, Remote};
use midshift_bundle::digest::Digest;
use midshift_bundle::directive::{Directive, LIFE_MS};
use midshift_bundle::key_set::KeySet;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::manifest::{Component, ComponentKind, FORMAT, Manifest, Migration, Needs};
use midshift_bundle::repository::{
    FileTarget, PEOPLE_LIFE_MS, RootDraft, Signers, sign_online, sign_root, sign_targets,
};
use midshift_core::ids::RobotId;
use midshift_core::time::Utc;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard};

/// When everything is signed.
pub const SIGNED: Utc = Utc(1_700_000_000_000);
/// The robot of the bench.
pub const MODEL: &str = "bench-1";

fn key(seed: u8) -> SecretKey {
    SecretKey::of_seed([seed; 32])
}

#[derive(Debug, Default)]
struct Shelf {
    documents: BTreeMap<String, Vec<u8>>,
    bytes: BTreeMap<Digest, Vec<u8>>,
    targets: Vec<u8>,
    version: u64,
    roots: u64,
    /// Seeds of the keys of root and targets.
    people: (u8, u8),
    /// Seeds of the keys of snapshot and timestamp.
    online: (u8, u8),
    /// Milliseconds after [`SIGNED`] at which the server signs now.
    later_ms: u64,
    /// Nothing answers.
    cut: bool,
    /// Every piece of content has a wrong byte.
    corrupt: bool,
    /// Bytes that went out.
    served: u64,
    /// What is said of ways to a file, first one first; the last stays.
    ways: BTreeMap<Digest, Vec<DownloadPlan>>,
    asked: Vec<Vec<Digest>>,
    /// Seed of the directive key that robots are set up with; none: 7.
    trust: Option<u8>,
}

/// A repository that robots reach.
#[derive(Clone, Debug)]
pub struct Releases(Arc<Mutex<Shelf>>);

/// One bundle of it.
#[derive(Clone, Debug)]
pub struct Bundle {
    pub digest: Digest,
    pub length: u64,
    pub manifest: Manifest,
}

pub fn component(name: &str, version: &str, kind: ComponentKind, content: &[u8]) -> Component {
    Component { hardware: [MODEL.to_owned()].into(), ..Component::new(name, version, kind, content) }
}

impl Releases {
    pub fn new() -> Self {
        let releases = Self(Arc::default());
        releases.begin((1, 2), (3, 4));
        releases
    }
    /// A new project of these people: nothing of another one is here any more.
    pub fn begin(&self, people: (u8, u8), online: (u8, u8)) {
        *self.shelf() = Shelf { people, ..Shelf::default() };
        self.rotate(online);
        self.sign(&[]);
    }
    /// Whoever has the root key hands everything over to other keys.
    pub fn hand_over(&self, people: (u8, u8), online: (u8, u8)) {
        let before = std::mem::replace(&mut self.shelf().people, people);
        self.next_root(before.0, online);
        self.sign(&[]);
    }
    /// The next root, with these seeds of keys for snapshot and timestamp. What was signed with others holds no more.
    pub fn rotate(&self, online: (u8, u8)) {
        let by = self.shelf().people.0;
        self.next_root(by, online);
    }
    /// The next root, signed by the key of seed `by` and its own.
    fn next_root(&self, by: u8, online: (u8, u8)) {
        let mut shelf = self.shelf();
        (shelf.online, shelf.roots) = (online, shelf.roots + 1);
        let (version, people) = (shelf.roots, shelf.people);
        let one = |seed: u8| Signers { keys: vec![key(seed).public()], threshold: 1 };
        let expires = SIGNED.plus_ms(PEOPLE_LIFE_MS);
        let (snapshot, timestamp) = (one(online.0), one(online.1));
        let (root, targets) = (one(people.0), one(people.1));
        let draft = RootDraft { version, expires, root, targets, snapshot, timestamp };
        let root = sign_root(&draft, &[&key(by), &key(people.0)]).expect("a root");
        shelf.documents.insert(format!("{version}.root.json"), root);
    }
    /// A thief of the keys of snapshot and timestamp signs what is released with a version of his own.
    pub fn forward(&self, version: u64) {
        self.put_online(&mut self.shelf(), version);
    }
    fn put_online(&self, shelf: &mut Shelf, version: u64) {
        let (snapshot, timestamp) = (key(shelf.online.0), key(shelf.online.1));
        let now = SIGNED.plus_ms(shelf.later_ms);
        let online = sign_online(&shelf.targets, version, version, now, &snapshot, &timestamp).expect("online");
        shelf.documents.insert(format!("{version}.snapshot.json"), online.snapshot);
        shelf.documents.insert("timestamp.json".to_owned(), online.timestamp);
    }
    /// A thief of the keys `online` of snapshot and timestamp signs, with a version of his own, that this is the newest
    /// targets document.
    pub fn present(&self, online: (u8, u8), (number, targets): (u64, &[u8]), version: u64) {
        let mut shelf = self.shelf();
        let (snapshot, timestamp) = (key(online.0), key(online.1));
        let now = SIGNED.plus_ms(shelf.later_ms);
        let online = sign_online(targets, version, version, now, &snapshot, &timestamp).expect("online");
        shelf.documents.insert(format!("{number}.targets.json"), targets.to_vec());
        shelf.documents.insert(format!("{version}.snapshot.json"), online.snapshot);
        shelf.documents.insert("timestamp.json".to_owned(), online.timestamp);
    }
    /// What a server without any key has kept: its newest documents are these again.
    pub fn replay(&self, kept: &BTreeMap<String, Vec<u8>>) {
        let mut shelf = self.shelf();
        let roots: BTreeMap<_, _> = shelf
            .documents
            .iter()
            .filter(|(name, _)| name.ends_with("root.json"))
            .map(|(n, d)| (n.clone(), d.clone()))
            .collect();
        shelf.documents = kept.clone();
        shelf.documents.extend(roots);
    }
    /// All documents as they are now.
    pub fn documents(&self) -> BTreeMap<String, Vec<u8>> {
        self.shelf().documents.clone()
    }
    fn shelf(&self) -> MutexGuard<'_, Shelf> {
        self.0.lock().expect("not poisoned")
    }
    fn sign(&self, add: &[FileTarget]) {
        let mut shelf = self.shelf();
        let previous = Some(shelf.targets.clone()).filter(|t| !t.is_empty());
        let expires = SIGNED.plus_ms(PEOPLE_LIFE_MS);
        let by = key(shelf.people.1);
        shelf.targets = sign_targets(previous.as_deref(), add, &[], expires, &[&by]).expect("targets");
        shelf.version += 1;
        let version = shelf.version;
        let targets = shelf.targets.clone();
        shelf.documents.insert(format!("{version}.targets.json"), targets);
        self.put_online(&mut shelf, version);
    }
    /// Time passes, and everything is signed anew.
    pub fn pass(&self, ms: u64) {
        self.shelf().later_ms += ms;
        self.sign(&[]);
    }
    /// Releases a bundle of a program and its settings.
    pub fn release(&self, version: &str) -> Bundle {
        self.release_as(version, |_| {})
    }
    /// As [`Releases::release`], with an operating system, and a program that migrates data.
    pub fn release_base(&self, version: &str) -> Bundle {
        let base = format!("base {version}").repeat(9_000).into_bytes();
        let mut os = component("os", version, ComponentKind::Base, &base);
        os.needs = Needs::Reboot;
        self.hold(&base);
        self.release_as(version, |manifest| {
            manifest.components.push(os);
            manifest.components[0].data_migration = Migration::Reversible;
        })
    }
    /// As [`Releases::release`], after `change` of its manifest. Bytes of a component that this adds are held already.
    pub fn release_as(&self, version: &str, change: impl FnOnce(&mut Manifest)) -> Bundle {
        let program = format!("program {version}").repeat(30_000).into_bytes();
        let settings = format!("settings {version}").into_bytes();
        let mut manifest = Manifest {
            format: FORMAT,
            name: "walk".to_owned(),
            version: version.to_owned(),
            description: String::new(),
            hard_stop_codes: BTreeSet::new(),
            raises_floor: true,
            components: vec![
                component("gait", version, ComponentKind::Process, &program),
                component("behaviour", version, ComponentKind::Config, &settings),
            ],
        };
        change(&mut manifest);
        let bytes = manifest.to_bytes();
        let file = |name: String, content: &[u8]| FileTarget {
            name,
            digest: Digest::of_content(content),
            length: content.len() as u64,
        };
        let mut files = vec![
            file(manifest.target(), &bytes),
            file(manifest.components[0].target(), &program),
            file(manifest.components[1].target(), &settings),
        ];
        let held = |c: &Component| FileTarget { name: c.target(), digest: c.digest, length: c.length };
        files.extend(manifest.components[2..].iter().map(held));
        self.sign(&files);
        let bundle = Bundle { digest: Digest::of_content(&bytes), length: bytes.len() as u64, manifest };
        self.shelf().bytes.extend([bytes, program, settings].map(|b| (Digest::of_content(&b), b)));
        bundle
    }
    /// The order to take `bundle`, signed.
    pub fn directive(&self, bundle: &Bundle, generation: u64) -> String {
        self.directive_as(bundle, generation, |_| {})
    }
    pub fn directive_as(&self, bundle: &Bundle, generation: u64, change: impl FnOnce(&mut Directive)) -> String {
        let mut directive = Directive {
            robot_id: RobotId::parse("rbt-01").expect("a name"),
            key_id: key(7).public().id(),
            generation,
            manifest: bundle.digest,
            manifest_length: bundle.length,
            rollback_floor: 0,
            issued_at: SIGNED,
            expires: SIGNED.plus_ms(LIFE_MS),
            rollout: "walk".to_owned(),
        };
        change(&mut directive);
        String::from_utf8(directive.sign(&key(7))).expect("text")
    }
    /// As [`Releases::directive`], signed with the key of another seed.
    pub fn directive_by(&self, seed: u8, bundle: &Bundle, generation: u64) -> String {
        let mut signed = Vec::new();
        self.directive_as(bundle, generation, |directive| signed = directive.clone().sign(&key(seed)));
        String::from_utf8(signed).expect("text")
    }
    /// A set of directive keys of these seeds, signed with the key of seed `by`, that the server holds and no release
    /// lists.
    pub fn hold_keys(&self, number: u64, seeds: &[u8], by: u8) -> FileTarget {
        let set = KeySet { number, keys: seeds.iter().map(|seed| key(*seed).public()).collect() };
        let held = self.hold(&set.sign(&key(by)).expect("a set"));
        FileTarget { name: set.target(), digest: held.digest, length: held.length }
    }
    /// As [`Releases::hold_keys`], and the newest release lists it.
    pub fn list_keys(&self, number: u64, seeds: &[u8], by: u8) {
        self.sign(&[self.hold_keys(number, seeds, by)]);
    }
    /// What a robot is set up with.
    pub fn config(&self) -> UpdateConfig {
        let trusted = key(self.shelf().trust.unwrap_or(7));
        UpdateConfig {
            root: self.shelf().documents["1.root.json"].clone(),
            directive_keys: [trusted.public()].into_iter().map(|k| (k.id(), k)).collect(),
            clock_synced: true,
            allows_safety_related: false,
            is_launched: true,
        }
    }
    /// Robots are set up with the directive key of this seed from now on.
    pub fn trust(&self, seed: u8) {
        self.shelf().trust = Some(seed);
    }
    pub fn cut(&self, cut: bool) {
        self.shelf().cut = cut;
    }
    pub fn corrupt(&self, corrupt: bool) {
        self.shelf().corrupt = corrupt;
    }
    /// Has bytes that no release lists.
    pub fn hold(&self, bytes: &[u8]) -> FileRef {
        self.shelf().bytes.insert(Digest::of_content(bytes), bytes.to_vec());
        FileRef { digest: Digest::of_content(bytes), length: bytes.len() as u64 }
    }
    pub fn drop_bytes(&self, digest: &Digest) {
        self.shelf().bytes.remove(digest);
    }
    /// Says this of ways to a file from now on, one after the other.
    pub fn ways(&self, wanted: &FileRef, mut ways: Vec<DownloadPlan>) {
        ways.reverse();
        self.shelf().ways.insert(wanted.digest, ways);
    }
    /// Bases of each question about ways so far.
    pub fn asked(&self) -> Vec<Vec<Digest>> {
        self.shelf().asked.clone()
    }
    pub fn served(&self) -> u64 {
        self.shelf().served
    }
}

#[async_trait]
impl Remote for Releases {
    async fn plan_download(&self, wanted: &FileRef, bases: &[Digest]) -> io::Result<DownloadPlan> {
        let mut shelf = self.shelf();
        if shelf.cut {
            return Err(io::ErrorKind::NotConnected.into());
        }
        shelf.asked.push(bases.to_vec());
        let Some(ways) = shelf.ways.get_mut(&wanted.digest) else { return Ok(DownloadPlan::AsItIs) };
        Ok(if ways.len() > 1 { ways.pop() } else { ways.last().copied() }.unwrap_or(DownloadPlan::AsItIs))
    }
    async fn metadata(&self, name: &str) -> io::Result<Option<Vec<u8>>> {
        let shelf = self.shelf();
        if shelf.cut { Err(io::ErrorKind::NotConnected.into()) } else { Ok(shelf.documents.get(name).cloned()) }
    }
    async fn range(&self, digest: &Digest, range: Range<u64>) -> io::Result<Pieces> {
        let mut shelf = self.shelf();
        if shelf.cut {
            return Err(io::ErrorKind::NotConnected.into());
        }
        let content = shelf.bytes.get(digest).ok_or_else(|| io::Error::from(io::ErrorKind::NotFound))?;
        let mut bytes = content[range.start as usize..range.end as usize].to_vec();
        if shelf.corrupt {
            bytes[0] ^= 1;
        }
        shelf.served += bytes.len() as u64;
        // In pieces that do not lie on chunks.
        let pieces: Vec<io::Result<Vec<u8>>> = bytes.chunks(100_000).map(|piece| Ok(piece.to_vec())).collect();
        Ok(Box::pin(tokio_stream::iter(pieces)))
    }
}
