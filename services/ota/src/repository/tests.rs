//! What may be published, what is kept, and that a cut at any write leaves something that robots believe.

mod anew;
mod key_sets;
mod unread;

use super::{Act, Error, FRESHEN_AFTER_MS, OnlineKeys, Publishers, Repository, write_whole};
use crate::content::Content;
use crate::fixture::{Room, SEEDS, START, Seeds, bundle, files, first_root, key, robot, root, target, targets};
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{PEOPLE_LIFE_MS, TIMESTAMP_LIFE_MS, sign_targets};
use midshift_core::time::Utc;
use std::fs;

/// A room in which walk 1.0.0 is published, and the targets document that lists it.
async fn published() -> (Room, Vec<u8>) {
    let room = Room::new().await;
    let files = files("walk", "1.0.0");
    room.bring(&files).await;
    let document = targets(None, &files, SEEDS.targets);
    room.repository.publish(vec![first_root()], document.clone(), 0, Act::of_release(START)).await.expect("published");
    (room, document)
}

/// The fields that a refusal names.
fn fields(error: &Error) -> Vec<&str> {
    let Error::Refused(refusal) = error else { panic!("{error}") };
    refusal.violations.iter().map(|v| v.field.as_str()).collect()
}

fn in_a_year() -> Utc {
    START.plus_ms(PEOPLE_LIFE_MS)
}

#[tokio::test]
async fn a_release_is_shown_to_robots_and_kept_over_a_restart() {
    let (room, first) = published().await;
    let believed = room.shown_to(&robot(), START).await.expect("believed");
    assert_eq!(believed.targets.keys().collect::<Vec<_>>(), ["walk-1.0.0.manifest", "walk-gait-1.0.0.component"]);
    let more = files("walk", "1.1.0");
    room.bring(&more).await;
    let second = targets(Some(&first), &more, SEEDS.targets);
    let later = START.plus_ms(1000);
    let newest = room.repository.publish(Vec::new(), second, 1, Act::of_release(later)).await.expect("the second");
    let room = room.restarted().await;
    let kept = room.repository.newest().expect("kept");
    assert_eq!((kept.targets.clone(), kept.releases.clone()), (newest.targets.clone(), newest.releases.clone()));
    let told: Vec<_> = kept.releases.iter().map(|r| (r.manifest.version.as_str(), r.seen)).collect();
    assert_eq!(told, [("1.0.0", START), ("1.1.0", later)]);
    assert_eq!(room.shown_to(&believed.trusted, later).await.expect("believed").targets.len(), 4);
}

#[tokio::test]
async fn bundles_are_sorted_by_version_as_numbers() {
    let room = Room::new().await;
    let all: Vec<_> = ["1.10.0", "1.9.0"].iter().flat_map(|v| files("walk", v)).chain(files("arm", "2.0.0")).collect();
    room.bring(&all).await;
    let document = targets(None, &all, SEEDS.targets);
    let newest =
        room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect("published");
    let names: Vec<String> = newest.releases.iter().map(|r| r.manifest.target()).collect();
    assert_eq!(names, ["arm-2.0.0.manifest", "walk-1.9.0.manifest", "walk-1.10.0.manifest"]);
}

#[tokio::test]
async fn nothing_is_shown_before_the_first_publication_and_nothing_but_documents_after_it() {
    let room = Room::new().await;
    assert!(room.repository.newest().is_none());
    assert_eq!(room.repository.document("timestamp.json").await.expect("asked"), None);
    let (room, _) = published().await;
    for name in ["1.root.json", "1.targets.json", "1.snapshot.json", "timestamp.json"] {
        assert!(room.repository.document(name).await.expect("asked").is_some(), "{name}");
    }
    for name in ["2.root.json", "01.root.json", "+1.root.json", "seen.json", "../keys/snapshot-1.pem", "root.json", ""]
    {
        assert_eq!(room.repository.document(name).await.expect("asked"), None, "{name}");
    }
}

#[tokio::test]
async fn the_first_publication_brings_the_whole_chain_of_roots() {
    let room = Room::new().await;
    let files = files("walk", "1.0.0");
    room.bring(&files).await;
    let document = targets(None, &files, SEEDS.targets);
    let second = root(2, SEEDS, in_a_year(), &[SEEDS.root]);
    for roots in [vec![], vec![second.clone()], vec![first_root(), first_root()]] {
        let error =
            room.repository.publish(roots, document.clone(), 0, Act::of_release(START)).await.expect_err("refused");
        assert!(fields(&error).iter().all(|field| field.starts_with("roots")), "{error}");
    }
    let newest = room
        .repository
        .publish(vec![first_root(), second], document, 0, Act::of_release(START))
        .await
        .expect("published");
    assert_eq!(newest.root.edition.version, 2);
    room.shown_to(&robot(), START).await.expect("believed");
}

#[tokio::test]
async fn a_root_that_the_one_before_did_not_sign_is_refused() {
    let (room, first) = published().await;
    let thief = Seeds { root: 66, targets: 66, ..SEEDS };
    let document = targets(Some(&first), &[], thief.targets);
    let stolen = root(2, thief, in_a_year(), &[thief.root]);
    let error = room.repository.publish(vec![stolen], document, 1, Act::of_release(START)).await.expect_err("refused");
    assert_eq!(fields(&error), ["roots[0]"]);
}

#[tokio::test]
async fn targets_of_a_stranger_or_of_the_wrong_number_or_expired_are_refused() {
    let (room, first) = published().await;
    let second = targets(Some(&first), &[], SEEDS.targets);
    let third = targets(Some(&second), &[], SEEDS.targets);
    let stranger = targets(Some(&first), &[], 66);
    let expired = sign_targets(Some(&first), &[], &[], START, &[&key(SEEDS.targets)]).expect("targets");
    for document in [first.clone(), third, stranger, expired, b"{}".to_vec(), Vec::new()] {
        let error =
            room.repository.publish(Vec::new(), document, 1, Act::of_release(START)).await.expect_err("refused");
        assert!(fields(&error).contains(&"targets"), "{error}");
    }
    assert_eq!(room.repository.newest().expect("as before").targets.bytes, first);
}

#[tokio::test]
async fn an_expired_root_is_refused() {
    let room = Room::new().await;
    let document = targets(None, &[], SEEDS.targets);
    let old = root(1, SEEDS, START, &[SEEDS.root]);
    let error = room.repository.publish(vec![old], document, 0, Act::of_release(START)).await.expect_err("refused");
    assert_eq!(fields(&error), ["roots"]);
}

#[tokio::test]
async fn who_published_each_bundle_is_known_also_after_a_start() {
    let (room, first) = published().await;
    let second = targets(Some(&first), &[], SEEDS.targets);
    let act = Act { by: "anna".into(), at: START };
    let newest = room.repository.publish(Vec::new(), second, 1, act).await.expect("the second");
    let old = newest.releases[0].digest;
    let known = |by: &Publishers| (by.newest().map(|by| by.to_string()), by.bundle(&old).map(|by| by.to_string()));
    let expected = (Some("anna".to_owned()), Some("release".to_owned()));
    assert_eq!(known(&newest.by), expected);
    let again = room.restarted().await.repository.newest().expect("a release");
    assert_eq!(known(&again.by), expected);
}

#[tokio::test]
async fn who_publishes_on_an_older_version_is_told_which_is_the_newest() {
    let (room, first) = published().await;
    let more = files("walk", "1.1.0");
    room.bring(&more).await;
    let second = targets(Some(&first), &more, SEEDS.targets);
    room.repository.publish(Vec::new(), second.clone(), 1, Act::of_release(START)).await.expect("one of them");
    let other = targets(Some(&first), &[], SEEDS.targets);
    for expected in [0, 1, 7] {
        let error = room
            .repository
            .publish(Vec::new(), other.clone(), expected, Act::of_release(START))
            .await
            .expect_err("too late");
        assert!(matches!(error, Error::Moved { newest: 2, .. }), "{error}");
    }
    let root = fs::read(room.metadata().join("1.root.json")).expect("the root");
    let again =
        room.repository.publish(vec![root], second, 1, Act::of_release(START)).await.expect("the answer was lost");
    assert_eq!(again.targets.edition.version, 2);
    assert_eq!(again.stamp.version, 2, "nothing was signed for that");
}

#[tokio::test]
async fn all_files_that_are_not_here_are_told() {
    let room = Room::new().await;
    let all = files("walk", "1.0.0");
    let document = targets(None, &all, SEEDS.targets);
    let error = room
        .repository
        .publish(vec![first_root()], document.clone(), 0, Act::of_release(START))
        .await
        .expect_err("none is here");
    let Error::Missing(missing) = error else { panic!("{error}") };
    assert_eq!(missing.len(), 2);
    room.bring(&all[..1]).await;
    let error = room
        .repository
        .publish(vec![first_root()], document, 0, Act::of_release(START))
        .await
        .expect_err("one is missing");
    let Error::Missing(missing) = error else { panic!("{error}") };
    assert_eq!(missing[0].name, "walk-gait-1.0.0.component");
}

#[tokio::test]
async fn a_length_that_lies_counts_as_missing() {
    let room = Room::new().await;
    let all = files("walk", "1.0.0");
    room.bring(&all).await;
    let mut listed: Vec<_> = all.iter().map(|(name, content)| target(name, content)).collect();
    listed[1].length += 1;
    let document = sign_targets(None, &listed, &[], in_a_year(), &[&key(SEEDS.targets)]).expect("targets");
    let error =
        room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect_err("refused");
    assert!(matches!(&error, Error::Missing(missing) if missing.len() == 1), "{error}");
}

#[tokio::test]
async fn a_manifest_that_is_none_or_names_what_is_not_listed_is_refused() {
    let room = Room::new().await;
    let (manifest, _) = bundle("walk", "1.0.0");
    let alone = (manifest.target(), manifest.to_bytes());
    let renamed = ("run-1.0.0.manifest".to_owned(), manifest.to_bytes());
    let none = ("jump-1.0.0.manifest".to_owned(), b"jumps".to_vec());
    let all = [alone, renamed, none];
    room.bring(&all).await;
    let document = targets(None, &all, SEEDS.targets);
    let error =
        room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect_err("refused");
    assert_eq!(
        fields(&error),
        ["targets.jump-1.0.0.manifest", "targets.run-1.0.0.manifest", "targets.walk-1.0.0.manifest"]
    );
}

#[tokio::test]
async fn a_root_that_names_other_online_keys_is_refused_and_a_successor_that_lies_ready_signs() {
    let (room, first) = published().await;
    let document = targets(Some(&first), &[], SEEDS.targets);
    let foreign = root(2, Seeds { timestamp: 66, ..SEEDS }, in_a_year(), &[SEEDS.root]);
    let error =
        room.repository.publish(vec![foreign], document.clone(), 1, Act::of_release(START)).await.expect_err("refused");
    assert!(matches!(error, Error::NotNamed { root_version: 2, role: "timestamp" }), "{error}");
    assert!(error.to_string().starts_with("the repository's root 2 names other timestamp keys than this server has"));
    let next = root(2, Seeds { snapshot: 13, timestamp: 14, ..SEEDS }, in_a_year(), &[SEEDS.root]);
    room.repository.publish(vec![next], document, 1, Act::of_release(START)).await.expect("the keys lie ready");
    let believed = room.shown_to(&robot(), START).await.expect("believed");
    let room = room.restarted().await;
    room.shown_to(&believed.trusted, START).await.expect("believed after a restart");
}

#[test]
fn a_folder_without_the_keys_of_a_role_is_no_folder_of_keys() {
    let dir = tempfile::tempdir().expect("a folder");
    SecretKey::draw().write(&dir.path().join("snapshot-1.pem")).expect("a key");
    let error = OnlineKeys::read(dir.path()).err().expect("no timestamp key");
    assert!(error.to_string().ends_with("has no timestamp-*.pem"), "{error}");
    fs::write(dir.path().join("timestamp-1.pem"), "no key").expect("a file");
    assert!(matches!(OnlineKeys::read(dir.path()), Err(Error::Key(_))));
}

#[tokio::test]
async fn a_cut_at_any_write_leaves_a_repository_that_robots_believe() {
    let rotated = Seeds { root: 11, targets: 12, snapshot: 13, timestamp: 14 };
    let more = files("walk", "1.1.0");
    let mut cut = 0;
    loop {
        let (room, first) = published().await;
        let believed = room.shown_to(&robot(), START).await.expect("believed").trusted;
        room.bring(&more).await;
        let roots = vec![root(2, rotated, in_a_year(), &[SEEDS.root, rotated.root])];
        let document = targets(Some(&first), &more, rotated.targets);
        let before = room.repository.newest();
        let publication =
            room.repository.prepare(before.as_deref(), roots.clone(), document.clone(), Act::of_release(START)).await;
        let writes = publication.expect("it holds").writes;
        for (name, bytes) in &writes[..cut] {
            write_whole(&room.metadata().join(name), bytes).expect("written");
        }
        if let Some((name, bytes)) = writes.get(cut) {
            fs::write(room.metadata().join(format!("{name}.new")), &bytes[..bytes.len() / 2]).expect("torn");
        }
        let room = room.restarted().await;
        let is_published = cut == writes.len();
        for robot in [&believed, &robot()] {
            let seen = room.shown_to(robot, START).await.unwrap_or_else(|e| panic!("after {cut} writes: {e}"));
            assert_eq!(seen.targets.len(), if is_published { 4 } else { 2 }, "after {cut} writes");
        }
        let again = room.repository.publish(roots, document, 1, Act::of_release(START)).await.expect("asked again");
        assert_eq!((again.root.edition.version, again.targets.edition.version), (2, 2));
        assert_eq!(room.shown_to(&believed, START).await.expect("believed").targets.len(), 4);
        if is_published {
            assert_eq!(writes.last().expect("writes").0, "timestamp.json");
            assert_eq!(cut, 6, "root, seen, by, targets, snapshot, timestamp");
            break;
        }
        cut += 1;
    }
}

#[tokio::test]
async fn freshness_is_signed_anew_at_half_its_life_and_not_before() {
    let (room, _) = published().await;
    let soon = START.plus_ms(FRESHEN_AFTER_MS - 1);
    assert_eq!(room.repository.freshen(soon).await.expect("looked"), Some(1));
    assert_eq!(room.repository.newest().expect("there").stamp.version, 1);
    let due = START.plus_ms(FRESHEN_AFTER_MS);
    assert_eq!(room.repository.freshen(due).await.expect("signed"), Some(FRESHEN_AFTER_MS));
    let stamp = room.repository.newest().expect("there").stamp;
    assert_eq!((stamp.version, stamp.issued, stamp.expires), (2, due, due.plus_ms(TIMESTAMP_LIFE_MS)));
    let late = START.plus_ms(TIMESTAMP_LIFE_MS + 1);
    let believed = room.shown_to(&robot(), late).await.expect("the first timestamp would be expired");
    assert_eq!(believed.trusted.time_floor(), due);
}

#[tokio::test]
async fn weeks_of_signatures_leave_few_snapshots_and_robots_that_follow() {
    let (room, _) = published().await;
    let mut trusted = robot();
    for half_day in 1..=40 {
        let now = START.plus_ms(half_day * FRESHEN_AFTER_MS);
        room.repository.freshen(now).await.expect("signed");
        if half_day % 13 == 0 {
            trusted = room.shown_to(&trusted, now).await.expect("believed").trusted;
        }
    }
    let names = fs::read_dir(room.metadata()).expect("a folder").map(|e| e.expect("an entry").file_name());
    let snapshots = names.filter(|n| n.to_string_lossy().ends_with(".snapshot.json")).count();
    assert_eq!(snapshots, 16);
}

#[tokio::test]
async fn targets_that_no_kept_snapshot_names_go_and_every_root_stays() {
    let (room, mut document) = published().await;
    for version in 1..=20 {
        let roots = if version == 5 { vec![root(2, SEEDS, in_a_year(), &[SEEDS.root])] } else { Vec::new() };
        document = targets(Some(&document), &[], SEEDS.targets);
        room.repository.publish(roots, document.clone(), version, Act::of_release(START)).await.expect("published");
    }
    let names = || -> Vec<String> {
        let entries = fs::read_dir(room.metadata()).expect("a folder");
        entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("text")).collect()
    };
    let count = |role: &str| names().iter().filter(|name| name.ends_with(&format!(".{role}.json"))).count();
    assert_eq!((count("root"), count("targets"), count("snapshot")), (2, 16, 16));
    assert_eq!(room.repository.document("5.targets.json").await.expect("asked"), None);
    assert!(room.repository.document("6.targets.json").await.expect("asked").is_some());
    let late = START.plus_ms(20 * FRESHEN_AFTER_MS);
    for half_day in 1..=20 {
        room.repository.freshen(START.plus_ms(half_day * FRESHEN_AFTER_MS)).await.expect("signed");
    }
    assert_eq!((count("root"), count("targets"), count("snapshot")), (2, 1, 16), "all of them name the newest");
    room.shown_to(&robot(), late).await.expect("believed");
    room.restarted().await.shown_to(&robot(), late).await.expect("believed after a start");
}

#[tokio::test]
async fn when_a_bundle_was_seen_is_forgotten_once_it_is_neither_listed_nor_here() {
    let (room, first) = published().await;
    let names = ["walk-1.0.0.manifest".to_owned(), "walk-gait-1.0.0.component".to_owned()];
    let without = |previous: &[u8], names: &[String]| {
        sign_targets(Some(previous), &[], names, in_a_year(), &[&key(SEEDS.targets)]).expect("targets")
    };
    let seen = || fs::read_to_string(room.metadata().join("seen.json")).expect("there").len() > "{}".len();
    let second = without(&first, &names);
    room.repository.publish(Vec::new(), second.clone(), 1, Act::of_release(START)).await.expect("published");
    assert!(seen(), "its files are here still");
    for (_, content) in files("walk", "1.0.0") {
        room.content.remove(Digest::of_content(&content)).await.expect("removed");
    }
    room.repository.publish(Vec::new(), without(&second, &[]), 2, Act::of_release(START)).await.expect("published");
    assert!(!seen());
}

#[tokio::test]
async fn a_clock_that_went_back_does_not_keep_freshness_from_being_signed() {
    let (room, _) = published().await;
    let earlier = Utc(START.0 - 86_400_000);
    room.repository.freshen(earlier).await.expect("signed");
    let stamp = room.repository.newest().expect("there").stamp;
    assert_eq!((stamp.version, stamp.issued), (2, earlier));
    assert_eq!(room.repository.freshen(earlier).await.expect("looked"), Some(FRESHEN_AFTER_MS));
}

#[tokio::test]
async fn documents_that_were_tampered_with_on_the_disk_are_not_opened() {
    for (name, from, to) in [
        ("1.targets.json", "walk-1.0.0", "walk-6.6.6"),
        ("timestamp.json", "\"version\": 1", "\"version\": 9"),
        ("1.root.json", "2028", "2038"),
    ] {
        let (room, _) = published().await;
        let path = room.metadata().join(name);
        let text = fs::read_to_string(&path).expect("a document");
        assert!(text.contains(from), "{name}: {text}");
        fs::write(&path, text.replace(from, to)).expect("tampered");
        let keys = OnlineKeys::read(&room.dir.path().join("keys")).expect("keys");
        let opened = Repository::open(&room.metadata(), keys, room.content.clone()).await;
        assert!(opened.is_err(), "{name}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_publication_that_nobody_waits_for_any_more_is_written_to_its_end_and_shown() {
    let files = files("walk", "1.0.0");
    // One that is over before anybody could turn away says nothing.
    for _ in 0..300 {
        let room = Room::new().await;
        room.bring(&files).await;
        let document = targets(None, &files, SEEDS.targets);
        let mut publishing = Box::pin(room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)));
        let mut is_over = false;
        while !is_over && !room.metadata().join("1.root.json").exists() {
            tokio::select! {
                biased;
                published = &mut publishing => is_over = published.is_ok(),
                () = tokio::task::yield_now() => {}
            }
        }
        drop(publishing);
        if !is_over {
            // It has its turn when all is written.
            room.repository.freshen(START).await.expect("nothing is due");
            assert!(room.repository.newest().is_some(), "it was shown");
            assert!(room.restarted().await.repository.newest().is_some(), "and kept");
            return;
        }
    }
    panic!("no publication took long enough to turn away from");
}

#[tokio::test]
async fn a_restored_repository_is_signed_anew_at_once_with_versions_above_all_that_robots_saw() {
    let (room, _) = published().await;
    let before = room.repository.newest().expect("published").stamp;
    // Robots saw later versions, which the copy does not know.
    super::raise_floor(&room.metadata(), 1_000).expect("written");
    super::raise_floor(&room.metadata(), 4).expect("it is never lowered");
    let room = room.restarted().await;
    room.repository.freshen(START).await.expect("signed");
    let stamp = room.repository.newest().expect("kept").stamp;
    assert_eq!((before.version, stamp.version, stamp.snapshot_version), (1, 1_000, 1_000));
    room.repository.freshen(START).await.expect("it is fresh");
    assert_eq!(room.repository.newest().expect("kept").stamp.version, 1_000);
    room.shown_to(&robot(), START).await.expect("believed");
}
