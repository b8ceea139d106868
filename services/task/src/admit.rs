//! Admission: from a request to rows, all violations at once, idempotent by request_id and by task_id.
//!
//! Invariant: the request's key, the task and its state are one item; nothing is half-stored. A request that was admitted once is
//! answered with its task for as long as its key is kept, even if its rules would no longer hold.

use crate::TaskService;
use crate::rows::{TaskRows, are_seen, read, unavailable, unknown_robot};
use midshift_core::audit::Note;
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{RequestId, RobotId, TaskId, WaypointId};
use midshift_core::item::Item;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violation};
use midshift_core::rows::{Table, Writer};
use midshift_core::task::requests::RequestKey;
use midshift_core::task::types::TypeCatalogue;
use midshift_core::task::{TaskIntake, TaskSpec, TaskState};
use midshift_core::time::Utc;
use midshift_proto::convert::shown;
use midshift_proto::convert::submission::{CheckedTask, Submission, canonical};
use midshift_proto::convert::task::encode_checked;
use midshift_proto::task::v1;
use midshift_store::{Applied, CommitError, load};
use sha2::{Digest, Sha256};

/// Draws of a task id before the store is suspected.
const DRAWS: usize = 8;
/// Crockford's alphabet: no letter that is read as a digit.
const BASE32: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";

/// A checked request.
struct Wanted {
    request_id: Option<RequestId>,
    task_id: Option<TaskId>,
    task: CheckedTask,
    hash: String,
}

/// One admission on its way to the store.
pub struct Admission {
    wanted: Wanted,
    intake: TaskIntake,
    /// What to commit.
    pub item: Item,
}

/// A request that may be answered.
pub enum Prepared {
    /// It is to be committed.
    New(Box<Admission>),
    /// It was admitted by an earlier call.
    Known(TaskId),
}

/// What the store said about an admission.
pub enum Admitted {
    /// The task is durable.
    Durable(Durable),
    /// The drawn id was taken: again with another.
    Again(Box<Admission>),
}

/// A task that is in the store.
pub enum Durable {
    /// By this call; the answer shows it as it was born.
    New(Box<TaskIntake>),
    /// By an earlier call; the answer shows it as it is now.
    Known(TaskId),
}

impl Durable {
    /// Its id.
    pub fn task_id(&self) -> &TaskId {
        match self {
            Self::New(intake) => &intake.task_id,
            Self::Known(task_id) => task_id,
        }
    }
}

fn hash(request: &v1::SubmitTaskRequest) -> String {
    Sha256::digest(canonical(request)).iter().map(|b| format!("{b:02x}")).collect()
}

/// A store that answered for fewer items than it was given.
pub fn no_result() -> Refusal {
    Refusal::new(Kind::Unavailable, Code::CommitUnknown)
}

/// A new task's id: the day, its milliseconds, and a number that no other task of this process has in that millisecond. Ids rise
/// with time, so that new rows lie beside each other in every index.
fn draw_id(utc: Utc, number: u64) -> TaskId {
    const DAY_MS: i64 = 86_400_000;
    const NUMBER_BITS: u32 = 23;
    let day = utc.rfc3339().get(..10).unwrap_or_default().replace('-', "");
    let of_day = utc.0.rem_euclid(DAY_MS).cast_unsigned();
    let drawn = of_day << NUMBER_BITS | (number & ((1 << NUMBER_BITS) - 1));
    let tail: String = (0..10).rev().map(|i| char::from(BASE32[(drawn >> (i * 5)) as usize & 31])).collect();
    // Letters, digits and hyphens only, 24 of them.
    TaskId::parse(&format!("TASK-{day}-{tail}")).unwrap_or_else(|e| unreachable!("drawn id: {e}"))
}

impl TaskService {
    /// Checks every rule of one request, and whether the caller may bring such work to where it goes.
    async fn check(&self, request: v1::SubmitTaskRequest, by: &Caller) -> Result<Wanted, Refusal> {
        let hash = hash(&request);
        let submission = Submission::read(request);
        let (request_id, task_id) = (submission.request_id.clone(), submission.task_id.clone());
        let site = &self.inner.parts.site;
        let knows = |waypoint: &WaypointId| site.find(waypoint).is_some();
        let task = if submission.needs_types() {
            // Another process may have registered a type that this one has not heard of yet.
            let (again, types) = (submission.clone(), self.types().await?);
            match submission.check(&knows, &types) {
                Err(refusal) if refusal.kind() == Kind::Invalid => {
                    let newest = self.newest_types().await?;
                    again.check(&knows, &newest)?
                }
                checked => checked?,
            }
        } else {
            submission.check(&knows, &TypeCatalogue::default())?
        };
        let spec = &task.spec;
        self.dispatches(spec, by)?;
        let depends_on =
            spec.depends_on.iter().enumerate().map(|(i, id)| (format!("spec.depends_on[{i}]"), id.clone()));
        let same_robot_as = spec.same_robot_as.iter().map(|id| ("spec.same_robot_as".to_owned(), id.clone()));
        let (fields, named): (Vec<String>, Vec<TaskId>) = depends_on.chain(same_robot_as).unzip();
        if !named.is_empty() {
            let found = are_seen(self.store(), site, by, &named).await?;
            let unknown = fields.into_iter().zip(&named).zip(found).filter(|(_, found)| !found);
            let violations: Vec<Violation> = unknown
                .map(|((field, id), _)| Violation { field, description: format!("there is no task {id}") })
                .collect();
            if !violations.is_empty() {
                return Err(Refusal::invalid(violations));
            }
        }
        Ok(Wanted { request_id, task_id, task, hash })
    }

    fn dispatches(&self, spec: &TaskSpec, by: &Caller) -> Result<(), Refusal> {
        let dispatch = Permission::Dispatch;
        if by.is_permitted_everywhere(dispatch) {
            Ok(())
        } else {
            by.authorize(dispatch, &self.inner.parts.site.areas_of_task(spec))
        }
    }

    /// The item of an admission, with the id asked for or a drawn one.
    fn compose(&self, wanted: Wanted, by: &Caller) -> Admission {
        let (now, actor) = (self.inner.parts.clock.now(), by.to_string());
        let number = self.next_number();
        let drawn = || draw_id(now.utc, self.inner.salt.wrapping_add(number));
        let task_id = wanted.task_id.clone().unwrap_or_else(drawn);
        let intake = TaskIntake {
            task_id: task_id.clone(),
            spec: wanted.task.spec.clone(),
            actor,
            request_id: wanted.request_id.as_ref().map(ToString::to_string).unwrap_or_default(),
            payload_hash: wanted.hash.clone(),
            created: now.utc,
            number,
            type_revision: wanted.task.type_revision,
        };
        let mut item = Item::new(Writer::Task, by);
        item.request_id = wanted.request_id.as_ref().map(|id| id.as_str().into());
        if let Some(request_id) = wanted.request_id.as_ref().filter(|_| !self.inner.parts.bugs.forgets_requests()) {
            let key = RequestKey {
                id: request_id.to_string(),
                payload_hash: wanted.hash.clone(),
                task_id: Some(task_id.clone()),
                request: None,
                at_unix_ms: now.wall.0,
            };
            item.create(&key, "request.used");
        }
        let note = Note::new("task.submit").about("task", &task_id).with("sha256", &wanted.hash).shared();
        item.create(&intake, "task.admitted").create(&TaskState::born(&intake), "task.born").audit(note);
        Admission { wanted, intake, item }
    }

    /// Checks a request and composes its admission, or finds the one it repeats: the site and the tasks it was checked against
    /// may have changed since.
    pub async fn prepare(&self, request: v1::SubmitTaskRequest, by: &Caller) -> Result<Prepared, Refusal> {
        let hash = hash(&request);
        let named = Submission::read(request.clone());
        match self.check(request, by).await {
            Ok(wanted) => Ok(Prepared::New(Box::new(self.compose(wanted, by)))),
            Err(refusal) if refusal.kind() == Kind::Invalid => {
                let known = self.known(named.request_id.as_ref(), named.task_id.as_ref(), &hash).await?;
                let known = known.ok_or(refusal)?;
                self.dispatches(&read(self.store(), &known).await?.intake.spec, by)?;
                Ok(Prepared::Known(known))
            }
            Err(refusal) => Err(refusal),
        }
    }

    /// The task of an earlier request with this id and body, or of this chosen id and body.
    async fn known(
        &self,
        request_id: Option<&RequestId>,
        task_id: Option<&TaskId>,
        hash: &str,
    ) -> Result<Option<TaskId>, Refusal> {
        if let Some(id) = request_id
            && let Some((key, _)) = load::<RequestKey>(self.store(), id.as_str()).await.map_err(unavailable)?
        {
            return Ok(key.task_id.filter(|_| key.payload_hash == hash));
        }
        let Some(id) = task_id else { return Ok(None) };
        let found = load::<TaskIntake>(self.store(), id.as_str()).await.map_err(unavailable)?;
        Ok(found.filter(|(intake, _)| intake.payload_hash == hash).map(|(intake, _)| intake.task_id))
    }

    /// What became of a committed admission.
    pub async fn settle(
        &self,
        admission: Admission,
        result: Result<Applied, CommitError>,
        by: &Caller,
    ) -> Result<Admitted, Refusal> {
        match result {
            Ok(_) => {
                metrics::counter!("midshift_task_admitted_total").increment(1);
                Ok(Admitted::Durable(Durable::New(Box::new(admission.intake))))
            }
            Err(CommitError::Conflict { key, .. }) if key.table == Table::RequestKey => self.repeated(admission).await,
            Err(CommitError::Conflict { .. }) if admission.wanted.task_id.is_some() => self.same_id(admission).await,
            Err(CommitError::Conflict { .. }) => Ok(Admitted::Again(Box::new(self.compose(admission.wanted, by)))),
            Err(CommitError::Unknown(_)) => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
            Err(CommitError::TooLarge) => Err(Refusal::field("body", "is too large to be stored")),
            Err(
                error @ (CommitError::NotTheWriter { .. } | CommitError::NulByte | CommitError::DuplicateKey { .. }),
            ) => {
                tracing::error!(%error, "an admission was composed wrongly");
                Err(Refusal::new(Kind::Internal, Code::Internal))
            }
            Err(error) => Err(unavailable(error)),
        }
    }

    /// The request_id was used: the same body gets the same task.
    async fn repeated(&self, admission: Admission) -> Result<Admitted, Refusal> {
        let id = admission.wanted.request_id.as_ref().map(ToString::to_string).unwrap_or_default();
        let found = load::<RequestKey>(self.store(), &id).await.map_err(unavailable)?;
        match found {
            Some((key, _)) if key.payload_hash == admission.wanted.hash => match key.task_id {
                Some(task_id) => Ok(Admitted::Durable(Durable::Known(task_id))),
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
        let task_id = admission.intake.task_id;
        let found = load::<TaskIntake>(self.store(), task_id.as_str()).await.map_err(unavailable)?;
        match found {
            Some((intake, _)) if intake.payload_hash == admission.wanted.hash => {
                Ok(Admitted::Durable(Durable::Known(task_id)))
            }
            Some(_) => {
                Err(Refusal::new(Kind::AlreadyExists, Reason::from(Code::TaskIdTaken).with("task_id", &task_id)))
            }
            None => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
        }
    }

    /// What a caller should know of a task that is admitted all the same: that it names a robot that nobody knows.
    pub async fn notes(&self, pin: &Option<RobotId>) -> Result<Vec<Reason>, Refusal> {
        let unknown = unknown_robot(self.store(), pin.as_slice()).await?;
        let note = |robot_id| Reason::from(Code::PinnedRobotUnknown).with("robot_id", robot_id);
        Ok(unknown.map(note).into_iter().collect())
    }

    /// Admits one task.
    pub async fn submit(&self, request: v1::SubmitTaskRequest, by: &Caller) -> Result<v1::SubmitTaskResponse, Refusal> {
        let answer = |task, notes: Vec<Reason>| v1::SubmitTaskResponse {
            task: Some(task),
            notes: notes.iter().map(shown).collect(),
        };
        if request.validate_only {
            let task = self.check(request, by).await?.task;
            return Ok(answer(encode_checked(&task), self.notes(&task.spec.robot_id).await?));
        }
        let durable = match self.prepare(request, by).await? {
            Prepared::New(admission) => self.admit(*admission, by).await?,
            Prepared::Known(task_id) => Durable::Known(task_id),
        };
        match durable {
            Durable::New(intake) => {
                let notes = self.notes(&intake.spec.robot_id).await?;
                Ok(answer(TaskRows::born(*intake).encode(), notes))
            }
            Durable::Known(task_id) => {
                let task = read(self.store(), &task_id).await?;
                let notes = self.notes(&task.intake.spec.robot_id).await?;
                Ok(answer(task.encode(), notes))
            }
        }
    }

    /// Commits an admission, with another id each time the drawn one was taken.
    pub async fn admit(&self, mut admission: Admission, by: &Caller) -> Result<Durable, Refusal> {
        for _ in 0..DRAWS {
            let item = admission.item.clone();
            let result = self.commit(vec![item]).await.pop().ok_or_else(no_result)?;
            match self.settle(admission, result, by).await? {
                Admitted::Durable(durable) => return Ok(durable),
                Admitted::Again(next) => admission = *next,
            }
        }
        Err(Refusal::new(Kind::Internal, Code::Internal))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawn_ids_differ_within_a_millisecond_and_rise_with_time() {
        let noon = Utc(1_800_000_000_000);
        let ids: std::collections::BTreeSet<_> = (0..100_000).map(|n| draw_id(noon, n)).collect();
        assert_eq!(ids.len(), 100_000);
        let late = draw_id(Utc(noon.0 + 1), 0);
        assert!(ids.iter().all(|id| *id < late));
        assert!(draw_id(Utc(noon.0 + 86_400_000), 0) > late, "the next day is later");
    }
}
