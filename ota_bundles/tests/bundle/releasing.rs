//! The folder of release people, from keys to a repository that robots believe.

use crate::shelf::{Documents, START};
use midshift_bundle::build::build;
use midshift_bundle::digest::Digest;
use midshift_bundle::folder::{Error, Folder, Signed};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{Profile, listed, sign_online};
use midshift_bundle::trust::{Reading, Trusted};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

fn bundle(place: &Path, version: &str, bytes: &[u8]) -> PathBuf {
    let folder = place.join(format!("draft-{version}"));
    fs::create_dir_all(&folder).expect("a folder");
    let text = format!(
        "name = \"walk\"\nversion = \"{version}\"\n[[component]]\nname = \"gait\"\nversion = \"{version}\"\nkind = \"process\"\nfile = \"gait\"\nhardware = [\"h1\"]\nneeds = \"restart\"\n"
    );
    fs::write(folder.join("bundle.toml"), text).expect("written");
    fs::write(folder.join("gait"), bytes).expect("written");
    let out = place.join(format!("walk-{version}-{}", bytes.len()));
    build(&folder, &out, &mut |_| {}).expect("built");
    out
}

fn key(place: &Path, name: &str) -> SecretKey {
    SecretKey::read(&place.join("keys").join(name)).expect("a key")
}

fn folder(place: &Path, profile: Profile) -> Folder {
    Folder::create(&place.join("repository"), &place.join("keys"), profile, START).expect("made")
}

#[tokio::test]
async fn what_one_person_signs_a_robot_believes() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = folder(place.path(), Profile::Solo);
    assert_eq!(folder.check().expect("empty").targets_version, None);
    let signed = folder.add(&bundle(place.path(), "1.0.0", b"one"), &[&key(place.path(), "targets-1.pem")], START);
    assert_eq!(signed.expect("signed").1, Signed::Published(1));
    let signed = folder.add(&bundle(place.path(), "1.1.0", b"two"), &[&key(place.path(), "targets-1.pem")], START);
    assert_eq!(signed.expect("signed").1, Signed::Published(2));
    let checked = Folder::open(&place.path().join("repository")).expect("there").check().expect("whole");
    assert_eq!(checked.bundles.iter().map(|b| b.version.as_str()).collect::<Vec<_>>(), ["1.0.0", "1.1.0"]);

    let read = |name: &str| fs::read(place.path().join("repository/metadata").join(name)).expect(name);
    let targets = read("2.targets.json");
    let online =
        sign_online(&targets, 1, 1, START, &key(place.path(), "snapshot-1.pem"), &key(place.path(), "timestamp-1.pem"));
    let online = online.expect("signed by the service");
    let mut documents = Documents::default();
    documents.0.insert("2.targets.json".into(), targets);
    documents.0.insert("1.snapshot.json".into(), online.snapshot);
    documents.0.insert("timestamp.json".into(), online.timestamp);
    let clock = Reading { utc: START, is_synced: true };
    let robot = Trusted::new(&read("1.root.json")).expect("a root").refresh(Arc::new(documents), clock).await;
    assert_eq!(robot.expect("believed").targets.len(), 4);
}

#[test]
fn a_release_of_two_people_waits_for_the_second() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = folder(place.path(), Profile::Release);
    let first = bundle(place.path(), "1.0.0", b"one");
    let signed = folder.add(&first, &[&key(place.path(), "targets-1.pem")], START).expect("signed once");
    assert_eq!(signed.1, Signed::Pending);
    assert_eq!(folder.check().expect("whole").targets_version, None, "nobody believes it yet");
    let other = folder.add(&bundle(place.path(), "1.1.0", b"two"), &[&key(place.path(), "targets-1.pem")], START);
    assert!(matches!(other, Err(Error::Refused(_))), "one document waits at a time");
    let of_another_role = folder.cosign(&[&key(place.path(), "root-1.pem")], &[]);
    assert!(matches!(of_another_role, Err(Error::Refused(_))), "it is not asked for");
    assert_eq!(folder.cosign(&[&key(place.path(), "targets-3.pem")], &[]).expect("the second"), Signed::Published(1));
    assert_eq!(folder.check().expect("whole").bundles.len(), 1);
    assert!(folder.cosign(&[&key(place.path(), "targets-2.pem")], &[]).is_err(), "none waits any more");
}

#[test]
fn a_waiting_document_that_cannot_be_looked_at_is_not_taken_for_absent() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = folder(place.path(), Profile::Solo);
    let key = key(place.path(), "targets-1.pem");
    folder.add(&bundle(place.path(), "1.0.0", b"one"), &[&key], START).expect("signed");
    let pending = place.path().join("repository/metadata/pending.targets.json");
    std::os::unix::fs::symlink(&pending, &pending).expect("a link to itself");
    assert!(matches!(folder.renew(&[&key], START), Err(Error::Io { .. })));
    assert_eq!(folder.targets_version().expect("reads"), Some(1), "nothing was signed");
}

#[test]
fn a_bundle_that_is_withdrawn_takes_along_only_what_no_other_has() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = folder(place.path(), Profile::Team);
    let key = key(place.path(), "targets-1.pem");
    for (version, bytes) in [("1.0.0", b"one"), ("1.1.0", b"two")] {
        folder.add(&bundle(place.path(), version, bytes), &[&key], START).expect("signed");
    }
    // It has the same gait as the first.
    let text = "name = \"walk\"\nversion = \"1.2.0\"\n[[component]]\nname = \"gait\"\nversion = \"1.0.0\"\nkind = \"process\"\nfile = \"gait\"\nhardware = [\"h1\"]\nneeds = \"restart\"\n";
    let draft = place.path().join("draft-again");
    fs::create_dir_all(&draft).expect("a folder");
    fs::write(draft.join("bundle.toml"), text).expect("written");
    fs::write(draft.join("gait"), b"one").expect("written");
    build(&draft, &place.path().join("again"), &mut |_| {}).expect("built");
    folder.add(&place.path().join("again"), &[&key], START).expect("signed");
    let names = || {
        let checked = folder.check().expect("whole");
        let version = checked.targets_version.expect("signed");
        let document = folder.document(&format!("{version}.targets.json")).expect("readable").expect("there");
        listed(&document).expect("a document").into_iter().map(|file| file.name).collect::<Vec<_>>()
    };
    let (withdrawn, signed) = folder.withdraw("walk-1.0.0", &[&key], START).expect("signed");
    assert_eq!((withdrawn.version.as_str(), signed), ("1.0.0", Signed::Published(4)));
    let left = ["gait-1.0.0.component", "gait-1.1.0.component", "walk-1.1.0.manifest", "walk-1.2.0.manifest"];
    assert_eq!(names(), left, "another bundle has the same gait");
    let digest = Digest::of_content(&folder.check().expect("whole").bundles[0].to_bytes()).to_string();
    folder.withdraw(&digest, &[&key], START).expect("by its digest");
    assert_eq!(names(), ["gait-1.0.0.component", "walk-1.2.0.manifest"]);
    assert!(matches!(folder.withdraw("walk-1.0.0", &[&key], START), Err(Error::Refused(_))), "it is in no release");
    folder.add(&place.path().join("walk-1.1.0-3"), &[&key], START).expect("it may come again");
    assert_eq!(names().len(), 4);
}

#[test]
fn files_that_are_gone_or_changed_are_all_told() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = folder(place.path(), Profile::Team);
    folder.add(&bundle(place.path(), "1.0.0", b"one"), &[&key(place.path(), "targets-2.pem")], START).expect("signed");
    let targets = place.path().join("repository/targets");
    for entry in fs::read_dir(&targets).expect("there") {
        let path = entry.expect("an entry").path();
        if path.to_string_lossy().ends_with(".component") {
            fs::write(path, b"uno").expect("changed");
        } else {
            fs::remove_file(path).expect("gone");
        }
    }
    let Err(Error::Refused(refusal)) = folder.check() else { panic!("it is not whole") };
    let told: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(told, ["gait-1.0.0.component", "walk-1.0.0.manifest"]);
}

#[test]
fn a_version_is_never_released_twice_with_other_bytes() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = folder(place.path(), Profile::Solo);
    let by = key(place.path(), "targets-1.pem");
    folder.add(&bundle(place.path(), "1.0.0", b"one"), &[&by], START).expect("signed");
    let again = folder.add(&bundle(place.path(), "1.0.0", b"other"), &[&by], START);
    assert!(matches!(again, Err(Error::Document(_))));
    assert_eq!(folder.check().expect("whole").targets_version, Some(1));
}

#[test]
fn keys_are_never_written_over() {
    let place = tempfile::tempdir().expect("a folder");
    folder(place.path(), Profile::Solo);
    let again = Folder::create(&place.path().join("other"), &place.path().join("keys"), Profile::Solo, START);
    assert!(matches!(again, Err(Error::Io { .. })));
}
