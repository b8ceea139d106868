//! Keeps what is derived from rows: what is due, the size of waves, and robots that come.
//!
//! Invariant: what is derived depends on the rows alone, never on the order in which they came.

use super::queue::waits_out;
use super::rows::{AreaBundle, Quarantine, RobotSoftware, RolloutRobot};
use super::state::RolloutProjection;
use crate::fleet::rows::RobotControl;
use crate::ids::{RobotId, RolloutId};
use crate::projection::Indexed;
use crate::session::Session;
use std::collections::BTreeMap;

impl Indexed<RolloutRobot> for RolloutProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&RolloutRobot>) {
        let new = view.robots.get(id).map(|r| &r.row);
        let size = |sizes: &mut BTreeMap<(RolloutId, u32), u32>, row: &RolloutRobot, by: i32| {
            let wave = (row.rollout_id.clone(), row.wave);
            let size = sizes.get(&wave).copied().unwrap_or_default().saturating_add_signed(by);
            if size > 0 {
                sizes.insert(wave, size)
            } else {
                sizes.remove(&wave)
            };
        };
        if let Some(old) = old {
            size(&mut view.wave_sizes, old, -1);
        }
        if new.and_then(waits_out).is_some() {
            view.waiting_out.insert(id.to_owned());
        } else {
            view.waiting_out.remove(id);
        }
        match new {
            Some(row) => {
                size(&mut view.wave_sizes, row, 1);
                view.of_robot.entry(row.robot_id.clone()).or_default().insert(row.rollout_id.clone());
                if row.step.is_over() {
                    view.open.remove(id);
                    // It is free for a roll-out that was completed meanwhile.
                    view.arrived.insert(row.robot_id.clone());
                } else {
                    view.open.insert(id.to_owned());
                }
            }
            None => {
                view.open.remove(id);
                if let Some(old) = old
                    && let Some(rollouts) = view.of_robot.get_mut(&old.robot_id)
                {
                    rollouts.remove(&old.rollout_id);
                }
            }
        }
    }
}

impl Indexed<RobotSoftware> for RolloutProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&RobotSoftware>) {
        let Some(new) = view.software.get(id).map(|s| &s.row) else { return };
        if old.is_none_or(|old| old.area != new.area || old.pin.is_some() != new.pin.is_some()) {
            view.arrived.insert(new.robot_id.clone());
        }
    }
}

impl Indexed<RobotControl> for RolloutProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&RobotControl>) {
        let Some(new) = view.control.get(id).map(|c| &c.row) else { return };
        if old.is_some_and(|old| old.retired.is_some()) && new.retired.is_none() {
            view.arrived.insert(new.robot_id.clone());
        }
    }
}

impl Indexed<Quarantine> for RolloutProjection {
    fn changed(view: &mut Self, id: &str, old: Option<&Quarantine>) {
        if let Some(lifted) = old.filter(|_| !view.quarantines.contains_key(id)) {
            view.arrived.insert(lifted.robot_id.clone());
        }
    }
}

impl Indexed<AreaBundle> for RolloutProjection {
    /// Robots that came while the roll-out ran had no part in it.
    fn changed(view: &mut Self, _id: &str, _old: Option<&AreaBundle>) {
        let all: Vec<RobotId> = view.sessions.values().map(|s| s.row.robot_id.clone()).collect();
        view.arrived.extend(all);
    }
}

impl Indexed<Session> for RolloutProjection {
    fn changed(view: &mut Self, id: &str, _old: Option<&Session>) {
        view.arrived.extend(view.sessions.get(id).map(|s| s.row.robot_id.clone()));
    }
}
