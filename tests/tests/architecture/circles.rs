//! Files of a crate use each other one way, and so do folders: there is no circle of files or of modules that stand beside
//! each other, and the rooms of core's `fleet` and `rollout` and of the agent stand one above the other.
//!
//! Arrows are read from `use` and from paths in code. A method called on a value is no arrow here.

use crate::source::{Arrows, Sources, crates};
use std::collections::BTreeSet;

/// Rooms, from the lowest to the highest: each uses only those before it.
const FLEET: &[&str] =
    &["projection", "decision", "tasks", "traffic", "facts", "assignment", "maintenance", "explanation"];
const ROLLOUT: &[&str] = &["projection", "decision", "members", "judgement", "robots", "phases", "facts", "commands"];
const AGENT: &[&str] = &[
    "body.rs",
    "bugs.rs",
    "launcher",
    "sets",
    "storage",
    "transport",
    "stop",
    "update",
    "core",
    "session",
    "program",
    "lib.rs",
    "bin",
];

/// Files that lead back to themselves.
fn in_circles(arrows: &Arrows) -> BTreeSet<String> {
    let leads_back = |path: &&String| {
        let (mut open, mut seen) = (vec![*path], BTreeSet::new());
        while let Some(at) = open.pop() {
            open.extend(arrows.get(at).into_iter().flatten().filter(|at| seen.insert((*at).clone())));
        }
        seen.contains(*path)
    };
    arrows.keys().filter(leads_back).cloned().collect()
}

/// Arrows between modules that stand beside each other, each with all that is below it: a file and its folder are one.
fn between_modules(arrows: &Arrows) -> Arrows {
    let names = |path: &str| -> Vec<String> {
        let names = path.trim_end_matches(".rs").split('/');
        names.filter(|name| !matches!(*name, "mod" | "lib" | "main")).map(str::to_owned).collect()
    };
    let mut between = Arrows::new();
    for (from, to) in arrows.iter().flat_map(|(from, to)| to.iter().map(move |to| (names(from), names(to)))) {
        let shared = from.iter().zip(&to).take_while(|(from, to)| from == to).count();
        // What uses the module around it, or is used by it, stands not beside it: a circle that leads through a door is not seen here.
        if let (Some(from), Some(to)) = (from.get(..=shared), to.get(..=shared)) {
            between.entry(from.join("/")).or_default().insert(to.join("/"));
        }
    }
    between
}

/// Arrows that lead up, where `rooms` are folders and files of `below` from the lowest to the highest.
fn upwards(arrows: &Arrows, below: &str, rooms: &[&str]) -> Vec<(String, String)> {
    let height = |path: &str| {
        let first = path.strip_prefix(below).unwrap_or(path).split('/').next().unwrap_or_default();
        let height = rooms.iter().position(|known| *known == first);
        assert!(height.is_some() || first.ends_with(".rs"), "{path}: the folder has no height here");
        height
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
fn no_file_and_no_folder_comes_into_a_circle() {
    let suites = ["e2e", "simulation", "model"].map(|suite| (suite.to_owned(), format!("tests/tests/{suite}")));
    let mut seen = 0;
    let mut found = BTreeSet::new();
    for (library, folder) in crates().into_iter().chain(suites) {
        let arrows = Sources::of_folder(&library, &folder).arrows(|_| true);
        seen += arrows.values().map(BTreeSet::len).sum::<usize>();
        found.extend(in_circles(&arrows));
        found.extend(in_circles(&between_modules(&arrows)));
    }
    assert!(seen > 2_000, "the arrows are not read: {seen}");
    assert_eq!(found, BTreeSet::new(), "they came into a circle");
}

#[test]
fn rooms_use_only_the_rooms_below_them() {
    let core = Sources::of_folder("midshift_core", "core/src");
    let of_core = |room: &str| core.arrows(|module| module.first().is_some_and(|first| first == room));
    let agent = Sources::of_folder("midshift_agent", "robot_agent/src").arrows(|_| true);
    for (arrows, below, rooms) in [
        (of_core("fleet"), "core/src/fleet/", FLEET),
        (of_core("rollout"), "core/src/rollout/", ROLLOUT),
        (agent, "robot_agent/src/", AGENT),
    ] {
        assert!(arrows.values().map(BTreeSet::len).sum::<usize>() > 100, "the arrows of {below} are not read");
        assert_eq!(upwards(&arrows, below, rooms), []);
    }
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
fn a_circle_of_folders_is_found_though_no_file_leads_back_to_itself() {
    let small = |verbs: &str| {
        let texts = [
            ("src/lib.rs", "mod out;\nmod robot;\nmod rollout;"),
            ("src/out.rs", ""),
            ("src/robot.rs", verbs),
            ("src/robot/target.rs", "pub fn find() {}"),
            ("src/rollout/mod.rs", "pub mod target;\nuse super::robot::find as find_robot;\nuse crate::out::*;"),
            ("src/rollout/target.rs", "pub fn find() {}"),
        ];
        let texts = texts.map(|(path, text)| (path.to_owned(), text.to_owned()));
        Sources::new("small", "src", texts).arrows(|_| true)
    };
    let door = "mod target;\npub use target::find;";
    for (verbs, is_circle) in
        [(format!("{door}\nfn f() {{ crate::rollout::target::find() }}"), true), (door.into(), false)]
    {
        let arrows = small(&verbs);
        assert_eq!(in_circles(&arrows), BTreeSet::new(), "who passes a name on does not own it");
        let both = ["src/robot", "src/rollout"].map(str::to_owned);
        let found = in_circles(&between_modules(&arrows));
        assert_eq!(found, if is_circle { both.into() } else { BTreeSet::new() }, "{verbs}");
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
        assert_eq!(!upwards(&arrow(from, to), "r/", FLEET).is_empty(), is_up, "{from} {to}");
    }
}
