//! Shorter ways to files: which one, when, and how much room they take.

use super::{Encodings, Key, Way};
use crate::content::{Content, DiskContent, Room as Space, Wanted};
use bytes::Bytes;
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{self, Base, ENCODED_BYTES_MIN};
use std::fs;
use std::io::Cursor;
use std::sync::Arc;
use tempfile::TempDir;
use tokio::io::AsyncReadExt;
use tokio_util::sync::CancellationToken;

const QUOTA: u64 = 1024 * 1024;

/// Bytes that do not become shorter by themselves.
pub fn noise(seed: u64, length: usize) -> Vec<u8> {
    let mut state = seed;
    let step = |_| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    (0..length).map(step).collect()
}

/// A program and the next one: half of it is said a hundred times, and something was put in.
pub fn programs() -> (Vec<u8>, Vec<u8>) {
    let old = [noise(1, 100_000), noise(2, 1_000).repeat(100)].concat();
    let mut new = old.clone();
    new.splice(30_000..30_000, noise(3, 2_000));
    (old, new)
}

struct Room {
    dir: TempDir,
    content: Arc<DiskContent>,
    encodings: Encodings,
}

impl Room {
    fn new() -> Self {
        Self::open(TempDir::new().expect("a folder"))
    }
    fn open(dir: TempDir) -> Self {
        let content = Arc::new(DiskContent::open(&dir.path().join("content"), Space::of(QUOTA)).expect("a store"));
        let encodings = Encodings::open(&dir.path().join("encoded"), content.clone()).expect("a shelf");
        Self { dir, content, encodings }
    }
    async fn bring(&self, content: &[u8]) -> Wanted {
        let file = Wanted { digest: Digest::of(content), length: content.len() as u64 };
        self.content.append(file, 0, Bytes::copy_from_slice(content)).await.expect("room");
        self.content.settle(file).await.expect("whole");
        file
    }
    async fn way(&self, target: Wanted, bases: &[Digest]) -> Way {
        self.encodings.way(target, bases).await.expect("asked")
    }
    /// The answer once everything that was asked for is made.
    async fn made(&self, target: Wanted, bases: &[Digest]) -> Way {
        self.way(target, bases).await;
        while self.encodings.make_next().await {}
        self.way(target, bases).await
    }
    async fn read(&self, digest: Digest, length: u64) -> Vec<u8> {
        let mut bytes = Vec::new();
        let reader = self.encodings.read(digest, 0..length).await.expect("readable");
        reader.expect("there").read_to_end(&mut bytes).await.expect("its bytes");
        bytes
    }
    fn names(&self) -> usize {
        fs::read_dir(self.dir.path().join("encoded")).expect("a folder").count()
    }
}

fn patch_of(way: Way) -> (Key, encoding::Encoded) {
    let Way::Encoded(key, encoded) = way else { panic!("{way:?}") };
    (key, encoded)
}

#[tokio::test]
async fn a_robot_that_has_the_version_before_gets_a_patch_and_another_gets_zstd() {
    let room = Room::new();
    let (old, new) = programs();
    let (base, target) = (room.bring(&old).await, room.bring(&new).await);
    let unknown = Digest::of(b"of nobody");
    assert_eq!(room.way(target, &[unknown, base.digest]).await, Way::Later, "it is not made yet");
    let (key, patch) = patch_of(room.made(target, &[unknown, base.digest]).await);
    assert_eq!(key, Key { target: target.digest, base: Some(base.digest) });
    assert!(patch.length < target.length / 50, "{} of {}", patch.length, target.length);
    let (mut out, mut from) = (Vec::new(), Cursor::new(&old));
    let bytes = room.read(patch.digest, patch.length).await;
    encoding::decode(Some(&mut from as &mut dyn Base), &mut &*bytes, target.length, &mut out).expect("a patch");
    assert!(out == new && Digest::of(&bytes) == patch.digest);
    let (key, full) = patch_of(room.made(target, &[unknown]).await);
    assert_eq!(key, Key { target: target.digest, base: None });
    assert!(full.length > patch.length && full.length < target.length * 6 / 10);
    assert_eq!(room.encodings.found(full.digest), Some((key, full.length)));
    assert_eq!(room.encodings.found(unknown), None);
}

#[tokio::test]
async fn what_does_not_become_shorter_comes_as_it_is_and_is_tried_once() {
    let room = Room::new();
    let target = room.bring(&noise(7, 50_000)).await;
    let base = room.bring(&noise(8, 50_000)).await;
    assert_eq!(room.made(target, &[base.digest]).await, Way::Identity);
    assert!(!room.encodings.make_next().await, "nothing is left to try");
    assert_eq!(room.names(), 0, "nothing lies around");
    let small = room.bring(&vec![0; ENCODED_BYTES_MIN as usize - 1]).await;
    assert_eq!(room.way(small, &[]).await, Way::Identity, "so short that asking costs as much");
    let same = room.bring(&vec![0; 50_000]).await;
    let (key, _) = patch_of(room.made(same, &[same.digest]).await);
    assert_eq!(key.base, None, "no patch of a file from itself");
}

#[tokio::test]
async fn ways_take_room_that_files_leave_and_go_when_files_need_it() {
    let room = Room::new();
    let (old, new) = programs();
    let (base, target) = (room.bring(&old).await, room.bring(&new).await);
    let (_, patch) = patch_of(room.made(target, &[base.digest]).await);
    let used = base.length + target.length;
    assert!(room.content.claim(QUOTA - used).is_err(), "the ways are counted");
    assert!(!room.encodings.make_room(QUOTA - used).await, "all went and it is not enough");
    room.content.claim(QUOTA - used).expect("all of it is free");
    assert_eq!((room.names(), room.encodings.found(patch.digest)), (0, None));
    assert!(room.encodings.read(patch.digest, 0..1).await.expect("asked").is_none());
    assert_eq!(room.made(target, &[base.digest]).await, Way::Identity, "there is no room for a way");
    room.content.give_back(QUOTA - used);
}

#[tokio::test]
async fn a_restart_keeps_what_was_made_and_takes_half_a_way_away() {
    let room = Room::new();
    let (old, new) = programs();
    let (base, target) = (room.bring(&old).await, room.bring(&new).await);
    let way = room.made(target, &[base.digest]).await;
    fs::write(room.dir.path().join("encoded").join("next.new"), b"half").expect("writes");
    let room = Room::open(room.dir);
    assert_eq!((room.way(target, &[base.digest]).await, room.names()), (way, 2));
    // What was made again after it went is the same: a download goes on.
    room.encodings.make_room(u64::MAX).await;
    assert_eq!(room.made(target, &[base.digest]).await, way);
}

#[tokio::test]
async fn the_maker_makes_what_is_asked_for_until_it_is_told_to_end() {
    let room = Room::new();
    let (old, new) = programs();
    let (base, target) = (room.bring(&old).await, room.bring(&new).await);
    let shutdown = CancellationToken::new();
    let (maker, ends) = (room.encodings.clone(), shutdown.clone());
    let making = tokio::spawn(async move { maker.run(&ends).await });
    while room.way(target, &[base.digest]).await == Way::Later {
        tokio::task::yield_now().await;
    }
    shutdown.cancel();
    making.await.expect("ends");
    assert_eq!(room.names(), 2);
}
