//! The key of a robot's machine: made once, kept, and shown to nobody.

use midshift_agent::device::DeviceKey;
use midshift_agent::memory::MemoryStore;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::{Op, Store};
use std::os::unix::fs::PermissionsExt;

#[tokio::test]
async fn the_file_of_a_robot_is_read_by_its_owner_only_also_one_that_was_open_to_all() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("robot.db");
    for _ in 0..2 {
        let mut store = SqliteStore::open(&path).await.expect("opens");
        store.load("ring-1").await.expect("loads");
        store.commit(&[Op::Device(DeviceKey::of_seed([9; 32]))]).await.expect("commits");
        for entry in std::fs::read_dir(dir.path()).expect("there") {
            let entry = entry.expect("an entry");
            let mode = entry.metadata().expect("there").permissions().mode() & 0o777;
            let is_lock = entry.path().extension().is_some_and(|e| e == "lock");
            assert!(is_lock || mode == 0o600, "{:?} has mode {mode:o}", entry.path());
        }
        drop(store);
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o644)).expect("changes");
    }
}

#[test]
fn what_is_shown_of_a_ledger_has_no_secret_in_it() {
    let key = DeviceKey::of_seed([9; 32]);
    let store = MemoryStore::new();
    store.commit_now(&[Op::Device(key.clone())]);
    let pem = serde_json::to_value(&key).expect("writes");
    let secret = pem.as_str().and_then(|pem| pem.lines().nth(1)).expect("a line of it");
    let shown = format!("{:?} {key:?}", store.memory());
    assert!(secret.len() > 40 && shown.contains("SecretKey(") && !shown.contains(secret), "{shown}");
    assert_eq!(serde_json::from_value::<DeviceKey>(pem.clone()).expect("reads").public(), key.public());
    assert!(serde_json::from_value::<DeviceKey>("no key".into()).is_err());
}
