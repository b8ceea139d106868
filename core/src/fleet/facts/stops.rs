//! Fleet stops as fleet sees them: hold tokens of robots, from the copy of the stops and from what robots themselves report.
//!
//! Either says stopped: stopped. A token `stop:<id>` ends only as `resume:<id>`, and that only by a person. Invariant: nothing here stops a robot, which hears
//! of its stop by a way of its own; this keeps work from it, and keeps it standing when its stop is over.

use super::holds::{holds_changed, touch};
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::{HoldToken, RobotControl};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::traffic::engaged_stops::{self, over};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{RobotId, StopId};
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::stop::latch::is_memory_lost;
use crate::stop::robot::is_silence;
use crate::time::Now;
use std::collections::{BTreeMap, BTreeSet};

/// How a stop holds a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hold {
    /// It is engaged.
    Stop,
    /// It is over, and nobody has resumed the robot.
    Resume,
}

impl Hold {
    fn token(self, stop_id: &StopId) -> String {
        match self {
            Self::Stop => format!("stop:{stop_id}"),
            Self::Resume => format!("resume:{stop_id}"),
        }
    }
    /// Reads a token of a fleet stop; those of the body's own safety system are of another form.
    pub fn read(token: &str) -> Option<(StopId, Self)> {
        let stop = token.strip_prefix("stop:").map(|id| (id, Self::Stop));
        let (id, hold) = stop.or_else(|| token.strip_prefix("resume:").map(|id| (id, Self::Resume)))?;
        Some((StopId::parse(id).ok()?, hold))
    }
}

/// Puts right the tokens of every robot that a stop or its own report concerns.
pub fn plan(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) {
    let all = std::mem::take(&mut view.stops_changed);
    if all {
        open_incidents(view, now, plan);
    }
    let held = view.holds.values().map(|h| &h.row).filter(|h| Hold::read(&h.token).is_some());
    let resumed = view.control.values().map(|c| &c.row).filter(|c| !c.resumed.is_empty());
    let waiting = board.iter().filter(|(_, live)| !live.report.awaiting_resume.is_empty());
    let known = view.authority.values().map(|a| &a.row.robot_id).filter(|_| all);
    let concerned = held.map(|h| &h.robot_id).chain(resumed.map(|c| &c.robot_id)).chain(waiting.map(|(id, _)| id));
    let concerned: BTreeSet<RobotId> = concerned.chain(known).cloned().collect();
    for robot_id in concerned.into_iter().filter(|id| view.sessions.contains_key(id.as_str())).collect::<Vec<_>>() {
        if plan.is_cut() {
            view.stops_changed |= all;
            return;
        }
        let online = liveness::presence(board, &robot_id, &now) == Presence::Online;
        let live = board.get(&robot_id).filter(|_| online).cloned();
        for _ in 0..=limits::HOLDS_OF_ROBOT_MAX.div_ceil(limits::HOLDS_PER_ITEM) {
            let mut is_done = true;
            plan.decide(view, now, "stop", |tx| is_done = correct_tokens(tx, &robot_id, live.as_deref()));
            if is_done {
                break;
            }
        }
    }
}

/// Opens one incident for each stop by which the stop service says that it began without its memory.
fn open_incidents(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let is_told = |stop_id: &StopId| {
        let told = view.incidents.values().map(|i| &i.row.reason).filter(|reason| reason.code == Code::StopMemoryLost);
        told.filter_map(|reason| reason.metadata.get("stop_id")).any(|told| *told == stop_id.as_str())
    };
    let lost = engaged_stops::engaged(view).filter(|stop| is_memory_lost(&stop.stop_id));
    let lost: Vec<Reason> = lost
        .filter(|stop| !is_told(&stop.stop_id))
        .map(|stop| Reason::new(Code::StopMemoryLost, stop.reason.clone()).with("stop_id", &stop.stop_id))
        .collect();
    for reason in lost {
        plan.decide(view, now, "stop", |tx| incidents::open(tx, reason, None, None));
    }
}

/// Puts one robot's tokens right, as many as one item takes; `live` only while it is heard. False: there are more.
fn correct_tokens(tx: &mut Tx, robot_id: &RobotId, live: Option<&NewestHeartbeat>) -> bool {
    let (waits, engaged): (BTreeSet<StopId>, BTreeSet<StopId>) = match live.map(|live| &live.report) {
        Some(r) => (r.awaiting_resume.iter().cloned().collect(), r.stops.iter().cloned().collect()),
        None => Default::default(),
    };
    let mut stopped: BTreeSet<StopId> = over(tx.view, robot_id, live).map(|stop| stop.stop_id.clone()).collect();
    let tokens: BTreeMap<StopId, Hold> = tx.view.robot_holds(robot_id).filter_map(|h| Hold::read(&h.token)).collect();
    let control = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    let control = control.unwrap_or_else(|| RobotControl::new(robot_id.clone()));
    let mut wanted = tokens.clone();
    for stop_id in &stopped {
        wanted.insert(stop_id.clone(), Hold::Stop);
    }
    // What only the robot knows of is taken while there is room: one that is held by so many needs no more.
    let has_room = |wanted: &BTreeMap<StopId, Hold>, id: &StopId| {
        wanted.contains_key(id) || wanted.len() < limits::HOLDS_OF_ROBOT_MAX
    };
    for stop_id in waits.intersection(&engaged) {
        if has_room(&wanted, stop_id) {
            wanted.insert(stop_id.clone(), Hold::Stop);
        }
        stopped.insert(stop_id.clone());
    }
    for (stop_id, hold) in &tokens {
        // Of a robot that is not heard only the copy tells; what only the robot knew stays.
        let is_told = live.is_some() || tx.view.stops.contains_key(stop_id.as_str());
        if *hold == Hold::Stop && !stopped.contains(stop_id) && is_told {
            wanted.insert(stop_id.clone(), Hold::Resume);
        }
    }
    // Stops first: what has no room is a silence.
    let (silences, stops): (Vec<&StopId>, Vec<&StopId>) = waits.iter().partition(|id| is_silence(id));
    for stop_id in stops.into_iter().chain(silences).filter(|id| !control.resumed.contains(id)) {
        if has_room(&wanted, stop_id) {
            wanted.entry(stop_id.clone()).or_insert(Hold::Resume);
        }
    }
    // A robot that is heard and waits no more has taken its resume; one that is stopped again needs another.
    let keeps = |id: &StopId| !wanted.contains_key(id) && (live.is_none() || waits.contains(id));
    let resumed: Vec<StopId> = control.resumed.iter().filter(|id| keeps(id)).cloned().collect();
    if resumed != control.resumed {
        tx.put_row(RobotControl { resumed, ..control }, "robot.resumed");
        tx.view.dirty.insert(robot_id.clone());
    }
    wanted == tokens || write(tx, robot_id, &tokens, &wanted)
}

/// Writes what differs, as much as one item takes. False: there is more.
fn write(tx: &mut Tx, robot_id: &RobotId, tokens: &BTreeMap<StopId, Hold>, wanted: &BTreeMap<StopId, Hold>) -> bool {
    let since = tx.now.utc;
    let most = if tx.view.bugs.holds_come_at_once() { usize::MAX } else { limits::HOLDS_PER_ITEM };
    let mut differ = wanted.iter().filter(|(id, hold)| tokens.get(*id) != Some(hold));
    for (stop_id, hold) in differ.by_ref().take(most) {
        if let Some(old) = tokens.get(stop_id) {
            tx.delete::<HoldToken>(&HoldToken::id_of(robot_id, &old.token(stop_id)), "hold.replaced");
        }
        let fact = if *hold == Hold::Stop { "hold.stopped" } else { "hold.awaits_resume" };
        tx.put_row(HoldToken { robot_id: robot_id.clone(), token: hold.token(stop_id), since }, fact);
    }
    touch(tx, robot_id);
    holds_changed(tx, robot_id);
    differ.next().is_none()
}

/// A person took a token away: the robot hears which stop it need not wait for any more.
pub(in crate::fleet) fn resumed(tx: &mut Tx, robot_id: &RobotId, token: &str) {
    let Some((stop_id, Hold::Resume)) = Hold::read(token) else { return };
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    let mut control = known.unwrap_or_else(|| RobotControl::new(robot_id.clone()));
    if !control.resumed.contains(&stop_id) {
        control.resumed.push(stop_id);
        // The oldest was for a robot that has not been heard for long: it is resumed once more.
        let surplus = control.resumed.len().saturating_sub(limits::STOPS_MAX);
        control.resumed.drain(..surplus);
        tx.put_row(control, "robot.resumed");
    }
}
