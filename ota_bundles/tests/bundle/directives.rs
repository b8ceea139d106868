//! Directives that a robot takes, and every other one. Each test is named by the attack.

use crate::shelf::{START, key};
use midshift_bundle::bugs::Bugs;
use midshift_bundle::digest::Digest;
use midshift_bundle::directive::{Directive, ENVELOPE_BYTES_MAX, Expected, LIFE_MS, Rejection};
use midshift_bundle::keys::{KeyId, PublicKey};
use midshift_core::ids::RobotId;
use midshift_core::time::Utc;
use std::collections::BTreeMap;

pub fn robot(id: &str) -> RobotId {
    RobotId::parse(id).expect("a robot")
}

pub fn directive() -> Directive {
    Directive {
        robot_id: robot("rbt-01"),
        key_id: key(7).public().id(),
        generation: 5,
        manifest: Digest::of_content(b"manifest"),
        manifest_length: 8,
        rollback_floor: 2,
        issued_at: START,
        expires: START.plus_ms(LIFE_MS),
        rollout: "walk-1.5.0".to_owned(),
    }
}

fn open(envelope: &[u8], generation: u64, now: Utc) -> Result<Directive, Rejection> {
    open_naively(envelope, generation, now, Bugs::default())
}

pub fn open_naively(envelope: &[u8], generation: u64, now: Utc, bugs: Bugs) -> Result<Directive, Rejection> {
    let keys: BTreeMap<KeyId, PublicKey> = [key(7).public()].into_iter().map(|k| (k.id(), k)).collect();
    let robot_id = robot("rbt-01");
    Directive::verify(envelope, &Expected { robot_id: &robot_id, keys: &keys, generation, now, bugs })
}

#[test]
fn a_good_directive_is_taken_as_it_was_meant() {
    assert_eq!(open(&directive().sign(&key(7)), 4, START), Ok(directive()));
}

#[test]
fn another_robots_directive_is_refused() {
    let other = Directive { robot_id: robot("rbt-02"), ..directive() };
    assert_eq!(open(&other.sign(&key(7)), 4, START), Err(Rejection::OtherRobot));
}

#[test]
fn replayed_and_older_generations_are_refused() {
    let envelope = directive().sign(&key(7));
    assert_eq!(open(&envelope, 5, START), Err(Rejection::Replayed));
    assert_eq!(open(&envelope, 6, START), Err(Rejection::Replayed));
}

#[test]
fn an_expired_directive_is_refused() {
    let envelope = directive().sign(&key(7));
    assert_eq!(open(&envelope, 4, START.plus_ms(LIFE_MS)), Err(Rejection::Expired));
}

#[test]
fn a_strangers_directive_is_refused() {
    assert_eq!(open(&directive().sign(&key(8)), 4, START), Err(Rejection::NotSigned));
}

#[test]
fn a_strangers_signature_under_a_trusted_id_is_refused() {
    let trusted = key(7).public().id().to_string();
    let envelope = String::from_utf8(directive().sign(&key(8))).expect("text");
    let forged = envelope.replace(&key(8).public().id().to_string(), &trusted);
    assert_ne!(forged, envelope);
    assert_eq!(open(forged.as_bytes(), 4, START), Err(Rejection::NotSigned));
}

#[test]
fn a_payload_that_was_changed_by_one_byte_is_refused() {
    let good: serde_json::Value = serde_json::from_slice(&directive().sign(&key(7))).expect("JSON");
    let other: serde_json::Value =
        serde_json::from_slice(&Directive { generation: 6, ..directive() }.sign(&key(8))).expect("JSON");
    let mut forged = good.clone();
    forged["payload"] = other["payload"].clone();
    assert_ne!(forged, good);
    assert_eq!(open(forged.to_string().as_bytes(), 4, START), Err(Rejection::NotSigned));
}

#[test]
fn another_kind_of_signed_text_is_refused() {
    let text = String::from_utf8(directive().sign(&key(7))).expect("text");
    let other = text.replace("vnd.midshift.directive.v1", "vnd.midshift.manifest.v1");
    assert_eq!(open(other.as_bytes(), 4, START), Err(Rejection::OtherType));
}

#[test]
fn noise_is_refused() {
    let good = directive().sign(&key(7));
    for length in 0..good.len() {
        assert_eq!(open(&good[..length], 4, START), Err(Rejection::Malformed), "cut at {length}");
    }
    assert_eq!(open(&vec![b' '; ENVELOPE_BYTES_MAX + 1], 4, START), Err(Rejection::TooLong));
}
