//! What a watcher knows of tasks beside their changes: what was asked for, and each attempt as it was at the watcher's place in the feed.
//!
//! Invariant: an attempt here is as it was right after the last entry taken, however far the rows have gone on since.

use midshift_core::ids::{AttemptId, TaskId};
use midshift_core::rows::{BadRow, Entry, Key, Record, Row, Seq, Table};
use midshift_core::task::{Attempt, TaskIntake, TaskState};
use midshift_store::{Error, FEED_PAGE_MAX, Store, Subjects};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Intakes and attempts remembered by one watcher; beyond it all are forgotten and read again as they are needed.
const REMEMBERED: usize = 4_096;
/// Attempts whose past is read in one call.
const PASTS: usize = 256;

/// Intakes and attempts.
#[derive(Default)]
pub struct WatchState {
    intakes: BTreeMap<TaskId, TaskIntake>,
    attempts: BTreeMap<AttemptId, Attempt>,
}

/// A task right after a change of it.
pub struct Image<'a> {
    /// What was asked for.
    pub intake: &'a TaskIntake,
    /// Where it was.
    pub state: TaskState,
    /// Its newest attempt at that moment.
    pub attempt: Option<&'a Attempt>,
}

/// The row after a change; none if it is of another table or was deleted.
pub fn read<R: Record>(entry: &Entry) -> Result<Option<R>, BadRow> {
    let Some(body) = entry.body.clone().filter(|_| entry.table == Some(R::TABLE)) else { return Ok(None) };
    let key = Key { table: R::TABLE, id: entry.subject.clone() };
    Row { key, revision: entry.revision, index: entry.index.clone(), body }.decode().map(Some)
}

impl WatchState {
    /// Gets to know the tasks and attempts of a stretch of the feed, as they were right after `place`, where the stretch begins.
    pub async fn learn(&mut self, store: &dyn Store, entries: &[Entry], place: Seq) -> Result<(), Error> {
        if self.intakes.len() > REMEMBERED || self.attempts.len() > REMEMBERED {
            *self = Self::default();
        }
        let (mut tasks, mut attempts, mut born) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
        for entry in entries {
            if entry.table == Some(Table::Attempt) {
                born.insert(entry.subject.clone());
            }
            // A row that cannot be read is said once, by whoever takes its entry.
            let Ok(Some(state)) = read::<TaskState>(entry) else { continue };
            // An attempt whose entry came before on this stretch needs no past.
            let attempt = state.attempt_id().filter(|a| !self.attempts.contains_key(a));
            attempts.extend(attempt.map(|a| Arc::<str>::from(a.to_string())).filter(|id| !born.contains(id)));
            if !self.intakes.contains_key(&state.task_id) {
                tasks.insert(Key::new(Table::TaskIntake, state.task_id.as_str()));
            }
        }
        for row in store.get(tasks.into_iter().collect()).await? {
            let intake: TaskIntake = row.decode()?;
            self.intakes.insert(intake.task_id.clone(), intake);
        }
        let attempts: Vec<Arc<str>> = attempts.into_iter().collect();
        for some in attempts.chunks(PASTS) {
            self.past(store, some, place).await?;
        }
        Ok(())
    }

    /// Reads attempts as they were right after `place`: the last entry up to there, or the row if it has not changed since.
    async fn past(&mut self, store: &dyn Store, ids: &[Arc<str>], place: Seq) -> Result<(), Error> {
        // The rows first: one that no later entry is about was the same at `place`.
        let rows = store.get(ids.iter().map(|id| Key::new(Table::Attempt, id)).collect()).await?;
        let mut changed = BTreeSet::new();
        let mut after = Seq(0);
        loop {
            let page = match store.feed_of(Subjects::Attempts(ids), after, FEED_PAGE_MAX).await {
                Err(Error::CursorExpired { asked, oldest }) if asked < oldest => {
                    after = oldest;
                    continue;
                }
                page => page?,
            };
            for entry in &page.entries {
                changed.insert(entry.subject.clone());
                if entry.seq <= place
                    && let Some(attempt) = read::<Attempt>(entry)?
                {
                    self.attempts.insert(attempt.attempt.clone(), attempt);
                }
            }
            after = page.next;
            if page.next >= page.head {
                break;
            }
        }
        for row in rows.iter().filter(|row| !changed.contains(&row.key.id)) {
            let attempt: Attempt = row.decode()?;
            self.attempts.insert(attempt.attempt.clone(), attempt);
        }
        Ok(())
    }

    /// Takes one entry; if it changed a task, that task with its attempt as this change left both. In an item of fleet the attempt
    /// comes first.
    pub fn absorb(&mut self, entry: &Entry) -> Result<Option<Image<'_>>, BadRow> {
        if let Some(attempt) = read::<Attempt>(entry)? {
            if attempt.attempt.subject.task_id().is_some() {
                self.attempts.insert(attempt.attempt.clone(), attempt);
            }
            return Ok(None);
        }
        let Some(state) = read::<TaskState>(entry)? else { return Ok(None) };
        let attempt = state.attempt_id().and_then(|id| self.attempts.get(&id));
        Ok(self.intakes.get(&state.task_id).map(|intake| Image { intake, state, attempt }))
    }
}
