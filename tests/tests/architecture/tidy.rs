//! Words of the source: a doc comment says something, and a function's name has a verb and an object.

use crate::source::crates;
use crate::{files, read};

/// Names that say nothing of what is done, or to what.
const BARE: [&str; 8] = ["of", "take", "look", "tell", "say", "hear", "put", "keep"];

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

/// Fails with all that `found` finds in the sources of any crate.
fn none(found: impl Fn(&str) -> Vec<String>) {
    let suites = "tests/tests".to_owned();
    let folders = crates().into_iter().map(|(_, folder)| folder).chain(std::iter::once(suites));
    let paths = folders.flat_map(|folder| files(&folder, "rs"));
    let all: Vec<String> =
        paths.flat_map(|path| found(&read(&path)).into_iter().map(move |what| format!("{path}: {what}"))).collect();
    assert!(all.is_empty(), "{all:#?}");
}

#[test]
fn a_doc_comment_is_more_than_a_word() {
    none(|text| one_word_docs(text).iter().map(ToString::to_string).collect());
    assert_eq!(one_word_docs("/// Which.\nx\n/// Says that\n/// much.\n//! Whose.\n"), [1]);
    assert_eq!(one_word_docs("    /// UTC.\n    x\n// Not.\n//! Whose.\n"), [1, 4]);
}

#[test]
fn a_function_is_named_by_a_verb_and_its_object() {
    none(bare_functions);
    // The word is put in, so that the sample is not found here.
    let sample = "pub async FN take<T>(x: T) {\nFN take_all() {}\n// FN put()\nlet fn_of = 1;".replace("FN", "fn");
    assert_eq!(bare_functions(&sample), ["take"]);
}
