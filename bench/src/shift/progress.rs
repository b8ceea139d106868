//! Watches for robots that have a task and come on with nothing: neither a millimetre nor an action.

use super::task_records::TaskRecords;
use midshift_core::ids::RobotId;
use midshift_core::time::SiteTime;
use midshift_sim::fleet::Fleet;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// A robot may stand so long with a task before it counts, milliseconds.
const PATIENCE_MS: u64 = 60_000;

/// Millimetres driven and milliseconds acted so far.
type Done = (u64, u64);

/// The watch over one fleet.
pub struct ProgressWatch {
    fleet: Arc<Fleet>,
    records: Arc<TaskRecords>,
    /// What each robot with a task had done, and since when it has not changed.
    stands: BTreeMap<RobotId, (Done, SiteTime)>,
    looked: SiteTime,
    no_progress: NoProgress,
}

/// Time that robots with a task stood beyond their minute, summed over all.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoProgress {
    /// While there was a planner.
    pub planned: Duration,
    /// While there was none: nobody takes a robot's word that it is done, and it has no other task.
    pub unplanned: Duration,
}

/// Whether anybody plans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Planning {
    /// A planner runs.
    Goes,
    /// The planner is away.
    Stopped,
}

impl ProgressWatch {
    /// Nothing was seen yet.
    pub fn new(fleet: Arc<Fleet>, records: Arc<TaskRecords>) -> Self {
        Self { fleet, records, stands: BTreeMap::new(), looked: SiteTime(0), no_progress: Default::default() }
    }

    /// Looks at every robot that has a task.
    pub fn look_at_robots(&mut self, now: SiteTime, planning: Planning) {
        let since_look_ms = now.since(std::mem::replace(&mut self.looked, now)).as_ms();
        let mut stands = BTreeMap::new();
        for robot_id in self.records.busy_robots() {
            let Some(robot) = self.fleet.robot(&robot_id) else { continue };
            let body = robot.lock();
            let done = (body.odometers_mm().0, body.counts().acting_ms);
            let known = self.stands.get(&robot_id).filter(|(known, _)| *known == done);
            let since = known.map_or(now, |(_, since)| *since);
            if now.since(since).as_ms() > PATIENCE_MS {
                let sum = match planning {
                    Planning::Goes => &mut self.no_progress.planned,
                    Planning::Stopped => &mut self.no_progress.unplanned,
                };
                *sum += Duration::from_millis(since_look_ms);
            }
            stands.insert(robot_id, (done, since));
        }
        self.stands = stands;
    }

    /// What was seen so far.
    pub fn no_progress(&self) -> NoProgress {
        self.no_progress
    }
}
