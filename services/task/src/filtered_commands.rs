//! Cancel and resolve for every task that a filter admits: one request a task, each with its own rights, as if a person had asked for each.
//!
//! Invariant: a task is asked for at most once a call, and what is counted as asked is durable.

use crate::TaskService;
use crate::commands::{PendingCommand, hash, reason_text, request_id};
use crate::rows::{TaskRows, read_many, sees, unavailable};
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{RequestId, TaskId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::{Seq, Table};
use midshift_core::task::{Ask, Phase, Resolution};
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::task::TaskFilter;
use midshift_proto::task::v1;
use midshift_store::{CommitError, Cursor, Query};
use std::collections::BTreeMap;

/// What is asked of each task.
struct Bulk {
    filter: TaskFilter,
    request_id: Option<RequestId>,
    hash: String,
    reason: String,
    permission: Permission,
    wish: Wish,
    validate_only: bool,
    after: Option<Cursor>,
}

#[derive(Clone, Copy)]
enum Wish {
    Cancel { force: bool },
    Resolve(Resolution),
}

impl Wish {
    /// Whether tasks of this phase are meant.
    const fn means(self, phase: Phase) -> bool {
        match self {
            Self::Cancel { .. } => !phase.is_terminal(),
            Self::Resolve(_) => matches!(phase, Phase::NeedsOperator),
        }
    }
    fn to_ask(self, task: &TaskRows) -> Ask {
        let task_id = task.state.task_id.clone();
        match self {
            Self::Cancel { force } => Ask::Cancel { task_id, force },
            Self::Resolve(resolution) => Ask::Resolve { task_id, resolution },
        }
    }
    fn fits(self, task: &TaskRows) -> Result<(), Refusal> {
        match self {
            Self::Resolve(resolution) if !task.allowed.contains(&resolution) => {
                let reason = Reason::from(Code::ResolutionNotAllowed).with("state", task.state.phase.as_str());
                Err(Refusal::new(Kind::Precondition, reason.with("task_id", &task.state.task_id)))
            }
            _ => Ok(()),
        }
    }
}

/// What became of it so far.
#[derive(Default)]
struct Count {
    matched: u32,
    asked: u32,
    refused: BTreeMap<String, u32>,
    /// Entry of the last request that was written.
    place: Seq,
    /// Where the next call goes on.
    next: Option<Cursor>,
}

impl Count {
    fn refuse(&mut self, refusal: &Refusal) {
        *self.refused.entry(refusal.reason.code.as_str().to_owned()).or_default() += 1;
    }
    fn encode(self, pending: bool) -> v1::BulkOutcome {
        let refused = self.refused.into_iter().collect();
        let next_page_token = self.next.map(|next| format!("{}:{}", next.order, next.id)).unwrap_or_default();
        v1::BulkOutcome { matched: self.matched, asked: self.asked, refused, pending, next_page_token }
    }
}

/// Beginning of the request ids of all tasks, with room for the longest task id after it.
fn shared_id(text: &str, bad: &mut Violations) -> Option<RequestId> {
    if text.len() > 63 {
        bad.add("request_id", "must be at most 63 bytes: the id of each task follows it");
    }
    request_id(text, bad)
}

/// Where a call goes on; none: at the beginning.
fn cursor_of(token: &str, bad: &mut Violations) -> Option<Cursor> {
    let read = || {
        let (order, id) = token.split_once(':')?;
        Some(Cursor { order: order.parse().ok()?, id: id.into() })
    };
    let cursor = read();
    if cursor.is_none() && !token.is_empty() {
        bad.add("page_token", "is not a token of an outcome");
    }
    cursor
}

/// A filter that a caller has forgotten, or that only a newer version can read, does not mean every task.
fn check_filter(filter: Option<&v1::TaskFilter>, all: bool, bad: &mut Violations) {
    if !all && filter.is_none_or(|filter| *filter == v1::TaskFilter::default()) {
        bad.add("filter", "says nothing: set all to mean every task");
    }
}

impl TaskService {
    /// Asks for the end of all tasks that are meant.
    pub async fn cancel_many(
        &self,
        r: v1::CancelTasksRequest,
        by: &Caller,
    ) -> Result<v1::CancelTasksResponse, Refusal> {
        let mut bad = Violations::default();
        reason_text(&r.reason, &mut bad);
        let request_id = shared_id(&r.request_id, &mut bad);
        let after = cursor_of(&r.page_token, &mut bad);
        check_filter(r.filter.as_ref(), r.all, &mut bad);
        bad.finish()?;
        let same = v1::CancelTasksRequest {
            request_id: String::new(),
            page_token: String::new(),
            validate_only: false,
            ..r.clone()
        };
        let hash = hash("cancel_many", &same);
        let filter = midshift_proto::parse_field(Some(r.filter.unwrap_or_default()), "filter")?;
        let wish = Wish::Cancel { force: r.force };
        let (permission, reason, validate_only) = (Permission::Dispatch, r.reason, r.validate_only);
        let bulk = Bulk { filter, request_id, hash, reason, permission, wish, validate_only, after };
        Ok(v1::CancelTasksResponse { outcome: Some(self.ask_each(bulk, by).await?) })
    }

    /// A person's answer for all tasks that are meant.
    pub async fn resolve_many(
        &self,
        r: v1::ResolveTasksRequest,
        by: &Caller,
    ) -> Result<v1::ResolveTasksResponse, Refusal> {
        let mut bad = Violations::default();
        reason_text(&r.reason, &mut bad);
        let request_id = shared_id(&r.request_id, &mut bad);
        let after = cursor_of(&r.page_token, &mut bad);
        check_filter(r.filter.as_ref(), r.all, &mut bad);
        let resolution = Resolution::from_wire(r.resolution);
        if resolution.is_none() {
            bad.add("resolution", "is required");
        }
        bad.finish()?;
        let Some(resolution) = resolution else { return Err(crate::commands::internal()) };
        let same = v1::ResolveTasksRequest {
            request_id: String::new(),
            page_token: String::new(),
            validate_only: false,
            ..r.clone()
        };
        let hash = hash("resolve_many", &same);
        let filter = midshift_proto::parse_field(Some(r.filter.unwrap_or_default()), "filter")?;
        let wish = Wish::Resolve(resolution);
        let (permission, reason, validate_only) = (Permission::Operate, r.reason, r.validate_only);
        let bulk = Bulk { filter, request_id, hash, reason, permission, wish, validate_only, after };
        Ok(v1::ResolveTasksResponse { outcome: Some(self.ask_each(bulk, by).await?) })
    }

    async fn ask_each(&self, bulk: Bulk, by: &Caller) -> Result<v1::BulkOutcome, Refusal> {
        let mut count = Count::default();
        let phases = Phase::ALL.iter().copied().filter(|phase| {
            bulk.wish.means(*phase) && (bulk.filter.phases.is_empty() || bulk.filter.phases.contains(phase))
        });
        let phases: Vec<i64> = phases.map(Phase::number).collect();
        let mut after = bulk.after.clone();
        while !phases.is_empty() {
            let query =
                Query { after, limit: limits::PAGE_MAX, ..Query::all(Table::TaskState).in_states(phases.clone()) };
            let rows = self.store().list(query).await.map_err(unavailable)?;
            let Some(last) = rows.last() else { break };
            after = Some(Cursor::of_row(last));
            let ids: Vec<TaskId> = rows.iter().filter_map(|row| TaskId::parse(&row.key.id).ok()).collect();
            let mut tasks = read_many(self.store(), &ids).await?;
            let site = &self.inner.parts.site;
            tasks.retain(|task| {
                bulk.wish.means(task.state.phase)
                    && bulk.filter.admits(&task.intake, &task.state)
                    && sees(site, by, &task.intake)
            });
            self.ask_page(&bulk, by, &tasks, &mut count).await?;
            if !bulk.validate_only && count.matched > 0 {
                count.next = after.filter(|_| rows.len() == limits::PAGE_MAX);
                break;
            }
        }
        let pending = count.place != Seq(0) && !self.looked_at(count.place).await?;
        Ok(count.encode(pending))
    }

    /// Makes the requests of these tasks durable, each by itself.
    async fn ask_page(&self, bulk: &Bulk, by: &Caller, tasks: &[TaskRows], count: &mut Count) -> Result<(), Refusal> {
        let mut items = Vec::new();
        for task in tasks {
            count.matched += 1;
            let refusal = self.authorize_task(task, by, bulk.permission).and_then(|()| bulk.wish.fits(task)).err();
            let own_id = bulk.request_id.as_ref().map(|id| format!("{id}/{}", task.state.task_id));
            let asked = PendingCommand {
                ask: bulk.wish.to_ask(task),
                reason: bulk.reason.clone(),
                request_id: own_id.and_then(|id| RequestId::parse(&id).ok()),
                hash: bulk.hash.clone(),
                actor: by.into(),
                robot_id: task.state.robot_id.clone(),
            };
            match refusal {
                Some(refusal) if bulk.validate_only => count.refuse(&refusal),
                Some(refusal) => {
                    count.refuse(&refusal);
                    drop(self.noted(&asked, Err(refusal)).await);
                }
                None if bulk.validate_only => count.asked += 1,
                None => items.push(self.item_of(&asked).0),
            }
        }
        for slice in items.chunks(limits::SUBMIT_SLICE) {
            for result in self.commit(slice.to_vec()).await {
                match result {
                    Ok(applied) => {
                        count.asked += 1;
                        count.place = count.place.max(applied.seq);
                    }
                    // The same call was made before.
                    Err(CommitError::Conflict { .. }) => count.asked += 1,
                    Err(error) => count.refuse(&unavailable(error)),
                }
            }
        }
        Ok(())
    }
}
