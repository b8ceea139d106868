//! The next root, from its draft to enough signatures, each made where its signer is.

use crate::shelf::{START, key};
use midshift_bundle::folder::{Error, Folder, Signed};
use midshift_bundle::keys::{PublicKey, SecretKey};
use midshift_bundle::repository::{Profile, RootDraft, sign_root};
use midshift_bundle::roots::{Change, Role, message};
use std::path::{Path, PathBuf};

/// A project of three people of whom two must sign; each has a copy of what is public.
struct Project {
    place: tempfile::TempDir,
}

impl Project {
    fn new() -> Self {
        let this = Self { place: tempfile::tempdir().expect("a folder") };
        Folder::create(&this.path("r"), &this.path("keys"), Profile::Release, START).expect("made");
        this
    }
    fn path(&self, name: &str) -> PathBuf {
        self.place.path().join(name)
    }
    fn folder(&self) -> Folder {
        Folder::open(&self.path("r")).expect("there")
    }
    fn copy(&self, name: &str) -> Folder {
        let to = self.path(name).join("metadata");
        std::fs::create_dir_all(&to).expect("a folder");
        std::fs::copy(self.path("r/metadata/1.root.json"), to.join("1.root.json")).expect("copied");
        Folder::open(&self.path(name)).expect("there")
    }
    fn key(&self, name: &str) -> SecretKey {
        SecretKey::read(&self.path("keys").join(name)).expect("a key")
    }
    /// The change that gives root another key instead of the first.
    fn exchange(&self) -> Change {
        let drop = vec![self.key("root-1.pem").public().id()];
        Change { role: Role::Root, drop, add: vec![key(9).public()], threshold: None }
    }
}

fn waits(folder: &Folder) -> Vec<u8> {
    folder.waiting_root().expect("readable").expect("waits").document
}

fn lacks(folder: &Folder) -> (u64, u64) {
    let waiting = folder.waiting_root().expect("readable").expect("waits");
    (waiting.lacks_of_before, waiting.lacks_of_own)
}

fn refusal(result: Result<Signed, Error>) -> String {
    let Err(Error::Refused(refusal)) = result else { panic!("{result:?}") };
    refusal.violations.into_iter().map(|v| v.description).collect()
}

#[test]
fn two_people_at_their_own_copies_make_a_root_and_it_needs_enough_of_both() {
    let project = Project::new();
    let (ann, ben) = (project.folder(), project.copy("ben"));
    assert_eq!(ann.draft_root(Some(&project.exchange()), START).expect("a draft"), 0);
    assert_eq!(ann.root().expect("there").0, 1, "nobody believes it yet");
    let asked = waits(&ann);
    assert_eq!(ben.sign_root(&[&project.key("root-2.pem")], &[asked]).expect("once"), Signed::Pending);
    assert_eq!(lacks(&ben), (1, 1));
    assert_eq!(ann.sign_root(&[&project.key("root-1.pem")], &[]).expect("the old one"), Signed::Pending);
    assert_eq!(lacks(&ann), (1, 2));
    assert_eq!(ann.sign_root(&[], &[waits(&ben)]).expect("handed over"), Signed::Pending);
    assert_eq!(lacks(&ann), (0, 1), "the old key counts before, not after");
    assert_eq!(ann.sign_root(&[&key(9)], &[]).expect("the new one"), Signed::Published(2));
    assert_eq!(ann.check().expect("whole").root_version, 2);
    assert!(ann.waiting_root().expect("readable").is_none());
}

#[test]
fn a_bare_signature_of_another_tool_counts_for_whichever_key_made_it() {
    let project = Project::new();
    let ann = project.folder();
    ann.draft_root(None, START).expect("only the year is new");
    let bytes = message(&waits(&ann)).expect("a root");
    let bare = |name: &str| project.key(name).sign(&bytes).to_vec();
    assert_eq!(ann.sign_root(&[], &[bare("root-3.pem"), bare("root-1.pem")]).expect("two"), Signed::Published(2));
}

#[test]
fn a_signature_that_is_not_asked_for_or_does_not_hold_is_refused_at_once_and_nothing_is_added() {
    let project = Project::new();
    let (ann, ben) = (project.folder(), project.copy("ben"));
    ann.draft_root(Some(&project.exchange()), START).expect("a draft");
    ben.draft_root(None, START).expect("another draft");
    ben.sign_root(&[&project.key("root-2.pem")], &[]).expect("signed");
    let before = waits(&ann);
    let draft = RootDraft::from_root(&before).expect("a root");
    let foreign = project.key("targets-1.pem");
    let by_foreign = sign_root(&draft, &[&project.key("root-2.pem"), &foreign]).expect("signed");
    let torn = sign_root(&draft, &[&project.key("root-2.pem")]).expect("signed");
    let torn = String::from_utf8(torn).expect("text").replace("\"sig\": \"", "\"sig\": \"00").into_bytes();
    let bare = foreign.sign(&message(&before).expect("a root")).to_vec();
    let tries = [
        (ann.sign_root(&[&foreign], &[]), "is not asked for"),
        (ann.sign_root(&[], &[by_foreign]), "is not asked for"),
        (ann.sign_root(&[], &[torn]), "does not hold"),
        (ann.sign_root(&[], &[bare]), "no key that is asked for"),
        (ann.sign_root(&[], &[waits(&ben)]), "another root document"),
        (ann.sign_root(&[], &[b"{}".to_vec()]), "reading root"),
    ];
    for (result, why) in tries {
        let said = refusal(result);
        assert!(said.contains(why), "{said}");
        assert_eq!(waits(&ann), before, "{why}");
    }
}

#[test]
fn a_changed_draft_takes_its_signatures_along_and_keeps_what_it_changed_before() {
    let project = Project::new();
    let ann = project.folder();
    ann.draft_root(Some(&project.exchange()), START).expect("a draft");
    ann.sign_root(&[&project.key("root-2.pem")], &[]).expect("signed");
    let more = Change { role: Role::Targets, drop: Vec::new(), add: vec![key(8).public()], threshold: Some(3) };
    assert_eq!(ann.draft_root(Some(&more), START).expect("changed"), 1);
    let draft = ann.waiting_root().expect("readable").expect("waits").draft;
    assert_eq!((draft.version, draft.targets.threshold, draft.targets.keys.len()), (2, 3, 4));
    assert!(draft.root.keys.contains(&key(9).public()));
    assert_eq!(lacks(&ann), (2, 2));
}

#[test]
fn a_change_that_nobody_could_sign_or_that_changes_nothing_is_no_draft() {
    let project = Project::new();
    let ann = project.folder();
    let own = project.key("root-1.pem").public();
    let change = |drop: &[&PublicKey], add: &[&PublicKey], threshold| {
        let drop = drop.iter().map(|key| key.id()).collect();
        let add = add.iter().copied().cloned().collect();
        ann.draft_root(Some(&Change { role: Role::Root, drop, add, threshold }), START)
    };
    assert!(change(&[], &[], None).is_err(), "nothing");
    assert!(change(&[&key(9).public()], &[], None).is_err(), "it has no such key");
    assert!(change(&[], &[&own], None).is_err(), "it has that key");
    assert!(change(&[], &[], Some(4)).is_err(), "more than there are");
    assert!(change(&[], &[], Some(0)).is_err(), "nobody");
    assert!(ann.waiting_root().expect("readable").is_none());
}

#[test]
fn after_a_root_with_other_targets_keys_what_is_listed_is_signed_once_more() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name);
    let folder = Folder::create(&path("r"), &path("keys"), Profile::Solo, START).expect("made");
    let read = |path: &Path| SecretKey::read(path).expect("a key");
    let (root, old) = (read(&path("keys/root-1.pem")), read(&path("keys/targets-1.pem")));
    let set = midshift_bundle::key_set::KeySet { number: 1, keys: vec![key(7).public()] }.sign(&key(7)).expect("a set");
    folder.add_keys(&set, &[&old], START).expect("listed");
    let drop = vec![old.public().id()];
    let change = Change { role: Role::Targets, drop, add: vec![key(8).public()], threshold: None };
    folder.draft_root(Some(&change), START).expect("a draft");
    assert_eq!(folder.sign_root(&[&root], &[]).expect("signed"), Signed::Published(2));
    assert!(folder.check().is_err(), "who signed it signs no more");
    refusal(folder.renew(&[&old], START));
    assert_eq!(folder.renew(&[&key(8)], START).expect("signed"), Signed::Published(2));
    let checked = folder.check().expect("whole");
    assert_eq!((checked.targets_version, checked.key_set.map(|set| set.number)), (Some(2), Some(1)));
}
