//! What the projection holds of roll-outs that have ended: what is still named, and what was just asked for. Everything
//! else stays in the store.
//!
//! Called by the rollout service, which reads what is wanted and tells it. Invariant: whoever decides about a roll-out
//! has it here whole, or it is not there: the service asks before.

use super::rows::{AreaBundle, Phase, Rollout, RolloutRobot, Step};
use super::state::RolloutProjection;
use crate::ids::RolloutId;
use crate::projection::Projected;
use crate::rows::{BadRow, Entry, Key, Record, Revision, Row, RowSelection, Table};
use std::collections::BTreeSet;

/// Phases of roll-outs that have ended, by number.
pub fn ended_phases() -> Vec<i64> {
    Phase::ALL.into_iter().filter(|phase| phase.is_over()).map(Phase::number).collect()
}

fn open_phases() -> Vec<i64> {
    Phase::ALL.into_iter().filter(|phase| !phase.is_over()).map(Phase::number).collect()
}

/// Robots of each roll-out that is read.
pub const fn robots() -> RowSelection {
    RowSelection::OfParents { table: Table::RolloutRobot, parents: Table::Rollout }
}

/// What names roll-outs: those that have not ended, robots for which something is still due, and what newcomers get.
/// With [`named`], and without robots of whole roll-outs, these are the ones that must stay.
pub fn naming() -> Vec<RowSelection> {
    let steps = Step::ALL.into_iter().filter(|step| !step.is_over()).map(Step::number).collect();
    vec![
        RowSelection::InStates(Table::Rollout, open_phases()),
        RowSelection::InStates(Table::RolloutRobot, steps),
        RowSelection::Whole(Table::AreaBundle),
    ]
}

/// What the projection begins with. [`named`] says what is read with it.
pub fn alive() -> Vec<RowSelection> {
    RolloutProjection::WHOLE.iter().map(|table| RowSelection::Whole(*table)).chain(naming()).chain([robots()]).collect()
}

/// What rows of the projection name: the roll-out of a robot for which something is due, the one that another takes back,
/// and those whose bundle newcomers get.
pub fn named(rows: &[Row]) -> Vec<Key> {
    let mut keys = Vec::new();
    for row in rows {
        let ids: Vec<RolloutId> = match row.key.table {
            Table::Rollout => {
                row.decode::<Rollout>().ok().filter(is_open).and_then(|r| r.revert_of).into_iter().collect()
            }
            Table::RolloutRobot => {
                let robot = row.decode::<RolloutRobot>().ok().filter(|r| !r.step.is_over());
                robot.map(|r| r.rollout_id).into_iter().collect()
            }
            Table::AreaBundle => {
                row.decode::<AreaBundle>().map(|a| a.rollouts.into_values().collect()).unwrap_or_default()
            }
            _ => continue,
        };
        keys.extend(ids.into_iter().map(|id| Key::new(Table::Rollout, id.as_str())));
    }
    keys
}

fn is_open(rollout: &Rollout) -> bool {
    !rollout.phase.is_over()
}

/// Whether the entry is of a roll-out that is not here; then it is read whole before anything is decided, unless the
/// entry makes it or takes it away.
pub(in crate::rollout) fn is_elsewhere(view: &mut RolloutProjection, entry: &Entry, table: Table) -> bool {
    let id = match table {
        Table::Rollout if entry.revision > Revision(1) => &*entry.subject,
        Table::RolloutRobot => entry.subject.split_once('/').map_or("", |(rollout, _)| rollout),
        _ => return false,
    };
    if view.rollouts.contains_key(id) {
        return false;
    }
    if let (Ok(id), true) = (RolloutId::parse(id), entry.body.is_some()) {
        view.absent.remove(&id);
        view.spoken_of.insert(id);
    }
    true
}

impl RolloutProjection {
    /// Roll-outs that something in the projection names, and those that have not ended.
    fn needed(&self) -> BTreeSet<RolloutId> {
        let open = self.rollouts.values().map(|r| &r.row).filter(|r| is_open(r));
        let mut needed: BTreeSet<RolloutId> =
            open.flat_map(|r| [Some(&r.rollout_id), r.revert_of.as_ref()]).flatten().cloned().collect();
        needed.extend(self.area_bundles.values().flat_map(|a| a.row.rollouts.values()).cloned());
        let mut from = String::new();
        while let Some(robot) = self.open.range(from..).next().and_then(|id| self.robots.get(id.as_str())) {
            let id = &robot.row.rollout_id;
            // Behind all robots of this one.
            from = format!("{id}0");
            needed.insert(id.clone());
        }
        needed
    }
    /// Roll-outs that must be read before anything is decided.
    pub fn wanted(&self) -> BTreeSet<RolloutId> {
        let mut wanted = self.needed();
        wanted.extend(self.spoken_of.iter().cloned());
        wanted.retain(|id| !self.rollouts.contains_key(id.as_str()) && !self.absent.contains(id));
        wanted
    }
    /// Takes what was read of roll-outs, whole, and of used request_ids. `wanted`: what [`Self::wanted`] said before
    /// the reading.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn absorb_past(&mut self, wanted: BTreeSet<RolloutId>, rows: &[Row]) -> Result<(), BadRow> {
        // A robot of a roll-out that ended is no newcomer for having been read.
        let arrived = std::mem::take(&mut self.arrived);
        for row in rows {
            self.take_row(&row.key, row.revision, Some(row))?;
        }
        self.arrived = arrived;
        self.spoken_of.clear();
        self.absent.extend(wanted.into_iter().filter(|id| !self.rollouts.contains_key(id.as_str())));
        Ok(())
    }
    /// Lets go of roll-outs that have ended and that nothing names, and of used request_ids. To be called once the
    /// projection has absorbed all that was committed by it.
    pub fn let_go(&mut self) {
        let needed = self.needed();
        let ended = self.rollouts.values().map(|r| &r.row.rollout_id).filter(|id| !needed.contains(*id));
        for id in ended.cloned().collect::<Vec<_>>() {
            for robot in self.robots_of(&id).map(Record::id).collect::<Vec<_>>() {
                let old = self.robots.remove(robot.as_str());
                RolloutRobot::changed(self, &robot, old.as_ref().map(|r| &r.row));
            }
            self.rollouts.remove(id.as_str());
        }
        self.absent.retain(|id| needed.contains(id));
        self.command_keys.clear();
    }
}
