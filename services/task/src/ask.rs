//! What people ask of admitted tasks: cancel, resolve, resume. The request is made durable; fleet obeys it; we wait a little and show the task.

use crate::TaskService;
use crate::rows::{TaskRows, read, unavailable};
use midshift_core::ids::{AreaId, RequestId, RobotId, TaskId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::{Item, Revision, Writer};
use midshift_core::task::state::RequestKey;
use midshift_core::task::{Ask, Phase, Resolution, TaskRequest};
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::task::revision_of;
use midshift_proto::task::v1;
use midshift_store::{CommitError, load};
use prost::Message;
use sha2::{Digest, Sha256};
use std::time::Duration;

/// A request made durable.
struct Asked {
    ask: Ask,
    reason: String,
    request_id: Option<RequestId>,
    hash: String,
}

fn reason_text(text: &str, required: bool, bad: &mut Violations) {
    if (required && text.is_empty()) || text.len() > limits::REASON_BYTES_MAX {
        bad.add("reason", if required { "is required, 1-256 bytes" } else { "must be at most 256 bytes" });
    }
}

fn request_id(text: &str, bad: &mut Violations) -> Option<RequestId> {
    if text.is_empty() { None } else { bad.take("request_id", RequestId::parse(text)) }
}

fn hash(verb: &str, message: &impl Message) -> String {
    let mut digest = Sha256::new();
    digest.update(verb);
    digest.update(message.encode_to_vec());
    digest.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

fn same_etag(seen: Option<Revision>, task: &TaskRows) -> Result<(), Refusal> {
    match seen {
        Some(seen) if seen != task.revision => {
            Err(Refusal::new(Kind::Conflict, Reason::from(Code::EtagMismatch).with("etag", task.revision.0)))
        }
        _ => Ok(()),
    }
}

impl TaskService {
    /// Asks for the end of a task.
    pub async fn cancel(&self, r: v1::CancelTaskRequest) -> Result<v1::CancelTaskResponse, Refusal> {
        let mut bad = Violations::default();
        let task_id = bad.take("task_id", TaskId::parse(&r.task_id));
        reason_text(&r.reason, true, &mut bad);
        let request_id = request_id(&r.request_id, &mut bad);
        bad.finish()?;
        let Some(task_id) = task_id else { return Err(Refusal::new(Kind::Internal, Code::Internal)) };
        let task = read(self.inner.parts.store.as_ref(), &task_id).await?;
        if task.state.phase == Phase::Canceled {
            return Ok(v1::CancelTaskResponse { task: Some(task.encode()), pending: false });
        }
        if task.state.phase.is_terminal() {
            let reason = Reason::from(Code::TaskEnded).with("state", task.state.phase.as_str());
            return Err(Refusal::new(Kind::Precondition, reason));
        }
        same_etag(revision_of(&r.etag), &task)?;
        if r.validate_only {
            return Ok(v1::CancelTaskResponse { task: Some(task.encode()), pending: false });
        }
        let hash = hash("cancel", &v1::CancelTaskRequest { request_id: String::new(), ..r.clone() });
        let ask = Ask::Cancel { task_id: task_id.clone(), force: r.force };
        self.ask(Asked { ask, reason: r.reason, request_id, hash }).await?;
        let seen = task.revision;
        let (task, pending) = self.wait(&task_id, |t| t.revision != seen && t.state.cancel_requested.is_some()).await?;
        Ok(v1::CancelTaskResponse { task: Some(task.encode()), pending })
    }

    /// A person's answer to NEEDS_OPERATOR.
    pub async fn resolve(&self, r: v1::ResolveTaskRequest) -> Result<v1::ResolveTaskResponse, Refusal> {
        let mut bad = Violations::default();
        let task_id = bad.take("task_id", TaskId::parse(&r.task_id));
        reason_text(&r.reason, true, &mut bad);
        let request_id = request_id(&r.request_id, &mut bad);
        let resolution = Resolution::from_wire(r.resolution);
        if resolution.is_none() {
            bad.add("resolution", "is required, one of the task's allowed resolutions");
        }
        let seen = revision_of(&r.etag);
        if seen.is_none() {
            bad.add("etag", "is required: a person answers what the person saw");
        }
        bad.finish()?;
        let (Some(task_id), Some(resolution)) = (task_id, resolution) else {
            return Err(Refusal::new(Kind::Internal, Code::Internal));
        };
        let task = read(self.inner.parts.store.as_ref(), &task_id).await?;
        if task.state.phase.is_terminal() {
            return Err(Refusal::new(
                Kind::Precondition,
                Reason::from(Code::TaskEnded).with("state", task.state.phase.as_str()),
            ));
        }
        same_etag(seen, &task)?;
        if !task.allowed.contains(&resolution) {
            let reason = Reason::from(Code::ResolutionNotAllowed).with("state", task.state.phase.as_str());
            return Err(Refusal::new(Kind::Precondition, reason));
        }
        if r.validate_only {
            return Ok(v1::ResolveTaskResponse { task: Some(task.encode()), pending: false });
        }
        let hash = hash("resolve", &v1::ResolveTaskRequest { request_id: String::new(), ..r.clone() });
        let ask = Ask::Resolve { task_id: task_id.clone(), resolution };
        self.ask(Asked { ask, reason: r.reason, request_id, hash }).await?;
        let (task, pending) = self.wait(&task_id, |t| t.state.phase != Phase::NeedsOperator).await?;
        Ok(v1::ResolveTaskResponse { task: Some(task.encode()), pending })
    }

    /// Takes `resume:` tokens away.
    pub async fn resume(&self, r: v1::ResumeHeldRequest) -> Result<v1::ResumeHeldResponse, Refusal> {
        let mut bad = Violations::default();
        reason_text(&r.reason, false, &mut bad);
        let request_id = request_id(&r.request_id, &mut bad);
        let area_id = if r.area_id.is_empty() { None } else { bad.take("area_id", AreaId::parse(&r.area_id)) };
        if area_id.as_ref().is_some_and(|area| self.inner.parts.site.find_area(area).is_none()) {
            bad.add("area_id", "the site has no such area");
        }
        let most = limits::PAGE_MAX;
        if r.task_ids.len() > most || r.robot_ids.len() > most {
            bad.add("task_ids", "at most 1000 task_ids and 1000 robot_ids");
        }
        let task_ids: Vec<TaskId> = r
            .task_ids
            .iter()
            .enumerate()
            .filter_map(|(i, id)| bad.take(&format!("task_ids[{i}]"), TaskId::parse(id)))
            .collect();
        let robot_ids: Vec<RobotId> = r
            .robot_ids
            .iter()
            .enumerate()
            .filter_map(|(i, id)| bad.take(&format!("robot_ids[{i}]"), RobotId::parse(id)))
            .collect();
        let stop_id = Some(r.stop_id.clone()).filter(|s| !s.is_empty());
        if stop_id.is_none() && area_id.is_none() && task_ids.is_empty() && robot_ids.is_empty() {
            bad.add("stop_id", "name a stop_id, an area_id, task_ids or robot_ids: nothing is resumed by accident");
        }
        bad.finish()?;
        if r.validate_only {
            return Ok(v1::ResumeHeldResponse { pending: false });
        }
        let hash = hash("resume", &v1::ResumeHeldRequest { request_id: String::new(), ..r.clone() });
        let ask = Ask::ResumeHeld { stop_id, area_id, task_ids, robot_ids };
        self.ask(Asked { ask, reason: r.reason, request_id, hash }).await?;
        Ok(v1::ResumeHeldResponse { pending: true })
    }

    /// Makes a request durable; a repeat of the same request_id and body is the same request.
    async fn ask(&self, asked: Asked) -> Result<(), Refusal> {
        let now = self.inner.parts.clock.now();
        // Until login exists nobody is known by name.
        let actor = "anonymous";
        let id = format!("{:013}-{:016x}", now.wall.0, rand::random::<u64>());
        let row =
            TaskRequest { id, ask: asked.ask, reason: asked.reason, actor: actor.to_owned(), at_unix_ms: now.wall.0 };
        let mut item = Item::new(Writer::Task, actor);
        item.request_id = asked.request_id.as_ref().map(|r| r.as_str().into());
        item.create(&row, "task.asked");
        if let Some(request_id) = &asked.request_id {
            let key = RequestKey {
                id: request_id.to_string(),
                payload_hash: asked.hash.clone(),
                task_id: None,
                at_unix_ms: now.wall.0,
            };
            item.create(&key, "request.used");
        }
        match self.inner.parts.store.commit(vec![item]).await.pop() {
            Some(Ok(_)) => Ok(()),
            Some(Err(CommitError::Conflict { .. })) => {
                let id = asked.request_id.map(|r| r.to_string()).unwrap_or_default();
                let found = load::<RequestKey>(self.inner.parts.store.as_ref(), &id).await.map_err(unavailable)?;
                if found.is_some_and(|(key, _)| key.payload_hash == asked.hash) {
                    return Ok(());
                }
                Err(Refusal::new(Kind::AlreadyExists, Reason::from(Code::RequestIdReused).with("request_id", id)))
            }
            Some(Err(CommitError::Unknown(_))) | None => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
            Some(Err(error)) => Err(unavailable(error)),
        }
    }

    /// Waits a little for fleet; answers with the task as it is and whether the request is still to be obeyed.
    async fn wait(&self, task_id: &TaskId, obeyed: impl Fn(&TaskRows) -> bool) -> Result<(TaskRows, bool), Refusal> {
        let store = self.inner.parts.store.as_ref();
        let mut wake = store.wake();
        let deadline = tokio::time::Instant::now() + Duration::from_millis(limits::CANCEL_WAIT.as_ms());
        loop {
            wake.mark_unchanged();
            let task = read(store, task_id).await?;
            if obeyed(&task) || task.state.phase.is_terminal() {
                return Ok((task, false));
            }
            let woken = tokio::time::timeout_at(deadline, wake.changed()).await;
            if !matches!(woken, Ok(Ok(()))) {
                return Ok((task, true));
            }
        }
    }
}
