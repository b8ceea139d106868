//! What must be true of everything fleet ever wrote, read from the feed.

use midshift_core::desired_state::DesiredWork;
use midshift_core::fleet::rows::{RobotAuthority, RobotHolder};
use midshift_core::ids::{AttemptId, Subject};
use midshift_core::rows::{Entry, Record, Row, Table};
use midshift_core::task::{Attempt, AttemptPhase, TaskState};
use std::collections::BTreeMap;

#[derive(Default)]
struct Ledger {
    attempts: BTreeMap<AttemptId, AttemptPhase>,
    tasks: BTreeMap<String, TaskState>,
    holders: BTreeMap<String, RobotHolder>,
    generations: BTreeMap<String, u64>,
}

/// Panics on the first entry that breaks a law.
pub fn hold(entries: &[Entry]) {
    let mut ledger = Ledger::default();
    for entry in entries {
        // Deleted only for its age.
        let by_age = ["task.forgotten", "errand.forgotten", "robot.forgotten"];
        let is_forgotten = entry.body.is_none() && by_age.contains(&&*entry.kind);
        match entry.table.filter(|_| !is_forgotten) {
            Some(Table::Attempt) => ledger.attempt(&row(entry)),
            Some(Table::TaskState) => ledger.task(row(entry)),
            Some(Table::RobotAuthority) => ledger.holder(row(entry)),
            Some(Table::DesiredWork) => ledger.desired(&row(entry)),
            _ => {}
        }
    }
}

fn row<R: Record>(entry: &Entry) -> R {
    let key = midshift_core::rows::Key { table: R::TABLE, id: entry.subject.clone() };
    let body = entry.body.clone().unwrap_or_else(|| panic!("{key:?} was deleted"));
    Row { key, revision: entry.revision, index: entry.index.clone(), body }.decode().expect("a row")
}

impl Ledger {
    fn attempt(&mut self, a: &Attempt) {
        if let Some(was) = self.attempts.insert(a.attempt.clone(), a.phase) {
            let may = was == a.phase || was.transitions().contains(&a.phase);
            assert!(may, "{} went from {was:?} to {:?}", a.attempt, a.phase);
        }
        let of_task = |id: &AttemptId| id.subject == a.attempt.subject && matches!(id.subject, Subject::Task(_));
        let done = self.attempts.iter().filter(|(id, p)| of_task(id) && **p == AttemptPhase::Succeeded).count();
        assert!(done <= 1, "{} was completed twice", a.attempt);
        let live = self.attempts.iter().filter(|(id, p)| of_task(id) && !p.is_terminal()).count();
        assert!(live <= 1, "{} is live twice", a.attempt);
    }

    fn task(&mut self, task: TaskState) {
        let id = task.task_id.to_string();
        if let Some(was) = self.tasks.get(&id) {
            assert!(!was.phase.is_terminal(), "{id} moved after {:?}", was.phase);
            assert!(task.epoch >= was.epoch, "{id}: the epoch fell");
        }
        self.tasks.insert(id, task);
    }

    fn holder(&mut self, authority: RobotAuthority) {
        let id = authority.robot_id.to_string();
        let was = self.holders.insert(id.clone(), authority.holder.clone()).unwrap_or_default();
        let taken = |h: &RobotHolder| *h != RobotHolder::None;
        let handed = taken(&was) && taken(&authority.holder) && was != authority.holder;
        assert!(!handed, "{id} went from {was:?} to {:?} without being free", authority.holder);
    }

    fn desired(&mut self, work: &DesiredWork) {
        let was = self.generations.insert(work.robot_id.to_string(), work.generation).unwrap_or(0);
        assert!(work.generation > was, "the generation of {} did not rise", work.robot_id);
    }
}
