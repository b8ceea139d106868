//! Every change of tasks in commit order, resumable by cursor without loss.
//!
//! Invariant: a change carries the task as it was right after it, not as it is now, and no task goes backwards; a slow watcher holds up
//! nobody: each reads the feed for itself, at its own pace.

use crate::TaskService;
use crate::grpc::CallId;
use crate::rows::{read_many, robot_kept, sees, unavailable};
use crate::search::{Direction, Search};
use crate::watch_state::{Image, WatchState};
use midshift_core::fleet::requests::allowed_resolutions;
use midshift_core::identity::Caller;
use midshift_core::ids::TaskId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Entry, Log, Revision, Seq, Table};
use midshift_core::task::{Phase, TaskState};
use midshift_core::time::Utc;
use midshift_proto::convert::task::{TaskFilter, TaskView, encode_task};
use midshift_proto::convert::timestamp;
use midshift_proto::task::v1::{self, watch_tasks_response::Item};
use midshift_proto::watches::{Gone, Teller};
use midshift_store::Error;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// A watcher hears from us at least this often.
const BOOKMARK_EVERY: Duration = Duration::from_secs(15);

/// One watcher.
pub struct Watcher {
    service: TaskService,
    filter: TaskFilter,
    /// Who watches: it is told of nothing that it may not see.
    by: Caller,
    teller: Arc<Teller<v1::WatchTasksResponse>>,
    /// Begins with the tasks as they are.
    from_now: bool,
    after: Seq,
    watch_state: WatchState,
    /// Revisions in which existing tasks were shown, until `after` has passed `shown_until`.
    shown: BTreeMap<TaskId, Revision>,
    shown_until: Seq,
    /// Tasks that were told and have not ended: one that leaves the filter is told once more.
    near: BTreeSet<TaskId>,
    said: Instant,
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

impl From<Gone> for Stop {
    fn from(_: Gone) -> Self {
        Self::Gone
    }
}

impl TaskService {
    /// A watcher at `cursor`, or at the beginning of now.
    pub fn watcher(
        &self,
        r: v1::WatchTasksRequest,
        by: Caller,
        teller: Teller<v1::WatchTasksResponse>,
    ) -> Result<Watcher, Refusal> {
        let filter: TaskFilter = midshift_proto::parse_field(Some(r.filter.unwrap_or_default()), "filter")?;
        let after = self.position(&r.cursor)?;
        Ok(Watcher {
            service: self.clone(),
            filter,
            by,
            teller: Arc::new(teller),
            from_now: r.cursor.is_empty(),
            after,
            watch_state: WatchState::default(),
            shown: BTreeMap::new(),
            shown_until: Seq(0),
            near: BTreeSet::new(),
            said: Instant::now(),
        })
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
    pub async fn run(mut self, id: CallId) {
        let (shutdown, teller) = (self.service.inner.shutdown.clone(), self.teller.clone());
        let stop = tokio::select! {
            () = shutdown.cancelled() => Err(Refusal::new(Kind::Unavailable, Code::ShuttingDown).into()),
            // One that waits for changes which its filter keeps away would not notice that nobody listens.
            () = teller.gone() => Err(Stop::Gone),
            stop = self.follow() => stop,
        };
        if let Err(Stop::Refused(refusal)) = stop {
            teller.end(id.status(&refusal));
        }
    }

    async fn follow(&mut self) -> Result<(), Stop> {
        let mut wake = self.service.store().wake();
        if self.from_now {
            self.existing().await?;
            self.bookmark().await?;
        }
        loop {
            wake.mark_unchanged();
            self.changes().await?;
            // A busy store wakes without end: the bookmark is due by what was said, not by how long it was quiet.
            let due = self.said + BOOKMARK_EVERY;
            if Instant::now() >= due {
                self.bookmark().await?;
                continue;
            }
            if let Ok(Err(_)) = tokio::time::timeout_at(due, wake.changed()).await {
                return Ok(());
            }
        }
    }

    async fn head(&self) -> Result<Seq, Refusal> {
        Ok(self.service.store().snapshot(&[Table::FleetMark]).await.map_err(unavailable)?.seq)
    }

    /// The matching tasks as they are, as [`begins_with`] says. The cursor is taken first, so that no change is lost between them; what a task already
    /// showed of the changes after it is not said again.
    async fn existing(&mut self) -> Result<(), Stop> {
        let store = self.service.inner.parts.store.clone();
        self.after = self.head().await?;
        let begin = begins_with(&self.filter);
        let mut search = Search::new(&begin, Direction::OldestFirst, None, limits::WATCH_PAGE);
        loop {
            let rows = search.next(store.as_ref()).await.map_err(unavailable)?;
            if rows.is_empty() {
                break;
            }
            let found = search.find_candidates(store.as_ref(), &rows).await.map_err(unavailable)?;
            for task in read_many(store.as_ref(), &found).await? {
                let is_seen = sees(&self.service.inner.parts.site, &self.by, &task.intake);
                if is_seen && begin.admits(&task.intake, &task.state) {
                    self.shown.insert(task.state.task_id.clone(), task.revision);
                    self.keep_near(&task.state, true);
                    self.teller.asked().await?;
                    self.tell_item(Item::Existing(task.encode()), None);
                }
            }
        }
        self.shown_until = self.head().await?;
        Ok(())
    }

    async fn changes(&mut self) -> Result<(), Stop> {
        let store = self.service.inner.parts.store.clone();
        loop {
            let page = match store.feed(self.after, &[Log::Task, Log::Fleet], limits::WATCH_PAGE).await {
                Err(Error::CursorExpired { .. }) => {
                    return Err(Refusal::new(Kind::Precondition, Code::CursorExpired).into());
                }
                page => page.map_err(unavailable)?,
            };
            self.watch_state.learn(store.as_ref(), &page.entries, self.after).await.map_err(unavailable)?;
            for entry in &page.entries {
                self.change(entry).await?;
            }
            self.after = page.next;
            if page.next >= page.head {
                if self.after >= self.shown_until {
                    self.shown.clear();
                }
                return Ok(());
            }
        }
    }

    async fn change(&mut self, entry: &Entry) -> Result<(), Stop> {
        let Image { intake, state, attempt } = match self.watch_state.absorb(entry) {
            Ok(Some(image)) => image,
            Ok(None) => return Ok(()),
            Err(error) => {
                tracing::error!(%error, seq = entry.seq.0, "a watcher passed over a row it cannot read");
                return Ok(());
            }
        };
        let said = self.shown.get(&state.task_id).is_some_and(|shown| entry.revision <= *shown);
        let admitted = self.filter.admits(intake, &state);
        let leaves = !admitted && self.near.contains(&state.task_id);
        let is_seen = sees(&self.service.inner.parts.site, &self.by, intake);
        if said || !(admitted || leaves) || !is_seen {
            return Ok(());
        }
        self.teller.asked().await?;
        // What may be answered is about now: the robot's row as it is.
        let asks = state.phase == Phase::NeedsOperator && state.opened_robot_id.is_some();
        let kept = asks && robot_kept(self.service.store(), &state).await.map_err(unavailable)?;
        let allowed = allowed_resolutions(state.phase, state.opened_robot_id.is_some(), kept);
        let task =
            encode_task(TaskView { intake, state: &state, revision: entry.revision, attempt, allowed: &allowed });
        self.keep_near(&state, admitted);
        let change = v1::TaskChange {
            task: Some(task),
            kind: entry.kind.to_string(),
            actor: entry.actor.to_string(),
            change_time: Some(timestamp(Utc(entry.at_unix_ms))),
        };
        self.tell_item(Item::Change(change), Some(entry.seq));
        Ok(())
    }

    fn keep_near(&mut self, state: &TaskState, admitted: bool) {
        if admitted && !state.phase.is_terminal() {
            self.near.insert(state.task_id.clone());
        } else {
            self.near.remove(&state.task_id);
        }
    }

    async fn bookmark(&mut self) -> Result<(), Stop> {
        self.teller.asked().await?;
        self.tell_item(Item::Bookmark(v1::Bookmark {}), Some(self.after));
        Ok(())
    }

    fn tell_item(&mut self, item: Item, seq: Option<Seq>) {
        let cursor = seq.map(|seq| format!("{}:{}", self.service.store().id(), seq.0)).unwrap_or_default();
        let message = v1::WatchTasksResponse { item: Some(item), cursor };
        self.teller.tell_message(message);
        self.said = Instant::now();
    }
}

/// Which tasks a watch begins with: what is over is told only where tasks or states are named, so that a beginning costs what is alive.
fn begins_with(filter: &TaskFilter) -> TaskFilter {
    let mut begin = filter.clone();
    if begin.phases.is_empty() && begin.task_ids.is_empty() && begin.task_id_prefix.is_empty() {
        begin.phases = Phase::ALL.into_iter().filter(|phase| !phase.is_terminal()).collect();
    }
    begin
}
