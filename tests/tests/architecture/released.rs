//! What each release wrote has its place in this build: tables and columns of its schema, names in what it kept as text.
//!
//! While processes of two versions serve one database, the older one goes on reading and writing as it always did: a name
//! that it knows stays, and what is new in a table refuses nothing that it writes. Words of an enum that are new are no
//! matter of this: record 0062 says what an older reader does with one.

use crate::{read, root};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Folders of all releases.
fn releases() -> Vec<PathBuf> {
    let entries =
        std::fs::read_dir(root().join("tests/fixtures")).expect("releases").map(|entry| entry.expect("an entry"));
    let made = entries.filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."));
    let all: Vec<PathBuf> = made.map(|entry| entry.path()).collect();
    assert!(!all.is_empty(), "no release is in tests/fixtures");
    all
}

/// Names in blocks of a list of stored names, by the head of the block. Keys of an object that is written by hand stand in
/// one line.
fn names(text: &str) -> BTreeMap<&str, BTreeSet<&str>> {
    let (mut all, mut head) = (BTreeMap::<&str, BTreeSet<&str>>::new(), "");
    for line in text.lines().filter(|line| !line.is_empty()) {
        match line.strip_prefix("    ") {
            None => head = line,
            Some(keys) if head.ends_with("by hand") => all.entry(head).or_default().extend(keys.split(' ')),
            Some(name) => drop(all.entry(head).or_default().insert(name)),
        }
    }
    all
}

/// Names of `before` that are gone in `now`; of an enum, words.
fn gone(before: &str, now: &str) -> Vec<String> {
    let (before, now) = (names(before), names(now));
    let none = BTreeSet::new();
    let words = |line: &str| -> BTreeSet<String> { line.split(" | ").map(str::to_owned).collect() };
    let mut gone = Vec::new();
    for (head, lines) in before {
        let after = now.get(head).unwrap_or(&none);
        for line in lines.into_iter().filter(|line| !after.contains(line)) {
            let (place, known) = line.split_once(" = ").unwrap_or((line, ""));
            let here = after.iter().filter_map(|line| line.split_once(" = ")).filter(|(at, _)| *at == place);
            let still: BTreeSet<String> = here.flat_map(|(_, known)| words(known)).collect();
            let lost: Vec<String> = words(known).into_iter().filter(|word| !still.contains(word)).collect();
            if !lost.is_empty() {
                gone.push(format!("{head}: {place} {}", lost.join(" ")).trim_end().to_owned());
            }
        }
    }
    gone
}

/// Tables of a schema as SQL text, each with its columns and rules as they stand there.
fn tables(sql: &str) -> BTreeMap<String, BTreeSet<String>> {
    let table = |statement: &str| {
        let (name, rest) = statement.split_once('(')?;
        let (body, _) = rest.rsplit_once(')')?;
        let (mut parts, mut part, mut depth) = (BTreeSet::new(), String::new(), 0_i32);
        for letter in body.chars() {
            depth += i32::from(letter == '(') - i32::from(letter == ')');
            if letter == ',' && depth == 0 {
                parts.insert(std::mem::take(&mut part));
            } else {
                part.push(letter);
            }
        }
        parts.insert(part);
        let plain = |part: &String| part.split_whitespace().collect::<Vec<_>>().join(" ");
        Some((name.trim().trim_matches('"').to_owned(), parts.iter().map(plain).collect()))
    };
    sql.split("CREATE TABLE ").skip(1).filter_map(|rest| table(rest.split(';').next()?)).collect()
}

/// What a writer that knows `before` would be refused in `now`.
fn refused(before: &str, now: &str) -> Vec<String> {
    let rules = |sql: &str| -> BTreeSet<String> {
        let plain = sql.split(';').map(|statement| statement.split_whitespace().collect::<Vec<_>>().join(" "));
        plain.filter(|s| s.starts_with("CREATE UNIQUE INDEX") || s.starts_with("CREATE TRIGGER")).collect()
    };
    let mut refused: Vec<String> = rules(now).difference(&rules(before)).map(|rule| format!("{rule} is new")).collect();
    let (before, now) = (tables(before), tables(now));
    for (name, parts) in &before {
        let Some(after) = now.get(name) else {
            refused.push(format!("{name} is gone"));
            continue;
        };
        refused.extend(parts.difference(after).map(|part| format!("{name}: {part} is gone")));
        // A column that the older writer does not name must be able to stay empty; a new rule may refuse what it writes.
        let narrow = |part: &&String| part.contains("NOT NULL") || part.contains('(');
        refused.extend(after.difference(parts).filter(narrow).map(|part| format!("{name}: {part} is new")));
    }
    refused
}

#[test]
fn every_name_that_a_release_kept_as_text_is_known() {
    let now = read(crate::stored_keys::GOLDEN);
    for release in releases() {
        let before = std::fs::read_to_string(release.join("stored_keys.txt")).expect("its names");
        assert_eq!(gone(&before, &now), [] as [String; 0], "{}", release.display());
    }
}

#[test]
fn what_a_release_writes_has_its_place_in_this_schema() {
    for release in releases() {
        for name in ["control.sql", "telemetry.sql"] {
            let before = std::fs::read_to_string(release.join("sqlite/data").join(name)).expect("its schema");
            assert!(tables(&before).len() > 3, "no schema was read from {name} of {}", release.display());
            let refused = refused(&before, &read(format!("services/store/golden/{name}")));
            assert_eq!(refused, [] as [String; 0], "{name} of {}", release.display());
        }
    }
}

#[test]
fn a_name_or_word_that_is_gone_is_found_and_a_new_one_is_not() {
    let before = "table t\n    a\n    b = x | y\n    c[].d\n";
    assert_eq!(gone(before, "table t\n    a\n    b = x | y | z\n    c[].d\n    e\n"), [] as [String; 0]);
    assert_eq!(gone(before, "table t\n    a\n    b = x\n"), ["table t: b y", "table t: c[].d"]);
    assert_eq!(gone("table t\n    a\n", "table u\n    a\n"), ["table t: a"]);
    let by_hand = |keys: &str| format!("cli, objects by hand\n    {keys}\n");
    assert_eq!(gone(&by_hand("a b"), &by_hand("a b c")), [] as [String; 0]);
    assert_eq!(gone(&by_hand("a b"), &by_hand("a c")), ["cli, objects by hand: b"]);
}

#[test]
fn an_older_writer_is_refused_by_what_it_does_not_name() {
    let before = "CREATE TABLE t (\n    id TEXT NOT NULL,\n    n BIGINT,\n    UNIQUE (id, n)\n);";
    let now = |columns: &str| refused(before, &format!("CREATE TABLE t (id TEXT NOT NULL, {columns});"));
    assert_eq!(now("n BIGINT, UNIQUE (id, n), more TEXT"), [] as [String; 0]);
    assert_eq!(now("n BIGINT, UNIQUE (id, n), more TEXT NOT NULL"), ["t: more TEXT NOT NULL is new"]);
    assert_eq!(now("UNIQUE (id, n)"), ["t: n BIGINT is gone"]);
    assert_eq!(now("n BIGINT, UNIQUE (id, n), UNIQUE (n)"), ["t: UNIQUE (n) is new"]);
    assert_eq!(refused(before, ""), ["t is gone"]);
    let unique = format!("{before} CREATE UNIQUE INDEX u ON t (n);");
    assert_eq!(refused(before, &unique), ["CREATE UNIQUE INDEX u ON t (n) is new"]);
}
