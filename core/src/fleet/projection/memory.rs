//! What only this process knows, ahead of the rows: nothing of it goes through the store, and a start begins without it.

use super::rows::Timer;
use crate::ids::{RobotId, TaskId};
use crate::reason::Code;
use crate::time::{LinkTime, SiteDuration, SiteTime, Utc};
use smol_str::SmolStr;
use std::collections::{BTreeMap, BTreeSet};

/// What is due and not done yet. Volatile: the next period gathers it again.
#[derive(Debug, Default)]
pub struct Agenda {
    pub(in crate::fleet) timers: Vec<Timer>,
    /// Tasks whose deadline passed.
    pub(in crate::fleet) late: Vec<TaskId>,
    pub(in crate::fleet) suspended: Vec<TaskId>,
    pub(in crate::fleet) heard: BTreeSet<RobotId>,
}

/// What is remembered of offers that were not answered. Volatile.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct UnansweredOffers {
    /// Robots by when they last missed an offer, link clock.
    pub(in crate::fleet) missed: BTreeMap<RobotId, LinkTime>,
    /// Offers that a robot missed in a row, and until when it gets no other, link clock.
    pub(in crate::fleet) backed_off: BTreeMap<RobotId, (u32, LinkTime)>,
}

/// Time in which a robot was heard and that no counter has yet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AttachedTime {
    /// Milliseconds of site time.
    pub ms: u64,
    /// Up to when, site clock.
    pub until: crate::time::SiteTime,
    /// It was heard then.
    pub is_heard: bool,
}

/// What a robot waits for. Volatile: waiting reasons never go through the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// Places it asked for and did not get.
    pub places: Vec<crate::ids::PlaceId>,
    /// All of them are free, and behind the grant there would be no order for these robots to go on. None: a place is not free.
    pub for_order: Option<Vec<RobotId>>,
    /// Since when.
    pub since: crate::time::SiteTime,
}

/// For whom a ready task is meant.
#[derive(Clone, Debug)]
pub struct MeantFor {
    /// A robot that is free soon.
    pub robot_id: RobotId,
    /// UTC, when it is free.
    pub free: Utc,
    /// Since when the task is meant for one robot or another.
    since: SiteTime,
}

/// Ready tasks that the newest plan means for robots which are free soon. Volatile: no promise.
#[derive(Clone, Debug, Default)]
pub struct Meant {
    named: BTreeMap<TaskId, MeantFor>,
    /// Tasks that the newest plan means for nobody and one before it did: since when that, and when it ended, site clock.
    dropped: BTreeMap<TaskId, (SiteTime, SiteTime)>,
    /// Tasks that were meant for too long, and until when they are meant for no robot, site clock.
    resting: BTreeMap<TaskId, SiteTime>,
}

impl Meant {
    /// A task is meant for no robot for longer than this without getting one, site time; then not again for as long.
    const FOR: SiteDuration = SiteDuration::from_secs(30);
    /// A shorter time without a robot, site time, counts as if the task had been meant for one.
    const GAP: SiteDuration = SiteDuration::from_secs(5);

    /// For whom a task is meant.
    pub fn get(&self, task_id: &TaskId) -> Option<&MeantFor> {
        self.named.get(task_id)
    }
    /// Whether a task was meant for one robot or another for so long that it goes to one that is free.
    pub fn is_over(&self, task_id: &TaskId, now: SiteTime) -> bool {
        let is_resting = || self.resting.get(task_id).is_some_and(|until| now < *until);
        self.since(task_id, now).map_or_else(is_resting, |since| is_over(since, now))
    }
    /// What a plan means: tasks with their robots, and when those are free.
    pub(in crate::fleet) fn put_plan(&mut self, tasks: Vec<(TaskId, RobotId, Utc)>, now: SiteTime) {
        let meant: BTreeMap<TaskId, MeantFor> = tasks
            .into_iter()
            .map(|(task_id, robot_id, free)| {
                let since = self.since(&task_id, now).filter(|since| !is_over(*since, now)).unwrap_or(now);
                (task_id, MeantFor { robot_id, free, since })
            })
            .collect();
        self.dropped.retain(|_, (_, ended)| now.since(*ended) < Self::GAP);
        let before =
            std::mem::replace(&mut self.named, meant).into_iter().map(|(task_id, meant)| (task_id, (meant.since, now)));
        self.dropped.extend(before);
        self.dropped.retain(|task_id, _| !self.named.contains_key(task_id));
        self.resting.retain(|_, until| now < *until);
        let over = self.dropped.extract_if(.., |_, (since, _)| is_over(*since, now));
        self.resting.extend(over.map(|(task_id, _)| (task_id, now + Self::FOR)));
    }
    /// Since when a task is meant for one robot or another, shorter gaps counted.
    fn since(&self, task_id: &TaskId, now: SiteTime) -> Option<SiteTime> {
        let is_near = |(_, ended): &&(SiteTime, SiteTime)| now.since(*ended) < Self::GAP;
        let dropped = || self.dropped.get(task_id).filter(is_near).map(|(since, _)| *since);
        self.named.get(task_id).map(|meant| meant.since).or_else(dropped)
    }
}

/// Whether a task that is meant for robots since then is so for too long.
fn is_over(since: SiteTime, now: SiteTime) -> bool {
    now.since(since) > Meant::FOR
}

/// What lasts, by robot and code: since when it lasts or was last seen as an open incident, link clock. Volatile.
pub type Lasting = BTreeMap<(RobotId, Code), LinkTime>;

/// What has no reason, and how far this period has looked. Volatile.
#[derive(Debug, Default)]
pub struct Unexplained {
    /// Robots and tasks by since when nobody can say why they stand, link clock; none: counted.
    pub(in crate::fleet) since: BTreeMap<String, Option<LinkTime>>,
    pub(in crate::fleet) robot: SmolStr,
    pub(in crate::fleet) task: SmolStr,
}
