//! Files that changed on the disk after they were brought.

use super::{EVERY, Integrity};
use crate::OtaService;
use crate::content::{Content, DiskContent, Held, Room, Wanted};
use crate::encodings::tests::programs;
use crate::encodings::{Encodings, Way};
use crate::fixture::{files, release, service};
use midshift_bundle::digest::Digest;
use midshift_core::reason::Code;
use std::path::PathBuf;
use std::sync::Arc;
use tempfile::TempDir;

/// A service whose newest release lists this file, and where that lies.
async fn world() -> (TempDir, OtaService, Vec<u8>, PathBuf) {
    let dir = TempDir::new().expect("a folder");
    let service = service(&dir).await;
    let files = files("walk", "1.0.0");
    release(&service, &files).await;
    let content = files[1].1.clone();
    let name = Digest::of(&content).to_string();
    let path = find(dir.path().to_owned(), &name).expect("it lies there");
    (dir, service, content, path)
}

/// A file of this name below a folder.
fn find(folder: PathBuf, name: &str) -> Option<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    let mut entries: Vec<PathBuf> = entries.collect();
    entries.sort();
    let is_it = |path: &PathBuf| path.file_name().is_some_and(|found| found == name);
    let found = entries.iter().find(|path| is_it(path)).cloned();
    found.or_else(|| entries.into_iter().filter(|path| path.is_dir()).find_map(|folder| find(folder, name)))
}

#[tokio::test]
async fn a_file_that_was_damaged_is_not_handed_out_and_can_be_brought_again() {
    let (_dir, service, content, path) = world().await;
    let opened = service.opened().expect("keys");
    let file = Wanted { digest: Digest::of(&content), length: content.len() as u64 };
    std::fs::write(&path, vec![0; content.len()]).expect("damaged");
    let refusal = opened.hatch.listed(file.digest).await.expect_err("it is damaged");
    assert_eq!(refusal.reason.code, Code::SoftwareNotFound);
    assert_eq!(opened.hatch.take_damaged().into_iter().collect::<Vec<_>>(), [file.digest]);
    assert!(opened.hatch.take_damaged().is_empty(), "it is told once");
    opened.content.append(file, 0, content.into()).await.expect("room");
    assert_eq!(opened.content.settle(file).await.expect("whole"), Held::Whole);
    assert_eq!(opened.hatch.listed(file.digest).await.expect("handed out"), file);
}

#[tokio::test(start_paused = true)]
async fn a_file_is_hashed_the_first_time_and_once_a_day() {
    let (_dir, service, content, path) = world().await;
    let opened = service.opened().expect("keys");
    let digest = Digest::of(&content);
    opened.hatch.listed(digest).await.expect("whole");
    std::fs::write(&path, vec![0; content.len()]).expect("damaged");
    opened.hatch.listed(digest).await.expect("it was hashed a moment ago");
    tokio::time::advance(EVERY).await;
    assert!(opened.hatch.listed(digest).await.is_err(), "a day later it is hashed again");
}

#[tokio::test]
async fn a_shorter_way_that_was_damaged_is_not_handed_out_and_made_again() {
    let dir = TempDir::new().expect("a folder");
    let folder = dir.path().join("encoded");
    let content = Arc::new(DiskContent::open(&dir.path().join("content"), Room::of(1 << 20)).expect("a store"));
    let encodings = Encodings::open(&folder, content.clone()).expect("a shelf");
    let (program, _) = programs();
    let file = Wanted { digest: Digest::of(&program), length: program.len() as u64 };
    content.append(file, 0, program.into()).await.expect("room");
    content.settle(file).await.expect("whole");
    let made = async || {
        assert_eq!(encodings.way(file, &[]).await.expect("asked"), Way::Later);
        assert!(encodings.make_next().await, "there was one to make");
        let way = encodings.way(file, &[]).await.expect("asked");
        let Way::Encoded(_, encoded) = way else { panic!("{way:?}") };
        encoded.digest
    };
    let digest = made().await;
    let path = std::fs::read_dir(&folder).expect("a folder").next().expect("a way").expect("an entry").path();
    std::fs::write(path, b"something else").expect("damaged");
    let integrity = Integrity::default();
    assert!(!integrity.holds_way(&encodings, digest).await.expect("hashed"));
    let again = made().await;
    assert!(integrity.holds_way(&encodings, again).await.expect("hashed"));
}
