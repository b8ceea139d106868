//! Sets of directive keys: which may be listed, and with which key the server signs.

use super::{fields, published};
use crate::fixture::{Room, SEEDS, START, first_root, give_back, hide, key, key_set, targets};
use crate::repository::{Act, CannotSign, Documents, Error, FRESHEN_AFTER_MS, SetLost};
use midshift_bundle::digest::Digest;
use midshift_bundle::repository::{PEOPLE_LIFE_MS, sign_targets};
use midshift_core::reason::Code;
use std::fs;

type File = (String, Vec<u8>);

/// Publishes these files on top of `previous`.
async fn push(room: &Room, previous: &[u8], version: u64, files: &[File]) -> Result<Vec<u8>, Error> {
    room.bring(files).await;
    let document = targets(Some(previous), files, SEEDS.targets);
    room.repository.publish(Vec::new(), document.clone(), version, Act::of_release(START)).await.map(|_| document)
}

fn signs_with(room: &Room) -> u8 {
    let own = room.repository.directive_key().expect("one that is current").public();
    [5, 15, 25].into_iter().find(|seed| key(*seed).public() == own).expect("one of them")
}

#[tokio::test]
async fn the_server_signs_with_the_first_key_of_the_newest_set_that_it_has_also_after_a_start() {
    let (room, first) = published().await;
    assert_eq!(signs_with(&room), 5, "the first by name");
    let second = push(&room, &first, 1, &[key_set(1, &[25, 15, 5], 5)]).await.expect("published");
    assert_eq!(signs_with(&room), 15);
    let room = room.restarted().await;
    assert_eq!(signs_with(&room), 15);
    push(&room, &second, 2, &[key_set(2, &[5], 15)]).await.expect("published");
    assert_eq!(signs_with(&room), 5, "the other one has ended");
}

#[tokio::test]
async fn a_set_that_no_current_key_signed_or_that_is_not_the_next_is_refused() {
    let (room, first) = published().await;
    let first = push(&room, &first, 1, &[key_set(1, &[15], 5)]).await.expect("published");
    for (set, field) in [
        (key_set(2, &[15], 66), "targets.2.directive-keys"),
        (key_set(2, &[15], 5), "targets.2.directive-keys"),
        (key_set(3, &[15], 15), "targets"),
        (("2.directive-keys".to_owned(), key_set(3, &[15], 15).1), "targets.2.directive-keys"),
        (("2.directive-keys".to_owned(), b"keys".to_vec()), "targets.2.directive-keys"),
        (("two.directive-keys".to_owned(), key_set(2, &[15], 15).1), "targets.two.directive-keys"),
    ] {
        let error = push(&room, &first, 2, &[set]).await.expect_err("refused");
        assert_eq!(fields(&error), [field], "{error}");
    }
    assert_eq!(signs_with(&room), 15);
}

#[tokio::test]
async fn a_set_without_a_key_of_the_server_is_refused_before_it_ends_those_that_it_has() {
    let (room, first) = published().await;
    let error = push(&room, &first, 1, &[key_set(1, &[25], 5)]).await.expect_err("refused");
    assert_eq!(fields(&error), ["targets.1.directive-keys"]);
    assert!(error.to_string().contains("names no directive key of this server"), "{error}");
}

#[tokio::test]
async fn a_set_stays_listed_for_robots_that_were_away() {
    let (room, first) = published().await;
    let second = push(&room, &first, 1, &[key_set(1, &[15, 5], 5)]).await.expect("published");
    let without = ["1.directive-keys".to_owned()];
    let expires = START.plus_ms(PEOPLE_LIFE_MS);
    let third = sign_targets(Some(&second), &[], &without, expires, &[&key(SEEDS.targets)]).expect("targets");
    let error = room.repository.publish(Vec::new(), third, 2, Act::of_release(START)).await.expect_err("refused");
    assert_eq!(fields(&error), ["targets.1.directive-keys"]);
}

#[tokio::test]
async fn a_repository_that_is_new_to_a_server_brings_all_its_sets() {
    let room = Room::new().await;
    let files = [key_set(1, &[25], 66), key_set(2, &[15], 25)];
    room.bring(&files).await;
    let document = targets(None, &files, SEEDS.targets);
    room.repository.publish(vec![first_root()], document, 0, Act::of_release(START)).await.expect("published");
    assert_eq!(signs_with(&room), 15);
}

#[tokio::test]
async fn a_server_without_a_key_of_the_newest_set_signs_nothing_until_the_key_is_there() {
    let (room, first) = published().await;
    push(&room, &first, 1, &[key_set(1, &[15], 5)]).await.expect("published");
    let file = room.dir.path().join("keys/directive-2.pem");
    fs::remove_file(&file).expect("it was not given to this process");
    let room = room.restarted().await;
    assert_eq!(room.repository.find_directive_key().await.err(), Some(CannotSign::Ended { number: 1 }));
    let reason = CannotSign::Ended { number: 1 }.reason();
    assert_eq!((reason.code, reason.metadata["set"].as_str()), (Code::NoDirectiveKey, "1"));
    key(15).write(&file).expect("a key");
    assert!(room.repository.directive_key().is_err(), "nobody has looked");
    let found = room.repository.find_directive_key().await.expect("without a restart");
    assert_eq!(found.public(), key(15).public());
}

#[tokio::test]
async fn a_server_that_cannot_read_the_newest_set_signs_nothing_until_it_can() {
    let (room, first) = published().await;
    let set = key_set(1, &[15, 5], 5);
    let path = room.dir.path().join("content").join(Digest::of_content(&set.1).to_string());
    push(&room, &first, 1, &[set]).await.expect("published");
    hide(&path);
    let room = room.restarted().await;
    assert_eq!(room.repository.find_directive_key().await.err(), Some(CannotSign::Unknown), "5 may have ended");
    give_back(&path);
    room.repository.documents().follow().await.expect("readable");
    assert_eq!(signs_with(&room), 15);
}

#[tokio::test]
async fn after_all_keys_of_a_set_were_lost_the_server_signs_nothing_until_a_set_of_its_own_is_listed() {
    let (room, first) = published().await;
    let second = push(&room, &first, 1, &[key_set(1, &[15], 5)]).await.expect("published");
    for name in ["directive-1", "directive-2"] {
        fs::remove_file(room.dir.path().join(format!("keys/{name}.pem"))).expect("lost");
    }
    key(25).write(&room.dir.path().join("keys/directive-3.pem")).expect("a key");
    let room = room.restarted().await;
    assert_eq!(room.repository.directive_key().err(), Some(CannotSign::Ended { number: 1 }));
    push(&room, &second, 2, &[key_set(2, &[25], 25)]).await.expect("robots have it from their trust files");
    assert_eq!(signs_with(&room), 25);
    assert_eq!(room.repository.newest().expect("there").key_set.as_ref().map(|set| set.number), Some(2));
}

#[tokio::test]
async fn a_server_whose_newest_set_is_gone_or_damaged_says_which_and_signs_again_once_it_is_back() {
    for damaged in [None, Some(&b"not a set"[..])] {
        let (room, first) = published().await;
        let set = key_set(1, &[15, 5], 5);
        let path = room.dir.path().join("content").join(Digest::of_content(&set.1).to_string());
        push(&room, &first, 1, std::slice::from_ref(&set)).await.expect("published");
        match damaged {
            None => fs::remove_file(&path).expect("removed"),
            Some(bytes) => fs::write(&path, bytes).expect("spoiled"),
        }
        let room = room.restarted().await;
        let lost = CannotSign::Lost(SetLost { number: 1 });
        assert_eq!(room.repository.find_directive_key().await.err(), Some(lost), "5 may have ended");
        let reason = lost.reason();
        assert_eq!((reason.code, reason.metadata["file"].as_str()), (Code::NoDirectiveKey, "gone or damaged"));
        room.repository.documents().follow().await.expect("the rest is readable");
        assert_eq!(room.repository.directive_key().err(), Some(lost));
        fs::write(&path, b"half of").expect("begun");
        room.repository.documents().follow().await.expect("the rest is readable");
        assert_eq!(room.repository.directive_key().err(), Some(lost), "it is not the set");
        fs::write(&path, &set.1).expect("put back");
        room.repository.documents().follow().await.expect("readable");
        assert_eq!(signs_with(&room), 15, "without a restart");
        assert!(room.repository.newest().expect("shown").unread.is_empty());
    }
}

#[tokio::test]
async fn a_set_that_goes_while_it_is_known_is_known_still() {
    let (room, first) = published().await;
    let set = key_set(1, &[15, 5], 5);
    let path = room.dir.path().join("content").join(Digest::of_content(&set.1).to_string());
    push(&room, &first, 1, &[set]).await.expect("published");
    let other = Documents::reading(&room.metadata(), room.content.clone()).await.expect("readable");
    fs::remove_file(&path).expect("removed");
    room.repository.freshen(START.plus_ms(FRESHEN_AFTER_MS)).await.expect("signed");
    other.follow().await.expect("the rest is readable");
    let newest = other.newest().expect("shown");
    assert_eq!((newest.key_set.as_ref().map(|set| set.number), newest.set_lost), (Some(1), None));
}
