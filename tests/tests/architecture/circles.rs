//! Files of a crate use each other one way: there is no circle of files, and the rooms of core's `fleet` stand one above
//! the other.
//!
//! Arrows are read from `use` and from paths in code. A method called on a value is no arrow here.

use crate::source::{Arrows, Sources, crates};
use std::collections::BTreeSet;

/// Rooms of fleet, from the lowest to the highest: each uses only those before it.
const ROOMS: [&str; 8] =
    ["projection", "decision", "tasks", "traffic", "facts", "assignment", "maintenance", "explanation"];

/// Files that still stand in a circle, by the folder that they are below. It only shrinks: lower it as they leave.
const KNOWN: &[(&str, usize)] = &[
    ("cli/src", 19),
    ("core/src/rollout", 12),
    ("robot_agent/src", 17),
    ("robot_sim/src", 3),
    ("services/midshift/src/commands", 2),
    ("services/ota/src", 16),
    ("services/stop/src", 10),
];

/// Files that lead back to themselves.
fn in_circles(arrows: &Arrows) -> BTreeSet<String> {
    let leads_back = |path: &&String| {
        let (mut open, mut seen) = (vec![*path], BTreeSet::new());
        while let Some(next) = open.pop().and_then(|at| arrows.get(at)) {
            open.extend(next.iter().filter(|at| seen.insert((*at).clone())));
        }
        seen.contains(*path)
    };
    arrows.keys().filter(leads_back).cloned().collect()
}

/// Arrows between folders of a room that lead up.
fn upwards(arrows: &Arrows, room: &str) -> Vec<(String, String)> {
    let height = |path: &str| {
        let folder = path.strip_prefix(room).and_then(|path| path.split_once('/')).map(|(folder, _)| folder);
        folder.map(|folder| ROOMS.iter().position(|known| *known == folder).expect("a folder that has its height here"))
    };
    let all = arrows.iter().flat_map(|(from, to)| to.iter().map(move |to| (from, to)));
    let up = all.filter(|(from, to)| match (height(from), height(to)) {
        (Some(from), Some(to)) => from < to,
        // What lies on top of the rooms is used by none of them, but for the naive rules.
        (Some(_), None) => !to.ends_with("/bugs.rs"),
        (None, _) => false,
    });
    up.map(|(from, to)| (from.clone(), to.clone())).collect()
}

#[test]
fn no_file_comes_into_a_circle() {
    let suites = ["e2e", "simulation", "model"].map(|suite| (suite.to_owned(), format!("tests/tests/{suite}")));
    let mut seen = 0;
    let mut found = BTreeSet::new();
    for (library, folder) in crates().into_iter().chain(suites) {
        let arrows = Sources::of_folder(&library, &folder).arrows(|_| true);
        seen += arrows.values().map(BTreeSet::len).sum::<usize>();
        found.extend(in_circles(&arrows));
    }
    assert!(seen > 2_000, "the arrows are not read: {seen}");
    for (folder, known) in KNOWN {
        let here: Vec<String> = found.extract_if(.., |path| path.starts_with(folder)).collect();
        assert_eq!(here.len(), *known, "below {folder}: mend what came in, or lower the number: {here:#?}");
    }
    assert_eq!(found, BTreeSet::new(), "they came into a circle");
}

/// Arrows between the files of `fleet`.
fn arrows_of_fleet() -> Arrows {
    Sources::of_folder("midshift_core", "core/src")
        .arrows(|module| module.first().is_some_and(|first| first == "fleet"))
}

#[test]
fn the_rooms_of_fleet_use_only_the_rooms_below_them() {
    let arrows = arrows_of_fleet();
    assert!(arrows.values().map(BTreeSet::len).sum::<usize>() > 200, "the arrows are not read");
    assert_eq!(upwards(&arrows, "core/src/fleet/"), []);
}

/// Files of a small crate that stand in a circle.
fn in_circles_of(texts: &[(&str, &str)]) -> BTreeSet<String> {
    let texts = texts.iter().map(|(path, text)| ((*path).to_owned(), (*text).to_owned()));
    in_circles(&Sources::new("small", "src", texts).arrows(|_| true))
}

#[test]
fn a_circle_is_found_however_its_arrows_are_written() {
    let lib = ("src/lib.rs", "pub mod a;");
    let door = ("src/a/mod.rs", "pub mod x;\npub mod y;\npub use y::Y;");
    let uses = [
        "use super::y;",
        "use super::{y::Y, z};",
        "use crate::a::Y as Other;",
        "fn f() { crate::a::y::g(\"\") }",
        "fn f() { small::a::y::g(\"\") }",
        "use super::Y;",
        "use crate::{a::{self}};\nfn f() { a::Y::new() }",
    ];
    for used in uses {
        for (back, is_circle) in [("fn g(c: char) { c == '\"'; super::x::f() }", true), ("// super::x::f()", false)] {
            let found = in_circles_of(&[lib, door, ("src/a/x.rs", used), ("src/a/y.rs", back)]);
            assert_eq!(found.contains("src/a/x.rs"), is_circle, "{used} {back}");
        }
    }
    let in_tests = "\n#[cfg(test)]\nmod tests {\n    use super::super::x;\n}";
    for (back, is_circle) in [
        (in_tests, false),
        ("pub(in crate::a) fn g() {}", false),
        ("use super::x as z;", true),
        ("mod z { use super::x; }", false),
        ("mod z { use super::super::x; }", true),
        ("const T: &str = r#\"{\"}\"#;\nuse super::x;", true),
    ] {
        let found = in_circles_of(&[lib, door, ("src/a/x.rs", "use super::y;"), ("src/a/y.rs", back)]);
        assert_eq!(found.contains("src/a/x.rs"), is_circle, "{back}");
    }
}

#[test]
fn an_arrow_that_leads_up_is_found() {
    let arrow = |from: &str, to: &str| Arrows::from([(format!("r/{from}"), BTreeSet::from([format!("r/{to}")]))]);
    for (from, to, is_up) in [
        ("tasks/a.rs", "facts/b.rs", true),
        ("facts/b.rs", "tasks/a.rs", false),
        ("facts/b.rs", "facts/c.rs", false),
        ("facts/b.rs", "mod.rs", true),
        ("facts/b.rs", "bugs.rs", false),
        ("commands.rs", "explanation/a.rs", false),
    ] {
        assert_eq!(!upwards(&arrow(from, to), "r/").is_empty(), is_up, "{from} {to}");
    }
}
