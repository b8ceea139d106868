//! Files in pieces, over restarts, under a quota.

use super::{Completeness, Content, DiskContent, Error, FileRef, Room};
use bytes::Bytes;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::COMPONENT_BYTES_MAX;
use midshift_core::limits;
use std::fs;
use std::path::Path;
use tempfile::TempDir;
use tokio::io::AsyncReadExt;

const QUOTA: u64 = 1024 * 1024;

fn store(dir: &TempDir) -> DiskContent {
    DiskContent::open(dir.path(), Room::with_quota(QUOTA)).expect("a store")
}

fn wanted(content: &[u8]) -> FileRef {
    FileRef { digest: Digest::of_content(content), length: content.len() as u64 }
}

fn bytes(count: usize, seed: u8) -> Vec<u8> {
    (0..count).map(|i| (i % 251) as u8 ^ seed).collect()
}

async fn bring(store: &DiskContent, content: &[u8]) -> Result<Completeness, Error> {
    let file = wanted(content);
    store.append(file, 0, Bytes::copy_from_slice(content)).await?;
    store.settle(file).await
}

async fn read(store: &DiskContent, digest: Digest, range: std::ops::Range<u64>) -> Vec<u8> {
    let mut reader = store.read(digest, range).await.expect("readable").expect("there");
    let mut found = Vec::new();
    reader.read_to_end(&mut found).await.expect("its bytes");
    found
}

fn names(path: &Path) -> Vec<String> {
    let entries = fs::read_dir(path).expect("a folder").map(|e| e.expect("an entry").file_name());
    let mut names: Vec<String> = entries.map(|n| n.into_string().expect("text")).collect();
    names.sort();
    names
}

#[tokio::test]
async fn a_file_is_brought_on_after_a_restart_from_where_it_was_durable() {
    let dir = TempDir::new().expect("a folder");
    let content = bytes(1000, 1);
    let file = wanted(&content);
    let first = store(&dir);
    assert_eq!(first.settle(file).await.expect("asked"), Completeness::Part(0));
    first.append(file, 0, Bytes::copy_from_slice(&content[..400])).await.expect("a piece");
    assert_eq!(first.settle(file).await.expect("durable"), Completeness::Part(400));
    assert_eq!(first.length(file.digest).await.expect("asked"), None, "half a file has no name");
    first.append(file, 400, Bytes::copy_from_slice(&content[400..700])).await.expect("never acknowledged");
    drop(first);
    let again = store(&dir);
    assert_eq!(again.settle(file).await.expect("asked"), Completeness::Part(400));
    let early = again.append(file, 700, Bytes::copy_from_slice(&content[700..])).await;
    assert!(matches!(early, Err(Error::Moved { at: 400, offset: 700 })), "{early:?}");
    again.append(file, 400, Bytes::copy_from_slice(&content[400..])).await.expect("the rest");
    assert_eq!(again.settle(file).await.expect("whole"), Completeness::Whole);
    assert_eq!(names(dir.path()), [file.digest.to_string()]);
    drop(again);
    let third = store(&dir);
    assert_eq!(third.settle(file).await.expect("asked"), Completeness::Whole);
    assert_eq!(read(&third, file.digest, 0..1000).await, content);
}

#[tokio::test]
async fn what_lies_beyond_the_mark_is_not_believed_after_a_cut() {
    let dir = TempDir::new().expect("a folder");
    let content = bytes(1000, 2);
    let file = wanted(&content);
    let first = store(&dir);
    first.append(file, 0, Bytes::copy_from_slice(&content[..400])).await.expect("a piece");
    first.settle(file).await.expect("durable");
    drop(first);
    let part = dir.path().join(format!("{}.part", file.digest));
    let mut torn = fs::read(&part).expect("the part");
    torn.extend([0; 300]);
    fs::write(&part, torn).expect("a torn tail");
    fs::write(dir.path().join(format!("{}.mark.new", file.digest)), "{\"leng").expect("a torn mark");
    let again = store(&dir);
    assert_eq!(again.settle(file).await.expect("asked"), Completeness::Part(400));
    again.append(file, 400, Bytes::copy_from_slice(&content[400..])).await.expect("the rest");
    assert_eq!(again.settle(file).await.expect("whole"), Completeness::Whole);
    assert_eq!(names(dir.path()), [file.digest.to_string()]);
}

#[tokio::test]
async fn a_part_shorter_than_its_mark_begins_anew() {
    let dir = TempDir::new().expect("a folder");
    let content = bytes(1000, 3);
    let file = wanted(&content);
    let first = store(&dir);
    first.append(file, 0, Bytes::copy_from_slice(&content[..400])).await.expect("a piece");
    first.settle(file).await.expect("durable");
    drop(first);
    fs::write(dir.path().join(format!("{}.part", file.digest)), &content[..10]).expect("lost bytes");
    let again = store(&dir);
    assert_eq!(again.settle(file).await.expect("asked"), Completeness::Part(0));
    assert_eq!(bring(&again, &content).await.expect("whole"), Completeness::Whole);
}

#[tokio::test]
async fn wrong_bytes_are_thrown_away_and_the_right_ones_may_come() {
    let dir = TempDir::new().expect("a folder");
    let store = store(&dir);
    let content = bytes(500, 4);
    let file = wanted(&content);
    store.append(file, 0, Bytes::from(bytes(500, 5))).await.expect("nobody knows yet");
    let error = store.settle(file).await.expect_err("others");
    assert!(matches!(error, Error::WrongBytes { found } if found == Digest::of_content(&bytes(500, 5))), "{error}");
    assert_eq!(names(dir.path()), Vec::<String>::new());
    assert_eq!(bring(&store, &content).await.expect("whole"), Completeness::Whole);
}

#[tokio::test]
async fn another_length_begins_the_file_anew() {
    let dir = TempDir::new().expect("a folder");
    let store = store(&dir);
    let content = bytes(500, 6);
    let lied = FileRef { length: 900, ..wanted(&content) };
    store.append(lied, 0, Bytes::from(bytes(300, 7))).await.expect("a piece");
    assert_eq!(store.settle(lied).await.expect("durable"), Completeness::Part(300));
    assert_eq!(store.settle(wanted(&content)).await.expect("asked"), Completeness::Part(0));
    assert_eq!(bring(&store, &content).await.expect("whole"), Completeness::Whole);
    assert!(matches!(store.settle(lied).await, Err(Error::Size)), "it is known how long it is");
}

#[tokio::test]
async fn two_who_bring_one_file_hear_where_it_is() {
    let dir = TempDir::new().expect("a folder");
    let store = store(&dir);
    let content = bytes(100, 8);
    let file = wanted(&content);
    store.append(file, 0, Bytes::copy_from_slice(&content[..60])).await.expect("one");
    let error = store.append(file, 0, Bytes::copy_from_slice(&content[..60])).await.expect_err("the other");
    assert!(matches!(error, Error::Moved { at: 60, offset: 0 }), "{error}");
    store.append(file, 60, Bytes::copy_from_slice(&content[60..])).await.expect("the other goes on");
    assert_eq!(store.settle(file).await.expect("whole"), Completeness::Whole);
    let error = store.append(file, 0, Bytes::copy_from_slice(&content)).await.expect_err("it is here");
    assert!(matches!(error, Error::Moved { at: 100, .. }), "{error}");
}

#[tokio::test]
async fn the_quota_counts_whole_files_and_parts_over_restarts() {
    let dir = TempDir::new().expect("a folder");
    let half = bytes(QUOTA as usize / 2, 9);
    let other = bytes(QUOTA as usize / 2 + 1, 10);
    let first = store(&dir);
    bring(&first, &half).await.expect("half of it");
    let error = bring(&first, &other).await.expect_err("a byte too many");
    let Error::Full { missing, used, free, quota } = error else { panic!("{error}") };
    assert_eq!((missing, used, free, quota), (QUOTA / 2 + 1, QUOTA / 2, QUOTA / 2, QUOTA));
    drop(first);
    let again = store(&dir);
    assert!(matches!(bring(&again, &other).await, Err(Error::Full { .. })));
    let wrong = FileRef { digest: Digest::of_content(b"something else"), length: QUOTA / 2 };
    again.append(wrong, 0, Bytes::from(bytes(QUOTA as usize / 2, 11))).await.expect("it fits");
    assert!(matches!(bring(&again, b"x").await, Err(Error::Full { .. })), "parts count too");
    assert!(matches!(again.settle(wrong).await, Err(Error::WrongBytes { .. })));
    bring(&again, b"x").await.expect("what was thrown away counts no more");
}

#[tokio::test]
async fn sizes_beyond_the_cap_and_bytes_beyond_the_whole_are_refused() {
    let dir = TempDir::new().expect("a folder");
    let store = DiskContent::open(dir.path(), Room::with_quota(u64::MAX)).expect("a store");
    let digest = Digest::of_content(b"any");
    for length in [0, COMPONENT_BYTES_MAX + 1, u64::MAX] {
        let error = store.append(FileRef { digest, length }, 0, Bytes::from_static(b"x")).await.expect_err("refused");
        assert!(matches!(error, Error::Size), "{length}: {error}");
    }
    let largest = FileRef { digest, length: COMPONENT_BYTES_MAX };
    store.append(largest, 0, Bytes::from_static(b"x")).await.expect("the largest");
    let short = FileRef { digest: Digest::of_content(b"abc"), length: 3 };
    let error = store.append(short, 0, Bytes::from_static(b"abcd")).await.expect_err("one too many");
    assert!(matches!(error, Error::TooLong { length: 3, end: 4 }), "{error}");
}

#[tokio::test]
async fn ranges_are_cut_at_the_end_of_the_file() {
    let dir = TempDir::new().expect("a folder");
    let store = store(&dir);
    let content = bytes(1000, 12);
    let digest = Digest::of_content(&content);
    bring(&store, &content).await.expect("whole");
    for range in [0..1000, 0..1, 999..1000, 400..600, 990..2000, 1000..1001, 5000..6000, 7..7] {
        let expected: Vec<u8> =
            content.iter().skip(range.start as usize).take((range.end - range.start) as usize).copied().collect();
        assert_eq!(read(&store, digest, range.clone()).await, expected, "{range:?}");
    }
    assert!(store.read(Digest::of_content(b"nobody"), 0..1).await.expect("asked").is_none());
}

#[tokio::test]
async fn ranges_around_two_and_four_gib_are_where_they_should_be() {
    let dir = TempDir::new().expect("a folder");
    let digest = Digest::of_content(b"a name for a sparse file");
    let file = fs::File::create(dir.path().join(digest.to_string())).expect("a file");
    for edge in [1_u64 << 31, 1 << 32] {
        std::os::unix::fs::FileExt::write_all_at(&file, b"edge", edge - 2).expect("sparse");
    }
    file.set_len((1 << 32) + 10).expect("sparse");
    let store = DiskContent::open(dir.path(), Room::with_quota(u64::MAX)).expect("a store");
    assert_eq!(store.length(digest).await.expect("asked"), Some((1 << 32) + 10));
    for edge in [1_u64 << 31, 1 << 32] {
        assert_eq!(read(&store, digest, edge - 2..edge + 2).await, b"edge");
    }
    assert_eq!(read(&store, digest, (1 << 32) + 8..u64::MAX).await, [0, 0]);
}

#[tokio::test]
async fn of_too_many_unfinished_files_the_one_left_alone_longest_goes() {
    let dir = TempDir::new().expect("a folder");
    let store = store(&dir);
    let files: Vec<Vec<u8>> = (0..=limits::UPLOADS_MAX).map(|n| format!("file {n:4}").into_bytes()).collect();
    for content in &files[..limits::UPLOADS_MAX] {
        store.append(wanted(content), 0, Bytes::copy_from_slice(&content[..4])).await.expect("a piece");
    }
    // The first is touched again, so the second goes.
    store.append(wanted(&files[0]), 4, Bytes::copy_from_slice(&files[0][4..5])).await.expect("a piece");
    let last = &files[limits::UPLOADS_MAX];
    store.append(wanted(last), 0, Bytes::copy_from_slice(&last[..4])).await.expect("a piece");
    assert_eq!(store.settle(wanted(&files[0])).await.expect("asked"), Completeness::Part(5));
    assert_eq!(store.settle(wanted(&files[1])).await.expect("asked"), Completeness::Part(0));
    assert_eq!(store.settle(wanted(last)).await.expect("asked"), Completeness::Part(4));
}

#[tokio::test]
async fn what_is_refused_for_want_of_room_leaves_nothing_behind_and_what_began_can_go_on() {
    let dir = TempDir::new().expect("a folder");
    let store = store(&dir);
    let (first, second) = (bytes(QUOTA as usize / 2, 13), bytes(QUOTA as usize / 2 + 2, 14));
    bring(&store, &first).await.expect("half of it");
    let before = names(dir.path());
    let error = bring(&store, &second).await.expect_err("two bytes too many");
    assert!(matches!(error, Error::Full { .. }), "{error}");
    assert_eq!(names(dir.path()), before);
    assert_eq!(store.fill().used_bytes, QUOTA / 2);
    // What was begun while there was room is refused in the middle, and stays.
    let file = FileRef { length: QUOTA / 2, ..wanted(&bytes(QUOTA as usize / 2, 15)) };
    let piece = bytes(QUOTA as usize / 2, 15);
    store.append(file, 0, Bytes::copy_from_slice(&piece[..100])).await.expect("it fits");
    bring(&store, b"x").await.expect("a byte");
    let rest = || Bytes::copy_from_slice(&piece[100..]);
    assert!(matches!(store.append(file, 100, rest()).await, Err(Error::Full { .. })));
    assert_eq!(store.settle(file).await.expect("asked"), Completeness::Part(100));
    assert_eq!(store.remove(wanted(&first).digest).await.expect("removable"), QUOTA / 2);
    store.append(file, 100, rest()).await.expect("there is room now");
    assert_eq!(store.settle(file).await.expect("whole"), Completeness::Whole);
}

#[tokio::test]
async fn the_disk_keeps_its_spare_bytes() {
    let dir = TempDir::new().expect("a folder");
    let spare_bytes = 1 << 62;
    let store = DiskContent::open(dir.path(), Room { spare_bytes, ..Room::with_quota(QUOTA) }).expect("a store");
    let error = bring(&store, b"abc").await.expect_err("no disk has so much");
    let Error::DiskFull { missing: 3, free, spare } = error else { panic!("{error}") };
    assert_eq!((spare, free > 0), (spare_bytes, true));
    assert_eq!(names(dir.path()), Vec::<String>::new());
    drop(store);
    let modest = DiskContent::open(dir.path(), Room { spare_bytes: 1, ..Room::with_quota(QUOTA) }).expect("a store");
    assert_eq!(bring(&modest, b"abc").await.expect("whole"), Completeness::Whole);
}

#[tokio::test]
async fn a_file_that_is_taken_away_is_gone_over_a_restart_and_its_room_is_free() {
    let dir = TempDir::new().expect("a folder");
    let first = store(&dir);
    let (whole, half) = (bytes(1000, 16), bytes(1000, 17));
    bring(&first, &whole).await.expect("whole");
    first.append(wanted(&half), 0, Bytes::copy_from_slice(&half[..300])).await.expect("a piece");
    first.settle(wanted(&half)).await.expect("durable");
    let listed: Vec<_> = first.list().await.expect("listed").iter().map(|s| (s.digest, s.bytes)).collect();
    let mut expected = [(Digest::of_content(&whole), 1000), (Digest::of_content(&half), 300)];
    expected.sort();
    assert_eq!(listed, expected);
    assert_eq!(first.remove(Digest::of_content(b"nobody")).await.expect("asked"), 0);
    assert_eq!(first.remove(Digest::of_content(&whole)).await.expect("removable"), 1000);
    assert_eq!(first.remove(Digest::of_content(&half)).await.expect("removable"), 300);
    assert_eq!((first.fill().used_bytes, names(dir.path())), (0, Vec::new()));
    drop(first);
    let again = store(&dir);
    assert_eq!(again.list().await.expect("listed"), []);
    assert_eq!(bring(&again, &whole).await.expect("brought anew"), Completeness::Whole);
    // A cut between the name and the mark of a file leaves the mark.
    fs::write(dir.path().join(format!("{}.mark", Digest::of_content(&whole))), "{\"length\":1000,\"durable\":1000}")
        .expect("a mark");
    drop(again);
    let third = store(&dir);
    assert_eq!(names(dir.path()), [Digest::of_content(&whole).to_string()]);
    assert_eq!(third.fill().used_bytes, 1000);
}
