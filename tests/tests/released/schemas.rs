//! Schemas of each release beside this build's: while both serve one database, the older process goes on writing as it always did.

use midshift_tests::released::Release;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

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
    let (before, now) = (tables(before), tables(now));
    let mut refused = Vec::new();
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
fn what_a_release_writes_has_its_place_in_this_schema() -> anyhow::Result<()> {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../services/store/golden");
    for release in Release::all()? {
        for file in ["control.sql", "telemetry.sql"] {
            let before = release.text(&format!("sqlite/{file}"))?;
            let now = std::fs::read_to_string(golden.join(file))?;
            assert!(tables(&before).len() > 3, "no schema was read from {file} of {}", release.folder.display());
            assert_eq!(refused(&before, &now), Vec::<String>::new(), "{file} of {}", release.folder.display());
        }
    }
    Ok(())
}

#[test]
fn an_older_writer_is_refused_by_what_it_does_not_name() {
    let before = "CREATE TABLE t (\n    id TEXT NOT NULL,\n    n BIGINT,\n    UNIQUE (id, n)\n);";
    let now = |columns: &str| refused(before, &format!("CREATE TABLE t (id TEXT NOT NULL, {columns});"));
    assert_eq!(now("n BIGINT, UNIQUE (id, n), more TEXT"), Vec::<String>::new());
    assert_eq!(now("n BIGINT, UNIQUE (id, n), more TEXT NOT NULL"), ["t: more TEXT NOT NULL is new"]);
    assert_eq!(now("UNIQUE (id, n)"), ["t: n BIGINT is gone"]);
    assert_eq!(now("n BIGINT, UNIQUE (id, n), UNIQUE (n)"), ["t: UNIQUE (n) is new"]);
    assert_eq!(refused(before, ""), ["t is gone"]);
}
