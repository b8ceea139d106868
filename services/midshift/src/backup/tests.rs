//! A backup is whole, says when it is not, and what is made of it is a store of its own.

use super::{Places, back_up, restore, verify};
use crate::clock;
use midshift_core::ids::SiteId;
use midshift_core::rows::{Expect, Index, Item, Key, RowChange, Seq, Table, Write, Writer};
use midshift_core::time::Utc;
use midshift_store::{FRAME_BYTES_DEFAULT, Frame, FrameLog, SqliteFrames, SqliteStore, Store};
use std::fs;
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;

const NOW: Utc = Utc(1_780_000_000_000);

/// A server's data directory, in use.
struct Used {
    dir: TempDir,
    store: SqliteStore,
    frames: SqliteFrames,
}

fn site() -> SiteId {
    SiteId::parse("north").expect("a site")
}

async fn open(data: &Path) -> (SqliteStore, SqliteFrames) {
    let clock = clock::clock(1000);
    let store = SqliteStore::open(data, site(), clock.clone()).await.expect("a store");
    let frames = SqliteFrames::open(data, site(), clock, FRAME_BYTES_DEFAULT).await.expect("a log");
    (store, frames)
}

impl Used {
    async fn new() -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let (store, frames) = open(&dir.path().join("data")).await;
        let used = Self { dir, store, frames };
        used.put("a").await;
        let frame = Frame {
            robot_id: midshift_core::ids::RobotId::parse("r-1").expect("a robot"),
            ring: Arc::from("ring"),
            first_seq: 1,
            last_seq: 1,
            bytes: Arc::from(&b"sample"[..]),
        };
        used.frames.append(vec![frame]).await.expect("kept");
        used
    }
    async fn put(&self, id: &str) {
        let key = Key::new(Table::Attempt, id);
        let write = Write::Put { body: Arc::from("{}"), index: Index::default() };
        let change = RowChange { key, expect: Expect::Absent, write, kind: "attempt.put" };
        let item = Item { rows: vec![change], ..Item::new(Writer::Fleet, "fleet") };
        self.store.commit(vec![item]).await.remove(0).expect("applied");
    }
    fn places(&self) -> Places {
        Places { data: self.dir.path().join("data"), ota_keys: None }
    }
    async fn backed_up(&self) -> std::path::PathBuf {
        let to = self.dir.path().join("backup");
        back_up(&self.places(), &to, NOW).await.expect("a backup");
        to
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_restored_is_the_moment_of_the_copy_in_a_store_of_its_own() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    used.put("later").await;
    let summary = verify(&backup).await.expect("it is good");
    assert_eq!((summary.site_id.as_str(), summary.begun), ("north", NOW));
    let names: Vec<&str> = summary.parts.iter().map(|(name, ..)| name.as_str()).collect();
    assert_eq!(names, ["control", "telemetry"]);
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None };
    restore(&backup, &to, NOW).await.expect("restored");
    let (store, frames) = open(&to.data).await;
    assert_ne!(store.id(), used.store.id(), "nobody may go on from a number of the other");
    let rows = store.snapshot(&[Table::Attempt]).await.expect("rows");
    assert_eq!((rows.rows.len(), rows.seq), (1, Seq(used.store.wake().borrow().0 - 1)));
    assert_eq!(frames.marks().await.expect("marks").len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_change_of_a_backup_is_found_and_nothing_is_restored_of_it() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    let file = backup.join("control").join("control.db");
    let whole = fs::read(&file).expect("the file");
    let mut other = whole.clone();
    let middle = other.len() / 2;
    other[middle] ^= 1;
    let stray = backup.join("control").join("stray");
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None };
    type Spoil<'a> = &'a dyn Fn();
    let spoils: [(&str, Spoil); 3] = [
        ("is not what was copied", &|| fs::write(&file, &other).expect("written")),
        ("is not listed", &|| {
            fs::write(&file, &whole).expect("written");
            fs::write(&stray, b"x").expect("written");
        }),
        ("is missing", &|| {
            fs::remove_file(&stray).expect("gone");
            fs::remove_file(&file).expect("gone");
        }),
    ];
    for (told, spoil) in spoils {
        spoil();
        let error = verify(&backup).await.expect_err("it is not good").to_string();
        assert!(error.contains(told), "{error}");
        assert!(restore(&backup, &to, NOW).await.is_err());
        assert!(!to.data.exists());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_written_over() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    let again = back_up(&used.places(), &backup, NOW).await.expect_err("it is there");
    assert!(again.to_string().contains("is not empty"), "{again}");
    assert!(restore(&backup, &used.places(), NOW).await.is_err());
    verify(&backup).await.expect("as it was");
    let nowhere = Places { data: used.dir.path().join("nowhere"), ota_keys: None };
    let to = used.dir.path().join("of-nothing");
    let error = back_up(&nowhere, &to, NOW).await.expect_err("there is nothing");
    assert!(error.to_string().contains("no server ever served"), "{error}");
    assert!(!to.exists());
}
