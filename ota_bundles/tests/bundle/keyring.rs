//! Key files.

use crate::shelf::key;
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
