//! Takes what robots say of their software, and what else of theirs counts for or against a bundle.
//!
//! Invariant: what a robot says changes rows only; what follows from it is decided in `robots::due` and `phases`. A
//! heartbeat counts only once everything the robot had said before it was taken.

use crate::heartbeat::NewestHeartbeat;
use crate::ids::{DrainId, RobotId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::{Fault, HardwareStop};
use crate::robot_events::{InboxEntry, InboxItem, RobotEvent, SampleBody};
use crate::rollout::decision::plan::Tx;
use crate::rollout::judgement::failures::fail;
use crate::rollout::projection::queue::is_directive_old;
use crate::rollout::projection::rows::{RobotSoftware, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::robots::moves;
use crate::update::{UpdateEvent, UpdateReport, UpdateState};

/// Obeys what a robot says in one entry of the inbox.
pub fn obey_event(tx: &mut Tx, entry: &InboxEntry) {
    let InboxItem::Sample(sample) = &entry.what else { return };
    let SampleBody::Event(event) = &sample.body else { return };
    let robot_id = &entry.robot_id;
    match event {
        RobotEvent::Update(UpdateEvent::Changed(report)) => take_report(tx, robot_id, report),
        RobotEvent::Update(UpdateEvent::Ready { drain_id, .. }) => note_ready(tx, robot_id, drain_id),
        RobotEvent::Update(UpdateEvent::DirectiveRefused { generation, reason }) => {
            note_refused(tx, robot_id, *generation, reason);
        }
        RobotEvent::Fault { fault, cleared: false } => judge_fault(tx, robot_id, fault),
        RobotEvent::HardwareStop(stop) if *stop != HardwareStop::None => judge_hardware_stop(tx, robot_id),
        _ => {}
    }
}

/// Takes a report that says something new.
fn take_report(tx: &mut Tx, robot_id: &RobotId, report: &UpdateReport) {
    let mut software = tx.view.software_of(robot_id);
    let bundle = Some(report.bundle.clone());
    match report.state {
        UpdateState::Probation | UpdateState::Trial => software.on_trial = bundle,
        UpdateState::Committed => {
            if software.committed != bundle {
                software.previous = std::mem::replace(&mut software.committed, bundle);
            }
            software.on_trial = None;
        }
        UpdateState::RolledBack => {
            if software.committed == bundle {
                software.committed = software.previous.take();
            }
            software.on_trial = None;
        }
        // It keeps the bundle, which the rows did not know: a store that was restored has forgotten it.
        UpdateState::Refused if report.reason.as_ref().is_some_and(|why| why.code == Code::SkippedCurrent) => {
            software.committed = bundle;
            software.on_trial = None;
        }
        _ => {}
    }
    software.report = Some(report.clone());
    software.since = tx.now.utc;
    tx.put_row(software, "robot.software_changed");
}

fn note_ready(tx: &mut Tx, robot_id: &RobotId, drain_id: &DrainId) {
    let Some(robot) = in_drain(tx.view, robot_id, drain_id).cloned() else { return };
    tx.put_row(RolloutRobot { ready: true, ..robot }, "robot.ready");
}

/// The robot in the roll-out whose drain this is. A robot that speaks of a drain of before is not heard.
fn in_drain<'a>(view: &'a RolloutProjection, robot_id: &'a RobotId, drain_id: &DrainId) -> Option<&'a RolloutRobot> {
    let any = view.bugs.any_drain_will_do();
    view.rows_of_robot(robot_id).find(|r| r.drain_id.as_ref() == Some(drain_id) || (any && r.drain_id.is_some()))
}

fn note_refused(tx: &mut Tx, robot_id: &RobotId, generation: u64, reason: &Reason) {
    note_way_back_refused(tx, robot_id, generation, reason);
    let newest = tx.view.desired.get(robot_id.as_str()).is_some_and(|d| d.row.generation <= generation);
    let row = tx.view.rows_of_robot(robot_id).find(|r| matches!(r.step, Step::Staging | Step::Staged)).cloned();
    // One that lay too long says nothing against the robot: it is signed anew.
    let old = |r: &RolloutRobot| r.step == Step::Staging && is_directive_old(&tx.now, r.signed);
    if let Some(row) = row.filter(|r| newest && !old(r)) {
        moves::skip_refused(tx, row, reason.clone());
    }
}

/// Notes that the robot did not take the order to go back. What it says of an order of before is not heard.
fn note_way_back_refused(tx: &mut Tx, robot_id: &RobotId, generation: u64, reason: &Reason) {
    let told = |r: &&RolloutRobot| (1..=generation).contains(&r.way_back.generation);
    let Some(mut row) = tx.view.rows_of_robot(robot_id).filter(|r| r.step == Step::Reverting).find(told).cloned()
    else {
        return;
    };
    if row.way_back.refused.is_none() {
        row.way_back.refused = Some(reason.clone());
        tx.put_row(row, "robot.way_back_refused");
    }
}

/// The robot in the roll-out whose bundle it runs.
fn on_trial(view: &RolloutProjection, robot_id: &RobotId) -> Option<RolloutRobot> {
    view.rows_of_robot(robot_id).find(|r| matches!(r.step, Step::Activating | Step::Trial | Step::Committing)).cloned()
}

fn judge_fault(tx: &mut Tx, robot_id: &RobotId, fault: &Fault) {
    let Some(robot) = on_trial(tx.view, robot_id) else { return };
    let bundle = tx.view.rollout(&robot.rollout_id).and_then(|r| tx.view.bundles.get(r.spec.bundle.as_str()));
    let runs = tx.view.software_of(robot_id).on_trial.is_some();
    if runs && bundle.is_some_and(|b| b.row.hard_stop_codes.contains(&fault.code)) {
        fail(tx, &robot, Reason::from(Code::HardStopCode).with("fault_code", fault.code));
    }
}

fn judge_hardware_stop(tx: &mut Tx, robot_id: &RobotId) {
    // What it said just before this may not have been acted upon yet.
    let says_so = says_trial(tx.view, robot_id);
    let Some(robot) = on_trial(tx.view, robot_id).filter(|r| r.step == Step::Trial || says_so) else { return };
    let since_ms = robot.moments.switched.map_or(0, |at| tx.now.ms_since(at));
    if since_ms <= limits::HARDWARE_STOP_COUNTS.as_ms() {
        fail(tx, &robot, Code::HardwareStopOnTrial.into());
    }
}

/// Its newest report says that it works with what is on trial.
fn says_trial(view: &RolloutProjection, robot_id: &RobotId) -> bool {
    let report = view.software.get(robot_id.as_str()).and_then(|s| s.row.report.as_ref());
    let row = on_trial(view, robot_id);
    report.zip(row).is_some_and(|(report, r)| {
        let ours = view.rollout(&r.rollout_id).is_some_and(|rollout| rollout.spec.bundle == report.bundle);
        ours && r.attempted && report.state == UpdateState::Trial
    })
}

/// What a settled heartbeat says that the rows do not: the store is older than the robot, or a row was lost.
pub fn repair(tx: &mut Tx, live: &NewestHeartbeat) {
    let robot_id = &live.robot_id;
    let known = tx.view.software_of(robot_id);
    if let Some(report) = &live.report.update
        && known.report.as_ref().is_none_or(|k| differs(k, report))
    {
        take_report(tx, robot_id, report);
    }
    let version = tx.view.sessions.get(robot_id.as_str()).map(|s| s.row.inventory.software.clone()).unwrap_or_default();
    let area = tx.view.area_of(live).or_else(|| known.area.clone());
    if known.version != version || known.area != area {
        let known = tx.view.software_of(robot_id);
        tx.put_row(RobotSoftware { version, area, ..known }, "robot.software_seen");
    }
}

/// Whether [`repair`] would change something.
pub fn is_repair_due(view: &RolloutProjection, live: &NewestHeartbeat) -> bool {
    let Some(known) = view.software.get(live.robot_id.as_str()).map(|s| &s.row) else { return true };
    let session = view.sessions.get(live.robot_id.as_str()).map(|s| s.row.inventory.software.as_str());
    let reported = match (&known.report, &live.report.update) {
        (_, None) => false,
        (None, Some(_)) => true,
        (Some(known), Some(said)) => differs(known, said),
    };
    let area = view.area_of(live);
    reported || session != Some(known.version.as_str()) || (area.is_some() && area != known.area)
}

/// Everything but the progress, which is no row's matter.
fn differs(known: &UpdateReport, said: &UpdateReport) -> bool {
    let progress_permille = known.progress_permille;
    *known != UpdateReport { progress_permille, ..said.clone() }
}
