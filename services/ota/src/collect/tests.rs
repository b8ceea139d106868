//! What goes, what stays, and that a cut anywhere costs nothing that is needed.

use super::{CollectionOutcome, Collector, NamedBundles, UNNAMED};
use crate::content::{Completeness, Content, DiskContent, Error, FileRef, Room};
use crate::fixture::{SEEDS, START, bundle, first_root, key, target, write_keys};
use crate::repository::{Act, OnlineKeys, Repository};
use bytes::Bytes;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::Manifest;
use midshift_bundle::repository::{FileTarget, PEOPLE_LIFE_MS, sign_targets};
use midshift_core::ids::BundleId;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;
use tokio::io::AsyncReadExt;

mod random;

/// Time that unnamed files have in tests, milliseconds.
const TIME: u64 = 1_000;

/// A manifest, and its files with their names.
type Bundle = (Manifest, Vec<(String, Vec<u8>)>);

struct Shop {
    dir: TempDir,
    room: Room,
    content: Arc<DiskContent>,
    repository: Repository,
    collector: Collector,
    named: NamedBundles,
}

impl Shop {
    async fn new(quota_bytes: u64) -> Self {
        let dir = TempDir::new().expect("a folder");
        write_keys(&dir.path().join("keys"));
        Self::open(dir, Room { quota_bytes, spare_bytes: 0, unnamed_ms: TIME }, NamedBundles::default()).await
    }
    async fn open(dir: TempDir, room: Room, named: NamedBundles) -> Self {
        let keys = OnlineKeys::read(&dir.path().join("keys")).expect("keys");
        let content = Arc::new(DiskContent::open(&dir.path().join("content"), room).expect("a store"));
        let repository = Repository::open(&dir.path().join("metadata"), keys, content.clone()).await;
        let collector = Collector::open(dir.path(), room).expect("marks");
        Self { repository: repository.expect("a repository"), dir, room, content, collector, named }
    }
    /// What a new process finds.
    async fn restarted(self) -> Self {
        let Self { dir, room, named, .. } = self;
        Self::open(dir, room, named).await
    }
    async fn bring(&self, content: &[u8]) -> Result<Completeness, Error> {
        let file = wanted(content);
        if self.content.settle(file).await? != Completeness::Whole {
            self.content.append(file, 0, Bytes::copy_from_slice(content)).await?;
        }
        self.content.settle(file).await
    }
    async fn has(&self, content: &[u8]) -> bool {
        self.content.length(Digest::of_content(content)).await.expect("asked").is_some()
    }
    /// Publishes a document that lists the files of these bundles and no other.
    async fn publish(&self, bundles: &[&Bundle]) -> Result<(), crate::repository::Error> {
        let before = self.repository.newest();
        let files = bundles.iter().flat_map(|(_, files)| files.iter()).map(|(name, bytes)| target(name, bytes));
        let listed: BTreeMap<String, FileTarget> = files.map(|file| (file.name.clone(), file)).collect();
        let known: BTreeSet<String> = before.iter().flat_map(|newest| newest.files.keys().cloned()).collect();
        let gone: Vec<String> = known.iter().filter(|name| !listed.contains_key(*name)).cloned().collect();
        let add: Vec<FileTarget> = listed.into_values().collect();
        let previous = before.as_ref().map(|newest| newest.targets.bytes.as_slice());
        let expires = START.plus_ms(PEOPLE_LIFE_MS);
        let document = sign_targets(previous, &add, &gone, expires, &[&key(SEEDS.targets)]).expect("targets");
        let expected = before.as_ref().map_or(0, |newest| newest.targets.edition.version);
        let roots = if expected == 0 { vec![first_root()] } else { Vec::new() };
        self.repository.publish(roots, document, expected, Act::of_release(START)).await.map(drop)
    }
    /// Brings and publishes.
    async fn release(&self, bundles: &[&Bundle]) {
        for (_, content) in bundles.iter().flat_map(|(_, files)| files) {
            self.bring(content).await.expect("room");
        }
        self.publish(bundles).await.expect("published");
    }
    /// Rows name these from now on.
    fn name(&mut self, bundles: &[&Bundle]) {
        self.named.bundles = bundles.iter().map(|(manifest, _)| id(manifest)).collect();
    }
    async fn pass(&self) -> Result<CollectionOutcome, crate::repository::Error> {
        let content = self.content.as_ref();
        self.collector.collect(content, &self.repository, &self.named, START).await
    }
    /// A pass after so many milliseconds of serving.
    async fn after(&mut self, ms: u64) -> CollectionOutcome {
        self.named.served_ms += ms;
        self.pass().await.expect("a pass")
    }
}

fn wanted(content: &[u8]) -> FileRef {
    FileRef { digest: Digest::of_content(content), length: content.len() as u64 }
}

fn id(manifest: &Manifest) -> BundleId {
    BundleId::parse(&Digest::of_content(&manifest.to_bytes()).to_string()).expect("an id")
}

/// A bundle with the files that it and others have.
fn with(version: &str, shared: &[(&str, &[u8])]) -> Bundle {
    let (mut manifest, content) = bundle("walk", version);
    let mut files = vec![(manifest.components[0].target(), content)];
    for (name, bytes) in shared {
        let mut component = manifest.components[0].clone();
        component.name = (*name).to_owned();
        component.version = "1.0.0".to_owned();
        (component.digest, component.length) = (Digest::of_content(bytes), bytes.len() as u64);
        files.push((component.target(), bytes.to_vec()));
        manifest.components.push(component);
    }
    files.push((manifest.target(), manifest.to_bytes()));
    (manifest, files)
}

fn bytes_in(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder).expect("a folder").map(|e| e.expect("an entry"));
    let counted = entries.filter(|e| !e.file_name().to_string_lossy().ends_with(".mark"));
    counted.map(|e| e.metadata().expect("a file").len()).sum()
}

#[tokio::test]
async fn what_nobody_published_goes_when_its_time_is_over_and_no_moment_earlier() {
    let mut shop = Shop::new(1 << 20).await;
    let walk = with("1.0.0", &[]);
    shop.release(&[&walk]).await;
    let stray = b"brought and never published";
    shop.bring(stray).await.expect("room");
    let half = wanted(b"half of this never comes");
    shop.content.append(half, 0, Bytes::from_static(b"half of")).await.expect("room");
    // The clock does not begin before a pass has seen that nothing names it.
    assert_eq!(shop.after(50 * TIME).await.files, 0);
    let waits = shop.after(TIME - 1).await;
    assert_eq!((waits.files, waits.unnamed_bytes), (0, stray.len() as u64 + 7));
    let done = shop.after(1).await;
    assert_eq!((done.files, done.file_bytes, done.unnamed_bytes), (2, stray.len() as u64 + 7, 0));
    assert!(!shop.has(stray).await);
    assert_eq!(shop.content.settle(half).await.expect("asked"), Completeness::Part(0));
    for (name, content) in &walk.1 {
        assert!(shop.has(content).await, "{name} is listed");
    }
    assert_eq!(shop.content.fill().used_bytes, bytes_in(&shop.dir.path().join("content")));
    assert_eq!(shop.collector.newest().expect("a pass").collected, done);
}

#[tokio::test]
async fn a_withdrawn_bundle_stays_while_it_is_named_and_shared_files_stay_for_the_others() {
    let mut shop = Shop::new(1 << 20).await;
    let (old, new) = (with("1.0.0", &[("map", b"of the hall")]), with("2.0.0", &[("map", b"of the hall")]));
    shop.release(&[&old, &new]).await;
    shop.name(&[&old]);
    shop.publish(&[&new]).await.expect("withdrawn");
    for _ in 0..3 {
        assert_eq!(shop.after(TIME).await, CollectionOutcome::default(), "a robot may need it");
    }
    shop.name(&[]);
    shop.after(1).await;
    assert_eq!(shop.after(TIME).await.files, 2, "its manifest and its own component");
    assert!(shop.has(b"of the hall").await);
    let missing = shop.publish(&[&old, &new]).await.expect_err("it is gone");
    assert!(matches!(missing, crate::repository::Error::Missing(files) if files.len() == 2));
    shop.release(&[&old, &new]).await;
    assert_eq!(shop.after(10 * TIME).await.files, 0);
}

#[tokio::test]
async fn published_again_within_its_time_it_need_not_be_brought_again() {
    let mut shop = Shop::new(1 << 20).await;
    let (old, new) = (with("1.0.0", &[]), with("2.0.0", &[]));
    shop.release(&[&old, &new]).await;
    shop.publish(&[&new]).await.expect("withdrawn");
    shop.after(1).await;
    shop.after(TIME - 1).await;
    shop.publish(&[&old, &new]).await.expect("all of it is here");
    assert_eq!(shop.after(TIME).await, CollectionOutcome::default());
    shop.publish(&[&new]).await.expect("withdrawn again");
    assert_eq!(shop.after(1).await.files, 0, "its time begins anew");
}

#[tokio::test]
async fn an_upload_that_goes_on_is_not_cut_and_one_that_was_left_alone_begins_anew() {
    let mut shop = Shop::new(1 << 20).await;
    let content = vec![7; 4_000];
    let file = wanted(&content);
    let piece = |at: usize| Bytes::copy_from_slice(&content[at..at + 1_000]);
    for at in [0, 1_000, 2_000] {
        shop.content.append(file, at as u64, piece(at)).await.expect("a piece");
        assert_eq!(shop.after(TIME).await.files, 0, "byte {at} came in the meantime");
    }
    shop.content.settle(file).await.expect("durable");
    // Killed: what was durable counts, and its time goes on where it was.
    let mut shop = shop.restarted().await;
    assert_eq!(shop.after(TIME - 1).await.files, 0);
    assert_eq!(shop.content.settle(file).await.expect("asked"), Completeness::Part(3_000));
    assert_eq!(shop.after(TIME - 1).await.files, 0, "somebody asked for it");
    shop.content.append(file, 3_000, piece(3_000)).await.expect("the rest");
    assert_eq!(shop.content.settle(file).await.expect("whole"), Completeness::Whole);
    assert_eq!(shop.after(TIME).await.files, 0, "it is new");
    assert_eq!(shop.content.settle(file).await.expect("whole"), Completeness::Whole);
    assert_eq!(shop.after(TIME).await.files, 0, "who goes on with the release asks for it again");
    assert_eq!(shop.after(TIME).await.files, 1);
    assert_eq!(shop.bring(&content).await.expect("brought anew"), Completeness::Whole);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_has_begun_to_read_reads_on() {
    let mut shop = Shop::new(1 << 20).await;
    let content = vec![9; 100_000];
    shop.bring(&content).await.expect("room");
    let digest = Digest::of_content(&content);
    let mut handle = shop.content.read(digest, 0..100_000).await.expect("readable").expect("there");
    shop.after(1).await;
    assert_eq!(shop.after(TIME).await.file_bytes, 100_000);
    let mut found = Vec::new();
    handle.read_to_end(&mut found).await.expect("its bytes");
    assert_eq!(found, content);
    assert!(shop.content.read(digest, 0..1).await.expect("asked").is_none(), "nobody begins any more");
}

#[tokio::test]
async fn what_is_known_of_unnamed_files_outlives_a_kill_and_its_loss_costs_only_time() {
    let mut shop = Shop::new(1 << 20).await;
    shop.bring(b"stray").await.expect("room");
    shop.after(1).await;
    let mut shop = shop.restarted().await;
    assert_eq!(shop.after(TIME).await.files, 1, "its time went on over the restart");
    for torn in ["{\"", "[]", ""] {
        shop.bring(b"stray").await.expect("room");
        shop.after(1).await;
        fs::write(shop.dir.path().join(UNNAMED), torn).expect("torn");
        shop = shop.restarted().await;
        assert_eq!(shop.after(TIME).await.files, 0, "{torn:?}");
        assert_eq!(shop.after(TIME).await.files, 1, "{torn:?}");
    }
    shop.bring(b"stray").await.expect("room");
    shop.named.served_ms = 50 * TIME;
    shop.after(0).await;
    // Rows of a backup: served less than when it was marked.
    shop.named.served_ms = TIME;
    assert_eq!(shop.after(0).await.files, 0);
    assert_eq!(shop.after(TIME - 1).await.files, 0);
    assert_eq!(shop.after(1).await.files, 1);
}

#[tokio::test]
async fn a_pass_that_was_cut_is_gone_on_with_and_marks_of_files_that_went_hurt_nobody() {
    let mut shop = Shop::new(1 << 20).await;
    for content in [b"one", b"two"] {
        shop.bring(content).await.expect("room");
    }
    shop.after(1).await;
    // As a cut between the first file and the marks leaves it.
    fs::remove_file(shop.dir.path().join("content").join(Digest::of_content(b"one").to_string())).expect("one went");
    let mut shop = shop.restarted().await;
    shop.bring(b"one").await.expect("brought anew at once");
    assert_eq!(shop.after(TIME).await.files, 1, "the other; who brings is there");
    assert!(shop.has(b"one").await && !shop.has(b"two").await);
}

#[tokio::test]
async fn when_nobody_can_tell_what_a_named_bundle_is_everything_stays() {
    let mut shop = Shop::new(1 << 20).await;
    let (old, new) = (with("1.0.0", &[]), with("2.0.0", &[]));
    shop.release(&[&old, &new]).await;
    shop.publish(&[&new]).await.expect("withdrawn");
    shop.bring(b"stray").await.expect("room");
    shop.name(&[&old]);
    shop.after(1).await;
    let manifest = Digest::of_content(&old.0.to_bytes());
    fs::write(shop.dir.path().join("content").join(manifest.to_string()), "no manifest").expect("damaged");
    shop.named.served_ms += 2 * TIME;
    let error = shop.pass().await.expect_err("it cannot be read");
    assert!(matches!(error, crate::repository::Error::Damaged { .. }), "{error}");
    assert!(shop.has(b"stray").await);
}

#[tokio::test]
async fn a_robot_that_names_a_file_that_is_no_bundle_keeps_that_file_and_stops_no_pass() {
    let mut shop = Shop::new(1 << 20).await;
    let (old, new) = (with("1.0.0", &[]), with("2.0.0", &[]));
    shop.release(&[&old, &new]).await;
    shop.publish(&[&new]).await.expect("withdrawn");
    shop.bring(b"stray").await.expect("room");
    shop.bring(b"another").await.expect("room");
    // A component of the withdrawn release, of the newest one, and a file of no release.
    let component = &old.1[0].1;
    let named =
        [component.as_slice(), new.1[0].1.as_slice(), b"stray"].map(|bytes| Digest::of_content(bytes).to_string());
    shop.named.bundles = named.iter().map(|digest| BundleId::parse(digest).expect("an id")).collect();
    shop.after(1).await;
    assert_eq!(shop.after(TIME).await.files, 2, "the old manifest and the other file");
    assert!(shop.has(component).await && shop.has(b"stray").await);
    shop.name(&[]);
    shop.after(1).await;
    assert_eq!(shop.after(TIME).await.files, 2, "nobody names them any more");
}

#[tokio::test]
async fn a_file_that_the_disk_holds_on_to_stops_no_pass_and_goes_when_it_can() {
    let mut shop = Shop::new(1 << 20).await;
    for content in [b"stuck", b"stray"] {
        shop.bring(content).await.expect("room");
    }
    shop.after(1).await;
    // No file can be removed where a folder with something in it is.
    let path = shop.dir.path().join("content").join(Digest::of_content(b"stuck").to_string());
    fs::remove_file(&path).expect("gone");
    fs::create_dir_all(path.join("in-the-way")).expect("a folder");
    let done = shop.after(TIME).await;
    assert_eq!((done.files, done.failed, done.unnamed_bytes), (1, 1, 5));
    assert!(!shop.has(b"stray").await, "the pass went to its end");
    fs::remove_dir_all(&path).expect("gone");
    fs::write(&path, b"stuck").expect("back");
    let done = shop.after(0).await;
    assert_eq!((done.files, done.failed, done.unnamed_bytes), (1, 0, 0));
}
