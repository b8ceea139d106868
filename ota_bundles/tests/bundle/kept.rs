//! The documents of a release as a robot keeps them.

use crate::sets::gait;
use crate::shelf::{Seeds, Shelf, key, target};
use midshift_bundle::manifest::{FORMAT, Manifest};
use midshift_bundle::release::{Error, Release};
use midshift_bundle::repository::{FileTarget, PEOPLE_LIFE_MS, sign_targets};

fn walk() -> Manifest {
    Manifest {
        format: FORMAT,
        name: "walk".to_owned(),
        version: "2.0.0".to_owned(),
        description: String::new(),
        hard_stop_codes: Default::default(),
        raises_floor: false,
        components: vec![gait("2.0.0")],
    }
}

fn files(manifest: &Manifest) -> Vec<FileTarget> {
    let component = &manifest.components[0];
    let content = FileTarget { name: component.target(), digest: component.digest, length: component.length };
    vec![target(&manifest.target(), &manifest.to_bytes()), content]
}

#[tokio::test]
async fn what_was_believed_holds_when_it_has_expired_and_others_sign() {
    let mut shelf = Shelf::new();
    shelf.release(&files(&walk()));
    let robot = shelf.shown_to(&shelf.robot()).await.expect("is believed");
    let (root, targets) = robot.trusted.documents().expect("it was asked");
    let release = Release::verified(root, targets, &walk().to_bytes()).expect("a release");
    let read: Release = serde_json::from_str(&serde_json::to_string(&release).expect("writes")).expect("reads");
    shelf.rotate(Seeds { root: 5, targets: 6, snapshot: 7, timestamp: 8 });
    assert_eq!(read.check().expect("holds"), walk());
    assert_eq!(read, release);
}

#[test]
fn what_is_not_listed_or_not_signed_or_was_changed_does_not_hold() {
    let mut shelf = Shelf::new();
    let (manifest, bytes) = (walk(), walk().to_bytes());
    let root = String::from_utf8(shelf.first_root.clone()).expect("text");
    let made = |targets: &[u8], bytes: &[u8]| Release::verified(&root, &String::from_utf8_lossy(targets), bytes);
    shelf.release(&files(&manifest)[..1]);
    assert!(matches!(made(&shelf.targets, &bytes), Err(Error::Unlisted(name)) if name == "gait-2.0.0.component"));
    shelf.release(&files(&manifest)[1..]);
    let release = made(&shelf.targets, &bytes).expect("both are listed");
    let other = Manifest { raises_floor: true, ..walk() };
    assert!(matches!(made(&shelf.targets, &other.to_bytes()), Err(Error::Unlisted(_))));
    let expires = shelf.now.plus_ms(PEOPLE_LIFE_MS);
    let thief = sign_targets(None, &files(&other), &[], expires, &[&key(9)]).expect("signed by the thief");
    assert!(matches!(made(&thief, &other.to_bytes()), Err(Error::Documents(_))));
    let mut changed = serde_json::to_value(&release).expect("writes");
    let text = changed["manifest"].as_str().expect("text").replace("\"raises_floor\": false", "\"raises_floor\": true");
    changed["manifest"] = text.into();
    let changed: Release = serde_json::from_value(changed).expect("reads");
    assert_ne!(changed, release);
    assert!(changed.check().is_err());
}
