//! Reads rows into the projection: from a snapshot, from the feed, and again after a conflict; lets go of what is over.
//!
//! Invariant: a row here is at the revision it has in the store, or one that an item of the running cycle will write.
//! After a conflict the whole projection is built again; after a refusal only the rows of what was refused are read
//! again.

use super::index;
use super::rows::{RobotAuthority, RobotHolder};
use super::state::FleetProjection;
use crate::ids::TaskId;
use crate::limits;
use crate::rows::{BadRow, Key, Revision, Row, RowSelection, Seq, Table};
use crate::task::figures::TaskFigures;
use crate::task::{AttemptPhase, Phase, TaskIntake, TaskState};

/// What the projection begins with: all that is alive. [`named`] says what is read with it.
pub fn alive() -> Vec<RowSelection> {
    let tasks = Phase::ALL.into_iter().filter(|p| !p.is_terminal()).map(Phase::number);
    let attempts = AttemptPhase::ALL.into_iter().filter(|p| !p.is_terminal()).map(AttemptPhase::number);
    let in_states = [
        RowSelection::InStates(Table::TaskState, tasks.collect()),
        RowSelection::InStates(Table::Attempt, attempts.collect()),
    ];
    FleetProjection::WHOLE.iter().map(|table| RowSelection::Whole(*table)).chain(in_states).collect()
}

/// What rows of the projection name: of a task that has not ended what was asked for, its newest attempt, and the tasks
/// that it waits for; of a robot the attempt that holds it.
pub fn named(rows: &[Row]) -> Vec<Key> {
    let mut keys = Vec::new();
    for row in rows {
        match row.key.table {
            Table::TaskState => {
                let Ok(task) = row.decode::<TaskState>() else { continue };
                if !task.phase.is_terminal() {
                    keys.push(Key { table: Table::TaskIntake, id: row.key.id.clone() });
                    keys.extend(task.attempt_id().map(|id| Key::new(Table::Attempt, id.to_string())));
                }
            }
            Table::TaskIntake => {
                let Ok(intake) = row.decode::<TaskIntake>() else { continue };
                keys.extend(intake.spec.waits_for().map(|id| Key::new(Table::TaskState, id.as_str())));
            }
            Table::RobotAuthority => {
                let holder = row.decode::<RobotAuthority>().map(|a| a.holder);
                if let Ok(RobotHolder::Attempt(id)) = holder {
                    keys.push(Key::new(Table::Attempt, id.to_string()));
                }
            }
            _ => {}
        }
    }
    keys
}

impl FleetProjection {
    /// Takes what was read at `seq` by [`alive`] and [`named`].
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn load(&mut self, rows: &[Row], seq: Seq) -> Result<(), BadRow> {
        for row in rows {
            self.absorb(&row.key, row.revision, Some(row))?;
        }
        self.read_at = seq;
        self.absorbed = self.marks.get("fleet").map_or(Seq(0), |m| m.row.seq);
        self.served = self.clocks.get("fleet").map(|c| c.row).unwrap_or_default();
        // Whatever a task waits for was asked with it.
        self.unasked.clear();
        self.forget_ended();
        self.let_go.clear();
        Ok(())
    }

    /// What is over and wanted all the same, and nobody has asked the store for: at most [`limits::ASKED_AT_ONCE`].
    pub fn wanted(&self) -> Vec<Key> {
        let ids = self.unasked.iter().take(limits::ASKED_AT_ONCE);
        ids.map(|id| Key::new(Table::TaskState, id.as_str())).collect()
    }

    /// Takes what the store has of `keys`, which were asked by id. What it does not have, or what has not ended, is
    /// told by the feed.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn apply_rows(&mut self, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
        for key in keys.iter().filter(|key| key.table == Table::TaskState) {
            if let Ok(id) = TaskId::parse(&key.id) {
                self.unasked.remove(&id);
            }
        }
        for row in rows {
            match row.key.table {
                Table::CommandKey => {
                    self.take_row(&row.key, row.revision, Some(row))?;
                }
                Table::TaskState => {
                    match row.decode::<TaskState>() {
                        Ok(task) if task.phase.is_terminal() => index::note_end(self, &task.task_id, (&task).into()),
                        Err(error) if !error.is_unknown() => return Err(error),
                        // It has not ended, as far as anybody here knows.
                        _ => {}
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Takes one row as the store has it; none: deleted. What this projection already has, or has let go on purpose, is
    /// passed over.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn absorb(&mut self, key: &Key, revision: Revision, row: Option<&Row>) -> Result<(), BadRow> {
        if let (Table::TaskState, None, Ok(task_id)) = (key.table, row, TaskId::parse(&key.id)) {
            self.ended.remove(&task_id);
        }
        if !self.has_row(key) && self.is_past(key) {
            return Ok(());
        }
        self.take_row(key, revision, row)
    }

    /// Puts a row as the store has it over what this projection had made of it. None: there is no such row.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn put_right(&mut self, key: &Key, row: Option<&Row>) -> Result<(), BadRow> {
        if let (Table::TaskState, Ok(task_id)) = (key.table, TaskId::parse(&key.id)) {
            self.let_go.remove(&task_id);
            index::note_open(self, &task_id);
        }
        self.absorb(key, Revision(u64::MAX), None)?;
        row.map_or(Ok(()), |row| self.absorb(key, row.revision, Some(row)))
    }

    /// A row that this projection has let go on purpose, or asks for by id alone.
    fn is_past(&self, key: &Key) -> bool {
        match key.table {
            Table::TaskIntake | Table::TaskState => {
                TaskId::parse(&key.id).is_ok_and(|id| self.let_go.contains_key(&id))
            }
            Table::CommandKey => true,
            _ => false,
        }
    }

    /// Lets go of tasks that have ended and of attempts that neither hold a robot nor are the newest of a live task. Gives back what the tasks
    /// came to.
    pub fn forget_ended(&mut self) -> Vec<TaskFigures> {
        // What is let go is committed after this, and comes by the feed before the feed is taken further than that.
        let absorbed = self.absorbed;
        self.let_go.retain(|_, at| *at >= absorbed);
        let ended: Vec<TaskId> =
            self.tasks.values().filter(|t| t.row.phase.is_terminal()).map(|t| t.row.task_id.clone()).collect();
        let mut figures = Vec::with_capacity(ended.len());
        for id in ended {
            let task = self.tasks.remove(id.as_str());
            if let Some(intake) = self.intakes.remove(id.as_str()) {
                figures.extend(task.map(|task| TaskFigures::of_rows(&task.row, &intake.row)));
                self.waits_no_more(&intake.row);
            }
            self.let_go.insert(id, absorbed);
        }
        self.command_keys.clear();
        let tasks = &self.tasks;
        let authority = &self.authority;
        self.attempts.retain(|_, a| {
            let a = &a.row;
            let holds = authority
                .get(a.robot_id.as_str())
                .is_some_and(|r| matches!(&r.row.holder, RobotHolder::Attempt(id) if *id == a.attempt));
            let newest = a
                .attempt
                .subject
                .task_id()
                .is_some_and(|t| tasks.get(t.as_str()).is_some_and(|t| t.row.epoch == a.attempt.epoch));
            holds || newest || !a.phase.is_terminal()
        });
        figures
    }

    /// Forgets what a planner would have to look at: whoever plans next begins with a projection of its own.
    pub fn rest(&mut self) {
        self.forget_ended();
        self.dirty.clear();
        self.policy_dirty.clear();
        self.queue.rest();
    }
}
