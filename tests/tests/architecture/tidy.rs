//! Words of the source: a doc comment says something, and a function's name has a verb and an object.

use crate::source::crates;
use crate::{files, read};

/// Names that say nothing of what is done, or to what.
const BARE: [&str; 8] = ["of", "take", "look", "tell", "say", "hear", "put", "keep"];

/// Functions that still have such a name, by crate. It only shrinks: lower a number as they get another name.
const KNOWN_BARE: &[(&str, usize)] = &[
    ("core/src", 40),
    ("proto/src", 3),
    ("services/store/src", 7),
    ("services/fleet/src", 3),
    ("services/identity/src", 2),
    ("ota_bundles/src", 3),
    ("tests/src", 5),
    ("tests/tests", 14),
];

/// Doc comments of one word that are still there, by crate. It only shrinks.
const KNOWN_DOCS: &[(&str, usize)] = &[];

/// Doc comments that are one word, by their line.
fn one_word_docs(text: &str) -> Vec<usize> {
    let lines: Vec<&str> = text.lines().map(str::trim).collect();
    let doc = |at: usize| {
        let line = lines.get(at)?;
        line.strip_prefix("///").or_else(|| line.strip_prefix("//!"))
    };
    let is_alone = |at: &usize| (*at == 0 || doc(at - 1).is_none()) && doc(at + 1).is_none();
    let is_word = |at: &usize| doc(*at).is_some_and(|doc| doc.split_whitespace().count() == 1);
    (0..lines.len()).filter(is_word).filter(is_alone).map(|at| at + 1).collect()
}

/// Functions whose name is one of those that say nothing.
fn bare_functions(text: &str) -> Vec<String> {
    let words = text.lines().filter(|line| !line.trim_start().starts_with("//")).flat_map(|line| {
        let words: Vec<&str> =
            line.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|w| !w.is_empty()).collect();
        words.windows(2).filter(|pair| pair[0] == "fn").map(|pair| pair[1].to_owned()).collect::<Vec<_>>()
    });
    words.filter(|name| BARE.contains(&name.as_str())).collect()
}

/// How many `found` finds in the sources of a crate, held against what is known.
fn hold(known: &[(&str, usize)], found: impl Fn(&str) -> Vec<String>) {
    let suites = ("tests".to_owned(), "tests/tests".to_owned());
    let mut wrong = Vec::new();
    for (_, folder) in crates().into_iter().chain([suites]) {
        let all: Vec<String> = files(&folder, "rs")
            .into_iter()
            .flat_map(|path| found(&read(&path)).into_iter().map(move |what| format!("{path}: {what}")))
            .collect();
        let known = known.iter().find(|(known, _)| *known == folder).map_or(0, |(_, count)| *count);
        if all.len() != known {
            wrong.push((folder, format!("{known} were known, {} are there", all.len()), all));
        }
    }
    assert!(wrong.is_empty(), "mend what came, or lower the number: {wrong:#?}");
}

#[test]
fn a_doc_comment_is_more_than_a_word() {
    hold(KNOWN_DOCS, |text| one_word_docs(text).iter().map(ToString::to_string).collect());
    assert_eq!(one_word_docs("/// Which.\nx\n/// Says that\n/// much.\n//! Whose.\n"), [1]);
    assert_eq!(one_word_docs("    /// UTC.\n    x\n// Not.\n//! Whose.\n"), [1, 4]);
}

#[test]
fn a_function_is_named_by_a_verb_and_its_object() {
    hold(KNOWN_BARE, bare_functions);
    assert_eq!(bare_functions("pub async fn take<T>(x: T) {\nfn take_all() {}\n// fn put()\nlet fn_of = 1;"), ["take"]);
}
