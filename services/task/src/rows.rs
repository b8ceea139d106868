//! Reads a task's rows and shows them as one message.

use midshift_core::fleet::requests::allowed_resolutions;
use midshift_core::fleet::rows::{RobotAuthority, RobotHolder};
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::rows::{BadRow, Key, Record, Revision, Row, Table};
use midshift_core::site::Site;
use midshift_core::task::{Attempt, Resolution, TaskIntake, TaskState};
use midshift_core::unknown_rows;
use midshift_proto::convert::task::{TaskView, encode_task};
use midshift_proto::task::v1;
use midshift_store::{Error, Store, load};
use std::collections::{BTreeMap, BTreeSet};

/// A task with all that is shown of it.
pub struct TaskRows {
    /// What was asked for.
    pub intake: TaskIntake,
    /// Where it is.
    pub state: TaskState,
    /// Of the state.
    pub revision: Revision,
    /// The live or last attempt.
    pub attempt: Option<Attempt>,
    /// What a person may answer.
    pub allowed: Vec<Resolution>,
}

impl TaskRows {
    /// A task as its admission writes it.
    pub fn born(intake: TaskIntake) -> Self {
        let state = TaskState::born(&intake);
        let allowed = allowed_resolutions(state.phase, false, false);
        Self { intake, state, revision: Revision(1), attempt: None, allowed }
    }

    /// As a message.
    pub fn encode(&self) -> v1::Task {
        encode_task(TaskView {
            intake: &self.intake,
            state: &self.state,
            revision: self.revision,
            attempt: self.attempt.as_ref(),
            allowed: &self.allowed,
        })
    }
}

/// A store that did not answer.
pub fn unavailable(error: impl std::fmt::Display) -> Refusal {
    Refusal::new(Kind::Unavailable, Reason::new(Code::StoreUnavailable, error.to_string()))
}

/// No such task.
pub fn not_found(task_id: &TaskId) -> Refusal {
    Refusal::new(Kind::NotFound, Reason::from(Code::TaskNotFound).with("task_id", task_id))
}

/// One task that this caller may see.
pub async fn read_for(store: &dyn Store, site: &Site, by: &Caller, task_id: &TaskId) -> Result<TaskRows, Refusal> {
    let task = read(store, task_id).await?;
    if sees(site, by, &task.intake) { Ok(task) } else { Err(not_found(task_id)) }
}

/// Whether a caller may see a task: all areas of its goals.
pub fn sees(site: &Site, by: &Caller, intake: &TaskIntake) -> bool {
    by.is_permitted_everywhere(Permission::Read)
        || by.is_permitted_in(Permission::Read, &site.areas_of_task(&intake.spec))
}

/// One task.
pub async fn read(store: &dyn Store, task_id: &TaskId) -> Result<TaskRows, Refusal> {
    if let Some(task) = read_many(store, std::slice::from_ref(task_id)).await?.pop() {
        return Ok(task);
    }
    let rows = store.get(vec![Key::new(Table::TaskState, task_id.as_str())]).await.map_err(unavailable)?;
    let unread = rows.iter().find_map(|row| Some(unknown_rows::reason(row, &row.decode::<TaskState>().err()?)));
    Err(unread.map_or_else(|| not_found(task_id), |reason| Refusal::new(Kind::Precondition, reason)))
}

/// These tasks, in this order. Left out: those that do not exist, and those with a value of a newer version.
pub async fn read_many(store: &dyn Store, ids: &[TaskId]) -> Result<Vec<TaskRows>, Refusal> {
    join(store, ids).await.map_err(unavailable)
}

/// The first of these robots that is not enrolled and has never connected.
pub async fn unknown_robot<'r>(store: &dyn Store, robot_ids: &'r [RobotId]) -> Result<Option<&'r RobotId>, Refusal> {
    let keys = |id: &RobotId| [Table::RobotIdentity, Table::Session].map(|table| Key::new(table, id.as_str()));
    let known = by_key(store, robot_ids.iter().flat_map(keys).collect()).await.map_err(unavailable)?;
    Ok(robot_ids.iter().find(|id| !keys(id).iter().any(|key| known.contains_key(key))))
}

async fn by_key(store: &dyn Store, keys: Vec<Key>) -> Result<BTreeMap<Key, Row>, Error> {
    if keys.is_empty() {
        return Ok(BTreeMap::new());
    }
    Ok(store.get(keys).await?.into_iter().map(|row| (row.key.clone(), row)).collect())
}

/// What a row holds; none: a value of a newer version.
fn known<R: Record>(row: &Row) -> Result<Option<R>, BadRow> {
    match row.decode() {
        Ok(record) => Ok(Some(record)),
        Err(error) if error.is_unknown() => Ok(None),
        Err(error) => Err(error),
    }
}

async fn join(store: &dyn Store, ids: &[TaskId]) -> Result<Vec<TaskRows>, Error> {
    let keys = |table| ids.iter().map(move |id| Key::new(table, id.as_str()));
    let mut intakes = BTreeMap::new();
    let mut states = BTreeMap::new();
    for row in store.get(keys(Table::TaskIntake).chain(keys(Table::TaskState)).collect()).await? {
        match row.key.table {
            Table::TaskIntake => {
                drop(known::<TaskIntake>(&row)?.map(|intake| intakes.insert(row.key.id.to_string(), intake)))
            }
            _ => drop(
                known::<TaskState>(&row)?.map(|state| states.insert(row.key.id.to_string(), (state, row.revision))),
            ),
        }
    }
    let attempts = states.values().filter_map(|(s, _)| s.attempt_id()).map(|a| Key::new(Table::Attempt, a.to_string()));
    let robots = states.values().filter_map(|(s, _)| s.robot_id.as_ref());
    let robots = robots.map(|r| Key::new(Table::RobotAuthority, r.as_str()));
    let named: BTreeSet<Key> = attempts.chain(robots).collect();
    let named = by_key(store, named.into_iter().collect()).await?;
    let mut tasks = Vec::new();
    for id in ids {
        let (Some(intake), Some((state, revision))) = (intakes.remove(id.as_str()), states.remove(id.as_str())) else {
            continue;
        };
        let attempt = state.attempt_id().map(|a| Key::new(Table::Attempt, a.to_string()));
        let attempt = attempt.and_then(|key| named.get(&key)).map(known::<Attempt>).transpose()?.flatten();
        let holder = state.robot_id.as_ref().map(|r| Key::new(Table::RobotAuthority, r.as_str()));
        let holder = holder.and_then(|key| named.get(&key)).map(known::<RobotAuthority>).transpose()?.flatten();
        let kept = holder.is_some_and(|h| keeps(&h, &state));
        let allowed = allowed_resolutions(state.phase, state.opened_robot_id.is_some(), kept);
        tasks.push(TaskRows { intake, state, revision, attempt, allowed });
    }
    Ok(tasks)
}

/// Whether a robot is kept for the newest attempt of a task.
fn keeps(authority: &RobotAuthority, state: &TaskState) -> bool {
    matches!(&authority.holder, RobotHolder::Attempt(held) if Some(held) == state.attempt_id().as_ref())
}

/// Whether the task's robot is kept for its newest attempt, as the rows are now.
pub async fn robot_kept(store: &dyn Store, state: &TaskState) -> Result<bool, Error> {
    let Some(robot_id) = &state.robot_id else { return Ok(false) };
    let found = load::<RobotAuthority>(store, robot_id.as_str()).await?;
    Ok(found.is_some_and(|(authority, _)| keeps(&authority, state)))
}

/// Whether there is a task of this id that a caller may see.
pub async fn are_seen(store: &dyn Store, site: &Site, by: &Caller, ids: &[TaskId]) -> Result<Vec<bool>, Refusal> {
    let key = |id: &TaskId| Key::new(Table::TaskIntake, id.as_str());
    let found = by_key(store, ids.iter().map(key).collect()).await.map_err(unavailable)?;
    let seen = |row: &Row| -> Result<bool, BadRow> {
        Ok(by.is_permitted_everywhere(Permission::Read) || sees(site, by, &row.decode::<TaskIntake>()?))
    };
    let seen = ids.iter().map(|id| found.get(&key(id)).map_or(Ok(false), seen));
    seen.collect::<Result<_, BadRow>>().map_err(unavailable)
}
