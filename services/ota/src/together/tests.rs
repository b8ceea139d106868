//! Two processes that sign and one that reads, over one folder: nothing forks, nothing goes back, nothing is lost with one of them.

use crate::collect::{CollectionOutcome, NamedBundles};
use crate::content::{Completeness, Error, FileRef, Room};
use crate::downloads::Downloads;
use crate::fixture::{SEEDS, START, files, first_root, noise, robot, root, targets, write_keys};
use crate::folder::Owner;
use crate::open_folder::OpenFolder;
use crate::repository::{self, Act, FRESHEN_AFTER_MS};
use crate::{OtaReader, OtaService, Parts};
use bytes::Bytes;
use http::{Request as Get, StatusCode};
use midshift_bundle::digest::Digest;
use midshift_bundle::encoded_target::EncodedTarget;
use midshift_bundle::repository::PEOPLE_LIFE_MS;
use midshift_core::time::{ScaledClock, Utc};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::chunk_service_server::ChunkService;
use midshift_store::StoreId;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::SystemTime;
use tempfile::TempDir;
use tokio_stream::StreamExt;
use tonic::{Code, Request, Status};
use tower::ServiceExt;

const UNNAMED_MS: u64 = 1_000_000;

/// A site with a volume.
struct Site {
    dir: TempDir,
    quota_bytes: u64,
    /// Of the clock of every process.
    us: Arc<AtomicU64>,
}

impl Site {
    fn new() -> Self {
        Self::with_quota(1 << 30)
    }
    fn with_quota(quota_bytes: u64) -> Self {
        let dir = TempDir::new().expect("a folder");
        write_keys(&dir.path().join("keys"));
        Self { dir, quota_bytes, us: Arc::default() }
    }
    fn folder(&self) -> PathBuf {
        self.dir.path().join("volume")
    }
    fn metadata(&self) -> PathBuf {
        self.folder().join("metadata")
    }
    fn id(&self) -> StoreId {
        StoreId(Arc::from("store"))
    }
    /// A process that starts now.
    async fn process(&self) -> OtaService {
        let us = self.us.clone();
        let parts = Parts {
            folder: self.folder(),
            keys: self.dir.path().join("keys"),
            room: Room { unnamed_ms: UNNAMED_MS, ..Room::with_quota(self.quota_bytes) },
            clock: Arc::new(ScaledClock::new(move || us.load(Relaxed), START, 1000)),
            owner: Owner::Shared { store_id: self.id(), known_bundles: 0 },
        };
        OtaService::open(parts).await.expect("a service")
    }
    async fn reader(&self) -> OtaReader {
        OtaReader::open(self.folder(), self.id()).await.expect("a reader")
    }
    /// Everything that lies in the volume, with when it changed.
    fn contents(&self) -> Vec<(PathBuf, SystemTime)> {
        let (mut found, mut open) = (Vec::new(), vec![self.folder()]);
        while let Some(folder) = open.pop() {
            for entry in fs::read_dir(&folder).expect("a folder") {
                let entry = entry.expect("an entry");
                let meta = entry.metadata().expect("its times");
                if meta.is_dir() {
                    open.push(entry.path());
                }
                found.push((entry.path(), meta.modified().expect("a time")));
            }
        }
        found.sort();
        found
    }
}

fn opened(service: &OtaService) -> &OpenFolder {
    service.opened().expect("keys")
}

fn wanted(content: &[u8]) -> FileRef {
    FileRef { digest: Digest::of_content(content), length: content.len() as u64 }
}

async fn append(service: &OtaService, content: &[u8], range: std::ops::Range<usize>) -> Result<(), Error> {
    let piece = Bytes::copy_from_slice(&content[range.clone()]);
    opened(service).content.append(wanted(content), range.start as u64, piece).await
}

async fn settle(service: &OtaService, content: &[u8]) -> Completeness {
    opened(service).content.settle(wanted(content)).await.expect("asked")
}

async fn bring(service: &OtaService, content: &[u8]) {
    append(service, content, 0..content.len()).await.expect("room");
    assert_eq!(settle(service, content).await, Completeness::Whole);
}

async fn has(service: &OtaService, content: &[u8]) -> bool {
    opened(service).content.length(Digest::of_content(content)).await.expect("asked").is_some()
}

/// Brings files and publishes a document that lists them too.
async fn publish(
    service: &OtaService,
    previous: Option<&[u8]>,
    files: &[(String, Vec<u8>)],
    expected: u64,
) -> Result<Vec<u8>, repository::Error> {
    for (_, content) in files {
        if settle(service, content).await != Completeness::Whole {
            bring(service, content).await;
        }
    }
    let document = targets(previous, files, SEEDS.targets);
    let roots = if previous.is_none() { vec![first_root()] } else { Vec::new() };
    opened(service).repository.publish(roots, document.clone(), expected, Act::of_release(START)).await?;
    Ok(document)
}

/// Versions of timestamp and targets that a process shows.
async fn shown(service: &OtaService) -> (u64, u64) {
    let repository = &opened(service).repository;
    repository.documents().follow().await.expect("readable");
    let newest = repository.newest().expect("published");
    (newest.stamp.version, newest.targets.edition.version)
}

#[tokio::test]
async fn a_file_that_is_brought_to_two_processes_grows_in_each_from_where_it_ends() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let content = noise(1, 1000);
    append(&one, &content, 0..400).await.expect("the beginning");
    let early = append(&two, &content, 0..400).await;
    assert!(matches!(early, Err(Error::Moved { at: 400, offset: 0 })), "{early:?}");
    append(&two, &content, 400..700).await.expect("from where it ends");
    let early = append(&one, &content, 400..700).await;
    assert!(matches!(early, Err(Error::Moved { at: 700, offset: 400 })), "{early:?}");
    assert_eq!(settle(&one, &content).await, Completeness::Part(700));
    append(&one, &content, 700..1000).await.expect("the rest");
    assert_eq!(settle(&two, &content).await, Completeness::Whole);
    assert_eq!(settle(&one, &content).await, Completeness::Whole);
    assert!(has(&one, &content).await && has(&two, &content).await);
}

#[tokio::test]
async fn an_upload_goes_on_in_another_process_when_the_one_that_had_it_is_gone() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let content = noise(2, 1000);
    append(&one, &content, 0..400).await.expect("never acknowledged");
    drop(one);
    assert_eq!(settle(&two, &content).await, Completeness::Part(400));
    append(&two, &content, 400..1000).await.expect("the rest");
    assert_eq!(settle(&two, &content).await, Completeness::Whole);
}

#[tokio::test]
async fn what_was_cut_between_two_steps_of_an_upload_is_mended_by_the_next_turn() {
    let site = Site::new();
    let two = site.process().await;
    let (content, files) = (noise(3, 1000), site.folder().join("content"));
    let digest = Digest::of_content(&content);
    // A part without its word, and a word without its part.
    fs::write(files.join(format!("{digest}.part")), b"xyz").expect("written");
    fs::write(files.join(format!("{}.mark", Digest::of_content(b"x"))), b"{}").expect("written");
    assert_eq!(settle(&two, &content).await, Completeness::Part(0));
    bring(&two, &content).await;
    // Named, and the word still there.
    fs::write(files.join(format!("{digest}.mark")), b"{\"length\":1000,\"durable\":1000}").expect("written");
    assert_eq!(settle(&two, &content).await, Completeness::Whole);
    let names: Vec<_> = fs::read_dir(&files).expect("a folder").map(|e| e.expect("an entry").file_name()).collect();
    assert_eq!(names, [std::ffi::OsString::from(digest.to_string())]);
}

#[tokio::test]
async fn after_a_loss_of_power_the_first_process_believes_only_what_was_durable() {
    let site = Site::new();
    let content = noise(4, 1000);
    let one = site.process().await;
    append(&one, &content, 0..400).await.expect("a piece");
    assert_eq!(settle(&one, &content).await, Completeness::Part(400));
    drop(one);
    let part = site.folder().join("content").join(format!("{}.part", Digest::of_content(&content)));
    let mut torn = fs::read(&part).expect("the part");
    torn.extend([0; 300]);
    fs::write(&part, torn).expect("what no process wrote");
    let one = site.process().await;
    let two = site.process().await;
    assert_eq!(settle(&two, &content).await, Completeness::Part(400));
    append(&one, &content, 400..1000).await.expect("the rest");
    assert_eq!(settle(&two, &content).await, Completeness::Whole);
}

#[tokio::test]
async fn wrong_bytes_that_came_through_two_processes_are_thrown_away() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let (content, other) = (noise(5, 1000), noise(6, 1000));
    append(&one, &content, 0..400).await.expect("right");
    let file = wanted(&content);
    opened(&two).content.append(file, 400, Bytes::copy_from_slice(&other[400..])).await.expect("nobody knows yet");
    let error = opened(&one).content.settle(file).await.expect_err("others");
    assert!(matches!(error, Error::WrongBytes { .. }), "{error}");
    bring(&two, &content).await;
}

#[tokio::test]
async fn the_quota_is_one_for_all_processes() {
    let site = Site::with_quota(100_000);
    let (one, two) = (site.process().await, site.process().await);
    bring(&one, &noise(7, 60_000)).await;
    let error = append(&two, &noise(8, 60_000), 0..1000).await.expect_err("full");
    assert!(matches!(error, Error::Full { missing: 60_000, used: 60_000, free: 40_000, .. }), "{error}");
    bring(&two, &noise(8, 40_000)).await;
    let error = append(&one, &noise(9, 1), 0..1).await.expect_err("full");
    assert!(matches!(error, Error::Full { used: 100_000, free: 0, .. }), "{error}");
}

#[tokio::test]
async fn a_publication_is_known_to_the_other_at_once_and_who_did_not_know_it_is_refused() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let first = publish(&one, None, &files("walk", "1.0.0"), 0).await.expect("the first");
    let error = publish(&two, None, &files("arm", "1.0.0"), 0).await.expect_err("too late");
    assert!(matches!(error, repository::Error::Moved { newest: 1, expected: 0 }), "{error}");
    let second = publish(&two, Some(&first), &files("walk", "1.1.0"), 1).await.expect("on the newest");
    let error = publish(&one, Some(&first), &files("arm", "1.0.0"), 1).await.expect_err("too late");
    assert!(matches!(error, repository::Error::Moved { newest: 2, expected: 1 }), "{error}");
    let again = opened(&one)
        .repository
        .publish(Vec::new(), second, 1, Act::of_release(START))
        .await
        .expect("the answer was lost");
    assert_eq!(again.stamp.version, 2, "nothing was signed for that");
    assert_eq!((shown(&one).await, shown(&two).await), ((2, 2), (2, 2)));
}

#[tokio::test]
async fn freshness_is_signed_by_one_of_them_and_its_versions_never_fork() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    publish(&one, None, &files("walk", "1.0.0"), 0).await.expect("published");
    let mut trusted = robot();
    for half_day in 1..=6_u64 {
        let now = START.plus_ms(half_day * FRESHEN_AFTER_MS);
        site.us.store(half_day * FRESHEN_AFTER_MS * 1000, Relaxed);
        let (signs, comes_late) = if half_day % 2 == 0 { (&one, &two) } else { (&two, &one) };
        opened(signs).repository.freshen(now).await.expect("signed");
        let told = opened(comes_late).repository.freshen(now).await.expect("looked");
        assert_eq!(told, Some(FRESHEN_AFTER_MS), "it is fresh");
        assert_eq!((shown(&one).await, shown(&two).await), ((half_day + 1, 1), (half_day + 1, 1)));
        trusted = refreshed(&trusted, &[&one, &two][half_day as usize % 2].downloads(), now).await;
    }
}

/// What a robot believes after it looked.
async fn refreshed(
    robot: &midshift_bundle::trust::Trusted,
    downloads: &Downloads,
    now: Utc,
) -> midshift_bundle::trust::Trusted {
    let reading = midshift_bundle::trust::Reading { utc: now, is_synced: true };
    robot.refresh(Arc::new(Shown(downloads.clone())), reading).await.expect("believed").trusted
}

struct Shown(Downloads);

impl std::fmt::Debug for Shown {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Shown")
    }
}

#[async_trait::async_trait]
impl midshift_bundle::trust::Source for Shown {
    async fn fetch(&self, name: &str) -> std::io::Result<Option<Vec<u8>>> {
        let shown = self.0.shown().map_err(std::io::Error::other)?;
        shown.documents.document(name).await.map_err(std::io::Error::other)
    }
}

#[tokio::test]
async fn a_process_killed_at_any_write_of_a_publication_leaves_the_other_able_to_publish() {
    let rotated = crate::fixture::Seeds { root: 11, targets: 12, snapshot: 13, timestamp: 14 };
    let more = files("walk", "1.1.0");
    let mut cut = 0;
    loop {
        let site = Site::new();
        let (one, two) = (site.process().await, site.process().await);
        let first = publish(&one, None, &files("walk", "1.0.0"), 0).await.expect("published");
        assert_eq!(shown(&two).await, (1, 1));
        let trusted = refreshed(&robot(), &two.downloads(), START).await;
        for (_, content) in &more {
            bring(&one, content).await;
        }
        let roots = vec![root(2, rotated, START.plus_ms(PEOPLE_LIFE_MS), &[SEEDS.root, rotated.root])];
        let document = targets(Some(&first), &more, rotated.targets);
        let writes = opened(&one).repository.prepared(roots.clone(), document.clone(), START).await.expect("it holds");
        for (name, bytes) in &writes[..cut] {
            fs::write(site.metadata().join(name), bytes).expect("written");
        }
        if let Some((name, bytes)) = writes.get(cut) {
            fs::write(site.metadata().join(format!("{name}.new")), &bytes[..bytes.len() / 2]).expect("torn");
        }
        drop(one);
        let is_published = cut == writes.len();
        assert_eq!(shown(&two).await, if is_published { (2, 2) } else { (1, 1) }, "after {cut} writes");
        refreshed(&trusted, &two.downloads(), START).await;
        let again =
            opened(&two).repository.publish(roots, document, 1, Act::of_release(START)).await.expect("sent again");
        assert_eq!((again.root.edition.version, again.targets.edition.version, again.stamp.version), (2, 2, 2));
        refreshed(&trusted, &site.reader().await.downloads, START).await;
        if is_published {
            break;
        }
        cut += 1;
    }
}

#[tokio::test]
async fn who_publishes_waits_for_the_one_that_takes_files_away() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let (_, turn) = opened(&one).repository.still().await.expect("known");
    let mut publishing = Box::pin(publish(&two, None, &[], 0));
    tokio::select! {
        biased;
        _ = &mut publishing => panic!("files are being taken away"),
        () = tokio::task::yield_now() => {}
    }
    drop(turn);
    publishing.await.expect("published");
}

async fn pass(service: &OtaService, served_ms: u64) -> CollectionOutcome {
    let opened = opened(service);
    let named = NamedBundles { served_ms, ..NamedBundles::default() };
    let pass = opened.collector.collect(opened.content.as_ref(), &opened.repository, &named, START);
    pass.await.expect("a pass")
}

#[tokio::test]
async fn a_file_that_is_brought_again_through_the_other_process_has_its_time_anew() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let stray = noise(10, 500);
    bring(&two, &stray).await;
    let path = site.folder().join("content").join(Digest::of_content(&stray).to_string());
    // So that a tick of the file system is not what the test is about.
    File::open(&path).and_then(|file| file.set_modified(SystemTime::UNIX_EPOCH)).expect("an old file");
    pass(&one, 0).await;
    pass(&one, 1).await;
    assert_eq!(settle(&two, &stray).await, Completeness::Whole, "somebody brings it");
    assert_eq!(pass(&one, UNNAMED_MS + 1).await.files, 0, "its time begins anew");
    // The other makes the next passes.
    assert_eq!(pass(&two, UNNAMED_MS + 2).await.files, 0);
    assert_eq!(pass(&two, 2 * UNNAMED_MS + 2).await.files, 1);
    assert!(!has(&one, &stray).await && !has(&two, &stray).await);
    bring(&one, &stray).await;
    assert!(has(&two, &stray).await);
}

#[tokio::test]
async fn what_the_other_process_published_is_never_taken_away() {
    let site = Site::new();
    let (one, two) = (site.process().await, site.process().await);
    let walk = files("walk", "1.0.0");
    for (_, content) in &walk {
        bring(&one, content).await;
    }
    pass(&one, 0).await;
    publish(&two, None, &walk, 0).await.expect("published");
    assert_eq!(pass(&one, 10 * UNNAMED_MS).await.files, 0);
    assert!(has(&one, &walk[0].1).await);
}

#[tokio::test]
async fn a_folder_put_back_under_processes_at_work_is_shown_to_nobody_and_signed_by_nobody() {
    let site = Site::new();
    let one = site.process().await;
    let first = publish(&one, None, &files("walk", "1.0.0"), 0).await.expect("published");
    let old = fs::read(site.metadata().join("timestamp.json")).expect("a timestamp");
    publish(&one, Some(&first), &files("walk", "1.1.0"), 1).await.expect("published");
    let reader = site.reader().await;
    fs::write(site.metadata().join("timestamp.json"), old).expect("put back");
    let version = |found: Vec<u8>| midshift_bundle::freshness::stamp(&found).expect("a timestamp").version;
    let shown = reader.documents.document("timestamp.json").await.expect("asked").expect("one");
    assert_eq!(version(shown), 2, "what was shown stays");
    let late = START.plus_ms(FRESHEN_AFTER_MS);
    let error = opened(&one).repository.freshen(late).await.expect_err("it would fork").to_string();
    assert!(error.contains("put back under a server at work"), "{error}");
}

async fn encoding(downloads: &Downloads, digest: Digest, bases: &[Digest]) -> Result<v1::GetEncodingResponse, Status> {
    let base_digests = bases.iter().map(Digest::to_string).collect();
    let request = v1::GetEncodingRequest { digest: digest.to_string(), base_digests };
    downloads.get_encoding(Request::new(request)).await.map(tonic::Response::into_inner)
}

async fn fetched(downloads: &Downloads, digest: Digest, length: u64) -> Result<Vec<u8>, Status> {
    let request = v1::FetchChunksRequest { digest: digest.to_string(), offset: 0, length };
    let mut stream = downloads.fetch_chunks(Request::new(request)).await?.into_inner();
    let mut bytes = Vec::new();
    while let Some(chunk) = stream.next().await {
        bytes.extend(chunk?.data);
    }
    Ok(bytes)
}

#[tokio::test]
async fn a_gateway_hands_out_what_others_publish_and_writes_nothing() {
    let site = Site::new();
    let one = site.process().await;
    let reader = site.reader().await;
    let walk = files("walk", "1.0.0");
    let (digest, content) = (Digest::of_content(&walk[1].1), walk[1].1.clone());
    for (_, content) in &walk {
        bring(&one, content).await;
    }
    let refused = fetched(&reader.downloads, digest, content.len() as u64).await.expect_err("nobody published it");
    assert_eq!(refused.code(), Code::NotFound);
    publish(&one, None, &walk, 0).await.expect("published");
    let before = site.contents();
    assert_eq!(fetched(&reader.downloads, digest, content.len() as u64).await.expect("published"), content);
    refreshed(&robot(), &reader.downloads, START).await;
    let page = |path: String, range: &'static str| {
        let get = Get::get(path).header("range", range).body(axum::body::Body::empty()).expect("a request");
        reader.pages().oneshot(get)
    };
    let part = page(format!("/targets/{digest}.{}", walk[1].0), "bytes=0-3").await.expect("answered");
    assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
    let body = axum::body::to_bytes(part.into_body(), 100).await.expect("its bytes");
    assert_eq!(body, content[..4]);
    let document = page("/metadata/timestamp.json".to_owned(), "").await.expect("answered");
    assert_eq!(document.status(), StatusCode::OK);
    assert_eq!(site.contents(), before, "nothing was written");
}

#[tokio::test]
async fn what_is_withdrawn_by_others_is_handed_out_no_more_once_the_gateway_followed() {
    let site = Site::new();
    let one = site.process().await;
    let walk = files("walk", "1.0.0");
    let first = publish(&one, None, &walk, 0).await.expect("published");
    let reader = site.reader().await;
    let names: Vec<String> = walk.iter().map(|(name, _)| name.clone()).collect();
    let key = crate::fixture::key(SEEDS.targets);
    let ends = START.plus_ms(PEOPLE_LIFE_MS);
    let document = midshift_bundle::repository::sign_targets(Some(&first), &[], &names, ends, &[&key]).expect("signed");
    opened(&one).repository.publish(Vec::new(), document, 1, Act::of_release(START)).await.expect("withdrawn");
    reader.documents.follow().await.expect("readable");
    let refused = fetched(&reader.downloads, Digest::of_content(&walk[1].1), 1).await.expect_err("withdrawn");
    assert_eq!(refused.code(), Code::NotFound);
}

#[tokio::test]
async fn a_gateway_tells_robots_of_the_patches_that_are_listed() {
    let site = Site::new();
    let one = site.process().await;
    let [base, target] = [b"old".as_slice(), b"new"].map(Digest::of_content);
    let patch = (EncodedTarget { to: target, from: Some(base) }.target(), b"what it lacks".to_vec());
    let release = [("gait-2.component".to_owned(), b"new".to_vec()), patch.clone()];
    publish(&one, None, &release, 0).await.expect("published");
    let reader = site.reader().await;
    let answer = encoding(&reader.downloads, target, &[base]).await.expect("listed");
    assert_eq!((answer.encoding(), answer.base_digest), (v1::Encoding::ZstdPatch, base.to_string()));
    let digest = answer.encoded_digest.parse().expect("a digest");
    assert_eq!(fetched(&reader.downloads, digest, answer.encoded_length).await.expect("there"), patch.1);
    let answer = encoding(&reader.downloads, target, &[]).await.expect("listed");
    assert_eq!(answer.encoding(), v1::Encoding::Identity, "the whole of it has no encoded target");
}

#[tokio::test]
async fn a_gateway_without_its_volume_or_with_another_store_s_does_not_start() {
    let site = Site::new();
    let open = |folder: &Path, id: &str| OtaReader::open(folder.to_owned(), StoreId(Arc::from(id)));
    let error = open(&site.folder(), "store").await.err().expect("not mounted").to_string();
    assert!(error.contains("mount the volume"), "{error}");
    assert!(!site.folder().exists());
    let _one = site.process().await;
    let error = open(&site.folder(), "other").await.err().expect("another's").to_string();
    assert!(error.contains("belongs to store store"), "{error}");
    open(&site.folder(), "store").await.expect("its own");
}
