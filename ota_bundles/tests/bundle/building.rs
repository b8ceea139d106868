//! From a draft to a bundle.

use midshift_bundle::build::{Error, build, inspect};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{Manifest, Needs};
use std::fs;
use std::path::{Path, PathBuf};

const DRAFT: &str = r#"
name = "walk"
version = "1.5.0"
description = "A longer stride."
hard_stop_codes = [2001, 1999]

[[component]]
name = "gait"
version = "1.5.0"
kind = "process"
file = "bin/gait"
hardware = ["h1", "h2"]
needs = "restart"

[[component]]
name = "policy"
version = "3.0.1"
kind = "weights"
file = "policy.bin"
hardware = ["h2"]
requires = { gait = "1.4.0" }
rollback_index = 7
needs = "park"
"#;

fn draft(folder: &Path, text: &str) -> PathBuf {
    fs::create_dir_all(folder.join("bin")).expect("a folder");
    fs::write(folder.join("bundle.toml"), text).expect("written");
    fs::write(folder.join("bin/gait"), b"walks").expect("written");
    fs::write(folder.join("policy.bin"), vec![9; 300_000]).expect("written");
    folder.join("out")
}

fn violations(error: Error) -> Vec<String> {
    match error {
        Error::Refused(refusal) => refusal.violations.into_iter().map(|v| v.field).collect(),
        Error::Io { .. } => panic!("{error}"),
    }
}

#[test]
fn a_bundle_is_built_whole_and_holds_what_its_manifest_says() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = draft(folder.path(), DRAFT);
    let mut bytes = 0;
    let built = build(folder.path(), &out, &mut |n| bytes += n).expect("built");
    assert_eq!(bytes, 300_005);
    assert_eq!((built.length(), built.needs()), (300_005, Needs::Park));
    assert_eq!(built.hardware().into_iter().collect::<Vec<_>>(), ["h2"], "models that run all of it");
    assert_eq!(built.components[0].digest, Digest::of_content(b"walks"));
    assert_eq!(built.hard_stop_codes.iter().copied().collect::<Vec<_>>(), [1999, 2001]);
    let mut names: Vec<_> = fs::read_dir(&out)
        .expect("there")
        .map(|e| e.expect("an entry").file_name().into_string().expect("text"))
        .collect();
    names.sort();
    assert_eq!(names, ["gait-1.5.0.component", "policy-3.0.1.component", "walk-1.5.0.manifest"]);
    assert_eq!(inspect(&out).expect("as built"), built);
    assert_eq!(Manifest::from_bytes(&built.to_bytes()).expect("read"), built);
    let again = build(folder.path(), &out, &mut |_| {});
    assert!(matches!(again, Err(Error::Io { .. })), "nothing is built over another");
}

#[test]
fn every_broken_rule_of_a_draft_is_told_at_once_and_nothing_is_left_behind() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = DRAFT
        .replace("name = \"walk\"", "name = \"Walk it\"")
        .replace("version = \"3.0.1\"", "version = \"three\"")
        .replace("hardware = [\"h2\"]", "hardware = [\"h9\"]")
        .replace("name = \"policy\"", "name = \"gait\"");
    let out = draft(folder.path(), &text);
    let told = violations(build(folder.path(), &out, &mut |_| {}).expect_err("refused"));
    assert_eq!(told, ["name", "component[1].version", "component[1].name", "component"]);
    let left: Vec<_> = fs::read_dir(folder.path()).expect("there").collect();
    assert_eq!(left.len(), 3, "{left:?}");
}

#[test]
fn a_component_outside_the_folder_is_refused() {
    for file in ["../secret", "/etc/passwd", "", "a/../../b"] {
        let folder = tempfile::tempdir().expect("a folder");
        let out = draft(folder.path(), &DRAFT.replace("policy.bin", file));
        let told = violations(build(folder.path(), &out, &mut |_| {}).expect_err("refused"));
        assert_eq!(told, ["component[1].file"], "{file}");
    }
}

#[test]
fn a_missing_file_leaves_no_half_bundle() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = draft(folder.path(), DRAFT);
    fs::remove_file(folder.path().join("policy.bin")).expect("gone");
    assert!(matches!(build(folder.path(), &out, &mut |_| {}), Err(Error::Io { doing: "reading", .. })));
    assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 2, "only bundle.toml and bin are left");
}

#[test]
fn bytes_that_are_not_what_the_manifest_says_are_found() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = draft(folder.path(), DRAFT);
    build(folder.path(), &out, &mut |_| {}).expect("built");
    fs::write(out.join("gait-1.5.0.component"), b"flies").expect("written");
    fs::write(out.join("policy-3.0.1.component"), vec![9; 300_001]).expect("written");
    let told = violations(inspect(&out).expect_err("both"));
    assert_eq!(told, ["component[0]", "component[1]"]);
}

#[test]
fn a_manifest_with_a_field_that_nobody_knows_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = draft(folder.path(), DRAFT);
    let built = build(folder.path(), &out, &mut |_| {}).expect("built");
    let text = String::from_utf8(built.to_bytes()).expect("text");
    for (from, to) in [
        ("\"format\": 1", "\"format\": 1, \"surprise\": true"),
        ("\"kind\": \"weights\"", "\"kind\": \"weights\", \"surprise\": true"),
        ("\"format\": 1", "\"format\": 2"),
    ] {
        let changed = text.replace(from, to);
        assert_ne!(changed, text);
        assert!(Manifest::from_bytes(changed.as_bytes()).is_err(), "{to}");
    }
}
