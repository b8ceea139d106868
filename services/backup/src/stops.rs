//! The files of the stop service beside the server: which stops are engaged, its key, its audit, and who is known to it.
//!
//! What a restore brings back is what was engaged at the backup. A reset that came later is not in it: that stop is engaged again for the service and for robots that
//! have not heard of the reset; those that have do not obey it, and say so. It is reset by name once more. A stop that came later is brought back by robots, who keep it themselves, and taken from them because the key is the same.

use super::files::{blocking, copy, copy_if_there, entries};
use super::part::{BackupFacts, Making, Part, Places};
use anyhow::{Context, ensure};
use async_trait::async_trait;
use midshift_core::stop::{FOLDER, LOG};
use midshift_identity::RevocationList;
use midshift_stop::{Copied, FIRST, HOLDER};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Latch, key, audit and snapshots.
pub struct Stops;

/// Which stops are engaged.
const LATCH: &str = "latch";
/// By which the service knows its own stops when robots bring them back.
const KEY: &str = "key.pem";
/// A file that is written over while it is read is read again so often.
const TRIES: usize = 5;

#[async_trait]
impl Part for Stops {
    fn name(&self) -> &'static str {
        FOLDER
    }
    async fn copy(&self, from: &Places, folder: &Path, _facts: &mut BackupFacts) -> anyhow::Result<bool> {
        let (from, folder) = (from.data.join(FOLDER), folder.to_owned());
        blocking(move || {
            let (has_latch, has_key) = (is_there(&from.join(LATCH))?, is_there(&from.join(KEY))?);
            if !has_latch && !has_key {
                return Ok(false);
            }
            ensure!(
                has_latch && has_key,
                "{} has lost a file: start `midshift-stop` once, which stops the fleet since nobody knows any more what was stopped, and take the backup then",
                from.display()
            );
            private(&folder)?;
            // Before the audit: its newest record that the latch knows of must be there.
            latch(&from, &folder)?;
            for path in entries(&from)? {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let is_left_out = [LATCH, LOG, FIRST, HOLDER, Copied::NAME, RevocationList::FILE].contains(&name.as_str());
                if !is_left_out && !name.ends_with(".new") {
                    copy_if_there(&path, &folder.join(name))?;
                }
            }
            Ok(true)
        })
        .await
    }
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>> {
        let folder = folder.to_owned();
        blocking(move || {
            let mut wrong = Vec::new();
            if let Err(error) = midshift_stop::verify(&folder) {
                wrong.push(error.to_string());
            }
            if !fs::read_to_string(folder.join(KEY)).unwrap_or_default().contains("PRIVATE KEY-----\n") {
                wrong.push(format!("{KEY} has no key"));
            }
            Ok(wrong)
        })
        .await
    }
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()> {
        let (from, to) = (folder.to_owned(), to.places.data.join(FOLDER));
        blocking(move || {
            private(&to)?;
            entries(&from)?.iter().try_for_each(|path| copy(path, &to.join(path.file_name().unwrap_or_default())))
        })
        .await
    }
}

/// One that cannot be looked at is not absent: a backup would leave it out.
fn is_there(path: &Path) -> anyhow::Result<bool> {
    path.try_exists().with_context(|| format!("looking for {}", path.display()))
}

fn private(folder: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(folder)?;
    fs::set_permissions(folder, fs::Permissions::from_mode(0o700))?;
    Ok(())
}

/// The latch, which its writer may be writing over: one of its two halves is whole in a copy unless it was written twice meanwhile.
fn latch(from: &Path, folder: &Path) -> anyhow::Result<()> {
    let mut copied = None;
    for _ in 0..TRIES {
        copy(&from.join(LATCH), &folder.join(LATCH))?;
        match midshift_stop::latch(folder) {
            Ok(_) => return Ok(()),
            Err(error) => copied = Some(error),
        }
    }
    copied.map_or(Ok(()), |error| Err(error).context("copying the latch"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn files_of_stops_that_cannot_be_looked_at_are_left_out_of_no_backup() {
        let dir = tempfile::tempdir().expect("a folder");
        let from = Places { data: dir.path().join("data"), ota_keys: None, store: None };
        let latch = from.data.join(FOLDER).join(LATCH);
        fs::create_dir_all(from.data.join(FOLDER)).expect("a folder");
        let to = dir.path().join("backup");
        assert!(!Stops.copy(&from, &to, &mut BackupFacts::default()).await.expect("there is nothing"));
        std::os::unix::fs::symlink(&latch, &latch).expect("a link to itself");
        let error = Stops.copy(&from, &to, &mut BackupFacts::default()).await.expect_err("nobody knows");
        assert!(format!("{error:#}").contains(LATCH), "{error:#}");
    }
}
