//! Every change of tasks in commit order, resumable by cursor without loss.
//!
//! Invariant: a change carries the task as it was right after it, not as it is now; a slow watcher holds up nobody.

use crate::TaskService;
use crate::rows::{read_many, unavailable};
use midshift_core::ids::TaskId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Entry, Key, Log, Seq, Table};
use midshift_core::task::{Attempt, TaskIntake, TaskState};
use midshift_core::time::Utc;
use midshift_proto::convert::task::{TaskFilter, TaskView, encode_task};
use midshift_proto::convert::timestamp;
use midshift_proto::task::v1::{self, watch_tasks_response::Item};
use midshift_store::{Cursor, Error, Query};
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::sync::mpsc;
use tonic::Status;

/// A watcher hears from us at least this often.
const BOOKMARK_EVERY: Duration = Duration::from_secs(15);
/// Entries read at a time.
const PAGE: usize = 500;
/// Intakes and attempts remembered by one watcher.
const REMEMBERED: usize = 4_096;

/// Where messages go.
pub type Sender = mpsc::Sender<Result<v1::WatchTasksResponse, Status>>;

/// One watcher.
pub struct Watcher {
    service: TaskService,
    filter: TaskFilter,
    sender: Sender,
    after: Seq,
    intakes: BTreeMap<TaskId, TaskIntake>,
    attempts: BTreeMap<TaskId, Attempt>,
}

enum Stop {
    Gone,
    Refused(Refusal),
}

impl From<Refusal> for Stop {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl TaskService {
    /// A watcher at `cursor`, or at the beginning of now.
    pub fn watcher(&self, r: v1::WatchTasksRequest, sender: Sender) -> Result<(Watcher, bool), Refusal> {
        let filter: TaskFilter = midshift_proto::parse_field(Some(r.filter.unwrap_or_default()), "filter")?;
        let after = self.position(&r.cursor)?;
        let watcher = Watcher {
            service: self.clone(),
            filter,
            sender,
            after,
            intakes: BTreeMap::new(),
            attempts: BTreeMap::new(),
        };
        Ok((watcher, r.cursor.is_empty()))
    }

    fn position(&self, cursor: &str) -> Result<Seq, Refusal> {
        if cursor.is_empty() {
            return Ok(Seq(0));
        }
        let bad = || Refusal::field("cursor", "is not a cursor");
        let (store, seq) = cursor.rsplit_once(':').ok_or_else(bad)?;
        let seq = seq.parse().map_err(|_| bad())?;
        if store != self.inner.parts.store.id().to_string() {
            return Err(Refusal::new(Kind::Precondition, Code::CursorOfOtherStore));
        }
        Ok(Seq(seq))
    }
}

impl Watcher {
    /// Runs until the watcher is gone, the service stops, or the cursor cannot be served.
    pub async fn run(mut self, from_now: bool) {
        let shutdown = self.service.inner.shutdown.clone();
        let sender = self.sender.clone();
        tokio::select! {
            () = shutdown.cancelled() => {
                let refusal = Refusal::new(Kind::Unavailable, Code::ShuttingDown);
                let _ = sender.try_send(Err(midshift_proto::status(&refusal, None)));
            }
            stop = self.follow(from_now) => {
                if let Err(Stop::Refused(refusal)) = stop {
                    let _ = sender.send(Err(midshift_proto::status(&refusal, None))).await;
                }
            }
        }
    }

    async fn follow(&mut self, from_now: bool) -> Result<(), Stop> {
        let mut wake = self.service.inner.parts.store.wake();
        if from_now {
            self.existing().await?;
            self.bookmark().await?;
        }
        loop {
            wake.mark_unchanged();
            self.changes().await?;
            match tokio::time::timeout(BOOKMARK_EVERY, wake.changed()).await {
                Ok(Ok(())) => {}
                Ok(Err(_)) => return Ok(()),
                Err(_) => self.bookmark().await?,
            }
        }
    }

    /// The matching tasks as they are. The cursor is taken first, so that no change is lost between them.
    async fn existing(&mut self) -> Result<(), Stop> {
        let store = self.service.inner.parts.store.clone();
        self.after = store.snapshot(&[Table::FleetMark]).await.map_err(unavailable)?.seq;
        let mut after: Option<Cursor> = None;
        loop {
            let states = self.filter.phases.iter().map(|p| p.number());
            let query = Query { after, limit: limits::PAGE_MAX, ..Query::all(Table::TaskState).in_states(states) };
            let rows = store.list(query).await.map_err(unavailable)?;
            let Some(last) = rows.last() else { return Ok(()) };
            after = Some(Cursor::of(last));
            let ids: Vec<TaskId> = rows.iter().filter_map(|r| TaskId::parse(&r.key.id).ok()).collect();
            for task in read_many(store.as_ref(), &ids).await? {
                if self.filter.admits(&task.intake, &task.state) {
                    self.send(Item::Existing(task.encode()), None).await?;
                }
            }
        }
    }

    async fn changes(&mut self) -> Result<(), Stop> {
        let store = self.service.inner.parts.store.clone();
        loop {
            let page = match store.feed(self.after, &[Log::Task, Log::Fleet], PAGE).await {
                Err(Error::CursorExpired { .. }) => {
                    return Err(Refusal::new(Kind::Precondition, Code::CursorExpired).into());
                }
                page => page.map_err(unavailable)?,
            };
            self.learn(&page.entries).await?;
            for entry in &page.entries {
                self.change(entry).await?;
            }
            self.after = page.next;
            if page.next >= page.head {
                return Ok(());
            }
        }
    }

    /// Reads what was asked for of the tasks on this page that are not known yet.
    async fn learn(&mut self, entries: &[Entry]) -> Result<(), Stop> {
        if self.intakes.len() > REMEMBERED || self.attempts.len() > REMEMBERED {
            self.intakes.clear();
            self.attempts.clear();
        }
        let states = entries.iter().filter(|e| e.table == Some(Table::TaskState));
        let ids: std::collections::BTreeSet<TaskId> = states.filter_map(|e| TaskId::parse(&e.subject).ok()).collect();
        let unknown: Vec<Key> = ids
            .iter()
            .filter(|id| !self.intakes.contains_key(id))
            .map(|id| Key::new(Table::TaskIntake, id.as_str()))
            .collect();
        if unknown.is_empty() {
            return Ok(());
        }
        for row in self.service.inner.parts.store.get(unknown).await.map_err(unavailable)? {
            let intake: TaskIntake = row.decode().map_err(unavailable)?;
            self.intakes.insert(intake.task_id.clone(), intake);
        }
        Ok(())
    }

    async fn change(&mut self, entry: &Entry) -> Result<(), Stop> {
        let Some(body) = &entry.body else { return Ok(()) };
        if entry.table == Some(Table::Attempt)
            && let Ok(attempt) = serde_json::from_str::<Attempt>(body)
            && let Some(task_id) = attempt.attempt.subject.task_id()
        {
            self.attempts.insert(task_id.clone(), attempt);
            return Ok(());
        }
        if entry.table != Some(Table::TaskState) {
            return Ok(());
        }
        let Ok(state) = serde_json::from_str::<TaskState>(body) else { return Ok(()) };
        let Some(intake) = self.intakes.get(&state.task_id) else { return Ok(()) };
        if !self.filter.admits(intake, &state) {
            return Ok(());
        }
        let attempt = self.attempts.get(&state.task_id).filter(|a| Some(&a.attempt) == state.attempt_id().as_ref());
        let allowed = midshift_core::fleet::requests::allowed_resolutions(state.phase, state.opened.is_some(), false);
        let view = TaskView { intake, state: &state, revision: entry.revision, attempt, allowed: &allowed };
        let change = v1::TaskChange {
            task: Some(encode_task(view)),
            kind: entry.kind.to_string(),
            actor: entry.actor.to_string(),
            change_time: Some(timestamp(Utc(entry.at_unix_ms))),
        };
        self.send(Item::Change(change), Some(entry.seq)).await
    }

    async fn bookmark(&mut self) -> Result<(), Stop> {
        self.send(Item::Bookmark(v1::Bookmark {}), Some(self.after)).await
    }

    async fn send(&self, item: Item, seq: Option<Seq>) -> Result<(), Stop> {
        let cursor = seq.map(|seq| format!("{}:{}", self.service.inner.parts.store.id(), seq.0)).unwrap_or_default();
        let message = v1::WatchTasksResponse { item: Some(item), cursor };
        self.sender.send(Ok(message)).await.map_err(|_| Stop::Gone)
    }
}
