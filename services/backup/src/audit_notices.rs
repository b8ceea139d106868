//! Leaves a notice for the server that a backup of its data directory was made or restored, and writes the row of the audit for it.
//!
//! Invariant: whoever copies files writes no rows: the store belongs to the server. The backup leaves a small file in the data directory, and a server
//! with it, now or at its next start, writes the row and then takes the file away. A row is never lost, and comes once in each life of a server at most.
//! Of several processes that share the directory one at a time does that.
//! The name of whoever made the backup is the one of the operating system: nobody signed in for it.

use super::{Access, AccessOutcome, Summary};
use anyhow::Context;
use midshift_core::audit::Note;
use midshift_core::item::Item;
use midshift_core::rows::Writer;
use midshift_core::time::Utc;
use midshift_store::{CommitError, Store};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Folder of the data directory.
pub const FOLDER: &str = "backups-made";
/// What they are called in the audit.
const MADE: &str = "backup.make";
const RESTORED: &str = "backup.restore";
/// Whoever writes rows of that folder holds this in it; the system lets it go with the process, however that ends.
const TURN: &str = "turn.lock";
/// How often a server looks, real time.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Bytes of such a file at most.
const BYTES_MAX: u64 = 16 * 1024;

/// The notice of a backup that was made.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct BackupNotice {
    /// Who, as the operating system knows it: `os:UID`.
    by: String,
    /// Where to, as it was asked for.
    to: String,
    /// When it was begun, unix ms.
    begun_unix_ms: i64,
    /// Names of its parts.
    parts: Vec<String>,
}

/// The notice of a restore that was made.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct RestoreNotice {
    /// Who, as the operating system knows it: `os:UID`.
    by: String,
    /// Of which folder.
    from: String,
    /// What was said of who is let in: `revocations`, `as-backed-up`, `re-issue`, several of them, or nothing.
    identity: String,
    /// Tokens that ended.
    tokens: usize,
    /// Keys of robots that were taken out.
    keys: usize,
}

/// What such a file says. Their fields tell them apart.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
enum Word {
    Made(BackupNotice),
    Restored(RestoreNotice),
}

fn whoever_asks() -> String {
    format!("os:{}", rustix::process::getuid().as_raw())
}

/// Leaves the file for the server of `data` that a backup was made.
///
/// # Errors
/// The disk.
pub fn leave_note(data: &Path, summary: &Summary, to: &Path) -> anyhow::Result<()> {
    let Utc(begun_unix_ms) = summary.begun;
    let parts = summary.parts.iter().map(|(name, ..)| name.clone()).collect();
    let made = BackupNotice { by: whoever_asks(), to: to.display().to_string(), begun_unix_ms, parts };
    leave(data, &begun_unix_ms.to_string(), &Word::Made(made))
}

/// Leaves the file for the server of `data` that it was restored, and who is let in.
///
/// # Errors
/// The disk.
pub fn leave_restored(data: &Path, from: &Path, access: &Access, settled: &AccessOutcome) -> anyhow::Result<()> {
    let list = access.revocations.iter().map(|_| "revocations");
    let identity: Vec<&str> = list.chain(access.identity.map(super::Identity::as_str)).collect();
    let restored = RestoreNotice {
        by: whoever_asks(),
        from: from.display().to_string(),
        identity: identity.join(" "),
        tokens: settled.tokens,
        keys: settled.keys,
    };
    leave(data, "restored", &Word::Restored(restored))
}

fn leave(data: &Path, name: &str, word: &Word) -> anyhow::Result<()> {
    let folder = data.join(FOLDER);
    midshift_durable::make_folder(&folder).with_context(|| format!("making {}", folder.display()))?;
    let path = folder.join(format!("{name}-{:08x}.json", rand::random::<u32>()));
    midshift_durable::replace(&path, &serde_json::to_vec(word)?)
        .with_context(|| format!("writing {}", path.display()))?;
    // Whoever made the backup may be another user than the server; the data directory is closed to others.
    fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).with_context(|| format!("opening {}", path.display()))
}

/// Writes rows of backups that were made, until it is dropped.
pub async fn run(data: &Path, store: &dyn Store) {
    let (mut failing, mut written) = (false, BTreeSet::new());
    // Its own, so that it may take away what another user put there.
    if let Err(error) = midshift_durable::make_folder(&data.join(FOLDER)) {
        tracing::warn!(%error, "there is no folder for the word of backups");
    }
    loop {
        let taken = take_all(data, store, &mut written).await;
        if let (Err(error), false) = (&taken, failing) {
            tracing::warn!(error = format!("{error:#}"), "a backup that was made is not in the audit yet");
        }
        failing = taken.is_err();
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// The turn to write rows; none: another process has it, or there is nothing to write.
fn turn_of(folder: &Path) -> io::Result<Option<File>> {
    let file = OpenOptions::new().create(true).truncate(false).write(true).open(folder.join(TURN));
    let file = match file {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(error)) => Err(error),
    }
}

/// Writes a row for each file that lies there and is not among those `written`, and takes the file away; nothing while another process does.
///
/// # Errors
/// The disk or the store; what is left is done another time.
async fn take_all(data: &Path, store: &dyn Store, written: &mut BTreeSet<PathBuf>) -> anyhow::Result<()> {
    let Some(_turn) = turn_of(&data.join(FOLDER)).context("waiting for the turn to tell of backups")? else {
        return Ok(());
    };
    for path in super::files::entries(&data.join(FOLDER))? {
        if path.extension().is_none_or(|ending| ending != "json") {
            continue;
        }
        if !written.contains(&path) {
            match store.commit(vec![row(&path)]).await.pop() {
                Some(Err(error @ (CommitError::Unavailable(_) | CommitError::Unknown(_)))) => {
                    return Err(error).context("writing the row of a backup");
                }
                Some(Err(error)) => tracing::error!(%error, "a row of the audit was composed wrongly"),
                _ => {}
            }
            written.insert(path.clone());
        }
        fs::remove_file(&path).with_context(|| format!("removing {}", path.display()))?;
        written.remove(&path);
    }
    Ok(())
}

/// The row for a file.
fn row(path: &Path) -> Item {
    let (by, note) = match word(path) {
        Ok(Word::Made(BackupNotice { by, to, begun_unix_ms, parts })) => {
            let note = Note::new(MADE).with("to", to).with("parts", parts.join(" "));
            (by, note.with("begun_unix_ms", begun_unix_ms))
        }
        Ok(Word::Restored(RestoreNotice { by, from, identity, tokens, keys })) => {
            let note = Note::new(RESTORED).with("from", from).with("identity", identity);
            (by, note.with("tokens", tokens).with("keys", keys))
        }
        Err(error) => {
            tracing::warn!(error = format!("{error:#}"), path = %path.display(), "this is no word of a backup");
            ("os:unknown".to_owned(), Note::new(MADE).with("unreadable", true))
        }
    };
    let mut item = Item::new(Writer::Identity, &by);
    item.audit(note);
    item
}

fn word(path: &Path) -> anyhow::Result<Word> {
    let bytes = path.metadata()?.len();
    anyhow::ensure!(bytes <= BYTES_MAX, "it has {bytes} bytes");
    Ok(serde_json::from_slice(&fs::read(path)?)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::audit::AuditRow;
    use midshift_core::ids::SiteId;
    use midshift_core::rows::Table;
    use midshift_core::time::ScaledClock;
    use midshift_store::{MemoryStore, Query, StoreId};
    use std::sync::Arc;

    #[tokio::test]
    async fn a_backup_of_files_is_one_row_of_the_audit_once_a_server_has_the_folder() {
        let dir = tempfile::tempdir().expect("a folder");
        let clock = Arc::new(ScaledClock::new(|| 0, Utc(1_000_000), 1000));
        let store = MemoryStore::new(SiteId::parse("s").expect("a site"), StoreId("store-1".into()), clock);
        let mut written = BTreeSet::new();
        take_all(dir.path(), &store, &mut written).await.expect("nothing lies there");
        let parts = vec![("rows".to_owned(), 1, 2), ("stops".to_owned(), 1, 2)];
        let summary = Summary { site_id: "s".to_owned(), begun: Utc(5), parts };
        leave_note(dir.path(), &summary, Path::new("/mnt/backup")).expect("told");
        fs::write(dir.path().join(FOLDER).join("torn.json"), "{").expect("written");
        for _ in 0..2 {
            take_all(dir.path(), &store, &mut written).await.expect("written");
        }
        let rows = store.list(Query::all(Table::IdentityAudit)).await.expect("rows");
        let rows: Vec<AuditRow> = rows.iter().map(|row| serde_json::from_str(&row.body).expect("a row")).collect();
        assert_eq!(rows.len(), 2, "each once; what cannot be read is told too");
        let (row, with) = (&rows[0], |name: &str| rows[0].with.get(name).map(String::as_str));
        assert_eq!(
            (row.action.as_str(), with("to"), with("parts")),
            ("backup.make", Some("/mnt/backup"), Some("rows stops"))
        );
        assert_eq!((with("begun_unix_ms"), row.actor.starts_with("os:")), (Some("5"), true));
        let left = super::super::files::entries(&dir.path().join(FOLDER)).expect("a folder");
        assert_eq!(left, [dir.path().join(FOLDER).join(TURN)]);
        let access = Access { identity: Some(super::super::Identity::ReIssue), ..Access::default() };
        let settled = AccessOutcome { tokens: 3, keys: 0, secret: Some("mst.hush".to_owned()), is_orphaned: false };
        leave_restored(dir.path(), Path::new("/mnt/backup"), &access, &settled).expect("told");
        take_all(dir.path(), &store, &mut written).await.expect("written");
        let newest = store.list(Query::all(Table::IdentityAudit)).await.expect("rows").pop().expect("a row");
        let row: AuditRow = serde_json::from_str(&newest.body).expect("a row");
        let with = ["from", "identity", "tokens"].map(|name| row.with.get(name).map(String::as_str));
        assert_eq!((row.action.as_str(), with), ("backup.restore", [Some("/mnt/backup"), Some("re-issue"), Some("3")]));
        assert!(!newest.body.contains("hush"));
        // A file that cannot be taken away leaves no second row.
        fs::write(dir.path().join(FOLDER).join("stays.json"), "{}").expect("written");
        written.insert(dir.path().join(FOLDER).join("stays.json"));
        take_all(dir.path(), &store, &mut written).await.expect("taken away");
        assert_eq!(store.list(Query::all(Table::IdentityAudit)).await.expect("rows").len(), 3);
    }

    #[tokio::test]
    async fn of_two_processes_that_share_the_folder_one_writes_the_row_of_a_backup() {
        let dir = tempfile::tempdir().expect("a folder");
        let clock = Arc::new(ScaledClock::new(|| 0, Utc(1_000_000), 1000));
        let store = MemoryStore::new(SiteId::parse("s").expect("a site"), StoreId("store-1".into()), clock);
        let summary = Summary { site_id: "s".to_owned(), begun: Utc(5), parts: Vec::new() };
        leave_note(dir.path(), &summary, Path::new("/mnt/backup")).expect("told");
        let written = async || {
            take_all(dir.path(), &store, &mut BTreeSet::new()).await.expect("it looks");
            store.list(Query::all(Table::IdentityAudit)).await.expect("rows").len()
        };
        let turn = turn_of(&dir.path().join(FOLDER)).expect("a file").expect("nobody is at it");
        assert_eq!(written().await, 0, "the other one is at it");
        drop(turn);
        assert_eq!(written().await, 1, "the other one was killed");
        assert_eq!(written().await, 1);
    }
}
