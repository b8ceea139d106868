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
    use super::nearest;

    #[test]
    fn the_names_that_may_be_meant_come_nearest_first_and_strangers_not_at_all() {
        let known = ["rbt-04", "rbt-14", "rbt-40", "amr-0400", "forklift-7"];
        let found = |name| nearest(name, known.into_iter()).collect::<Vec<_>>();
        assert_eq!(found("rbt-4"), ["rbt-04", "rbt-14", "rbt-40"]);
        assert_eq!(found("rbt-004"), ["rbt-04", "rbt-14", "rbt-40"]);
        assert_eq!(found("forklift7"), ["forklift-7"]);
        assert!(found("crane").is_empty() && found("").is_empty());
    }
}
