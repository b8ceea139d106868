//! A disk without room: a tmpfs that is really full.
//!
//! The latch file has all its blocks from the beginning, which is why a full disk does not hurt it. To see it refused all the same, its blocks are
//! given back to the disk and taken by another file.

use crate::harness::{Folder, Robot, Server, eventually, fleet, id_of, told};
use midshift_stop::{announce_first_start, verify};
use rustix::fs::{FallocateFlags, fallocate};
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A tmpfs of 20 MiB, gone when it is dropped.
struct Small(Folder);

impl Small {
    fn mount() -> Self {
        let folder = Folder::new();
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", "size=20m", "tmpfs"]).arg(folder.path()).status();
        assert!(mounted.is_ok_and(|status| status.success()), "this test mounts a tmpfs: run it as root");
        assert!(announce_first_start(&folder.path()).unwrap());
        Self(folder)
    }
    fn path(&self) -> PathBuf {
        self.0.path()
    }
    /// Takes all the room there is.
    fn fill(&self) -> PathBuf {
        let path = self.path().join("filler");
        let mut file = OpenOptions::new().append(true).create(true).open(&path).unwrap();
        let mut bytes = vec![1; 1024 * 1024];
        while !bytes.is_empty() {
            if file.write_all(&bytes).is_err() {
                bytes.truncate(bytes.len() / 2);
            }
        }
        path
    }
}

impl Drop for Small {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.path()).status();
    }
}

fn give_back(latch: &Path) {
    let file = File::options().write(true).open(latch).unwrap();
    let length = file.metadata().unwrap().len();
    fallocate(&file, FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE, 0, length).unwrap();
}

#[tokio::test]
async fn a_full_disk_keeps_stops_all_the_same_and_records_wait_for_room() {
    let disk = Small::mount();
    let server = Server::start(&disk.path()).await;
    let filler = disk.fill();
    // The audit has a block of 4 KiB that is not full at once.
    let mut engaged = Vec::new();
    for _ in 0..40 {
        let answer = server.engage(fleet()).await.unwrap();
        assert!(answer.durable, "the latch has its blocks");
        engaged.push(id_of(&answer));
    }
    let recorded = fs::read_to_string(disk.path().join("audit.jsonl")).unwrap();
    assert!(!recorded.contains(engaged.last().unwrap()), "the disk was not full");
    fs::remove_file(filler).unwrap();
    let is_recorded = || {
        let recorded = fs::read_to_string(disk.path().join("audit.jsonl")).unwrap();
        engaged.iter().all(|id| recorded.contains(id))
    };
    eventually(async || is_recorded().then_some(())).await;
    assert_eq!(verify(&disk.path()).unwrap().records, 41);
    server.kill();
    let server = Server::start(&disk.path()).await;
    assert_eq!(server.engaged().await.len(), 40);
    server.end().await;
}

#[tokio::test]
async fn a_disk_that_refuses_the_latch_stops_robots_all_the_same_and_holds_it_later() {
    let disk = Small::mount();
    let server = Server::start(&disk.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    eventually(async || server.status().await.durable.then_some(())).await;
    give_back(&disk.path().join("latch"));
    let filler = disk.fill();
    let mut stream = server.client().await.engage(fleet()).await.unwrap().into_inner();
    let first = stream.message().await.unwrap().unwrap();
    assert!(!first.durable && !server.status().await.durable, "the disk refused it");
    let id = id_of(&first);
    robot.until(|robot| robot.knows(&id)).await;
    assert!(!told(&robot, &id).proof.is_empty(), "the robot can bring it back");
    fs::remove_file(filler).unwrap();
    while !stream.message().await.unwrap().expect("the stream goes on").durable {}
    server.kill();
    let server = Server::start(&disk.path()).await;
    assert_eq!(server.engaged().await, [id]);
    server.end().await;
}

#[tokio::test]
async fn a_service_is_followed_only_when_its_disk_holds_all_that_it_knows() {
    let disk = Small::mount();
    let server = Server::start(&disk.path()).await;
    let filler = disk.fill();
    // The audit has a block of 4 KiB that is not full at once.
    let recorded = || fs::read_to_string(disk.path().join("audit.jsonl")).unwrap();
    loop {
        let engaged = server.engage(fleet()).await.unwrap();
        if !recorded().contains(&id_of(&engaged)) {
            break;
        }
    }
    assert!(!server.service.is_followed().await);
    assert!(server.engage(fleet()).await.is_ok(), "it goes on");
    fs::remove_file(filler).unwrap();
    eventually(async || server.service.is_followed().await.then_some(())).await;
    assert!(recorded().contains("FOLLOWED"));
    server.end().await;
}
