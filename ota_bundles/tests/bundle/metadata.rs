//! What a robot believes of a repository, and what it does not. Each test is named by the attack or mishap.

use crate::shelf::{Documents, START, Seeds, Shelf, key, signers, target};
use midshift_bundle::repository::{
    DAY_MS, PEOPLE_LIFE_MS, RootDraft, add_signatures, check_targets, sign_root, sign_targets,
};
use midshift_bundle::trust::{Error, METADATA_BYTES_MAX, Reading, Trusted};
use midshift_core::time::Utc;
use std::sync::Arc;

/// The name of the rule of the library that refused.
pub fn rule(error: &Error) -> String {
    match error {
        Error::Metadata(e) => format!("{e:?}").split([' ', '{', '(']).next().unwrap_or_default().to_owned(),
        other => format!("{other:?}").split([' ', '{', '(']).next().unwrap_or_default().to_owned(),
    }
}

#[tokio::test]
async fn a_good_release_is_believed_and_listed() {
    let mut shelf = Shelf::new();
    let robot = shelf.shown_to(&shelf.robot()).await.expect("the first");
    assert_eq!(robot.targets.keys().collect::<Vec<_>>(), ["walk-1.0.0.manifest"]);
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let robot = shelf.shown_to(&robot.trusted).await.expect("the second");
    assert_eq!(robot.targets.len(), 2);
    assert_eq!(robot.targets["walk-1.1.0.manifest"].length, 3);
    let again = shelf.shown_to(&robot.trusted).await.expect("nothing new");
    assert_eq!(again.trusted, robot.trusted);
}

#[tokio::test]
async fn tampered_documents_are_refused() {
    let shelf = Shelf::new();
    for name in ["timestamp.json", "1.snapshot.json", "1.targets.json"] {
        let mut tampered = shelf.clone();
        let text = String::from_utf8(tampered.documents.0[name].clone()).expect("text");
        let changed = text.replacen("\"version\": 1", "\"version\": 9", 1);
        assert_ne!(changed, text, "{name}");
        tampered.documents.0.insert(name.to_owned(), changed.into_bytes());
        assert!(tampered.shown_to(&shelf.robot()).await.is_err(), "{name}");
    }
}

#[tokio::test]
async fn a_stolen_online_key_adds_no_target() {
    let mut shelf = Shelf::new();
    let stolen = key(shelf.seeds.timestamp);
    let expires = shelf.now.plus_ms(PEOPLE_LIFE_MS);
    let evil = [target("walk-6.6.6.manifest", b"evil")];
    shelf.targets = sign_targets(Some(&shelf.targets), &evil, &[], expires, &[&stolen]).expect("signed by the thief");
    shelf.documents.0.insert("2.targets.json".to_owned(), shelf.targets.clone());
    shelf.freshen();
    let error = shelf.shown_to(&shelf.robot()).await.expect_err("refused");
    assert_eq!(rule(&error), "VerifyMetadata");
}

#[tokio::test]
async fn rolled_back_documents_are_refused() {
    let mut shelf = Shelf::new();
    let old = shelf.clone();
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let robot = shelf.shown_to(&shelf.robot()).await.expect("the newest").trusted;
    let error = old.shown_to(&robot).await.expect_err("yesterday's repository");
    assert_eq!(rule(&error), "OlderMetadata");
}

#[tokio::test]
async fn a_mix_of_two_releases_is_refused() {
    let mut shelf = Shelf::new();
    let old = shelf.clone();
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let mut mixed = shelf.clone();
    mixed.documents.0.insert("2.targets.json".to_owned(), old.documents.0["1.targets.json"].clone());
    assert!(mixed.shown_to(&shelf.robot()).await.is_err());
    let mut mixed = shelf.clone();
    mixed.documents.0.insert("2.snapshot.json".to_owned(), old.documents.0["1.snapshot.json"].clone());
    assert!(mixed.shown_to(&shelf.robot()).await.is_err());
}

#[tokio::test]
async fn a_frozen_repository_is_noticed() {
    let shelf = Shelf::new();
    let late = Reading { utc: shelf.now.plus_ms(2 * DAY_MS), is_synced: true };
    let error = shelf.robot().refresh(Arc::new(shelf.documents.clone()), late).await.expect_err("two days old");
    assert!(matches!(error, Error::Expired { role: "timestamp", .. }), "{error}");
}

#[tokio::test]
async fn endless_documents_are_refused() {
    let mut shelf = Shelf::new();
    let mut long = shelf.documents.0["timestamp.json"].clone();
    long.resize(METADATA_BYTES_MAX as usize + 1, b' ');
    shelf.documents.0.insert("timestamp.json".to_owned(), long);
    let error = shelf.shown_to(&shelf.robot()).await.expect_err("too long");
    assert!(!error.is_unreachable(), "{error}");
}

#[tokio::test]
async fn an_empty_or_vanished_repository_takes_nothing_away() {
    let shelf = Shelf::new();
    let robot = shelf.shown_to(&shelf.robot()).await.expect("believed").trusted;
    let gone = robot.refresh(Arc::new(Documents::default()), shelf.clock()).await;
    let error = gone.expect_err("there is nothing");
    assert!(error.is_unreachable(), "{error}");
    assert!(shelf.shown_to(&robot).await.is_ok(), "what was believed is believed still");
}

#[tokio::test]
async fn a_new_root_needs_the_old_key() {
    let mut shelf = Shelf::new();
    let robot = shelf.robot();
    let thief = 66;
    let draft = RootDraft {
        version: 2,
        expires: shelf.now.plus_ms(PEOPLE_LIFE_MS),
        root: signers(&[thief], 1),
        targets: signers(&[thief], 1),
        snapshot: signers(&[thief], 1),
        timestamp: signers(&[thief], 1),
    };
    let root = sign_root(&draft, &[&key(thief)]).expect("a root of the thief");
    shelf.documents.0.insert("2.root.json".to_owned(), root);
    let error = shelf.shown_to(&robot).await.expect_err("refused");
    assert_eq!(rule(&error), "VerifyMetadata");
}

#[tokio::test]
async fn after_a_fast_forward_a_rotated_key_begins_again() {
    let mut shelf = Shelf::new();
    let robot = shelf.shown_to(&shelf.robot()).await.expect("believed").trusted;
    // A thief of the online keys drives the versions up, so that nothing newer could follow.
    let mut forward = shelf.clone();
    forward.publish(u64::MAX / 2);
    let robot = forward.shown_to(&robot).await.expect("signed with good keys").trusted;
    shelf.freshen();
    assert!(shelf.shown_to(&robot).await.is_err(), "without a new root there is no way on");
    shelf.rotate(Seeds { snapshot: 13, timestamp: 14, ..shelf.seeds });
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let after = shelf.shown_to(&robot).await.expect("the new keys count from their own beginning");
    assert_eq!(after.targets.len(), 2);
}

#[tokio::test]
async fn no_clock_makes_an_older_repository_good_or_a_good_one_bad() {
    let mut shelf = Shelf::new();
    let old = shelf.clone();
    shelf.now = START.plus_ms(20 * DAY_MS);
    shelf.release(&[target("walk-1.1.0.manifest", b"two")]);
    let robot = shelf.shown_to(&shelf.robot()).await.expect("believed").trusted;
    assert_eq!(robot.time_floor(), shelf.now);
    let wrong = [
        ("a day back", Reading { utc: Utc(shelf.now.0 - DAY_MS as i64), is_synced: true }),
        ("1970", Reading { utc: Utc(0), is_synced: true }),
        ("not synced", Reading { utc: shelf.now.plus_ms(3_650 * DAY_MS), is_synced: false }),
    ];
    for (name, clock) in wrong {
        assert!(robot.refresh(Arc::new(old.documents.clone()), clock).await.is_err(), "{name}: an older one");
        let good = robot.refresh(Arc::new(shelf.documents.clone()), clock).await;
        assert_eq!(good.expect(name).trusted.time_floor(), shelf.now, "{name}: the floor is the signed time");
    }
    // Ten years ahead and back: nothing is accepted while it lasts, everything afterwards.
    let ahead = Reading { utc: shelf.now.plus_ms(3_650 * DAY_MS), is_synced: true };
    assert!(matches!(robot.refresh(Arc::new(shelf.documents.clone()), ahead).await, Err(Error::Expired { .. })));
    assert!(shelf.shown_to(&robot).await.is_ok());
}

#[tokio::test]
async fn two_of_three_must_sign_and_hand_the_document_on() {
    let expires = START.plus_ms(PEOPLE_LIFE_MS);
    let people = signers(&[21, 22, 23], 2);
    let draft = RootDraft {
        version: 1,
        expires,
        root: people.clone(),
        targets: people,
        snapshot: signers(&[3], 1),
        timestamp: signers(&[4], 1),
    };
    let root = sign_root(&draft, &[&key(21), &key(22)]).expect("a root");
    let first = sign_targets(None, &[target("a.manifest", b"a")], &[], expires, &[&key(22)]).expect("one signature");
    assert!(check_targets(&root, &first).is_err(), "one is not enough");
    assert!(
        check_targets(&root, &add_signatures(&first, &[&key(22)]).expect("again")).is_err(),
        "twice the same is one"
    );
    assert!(check_targets(&root, &add_signatures(&first, &[&key(99)]).expect("a stranger")).is_err());
    let both = add_signatures(&first, &[&key(23)]).expect("the second");
    check_targets(&root, &both).expect("two of three");
}

#[test]
fn what_a_name_stands_for_never_changes() {
    let expires = START.plus_ms(PEOPLE_LIFE_MS);
    let first = sign_targets(None, &[target("a-1.0.0.manifest", b"a")], &[], expires, &[&key(2)]).expect("signed");
    let same = sign_targets(Some(&first), &[target("a-1.0.0.manifest", b"a")], &[], expires, &[&key(2)]);
    assert!(same.is_ok());
    let other = sign_targets(Some(&first), &[target("a-1.0.0.manifest", b"b")], &[], expires, &[&key(2)]);
    assert!(other.expect_err("other bytes").to_string().contains("raise its version"));
    for name in ["", "a/b", "..", "../a", "a\\b", ".hidden"] {
        assert!(sign_targets(None, &[target(name, b"a")], &[], expires, &[&key(2)]).is_err(), "{name:?}");
    }
}

#[test]
fn what_is_believed_is_on_the_disk_whole_or_refused() {
    let shelf = Shelf::new();
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trusted.json");
    assert_eq!(Trusted::load(&path).expect("nothing yet"), None);
    let robot = shelf.robot();
    robot.save(&path).expect("written");
    assert_eq!(Trusted::load(&path).expect("read"), Some(robot.clone()));
    // Power went while the next one was written beside it.
    std::fs::write(path.with_extension("json.new"), b"{\"root\":").expect("torn");
    assert_eq!(Trusted::load(&path).expect("read"), Some(robot));
    let whole = std::fs::read(&path).expect("bytes");
    for length in [0, 1, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).expect("torn");
        assert!(matches!(Trusted::load(&path), Err(Error::Store { .. })), "{length} bytes are not taken for none");
    }
}

#[tokio::test]
async fn a_timestamp_that_is_withheld_is_seen_to_expire_by_the_time_that_a_proven_server_tells() {
    let shelf = Shelf::new();
    let robot = shelf.shown_to(&shelf.robot()).await.expect("believed").trusted;
    let unsynced = Reading { utc: Utc(0), is_synced: false };
    let shown = async |robot: &Trusted| robot.refresh(Arc::new(shelf.documents.clone()), unsynced).await;
    assert!(shown(&robot).await.is_ok(), "by itself it cannot know that a day has passed");
    assert_eq!(robot.raise_time_floor(shelf.now), None);
    assert_eq!(robot.raise_time_floor(shelf.now.plus_ms(DAY_MS / 48)), None, "not worth a write");
    let later = robot.raise_time_floor(shelf.now.plus_ms(DAY_MS + DAY_MS / 2)).expect("a later time");
    let error = shown(&later).await.expect_err("the timestamp lived a day");
    assert!(matches!(error, Error::Expired { role: "timestamp", .. }), "{error}");
    assert_eq!(later.raise_time_floor(shelf.now.plus_ms(DAY_MS)), None, "it never falls");
    // A server that is ten years ahead moves it by two days, and then no further.
    let ahead = robot.raise_time_floor(shelf.now.plus_ms(3_650 * DAY_MS)).expect("a later time");
    assert_eq!(ahead.time_floor(), shelf.now.plus_ms(2 * DAY_MS));
    assert_eq!(ahead.raise_time_floor(shelf.now.plus_ms(3_651 * DAY_MS)), None);
    let mut signed = shelf.clone();
    signed.now = shelf.now.plus_ms(3 * DAY_MS);
    signed.freshen();
    let healed = signed.shown_to(&ahead).await.expect("what is signed after that is believed").trusted;
    assert_eq!(healed.time_floor(), signed.now);
    assert!(
        Trusted::new(&shelf.documents.0["1.root.json"]).expect("a root").raise_time_floor(shelf.now).is_none(),
        "no signed time"
    );
}

/// A server whose clock is far ahead signs, and what follows for a robot that fetches it again and again.
#[tokio::test]
async fn a_signed_time_raises_the_floor_two_days_past_what_a_robot_knows_and_each_only_once() {
    let shelf = Shelf::new();
    let unsynced = Reading { utc: Utc(0), is_synced: false };
    let shown = async |shelf: &Shelf, robot: &Trusted| {
        robot.refresh(Arc::new(shelf.documents.clone()), unsynced).await.map(|refreshed| refreshed.trusted)
    };
    let robot = shown(&shelf, &shelf.robot()).await.expect("the first time that it hears counts whole");
    assert_eq!(robot.time_floor(), shelf.now);
    let ahead = |days: u64| {
        let mut ahead = shelf.clone();
        ahead.now = shelf.now.plus_ms(days * DAY_MS);
        ahead.freshen();
        ahead
    };
    let wrong = ahead(30);
    let fooled = shown(&wrong, &robot).await.expect("believed");
    assert_eq!(fooled.time_floor(), shelf.now.plus_ms(2 * DAY_MS));
    let again = shown(&wrong, &fooled).await.expect("believed");
    assert_eq!(again.time_floor(), fooled.time_floor(), "one signature raises it once");
    // What it counted itself, or was told by a proven server, or reads off a clock that is set, is no doubt of the signature's.
    let knows = robot.clone().knowing(shelf.now.plus_ms(29 * DAY_MS));
    assert_eq!(shown(&wrong, &knows).await.expect("believed").time_floor(), wrong.now);
    let synced = Reading { utc: shelf.now.plus_ms(10 * DAY_MS), is_synced: true };
    let synced = robot.refresh(Arc::new(wrong.documents.clone()), synced).await.expect("believed").trusted;
    assert_eq!(synced.time_floor(), shelf.now.plus_ms(12 * DAY_MS));
    // The clock is right again: it goes on as soon as what is honest is not older than two days.
    let mut honest = wrong.clone();
    honest.now = shelf.now.plus_ms(DAY_MS + DAY_MS / 2);
    honest.freshen();
    let healed = shown(&honest, &again).await.expect("two days, not thirty");
    assert_eq!(healed.time_floor(), fooled.time_floor());
}
