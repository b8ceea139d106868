//! Sets of keys that sign directives: which of those that a release lists a robot goes over to, and which people may list.

use crate::shelf::{START, key};
use midshift_bundle::folder::{Error, Folder, Signed};
use midshift_bundle::key_set::{Current, ENVELOPE_BYTES_MAX, KEYS_MAX, KeySet, Rejection};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{Profile, listed};
use std::collections::BTreeMap;

fn set(number: u64, seeds: &[u8], by: u8) -> Vec<u8> {
    let keys = seeds.iter().map(|seed| key(*seed).public()).collect();
    KeySet { number, keys }.sign(&key(by)).expect("a set")
}

/// A robot that has the keys of these seeds from set `number`.
fn robot(number: u64, seeds: &[u8]) -> Current {
    let keys = seeds.iter().map(|seed| key(*seed).public()).map(|key| (key.id(), key)).collect();
    Current { number, keys }
}

fn shown(robot: &mut Current, sets: &[(u64, Vec<u8>)]) -> Vec<(u64, Rejection)> {
    robot.follow(&sets.iter().cloned().collect::<BTreeMap<_, _>>())
}

#[test]
fn a_set_that_a_current_key_signed_is_taken_and_ends_the_keys_that_it_does_not_name() {
    let mut this = robot(0, &[7]);
    assert_eq!(shown(&mut this, &[(1, set(1, &[8, 7], 7)), (2, set(2, &[8], 8))]), []);
    assert_eq!(this, robot(2, &[8]), "from set to set, as a robot goes that was away");
}

#[test]
fn a_set_that_an_ended_or_an_unknown_key_signed_is_passed_over() {
    let mut this = robot(2, &[8]);
    let sets = [(3, set(3, &[7], 7)), (4, set(4, &[66], 66)), (5, set(5, &[9], 8))];
    assert_eq!(shown(&mut this, &sets), [(3, Rejection::NotSigned), (4, Rejection::NotSigned)]);
    assert_eq!(this, robot(5, &[9]), "a stranger's set stops none that is good");
}

#[test]
fn a_set_that_brings_back_an_ended_key_is_not_taken_again() {
    let mut this = robot(0, &[7]);
    let first = set(1, &[8, 7], 7);
    shown(&mut this, &[(1, first.clone()), (2, set(2, &[8], 8))]);
    assert_eq!(shown(&mut this, &[(1, first.clone())]), [], "it is older than what the robot has");
    assert_eq!(shown(&mut this, &[(3, first)]), [(3, Rejection::NotSigned)]);
    assert_eq!(
        shown(&mut this, &[(4, set(1, &[7], 8))]),
        [(4, Rejection::OtherNumber)],
        "an older one, listed as newer"
    );
    assert_eq!(this, robot(2, &[8]));
}

#[test]
fn what_is_no_set_of_keys_is_passed_over_whoever_signed_it() {
    let mut this = robot(0, &[7]);
    let directive = br#"{"payloadType":"application/vnd.midshift.directive.v1+json","payload":"e30=","signatures":[]}"#;
    let sets = [(1, b"{}".to_vec()), (2, directive.to_vec()), (3, vec![b' '; ENVELOPE_BYTES_MAX + 1])];
    let passed = [(1, Rejection::Malformed), (2, Rejection::OtherType), (3, Rejection::TooLong)];
    assert_eq!(shown(&mut this, &sets), passed);
    assert_eq!(this, robot(0, &[7]));
}

#[test]
fn a_set_names_one_to_eight_keys_each_once_and_is_numbered_from_1() {
    let fields = |number, seeds: &[u8]| -> Vec<String> {
        let keys = seeds.iter().map(|seed| key(*seed).public()).collect();
        let refusal = KeySet { number, keys }.sign(&key(7)).expect_err("refused");
        refusal.violations.into_iter().map(|v| v.field).collect()
    };
    assert_eq!(fields(0, &[]), ["number", "keys"]);
    let many: Vec<u8> = (1..=KEYS_MAX as u8 + 1).collect();
    assert_eq!(fields(1, &many), ["keys"]);
    assert_eq!(fields(1, &[7, 8, 7]), ["keys[2]"]);
}

#[test]
fn only_a_plain_number_names_a_set() {
    assert_eq!(KeySet::number_of("12.directive-keys"), Some(12));
    for name in ["0.directive-keys", "01.directive-keys", "+1.directive-keys", "directive-keys", "x.directive-keys"] {
        assert_eq!(KeySet::number_of(name), None, "{name}");
    }
}

#[test]
fn people_list_the_next_set_only_and_one_that_a_key_before_it_or_of_its_own_signed() {
    let place = tempfile::tempdir().expect("a folder");
    let folder =
        Folder::create(&place.path().join("r"), &place.path().join("keys"), Profile::Solo, START).expect("made");
    let by = SecretKey::read(&place.path().join("keys/targets-1.pem")).expect("a key");
    let add = |envelope: Vec<u8>| folder.add_keys(&envelope, &[&by], START).map(|(_, signed)| signed);
    assert!(matches!(add(set(2, &[8], 7)), Err(Error::Refused(_))), "the first is 1");
    assert!(matches!(add(b"{}".to_vec()), Err(Error::Refused(_))), "no set");
    assert_eq!(add(set(1, &[8, 7], 7)).expect("listed"), Signed::Published(1));
    assert!(matches!(add(set(1, &[8, 7], 7)), Err(Error::Refused(_))), "it is there");
    assert!(matches!(add(set(2, &[9], 66)), Err(Error::Refused(_))), "a stranger's");
    assert_eq!(add(set(2, &[8], 8)).expect("listed"), Signed::Published(2));
    assert_eq!(add(set(3, &[9], 9)).expect("all keys were lost"), Signed::Published(3));
    let checked = folder.check().expect("whole");
    assert_eq!(checked.key_set.expect("listed").number, 3);
    let document = folder.document("3.targets.json").expect("readable").expect("there");
    let names: Vec<_> = listed(&document).expect("targets").into_iter().map(|f| f.name).collect();
    assert_eq!(names, ["1.directive-keys", "2.directive-keys", "3.directive-keys"], "who was away needs each");
}
