//! Figures of the shift as it is now: what robots do, and how far they drove. Counted from rows, so a restart changes none of them.

use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::RobotHolder;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::traffic::routing;
use crate::ids::{AttemptId, RobotId};
use crate::presence::Presence;
use crate::task::state::Errand;
use crate::time::Now;
use std::collections::BTreeMap;

/// Figures of the shift at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FleetFigures {
    /// Robots that are not offline, by what has them: `task`, `charge`, `park`, `update` (a drain), or `nothing`.
    pub robots: BTreeMap<&'static str, u64>,
    /// Of these, such with too little charge for work that nothing has.
    pub waits_for_charger: u64,
    /// Millimetres driven, by work (`task`, `errand`) and load (`yes`, `no`).
    pub driven_mm: [(&'static str, &'static str, u64); 3],
}

impl FleetFigures {
    /// What may have a robot, or nothing.
    pub const DOES: [&'static str; 5] = ["task", "charge", "park", "update", "nothing"];

    /// As the rows and the newest heartbeats say.
    pub fn new(view: &FleetProjection, board: &Board, now: &Now) -> Self {
        let mut robots = BTreeMap::from(Self::DOES.map(|does| (does, 0)));
        let mut waits_for_charger = 0;
        let authorities = view.authority.values().map(|authority| &authority.row);
        let is_here = |robot_id: &RobotId| liveness::presence(board, robot_id, now) != Presence::Offline;
        for authority in authorities.filter(|a| is_here(&a.robot_id)) {
            let does = match &authority.holder {
                RobotHolder::None => "nothing",
                RobotHolder::Maintenance(_) => "update",
                RobotHolder::Attempt(id) => work(view, id),
            };
            *robots.entry(does).or_default() += 1;
            waits_for_charger += u64::from(does == "nothing" && must_charge(view, board, &authority.robot_id));
        }
        let (mut empty, mut loaded, mut errands) = (0_u64, 0_u64, 0_u64);
        for counter in view.counters.values().map(|counter| &counter.row) {
            let on_errands = counter.errands.path_mm;
            let on_tasks = counter.stats.path_mm.saturating_sub(on_errands);
            loaded = loaded.saturating_add(counter.stats.loaded_path_mm);
            empty = empty.saturating_add(on_tasks.saturating_sub(counter.stats.loaded_path_mm));
            errands = errands.saturating_add(on_errands);
        }
        let driven_mm = [("task", "yes", loaded), ("task", "no", empty), ("errand", "no", errands)];
        Self { robots, waits_for_charger, driven_mm }
    }
}

fn work(view: &FleetProjection, attempt: &AttemptId) -> &'static str {
    match view.attempt(attempt).and_then(|attempt| attempt.errand) {
        None => "task",
        Some(Errand::Charge) => "charge",
        Some(Errand::Park) => "park",
    }
}

fn must_charge(view: &FleetProjection, board: &Board, robot_id: &RobotId) -> bool {
    let Some(vitals) = board.get(robot_id).map(|live| &live.report.vitals) else { return false };
    let Some(at) = routing::find(view, vitals.waypoint.as_ref()) else { return false };
    let least = view.policy(&view.site.area_of(at).area_id).charge_mandatory_permille;
    vitals.battery_permille < least && view.site.chargers().next().is_some()
}
