//! What is acknowledged is on the disk, as the calls of a process say; and a commit syncs the content of its file, not the time of its last change.

use crate::strace::{Victim, traced};
use crate::support::{clock, one, put, site};
use midshift_core::item::Expect;
use midshift_core::rows::{Table, Writer};
use midshift_store::SqliteStore;
use std::path::PathBuf;

const FOLDER: &str = "MIDSHIFT_SYNCED_FOLDER";
const ACKNOWLEDGED: &str = "it is acknowledged";

/// In a process of its own: commits once and says so.
#[tokio::test]
async fn commits_once() {
    let Some(folder) = std::env::var_os(FOLDER) else { return };
    let store = SqliteStore::open(&PathBuf::from(folder), site(), clock()).await.unwrap();
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    println!("{ACKNOWLEDGED}");
}

#[test]
fn a_commit_is_acknowledged_when_its_content_is_synced() {
    let dir = tempfile::tempdir().unwrap();
    let environment = [(FOLDER, dir.path().as_os_str().to_owned())];
    let victim = Victim { test: "synced::commits_once", environment: &environment, folder: dir.path() };
    let (output, trace) = traced(&victim, &["-e".to_owned(), "trace=write,pwrite64,fsync,fdatasync".to_owned()]);
    assert!(output.status.success(), "{}: {trace}", output.status);
    let (before, _) = trace.split_once(ACKNOWLEDGED).expect("what it said");
    let of_log: Vec<&str> = before.lines().filter(|line| line.contains("control.db-wal>")).collect();
    assert!(of_log.iter().any(|call| call.contains("pwrite64(")), "{trace}");
    assert!(of_log.last().is_some_and(|call| call.contains("fdatasync(")), "{trace}");
    assert!(!of_log.iter().any(|call| call.contains(" fsync(")), "{trace}");
}
