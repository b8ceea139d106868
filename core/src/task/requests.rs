//! What people ask of a task after its admission, and the request_ids that they used.

use super::edit::{TaskEdit, is_in_order};
use super::machine::takes_edit;
use super::state::{TaskIntake, TaskState};
use crate::audit::Note;
use crate::ids::{RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::rows::{Index, Record, Revision, Table, body_is_json};
use serde::{Deserialize, Serialize};

/// A person's answer to NEEDS_OPERATOR.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Resolution {
    /// Try again; an opened task goes on at the robot that carries its item.
    Requeue,
    /// Try again elsewhere: a person handed the item to whichever robot comes (it goes on after the pick).
    RequeueHandedOver,
    /// Try again from the first step: a person put the item back.
    RequeuePutBack,
    /// Done by hand.
    Succeeded,
    /// Give up.
    Failed,
    /// Give up, the item is lost.
    FailedItemLost,
    /// Not wanted any more.
    Canceled,
}

/// What somebody asks of a task or robot after admission.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ask {
    /// End it.
    Cancel {
        /// The task that is to end.
        task_id: TaskId,
        /// End the record at once; robot and places stay kept until the robot reports.
        force: bool,
    },
    /// Answer NEEDS_OPERATOR.
    Resolve {
        /// The task that waits for an operator.
        task_id: TaskId,
        /// What the person says of it.
        resolution: Resolution,
    },
    /// Change what was asked for, while no robot has the task.
    Edit {
        /// The task that changes.
        task_id: TaskId,
        /// Only if its state is still at this revision. None: whatever it is.
        seen: Option<Revision>,
        /// What changes.
        edit: TaskEdit,
    },
    /// Put the token `operator` on a task: it waits, or its robot pauses, until it is released.
    Hold {
        /// The task that is to stand.
        task_id: TaskId,
    },
    /// Take the token `operator` away.
    Release {
        /// The task that may go on.
        task_id: TaskId,
    },
    /// Take away `resume:<stop_id>` tokens (of all if none is named) from these tasks and robots.
    ResumeHeld {
        /// Only the tokens of this stop.
        stop_id: Option<String>,
        /// Everything in this area.
        area_id: Option<crate::ids::AreaId>,
        /// These tasks.
        task_ids: Vec<TaskId>,
        /// These robots.
        robot_ids: Vec<RobotId>,
    },
}

impl Ask {
    /// What it leaves in the audit.
    pub fn note(&self) -> Note {
        match self {
            Self::Cancel { task_id, force } => Note::new("task.cancel").about("task", task_id).with("force", force),
            Self::Resolve { task_id, resolution } => {
                let word = serde_json::to_value(resolution).unwrap_or_default();
                let word = word.as_str().map_or_else(|| format!("{resolution:?}"), str::to_owned);
                Note::new("task.resolve").about("task", task_id).with("resolution", word)
            }
            Self::Edit { task_id, edit, .. } => edit.note(Note::new("task.edit").about("task", task_id)),
            Self::Hold { task_id } => Note::new("task.hold").about("task", task_id),
            Self::Release { task_id } => Note::new("task.release").about("task", task_id),
            Self::ResumeHeld { stop_id, area_id, task_ids, robot_ids } => {
                let note = Note::new("task.resume");
                let note = stop_id.iter().fold(note, |note, id| note.about("stop", id));
                let note = area_id.iter().fold(note, |note, id| note.about("area", id));
                let note = task_ids.iter().fold(note, |note, id| note.about("task", id));
                robot_ids.iter().fold(note, |note, id| note.about("robot", id))
            }
        }
    }
}

/// Checks an edit against the task as it stands at `revision`.
///
/// # Errors
/// Why it is not to be carried out.
pub fn check_edit(
    task: &TaskState,
    revision: Revision,
    intake: &TaskIntake,
    seen: Option<Revision>,
    edit: &TaskEdit,
) -> Result<(), Reason> {
    check_alive(task)?;
    if seen.is_some_and(|seen| seen != revision) {
        return Err(Reason::from(Code::EtagMismatch).with("etag", revision.0));
    }
    if !takes_edit(task.phase) {
        let reason = Reason::from(Code::TaskNotEditable).with("state", task.phase.as_str());
        return Err(task.robot_id.iter().fold(reason, |reason, robot_id| reason.with("robot_id", robot_id)));
    }
    let pin = edit.robot_id.as_ref().and_then(Option::as_ref);
    if let Some(opened) = task.opened_robot_id.as_ref().filter(|opened| pin.is_some_and(|pin| pin != *opened)) {
        return Err(Reason::from(Code::BoundElsewhere).with("robot_id", opened));
    }
    let not_before = edit.not_before.unwrap_or_else(|| task.not_before(intake));
    let deadline = edit.deadline.unwrap_or_else(|| task.deadline(intake));
    if !is_in_order(not_before, deadline) {
        return Err(Reason::new(Code::NotAllowedNow, "Its deadline would not be after its not_before."));
    }
    Ok(())
}

/// Checks that a task has not ended.
///
/// # Errors
/// It has.
pub fn check_alive(task: &TaskState) -> Result<(), Reason> {
    if !task.phase.is_terminal() {
        return Ok(());
    }
    let reason = Reason::from(Code::TaskEnded).with("state", task.phase.as_str());
    Err(reason.with("task_id", &task.task_id))
}

/// One such request: append-only, consumed by fleet in order.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskRequest {
    /// Drawn at random; unique.
    pub id: String,
    /// What the person asks for.
    pub ask: Ask,
    /// Why, as the person said.
    pub reason: String,
    /// The actor that asks, by name.
    pub actor: String,
    /// UTC of the wall.
    pub at_unix_ms: i64,
}

impl Record for TaskRequest {
    const TABLE: Table = Table::TaskRequest;
    body_is_json!();
    fn id(&self) -> String {
        self.id.clone()
    }
    fn index(&self) -> Index {
        let parent = match &self.ask {
            Ask::Cancel { task_id, .. }
            | Ask::Resolve { task_id, .. }
            | Ask::Edit { task_id, .. }
            | Ask::Hold { task_id }
            | Ask::Release { task_id } => Some(task_id.as_str().into()),
            Ask::ResumeHeld { .. } => None,
        };
        Index { parent, order: Some(self.at_unix_ms), ..Index::default() }
    }
}

/// A used request_id and what it was answered: kept 7 days.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequestKey {
    /// The client's request_id, with the verb before it.
    pub id: String,
    /// SHA-256 of the request's canonical form, hex.
    pub payload_hash: String,
    /// The task that it admitted. None: it asked for something else.
    pub task_id: Option<TaskId>,
    /// Id of the row in `task_request` that has what it asked for. None: it admitted a task, or an older version wrote it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub request: Option<String>,
    /// UTC of the wall.
    pub at_unix_ms: i64,
}

impl Record for RequestKey {
    const TABLE: Table = Table::RequestKey;
    body_is_json!();
    fn id(&self) -> String {
        self.id.clone()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.at_unix_ms), ..Index::default() }
    }
}
