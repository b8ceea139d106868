//! Pages of lists: how many rows a page may have, and which rows come next.

use midshift_core::limits;
use midshift_core::reason::Violations;

/// Rows of a page that was asked for: 1 to [`limits::PAGE_MAX`], 0 means [`limits::PAGE_DEFAULT`]. More is a violation.
pub fn size(asked: u32, bad: &mut Violations) -> usize {
    match asked as usize {
        0 => limits::PAGE_DEFAULT,
        n if n <= limits::PAGE_MAX => n,
        _ => {
            bad.add("page_size", "must be 1..1000; 0: 100");
            limits::PAGE_DEFAULT
        }
    }
}

/// One page of rows that come in ascending order of their keys, and the token of the next page, empty after the last. A token is the key of
/// the last row of the page before, so rows that came or went in between move nothing.
pub fn page<K: AsRef<str>, T>(rows: impl Iterator<Item = (K, T)>, after: &str, size: usize) -> (Vec<T>, String) {
    let mut rows = rows.skip_while(|(key, _)| !after.is_empty() && key.as_ref() <= after);
    let mut last = None;
    let mut out = Vec::new();
    for (key, row) in rows.by_ref().take(size) {
        last = Some(key);
        out.push(row);
    }
    let next = last.filter(|_| rows.next().is_some());
    (out, next.map(|key| key.as_ref().to_owned()).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows<'a>(keys: &'a [&'a str]) -> impl Iterator<Item = (String, &'a str)> {
        keys.iter().map(|k| ((*k).to_owned(), *k))
    }

    #[test]
    fn pages_give_every_row_once_and_the_last_has_no_token() {
        let all = ["a", "b", "c", "d"];
        assert_eq!(page(rows(&all), "", 3), (vec!["a", "b", "c"], "c".to_owned()));
        assert_eq!(page(rows(&all), "c", 3), (vec!["d"], String::new()));
        assert_eq!(page(rows(&all), "", 4), (all.to_vec(), String::new()));
    }

    #[test]
    fn a_row_that_went_takes_nothing_with_it() {
        assert_eq!(page(rows(&["a", "b", "d"]), "c", 3), (vec!["d"], String::new()));
    }

    #[test]
    fn a_page_has_a_limit_and_a_default() {
        let mut bad = Violations::default();
        assert_eq!([size(0, &mut bad), size(7, &mut bad), size(1_000, &mut bad)], [100, 7, 1_000]);
        assert!(bad.0.is_empty());
        size(1_001, &mut bad);
        assert_eq!(bad.0.len(), 1);
    }
}
