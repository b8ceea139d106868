//! The newest plans of `rolling`, each with all that it was decided by: the same decision can be made of it once more.
//!
//! `assignment::rolling` notes them; people read them. Memory of this process: no row, and gone with a start. Nothing is decided by them.
//! Invariant: some of the newest plans and no more of what they weighed than a bound, but always the newest.

use crate::ids::{RobotId, TaskId};
use crate::planner_policy::PlannerPolicy;
use crate::task::spec::Class;
use crate::time::Utc;
use std::collections::VecDeque;
use std::sync::Arc;

/// From when on a robot could do a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Free {
    /// It waits for work.
    Now,
    /// Once its errand was broken off.
    AfterErrand,
    /// By itself, soon.
    Soon,
}

/// A robot that a plan weighed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WeighedRobot {
    /// Which robot.
    pub robot_id: RobotId,
    /// From when on it could do a task.
    pub free: Free,
    /// In so many milliseconds.
    pub ready_ms: u64,
    /// What it costs beside time to take it from what it does, milliseconds on the way: charge that it does not get.
    pub loss_ms: u64,
    /// Tasks that it was given so far.
    pub tasks: u64,
}

/// A task that a plan weighed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WeighedTask {
    /// Which task.
    pub task_id: TaskId,
    /// Class, after promotions.
    pub class: Class,
    /// UTC, since when it is ready.
    pub since: Utc,
    /// UTC, when it must have ended; none: never.
    pub deadline: Option<Utc>,
}

/// A robot and a task that a plan weighed for each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WeighedPair {
    /// Index of the robot.
    pub robot: usize,
    /// Index of the task.
    pub task: usize,
    /// From where the robot is free to the task's first goal, millimetres.
    pub way_mm: u64,
    /// What the robot takes for that way beside a usual one, milliwatt-hours: less than 0 if less.
    pub energy_mwh: i64,
    /// The robot failed the task before.
    pub has_failed: bool,
    /// The task was meant for this robot in the plan before.
    pub is_meant: bool,
}

/// All that a plan weighed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Weighed {
    /// Robots, by id.
    pub robots: Vec<WeighedRobot>,
    /// Tasks, each once.
    pub tasks: Vec<WeighedTask>,
    /// Pairs that could be made, each once.
    pub pairs: Vec<WeighedPair>,
}

impl Weighed {
    fn size(&self) -> usize {
        self.robots.len() + self.tasks.len() + self.pairs.len()
    }
}

/// One plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanRecord {
    /// Counted since this process began.
    pub number: u64,
    /// UTC, site clock.
    pub at: Utc,
    /// What each thing weighed.
    pub policy: PlannerPolicy,
    /// What it was decided of.
    pub weighed: Weighed,
    /// The pairs that it made, as indices of robots and tasks, by robot.
    pub made: Vec<(usize, usize)>,
}

/// The newest plans. Volatile.
#[derive(Clone, Debug, Default)]
pub struct Plans {
    /// The oldest first.
    newest: VecDeque<Arc<PlanRecord>>,
    counted: u64,
    /// Robots, tasks and pairs of all of them.
    weighed: usize,
}

impl Plans {
    /// Plans that are remembered.
    pub const MAX: usize = 64;
    /// Robots, tasks and pairs of all of them, unless the newest alone has more: some 6 MB.
    const WEIGHED_MAX: usize = 100_000;

    /// The newest first.
    pub fn iter(&self) -> impl Iterator<Item = &Arc<PlanRecord>> {
        self.newest.iter().rev()
    }

    /// One by its number, or the newest. None: there was none, or it is forgotten.
    pub fn get(&self, number: Option<u64>) -> Option<&Arc<PlanRecord>> {
        self.iter().find(|plan| number.is_none_or(|number| plan.number == number))
    }

    /// Notes a plan.
    pub(in crate::fleet) fn note(
        &mut self,
        at: Utc,
        policy: &PlannerPolicy,
        weighed: Weighed,
        made: Vec<(usize, usize)>,
    ) {
        self.counted += 1;
        self.weighed += weighed.size();
        self.newest.push_back(Arc::new(PlanRecord { number: self.counted, at, policy: policy.clone(), weighed, made }));
        while self.newest.len() > Self::MAX || (self.weighed > Self::WEIGHED_MAX && self.newest.len() > 1) {
            let oldest = self.newest.pop_front();
            self.weighed -= oldest.map_or(0, |plan| plan.weighed.size());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::SiteId;

    fn noted(plans: &mut Plans, pairs: usize) {
        let pair = WeighedPair { robot: 0, task: 0, way_mm: 0, energy_mwh: 0, has_failed: false, is_meant: false };
        let weighed = Weighed { pairs: vec![pair; pairs], ..Weighed::default() };
        let policy = PlannerPolicy::default_of(SiteId::parse("hall").expect("an id"));
        plans.note(Utc(0), &policy, weighed, Vec::new());
    }

    #[test]
    fn the_newest_plans_are_remembered_as_far_as_there_is_room() {
        let numbers = |plans: &Plans| plans.iter().map(|plan| plan.number).collect::<Vec<_>>();
        let mut plans = Plans::default();
        assert!(plans.get(None).is_none());
        (0..Plans::MAX + 2).for_each(|_| noted(&mut plans, 1));
        assert_eq!(numbers(&plans), (3..=66).rev().collect::<Vec<_>>());
        assert_eq!(plans.get(None).map(|plan| plan.number), Some(66));
        assert!(plans.get(Some(2)).is_none() && plans.get(Some(3)).is_some());
        noted(&mut plans, Plans::WEIGHED_MAX - 1);
        assert_eq!(numbers(&plans), [67, 66]);
        noted(&mut plans, 2 * Plans::WEIGHED_MAX);
        assert_eq!(numbers(&plans), [68], "the newest stays, however large");
        noted(&mut plans, 1);
        assert_eq!(numbers(&plans), [69]);
    }
}
