//! Edit, hold and release of a task. Fleet answers each in the row of the task, beside what it did about it.
//!
//! Invariant: a caller is told that a task was changed only if it was. What fleet answered is told again to whoever repeats the request by its
//! request_id.

use crate::TaskService;
use crate::commands::{DurableRequest, PendingCommand, hash, internal, reason_text, refused, request_id};
use crate::rows::{TaskRows, read};
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{RequestId, TaskId};
use midshift_core::reason::{Code, Reason, Refusal, Violations};
use midshift_core::task::Ask;
use midshift_core::task::requests::{check_alive, check_edit};
use midshift_proto::convert::shown;
use midshift_proto::convert::task::{read_update, revision_of};
use midshift_proto::task::v1;

/// One change that is asked of one task.
struct Wanted {
    ask: Ask,
    task_id: TaskId,
    reason: String,
    request_id: Option<RequestId>,
    hash: String,
    permission: Permission,
    validate_only: bool,
}

/// The task after a change, or before one that fleet has not looked at.
struct Changed {
    task: v1::Task,
    pending: bool,
}

impl TaskService {
    /// Changes what was asked for, while no robot has the task.
    pub async fn update(&self, r: v1::UpdateTaskRequest, by: &Caller) -> Result<v1::UpdateTaskResponse, Refusal> {
        let mut bad = Violations::default();
        let (task_id, request_id) = read_common(&r.task_id, &r.reason, &r.request_id, &mut bad);
        let edit = read_update(r.update_mask.as_ref(), r.update.clone().unwrap_or_default(), &mut bad);
        bad.finish()?;
        let (Some(task_id), Some(edit)) = (task_id, edit) else { return Err(internal()) };
        let same = v1::UpdateTaskRequest { request_id: String::new(), validate_only: false, ..r.clone() };
        let pin = edit.robot_id.clone().flatten();
        let wanted = Wanted {
            ask: Ask::Edit { task_id: task_id.clone(), seen: revision_of(&r.etag), edit },
            task_id,
            reason: r.reason,
            request_id,
            hash: hash("update", &same),
            permission: Permission::Dispatch,
            validate_only: r.validate_only,
        };
        let Changed { task, pending } = self.change(wanted, by).await?;
        let notes = self.notes(&pin).await?.iter().map(shown).collect();
        Ok(v1::UpdateTaskResponse { task: Some(task), pending, notes })
    }

    /// Puts a person's hold on a task.
    pub async fn hold(&self, r: v1::HoldTaskRequest, by: &Caller) -> Result<v1::HoldTaskResponse, Refusal> {
        let hash = hash("hold", &v1::HoldTaskRequest { request_id: String::new(), validate_only: false, ..r.clone() });
        let named = (r.task_id, r.request_id, r.reason);
        let Changed { task, pending } =
            self.let_stand(|task_id| Ask::Hold { task_id }, named, hash, r.validate_only, by).await?;
        Ok(v1::HoldTaskResponse { task: Some(task), pending })
    }

    /// Takes a person's hold away.
    pub async fn release(&self, r: v1::ReleaseTaskRequest, by: &Caller) -> Result<v1::ReleaseTaskResponse, Refusal> {
        let same = v1::ReleaseTaskRequest { request_id: String::new(), validate_only: false, ..r.clone() };
        let named = (r.task_id, r.request_id, r.reason);
        let Changed { task, pending } = self
            .let_stand(|task_id| Ask::Release { task_id }, named, hash("release", &same), r.validate_only, by)
            .await?;
        Ok(v1::ReleaseTaskResponse { task: Some(task), pending })
    }

    /// Asks for a hold or its end, of the task, by the request_id and for the reason that the caller named.
    async fn let_stand(
        &self,
        ask: impl Fn(TaskId) -> Ask,
        (task_id, request_id, reason): (String, String, String),
        hash: String,
        validate_only: bool,
        by: &Caller,
    ) -> Result<Changed, Refusal> {
        let mut bad = Violations::default();
        let (task_id, request_id) = read_common(&task_id, &reason, &request_id, &mut bad);
        bad.finish()?;
        let task_id = task_id.ok_or_else(internal)?;
        let (ask, permission) = (ask(task_id.clone()), Permission::Operate);
        self.change(Wanted { ask, task_id, reason, request_id, hash, permission, validate_only }, by).await
    }

    async fn change(&self, wanted: Wanted, by: &Caller) -> Result<Changed, Refusal> {
        let Wanted { ask, task_id, reason, request_id, hash, permission, validate_only } = wanted;
        let task = match self.read_authorized(&task_id, by, permission).await {
            Err(refusal) if !validate_only => return Err(self.denied(ask, reason, request_id, by, refusal).await),
            looked => looked?,
        };
        let earlier = self.asked_before(request_id.as_ref(), &hash).await?;
        let fits = if earlier.is_none() { check(&ask, &task).map_err(refused) } else { Ok(()) };
        if validate_only {
            return fits.map(|()| Changed { task: task.encode(), pending: false });
        }
        let robot_id = task.state.robot_id.clone();
        let asked = PendingCommand { ask, reason, request_id, hash, actor: by.into(), robot_id };
        self.noted(&asked, fits).await?;
        let is_first = earlier.is_none();
        let request = self.make_durable(earlier, asked.clone()).await?;
        match self.answer_of_fleet(&request, &task_id).await {
            // Its repeats are no further decisions.
            Err(refusal) if is_first => Err(self.noted(&asked, Err(refusal)).await.err().unwrap_or_else(internal)),
            answer => answer,
        }
    }

    /// Waits a little for fleet, and reads its answer.
    async fn answer_of_fleet(&self, request: &DurableRequest, task_id: &TaskId) -> Result<Changed, Refusal> {
        let pending = !self.has_looked(request).await?;
        let task = read(self.store(), task_id).await?;
        let answer = request.id.as_ref().and_then(|id| task.state.answer_to(id));
        match answer.map(|answer| &answer.refusal) {
            Some(Some(reason)) => Err(refused(reason.clone())),
            Some(None) => Ok(Changed { task: task.encode(), pending: false }),
            None if pending => Ok(Changed { task: task.encode(), pending }),
            // Fleet has let go of tasks that ended.
            None => Err(refused(check_alive(&task.state).err().unwrap_or_else(|| Code::AnswerUnknown.into()))),
        }
    }
}

/// What every change names.
fn read_common(task_id: &str, reason: &str, own_id: &str, bad: &mut Violations) -> (Option<TaskId>, Option<RequestId>) {
    let task_id = bad.accept("task_id", TaskId::parse(task_id));
    reason_text(reason, bad);
    (task_id, request_id(own_id, bad))
}

/// What stands against a change as the task is now. Fleet looks again.
fn check(ask: &Ask, task: &TaskRows) -> Result<(), Reason> {
    match ask {
        Ask::Edit { seen, edit, .. } => check_edit(&task.state, task.revision, &task.intake, *seen, edit),
        _ => check_alive(&task.state),
    }
}
