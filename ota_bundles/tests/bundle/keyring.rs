//! Key files.

use crate::shelf::key;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ed25519_dalek::SigningKey;
use ed25519_dalek::pkcs8::EncodePrivateKey;
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use midshift_bundle::keys::{Error, PublicKey, SecretKey};
use std::os::unix::fs::PermissionsExt;

#[test]
fn a_key_comes_back_from_its_file_which_only_its_owner_reads() {
    let folder = tempfile::tempdir().expect("a folder");
    let (secret, public) = (folder.path().join("k.pem"), folder.path().join("k.pub.pem"));
    let drawn = SecretKey::draw();
    drawn.write(&secret).expect("written");
    drawn.public().write(&public).expect("written");
    assert_eq!(std::fs::metadata(&secret).expect("there").permissions().mode() & 0o777, 0o600);
    assert_eq!(SecretKey::read(&secret).expect("read").public(), drawn.public());
    assert_eq!(PublicKey::read(&public).expect("read"), drawn.public());
    assert!(std::fs::read_to_string(&secret).expect("text").starts_with("-----BEGIN PRIVATE KEY-----"));
    assert!(matches!(drawn.write(&secret), Err(Error::Io { .. })), "a key is never written over");
    assert!(matches!(SecretKey::read(&public), Err(Error::NoKey { .. })));
}

/// What versions before 0.2.0 wrote: with the public key beside the secret one.
fn with_public(seed: [u8; 32]) -> String {
    let pem = SigningKey::from_bytes(&seed).to_pkcs8_pem(LineEnding::LF).expect("PEM");
    String::clone(&pem)
}

#[test]
fn a_key_file_has_the_secret_alone_as_version_1_has_it_and_one_with_the_public_key_is_read_too() {
    let (key, older) = (SecretKey::of_seed([7; 32]), with_public([7; 32]));
    let text = key.to_pem();
    let body = |text: &str| text.lines().filter(|line| !line.starts_with('-')).collect::<String>();
    // SEQUENCE of 46 bytes, version 0, ed25519, and 34 bytes of which 32 are the secret.
    let mut der = b"\x30\x2e\x02\x01\x00\x30\x05\x06\x03\x2b\x65\x70\x04\x22\x04\x20".to_vec();
    der.extend([7; 32]);
    assert_eq!(STANDARD.decode(body(&text)).expect("base64"), der);
    assert!(body(&older).len() > body(&text).len());
    for text in [&text, &older] {
        assert_eq!(SecretKey::from_pem(text).expect("read").public(), key.public());
    }
}

#[test]
fn the_id_is_that_of_tufs_canonical_form() {
    let key = key(1).public();
    let known: tough::schema::key::Key = serde_json::from_value(key.tuf()).expect("a key of TUF");
    let id = known.key_id().expect("an id");
    assert_eq!(key.id().0.bytes().as_slice(), &id[..]);
}

#[test]
fn a_secret_key_is_not_shown() {
    let shown = format!("{:?}", key(1));
    assert_eq!(shown, format!("SecretKey({})", key(1).public().id()));
}
