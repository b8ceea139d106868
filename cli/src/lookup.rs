//! Finds the one thing that a person means by an id or by the beginning of one.
//!
//! Invariant: a whole id is always itself, however many others begin with it.

use super::client::Exit;
use super::pages::{Listed, Page};
use tonic::{Code, Status};

/// Candidates that are asked for, and shown where they are several.
pub const SHOWN: u32 = 10;

/// What begins with what was typed.
#[derive(Debug, Default)]
pub struct Found {
    /// Id of each, and how it is shown.
    pub candidates: Vec<(String, String)>,
    /// There are no more.
    pub is_all: bool,
}

impl Found {
    /// One page of a list, in the order of ids, with what is told of each.
    pub fn page<P: Page<Item: Listed>>(page: &P, row: impl Fn(&P::Item) -> Vec<String>) -> Self {
        let candidate = |one: &P::Item| (one.name(), row(one));
        Self::new(page.items().iter().map(candidate), page.is_last())
    }

    /// Ids, each with what is told of it.
    pub fn new(ids: impl IntoIterator<Item = (String, Vec<String>)>, is_all: bool) -> Self {
        let candidate = |(id, mut words): (String, Vec<String>)| {
            words.retain(|word| *word != id && !word.is_empty());
            (id.clone(), [vec![id], words].concat().join("  "))
        };
        Self { candidates: ids.into_iter().map(candidate).collect(), is_all }
    }

    /// The id that is meant; none: nothing begins with it.
    ///
    /// # Errors
    /// If several begin with it: they are listed.
    pub fn single(self, what: &str, typed: &str) -> Result<Option<String>, Exit> {
        if self.candidates.iter().any(|(id, _)| id == typed) {
            return Ok(Some(typed.to_owned()));
        }
        let mut lines: String = self.candidates.iter().map(|(_, line)| format!("\n  {}", line.trim_end())).collect();
        let mut ids = self.candidates.into_iter().map(|(id, _)| id);
        let first = ids.next();
        if ids.next().is_none() && self.is_all {
            return Ok(first);
        }
        if !self.is_all {
            lines += "\n  and more";
        }
        Err(Exit::usage(format!(
            "more than one {what} begins with {typed}:{lines}\n  try: the same with more of the id"
        )))
    }
}

/// Completes an id from its beginning, by the ids that the server lists. Returns `typed` unchanged if no id begins with
/// it, or if the caller may not list: the next call reports an unknown id.
///
/// # Errors
/// If `typed` is empty, several ids begin with it, or the server does not answer.
pub async fn whole_id(
    what: &str,
    typed: &str,
    listed: impl Future<Output = Result<Found, Status>>,
) -> Result<String, Exit> {
    if typed.is_empty() {
        return Err(Exit::usage(format!("the id of a {what} is empty\n  try: midshift {what} --help")));
    }
    match listed.await {
        Ok(found) => Ok(found.single(what, typed)?.unwrap_or_else(|| typed.to_owned())),
        Err(status) if matches!(status.code(), Code::PermissionDenied | Code::Unimplemented) => Ok(typed.to_owned()),
        Err(status) => Err(status.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(ids: &[&str], next_page_token: &str) -> Found {
        let row = |id: &&str| ((*id).to_owned(), vec!["OPEN".to_owned(), (*id).to_owned(), String::new()]);
        Found::new(ids.iter().map(row), next_page_token.is_empty())
    }

    #[test]
    fn a_whole_id_is_itself_however_many_others_begin_with_it() {
        for next in ["", "more"] {
            let one = found(&["T-1", "T-10", "T-11"], next).single("task", "T-1");
            assert_eq!(one.expect("itself").as_deref(), Some("T-1"));
        }
    }

    #[test]
    fn a_beginning_that_only_one_has_is_that_one_and_of_several_each_is_listed() {
        assert_eq!(found(&["T-10"], "").single("task", "T-1").expect("one").as_deref(), Some("T-10"));
        assert_eq!(found(&[], "").single("task", "T-1").expect("none"), None);
        let several = found(&["T-10", "T-11"], "").single("task", "T-1").expect_err("it may be either");
        assert_eq!(several.code(), 2);
        let text =
            "more than one task begins with T-1:\n  T-10  OPEN\n  T-11  OPEN\n  try: the same with more of the id";
        assert_eq!(several.to_string(), text);
        let more = found(&["T-10"], "T-10").single("task", "T-1").expect_err("there are more");
        assert!(more.to_string().contains("\n  and more\n"), "{more}");
    }

    #[tokio::test]
    async fn who_may_not_list_may_name_a_whole_id_and_a_server_that_is_away_is_told() {
        let answered = |code| async move { Err(Status::new(code, "")) };
        assert_eq!(whole_id("robot", "r1", answered(Code::PermissionDenied)).await.expect("as it is"), "r1");
        assert!(whole_id("robot", "r1", answered(Code::Unavailable)).await.is_err());
        let nothing = whole_id("robot", "r1", async { Ok(Found { candidates: Vec::new(), is_all: true }) }).await;
        assert_eq!(nothing.expect("as it is"), "r1");
        assert_eq!(whole_id("robot", "", answered(Code::Unavailable)).await.expect_err("nothing").code(), 2);
    }
}
