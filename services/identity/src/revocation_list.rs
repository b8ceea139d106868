//! The file of what was taken back: one line of JSON for each token and each key, appended and never taken off.
//!
//! Invariants:
//! 1. A line is durable when [`RevocationList::append`] returns. One that a power cut tore was told to nobody, and is cut off before the next.
//! 2. The file is in no backup: it is merged into the rows of one that is older than it.
//!
//! Identity keeps one beside the authority's key; the follower of a stop service keeps a copy in that one's folder, which may be on another machine.

use crate::{Error, files};
use midshift_core::identity::Revocation;
use std::collections::BTreeSet;
use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use tokio::sync::Mutex;

type Marks = BTreeSet<(String, i64)>;

/// A list that is appended to. One process at a time has a file.
pub struct RevocationList {
    path: PathBuf,
    /// What is in the file, durably; none: it must be read.
    written: Mutex<Option<Marks>>,
}

impl RevocationList {
    /// Its name in a folder.
    pub const FILE: &str = "revocations.jsonl";

    /// The one in this folder, which must be there when something is appended.
    pub fn new(folder: &Path) -> Self {
        Self { path: folder.join(Self::FILE), written: Mutex::default() }
    }

    /// Appends what is not in it yet; durable when it returns.
    ///
    /// # Errors
    /// The disk. What was appended then is seen at the next call.
    pub async fn append(&self, revocations: &[Revocation]) -> Result<(), Error> {
        let mut written = self.written.lock().await;
        // One that somebody took away is written anew.
        let known = written.take().filter(|known| known.is_empty() || self.path.exists());
        let (path, revocations) = (self.path.clone(), revocations.to_vec());
        let appended = match known {
            Some(known) if revocations.iter().all(|line| known.contains(&line.mark())) => Ok(known),
            known => {
                let appending = tokio::task::spawn_blocking(move || append(&path, known, &revocations));
                appending.await.unwrap_or_else(|error| Err(io::Error::other(error)))
            }
        };
        *written = Some(appended.map_err(|source| Error::Folder { path: self.path.clone(), source })?);
        Ok(())
    }

    /// Everything in a file, for whoever merges it. A last line without an end was told to nobody, and is left out.
    ///
    /// # Errors
    /// It cannot be read, or has a line that this release does not know: what it takes back would come back.
    pub fn read(path: &Path) -> Result<Vec<Revocation>, Error> {
        let text = fs::read_to_string(path).map_err(|source| Error::Folder { path: path.to_owned(), source })?;
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let lines = whole.lines().enumerate().map(|(n, line)| {
            let read = serde_json::from_str::<Revocation>(line);
            read.map_err(|source| Error::Line { path: path.to_owned(), line: n + 1, source })
        });
        lines.collect()
    }
}

fn append(path: &Path, known: Option<Marks>, revocations: &[Revocation]) -> io::Result<Marks> {
    let mut known = match known {
        Some(known) => known,
        None => open(path)?,
    };
    let mut lines = String::new();
    for line in revocations {
        if known.insert(line.mark()) {
            lines += &serde_json::to_string(line)?;
            lines.push('\n');
        }
    }
    if lines.is_empty() {
        return Ok(known);
    }
    let is_new = !path.exists();
    let mut file = OpenOptions::new().append(true).create(true).mode(files::PRIVATE).open(path)?;
    file.write_all(lines.as_bytes())?;
    file.sync_all()?;
    if is_new {
        midshift_durable::sync_folder_of(path)?;
    }
    Ok(known)
}

/// What is in a file, made durable: an earlier process may have ended before it was. A torn line is cut off. Lines of a newer version stay as they are.
fn open(path: &Path) -> io::Result<Marks> {
    let text = match fs::read(path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Marks::new()),
        Err(error) => return Err(error),
    };
    let whole = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
    let file = OpenOptions::new().write(true).open(path)?;
    if whole < text.len() {
        file.set_len(whole as u64)?;
    }
    file.sync_all()?;
    let lines = text.split(|byte| *byte == b'\n');
    Ok(lines.filter_map(|line| serde_json::from_slice::<Revocation>(line).ok()).map(|line| line.mark()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::identity::{Act, TokenId};

    fn revoked(token: &str, at: i64) -> Revocation {
        let token_id = TokenId::new(token).expect("an id");
        Revocation::Token { token_id, revoked: Act::new("anna", at) }
    }

    #[tokio::test]
    async fn what_was_taken_back_is_in_the_file_once_and_a_torn_line_is_cut_off_before_the_next() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join(RevocationList::FILE);
        let all = [revoked("t1", 5), revoked("t2", 6), revoked("t2", 4)];
        let list = RevocationList::new(dir.path());
        list.append(&[]).await.expect("nothing to do");
        for n in [1, 1, 2] {
            list.append(&all[..n]).await.expect("appended");
        }
        assert_eq!(RevocationList::read(&path).expect("lines"), all[..2]);
        let mut text = fs::read(&path).expect("the file");
        text.extend(b"{\"what\":\"token\",\"tok");
        fs::write(&path, text).expect("torn");
        assert_eq!(RevocationList::read(&path).expect("lines"), all[..2]);
        RevocationList::new(dir.path()).append(&all).await.expect("appended");
        assert_eq!(RevocationList::read(&path).expect("lines"), all);
        fs::remove_file(&path).expect("taken away");
        list.append(&all).await.expect("written anew");
        assert_eq!(RevocationList::read(&path).expect("lines"), all);
    }

    #[test]
    fn a_line_that_is_not_known_is_named_and_nothing_of_the_list_is_used() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("list");
        let known = serde_json::to_string(&revoked("t1", 5)).expect("a line");
        fs::write(&path, format!("{known}\n{{\"what\":\"planet\"}}\n{known}\n")).expect("written");
        let refused = RevocationList::read(&path).expect_err("a newer version's").to_string();
        assert!(refused.starts_with("line 2 of "), "{refused}");
    }
}
