//! What people ask of admitted tasks: cancel, resolve; `resume` and `task_changes` are rooms of their own. The request is
//! made durable; fleet obeys it; we wait a little and show the task.
//!
//! Invariant: whether fleet has looked at a request is read from fleet's own mark, never guessed from how a task looks. A repeat of a
//! request_id with the same body is the same request: it writes nothing and its etag is not asked for again.

use crate::TaskService;
use crate::admit::no_result;
use crate::rows::{TaskRows, read, unavailable};
use midshift_core::audit::Note;
use midshift_core::fleet::rows::FleetMark;
use midshift_core::identity::{Actor, Caller, Permission};
use midshift_core::ids::{RequestId, RobotId, TaskId};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::{Revision, Seq, Writer};
use midshift_core::task::requests::{RequestKey, check_alive};
use midshift_core::task::{Ask, Phase, Resolution, TaskRequest};
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::task::revision_of;
use midshift_proto::task::v1;
use midshift_store::{CommitError, Error, Subjects, load};
use prost::Message;
use sha2::{Digest, Sha256};
use std::time::Duration;

/// Entries about one request_id read at a time; there are one or two.
const ENTRIES: usize = 16;

/// A request that is durable.
pub(crate) struct DurableRequest {
    /// Its number in the log; 0: fleet has looked at it long ago.
    place: Seq,
    /// Id of its row. None: an older version wrote it.
    pub(crate) id: Option<String>,
}

/// A command for a task, before its request is durable.
#[derive(Clone)]
pub(crate) struct PendingCommand {
    pub(crate) ask: Ask,
    pub(crate) reason: String,
    pub(crate) request_id: Option<RequestId>,
    pub(crate) hash: String,
    pub(crate) actor: Actor,
    /// The robot that has the task.
    pub(crate) robot_id: Option<RobotId>,
}

impl PendingCommand {
    /// What it leaves in the audit.
    fn note(&self) -> Note {
        let note = self.ask.note().because(&self.reason);
        self.robot_id.iter().fold(note, |note, id| note.about("robot", id))
    }
}

pub(crate) fn reason_text(text: &str, bad: &mut Violations) {
    if text.is_empty() || text.len() > limits::REASON_BYTES_MAX {
        bad.add("reason", "is required, 1-256 bytes");
    }
}

pub(crate) fn request_id(text: &str, bad: &mut Violations) -> Option<RequestId> {
    if text.is_empty() { None } else { bad.accept("request_id", RequestId::parse(text)) }
}

pub(crate) fn hash(verb: &str, message: &impl Message) -> String {
    let mut digest = Sha256::new();
    digest.update(verb);
    digest.update(message.encode_to_vec());
    digest.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

fn reused(id: &RequestId) -> Refusal {
    Refusal::new(Kind::AlreadyExists, Reason::from(Code::RequestIdReused).with("request_id", id))
}

pub(crate) fn internal() -> Refusal {
    Refusal::new(Kind::Internal, Code::Internal)
}

/// What a task refuses for how it is.
pub(crate) fn refused(reason: Reason) -> Refusal {
    let is_conflict = matches!(reason.code, Code::EtagMismatch | Code::AnswerUnknown);
    Refusal::new(if is_conflict { Kind::Conflict } else { Kind::Precondition }, reason)
}

fn same_etag(seen: Option<Revision>, task: &TaskRows) -> Result<(), Refusal> {
    match seen {
        Some(seen) if seen != task.revision => {
            Err(refused(Reason::from(Code::EtagMismatch).with("etag", task.revision.0)))
        }
        _ => Ok(()),
    }
}

impl TaskService {
    /// Asks for the end of a task.
    pub async fn cancel(&self, r: v1::CancelTaskRequest, by: &Caller) -> Result<v1::CancelTaskResponse, Refusal> {
        let mut bad = Violations::default();
        let task_id = bad.accept("task_id", TaskId::parse(&r.task_id));
        reason_text(&r.reason, &mut bad);
        let request_id = request_id(&r.request_id, &mut bad);
        bad.finish()?;
        let task_id = task_id.ok_or_else(internal)?;
        let same = v1::CancelTaskRequest { request_id: String::new(), validate_only: false, ..r.clone() };
        let hash = hash("cancel", &same);
        let task = match self.read_authorized(&task_id, by, Permission::Dispatch).await {
            Err(refusal) if !r.validate_only => {
                let ask = Ask::Cancel { task_id, force: r.force };
                return Err(self.denied(ask, r.reason, request_id, by, refusal).await);
            }
            looked => looked?,
        };
        let earlier = self.asked_before(request_id.as_ref(), &hash).await?;
        if earlier.is_none() && task.state.phase == Phase::Canceled {
            return Ok(v1::CancelTaskResponse { task: Some(task.encode()), pending: false });
        }
        let fits = || {
            check_alive(&task.state).map_err(refused)?;
            same_etag(revision_of(&r.etag), &task)
        };
        let fits = if earlier.is_none() { fits() } else { Ok(()) };
        let (ask, robot_id) = (Ask::Cancel { task_id: task_id.clone(), force: r.force }, task.state.robot_id.clone());
        let asked = PendingCommand { ask, reason: r.reason, request_id, hash, actor: by.into(), robot_id };
        if r.validate_only {
            return fits.map(|()| v1::CancelTaskResponse { task: Some(task.encode()), pending: false });
        }
        self.noted(&asked, fits).await?;
        let pending = self.submit_command(earlier, asked).await?;
        let task = read(self.store(), &task_id).await?;
        Ok(v1::CancelTaskResponse { task: Some(task.encode()), pending })
    }

    /// A person's answer to NEEDS_OPERATOR.
    pub async fn resolve(&self, r: v1::ResolveTaskRequest, by: &Caller) -> Result<v1::ResolveTaskResponse, Refusal> {
        let mut bad = Violations::default();
        let task_id = bad.accept("task_id", TaskId::parse(&r.task_id));
        reason_text(&r.reason, &mut bad);
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
        let (Some(task_id), Some(resolution)) = (task_id, resolution) else { return Err(internal()) };
        let same = v1::ResolveTaskRequest { request_id: String::new(), validate_only: false, ..r.clone() };
        let hash = hash("resolve", &same);
        let task = match self.read_authorized(&task_id, by, Permission::Operate).await {
            Err(refusal) if !r.validate_only => {
                let ask = Ask::Resolve { task_id, resolution };
                return Err(self.denied(ask, r.reason, request_id, by, refusal).await);
            }
            looked => looked?,
        };
        let earlier = self.asked_before(request_id.as_ref(), &hash).await?;
        let fits = || {
            check_alive(&task.state).map_err(refused)?;
            same_etag(seen, &task)?;
            if !task.allowed.contains(&resolution) {
                let reason = Reason::from(Code::ResolutionNotAllowed).with("state", task.state.phase.as_str());
                return Err(Refusal::new(Kind::Precondition, reason.with("task_id", &task_id)));
            }
            Ok(())
        };
        let fits = if earlier.is_none() { fits() } else { Ok(()) };
        let (ask, robot_id) = (Ask::Resolve { task_id: task_id.clone(), resolution }, task.state.robot_id.clone());
        let asked = PendingCommand { ask, reason: r.reason, request_id, hash, actor: by.into(), robot_id };
        if r.validate_only {
            return fits.map(|()| v1::ResolveTaskResponse { task: Some(task.encode()), pending: false });
        }
        self.noted(&asked, fits).await?;
        let pending = self.submit_command(earlier, asked).await?;
        let task = read(self.store(), &task_id).await?;
        Ok(v1::ResolveTaskResponse { task: Some(task.encode()), pending })
    }

    /// Where the request stands that this one repeats; none: it is new.
    pub(crate) async fn asked_before(
        &self,
        request_id: Option<&RequestId>,
        hash: &str,
    ) -> Result<Option<DurableRequest>, Refusal> {
        let Some(id) = request_id else { return Ok(None) };
        match load::<RequestKey>(self.store(), id.as_str()).await.map_err(unavailable)? {
            Some((key, _)) if key.payload_hash == hash => {
                let place = self.place_of(id).await.map_err(unavailable)?;
                Ok(Some(DurableRequest { place, id: key.request }))
            }
            Some(_) => Err(reused(id)),
            None => Ok(None),
        }
    }

    /// Number of the entry of the request that used this request_id. The log is never cut before fleet has looked: what is no
    /// longer in it has been looked at, and stands at 0.
    async fn place_of(&self, request_id: &RequestId) -> Result<Seq, Error> {
        let subject = [request_id.as_str().into()];
        let mut after = Seq(0);
        loop {
            let page = match self.store().feed_of(Subjects::RequestKeys(&subject), after, ENTRIES).await {
                Err(Error::CursorExpired { asked, oldest }) if asked < oldest => {
                    after = oldest;
                    continue;
                }
                page => page?,
            };
            // The newest: an older use of the id, and that it was forgotten, may still be in the log.
            if let Some(key) = page.entries.iter().rev().find(|entry| entry.body.is_some()) {
                return Ok(Seq(key.seq.0 + 1));
            }
            if page.next >= page.head {
                return Ok(Seq(0));
            }
            after = page.next;
        }
    }

    /// Makes a request durable unless it is a repeat, and waits a little for fleet. True: fleet has not looked at it yet.
    pub(crate) async fn submit_command(
        &self,
        earlier: Option<DurableRequest>,
        asked: PendingCommand,
    ) -> Result<bool, Refusal> {
        let request = self.make_durable(earlier, asked).await?;
        Ok(!self.has_looked(&request).await?)
    }

    /// Makes a request durable unless it is a repeat.
    pub(crate) async fn make_durable(
        &self,
        earlier: Option<DurableRequest>,
        asked: PendingCommand,
    ) -> Result<DurableRequest, Refusal> {
        match earlier {
            Some(earlier) => Ok(earlier),
            None => self.write(asked).await,
        }
    }

    /// Waits a little until fleet has looked at a request.
    pub(crate) async fn has_looked(&self, request: &DurableRequest) -> Result<bool, Refusal> {
        self.looked_at(request.place).await
    }

    /// Leaves it in the audit if the caller may not, and gives the refusal back. What it may not even see is about nothing that there is.
    pub(crate) async fn denied(
        &self,
        ask: Ask,
        reason: String,
        request_id: Option<RequestId>,
        by: &Caller,
        refusal: Refusal,
    ) -> Refusal {
        if refusal.kind() != Kind::Denied {
            return refusal;
        }
        let asked = PendingCommand { ask, reason, request_id, hash: String::new(), actor: by.into(), robot_id: None };
        let noted = self.noted(&asked, Err(refusal)).await;
        noted.err().unwrap_or_else(internal)
    }

    /// Leaves a refusal in the audit. Whoever asked hears why, whether or not that can be written down.
    pub(crate) async fn noted(&self, asked: &PendingCommand, fits: Result<(), Refusal>) -> Result<(), Refusal> {
        if let Err(refusal) = &fits {
            let request_id = asked.request_id.as_ref().map(RequestId::as_str);
            let item = Item::for_refusal(Writer::Task, &asked.actor, request_id, asked.note(), refusal);
            drop(self.commit(item.into_iter().collect()).await);
        }
        fits
    }

    /// The item of a request, and the id of its row. The key goes first, so that the number of the item is that of the request itself.
    pub(crate) fn item_of(&self, asked: &PendingCommand) -> (Item, String) {
        let now = self.inner.parts.clock.now();
        let mut item = Item::new(Writer::Task, &asked.actor);
        item.request_id = asked.request_id.as_ref().map(|r| r.as_str().into());
        let id = format!("{:013}-{:016x}", now.wall.0, rand::random::<u64>());
        if let Some(request_id) = &asked.request_id {
            let key = RequestKey {
                id: request_id.to_string(),
                payload_hash: asked.hash.clone(),
                task_id: None,
                request: Some(id.clone()),
                at_unix_ms: now.wall.0,
            };
            item.create(&key, "request.used");
        }
        item.audit(asked.note());
        let (ask, reason, actor) = (asked.ask.clone(), asked.reason.clone(), asked.actor.to_string());
        let request = TaskRequest { id: id.clone(), ask, reason, actor, at_unix_ms: now.wall.0 };
        item.create(&request, "task.asked");
        (item, id)
    }

    async fn write(&self, asked: PendingCommand) -> Result<DurableRequest, Refusal> {
        let (item, id) = self.item_of(&asked);
        match self.commit(vec![item]).await.pop().ok_or_else(no_result)? {
            Ok(applied) => Ok(DurableRequest { place: applied.seq, id: Some(id) }),
            // The same call came in twice at once, or the id was used in between.
            Err(CommitError::Conflict { .. }) => {
                self.asked_before(asked.request_id.as_ref(), &asked.hash).await?.ok_or_else(no_result)
            }
            Err(CommitError::Unknown(_)) => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
            Err(error) => Err(unavailable(error)),
        }
    }

    /// Waits a little until fleet has consumed the log up to `place`; what it did about it is in the same commit as its mark.
    pub(crate) async fn looked_at(&self, place: Seq) -> Result<bool, Refusal> {
        let mut wake = self.store().wake();
        let deadline = tokio::time::Instant::now() + Duration::from_millis(limits::CANCEL_WAIT.as_ms());
        loop {
            wake.mark_unchanged();
            let mark = load::<FleetMark>(self.store(), "fleet").await.map_err(unavailable)?;
            if place == Seq(0) || mark.is_some_and(|(mark, _)| mark.seq >= place) {
                return Ok(true);
            }
            let woken = tokio::time::timeout_at(deadline, wake.changed()).await;
            if !matches!(woken, Ok(Ok(()))) {
                return Ok(false);
            }
        }
    }
}
