//! Tasks that wait for a robot: the ready ones in the order in which they are served, and of each other one what it waits for first.
//!
//! `index` puts a task anew when its rows change; `assignment::readiness` brings it up to now; the planner and the explanations read.
//! Invariants:
//! 1. The order is total: two processes that have read the same rows serve the same task first.
//! 2. A task that is not ready is looked at only when what it waits for may have come: its time, the end of a task, its last hold.

use super::broken_steps::StepAt;
use crate::ids::{RobotId, TaskId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::task::spec::Class;
use crate::task::state::OPERATOR_HOLD;
use crate::task::{Phase, TaskIntake, TaskState};
use crate::time::Utc;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::OnceLock;

/// Ready tasks from one milestone to the next: what a question about a position counts at most.
const MILESTONE: usize = 64;

/// Where a ready task stands. The smallest is served first.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Rank {
    /// Class by priority, one up for each [`limits::MAX_WAIT`] that it is ready with this priority.
    pub class: Class,
    /// It came up by waiting: after those whose class is their own.
    pub promoted: bool,
    /// Of equal class the smaller goes first; 0 once promoted, where only age counts.
    priority: u8,
    /// UTC, site clock, since when it is ready, or the first that it stands for by its key.
    pub since: Utc,
    /// Admission number. Several processes may give the same one.
    number: u64,
    /// Makes the order total.
    pub task_id: TaskId,
    /// UTC, site clock, from when on it is promoted: since it is ready with this priority.
    promoted_from: Utc,
}

impl Rank {
    fn of_task(task: &TaskState, intake: &TaskIntake, since: Utc, now: Utc) -> Self {
        let since = task.asked_since.map_or(since, |asked| asked.min(since));
        let priority = task.priority(intake);
        let promoted_from = task.priority_since.map_or(since, |changed| changed.max(since));
        let class = Class::from_priority(priority, promotions(promoted_from, now));
        let promoted = class != Class::from_priority(priority, 0);
        let (priority, task_id) = (if promoted { 0 } else { priority }, task.task_id.clone());
        Self { class, promoted, priority, since, number: task.number, task_id, promoted_from }
    }
}

impl Rank {
    /// As if it had not waited.
    pub(in crate::fleet) fn unpromoted(self, priority: u8) -> Self {
        Self { class: Class::from_priority(priority, 0), promoted: false, priority, ..self }
    }
}

/// How often a task that is ready `since` has been promoted.
fn promotions(since: Utc, now: Utc) -> u64 {
    now.ms_since(since) / limits::MAX_WAIT.as_ms()
}

/// How a task ended that others wait for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ended {
    /// A phase that ends.
    pub phase: Phase,
    /// The robot that had it last, if any took it.
    pub robot_id: Option<RobotId>,
}

impl From<&TaskState> for Ended {
    fn from(task: &TaskState) -> Self {
        Self { phase: task.phase, robot_id: task.robot_id.clone().filter(|_| task.started.is_some()) }
    }
}

/// What a task that wants a robot waits for first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Wait {
    /// Its turn.
    Turn(Rank),
    /// A step that is broken at its place; with where it stands but for that.
    Step(StepAt, Rank),
    /// Its turn, once it is written since when.
    Mark,
    /// Its time, UTC on the site clock.
    Time(Utc),
    /// The last of the tokens that hold it.
    Hold(String),
    /// The end of another task: its success, or which robot had it.
    Dependency(TaskId),
    /// The success of another task, which ended otherwise, or its robot, which it never had.
    Failed(TaskId),
}

impl Wait {
    /// What a task waits for, whatever its phase.
    pub fn of_task(task: &TaskState, intake: &TaskIntake, ended: &BTreeMap<TaskId, Ended>, now: Utc) -> Self {
        if let Some(at) = task.not_before(intake).filter(|at| *at > now) {
            return Self::Time(at);
        }
        if let Some(token) = task.holds.first() {
            return Self::Hold(token.clone());
        }
        let (depends_on, same_robot_as) = (&intake.spec.depends_on, &intake.spec.same_robot_as);
        // A person has said which robot.
        let is_edited = task.edit.robot_id.is_some();
        for id in intake.spec.waits_for() {
            let (is_for_robot, must_succeed) = (same_robot_as.as_ref() == Some(id), depends_on.contains(id));
            if task.same_robot.is_some() && !must_succeed {
                continue;
            }
            let Some(end) = ended.get(id) else { return Self::Dependency(id.clone()) };
            let lacks_robot = is_for_robot && end.robot_id.is_none() && !is_edited;
            if lacks_robot || (end.phase != Phase::Succeeded && must_succeed) {
                return Self::Failed(id.clone());
            }
        }
        let is_marked = same_robot_as.is_none() || task.same_robot.is_some() || is_edited;
        let since = task.ready_since.filter(|_| is_marked);
        since.map_or(Self::Mark, |since| Self::Turn(Rank::of_task(task, intake, since, now)))
    }
    /// What it waits for, in one word.
    fn code(&self) -> Code {
        self.reason().map_or(Code::WaitingForRobot, |reason| reason.code)
    }
    /// Why it is not offered yet; none: it may be.
    pub fn reason(&self) -> Option<Reason> {
        Some(match self {
            Self::Turn(_) | Self::Mark => return None,
            Self::Step(at, _) => {
                Reason::from(Code::PlaceBroken).with("waypoint", &at.waypoint).with("action", &at.action)
            }
            Self::Time(_) => Code::WaitingForTime.into(),
            Self::Hold(token) if token == OPERATOR_HOLD => Code::HoldByPerson.into(),
            Self::Hold(token) => Reason::from(Code::WaitingForHold).with("token", token),
            Self::Dependency(id) => Reason::from(Code::WaitingForDependency).with("task_id", id),
            Self::Failed(id) => Reason::from(Code::DependencyFailed).with("task_id", id),
        })
    }
}

/// What a task waits for, and when that is to be looked at again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::fleet) struct Waiting {
    pub(in crate::fleet) wait: Wait,
    /// UTC: its time, or its next promotion. None: time alone changes nothing.
    due: Option<Utc>,
    /// UTC: since when it waits in the queue. None: it is not ready.
    age: Option<Utc>,
    /// UTC: when it is looked at whether any known robot could ever do it. None: it is not ready.
    check: Option<Utc>,
}

impl Waiting {
    fn from_wait(wait: Wait, queued_since: Utc, now: Utc) -> Self {
        let after = |since: Utc| since.plus_ms(limits::MAX_WAIT.as_ms() * (promotions(since, now) + 1));
        let age = match &wait {
            Wait::Turn(rank) => Some(rank.since.max(queued_since)),
            _ => None,
        };
        let due = match &wait {
            Wait::Time(at) => Some(*at),
            Wait::Turn(rank) => Some(after(rank.promoted_from)),
            Wait::Step(..) | Wait::Mark | Wait::Hold(_) | Wait::Dependency(_) | Wait::Failed(_) => None,
        };
        Self { wait, due, age, check: age.map(after) }
    }
}

/// Tasks that wait for a robot.
#[derive(Clone, Debug, Default)]
pub struct Queue {
    /// UTC up to which time has done its work on it.
    pub(in crate::fleet) now: Utc,
    pub(in crate::fleet) waiting: BTreeMap<TaskId, Waiting>,
    pub(in crate::fleet) ready: BTreeSet<Rank>,
    /// Every [`MILESTONE`]th ready task, counted at the first question after the queue changed.
    milestones: OnceLock<Vec<Rank>>,
    /// When time changes what a task waits for, or its rank.
    pub(in crate::fleet) due: BTreeSet<(Utc, TaskId)>,
    /// Tasks by the one whose end they wait for.
    pub(in crate::fleet) dependents: BTreeMap<TaskId, BTreeSet<TaskId>>,
    /// Tasks that would be ready, by the broken step that bars them.
    barred: BTreeMap<StepAt, BTreeSet<Rank>>,
    /// Tasks by what they wait for.
    counts: BTreeMap<Code, usize>,
    /// Tasks that wait for what can never be.
    pub(in crate::fleet) failed: BTreeSet<TaskId>,
    /// Ready tasks by when they began to wait.
    ages: BTreeSet<(Utc, TaskId)>,
    /// Ready tasks by when they are looked at next.
    pub(in crate::fleet) checks: BTreeSet<(Utc, TaskId)>,
    /// Ready tasks that are to be looked at now.
    pub(in crate::fleet) unchecked: BTreeSet<TaskId>,
    /// Tasks that began or ended to be ready since the planner last looked.
    pub(in crate::fleet) moved: BTreeSet<TaskId>,
    /// Ready tasks that came since the last walk began.
    news: BTreeSet<Rank>,
    /// The walk that goes on in the next turn.
    paused: Option<Walk>,
    /// Robots that found nothing on the last walk.
    left: BTreeSet<RobotId>,
}

/// One way along the queue, in the order in which tasks are served, as long as it may take.
#[derive(Clone, Debug)]
pub struct Walk {
    /// Robots that walk: those that were there when it began.
    pub robots: BTreeSet<RobotId>,
    /// Only these tasks; none: all that are ready.
    only: Option<BTreeSet<Rank>>,
    /// How far it is.
    after: Option<Rank>,
}

impl Walk {
    /// Whether it leads along tasks that are new, which are shown once.
    pub(in crate::fleet) fn is_of_news(&self) -> bool {
        self.only.is_some()
    }
}

impl Queue {
    /// An empty queue at a moment.
    pub fn new(now: Utc) -> Self {
        Self { now, ..Self::default() }
    }
    /// Ready tasks in the order in which they are served.
    pub fn ready(&self) -> impl Iterator<Item = &TaskId> {
        self.ready.iter().map(|rank| &rank.task_id)
    }
    /// Whether no task is ready.
    pub fn is_empty(&self) -> bool {
        self.ready.is_empty()
    }
    /// Where a task stands; none: it is not ready.
    pub fn rank(&self, task_id: &TaskId) -> Option<&Rank> {
        match &self.waiting.get(task_id)?.wait {
            Wait::Turn(rank) => Some(rank),
            _ => None,
        }
    }
    /// How many ready tasks are served up to a task, itself included; none: it is not ready. However long the queue is, a question counts
    /// `MILESTONE` tasks at most.
    pub fn position(&self, task_id: &TaskId) -> Option<usize> {
        let rank = self.rank(task_id)?;
        let milestones = self.milestones();
        let passed = milestones.partition_point(|milestone| milestone <= rank);
        let last = passed.checked_sub(1).map_or(Bound::Unbounded, |at| Bound::Excluded(&milestones[at]));
        Some(passed * MILESTONE + self.ready.range((last, Bound::Included(rank))).count())
    }
    fn milestones(&self) -> &Vec<Rank> {
        let every = || self.ready.iter().skip(MILESTONE - 1).step_by(MILESTONE).cloned().collect();
        self.milestones.get_or_init(every)
    }
    /// Of the tasks that a broken step bars the one behind `last` in the order of the queue, or the first.
    pub(in crate::fleet) fn next_barred(&self, at: &StepAt, last: Option<&Rank>) -> Option<&TaskId> {
        let barred = self.barred.get(at)?;
        let behind = last.and_then(|last| barred.range((Bound::Excluded(last), Bound::Unbounded)).next());
        behind.or_else(|| barred.first()).map(|rank| &rank.task_id)
    }
    /// Tasks that a broken step bars.
    pub(in crate::fleet) fn barred(&self, at: &StepAt) -> impl Iterator<Item = &TaskId> {
        self.barred.get(at).into_iter().flatten().map(|rank| &rank.task_id)
    }
    /// Tasks that wait, by what for.
    pub fn counts(&self) -> impl Iterator<Item = (Code, u64)> {
        self.counts.iter().map(|(code, tasks)| (*code, *tasks as u64))
    }
    /// The ready task that waits in the queue longest, and since when; none: no task is ready.
    pub fn oldest(&self) -> Option<(Utc, &TaskId)> {
        self.ages.first().map(|(since, task_id)| (*since, task_id))
    }
    /// Forgets what the planner would have to look at.
    pub fn rest(&mut self) {
        self.moved.clear();
        self.news.clear();
    }

    /// The walk that was paused, if any of its robots is still `present`. Else robots that have not walked, or were `heard` since, walk along
    /// all ready tasks; if there is none, everybody walks along the new tasks.
    pub(in crate::fleet) fn walk(&mut self, present: &BTreeSet<RobotId>, heard: &BTreeSet<RobotId>) -> Walk {
        if let Some(walk) = self.paused.take().filter(|walk| !walk.robots.is_disjoint(present)) {
            return walk;
        }
        self.left.retain(|robot_id| present.contains(robot_id) && !heard.contains(robot_id));
        let fresh: BTreeSet<RobotId> = present.difference(&self.left).cloned().collect();
        if fresh.is_empty() {
            return Walk { robots: present.clone(), only: Some(std::mem::take(&mut self.news)), after: None };
        }
        if self.left.is_empty() {
            self.news.clear();
        }
        Walk { robots: fresh, only: None, after: None }
    }
    /// Something else than its place changed of a ready task: robots that passed it over look at it again.
    pub(in crate::fleet) fn show_again(&mut self, task_id: &TaskId) {
        let rank = self.rank(task_id).cloned();
        self.news.extend(rank);
    }
    /// The walk goes on in the next turn.
    pub(in crate::fleet) fn pause(&mut self, walk: Walk) {
        self.paused = Some(walk);
    }
    /// A walk is over, and these robots found nothing. True: of those `present` somebody has more to look at.
    pub(in crate::fleet) fn end(&mut self, walk: &Walk, left: BTreeSet<RobotId>, present: &BTreeSet<RobotId>) -> bool {
        self.left.extend(left);
        let walked = |robot_id: &RobotId| walk.robots.contains(robot_id) || self.left.contains(robot_id);
        !present.iter().all(walked) || !(self.news.is_empty() || self.left.is_empty())
    }
    /// Whether everybody `present` found nothing, was not `heard` since, and no task came.
    pub(in crate::fleet) fn is_seen_by_all(&mut self, present: &BTreeSet<RobotId>, heard: &BTreeSet<RobotId>) -> bool {
        self.news.is_empty() && self.paused.is_none() && self.rested(present, heard).len() == present.len()
    }
    /// Robots of those `present` that found nothing, and were not `heard` since.
    pub(in crate::fleet) fn rested(
        &mut self,
        present: &BTreeSet<RobotId>,
        heard: &BTreeSet<RobotId>,
    ) -> BTreeSet<RobotId> {
        self.left.retain(|robot_id| present.contains(robot_id) && !heard.contains(robot_id));
        self.left.clone()
    }
    /// Ready tasks that came since they were last taken: whoever rests has not seen them.
    pub(in crate::fleet) fn take_news(&mut self) -> BTreeSet<Rank> {
        std::mem::take(&mut self.news)
    }
    /// These robots found nothing.
    pub(in crate::fleet) fn let_rest(&mut self, robots: BTreeSet<RobotId>) {
        self.left = robots;
    }
    /// The next task of a walk.
    pub(in crate::fleet) fn next(&self, walk: &mut Walk) -> Option<TaskId> {
        let tasks = walk.only.as_ref().unwrap_or(&self.ready);
        let from = walk.after.as_ref().map_or(Bound::Unbounded, Bound::Excluded);
        let mut tasks = tasks.range((from, Bound::Unbounded)).filter(|rank| self.ready.contains(*rank));
        walk.after = Some(tasks.next()?.clone());
        walk.after.as_ref().map(|rank| rank.task_id.clone())
    }

    pub(in crate::fleet) fn set_wait(&mut self, task_id: &TaskId, wait: Option<(Wait, Utc)>) {
        let now = self.now;
        let new = wait.map(|(wait, queued_since)| Waiting::from_wait(wait, queued_since, now));
        if self.waiting.get(task_id) == new.as_ref() {
            return;
        }
        if let Some(old) = self.waiting.remove(task_id) {
            self.take_out(task_id, &old);
        }
        let Some(new) = new else {
            self.moved.remove(task_id);
            self.unchecked.remove(task_id);
            return;
        };
        match &new.wait {
            Wait::Turn(rank) => {
                self.milestones.take();
                self.ready.insert(rank.clone());
                self.news.insert(rank.clone());
            }
            Wait::Step(at, rank) => drop(self.barred.entry(at.clone()).or_default().insert(rank.clone())),
            Wait::Dependency(on) => drop(self.dependents.entry(on.clone()).or_default().insert(task_id.clone())),
            Wait::Failed(_) => drop(self.failed.insert(task_id.clone())),
            Wait::Mark | Wait::Time(_) | Wait::Hold(_) => {}
        }
        self.due.extend(new.due.map(|at| (at, task_id.clone())));
        self.ages.extend(new.age.map(|at| (at, task_id.clone())));
        self.checks.extend(new.check.map(|at| (at, task_id.clone())));
        *self.counts.entry(new.wait.code()).or_default() += 1;
        self.waiting.insert(task_id.clone(), new);
        self.moved.insert(task_id.clone());
    }

    fn take_out(&mut self, task_id: &TaskId, old: &Waiting) {
        match &old.wait {
            Wait::Turn(rank) => {
                self.milestones.take();
                self.ready.remove(rank);
                self.news.remove(rank);
            }
            Wait::Step(at, rank) => {
                if let Some(barred) = self.barred.get_mut(at) {
                    barred.remove(rank);
                    if barred.is_empty() {
                        self.barred.remove(at);
                    }
                }
            }
            Wait::Dependency(on) => {
                if let Some(waiting) = self.dependents.get_mut(on) {
                    waiting.remove(task_id);
                    if waiting.is_empty() {
                        self.dependents.remove(on);
                    }
                }
            }
            Wait::Failed(_) => drop(self.failed.remove(task_id)),
            Wait::Mark | Wait::Time(_) | Wait::Hold(_) => {}
        }
        let forget = |from: &mut BTreeSet<(Utc, TaskId)>, at: Option<Utc>| {
            if let Some(at) = at {
                from.remove(&(at, task_id.clone()));
            }
        };
        forget(&mut self.due, old.due);
        forget(&mut self.ages, old.age);
        forget(&mut self.checks, old.check);
        if old.check.is_some_and(|at| at <= self.now) {
            self.unchecked.insert(task_id.clone());
        }
        if let Some(count) = self.counts.get_mut(&old.wait.code()) {
            *count -= 1;
        }
    }
}

/// Tasks whose wait changes in one turn at most; the others follow in the next.
pub(in crate::fleet) const TASKS_PER_TURN: usize = 4_096;

#[cfg(test)]
mod tests {
    use super::*;

    fn rank(n: u64) -> Rank {
        let task_id = TaskId::parse(&format!("T{n:04}")).expect("an id");
        let (class, since) = (Class::from_priority(5, 0), Utc(0));
        Rank { class, promoted: false, priority: 5, since, number: n, task_id, promoted_from: since }
    }

    #[test]
    fn positions_are_counted_from_what_was_prepared_at_the_first_question_and_again_once_the_queue_changed() {
        for many in [0, 1, 63, 64, 65, 1_000] {
            let mut queue = Queue::new(Utc(0));
            for n in 0..many {
                queue.set_wait(&rank(n).task_id, Some((Wait::Turn(rank(n)), Utc(0))));
            }
            let prepared = queue.milestones().as_ptr();
            for n in 0..many {
                assert_eq!(queue.position(&rank(n).task_id), Some(n as usize + 1), "of {many}");
            }
            assert_eq!(queue.milestones().as_ptr(), prepared, "nothing was prepared anew");
            assert!(queue.milestones().len() == many as usize / MILESTONE);
            assert_eq!(queue.position(&rank(many).task_id), None);
            if many > 1 {
                queue.set_wait(&rank(0).task_id, None);
                assert_eq!(queue.position(&rank(many - 1).task_id), Some(many as usize - 1));
            }
        }
    }
}
