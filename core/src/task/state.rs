//! The rows of a task: what was asked for, where it is, and its attempts.

use super::edit::TaskEdit;
use super::machine::{AfterStopping, Phase};
use super::spec::TaskSpec;
use crate::authority::Authority;
use crate::ids::{AttemptId, PlaceId, RobotId, Subject, TaskId, WaypointId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::Fault;
use crate::robot_events::WorkStats;
use crate::rows::{Index, Record, Revision, Table, body_is_json};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// What was asked for. Immutable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaskIntake {
    /// Its id.
    pub task_id: TaskId,
    /// What is wanted.
    pub spec: TaskSpec,
    /// Who submitted it.
    pub actor: String,
    /// The client's request_id; empty: none.
    pub request_id: String,
    /// SHA-256 of the request's canonical form, hex.
    pub payload_hash: String,
    /// UTC, site clock.
    pub created: Utc,
    /// Admission number: rises by one a task of one process, and orders lists. Several processes may give the same one.
    pub number: u64,
    /// Revision of the type `spec.kind` whose steps these are. None: they were sent as steps, or as a transport.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub type_revision: Option<Revision>,
}

impl Record for TaskIntake {
    const TABLE: Table = Table::TaskIntake;
    body_is_json!();
    fn id(&self) -> String {
        self.task_id.to_string()
    }
    fn index(&self) -> Index {
        Index { state: None, parent: None, order: Some(self.number as i64) }
    }
}

/// Token of a task that a person holds.
pub const OPERATOR_HOLD: &str = "operator";

/// A person's hold of a task: who, why and since when.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OperatorHold {
    /// The actor that holds it, by name.
    pub actor: String,
    /// Why, in a person's words.
    pub reason: String,
    /// UTC, site clock.
    pub since: Utc,
}

/// What became of one request to edit, hold or release a task.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequestAnswer {
    /// Id of the request's row.
    pub request: String,
    /// Why it was not carried out. None: it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refusal: Option<Reason>,
}

/// Where a task is. Born QUEUED with its intake, changed by fleet alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaskState {
    /// Which task.
    pub task_id: TaskId,
    /// Admission number of its intake.
    pub number: u64,
    /// Where it is.
    pub phase: Phase,
    /// Why it is there.
    pub reason: Option<Reason>,
    /// Where STOPPING leads once the robot confirmed; kept also while UNCERTAIN.
    pub then: Option<AfterStopping>,
    /// Tokens that hold it; survive every transition.
    pub holds: BTreeSet<String>,
    /// Highest epoch granted; 0: none.
    pub epoch: u64,
    /// Robot of the live or last attempt.
    pub robot_id: Option<RobotId>,
    /// Set once the first irreversible step is done or unknown: bound to that robot.
    pub opened_robot_id: Option<RobotId>,
    /// Steps done: where the next attempt begins.
    pub next_step: u32,
    /// Attempts that were accepted and ended without success.
    pub failures: u32,
    /// Offers refused in a row.
    pub refusals_in_row: u32,
    /// Robots that refused it since it was last taken, at most as many as there are refusals.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub refusers: BTreeSet<RobotId>,
    /// Robots whose attempt failed.
    pub failed_robots: BTreeSet<RobotId>,
    /// Robots that refused it for its content, or took it and then said that it cannot be done as asked: never again on these.
    pub semantic_refusers: BTreeSet<RobotId>,
    /// UTC, since when it waits (admission, hand-back, end of back-off).
    pub queued_since: Utc,
    /// UTC, since when nothing but a robot was missing for the first time: not_before passed, dependencies met, no hold. Survives requeues.
    /// None: it has not been ready yet.
    pub ready_since: Option<Utc>,
    /// UTC, end of the back-off in RETRY_WAIT.
    pub retry_at: Option<Utc>,
    /// UTC, a cancel was asked for and has not ended yet.
    pub cancel_requested: Option<Utc>,
    /// UTC, first acceptance.
    pub started: Option<Utc>,
    /// UTC, entry into a terminal phase.
    pub ended: Option<Utc>,
    /// UTC, last change.
    pub changed: Utc,
    /// Sum over its ended attempts.
    pub stats: WorkStats,
    /// What people changed of what was asked for: goes before the intake.
    #[serde(default, skip_serializing_if = "TaskEdit::is_empty")]
    pub edit: TaskEdit,
    /// UTC, when its priority last changed: it is promoted by the time that it is ready since then. None: never.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub priority_since: Option<Utc>,
    /// The person behind the token [`OPERATOR_HOLD`]. None: no person holds it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub operator_hold: Option<OperatorHold>,
    /// Answers to the newest requests to edit, hold or release it, oldest first, at most [`limits::ANSWERS_OF_TASK`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub answers: Vec<RequestAnswer>,
    /// The robot that had the task of `same_robot_as` when it ended. None: not known yet, or not asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub same_robot: Option<RobotId>,
    /// UTC, since when the first of the tasks was ready that this one stands for by its coalesce key. None: it stands for itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub asked_since: Option<Utc>,
}

impl TaskState {
    /// QUEUED, as born with its intake.
    pub fn born(intake: &TaskIntake) -> Self {
        let begins = intake.spec.not_before.map_or(intake.created, |t| t.max(intake.created));
        Self {
            task_id: intake.task_id.clone(),
            number: intake.number,
            phase: Phase::Queued,
            reason: None,
            then: None,
            holds: BTreeSet::new(),
            epoch: 0,
            robot_id: None,
            opened_robot_id: None,
            next_step: 0,
            failures: 0,
            refusals_in_row: 0,
            failed_robots: BTreeSet::new(),
            semantic_refusers: BTreeSet::new(),
            refusers: BTreeSet::new(),
            queued_since: begins,
            ready_since: intake.spec.waits_for().next().is_none().then_some(begins),
            retry_at: None,
            cancel_requested: None,
            started: None,
            ended: None,
            changed: intake.created,
            stats: WorkStats::default(),
            edit: TaskEdit::default(),
            priority_since: None,
            operator_hold: None,
            answers: Vec::new(),
            same_robot: None,
            asked_since: None,
        }
    }
    /// 0 most urgent ..= 9, as it is now.
    pub fn priority(&self, intake: &TaskIntake) -> u8 {
        self.edit.priority.unwrap_or(intake.spec.priority)
    }
    /// UTC before which it does not begin, as it is now.
    pub fn not_before(&self, intake: &TaskIntake) -> Option<Utc> {
        self.edit.not_before.unwrap_or(intake.spec.not_before)
    }
    /// UTC after which it is worthless, as it is now.
    pub fn deadline(&self, intake: &TaskIntake) -> Option<Utc> {
        self.edit.deadline.unwrap_or(intake.spec.deadline)
    }
    /// The only robot that may do it, as it is now. None: any that is able.
    pub fn pinned_robot<'a>(&'a self, intake: &'a TaskIntake) -> Option<&'a RobotId> {
        match &self.edit.robot_id {
            Some(edited) => edited.as_ref(),
            None => intake.spec.robot_id.as_ref().or(self.same_robot.as_ref()),
        }
    }
    /// What is wanted now: what was asked for, with what people changed of it.
    pub fn spec(&self, intake: &TaskIntake) -> TaskSpec {
        TaskSpec {
            priority: self.priority(intake),
            not_before: self.not_before(intake),
            deadline: self.deadline(intake),
            robot_id: self.pinned_robot(intake).cloned(),
            ..intake.spec.clone()
        }
    }
    /// Who holds it and why. None: no person does.
    pub fn held_by_person(&self) -> Option<Reason> {
        match &self.operator_hold {
            None => self.holds.contains(OPERATOR_HOLD).then(|| Code::HoldByPerson.into()),
            Some(OperatorHold { actor, reason, since }) => {
                let told = format!("{actor} holds it since {}: {reason}", since.rfc3339());
                let held = Reason::new(Code::HoldByPerson, told).with("actor", actor);
                Some(held.with("since", since.rfc3339()))
            }
        }
    }
    /// Why it is where it is: of one that stands because a person holds it, that.
    pub fn shown_reason(&self) -> Option<Reason> {
        let stands = matches!(self.phase, Phase::Queued | Phase::Held);
        self.held_by_person().filter(|_| stands).or_else(|| self.reason.clone())
    }
    /// What became of a request. None: it was not answered, or so many came since that this is forgotten.
    pub fn answer_to(&self, request: &str) -> Option<&RequestAnswer> {
        self.answers.iter().find(|answer| answer.request == request)
    }
    /// Keeps what became of a request; the oldest of too many answers is forgotten.
    pub fn note_answer(&mut self, request: &str, refusal: Option<Reason>) {
        self.answers.push(RequestAnswer { request: request.to_owned(), refusal });
        self.answers.drain(..self.answers.len().saturating_sub(limits::ANSWERS_OF_TASK));
    }
    /// Id of its newest attempt, if it ever had one.
    pub fn attempt_id(&self) -> Option<AttemptId> {
        (self.epoch > 0).then(|| AttemptId { subject: Subject::Task(self.task_id.clone()), epoch: self.epoch })
    }
}

impl Record for TaskState {
    const TABLE: Table = Table::TaskState;
    body_is_json!();
    fn id(&self) -> String {
        self.task_id.to_string()
    }
    fn index(&self) -> Index {
        let parent = self.robot_id.as_ref().map(|r| r.as_str().into());
        Index { state: Some(self.phase.number()), parent, order: Some(self.number as i64) }
    }
}

/// Where an attempt is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttemptPhase {
    /// Written, not answered.
    Offered,
    /// The robot has taken it.
    Accepted,
    /// The robot drives.
    Navigating,
    /// Acting or waiting.
    Executing,
    /// Standing with it.
    Paused,
    /// Told to stop, not confirmed.
    Stopping,
    /// The robot did not take it.
    Refused,
    /// Nobody answered and the robot confirmed that it does not have it.
    OfferExpired,
    /// The robot has done all steps.
    Succeeded,
    /// Ended by a fault, or its success was not believed.
    Failed,
    /// It ended without having been done, as far as the record knows.
    Aborted,
    /// Given up by a person while nobody knew.
    Lost,
    /// A charge that was ended at its charger: the robot keeps its place there and goes on charging.
    Docked,
}

impl AttemptPhase {
    /// All phases.
    pub const ALL: [AttemptPhase; Self::Docked as usize + 1] = [
        Self::Offered,
        Self::Accepted,
        Self::Navigating,
        Self::Executing,
        Self::Paused,
        Self::Stopping,
        Self::Refused,
        Self::OfferExpired,
        Self::Succeeded,
        Self::Failed,
        Self::Aborted,
        Self::Lost,
        Self::Docked,
    ];
    /// No way out.
    pub const fn is_terminal(self) -> bool {
        use AttemptPhase::{Aborted, Docked, Failed, Lost, OfferExpired, Refused, Succeeded};
        matches!(self, Refused | OfferExpired | Succeeded | Failed | Aborted | Lost | Docked)
    }
    /// Number in indices and on the wire.
    pub const fn number(self) -> i64 {
        self as i64 + 1
    }
    /// Where a live attempt may go. LOST may still turn into the truth (a late report) while no newer epoch was granted.
    pub const fn transitions(self) -> &'static [AttemptPhase] {
        use AttemptPhase::{
            Aborted, Accepted, Docked, Executing, Failed, Lost, Navigating, OfferExpired, Offered, Paused, Refused,
            Stopping, Succeeded,
        };
        match self {
            Offered => &[
                Accepted,
                Navigating,
                Executing,
                Paused,
                Refused,
                OfferExpired,
                Stopping,
                Succeeded,
                Failed,
                Aborted,
                Lost,
            ],
            Accepted => &[Navigating, Executing, Paused, Stopping, Succeeded, Failed, Aborted, Lost],
            Navigating => &[Executing, Paused, Stopping, Succeeded, Failed, Aborted, Lost],
            Executing => &[Navigating, Paused, Stopping, Succeeded, Failed, Aborted, Lost],
            Paused => &[Navigating, Executing, Stopping, Succeeded, Failed, Aborted, Lost],
            Stopping => &[Refused, OfferExpired, Succeeded, Failed, Aborted, Lost, Docked],
            Lost => &[Succeeded, Failed, Aborted],
            Refused | OfferExpired | Succeeded | Failed | Aborted | Docked => &[],
        }
    }
}

/// Fleet's own wishes of a robot, without a task row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Errand {
    /// Drive to a charger and charge.
    Charge,
    /// Drive to a parking or hold place.
    Park,
}

/// Nobody knows what the robot does with the attempt.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Uncertain {
    /// UTC, since when.
    pub since: Utc,
    /// Why nobody knows how it stands.
    pub cause: Reason,
}

/// The places that the robot of an attempt visited while it had it, as far as its work is done there.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct VisitedPlaces {
    /// The ring in which the robot wrote its events when it was given the attempt: what another one tells is not the whole.
    pub ring: String,
    /// Standing places at which a step is done and that it entered, or stood in already: at most one a step.
    pub places: BTreeSet<PlaceId>,
    /// The step with which the attempt goes on: those before it were done by attempts before.
    #[serde(default)]
    pub resume_step: u32,
    /// A part of what the robot said meanwhile is lost.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_incomplete: bool,
}

/// One grant of a task or errand to one robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Attempt {
    /// Its id: subject and epoch.
    pub attempt: AttemptId,
    /// Given to.
    pub robot_id: RobotId,
    /// What kind of errand; none for a task.
    pub errand: Option<Errand>,
    /// Where an errand goes; none for a task, whose steps say it.
    pub goal: Option<WaypointId>,
    /// Where it is.
    pub phase: AttemptPhase,
    /// None: known.
    pub uncertain: Option<Uncertain>,
    /// The offer's anchor.
    pub offer: Authority,
    /// Steps done so far.
    pub step_index: u32,
    /// The highest step that its robot reported: no later report of it may name a lower one. None: nothing was reported, or before this was
    /// noted.
    #[serde(default)]
    pub reported: Option<u32>,
    /// Its first irreversible step is done or unknown.
    pub is_opened: bool,
    /// When it was offered, UTC.
    pub offered: Utc,
    /// When the robot took it, UTC; none: it has not.
    pub accepted: Option<Utc>,
    /// When it ended, UTC; none: it goes on.
    pub ended: Option<Utc>,
    /// What the robot reported.
    pub fault: Option<Fault>,
    /// Why the robot refused.
    pub refusal: Option<Reason>,
    /// Driven and spent so far.
    pub stats: WorkStats,
    /// Version of the robot's base software when it was granted.
    pub software: String,
    /// Where the robot was while it had it. None: it is an errand, an older version began it, or a part of it was lost or cannot be compared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub visited: Option<VisitedPlaces>,
}

impl Attempt {
    /// Attempts of errands are ordered behind this, by the moment of their offer; those of tasks before it, by their epoch.
    pub const ERRANDS_BEHIND: i64 = 1 << 32;
}

impl Record for Attempt {
    const TABLE: Table = Table::Attempt;
    body_is_json!();
    fn id(&self) -> String {
        self.attempt.to_string()
    }
    fn index(&self) -> Index {
        let parent = Some(self.attempt.subject.to_string().as_str().into());
        let order = match &self.attempt.subject {
            Subject::Task(_) => self.attempt.epoch as i64,
            Subject::Errand { .. } => self.offered.0.max(Self::ERRANDS_BEHIND + 1),
        };
        Index { state: Some(self.phase.number()), parent, order: Some(order) }
    }
}
