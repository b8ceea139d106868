//! What only this process knows, ahead of the rows: nothing of it goes through the store, and a start begins without it.

use super::rows::Timer;
use crate::ids::{RobotId, TaskId};
use crate::reason::Code;
use crate::time::LinkTime;
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
    /// Since when.
    pub since: crate::time::SiteTime,
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
