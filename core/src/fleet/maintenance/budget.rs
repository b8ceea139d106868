//! Limits how many robots of an area are out of work at once, and orders the robots that wait.
//!
//! Called once a cycle, before drains go on. Invariants:
//! 1. A waiting drain begins only in an item that also writes its area's row, so two planners cannot both spend the
//!    last place. That item relies on the drain's request, its release and the area's rules: if one of them changes
//!    meanwhile, it conflicts.
//! 2. A robot that is out of work for several reasons counts once. One that was written off counts again once heard.
//! 3. Urgent drains begin first, then drains of robots that charge, of robots without work, and of the others; older
//!    ones first among these.
//! 4. Drains of people and urgent drains count, and do not wait for the area.
//! 5. A drain for new software also waits for the area's update window, unless it is urgent.
//! 6. A drain away from aborted software waits only for drains that end without a person: one stuck robot would
//!    otherwise keep it on bad software.
//! 7. What the area's rules keep in work by capability limits the drains of 6 too.

use crate::drain_request::{DrainRelease, DrainRequest};
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::objects;
use crate::fleet::projection::rows::{AreaBudget, Drain, DrainState, RobotHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{AreaId, RobotId};
use crate::policy::AreaPolicy;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::robot::Duty;
use crate::task::state::Errand;
use crate::time::Now;
use crate::update::UpdateState;
use std::collections::{BTreeMap, BTreeSet};

/// Robots of one area.
#[derive(Debug, Default)]
struct Area {
    /// All that are heard there.
    robots: BTreeSet<RobotId>,
    /// Of these, and of robots that were taken from there, those that are out of work.
    off_work: BTreeSet<RobotId>,
    /// Of those out of work, the ones in a drain that comes to an end without a person.
    draining: BTreeSet<RobotId>,
    /// Robots in work that are heard and have a capability, as far as somebody asked.
    able: BTreeMap<String, usize>,
}

impl Area {
    /// Robots in work that are heard and have the capability. Counted once for all drains that wait.
    fn able(&mut self, view: &FleetProjection, board: &Board, now: &Now, capability: &str) -> usize {
        if let Some(count) = self.able.get(capability) {
            return *count;
        }
        let works = |id: &&RobotId| !self.off_work.contains(*id) && is_able(view, board, now, id, capability);
        let count = self.robots.iter().filter(works).count();
        self.able.insert(capability.to_owned(), count);
        count
    }

    /// One more is out of work.
    fn take_out(&mut self, view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId) {
        self.draining.insert(robot_id.clone());
        if self.off_work.insert(robot_id.clone()) && self.robots.contains(robot_id) {
            for (capability, count) in &mut self.able {
                *count -= usize::from(is_able(view, board, now, robot_id, capability)).min(*count);
            }
        }
    }
}

fn has(view: &FleetProjection, robot_id: &RobotId, capability: &str) -> bool {
    let session = view.sessions.get(robot_id.as_str());
    session.is_some_and(|s| s.row.inventory.capabilities.iter().any(|c| c == capability))
}

fn is_able(view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId, capability: &str) -> bool {
    has(view, robot_id, capability) && liveness::presence(board, robot_id, now) == Presence::Online
}

/// The drain waits for the same thing: numbers that change with every robot that comes and goes are no news.
fn is_same(known: &Reason, why: &Reason) -> bool {
    let same = |key: &str| known.metadata.get(key) == why.metadata.get(key);
    known.code == why.code && ["area_id", "capability", "drain_id"].into_iter().all(same)
}

/// Lets waiting drains begin as far as the areas' rules allow, and keeps the areas' rows.
pub fn plan(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) {
    let waits = |d: &&Drain| d.state == DrainState::Waiting && !view.drain_releases.contains_key(d.drain_id.as_str());
    let mut waiting: Vec<Drain> = view.drains.values().map(|d| &d.row).filter(waits).cloned().collect();
    if waiting.is_empty() && view.budgets.is_empty() {
        return;
    }
    let mut areas = areas(view, board, &now);
    keep_rows(view, now, &areas, plan);
    waiting.sort_by_cached_key(|d| (!d.urgent, cost(view, &d.robot_id), d.since, d.drain_id.clone()));
    for drain in waiting {
        if plan.is_cut() {
            return;
        }
        let here = objects::area_of(view, board, &drain.robot_id);
        let why = match (&here, view.drain_of(&drain.robot_id)) {
            (_, Some(other)) => Some(Reason::from(Code::RobotDraining).with("drain_id", &other.drain_id)),
            (Some(area), None) if !drain.urgent => shut(view, &now, area, &drain)
                .or_else(|| areas.get_mut(area).and_then(|a| refusal(view, board, &now, area, a, &drain))),
            _ => None,
        };
        if why.is_none()
            && let Some(area) = here.as_ref().and_then(|area| areas.get_mut(area))
        {
            area.take_out(view, board, &now, &drain.robot_id);
        }
        plan.decide(view, now, "fleet", |tx| match why {
            Some(why) if drain.why.as_ref().is_some_and(|known| is_same(known, &why)) => {}
            Some(why) => wait(tx, drain, why, here, &areas),
            None => begin(tx, drain, here, &areas),
        });
    }
}

/// It waits on; the area's row says for whom, however they came out of work.
fn wait(tx: &mut Tx, drain: Drain, why: Reason, area_id: Option<AreaId>, areas: &BTreeMap<AreaId, Area>) {
    if let Some((id, area)) = area_id.as_ref().and_then(|id| areas.get_key_value(id))
        && tx.view.budgets.get(id.as_str()).is_none_or(|b| b.row != row_of(tx.view, id, area))
    {
        put_row(tx, id, area);
    }
    tx.put_row(Drain { why: Some(why), ..drain }, "drain.waits");
}

fn begin(tx: &mut Tx, drain: Drain, area_id: Option<AreaId>, areas: &BTreeMap<AreaId, Area>) {
    if let Some((id, area)) = area_id.as_ref().and_then(|id| areas.get_key_value(id)) {
        put_row(tx, id, area);
    }
    let (state, since, drain_id) = (DrainState::Draining, tx.now.utc, drain.drain_id.clone());
    let rules = area_id.clone();
    tx.put_row(Drain { state, since, area_id, why: None, ..drain }, "drain.begun");
    tx.rely::<DrainRequest>(drain_id.as_str());
    tx.rely::<DrainRelease>(drain_id.as_str());
    if let Some(area_id) = rules {
        tx.rely::<AreaPolicy>(area_id.as_str());
    }
}

fn put_row(tx: &mut Tx, area_id: &AreaId, area: &Area) {
    let row = row_of(tx.view, area_id, area);
    tx.put_row(row, "area.off_work");
}

fn row_of(view: &FleetProjection, area_id: &AreaId, area: &Area) -> AreaBudget {
    let off_work_max = view.policy(area_id).software.off_work_max(area.robots.len()) as u32;
    AreaBudget { area_id: area_id.clone(), off_work: area.off_work.clone(), off_work_max }
}

/// Rows of areas whose robots came back, or were taken out by a person or the breaker.
fn keep_rows(view: &mut FleetProjection, now: Now, areas: &BTreeMap<AreaId, Area>, plan: &mut Plan) {
    let none = Area::default();
    let known: Vec<AreaId> = view.budgets.values().map(|b| b.row.area_id.clone()).collect();
    for area_id in known {
        if plan.is_cut() {
            return;
        }
        let area = areas.get(&area_id).unwrap_or(&none);
        let row = row_of(view, &area_id, area);
        if view.budgets.get(area_id.as_str()).is_some_and(|b| b.row != row) {
            plan.decide(view, now, "fleet", |tx| put_row(tx, &area_id, area));
        }
    }
}

/// What it costs to take a robot out of work now: nothing while it charges, little while it has nothing to do.
fn cost(view: &FleetProjection, robot_id: &RobotId) -> u8 {
    let holder = view.authority.get(robot_id.as_str()).map(|a| &a.row.holder);
    match holder {
        Some(RobotHolder::Attempt(id)) => match view.attempt(id).and_then(|a| a.errand) {
            Some(Errand::Charge) => 0,
            Some(Errand::Park) => 1,
            None => 2,
        },
        _ => 1,
    }
}

fn areas(view: &FleetProjection, board: &Board, now: &Now) -> BTreeMap<AreaId, Area> {
    let mut areas: BTreeMap<AreaId, Area> = BTreeMap::new();
    for robot_id in board.keys().filter(|id| liveness::presence(board, id, now) != Presence::Offline) {
        let Some(area_id) = objects::area_of(view, board, robot_id) else { continue };
        let area = areas.entry(area_id).or_default();
        area.robots.insert(robot_id.clone());
        let duty = view.control.get(robot_id.as_str()).map_or(Duty::InWork, |c| c.row.duty());
        let taken_here = view.drain_of(robot_id).is_some_and(|d| d.area_id.is_none());
        if duty != Duty::InWork || taken_here {
            area.off_work.insert(robot_id.clone());
        }
        if taken_here && comes_to_an_end(board, now, robot_id) {
            area.draining.insert(robot_id.clone());
        }
    }
    let counts = |drain: &&Drain| drain.is_on() && !is_written_off(view, board, now, drain);
    for drain in view.drains.values().map(|d| &d.row).filter(counts) {
        if let Some(area_id) = &drain.area_id {
            let area = areas.entry(area_id.clone()).or_default();
            area.off_work.insert(drain.robot_id.clone());
            if comes_to_an_end(board, now, &drain.robot_id) {
                area.draining.insert(drain.robot_id.clone());
            }
        }
    }
    areas
}

/// The robot is not heard, and a person or its roll-out's policy said that it counts in no budget until it is.
fn is_written_off(view: &FleetProjection, board: &Board, now: &Now, drain: &Drain) -> bool {
    let said = view.drain_requests.get(drain.drain_id.as_str()).is_some_and(|request| request.row.written_off);
    said && liveness::presence(board, &drain.robot_id, now) == Presence::Offline
}

/// The robot is heard, and is not stuck with what it runs: its drain ends without a person.
fn comes_to_an_end(board: &Board, now: &Now, robot_id: &RobotId) -> bool {
    let is_stuck =
        board.get(robot_id).and_then(|l| l.report.update.as_ref()).is_some_and(|u| u.state == UpdateState::Stuck);
    !is_stuck && liveness::presence(board, robot_id, now) != Presence::Offline
}

/// Why a robot that changes to something new does not leave its work now, however many are out of it.
fn shut(view: &FleetProjection, now: &Now, area_id: &AreaId, drain: &Drain) -> Option<Reason> {
    let forward = view.drain_requests.get(drain.drain_id.as_str()).is_some_and(|request| request.row.forward);
    let shut = forward && !view.policy(area_id).software.is_open(now);
    shut.then(|| Reason::from(Code::BlockedByWindow).with("area_id", area_id))
}

/// Why one more robot may not leave its work now.
fn refusal(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    area_id: &AreaId,
    area: &mut Area,
    drain: &Drain,
) -> Option<Reason> {
    let robot_id = &drain.robot_id;
    if area.off_work.contains(robot_id) || view.bugs.budget_is_forgotten() {
        return None;
    }
    let rules = view.policy(area_id).software;
    let off = if drain.is_way_back { area.draining.len() } else { area.off_work.len() };
    let most = rules.off_work_max(area.robots.len());
    let budget = || Reason::from(Code::BlockedByBudget).with("area_id", area_id);
    if off >= most {
        return Some(budget().with("off_work", off).with("most", most));
    }
    for (capability, least) in rules.keep_in_work.iter().filter(|(capability, _)| has(view, robot_id, capability)) {
        let counts = area.robots.contains(robot_id) && is_able(view, board, now, robot_id, capability);
        let left = area.able(view, board, now, capability).saturating_sub(usize::from(counts));
        if left < *least as usize {
            return Some(budget().with("capability", capability).with("in_work", left).with("keep_in_work", least));
        }
    }
    None
}
