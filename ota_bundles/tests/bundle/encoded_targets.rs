//! Encoded targets of a release: who signs makes them, from which releases, and only what is worth it.

use crate::shelf::START;
use midshift_bundle::build::build;
use midshift_bundle::digest::Digest;
use midshift_bundle::encoded_target::EncodedTarget;
use midshift_bundle::encoding::{Base, decode};
use midshift_bundle::folder::{Error, Folder};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{FileTarget, Profile, listed};
use std::fs;
use std::io::Cursor;
use std::path::PathBuf;

/// Bytes that do not become shorter by themselves.
fn noise(seed: u64, length: usize) -> Vec<u8> {
    let mut state = seed;
    let step = |_| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    (0..length).map(step).collect()
}

/// A program of this version: half of it is said a hundred times, and a little differs from version to version.
fn program(version: u64) -> Vec<u8> {
    [noise(1, 40_000), noise(2, 400).repeat(100), noise(100 + version, 400)].concat()
}

struct Shop {
    place: tempfile::TempDir,
    folder: Folder,
    key: SecretKey,
}

impl Shop {
    fn new() -> Self {
        let place = tempfile::tempdir().expect("a folder");
        let (repository, keys) = (place.path().join("r"), place.path().join("keys"));
        let folder = Folder::create(&repository, &keys, Profile::Solo, START).expect("made");
        let key = SecretKey::read(&keys.join("targets-1.pem")).expect("a key");
        Self { place, folder, key }
    }
    fn built(&self, version: u64, content: &[u8]) -> PathBuf {
        let draft = self.place.path().join(format!("draft-{version}"));
        fs::create_dir_all(&draft).expect("a folder");
        let text = format!(
            "name = \"walk\"\nversion = \"1.{version}.0\"\n[[component]]\nname = \"gait\"\nversion = \"1.{version}.0\"\nkind = \"process\"\nfile = \"gait\"\nhardware = [\"h1\"]\nneeds = \"restart\"\n"
        );
        fs::write(draft.join("bundle.toml"), text).expect("written");
        fs::write(draft.join("gait"), content).expect("written");
        let out = self.place.path().join(format!("walk-1.{version}.0"));
        build(&draft, &out, &mut |_| {}).expect("built");
        out
    }
    fn sign(&self, version: u64, from: &[&str]) -> Result<(), Error> {
        let from: Vec<String> = from.iter().map(|name| (*name).to_owned()).collect();
        let bundle = self.built(version, &program(version));
        self.folder.add_with_encoded_targets(&bundle, &from, &[&self.key], START).map(drop)
    }
    fn listed(&self) -> Vec<FileTarget> {
        let version = self.folder.targets_version().expect("readable").expect("signed");
        let document = self.folder.document(&format!("{version}.targets.json")).expect("readable").expect("there");
        listed(&document).expect("targets")
    }
    /// Versions from which a patch to this one is listed, and whether the whole of it is.
    fn ways(&self, to: u64) -> (Vec<u64>, bool) {
        let to = Digest::of_content(&program(to));
        let files = self.listed();
        let has = |way: EncodedTarget| files.iter().any(|file| file.name == way.target());
        let bases =
            (0..9).filter(|from| has(EncodedTarget { to, from: Some(Digest::of_content(&program(*from))) })).collect();
        (bases, has(EncodedTarget { to, from: None }))
    }
}

#[test]
fn a_release_comes_with_patches_from_the_last_three_and_from_those_that_are_named() {
    let shop = Shop::new();
    for version in 0..5 {
        shop.sign(version, &[]).expect("signed");
    }
    assert_eq!(shop.ways(0), (vec![], true), "nothing was before it");
    assert_eq!(shop.ways(4), (vec![1, 2, 3], true));
    shop.sign(5, &["walk-1.0.0"]).expect("signed");
    assert_eq!(shop.ways(5), (vec![0, 2, 3, 4], true));
    let refused = shop.sign(6, &["walk-9.9.9"]);
    assert!(matches!(refused, Err(Error::Refused(_))), "{refused:?}");
    shop.folder.check().expect("every file is there");
}

#[test]
fn a_patch_leads_to_the_file_and_is_shorter_than_the_whole() {
    let shop = Shop::new();
    shop.sign(0, &[]).expect("signed");
    shop.sign(1, &[]).expect("signed");
    let [old, new] = [0, 1].map(program);
    let (files, to) = (shop.listed(), Digest::of_content(&new));
    let listed = |from| files.iter().find(|file| file.name == EncodedTarget { to, from }.target()).expect("listed");
    let (patch, whole) = (listed(Some(Digest::of_content(&old))), listed(None));
    assert!(patch.length < whole.length && whole.length < new.len() as u64);
    let bytes = fs::read(shop.folder.file(&patch.name, patch.digest)).expect("there");
    let (mut out, mut base) = (Vec::new(), Cursor::new(&old));
    decode(Some(&mut base as &mut dyn Base), &mut &*bytes, new.len() as u64, &mut out).expect("a patch");
    assert_eq!(Digest::of_content(&out), to);
}

#[test]
fn what_does_not_become_shorter_has_no_ways() {
    let shop = Shop::new();
    let add = |version, content: &[u8]| {
        let bundle = shop.built(version, content);
        shop.folder.add_with_encoded_targets(&bundle, &[], &[&shop.key], START).expect("signed");
    };
    add(0, &noise(7, 50_000));
    add(1, &noise(8, 50_000));
    add(2, b"so short that asking costs as much");
    let ways: Vec<_> =
        shop.listed().into_iter().filter(|file| EncodedTarget::of_target(&file.name).is_some()).collect();
    assert!(ways.is_empty(), "{ways:?}");
    let left = fs::read_dir(shop.place.path().join("r/targets")).expect("there").count();
    assert_eq!(left, 6, "nothing lies around");
}

#[test]
fn ways_go_with_the_file_that_they_lead_to() {
    let shop = Shop::new();
    for version in 0..3 {
        shop.sign(version, &[]).expect("signed");
    }
    shop.folder.withdraw("walk-1.1.0", &[&shop.key], START).expect("signed");
    assert_eq!(shop.ways(1), (vec![], false));
    assert_eq!(shop.ways(2), (vec![0, 1], true), "robots that have the withdrawn one still come from it");
    shop.folder.check().expect("whole");
}

#[test]
fn only_two_digests_name_a_way() {
    let [to, from] = [b"to".as_slice(), b"from"].map(Digest::of_content);
    for way in [EncodedTarget { to, from: Some(from) }, EncodedTarget { to, from: None }] {
        assert_eq!(EncodedTarget::of_target(&way.target()), Some(way));
    }
    let (half, strange) = (format!("{to}.patch"), format!("{to}.x.patch"));
    for name in ["gait-1.0.0.component", "x.zst", "x.y.patch", ".zst", half.as_str(), strange.as_str()] {
        assert_eq!(EncodedTarget::of_target(name), None, "{name}");
    }
}
