//! The client's workflow of the TUF specification, step by step: <https://theupdateframework.github.io/specification/latest/#detailed-client-workflow>.
//! Each test has the number of the steps that it walks. 5.1, the fixed time of a refresh, is the clock that each is given; 5.7, files, is walked by
//! agents and in `encoded_targets`. There are no delegations (5.6.7).

use crate::metadata::rule;
use crate::shelf::{Documents, START, Seeds, Shelf, key, signers, target};
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::{SecretKey, hex};
use midshift_bundle::repository::{DAY_MS, PEOPLE_LIFE_MS, RootDraft, sign_online, sign_root, sign_targets};
use midshift_bundle::trust::{Error, Reading, Refreshed, Trusted};
use midshift_core::time::Utc;
use olpc_cjson::CanonicalFormatter;
use serde::Serialize;
use serde_json::{Value, json};
use std::sync::Arc;

/// A document with another content, signed by `by` alone.
fn forged(document: &[u8], by: &SecretKey, change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let mut page: Value = serde_json::from_slice(document).expect("a document");
    change(&mut page["signed"]);
    let mut message = Vec::new();
    let mut serializer = serde_json::Serializer::with_formatter(&mut message, CanonicalFormatter::new());
    page["signed"].serialize(&mut serializer).expect("plain JSON");
    page["signatures"] = json!([{"keyid": by.public().id().to_string(), "sig": hex(&by.sign(&message))}]);
    serde_json::to_vec(&page).expect("plain JSON")
}

fn meta(document: &[u8], version: u64) -> Value {
    json!({"length": document.len(), "hashes": {"sha256": Digest::of_content(document).to_string()}, "version": version})
}

/// Seed of a key of no role.
const STRANGER: u8 = 99;

/// A repository that has a document replaced, and all above it signed anew by the right keys, as whoever stole those could.
struct Forge(Shelf);

impl Forge {
    fn document(&self, name: &str) -> Vec<u8> {
        self.0.documents.0[name].clone()
    }
    fn put(&mut self, name: &str, document: Vec<u8>) {
        self.0.documents.0.insert(name.to_owned(), document);
    }
    /// A timestamp that names these bytes as snapshot `version`.
    fn stamp(&mut self, snapshot: &[u8], version: u64) {
        let by = key(self.0.seeds.timestamp);
        let stamped = forged(&self.document("timestamp.json"), &by, |signed| {
            signed["meta"]["snapshot.json"] = meta(snapshot, version);
        });
        self.put("timestamp.json", stamped);
        self.put(&format!("{version}.snapshot.json"), snapshot.to_vec());
    }
    /// Snapshot `version` that names these bytes as targets `targets_version`, and its timestamp.
    fn snap(&mut self, version: u64, targets: &[u8], targets_version: u64) {
        let by = key(self.0.seeds.snapshot);
        let snapshot = forged(&self.document(&format!("{version}.snapshot.json")), &by, |signed| {
            signed["meta"]["targets.json"] = meta(targets, targets_version);
        });
        self.stamp(&snapshot, version);
        self.put(&format!("{targets_version}.targets.json"), targets.to_vec());
    }
    async fn refused(&self, robot: &Trusted, why: &str) {
        let error = self.0.shown_to(robot).await.expect_err(why);
        assert_eq!(rule(&error), why, "{error}");
        assert!(!error.is_unreachable(), "it came, and was wrong: {error}");
    }
}

/// A repository with two releases, and a robot that believes the second.
async fn repository() -> (Shelf, Trusted) {
    let mut shelf = Shelf::new();
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let robot = believed(&shelf, &shelf.robot()).await.trusted;
    (shelf, robot)
}

async fn believed(shelf: &Shelf, robot: &Trusted) -> Refreshed {
    shelf.shown_to(robot).await.expect("believed")
}

fn next_root(shelf: &Shelf, version: u64, expires: Utc, root: u8, by: &[u8]) -> Vec<u8> {
    let one = |seed| signers(&[seed], 1);
    let Seeds { targets, snapshot, timestamp, .. } = shelf.seeds;
    let (targets, snapshot, timestamp) = (one(targets), one(snapshot), one(timestamp));
    let draft = RootDraft { version, expires, root: one(root), targets, snapshot, timestamp };
    let by: Vec<SecretKey> = by.iter().map(|seed| key(*seed)).collect();
    sign_root(&draft, &by.iter().collect::<Vec<_>>()).expect("a root")
}

#[tokio::test]
async fn step_5_2_the_trusted_root_is_the_one_that_the_robot_came_with() {
    let mut other = Shelf::new();
    other.documents = Documents::default();
    other.root_version = 0;
    let theirs = Seeds { root: 61, targets: 62, snapshot: 63, timestamp: 64 };
    other.seeds = theirs;
    other.rotate(theirs);
    other.freshen();
    Forge(other).refused(&Shelf::new().robot(), "VerifyMetadata").await;
}

#[tokio::test]
async fn steps_5_3_3_to_5_3_5_the_next_root_is_signed_by_both_and_has_the_next_number() {
    let (shelf, robot) = repository().await;
    let ends = START.plus_ms(PEOPLE_LIFE_MS);
    let tries = [
        (2, vec![11], "VerifyMetadata"),
        (2, vec![shelf.seeds.root], "VerifyMetadata"),
        (3, vec![11, shelf.seeds.root], "OlderMetadata"),
        (1, vec![11, shelf.seeds.root], "OlderMetadata"),
    ];
    for (version, by, why) in tries {
        let mut forge = Forge(shelf.clone());
        forge.put("2.root.json", next_root(&shelf, version, ends, 11, &by));
        forge.refused(&robot, why).await;
    }
    let mut good = shelf.clone();
    good.documents.0.insert("2.root.json".to_owned(), next_root(&shelf, 2, ends, 11, &[11, shelf.seeds.root]));
    let after = believed(&good, &robot).await.trusted;
    // What is written down is the newest root (5.3.8): the key before it signs no further one.
    let mut forge = Forge(good);
    forge.put("3.root.json", next_root(&shelf, 3, ends, 12, &[12, shelf.seeds.root]));
    forge.refused(&after, "VerifyMetadata").await;
}

/// What a robot writes down of a refresh that fails.
async fn rooted(shelf: &Shelf, robot: &Trusted) -> Option<Trusted> {
    let failed = robot.verify_repository(Arc::new(shelf.documents.clone()), shelf.clock()).await.expect_err("fails");
    failed.rooted.map(|rooted| *rooted)
}

#[tokio::test]
async fn step_5_3_8_a_new_root_is_kept_though_a_later_step_fails_and_no_key_before_it_signs_again() {
    let (shelf, robot) = repository().await;
    let mut thief = shelf.clone();
    thief.rotate(Seeds { root: 21, targets: 22, snapshot: 23, timestamp: 24 });
    thief.release(&[]);
    let mut broken = shelf.clone();
    broken.rotate(Seeds { root: 11, ..shelf.seeds });
    let good = broken.clone();
    broken.documents.0.remove("timestamp.json");
    let kept = rooted(&broken, &robot).await.expect("the new root");
    believed(&thief, &robot).await;
    Forge(thief).refused(&kept, "VerifyMetadata").await;
    believed(&good, &kept).await;
    assert_eq!(rooted(&broken, &kept).await, None, "nothing is new");
    // A root that breaks a rule is none of those that are kept; the one before it is.
    let ends = START.plus_ms(PEOPLE_LIFE_MS);
    broken.documents.0.insert("3.root.json".to_owned(), next_root(&good, 3, ends, 12, &[12]));
    assert_eq!(rooted(&broken, &robot).await, Some(kept));
}

#[tokio::test]
async fn steps_5_3_8_and_5_3_11_a_root_that_was_kept_alone_begins_anew_after_a_fast_forward() {
    let (mut shelf, robot) = repository().await;
    let mut thief = shelf.clone();
    thief.publish(1_000_000);
    let driven = believed(&thief, &robot).await.trusted;
    for seeds in [Seeds { snapshot: 13, timestamp: 14, ..shelf.seeds }, Seeds { snapshot: 15, ..shelf.seeds }] {
        let same_timestamp = seeds.timestamp == shelf.seeds.timestamp;
        let mut shelf = shelf.clone();
        shelf.rotate(seeds);
        shelf.documents.0.remove("timestamp.json");
        let kept = rooted(&shelf, &driven).await.expect("the new root");
        let (snapshot, timestamp) = (key(seeds.snapshot), key(seeds.timestamp));
        let stamp = if same_timestamp { 1_000_001 } else { 3 };
        let online = sign_online(&shelf.targets, 3, stamp, shelf.now, &snapshot, &timestamp).expect("online");
        shelf.documents.0.insert("3.snapshot.json".to_owned(), online.snapshot);
        shelf.documents.0.insert("timestamp.json".to_owned(), online.timestamp);
        believed(&shelf, &kept).await;
    }
    // A root that leaves the keys leaves what was believed by them.
    shelf.rotate(shelf.seeds);
    let mut broken = shelf.clone();
    broken.documents.0.remove("timestamp.json");
    let kept = rooted(&broken, &driven).await.expect("the new root");
    shelf.freshen();
    Forge(shelf).refused(&kept, "OlderMetadata").await;
}

#[tokio::test]
async fn steps_5_3_6_to_5_3_10_only_the_last_root_may_not_have_expired() {
    let (mut shelf, robot) = repository().await;
    let (ended, ends) = (Utc(START.0 - 1_000), START.plus_ms(PEOPLE_LIFE_MS));
    let root = shelf.seeds.root;
    let between = next_root(&shelf, 2, ended, root, &[root]);
    shelf.documents.0.insert("2.root.json".to_owned(), between);
    let error = shelf.shown_to(&robot).await.expect_err("the last one");
    assert!(matches!(error, Error::Expired { role: "root", .. }), "{error}");
    let last = next_root(&shelf, 3, ends, root, &[root]);
    shelf.documents.0.insert("3.root.json".to_owned(), last);
    believed(&shelf, &robot).await;
}

#[tokio::test]
async fn step_5_3_11_other_online_keys_begin_anew_after_a_fast_forward() {
    let (mut shelf, robot) = repository().await;
    let mut thief = shelf.clone();
    thief.publish(1_000_000);
    let driven = believed(&thief, &robot).await.trusted;
    shelf.freshen();
    Forge(shelf.clone()).refused(&driven, "OlderMetadata").await;
    shelf.rotate(Seeds { snapshot: 13, timestamp: 14, ..shelf.seeds });
    shelf.freshen();
    believed(&shelf, &driven).await;
}

#[tokio::test]
async fn step_5_4_2_a_timestamp_is_signed_by_its_key() {
    let (shelf, robot) = repository().await;
    for by in [shelf.seeds.snapshot, STRANGER] {
        let mut forge = Forge(shelf.clone());
        forge.put("timestamp.json", forged(&forge.document("timestamp.json"), &key(by), |_| {}));
        forge.refused(&robot, "VerifyMetadata").await;
    }
}

#[tokio::test]
async fn step_5_4_3_neither_a_timestamp_nor_the_snapshot_that_it_names_goes_back() {
    let (shelf, robot) = repository().await;
    let mut older = Forge(shelf.clone());
    let by = key(shelf.seeds.timestamp);
    older.put("timestamp.json", forged(&older.document("timestamp.json"), &by, |signed| signed["version"] = json!(1)));
    older.refused(&robot, "OlderMetadata").await;
    let mut back = Forge(shelf.clone());
    let first = back.document("1.snapshot.json");
    back.stamp(&first, 1);
    back.refused(&robot, "OlderSnapshotInTimestamp").await;
    // The same number again is nothing new, and no attack.
    assert_eq!(believed(&shelf, &robot).await.trusted, robot);
}

#[tokio::test]
async fn steps_5_4_4_5_5_6_and_5_6_5_nothing_is_believed_that_has_expired() {
    let (shelf, robot) = repository().await;
    let late = Reading { utc: shelf.now.plus_ms(DAY_MS), is_synced: true };
    let error = robot.refresh(Arc::new(shelf.documents.clone()), late).await.expect_err("a day old");
    assert!(matches!(error, Error::Expired { role: "timestamp", .. }), "{error}");

    // A thief of the timestamp key alone keeps the old snapshot.
    let mut later = shelf.clone();
    later.now = START.plus_ms(8 * DAY_MS);
    let old = later.documents.0["2.snapshot.json"].clone();
    later.freshen();
    let mut forge = Forge(later);
    forge.stamp(&old, 2);
    let error = forge.0.shown_to(&robot).await.expect_err("a week old");
    assert!(matches!(error, Error::Expired { role: "snapshot", .. }), "{error}");

    let mut later = shelf;
    later.now = START.plus_ms(200 * DAY_MS);
    later.rotate(later.seeds);
    later.now = START.plus_ms(400 * DAY_MS);
    later.freshen();
    let error = later.shown_to(&robot).await.expect_err("a year old");
    assert!(matches!(error, Error::Expired { role: "targets", .. }), "{error}");
}

#[tokio::test]
async fn steps_5_5_2_to_5_5_4_a_snapshot_is_the_one_that_the_timestamp_names_and_signed_by_its_key() {
    let (shelf, robot) = repository().await;
    let mut other = Forge(shelf.clone());
    let first = other.document("1.snapshot.json");
    other.put("2.snapshot.json", first.clone());
    other.refused(&robot, "Transport").await;
    for by in [shelf.seeds.timestamp, STRANGER] {
        let mut other = Forge(shelf.clone());
        let forgery = forged(&other.document("2.snapshot.json"), &key(by), |_| {});
        other.stamp(&forgery, 2);
        other.refused(&robot, "VerifyMetadata").await;
    }
    let mut renamed = Forge(shelf);
    renamed.stamp(&first, 2);
    renamed.refused(&robot, "VersionMismatch").await;
}

#[tokio::test]
async fn step_5_5_5_no_targets_document_goes_back_or_vanishes() {
    let (shelf, robot) = repository().await;
    let mut back = Forge(shelf.clone());
    let first = back.document("1.targets.json");
    back.snap(2, &first, 1);
    back.refused(&robot, "SnapshotRoleRollback").await;
    let mut gone = Forge(shelf.clone());
    let by = key(shelf.seeds.snapshot);
    let without = forged(&gone.document("2.snapshot.json"), &by, |signed| signed["meta"] = json!({}));
    gone.stamp(&without, 2);
    gone.refused(&robot, "SnapshotTargetsMetaMissing").await;
}

#[tokio::test]
async fn steps_5_6_2_to_5_6_4_targets_are_those_that_the_snapshot_names_and_signed_by_their_key() {
    let (shelf, robot) = repository().await;
    let (first, second) = (shelf.documents.0["1.targets.json"].clone(), shelf.documents.0["2.targets.json"].clone());
    let mut other = Forge(shelf.clone());
    other.put("2.targets.json", first.clone());
    other.refused(&robot, "Transport").await;
    for by in [shelf.seeds.snapshot, STRANGER] {
        let mut other = Forge(shelf.clone());
        let evil = [target("walk-6.6.6.manifest", b"evil")];
        let ends = START.plus_ms(PEOPLE_LIFE_MS);
        let forgery = sign_targets(Some(&second), &evil, &[], ends, &[&key(by)]).expect("signed");
        other.snap(2, &forgery, 3);
        other.refused(&robot, "VerifyMetadata").await;
    }
    let mut renamed = Forge(shelf);
    renamed.snap(2, &second, 3);
    renamed.refused(&robot, "VersionMismatch").await;
}

#[tokio::test]
async fn steps_5_6_6_and_5_7_what_is_listed_is_known_by_length_and_digest_and_nothing_else_is() {
    let (shelf, robot) = repository().await;
    let listed = believed(&shelf, &robot).await.targets;
    assert_eq!(listed.keys().collect::<Vec<_>>(), ["walk-1.0.0.manifest", "walk-1.1.0.manifest"]);
    let two = &listed["walk-1.1.0.manifest"];
    assert_eq!((two.digest, two.length), (Digest::of_content(b"two"), 3));
}
