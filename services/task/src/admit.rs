//! Admission: from a request to rows, all violations at once, idempotent by request_id and by task_id.
//!
//! Invariant: the request's key, the task and its state are one item; nothing is half-stored.

use crate::TaskService;
use crate::rows::{exist, read, unavailable};
use midshift_core::ids::{RequestId, TaskId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violation};
use midshift_core::rows::{Item, Table, Writer};
use midshift_core::task::state::RequestKey;
use midshift_core::task::{TaskIntake, TaskSpec, TaskState};
use midshift_core::time::Utc;
use midshift_proto::convert::task::{Submission, canonical, encode_checked};
use midshift_proto::task::v1;
use midshift_store::{CommitError, load};
use sha2::{Digest, Sha256};

/// Draws of a task id before the store is suspected.
const DRAWS: usize = 8;
/// Crockford's alphabet: no letter that is read as a digit.
const BASE32: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";

/// A checked request.
struct Wanted {
    request_id: Option<RequestId>,
    task_id: Option<TaskId>,
    spec: TaskSpec,
    hash: String,
}

/// One admission on its way to the store.
pub struct Admission {
    wanted: Wanted,
    /// The id it will have.
    pub task_id: TaskId,
    /// What to commit.
    pub item: Item,
}

/// What the store said about an admission.
pub enum Admitted {
    /// The task is durable, now or by an earlier call.
    Task(TaskId),
    /// The drawn id was taken: again with another.
    Again(Box<Admission>),
}

fn hash(request: &v1::SubmitTaskRequest) -> String {
    Sha256::digest(canonical(request)).iter().map(|b| format!("{b:02x}")).collect()
}

fn draw_id(utc: Utc) -> TaskId {
    let day = utc.rfc3339().get(..10).unwrap_or_default().replace('-', "");
    let random: u64 = rand::random();
    let tail: String = (0..10).map(|i| char::from(BASE32[(random >> (i * 5)) as usize & 31])).collect();
    // Letters, digits and hyphens only, 24 of them.
    TaskId::parse(&format!("TASK-{day}-{tail}")).unwrap_or_else(|e| unreachable!("drawn id: {e}"))
}

impl TaskService {
    /// Checks every rule of one request.
    async fn check(&self, request: v1::SubmitTaskRequest) -> Result<Wanted, Refusal> {
        let hash = hash(&request);
        let submission = Submission::read(request);
        let (request_id, task_id) = (submission.request_id.clone(), submission.task_id.clone());
        let site = &self.inner.parts.site;
        let spec = submission.check(&|waypoint| site.find(waypoint).is_some())?;
        if !spec.depends_on.is_empty() {
            let found = exist::<TaskIntake>(self.inner.parts.store.as_ref(), &spec.depends_on).await?;
            let unknown = spec.depends_on.iter().zip(found).enumerate().filter(|(_, (_, found))| !found);
            let violations: Vec<Violation> = unknown
                .map(|(i, (id, _))| Violation {
                    field: format!("spec.depends_on[{i}]"),
                    description: format!("there is no task {id}"),
                })
                .collect();
            if !violations.is_empty() {
                return Err(Refusal::invalid(violations));
            }
        }
        Ok(Wanted { request_id, task_id, spec, hash })
    }

    /// The item of an admission, with the id asked for or a drawn one.
    fn compose(&self, wanted: Wanted, actor: &str) -> Admission {
        let now = self.inner.parts.clock.now();
        let task_id = wanted.task_id.clone().unwrap_or_else(|| draw_id(now.utc));
        let intake = TaskIntake {
            task_id: task_id.clone(),
            spec: wanted.spec.clone(),
            actor: actor.to_owned(),
            request_id: wanted.request_id.as_ref().map(ToString::to_string).unwrap_or_default(),
            payload_hash: wanted.hash.clone(),
            created: now.utc,
            number: self.next_number(),
        };
        let mut item = Item::new(Writer::Task, actor);
        item.request_id = wanted.request_id.as_ref().map(|id| id.as_str().into());
        if let Some(request_id) = &wanted.request_id {
            let key = RequestKey {
                id: request_id.to_string(),
                payload_hash: wanted.hash.clone(),
                task_id: Some(task_id.clone()),
                at_unix_ms: now.wall.0,
            };
            item.create(&key, "request.used");
        }
        item.create(&intake, "task.admitted").create(&TaskState::born(&intake), "task.born");
        Admission { wanted, task_id, item }
    }

    /// Checks a request and composes its admission; none if it was only to be checked, then with the checked spec.
    pub async fn prepare(&self, request: v1::SubmitTaskRequest, actor: &str) -> Result<Admission, Refusal> {
        Ok(self.compose(self.check(request).await?, actor))
    }

    /// What became of a committed admission.
    pub async fn settle(
        &self,
        admission: Admission,
        result: Result<(), CommitError>,
        actor: &str,
    ) -> Result<Admitted, Refusal> {
        match result {
            Ok(()) => {
                metrics::counter!("midshift_task_admitted_total").increment(1);
                Ok(Admitted::Task(admission.task_id))
            }
            Err(CommitError::Conflict { key, .. }) if key.table == Table::RequestKey => self.repeated(admission).await,
            Err(CommitError::Conflict { .. }) if admission.wanted.task_id.is_some() => self.same_id(admission).await,
            Err(CommitError::Conflict { .. }) => Ok(Admitted::Again(Box::new(self.compose(admission.wanted, actor)))),
            Err(CommitError::Unknown(_)) => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
            Err(CommitError::TooLarge) => Err(Refusal::field("body", "is too large to be stored")),
            Err(error @ (CommitError::NotTheWriter { .. } | CommitError::DuplicateKey { .. })) => {
                tracing::error!(%error, "an admission was composed wrongly");
                Err(Refusal::new(Kind::Internal, Code::Internal))
            }
            Err(error) => Err(unavailable(error)),
        }
    }

    /// The request_id was used: the same body gets the same task.
    async fn repeated(&self, admission: Admission) -> Result<Admitted, Refusal> {
        let id = admission.wanted.request_id.as_ref().map(ToString::to_string).unwrap_or_default();
        let found = load::<RequestKey>(self.inner.parts.store.as_ref(), &id).await.map_err(unavailable)?;
        match found {
            Some((key, _)) if key.payload_hash == admission.wanted.hash => match key.task_id {
                Some(task_id) => Ok(Admitted::Task(task_id)),
                None => {
                    Err(Refusal::new(Kind::AlreadyExists, Reason::from(Code::RequestIdReused).with("request_id", id)))
                }
            },
            Some(_) => {
                Err(Refusal::new(Kind::AlreadyExists, Reason::from(Code::RequestIdReused).with("request_id", id)))
            }
            None => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
        }
    }

    /// The chosen task_id exists: the same body is the same task.
    async fn same_id(&self, admission: Admission) -> Result<Admitted, Refusal> {
        let found = load::<TaskIntake>(self.inner.parts.store.as_ref(), admission.task_id.as_str())
            .await
            .map_err(unavailable)?;
        match found {
            Some((intake, _)) if intake.payload_hash == admission.wanted.hash => Ok(Admitted::Task(admission.task_id)),
            Some(_) => Err(Refusal::new(
                Kind::AlreadyExists,
                Reason::from(Code::TaskIdTaken).with("task_id", &admission.task_id),
            )),
            None => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
        }
    }

    /// Admits one task.
    pub async fn submit(&self, request: v1::SubmitTaskRequest, actor: &str) -> Result<v1::Task, Refusal> {
        if request.validate_only {
            return Ok(encode_checked(&self.check(request).await?.spec));
        }
        let admission = self.prepare(request, actor).await?;
        let task_id = self.admit(admission, actor).await?;
        Ok(read(self.inner.parts.store.as_ref(), &task_id).await?.encode())
    }

    async fn admit(&self, mut admission: Admission, actor: &str) -> Result<TaskId, Refusal> {
        for _ in 0..DRAWS {
            let item = admission.item.clone();
            let result = self.inner.parts.store.commit(vec![item]).await.pop();
            let result = result.map_or_else(|| Err(CommitError::TooLarge), |r| r.map(|_| ()));
            match self.settle(admission, result, actor).await? {
                Admitted::Task(task_id) => return Ok(task_id),
                Admitted::Again(next) => admission = *next,
            }
        }
        Err(Refusal::new(Kind::Internal, Code::Internal))
    }

    /// Admits one slice of a batch; each item stands for itself.
    pub async fn submit_slice(&self, requests: Vec<v1::SubmitTaskRequest>, actor: &str) -> Vec<v1::SubmitTaskResult> {
        let ids: Vec<String> = requests.iter().map(|r| r.request_id.clone()).collect();
        let mut prepared = Vec::with_capacity(requests.len());
        for request in requests {
            prepared.push(self.prepare_batched(request, actor).await);
        }
        let items = prepared.iter().filter_map(|p| p.as_ref().ok()).map(|a| a.item.clone()).collect();
        let mut committed = self.inner.parts.store.commit(items).await.into_iter();
        let mut results = Vec::with_capacity(ids.len());
        for (request_id, admission) in ids.into_iter().zip(prepared) {
            let outcome = match admission {
                Err(refusal) => Err(refusal),
                Ok(admission) => {
                    let result = committed.next().map_or_else(|| Err(CommitError::TooLarge), |r| r.map(|_| ()));
                    match self.settle(admission, result, actor).await {
                        Ok(Admitted::Task(task_id)) => Ok(task_id),
                        Ok(Admitted::Again(next)) => self.admit(*next, actor).await,
                        Err(refusal) => Err(refusal),
                    }
                }
            };
            results.push(result_of(request_id, outcome));
        }
        results
    }

    async fn prepare_batched(&self, request: v1::SubmitTaskRequest, actor: &str) -> Result<Admission, Refusal> {
        if request.request_id.is_empty() {
            return Err(Refusal::field("request_id", "is required in a batch, so that it can be sent again"));
        }
        if request.validate_only {
            return Err(Refusal::field("validate_only", "is not for a batch"));
        }
        self.prepare(request, actor).await
    }
}

fn result_of(request_id: String, outcome: Result<TaskId, Refusal>) -> v1::SubmitTaskResult {
    use v1::submit_task_result::Outcome;
    let outcome = match outcome {
        Ok(task_id) => Outcome::TaskId(task_id.to_string()),
        Err(refusal) => Outcome::Refusal(v1::SubmitTaskRefusal {
            reason: Some(midshift_proto::convert::shown(&refusal.reason)),
            violations: refusal
                .violations
                .into_iter()
                .map(|v| midshift_proto::common::v1::FieldViolation { field: v.field, description: v.description })
                .collect(),
        }),
    };
    v1::SubmitTaskResult { request_id, outcome: Some(outcome) }
}

/// Whole slices of a batch.
pub const SLICE: usize = limits::SUBMIT_SLICE;
