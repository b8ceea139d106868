//! Files of a release that the disk does not give at the moment: they are not gone, and are there again as soon as it gives them.

use super::published;
use crate::content::{Content, DiskContent};
use crate::fixture::{Room, SEEDS, START, files, first_root, give_back, hide, key_set, targets};
use crate::repository::{Act, Documents, Error, FRESHEN_AFTER_MS, Newest};
use midshift_bundle::digest::Digest;
use std::path::PathBuf;
use std::sync::Arc;

type File = (String, Vec<u8>);

fn path_of(room: &Room, (_, content): &File) -> PathBuf {
    room.dir.path().join("content").join(Digest::of_content(content).to_string())
}

fn versions(newest: &Newest) -> Vec<&str> {
    newest.releases.iter().map(|r| r.manifest.version.as_str()).collect()
}

/// What other processes publish is followed past a manifest and a set that were known and that the disk does not give for a while.
async fn what_was_known_stays() {
    let room = Room::new().await;
    let walk = files("walk", "1.0.0");
    let set = key_set(1, &[15], 5);
    let all: Vec<File> = walk.iter().cloned().chain([set.clone()]).collect();
    room.bring(&all).await;
    let document = targets(None, &all, SEEDS.targets);
    room.repository.publish(vec![first_root()], document.clone(), 0, Act::of_release(START)).await.expect("published");
    let content: Arc<dyn Content> = Arc::new(DiskContent::reading(&room.dir.path().join("content")));
    let other = Documents::reading(&room.metadata(), content).await.expect("readable");
    for file in [&walk[0], &set] {
        hide(&path_of(&room, file));
    }
    let next = targets(Some(&document), &[], SEEDS.targets);
    let error =
        room.repository.publish(Vec::new(), next, 1, Act::of_release(START)).await.expect_err("nobody can check it");
    assert!(matches!(error, Error::Disk(_)), "{error}");
    room.repository.freshen(START.plus_ms(FRESHEN_AFTER_MS)).await.expect("signed");
    for _ in 0..2 {
        other.follow().await.expect("the rest is readable");
        let newest = other.newest().expect("shown");
        assert_eq!((newest.stamp.version, versions(&newest)), (2, vec!["1.0.0"]));
        assert_eq!((newest.key_set.as_ref().map(|set| set.number), newest.unread.len()), (Some(1), 2));
    }
    for file in [&walk[0], &set] {
        give_back(&path_of(&room, file));
    }
    other.follow().await.expect("readable");
    let newest = other.newest().expect("shown");
    assert_eq!((versions(&newest), newest.unread.len()), (vec!["1.0.0"], 0));
    assert_eq!(newest.key_set.as_ref().map(|set| set.number), Some(1));
}

#[tokio::test]
async fn what_was_known_of_a_file_stays_while_the_disk_does_not_give_it() {
    what_was_known_stays().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn what_was_known_of_a_file_stays_also_where_the_disk_says_so_only_when_it_is_read() {
    what_was_known_stays().await;
}

/// A start with a manifest and a set that the disk does not give shows the rest, and them as soon as it does.
async fn a_start_shows_the_rest() {
    let room = Room::new().await;
    let (old, new, set) = (files("walk", "1.0.0"), files("walk", "1.1.0"), key_set(1, &[15], 5));
    let all: Vec<File> = old.iter().chain(&new).cloned().chain([set.clone()]).collect();
    room.bring(&all).await;
    let document = targets(None, &all, SEEDS.targets);
    room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect("published");
    for file in [&new[0], &set] {
        hide(&path_of(&room, file));
    }
    let room = room.restarted().await;
    let newest = room.repository.newest().expect("shown");
    assert_eq!((versions(&newest), newest.unread.len()), (vec!["1.0.0"], 2));
    assert!(newest.lists(Digest::of_content(&new[0].1)), "it is listed as before");
    give_back(&path_of(&room, &new[0]));
    room.repository.documents().follow().await.expect("readable");
    let newest = room.repository.newest().expect("shown");
    assert_eq!((versions(&newest), newest.unread.len()), (vec!["1.0.0", "1.1.0"], 1));
    give_back(&path_of(&room, &set));
    room.repository.documents().follow().await.expect("readable");
    let newest = room.repository.newest().expect("shown");
    assert_eq!((newest.key_set.as_ref().map(|set| set.number), newest.unread.len()), (Some(1), 0));
}

#[tokio::test]
async fn a_start_shows_what_the_disk_gives_and_the_rest_without_another_one() {
    a_start_shows_the_rest().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_start_shows_what_the_disk_gives_also_where_it_says_so_only_when_it_is_read() {
    a_start_shows_the_rest().await;
}

#[tokio::test]
async fn a_file_that_is_gone_is_left_out_and_not_waited_for() {
    let (room, _) = published().await;
    std::fs::remove_file(path_of(&room, &files("walk", "1.0.0")[0])).expect("removed");
    let room = room.restarted().await;
    let newest = room.repository.newest().expect("shown");
    assert_eq!((versions(&newest), newest.unread.len()), (Vec::<&str>::new(), 0));
}

#[tokio::test]
async fn whoever_only_asks_for_a_document_tries_nothing_again() {
    let room = Room::new().await;
    let walk = files("walk", "1.0.0");
    room.bring(&walk).await;
    let document = targets(None, &walk, SEEDS.targets);
    room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect("published");
    hide(&path_of(&room, &walk[0]));
    let content: Arc<dyn Content> = Arc::new(DiskContent::reading(&room.dir.path().join("content")));
    let other = Documents::reading(&room.metadata(), content).await.expect("readable");
    give_back(&path_of(&room, &walk[0]));
    other.document("timestamp.json").await.expect("readable").expect("there");
    other.look_if_possible().await;
    assert_eq!(other.newest().expect("shown").unread.len(), 1, "the next second does");
    other.follow().await.expect("readable");
    assert!(other.newest().expect("shown").unread.is_empty());
}
