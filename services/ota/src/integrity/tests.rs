//! Files that changed on the disk after they were brought.

use super::EVERY;
use crate::OtaService;
use crate::content::{Completeness, FileRef};
use crate::fixture::{files, release, service};
use midshift_bundle::digest::Digest;
use midshift_core::reason::Code;
use std::path::PathBuf;
use tempfile::TempDir;

/// A service whose newest release lists this file, and where that lies.
async fn world() -> (TempDir, OtaService, Vec<u8>, PathBuf) {
    let dir = TempDir::new().expect("a folder");
    let service = service(&dir).await;
    let files = files("walk", "1.0.0");
    release(&service, &files).await;
    let content = files[1].1.clone();
    let name = Digest::of_content(&content).to_string();
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
    let file = FileRef { digest: Digest::of_content(&content), length: content.len() as u64 };
    std::fs::write(&path, vec![0; content.len()]).expect("damaged");
    let refusal = opened.downloads.listed(file.digest).await.expect_err("it is damaged");
    assert_eq!(refusal.reason.code, Code::SoftwareNotFound);
    let damaged = opened.downloads.damaged();
    assert_eq!(damaged.iter().copied().collect::<Vec<_>>(), [file.digest]);
    assert_eq!(opened.downloads.damaged(), damaged, "it is kept until somebody was told");
    opened.downloads.mark_damaged_reported(&damaged);
    assert!(opened.downloads.damaged().is_empty(), "it is told once");
    opened.content.append(file, 0, content.into()).await.expect("room");
    assert_eq!(opened.content.settle(file).await.expect("whole"), Completeness::Whole);
    assert_eq!(opened.downloads.listed(file.digest).await.expect("handed out"), file);
}

#[tokio::test(start_paused = true)]
async fn a_file_is_hashed_the_first_time_and_once_a_day() {
    let (_dir, service, content, path) = world().await;
    let opened = service.opened().expect("keys");
    let digest = Digest::of_content(&content);
    opened.downloads.listed(digest).await.expect("whole");
    std::fs::write(&path, vec![0; content.len()]).expect("damaged");
    opened.downloads.listed(digest).await.expect("it was hashed a moment ago");
    tokio::time::advance(EVERY).await;
    assert!(opened.downloads.listed(digest).await.is_err(), "a day later it is hashed again");
}
