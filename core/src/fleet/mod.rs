//! Plans the fleet: assigns tasks, grants places, repairs rows from heartbeats, and explains what waits.
//!
//! [`cycle`] turns new facts into items to commit and a report. The service around it reads, commits and publishes.
//! Modules, from the lowest to the highest; each uses only those before it:
//! 1. [`projection`]: rows by table, indices derived from them, and memory of this process.
//! 2. [`decision`]: turns one decision into one item, limits a turn, reports it, opens incidents.
//! 3. [`tasks`]: moves tasks and attempts by their table, and checks what robots claim.
//! 4. [`traffic`]: routes, grants of places, and the desired work of each robot.
//! 5. [`facts`]: applies feed entries, heartbeats, requests, stops, and what is due by time.
//! 6. [`assignment`]: picks a robot for each task and each errand.
//! 7. [`maintenance`]: takes robots out of work and gives them back.
//! 8. [`explanation`]: says what a task or a robot waits for.
//!
//! `commands` carries out direct requests of people. `bugs` holds deliberately naive rules, with which a test shows
//! what the real rule prevents. Modules that other crates use are re-exported here.
//! Invariant: no IO, no clock, no hash-map order; the same inputs give the same items.

pub mod assignment;
pub mod bugs;
pub mod commands;
pub mod decision;
pub mod explanation;
pub mod facts;
pub mod maintenance;
pub mod projection;
pub mod tasks;
pub mod traffic;

#[cfg(test)]
mod tests;

pub use decision::plan::{Plan, Tx};
pub use decision::report::{Report, Tally, WAITS_FOR};
pub use decision::slice::Slice;
pub use decision::{incidents, refusals};
pub use explanation::explain;
pub use explanation::figures::FleetFigures;
pub use facts::feed::{
    CLONE_SEEN, LOGS, NOT_ENROLLED_SEEN, NOT_UNDERSTOOD_SEEN, REPORT_TOO_LONG, absorb, follow_rows, obeyed, put_right,
    reread,
};
pub use facts::{maps, requests, stops};
pub use projection::liveness::Board;
pub use projection::{liveness, objects, rows};
pub use tasks::load;
pub use traffic::starts;

use crate::ids::RobotId;
use crate::leadership::Contenders;
use crate::time::Now;
use assignment::{assign, errands, readiness};
use decision::plan::mark;
use explanation::{lasting, unexplained};
use facts::{misreads, sweep};
use maintenance::{budget, drain};
use projection::rows::{Place, RobotAuthority, RobotControl, RobotHolder, ServiceClock, SiteRow};
use projection::state::FleetProjection;
use tasks::arrivals;
use traffic::{allocation, blocked_places, closed_places, desired};

/// Says whether other processes may contend for the lease of fleet's planner.
pub fn contenders(is_shared: bool, bugs: bugs::Bugs) -> Contenders {
    match (bugs.everybody_leads(), is_shared) {
        (true, _) => Contenders::Ignored,
        (false, true) => Contenders::Some,
        (false, false) => Contenders::None,
    }
}

/// Ensures the rows that every start needs: the site, its places, and serving time.
pub fn ensure_site_rows(view: &mut FleetProjection, now: Now, site_text: &str, map: &maps::MapChange, plan: &mut Plan) {
    maps::tell_of_change(view, now, map, plan);
    let site = view.site.clone();
    if view.sites.get(site.site_id().as_str()).is_some_and(|stored| stored.row.text != site_text) {
        arrivals::forget(view, now, plan);
    }
    plan.decide(view, now, "fleet", |tx| {
        let row = SiteRow {
            site_id: site.site_id().clone(),
            map_version: site.map_version().to_owned(),
            text: site_text.to_owned(),
        };
        if tx.view.sites.get(site.site_id().as_str()).is_none_or(|s| s.row != row) {
            tx.put_row(row, "site.loaded");
        }
    });
    for chunk in site.places().chunks(128) {
        plan.decide(view, now, "fleet", |tx| {
            for place in chunk {
                if site_has(tx.view, place) || tx.view.unknown_rows.is_place_aside(&place.place_id) {
                    continue;
                }
                let known = tx.view.places.get(place.place_id.as_str()).map(|p| p.row.clone());
                let fresh = Place::unheld(place);
                let row =
                    known.map_or(fresh.clone(), |k| rows::Place { capacity: fresh.capacity, kind: fresh.kind, ..k });
                tx.put_row(row, "place.founded");
            }
        });
    }
    let all: Vec<RobotId> = view.sessions.values().map(|s| s.row.robot_id.clone()).collect();
    view.dirty.extend(all.iter().cloned());
    view.policy_dirty.extend(all);
}

fn site_has(view: &FleetProjection, place: &crate::site::Place) -> bool {
    view.places
        .get(place.place_id.as_str())
        .is_some_and(|p| p.row.capacity == place.capacity && p.row.kind == place.kind())
}

/// How much of a cycle is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Something happened: plan with what is known.
    Wake,
    /// The period is over: timers and every heartbeat too.
    Sweep,
}

/// One cycle over a view that has absorbed the whole feed. Items of earlier decisions of the cycle are already in `plan`. Each stage does as
/// much as a slice holds, and leaves the rest for the next turn: then the report says `more`.
pub fn cycle(view: &mut FleetProjection, now: Now, board: &Board, pace: Pace, plan: &mut Plan) {
    view.screened.take();
    incidents::open_put_aside(view, now, plan);
    refusals::try_again(view);
    // At once where somebody plainly lacks them; rows of who is gone may hide a new robot until the sweep.
    if pace == Pace::Sweep || view.authority.len() < view.sessions.len() {
        welcome(view, now, board, plan);
    }
    if pace == Pace::Sweep {
        sweep::gather(view, now, board);
    }
    plan.slice.renew();
    let heard = sweep::carry_out(view, now, board, plan);
    plan.slice.renew();
    if pace == Pace::Sweep || view.stops_changed {
        stops::plan(view, board, now, plan);
    }
    if pace == Pace::Sweep {
        blocked_places::end_blocks(view, now, plan);
    }
    plan.slice.renew();
    drain::obey_requests(view, now, plan);
    plan.slice.renew();
    budget::plan(view, board, now, plan);
    plan.slice.renew();
    drain::plan(view, board, now, plan);
    plan.slice.renew();
    let moved = readiness::settle(view, now, plan);
    if pace == Pace::Sweep {
        readiness::tell_backlog(view, now, plan);
    }
    plan.slice.renew();
    let idle = assign::plan(view, board, now, &heard, plan);
    readiness::reckon_starts(view, now, &moved);
    errands::plan(view, board, now, idle, plan);
    plan.slice.renew();
    write_down(view, now, board, &desired::Releases::default(), plan);
    let releases = allocation::allocate_places(view, board, now, plan);
    plan.slice.renew();
    write_down(view, now, board, &releases, plan);
    if pace == Pace::Sweep {
        plan.slice.renew();
        unexplained::count_unexplained(view, board, now, plan);
        lasting::tell_lasting(view, board, now, plan);
        closed_places::keep_incidents(view, now, plan);
        misreads::close_understood(view, board, now, plan);
    }
    if !plan.items.is_empty() {
        tell_time(view, now, plan);
    }
    plan.report.ended.extend(view.forget_ended());
}

/// Robots that are new get their rows.
fn welcome(view: &mut FleetProjection, now: Now, board: &Board, plan: &mut Plan) {
    let new: Vec<RobotId> = board
        .keys()
        .filter(|r| view.sessions.contains_key(r.as_str()) && !view.authority.contains_key(r.as_str()))
        .cloned()
        .collect();
    for robot_id in new {
        if plan.is_cut() {
            return;
        }
        plan.decide(view, now, "fleet", |tx| {
            tx.put_row(RobotAuthority { robot_id: robot_id.clone(), holder: RobotHolder::None }, "robot.known");
            if !tx.view.control.contains_key(robot_id.as_str()) {
                tx.put_row(RobotControl::new(robot_id.clone()), "robot.known");
            }
            desired::compose_policy(tx, &robot_id);
        });
        view.dirty.insert(robot_id);
    }
}

/// Composes the desired state of every robot that something changed for; first of those that were just let go further.
fn write_down(view: &mut FleetProjection, now: Now, board: &Board, releases: &desired::Releases, plan: &mut Plan) {
    let mut due = std::mem::take(&mut view.dirty);
    for robot_id in releases.0.keys() {
        due.remove(robot_id);
        plan.decide(view, now, "fleet", |tx| desired::compose(tx, robot_id, board, releases));
    }
    while let Some(robot_id) = due.first().filter(|_| !plan.is_cut()).cloned() {
        due.remove(&robot_id);
        plan.decide(view, now, "fleet", |tx| desired::compose(tx, &robot_id, board, releases));
    }
    view.dirty = due;
    while let Some(robot_id) = view.policy_dirty.first().filter(|_| !plan.is_cut()).cloned() {
        view.policy_dirty.remove(&robot_id);
        plan.decide(view, now, "fleet", |tx| desired::compose_policy(tx, &robot_id));
    }
}

/// Writes serving time and the consumed position with the items of this cycle, at most once a second.
fn tell_time(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let served = view.serving(&now);
    let written = view.clocks.get("fleet").map(|c| c.row).unwrap_or_default();
    if served.link_ms >= written.link_ms + 1_000 || written == ServiceClock::default() {
        plan.decide(view, now, "fleet", |tx| {
            tx.put_row(served, "fleet.served");
            mark(tx, tx.view.absorbed);
        });
    }
}
