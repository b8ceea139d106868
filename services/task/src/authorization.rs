//! What a caller may do to tasks, and to what is held: by the areas in which they lie.
//!
//! Invariant: each thing that is named must be in reach of its own; a task that a caller may not see is not there for it.

use crate::TaskService;
use crate::rows::{TaskRows, not_found, read, read_many, unavailable};
use midshift_core::fleet::rows::Place;
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{AreaId, RobotId, TaskId};
use midshift_core::limits;
use midshift_core::reason::Refusal;
use midshift_core::rows::Record;
use midshift_core::task::Ask;
use midshift_store::{Cursor, Query};
use std::collections::{BTreeMap, BTreeSet};

impl TaskService {
    /// A task that a caller may do that to.
    pub async fn read_authorized(
        &self,
        task_id: &TaskId,
        by: &Caller,
        permission: Permission,
    ) -> Result<TaskRows, Refusal> {
        let task = read(self.store(), task_id).await?;
        self.authorize_task(&task, by, permission)?;
        Ok(task)
    }

    pub(crate) fn authorize_task(&self, task: &TaskRows, by: &Caller, permission: Permission) -> Result<(), Refusal> {
        if by.is_permitted_everywhere(permission) && by.is_permitted_everywhere(Permission::Read) {
            return Ok(());
        }
        let areas = self.inner.parts.site.areas_of_task(&task.intake.spec);
        by.authorize_visible(permission, &areas, || not_found(&task.state.task_id))
    }

    /// Whether a caller may let go what this names. A stop that is named alone means everywhere, and needs a right that holds there.
    pub async fn authorize_resume(&self, ask: &Ask, by: &Caller) -> Result<(), Refusal> {
        let operate = Permission::Operate;
        let Ask::ResumeHeld { area_id, task_ids, robot_ids, .. } = ask else { return Ok(()) };
        if by.is_permitted_everywhere(operate) {
            return Ok(());
        }
        if area_id.is_none() && task_ids.is_empty() && robot_ids.is_empty() {
            return by.authorize(operate, []);
        }
        area_id.iter().try_for_each(|area_id| by.authorize(operate, [area_id]))?;
        // With a task the robot goes on that works on it, wherever that stands.
        let mut robots: BTreeSet<RobotId> = robot_ids.iter().cloned().collect();
        let tasks = read_many(self.store(), task_ids).await?;
        for task in &tasks {
            self.authorize_task(task, by, operate)?;
            robots.extend(task.state.robot_id.clone());
        }
        // One that does not exist is answered as one that the caller may not see.
        let is_there = |id: &&TaskId| tasks.iter().any(|task| task.state.task_id == **id);
        if let Some(missing) = task_ids.iter().find(|id| !is_there(id)) {
            return Err(not_found(missing));
        }
        if robots.is_empty() {
            return Ok(());
        }
        let areas = self.areas_of_robots().await?;
        robots.iter().try_for_each(|robot_id| by.authorize(operate, areas.get(robot_id).into_iter().flatten()))
    }

    /// The areas of the places that robots hold: here no heartbeat is heard. Of a robot that holds none nothing is known.
    async fn areas_of_robots(&self) -> Result<BTreeMap<RobotId, BTreeSet<AreaId>>, Refusal> {
        let mut areas: BTreeMap<RobotId, BTreeSet<AreaId>> = BTreeMap::new();
        let mut after = None;
        loop {
            let query = Query { after, limit: limits::PAGE_MAX, ..Query::all(Place::TABLE) };
            let rows = self.store().list(query).await.map_err(unavailable)?;
            let Some(last) = rows.last() else { return Ok(areas) };
            after = Some(Cursor::of_row(last));
            for row in &rows {
                let place: Place = row.decode().map_err(unavailable)?;
                for holder in &place.holders {
                    let own = self.inner.parts.site.areas_of_place(&place.place_id);
                    areas.entry(holder.robot_id.clone()).or_default().extend(own);
                }
            }
        }
    }
}
