//! Writes what is due for a robot: its row, what it should run, permissions; with [`super::drains`] its drains.
//!
//! Called with what [`super::due::decide_move`] said; [`super::machine`] says where it leads. Invariants:
//! 1. One move is one item.
//! 2. A permission relies on fleet's record of the robot, on the rules of its area and on the roll-out's row, and
//!    robots out of work are counted in that row.

use super::drains::{ask_drain, is_asked, next_number, recount, release_drain, unpermitted};
use super::due::{anchor, area_ahead, wants};
use super::machine::{self, Move};
use crate::drain_request::ReleasedBy;
use crate::fleet::Board;
use crate::fleet::rows::RobotAuthority;
use crate::ids::{DrainId, RobotId, RolloutId};
use crate::limits;
use crate::policy::AreaPolicy;
use crate::reason::{Code, Reason};
use crate::robot::Duty;
use crate::rollout::decision::directive::{Order, Sign};
use crate::rollout::decision::plan::{Tx, incident};
use crate::rollout::judgement::failures::{fail, is_hard, quarantine};
use crate::rollout::judgement::infrastructure::is_open_to;
use crate::rollout::judgement::{effort, ending, verdict};
use crate::rollout::members::matching::other_key;
use crate::rollout::members::newcomers;
use crate::rollout::projection::queue::{is_directive_old, is_retried};
use crate::rollout::projection::rows::{
    Act, GivenPermission, Lost, RobotSoftware, Rollout, RolloutRobot, Step, WayBack,
};
use crate::rollout::projection::state::RolloutProjection;
use crate::rollout::projection::timestamp::Stamp;
use crate::time::Now;
use crate::update::{ActivationGrant, DesiredUpdate, Goal};

/// Writes what is due for a robot, by the id of its row.
pub fn apply(tx: &mut Tx, sign: &dyn Sign, board: &Board, id: &str, due: Move) {
    let Some(mut r) = tx.view.robots.get(id).map(|r| r.row.clone()) else { return };
    let Some(rollout) = tx.view.rollout(&r.rollout_id).cloned() else { return };
    let Some(to) = machine::next(r.step, &due) else { return };
    match due {
        Move::Stage | Move::SignAnew => write_stage(tx, sign, &rollout, r, to),
        Move::IsStaged => write_step(tx, r, to, "robot.staged"),
        Move::Refused(why) => skip_refused(tx, r, why),
        Move::Unstick => unstick(tx, r),
        Move::Skip(why) => {
            r.why = Some(why);
            if r.again || !is_retried(&r) {
                drop_bundle(tx, &r);
            }
            let released_by = match tx.view.duty(&r.robot_id) {
                Duty::Retired => ReleasedBy::Retired,
                // It said that it never will.
                _ if r.grant.is_some() => ReleasedBy::Reported,
                _ => unpermitted(&r),
            };
            release_drain(tx, &mut r, released_by);
            write_step(tx, r, to, "robot.skipped");
        }
        Move::Again => {
            // If no wave was judged the waves begin anew, and each robot keeps its own. Nobody comes into one that was
            // judged.
            let is_last = rollout.wave >= rollout.spec.waves.len() as u32;
            r.wave = if is_last { rollout.wave } else { r.wave.max(rollout.wave) };
            (r.again, r.why, r.ready) = (true, None, false);
            write_step(tx, r, to, "robot.tried_again");
        }
        Move::Forget => drop_bundle(tx, &r),
        Move::AskDrain => {
            r.moments.asked = Some(tx.now.utc);
            ask_drain(tx, &rollout, &mut r, false);
            write_step(tx, r, to, "robot.drain_asked");
        }
        Move::Held => {
            r.moments.draining = r.drain_id.as_ref().and_then(|id| tx.view.drain(id)).map(|d| d.since);
            (r.moments.held, r.moments.held_link) = (Some(tx.now.utc), Some(stamp_now(tx)));
            (r.ready, r.grant) = (false, None);
            if rollout.revert_of.is_none() {
                let drain_id = r.drain_id.clone();
                change_desired(tx, &r.robot_id, |d| (d.goal, d.drain_id, d.grant) = (Goal::Activate, drain_id, None));
            }
            write_step(tx, r, to, "robot.held");
        }
        Move::Grant => give_grant(tx, board, &rollout, r),
        Move::NotUsed => {
            change_desired(tx, &r.robot_id, |d| d.grant = None);
            (r.grant, r.ready, r.not_used) = (None, false, true);
            r.moments.granted_link = None;
            // It never ran the bundle, so the bundle has not lost it.
            r.failure = r.failure.filter(|f| f.code != Code::RobotLost);
            tx.put_row(r, "robot.grant_not_used");
        }
        Move::LeaveDrain => give_up_drain(tx, r, to),
        Move::Switched => {
            (r.moments.switched, r.moments.switched_link) = (Some(tx.now.utc), Some(stamp_now(tx)));
            // It runs, whatever the rows know of a permission: a store that was restored has forgotten some.
            r.attempted = true;
            tx.put_row(r, "robot.switched");
        }
        Move::OnTrial => {
            r.moments.switched.get_or_insert(tx.now.utc);
            r.moments.switched_link.get_or_insert(stamp_now(tx));
            r.moments.on_trial = Some(tx.now.utc);
            r.before = verdict::tasks_of_robot(tx.view, &rollout, &r.robot_id);
            r.effort_before = effort::effort_of_robot(tx.view, &rollout, &r.robot_id);
            if is_open_to(&rollout, &r) {
                r.failure = r.failure.filter(|f| f.code != Code::RobotLost);
            }
            r.attempted = true;
            release_drain(tx, &mut r, ReleasedBy::Reported);
            write_step(tx, r, to, "robot.on_trial");
        }
        Move::Fail(why) => fail(tx, &r, why),
        Move::Found => tx.put_row(RolloutRobot { failure: None, ..r }, "robot.found"),
        Move::Commit => {
            change_desired(tx, &r.robot_id, |d| (d.goal, d.drain_id, d.grant) = (Goal::Commit, None, None));
            write_step(tx, r, to, "robot.committing");
        }
        Move::Committed => {
            write_step(tx, r, to, "robot.committed");
            ending::reconsider_ending(tx, &rollout.rollout_id);
        }
        Move::Revert => {
            let hard = rollout.abort.as_ref().is_some_and(|a| a.hard) || r.failure.is_some();
            // A robot that is not heard goes back before it works again.
            let urgent = hard || !tx.view.is_heard(board, &tx.now, &r.robot_id);
            r.attempted |= rollout.revert_of.is_some();
            r.way_back = WayBack { unstuck: r.way_back.unstuck, ..WayBack::default() };
            if r.drain_id.is_none() {
                ask_drain(tx, &rollout, &mut r, urgent);
            }
            write_step(tx, r, to, "robot.reverting");
        }
        Move::GoBack => {
            let drain_id = r.drain_id.clone();
            if must_be_ordered_back(tx.view, &rollout, &r) {
                order_back(tx, sign, &rollout, &mut r);
            } else {
                change_desired(tx, &r.robot_id, |d| (d.goal, d.drain_id, d.grant) = (Goal::Revert, drain_id, None));
                let generation = tx.view.desired.get(r.robot_id.as_str()).map_or(0, |d| d.row.generation);
                r.way_back = WayBack { generation, ..WayBack::default() };
            }
            write_step(tx, r, to, "robot.going_back");
        }
        Move::OrderBackAnew => {
            order_back(tx, sign, &rollout, &mut r);
            write_step(tx, r, to, "robot.ordered_back_anew");
        }
        Move::RolledBack(why) => roll_back(tx, &rollout, r, to, why),
        Move::SetUpAnew => {
            let known = tx.view.software_of(&r.robot_id);
            let (committed, previous, on_trial, report) = (None, None, None, None);
            let row = RobotSoftware { committed, previous, on_trial, report, since: tx.now.utc, ..known };
            tx.put_row(row, "robot.software_changed");
            roll_back(tx, &rollout, r, to, Code::RevertAsked.into());
        }
        Move::Stuck(why) => {
            let reason = Reason::from(Code::RollbackFailed).with("because", why.code).with("said", why.text());
            let reason = reason.with("rollout_id", &r.rollout_id);
            incident(tx, Some(&r.robot_id), &reason);
            r.failure = Some(reason);
            r.attempted = true;
            newcomers::stop_serving(tx, &rollout, &r);
            write_step(tx, r, to, "robot.stuck");
        }
        Move::Lost => write_lost(tx, &rollout, r),
        Move::Heard => {
            if !r.counts() {
                recount(tx, &r, 1);
            }
            tx.put_row(RolloutRobot { lost: None, ..r }, "robot.heard_again");
        }
    }
}

/// Why nothing is signed for `r` now: nobody can, or its machine is not known to be the robot's. None: it is.
pub fn why_unsigned(view: &RolloutProjection, r: &RolloutRobot) -> Option<Reason> {
    view.keyless.map(Reason::from).or_else(|| other_key(view, &r.robot_id))
}

/// Whether what is due for `r` is told with a directive that must be signed for that, or takes it out of work only for
/// one.
pub fn is_signed(view: &RolloutProjection, rollout: &Rollout, r: &RolloutRobot, due: &Move) -> bool {
    match due {
        Move::Stage | Move::SignAnew | Move::OrderBackAnew => true,
        Move::GoBack => must_be_ordered_back(view, rollout, r),
        Move::AskDrain => rollout.revert_of.is_some() && must_be_ordered_back(view, rollout, r),
        Move::Revert => {
            let hard = rollout.abort.as_ref().is_some_and(|a| a.hard) || r.failure.is_some();
            r.drain_id.is_none() && !hard && must_be_ordered_back(view, rollout, r)
        }
        _ => false,
    }
}

/// It was told something else since, and has left it, or it was stuck: only a directive of its own leads back from what
/// it kept.
fn must_be_ordered_back(view: &RolloutProjection, rollout: &Rollout, r: &RolloutRobot) -> bool {
    let said = view.software_of(&r.robot_id).report.map(|report| report.bundle);
    let left = rollout.revert_of.is_some() && said.as_ref() != Some(&rollout.spec.bundle);
    left || r.way_back.unstuck || !view.desired.contains_key(r.robot_id.as_str())
}

fn stamp_now(tx: &Tx) -> Stamp {
    Stamp::new(&tx.now, &tx.view.started)
}

fn write_step(tx: &mut Tx, r: RolloutRobot, to: Step, kind: &'static str) {
    let since = if r.step == to { r.since } else { tx.now.utc };
    tx.put_row(RolloutRobot { step: to, since, ..r }, kind);
}

/// Leaves out a robot that did not take its directive.
pub fn skip_refused(tx: &mut Tx, r: RolloutRobot, why: Reason) {
    if let Some(to) = machine::next(r.step, &Move::Refused(why.clone())) {
        write_step(tx, RolloutRobot { why: Some(why), ..r }, to, "robot.skipped");
    }
}

/// Lets a robot go back that could not: a person mended what kept it from that.
pub fn unstick(tx: &mut Tx, r: RolloutRobot) {
    if let Some(to) = machine::next(r.step, &Move::Unstick) {
        let way_back = WayBack { unstuck: true, ..WayBack::default() };
        write_step(tx, RolloutRobot { way_back, ..r }, to, "robot.unstuck");
    }
}

fn roll_back(tx: &mut Tx, rollout: &Rollout, mut r: RolloutRobot, to: Step, why: Reason) {
    let asked = r.step == Step::Reverting || wants(tx.view, &r, Goal::Revert);
    // Whether its bundle or the network kept it from its server is known only if others were heard meanwhile: then it
    // was lost.
    let unreached = why.code == Code::LostServer && r.failure.is_none();
    if !asked && !unreached {
        // It went back by itself: that is what gates count.
        let because = if is_hard(&why) {
            why.clone()
        } else {
            Reason::new(Code::RobotWentBack, why.text()).with("because", why.code)
        };
        let lost = r.failure.as_ref().is_some_and(|f| f.code == Code::RobotLost);
        if r.failure.is_none() || lost {
            r.failure = Some(because);
        }
    }
    if let Some(failure) = r.failure.clone() {
        quarantine(tx, &r, &failure);
        newcomers::stop_serving(tx, rollout, &r);
    }
    let back = if asked && r.failure.is_none() { Code::RevertAsked.into() } else { why };
    r.why = Some(rollout.abort.as_ref().map_or(back, |a| a.reason.clone()));
    release_drain(tx, &mut r, ReleasedBy::Reported);
    write_step(tx, r, to, "robot.rolled_back");
    ending::reconsider_ending(tx, &rollout.rollout_id);
}

fn write_stage(tx: &mut Tx, sign: &dyn Sign, rollout: &Rollout, mut r: RolloutRobot, to: Step) {
    let Some(generation) = write_directive(tx, sign, rollout, &r.robot_id, Goal::Stage, None) else { return };
    if r.step == Step::Waiting {
        r.directive_generation = generation;
    }
    r.signed = tx.now.wall;
    write_step(tx, r, to, "robot.staging");
}

/// Tells a robot something about the bundle with a new directive. Its generation; none: the bundle is not known.
fn write_directive(
    tx: &mut Tx,
    sign: &dyn Sign,
    rollout: &Rollout,
    robot_id: &RobotId,
    goal: Goal,
    drain_id: Option<DrainId>,
) -> Option<u64> {
    let bundle = tx.view.bundles.get(rollout.spec.bundle.as_str()).map(|b| b.row.clone())?;
    let generation = next_generation(tx.view, robot_id, &tx.now);
    let order = Order {
        robot_id,
        generation,
        bundle: &bundle.bundle,
        manifest_length: bundle.manifest_length,
        rollback_floor: if goal == Goal::Revert { 0 } else { rollout.spec.rollback_floor },
        rollout_id: &rollout.rollout_id,
        issued_at: tx.now.wall,
    };
    let row = DesiredUpdate {
        robot_id: robot_id.clone(),
        generation,
        goal,
        directive: sign.directive(&order),
        drain_id,
        grant: None,
        rate_bytes_s: rollout.spec.rate_bytes_s,
        probation_ms: rollout.spec.probation_ms,
    };
    tx.put_row(row, "update.desired");
    Some(generation)
}

/// Tells a robot to go back with a directive of its own, which it takes once nothing of another bundle is under way on
/// it.
fn order_back(tx: &mut Tx, sign: &dyn Sign, rollout: &Rollout, r: &mut RolloutRobot) {
    let Some(generation) = write_directive(tx, sign, rollout, &r.robot_id, Goal::Revert, r.drain_id.clone()) else {
        return;
    };
    let old = r.way_back.signed.is_some_and(|signed| is_directive_old(&tx.now, signed));
    let again = r.way_back.refused.is_some() && !old;
    r.way_back = WayBack { generation, signed: Some(tx.now.wall), refused: None, again, ..r.way_back };
}

fn next_generation(view: &RolloutProjection, robot_id: &RobotId, now: &Now) -> u64 {
    let last = view.desired.get(robot_id.as_str()).map_or(0, |d| d.row.generation);
    let reported = view.sessions.get(robot_id.as_str()).map_or(0, |s| s.row.followed_update());
    (last.max(reported) + 1).max(now.wall.0.max(0) as u64)
}

/// Changes what a robot should run, if it was told anything and this is news.
fn change_desired(tx: &mut Tx, robot_id: &RobotId, change: impl FnOnce(&mut DesiredUpdate)) {
    let Some(old) = tx.view.desired.get(robot_id.as_str()).map(|d| d.row.clone()) else { return };
    let mut new = old.clone();
    change(&mut new);
    if new != old {
        new.generation = next_generation(tx.view, robot_id, &tx.now);
        tx.put_row(new, "update.desired");
    }
}

/// A robot that has the bundle and never ran it forgets it.
fn drop_bundle(tx: &mut Tx, r: &RolloutRobot) {
    if r.directive_generation > 0 && r.never_ran() {
        change_desired(tx, &r.robot_id, |d| (d.goal, d.drain_id, d.grant) = (Goal::Revert, None, None));
    }
}

/// The highest permission that a robot says it has used. After a jump of the clock it may lie ahead of everything that
/// a store of before knows; what lies further ahead than a clock jumps is not followed: so far the word of one robot
/// moves the numbers of all.
fn used_grant(view: &RolloutProjection, board: &Board, now: &Now, robot_id: &RobotId) -> u64 {
    let said = board.get(robot_id).and_then(|live| live.report.update.as_ref());
    let known = view.software.get(robot_id.as_str()).and_then(|s| s.row.report.as_ref());
    let used = said.into_iter().chain(known).map(|report| report.grant_id).max().unwrap_or_default();
    let most = (now.wall.0.max(0) as u64).saturating_add(limits::GRANT_AHEAD_MAX_MS);
    if used > most { 0 } else { used }
}

/// A person is told of a robot that is lost; the roll-out's policy may say the rest.
fn write_lost(tx: &mut Tx, rollout: &Rollout, mut r: RolloutRobot) {
    let reason = Reason::from(Code::BlockedBySilence).with("rollout_id", &r.rollout_id);
    incident(tx, Some(&r.robot_id), &reason.with("lost_after_ms", rollout.spec.lost_after_ms));
    r.lost = Some(Lost { since: tx.now.utc, written_off: None });
    if rollout.spec.writes_off_lost {
        let reason = "its policy says so".to_owned();
        let act = Act { actor: "ota".to_owned(), person: None, reason, at: tx.now.utc };
        return write_off(tx, r, act);
    }
    tx.put_row(r, "robot.lost");
}

/// A robot that is lost counts in no budget until it is heard. It keeps its drain.
pub fn write_off(tx: &mut Tx, mut r: RolloutRobot, act: Act) {
    let counted = r.counts();
    let Some(lost) = &mut r.lost else { return };
    lost.written_off = Some(act);
    if counted {
        recount(tx, &r, -1);
    }
    tx.put_row(r, "robot.written_off");
}

/// Leaves a drain in which no permission may be alive.
fn give_up_drain(tx: &mut Tx, mut r: RolloutRobot, to: Step) {
    if to == Step::Staged {
        change_desired(tx, &r.robot_id, |d| (d.goal, d.drain_id, d.grant) = (Goal::Stage, None, None));
    }
    let released_by = unpermitted(&r);
    release_drain(tx, &mut r, released_by);
    write_step(tx, r, to, "robot.drain_left");
}

/// Takes back what was asked of fleet for a roll-out that goes on no more, in the item that says so: no drain that
/// waits begins after it. Those for which the item has no room are taken back one by one.
pub fn take_back_asked(tx: &mut Tx, rollout_id: &RolloutId) {
    // The robot, what it is told, and the release.
    let room = limits::ITEM_ROWS_MAX.saturating_sub(tx.rows()) / 4;
    let asked = tx.view.robots_of(rollout_id).filter(|r| is_asked(tx.view, r));
    let asked: Vec<RolloutRobot> = asked.take(room).cloned().collect();
    for r in asked {
        if let Some(to) = machine::next(r.step, &Move::LeaveDrain) {
            give_up_drain(tx, r, to);
        }
    }
}

fn give_grant(tx: &mut Tx, board: &Board, rollout: &Rollout, mut r: RolloutRobot) {
    let (Some(drain_id), Some(authority)) = (r.drain_id.clone(), anchor(tx.view, board, &r.robot_id)) else { return };
    // Fleet's record must still say so when this is written.
    tx.rely::<RobotAuthority>(r.robot_id.as_str());
    tx.rely::<Rollout>(rollout.rollout_id.as_str());
    if let Some(area) = area_ahead(tx.view, board, rollout, &r) {
        tx.rely::<AreaPolicy>(area.as_str());
    }
    let used = used_grant(tx.view, board, &tx.now, &r.robot_id);
    let grant_id = next_number(tx, used);
    let given = ActivationGrant { grant_id, drain_id, authority };
    change_desired(tx, &r.robot_id, |d| d.grant = Some(given));
    r.grant = Some(GivenPermission { grant_id, authority, generation: rollout.generation });
    r.moments.granted_link = Some(stamp_now(tx));
    r.attempted = true;
    tx.put_row(r, "robot.granted");
}
