//! Holds the clock of a start against the store, and takes a person's word for the clock of a running server.
//!
//! The word is a file in the data folder: whoever may write there is on the machine whose clock it is. Invariant: it counts for a doubt that stands when it is read, once in
//! each process that shares the folder. In one without a doubt it accepts nothing later.

use anyhow::Context;
use midshift_core::audit::Note;
use midshift_core::item::Item;
use midshift_core::rows::{Log, Seq, Table, Writer};
use midshift_core::time::{Clock, Now, Utc};
use midshift_core::wall_clock::ACCEPTED;
use midshift_store::{Error, Store};
use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::{Duration, SystemTime};

/// File of the data folder: the newest time that was in no doubt, unix ms.
const BELIEVED: &str = "clock-believed";
/// It is written anew when the clock is so far from it, milliseconds: much less than what puts a start in doubt.
const BELIEVED_EVERY_MS: u64 = 3_600_000;
/// What it is called in the audit.
const ACTION: &str = "clock.accept";
/// How often a server looks, real time.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Looks after which whoever read a word takes it away: by then each process that shares the folder has read it.
const LOOKS: u32 = 5;
/// Entries of the log that are looked at for the newest time of the store.
const ENTRIES: usize = 64;

/// Holds the clock of a start against the newest time that the store has, and that was in no doubt.
///
/// # Errors
/// The store, or a time that was kept and cannot be read.
pub async fn check_start(data: &Path, clock: &dyn Clock, store: &dyn Store) -> anyhow::Result<()> {
    let newest = newest_time(store).await.context("reading the newest time of the store")?;
    let before = believed(data)?;
    // What was written in doubt has the doubted time.
    if let Some(newest) = newest.map(|newest| before.map_or(newest, |before| before.min(newest))) {
        clock.check_start(newest);
    }
    if let Some(doubt) = clock.doubt() {
        let (ahead_s, newest) = (doubt.step_ms / 1_000, Utc(doubt.at.0.saturating_sub(doubt.step_ms)).rfc3339());
        tracing::error!(ahead_s, newest, "nothing is signed: the wall clock is far past what was written last");
    }
    keep_believed(data, clock, before);
    Ok(())
}

/// The newest time that was in no doubt, of a run before; none: there was none.
fn believed(data: &Path) -> anyhow::Result<Option<Utc>> {
    let path = data.join(BELIEVED);
    let reading = || format!("reading {}: if the clock of this machine is right, remove the file", path.display());
    match fs::read_to_string(&path) {
        Ok(text) => text.trim().parse().map(|ms| Some(Utc(ms))).with_context(reading),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(reading),
    }
}

/// Keeps the time for the next start while it is in no doubt, once it is far from what is `kept`. What is kept then.
fn keep_believed(data: &Path, clock: &dyn Clock, kept: Option<Utc>) -> Option<Utc> {
    let is_far = |now: &Now| kept.is_none_or(|kept| kept.0.abs_diff(now.wall.0) >= BELIEVED_EVERY_MS);
    let Some(now) = clock.undoubted().ok().filter(is_far) else { return kept };
    match midshift_durable::replace(&data.join(BELIEVED), now.wall.0.to_string().as_bytes()) {
        Ok(()) => Some(now.wall),
        Err(error) => {
            tracing::warn!(%error, file = BELIEVED, "the time is not kept for the next start; it is tried again in an hour");
            Some(now.wall)
        }
    }
}

/// None: nothing is in the log.
async fn newest_time(store: &dyn Store) -> Result<Option<Utc>, Error> {
    let head = store.snapshot(&[Table::OtaLeader]).await?.seq;
    let after = Seq(head.0.saturating_sub(ENTRIES as u64));
    let page = match store.feed(after, &Log::ALL, ENTRIES).await {
        Err(Error::CursorExpired { asked, oldest }) if asked < oldest => store.feed(oldest, &Log::ALL, ENTRIES).await?,
        page => page?,
    };
    Ok(page.entries.iter().map(|entry| Utc(entry.at_unix_ms)).max())
}

/// The word that a process read last, by its file, and how often it saw that file since.
#[derive(Default)]
struct Read {
    word: Option<(u64, SystemTime)>,
    looks: u32,
}

/// Takes words until it is dropped.
pub async fn run(data: &Path, clock: &dyn Clock, store: &dyn Store) {
    let (mut read, mut kept) = (Read::default(), None);
    loop {
        if let Err(error) = take_word(data, clock, store, &mut read).await {
            tracing::warn!(error = format!("{error:#}"), "a word about the clock was not taken: say it again");
        }
        kept = keep_believed(data, clock, kept);
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// Takes away what each process has read.
fn take_away(path: &Path, read: &mut Read) -> anyhow::Result<()> {
    read.looks += 1;
    if read.looks < LOOKS {
        return Ok(());
    }
    match fs::remove_file(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        removed => removed.with_context(|| format!("removing {}", path.display())),
    }
}

async fn take_word(data: &Path, clock: &dyn Clock, store: &dyn Store, read: &mut Read) -> anyhow::Result<()> {
    let path = data.join(ACCEPTED);
    let reading = || format!("reading {}", path.display());
    let word = match fs::metadata(&path) {
        Ok(file) => Some((file.ino(), file.modified().with_context(reading)?)),
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error).with_context(reading),
    };
    if read.word == word {
        return take_away(&path, read);
    }
    let by = fs::read_to_string(&path).with_context(reading)?;
    *read = Read { word, looks: 0 };
    let Some(doubt) = clock.doubt() else { return Ok(()) };
    let mut item = Item::new(Writer::Identity, &by);
    item.audit(Note::new(ACTION).with("step_ms", doubt.step_ms));
    if let Some(Err(error)) = store.commit(vec![item]).await.pop() {
        return Err(error).context("writing the row of the audit");
    }
    clock.accept_wall();
    tracing::warn!(by, step_ms = doubt.step_ms, "a person says that the wall clock is right");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_cli::clock::leave_word;
    use midshift_core::audit::AuditRow;
    use midshift_core::ids::SiteId;
    use midshift_core::item::Fact;
    use midshift_core::wall_clock::WallClock;
    use midshift_store::{MemoryStore, Query, StoreId};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

    const DAY_MS: i64 = 24 * 3_600_000;

    /// A clock whose wall says what a test sets, and a store by it.
    fn site() -> (Arc<AtomicI64>, Arc<dyn Clock>, MemoryStore) {
        let wall = Arc::new(AtomicI64::new(1_800_000_000_000));
        let said = wall.clone();
        let clock: Arc<dyn Clock> = Arc::new(WallClock::new(|| 0, move || Utc(said.load(Relaxed)), |_| {}));
        let store = MemoryStore::new(SiteId::parse("s").expect("a site"), StoreId("store-1".into()), clock.clone());
        (wall, clock, store)
    }

    async fn write(store: &MemoryStore) {
        let mut item = Item::new(Writer::Identity, "test");
        let (subject, kind, body) = (Arc::from("s"), "test.wrote", Arc::from("{}"));
        item.facts.push(Fact { log: Log::Identity, subject, kind, body });
        store.commit(vec![item]).await.pop().expect("a result").expect("committed");
    }

    async fn accepted(store: &MemoryStore) -> usize {
        let rows = store.list(Query::all(Table::IdentityAudit)).await.expect("rows");
        let rows = rows.iter().map(|row| serde_json::from_str::<AuditRow>(&row.body).expect("a row"));
        rows.filter(|row| row.action == ACTION && row.with.contains_key("step_ms")).count()
    }

    #[tokio::test]
    async fn a_start_is_held_against_the_newest_entry_of_the_store() {
        let dir = tempfile::tempdir().expect("a folder");
        let (wall, clock, store) = site();
        check_start(dir.path(), &*clock, &store).await.expect("an empty store says nothing");
        for _ in 0..2 * ENTRIES {
            write(&store).await;
        }
        for (days, is_doubted) in [(7, false), (8, true)] {
            let begun = Utc(wall.load(Relaxed) + days * DAY_MS);
            let next = WallClock::new(|| 0, move || begun, |_| {});
            check_start(dir.path(), &next, &store).await.expect("read");
            assert_eq!(next.doubt().is_some(), is_doubted, "{days} days");
        }
    }

    /// The next run of the server, by the wall of this moment.
    async fn started(data: &Path, wall: &AtomicI64, store: &MemoryStore) -> Arc<dyn Clock> {
        let begun = Utc(wall.load(Relaxed));
        let next: Arc<dyn Clock> = Arc::new(WallClock::new(|| 0, move || begun, |_| {}));
        check_start(data, &*next, store).await.expect("read");
        next
    }

    #[tokio::test]
    async fn a_restart_right_behind_a_jump_is_in_doubt_though_entries_were_written_meanwhile() {
        let dir = tempfile::tempdir().expect("a folder");
        let (wall, clock, store) = site();
        write(&store).await;
        check_start(dir.path(), &*clock, &store).await.expect("it starts");
        wall.fetch_add(30 * DAY_MS, Relaxed);
        write(&store).await;
        // Nobody has looked at the clock since, and the process is killed; so is the next one.
        for _ in 0..2 {
            assert!(started(dir.path(), &wall, &store).await.doubt().is_some());
            write(&store).await;
        }
        wall.fetch_sub(30 * DAY_MS, Relaxed);
        assert_eq!(started(dir.path(), &wall, &store).await.doubt(), None, "the wall is right again");
    }

    #[tokio::test]
    async fn a_wall_that_was_believed_is_believed_by_the_next_start() {
        let dir = tempfile::tempdir().expect("a folder");
        let (wall, clock, store) = site();
        write(&store).await;
        let mut kept = keep_believed(dir.path(), &*clock, None);
        for _ in 0..2 {
            wall.fetch_add(30 * DAY_MS, Relaxed);
            write(&store).await;
            kept = keep_believed(dir.path(), &*clock, kept);
            assert!(started(dir.path(), &wall, &store).await.doubt().is_some(), "nobody has said that it is right");
            clock.accept_wall();
            kept = keep_believed(dir.path(), &*clock, kept);
            assert_eq!(started(dir.path(), &wall, &store).await.doubt(), None);
        }
        assert_eq!(keep_believed(dir.path(), &*clock, kept), kept);
    }

    #[tokio::test]
    async fn a_time_that_cannot_be_read_is_an_error_and_not_absent() {
        let dir = tempfile::tempdir().expect("a folder");
        let (_, clock, store) = site();
        fs::write(dir.path().join(BELIEVED), "soon").expect("written");
        let error = check_start(dir.path(), &*clock, &store).await.expect_err("refused");
        assert!(format!("{error:#}").contains(BELIEVED), "{error:#}");
    }

    #[tokio::test]
    async fn a_persons_word_counts_for_the_doubt_that_stands_and_leaves_a_row() {
        let dir = tempfile::tempdir().expect("a folder");
        let (wall, clock, store) = site();
        let mut read = Read::default();
        leave_word(dir.path()).expect("said");
        take_word(dir.path(), &*clock, &store, &mut read).await.expect("read");
        wall.fetch_add(30 * DAY_MS, Relaxed);
        take_word(dir.path(), &*clock, &store, &mut read).await.expect("it was read before");
        assert!(clock.doubt().is_some(), "what was said before accepts nothing");
        assert_eq!(accepted(&store).await, 0);
        leave_word(dir.path()).expect("said");
        take_word(dir.path(), &*clock, &store, &mut read).await.expect("taken");
        assert_eq!((clock.doubt(), accepted(&store).await), (None, 1));
        for _ in 0..LOOKS {
            take_word(dir.path(), &*clock, &store, &mut read).await.expect("looked");
        }
        assert_eq!(fs::read_dir(dir.path()).expect("a folder").count(), 0);
    }

    #[tokio::test]
    async fn a_word_reaches_each_process_that_shares_the_folder() {
        let dir = tempfile::tempdir().expect("a folder");
        let (wall, first, store) = site();
        let said = wall.clone();
        let second = WallClock::new(|| 0, move || Utc(said.load(Relaxed)), |_| {});
        assert_eq!((first.doubt(), second.doubt()), (None, None));
        wall.fetch_add(30 * DAY_MS, Relaxed);
        assert!(first.doubt().is_some() && second.doubt().is_some());
        leave_word(dir.path()).expect("said");
        let (mut read, mut other) = (Read::default(), Read::default());
        take_word(dir.path(), &*first, &store, &mut read).await.expect("taken");
        take_word(dir.path(), &second, &store, &mut other).await.expect("taken");
        assert_eq!((first.doubt(), second.doubt(), accepted(&store).await), (None, None, 2));
    }
}
