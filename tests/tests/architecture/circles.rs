//! Files use each other one way: no circle of files in `fleet`, `rollout` and `task` of core, in the agent and in the simulated robots; the
//! rooms of `fleet` and of the agent stand one above the other.
//!
//! Arrows are read from `use` and from paths in code; a name that a `mod.rs` passes on counts for the file that owns it. Inline tests and
//! folders of tests are left out. A method called on a value is no arrow here.

use crate::{code, files, read};
use std::collections::{BTreeMap, BTreeSet};

/// Rooms of fleet, from the lowest to the highest: each uses only those before it.
const ROOMS: &[&str] =
    &["projection", "decision", "tasks", "traffic", "facts", "assignment", "maintenance", "explanation"];

/// Rooms and files of the agent, from the lowest to the highest.
const AGENT_ROOMS: &[&str] = &[
    "body.rs",
    "bugs.rs",
    "clock.rs",
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
];

/// Files that still stand in a circle. Strike them as they leave it; none is added.
const KNOWN: &[&str] = &[
    "core/src/rollout/assign.rs",
    "core/src/rollout/ending.rs",
    "core/src/rollout/hear.rs",
    "core/src/rollout/infrastructure.rs",
    "core/src/rollout/jams.rs",
    "core/src/rollout/mod.rs",
    "core/src/rollout/moves.rs",
    "core/src/rollout/newcomers.rs",
    "core/src/rollout/phases.rs",
    "core/src/rollout/robots.rs",
    "core/src/rollout/served.rs",
    "core/src/rollout/verdict.rs",
];

/// Names from the root of the crate on.
type Name = Vec<String>;

/// Files by the files that they use.
type Arrows = BTreeMap<String, BTreeSet<String>>;

/// Words of code: names, `::`, and single signs. Strings, characters and comments are left out.
fn tokens(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let (mut at, mut found) = (0, Vec::new());
    while at < chars.len() {
        let next = chars.get(at + 1).copied().unwrap_or(' ');
        match chars[at] {
            '/' if next == '/' => {
                while at < chars.len() && chars[at] != '\n' {
                    at += 1;
                }
            }
            '"' => {
                at += 1;
                while at < chars.len() && chars[at] != '"' {
                    at += if chars[at] == '\\' { 2 } else { 1 };
                }
                at += 1;
            }
            '\'' if next == '\\' || chars.get(at + 2) == Some(&'\'') => {
                at += 2 + usize::from(next == '\\');
                while at < chars.len() && chars[at] != '\'' {
                    at += 1;
                }
                at += 1;
            }
            ':' if next == ':' => {
                found.push("::".to_owned());
                at += 2;
            }
            c if c.is_alphanumeric() || c == '_' => {
                let word: String = chars[at..].iter().take_while(|c| c.is_alphanumeric() || **c == '_').collect();
                at += word.chars().count();
                found.push(word);
            }
            c => {
                if !c.is_whitespace() {
                    found.push(c.to_string());
                }
                at += 1;
            }
        }
    }
    found
}

fn is_word(token: &str) -> bool {
    token == "*" || token.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// Paths of the tree of a `use`, each with the name that it has here.
fn leaves(tree: &[String], prefix: &[String], found: &mut Vec<(Name, String)>) {
    let (mut depth, mut begin) = (0_usize, 0);
    for at in 0..=tree.len() {
        match tree.get(at).map(String::as_str) {
            Some("{") => depth += 1,
            Some("}") => depth -= 1,
            Some(",") | None if depth == 0 => {
                leaf(&tree[begin..at], prefix, found);
                begin = at + 1;
            }
            _ => {}
        }
    }
}

fn leaf(tree: &[String], prefix: &[String], found: &mut Vec<(Name, String)>) {
    let path = tree.iter().take_while(|token| is_word(token) && *token != "as" || *token == "::");
    let mut name: Name = prefix.to_vec();
    name.extend(path.filter(|token| *token != "::").cloned());
    if let Some(open) = tree.iter().position(|token| token == "{") {
        return leaves(&tree[open + 1..tree.len() - 1], &name, found);
    }
    if name.last().is_some_and(|last| last == "self") {
        name.pop();
    }
    let alias = tree.iter().position(|token| token == "as").and_then(|at| tree.get(at + 1)).or(name.last()).cloned();
    if let Some(alias) = alias.filter(|_| !tree.is_empty()) {
        found.push((name, alias));
    }
}

/// What one file names.
#[derive(Default)]
struct Named {
    /// Paths that it brings in, each with its name here, and whether it passes it on.
    uses: Vec<(Name, String, bool)>,
    /// Paths in its code.
    paths: Vec<Name>,
}

fn named(text: &str) -> Named {
    let tokens = tokens(text);
    let (mut at, mut named) = (0, Named::default());
    while at < tokens.len() {
        let is_in = tokens[at] == "in" && at > 1 && tokens[at - 1] == "(" && tokens[at - 2] == "pub";
        if tokens[at] == "use" && tokens.get(at + 1).is_some_and(|next| is_word(next)) {
            let end = tokens[at..].iter().position(|token| token == ";").map_or(tokens.len(), |end| at + end);
            let mut found = Vec::new();
            leaves(&tokens[at + 1..end], &[], &mut found);
            let is_passed_on = at > 0 && matches!(tokens[at - 1].as_str(), "pub" | ")");
            named.uses.extend(found.into_iter().map(|(name, alias)| (name, alias, is_passed_on)));
            at = end;
        } else if is_in || is_word(&tokens[at]) && tokens[at] != "*" {
            let begin = if is_in { at + 1 } else { at };
            let mut path = vec![tokens[begin].clone()];
            at = begin;
            while tokens.get(at + 1).is_some_and(|token| token == "::")
                && tokens.get(at + 2).is_some_and(|token| is_word(token))
            {
                path.push(tokens[at + 2].clone());
                at += 2;
            }
            if path.len() > 1 && !is_in {
                named.paths.push(path);
            }
        }
        at += 1;
    }
    named
}

/// The files of a crate by their modules.
struct Sources {
    files: BTreeMap<Name, (String, Named)>,
}

impl Sources {
    /// Of texts by their paths, which begin with `root`.
    fn of(root: &str, texts: impl IntoIterator<Item = (String, String)>) -> Self {
        let module = |path: &str| -> Name {
            let short = path.trim_start_matches(root).trim_start_matches('/').trim_end_matches(".rs");
            let names = short.split('/').filter(|name| !matches!(*name, "mod" | "lib"));
            names.map(str::to_owned).collect()
        };
        let files = texts.into_iter().map(|(path, text)| (module(&path), (path, named(&code(&text)))));
        Self { files: files.collect() }
    }

    /// The module that owns what a path names in the file of a module; none: it is of another crate.
    fn owner(&self, from: &[String], path: &[String], depth: usize) -> Option<Name> {
        let mut base: Name = from.to_vec();
        let mut rest = path;
        match path.first()?.as_str() {
            "crate" => (base, rest) = (Name::new(), &path[1..]),
            "self" => rest = &path[1..],
            "super" => {
                while rest.first().is_some_and(|name| name == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            name => {
                let known = self.files.get(from).and_then(|(_, named)| named.uses.iter().find(|u| u.1 == name));
                base.push(name.to_owned());
                if !self.files.contains_key(&base) {
                    let (path, ..) = known.filter(|u| u.0.first().is_some_and(|first| first != name))?;
                    let whole: Name = path.iter().chain(&rest[1..]).cloned().collect();
                    return self.owner(from, &whole, depth.checked_sub(1)?);
                }
                rest = &rest[1..];
            }
        }
        while let Some(name) = rest.first() {
            let child: Name = base.iter().chain([name]).cloned().collect();
            if !self.files.contains_key(&child) {
                break;
            }
            (base, rest) = (child, &rest[1..]);
        }
        let (_, named) = self.files.get(&base)?;
        let passed_on = rest.first().and_then(|name| named.uses.iter().find(|u| u.2 && u.1 == *name));
        match passed_on {
            Some((path, ..)) if depth > 0 => {
                let whole: Name = path.iter().chain(&rest[1..]).cloned().collect();
                self.owner(&base, &whole, depth - 1).or(Some(base))
            }
            _ => Some(base),
        }
    }

    /// Arrows between files of one room; of an empty name: between all of them.
    fn arrows(&self, room: &str) -> Arrows {
        let is_of_room = |module: &[String]| room.is_empty() || module.first().is_some_and(|first| first == room);
        let mut arrows = Arrows::new();
        for (module, (path, named)) in self.files.iter().filter(|(module, _)| is_of_room(module)) {
            let paths = named.uses.iter().map(|(path, ..)| path).chain(&named.paths);
            let owners = paths.filter_map(|path| self.owner(module, path, 8));
            let others = owners.filter(|owner| owner != module && is_of_room(owner));
            arrows.insert(path.clone(), others.map(|owner| self.files[&owner].0.clone()).collect());
        }
        arrows
    }
}

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

/// Arrows between folders of a room that lead up, where `rooms` are its folders and files from the lowest to the highest.
fn upwards(arrows: &Arrows, room: &str, rooms: &[&str]) -> Vec<(String, String)> {
    let height = |path: &str| {
        let first = path.strip_prefix(room).unwrap_or(path).split('/').next().unwrap_or_default();
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

/// The files of a crate without its tests.
fn sources(root: &str) -> Sources {
    let of_use = files(root, "rs").into_iter().filter(|path| !path.contains("/tests"));
    Sources::of(root, of_use.map(|path| (path.clone(), read(&path))))
}

#[test]
fn no_file_of_fleet_rollouts_or_tasks_comes_into_a_circle() {
    let core = sources("core/src");
    let found: BTreeSet<String> =
        ["fleet", "rollout", "task"].iter().flat_map(|room| in_circles(&core.arrows(room))).collect();
    let known: BTreeSet<String> = KNOWN.iter().map(ToString::to_string).collect();
    assert_eq!(found.difference(&known).collect::<Vec<_>>(), Vec::<&String>::new(), "they came into a circle");
    assert_eq!(known.difference(&found).collect::<Vec<_>>(), Vec::<&String>::new(), "they left it: strike them here");
}

#[test]
fn the_rooms_of_fleet_use_only_the_rooms_below_them() {
    let arrows = sources("core/src").arrows("fleet");
    assert!(arrows.values().map(BTreeSet::len).sum::<usize>() > 200, "the arrows are not read");
    assert_eq!(upwards(&arrows, "core/src/fleet/", ROOMS), []);
}

#[test]
fn no_file_of_the_agent_or_of_simulated_robots_comes_into_a_circle() {
    for (root, files) in [("robot_agent/src", 80), ("robot_sim/src", 20)] {
        let arrows = sources(root).arrows("");
        assert!(arrows.len() >= files, "{root}: the files are not read");
        assert_eq!(in_circles(&arrows), BTreeSet::new(), "{root}");
    }
}

#[test]
fn the_rooms_of_the_agent_use_only_the_rooms_below_them() {
    let arrows = sources("robot_agent/src").arrows("");
    assert!(arrows.values().map(BTreeSet::len).sum::<usize>() > 200, "the arrows are not read");
    assert_eq!(upwards(&arrows, "robot_agent/src/", AGENT_ROOMS), []);
}

#[test]
fn a_circle_is_found_however_its_arrows_are_written() {
    let lib = ("src/lib.rs", "pub mod a;");
    let door = ("src/a/mod.rs", "pub mod x;\npub mod y;\npub use y::Y;");
    let uses =
        ["use super::y;", "use super::{y::Y, z};", "use crate::a::Y as Other;", "fn f() { crate::a::y::g(\"\") }"];
    for used in uses.into_iter().chain(["use super::Y;", "use crate::{a::{self}};\nfn f() { a::Y::new() }"]) {
        for (back, is_circle) in [("fn g(c: char) { c == '\"'; super::x::f() }", true), ("// super::x::f()", false)] {
            let texts = [lib, door, ("src/a/x.rs", used), ("src/a/y.rs", back)];
            let sources = Sources::of("src", texts.map(|(path, text)| (path.to_owned(), text.to_owned())));
            let found = in_circles(&sources.arrows("a"));
            assert_eq!(found.contains("src/a/x.rs"), is_circle, "{used} {back}");
        }
    }
    let in_tests = "\n#[cfg(test)]\nmod tests {\n    use super::super::x;\n}";
    for (back, is_circle) in [(in_tests, false), ("pub(in crate::a) fn g() {}", false), ("use super::x as z;", true)] {
        let texts = [lib, door, ("src/a/x.rs", "use super::y;"), ("src/a/y.rs", back)];
        let sources = Sources::of("src", texts.map(|(path, text)| (path.to_owned(), text.to_owned())));
        assert_eq!(in_circles(&sources.arrows("a")).len(), if is_circle { 2 } else { 0 }, "{back}");
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
        assert_eq!(!upwards(&arrow(from, to), "r/", ROOMS).is_empty(), is_up, "{from} {to}");
    }
}
