//! Finds the names that somebody who mistyped one may have meant.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Names that are offered for one that is not known.
const NAMES_MAX: usize = 3;
/// Edits between a name and what was typed: beyond these it is another name.
const EDITS_MAX: usize = 3;

/// The known names that differ from `name` by at most 3 edits, nearest first and then in their order, at most 3.
pub fn nearest<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> impl Iterator<Item = &'a str> {
    let found = known.filter_map(|known| Some((edits(name.as_bytes(), known.as_bytes())?, known)));
    let mut nearest: BinaryHeap<Reverse<(usize, &str)>> = found.map(Reverse).collect();
    std::iter::from_fn(move || nearest.pop().map(|Reverse((_, known))| known)).take(NAMES_MAX)
}

/// Letters of the shortest word of which a slip can be told from another word.
const SLIP_LETTERS: usize = 5;
/// Letters of the shortest word of which two that changed places are told.
const SWAPPED_LETTERS: usize = 4;
/// Letters from which on two slips are told too.
const TWO_SLIPS_LETTERS: usize = 8;

/// The known names of which `name` is likely a slip of the hand, nearest first, at most 3: in one word one letter behind
/// the first more, less or another, two where the word is long, or two neighbours that changed places. Other words and
/// numbers are no slip: `dock-south` is not `dock-north`, `line-2` is not `line-1`, `transport-b` is not `transport`.
pub fn misspelled<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> impl Iterator<Item = &'a str> {
    let slips = |known: &&'a str| is_slip(name, known);
    nearest(name, known.filter(slips).collect::<Vec<_>>().into_iter())
}

fn is_slip(name: &str, known: &str) -> bool {
    fn words(text: &str) -> Vec<&str> {
        text.split(['-', '_']).collect()
    }
    let (name, known) = (words(name), words(known));
    if name.len() != known.len() {
        return false;
    }
    let mut others = name.iter().zip(&known).filter(|(a, b)| a != b);
    match (others.next(), others.next()) {
        // The same words, set apart by another character.
        (None, _) => true,
        (Some((a, b)), None) => is_slip_of_word(a, b),
        _ => false,
    }
}

fn is_slip_of_word(name: &str, known: &str) -> bool {
    let digits = |text: &str| text.bytes().filter(u8::is_ascii_digit).collect::<Vec<_>>();
    let letters_of = |text: &str| text.bytes().filter(u8::is_ascii_alphabetic).count();
    let letters = letters_of(name).min(letters_of(known));
    let is_longer_word = |a: &str, b: &str| a.starts_with(b) && a.len() > b.len() + 1;
    if digits(name) != digits(known) || name.bytes().next() != known.bytes().next() {
        return false;
    }
    if letters >= SWAPPED_LETTERS && has_neighbours_swapped(name.as_bytes(), known.as_bytes()) {
        return true;
    }
    if letters < SLIP_LETTERS || is_longer_word(name, known) || is_longer_word(known, name) {
        return false;
    }
    let slips = if letters < TWO_SLIPS_LETTERS { 1 } else { 2 };
    edits(name.as_bytes(), known.as_bytes()).is_some_and(|edits| edits <= slips)
}

fn has_neighbours_swapped(a: &[u8], b: &[u8]) -> bool {
    let Some(at) = a.iter().zip(b).position(|(x, y)| x != y) else { return false };
    a.len() == b.len() && at + 1 < a.len() && a[at] == b[at + 1] && a[at + 1] == b[at] && a[at + 2..] == b[at + 2..]
}

/// How many bytes are put in, left out or changed between two names; none: more than [`EDITS_MAX`].
fn edits(a: &[u8], b: &[u8]) -> Option<usize> {
    if a.len().abs_diff(b.len()) > EDITS_MAX {
        return None;
    }
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut before = std::mem::replace(&mut row[0], i + 1);
        for (j, y) in b.iter().enumerate() {
            let changed = before + usize::from(x != y);
            before = row[j + 1];
            row[j + 1] = changed.min(before + 1).min(row[j] + 1);
        }
        if row.iter().all(|edits| *edits > EDITS_MAX) {
            return None;
        }
    }
    row.last().copied().filter(|edits| *edits <= EDITS_MAX)
}

#[cfg(test)]
mod tests {
    use super::{misspelled, nearest};

    #[test]
    fn the_names_that_may_be_meant_come_nearest_first_and_strangers_not_at_all() {
        let known = ["rbt-04", "rbt-14", "rbt-40", "amr-0400", "forklift-7"];
        let found = |name| nearest(name, known.into_iter()).collect::<Vec<_>>();
        assert_eq!(found("rbt-4"), ["rbt-04", "rbt-14", "rbt-40"]);
        assert_eq!(found("rbt-004"), ["rbt-04", "rbt-14", "rbt-40"]);
        assert_eq!(found("forklift7"), ["forklift-7"]);
        assert!(found("crane").is_empty() && found("").is_empty());
    }

    #[test]
    fn a_slip_of_the_hand_is_told_from_another_name() {
        let known =
            ["dock-north", "inspect", "line-1", "pallet-in", "patrol", "pick", "pick-place", "restock", "transport"];
        let found = |name| misspelled(name, known.into_iter()).collect::<Vec<_>>();
        for (slip, meant) in [
            ("transpot", "transport"),
            ("transprot", "transport"),
            ("transports", "transport"),
            ("partol", "patrol"),
            ("patrl", "patrol"),
            ("inspekt", "inspect"),
            ("pick_place", "pick-place"),
        ] {
            assert_eq!(found(slip), [meant], "{slip}");
        }
        for other in [
            "pack",
            "picks",
            "trnsprt",
            "lick",
            "line-2",
            "line-1b",
            "transport-b",
            "transport2",
            "transporter",
            "dock-south",
            "pallet-on",
            "destock",
            "transfer",
            "visit",
            "",
        ] {
            assert!(found(other).is_empty(), "{other}: {:?}", found(other));
        }
    }
}
