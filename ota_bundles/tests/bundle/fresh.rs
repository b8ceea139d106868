//! What a server reads off signed documents, and when it must not call them the newest.

use crate::shelf::{START, Seeds, Shelf, key, target};
use midshift_bundle::freshness::{
    OnlineRole, check_online, names, newest_targets, root_edition, stamp, targets_edition,
};
use midshift_bundle::repository::{Online, PEOPLE_LIFE_MS, TIMESTAMP_LIFE_MS};

fn online(shelf: &Shelf) -> Online {
    let snapshot = shelf.documents.0[&format!("{}.snapshot.json", shelf.online_version)].clone();
    Online { snapshot, timestamp: shelf.documents.0["timestamp.json"].clone() }
}

#[test]
fn numbers_and_ends_are_read_off_each_document() {
    let mut shelf = Shelf::new();
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let root = root_edition(&shelf.first_root).expect("a root");
    assert_eq!((root.version, root.expires), (1, START.plus_ms(PEOPLE_LIFE_MS)));
    assert_eq!(targets_edition(&shelf.targets).expect("targets").version, 2);
    let online = online(&shelf);
    let stamp = stamp(&online.timestamp).expect("a timestamp");
    assert_eq!((stamp.version, stamp.snapshot_version, stamp.issued), (2, 2, START));
    assert_eq!(stamp.expires, START.plus_ms(TIMESTAMP_LIFE_MS));
    assert_eq!(newest_targets(&online.snapshot).expect("a snapshot"), 2);
    assert!(root_edition(&shelf.targets).is_err() && newest_targets(&online.timestamp).is_err());
}

#[test]
fn a_root_names_its_online_keys_by_role() {
    let shelf = Shelf::new();
    let names = |role, seed| names(&shelf.first_root, role, &key(seed).public()).expect("a root");
    assert!(names(OnlineRole::Snapshot, 3) && names(OnlineRole::Timestamp, 4));
    assert!(!names(OnlineRole::Snapshot, 4) && !names(OnlineRole::Timestamp, 2));
}

#[test]
fn a_set_of_documents_holds_only_whole_and_under_its_own_root() {
    let mut shelf = Shelf::new();
    let old = shelf.clone();
    check_online(&shelf.first_root, &shelf.targets, &online(&shelf)).expect("the first release");
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let (before, now) = (online(&old), online(&shelf));
    check_online(&shelf.first_root, &shelf.targets, &now).expect("the second release");
    let mixed = [
        (&shelf.targets, before.clone()),
        (&old.targets, now.clone()),
        (&shelf.targets, Online { snapshot: before.snapshot.clone(), timestamp: now.timestamp.clone() }),
        (&shelf.targets, Online { snapshot: now.snapshot.clone(), timestamp: before.timestamp.clone() }),
    ];
    for (targets, online) in mixed {
        assert!(check_online(&shelf.first_root, targets, &online).is_err());
    }
    shelf.rotate(Seeds { timestamp: 14, ..shelf.seeds });
    let root = &shelf.documents.0["2.root.json"];
    assert!(check_online(root, &shelf.targets, &now).is_err(), "signed by the key before");
}
