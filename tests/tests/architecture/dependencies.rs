//! Each crate of others is needed by one of ours, stands in docs/numbers.md with who needs it, and the roots of the public web are nobody's.
//!
//! Invariant: what is needed is read from paths in the sources: a name that stands there alone, in a comment or a text, needs nothing.

use crate::{code, dependencies, files, manifests, package, read, root, short, table};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The library of a crate, where it has another name than the crate.
const LIBRARIES: &[(&str, &str)] = &[("rustls-webpki", "webpki")];

/// Whether a source names something of this library.
fn names(source: &str, library: &str) -> bool {
    source.match_indices(library).any(|(at, _)| {
        let before = source[..at].chars().next_back();
        let after = &source[at + library.len()..];
        let is_whole = !before.is_some_and(|c| c.is_alphanumeric() || c == '_');
        is_whole && ["::", ";", "!", " as "].iter().any(|next| after.starts_with(next))
    })
}

/// Sources of other packages that this one takes in by their path.
fn taken_in(path: &str, source: &str) -> String {
    let paths = source.split("#[path = \"").skip(1).filter_map(|rest| rest.split('"').next());
    let beside = Path::new(path).parent().unwrap_or(Path::new(""));
    paths.filter(|path| path.starts_with("../")).map(|path| read(beside.join(path))).collect::<Vec<_>>().join("\n")
}

/// Sources below a folder of a package; those of tests with what they take in from elsewhere.
fn sources(folder: &str, of_tests: bool) -> String {
    let in_tests =
        |path: &String| path.ends_with("/tests.rs") || path.contains("/tests/") || path.contains("/examples/");
    let read = |path: String| {
        let source = read(&path);
        if of_tests { taken_in(&path, &source) + &source } else { code(&source) }
    };
    files(folder, "rs").into_iter().filter(|path| of_tests || !in_tests(path)).map(read).collect::<Vec<_>>().join("\n")
}

/// Crates of this section of a manifest that none of the sources name.
fn needless(manifest: &toml::Table, section: &str, sources: &str) -> Vec<String> {
    let of_section = manifest.get(section).and_then(toml::Value::as_table).into_iter().flat_map(toml::Table::keys);
    let name = package(manifest);
    let library = |dependency: &str| {
        let known = LIBRARIES.iter().find(|(known, _)| *known == dependency);
        known.map_or_else(|| dependency.replace('-', "_"), |(_, library)| (*library).to_owned())
    };
    let missing = of_section.filter(|dependency| !names(sources, &library(dependency)));
    missing.map(|dependency| format!("{name} -> {dependency}")).collect()
}

/// Folders of the members, with their manifests.
fn members() -> Vec<(String, toml::Table)> {
    let workspace: toml::Table = read("Cargo.toml").parse().expect("a manifest");
    let members = workspace["workspace"]["members"].as_array().expect("members").iter();
    members.map(|m| m.as_str().expect("a path").to_owned()).zip(manifests()).collect()
}

#[test]
fn every_dependency_is_named_by_the_sources_of_its_section() {
    for (folder, manifest) in members() {
        let everything = sources(&folder, true);
        // The library of tests is for their programs, which name the rest.
        let of_use = if folder == "tests" { everything.clone() } else { sources(&format!("{folder}/src"), false) };
        assert_eq!(
            needless(&manifest, "dependencies", &of_use),
            Vec::<String>::new(),
            "strike it, or put it among those of tests"
        );
        assert_eq!(needless(&manifest, "dev-dependencies", &everything), Vec::<String>::new(), "strike it");
        if root().join(&folder).join("build.rs").is_file() {
            let build = read(format!("{folder}/build.rs"));
            assert_eq!(needless(&manifest, "build-dependencies", &build), Vec::<String>::new(), "strike it");
        }
    }
}

#[test]
fn a_dependency_that_nothing_names_is_found() {
    let manifest = "[package]\nname='midshift-x'\n[dependencies]\nserde.workspace=true\nhyper-util.workspace=true\ntoml.workspace=true";
    let manifest: toml::Table = manifest.parse().expect("a manifest");
    let found = |source: &str| needless(&manifest, "dependencies", source);
    assert_eq!(found("use serde::Serialize;\nuse hyper_util as h;\nfn f() { toml::from_str() }"), Vec::<String>::new());
    assert_eq!(
        found("use my_serde::Serialize; // toml\nuse hyper_utils::x; toml::x()"),
        ["midshift-x -> hyper-util", "midshift-x -> serde"]
    );
}

#[test]
fn each_crate_of_others_stands_on_the_page_with_who_needs_it() {
    let mut needed: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for manifest in manifests() {
        let ours = package(&manifest);
        for dependency in dependencies(&manifest).into_iter().filter(|name| short(name).is_none()) {
            needed.entry(dependency).or_default().insert(short(&ours).expect("a crate of ours").to_owned());
        }
    }
    let page = table(&read("docs/numbers.md"), "direct dependency");
    let written: Vec<(String, String)> = page.iter().map(|row| (row[0].clone(), row[1].clone())).collect();
    let names = |ours: BTreeSet<String>| ours.into_iter().collect::<Vec<_>>().join(", ");
    let needed: Vec<(String, String)> = needed.into_iter().map(|(name, ours)| (name, names(ours))).collect();
    assert_eq!(written, needed, "docs/numbers.md, and the manifests");
    assert!(page.iter().all(|row| !row[2].is_empty()), "each says what for");

    let workspace: toml::Table = read("Cargo.toml").parse().expect("a manifest");
    let declared = workspace["workspace"]["dependencies"].as_table().expect("dependencies").keys();
    let unused: Vec<_> =
        declared.filter(|name| short(name).is_none() && !needed.iter().any(|(n, _)| n == *name)).collect();
    assert!(unused.is_empty(), "nobody needs {unused:?} of the workspace");
}

#[test]
fn the_roots_of_the_public_web_are_the_stand_in_and_nothing_else() {
    let lock: toml::Table = read("Cargo.lock").parse().expect("a lock file");
    let packages = lock["package"].as_array().expect("packages").iter();
    let roots: Vec<_> = packages.filter(|package| package["name"].as_str() == Some("webpki-roots")).collect();
    let [roots] = roots.as_slice() else { panic!("{} crates of this name", roots.len()) };
    // What comes from a registry or a repository says so.
    assert!(roots.get("source").is_none(), "it is not the stand-in: {roots:?}");
    let stand_in: toml::Table = read("services/store/no_web_roots/Cargo.toml").parse().expect("a manifest");
    assert_eq!(roots["version"], stand_in["package"]["version"]);
    let workspace: toml::Table = read("Cargo.toml").parse().expect("a manifest");
    let patch = workspace["patch"]["crates-io"]["webpki-roots"]["path"].as_str();
    assert_eq!(patch, Some("services/store/no_web_roots"));
    for other in ["rustls-native-certs", "webpki-root-certs", "rustls-platform-verifier"] {
        assert!(!read("Cargo.lock").contains(&format!("name = \"{other}\"")), "{other} brings roots of the public web");
    }
}

#[test]
fn no_package_of_a_program_has_a_profile_of_its_own() {
    // Cargo passes `strip = "debuginfo"` instead of the profile's to a package that an override names.
    let workspace: toml::Table = read("Cargo.toml").parse().expect("a manifest");
    let overrides = workspace["profile"]["release"]["package"].as_table().expect("overrides");
    assert!(workspace["profile"]["dist"].get("package").is_none(), "what is released is compiled as a release is");
    let has_program = |(folder, manifest): &(String, toml::Table)| {
        manifest.contains_key("bin")
            || [root().join(folder).join("src/main.rs"), root().join(folder).join("src/bin")].iter().any(|p| p.exists())
    };
    let programs: Vec<String> = members().iter().filter(|m| has_program(m)).map(|(_, m)| package(m)).collect();
    assert!(["midshift", "midshift-stop", "midshift-agent"].iter().all(|p| programs.iter().any(|found| found == p)));
    assert!(overrides.keys().any(|name| name.starts_with("midshift-")), "the question can be answered with yes");
    let stripped_less: Vec<_> = programs.iter().filter(|name| overrides.contains_key(*name)).collect();
    assert!(stripped_less.is_empty(), "its symbols would stay in the program: {stripped_less:?}");
}
