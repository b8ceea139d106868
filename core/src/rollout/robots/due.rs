//! Finds what is due for each robot of a roll-out: fetch, drain, permission, trial, commit, and back.
//!
//! [`decide_move`] says what is due and [`super::moves`] writes it, so that the planner and an explanation see the same.
//! Invariants:
//! 1. Permission is given only while fleet's record says that this drain holds the robot, the roll-out runs and nobody
//!    has frozen the area.
//! 2. Robots out of work for a roll-out are counted in its row, in the item that takes one more.

use super::drains::{is_asked, is_permission_unused};
use super::machine::Move;
use crate::authority::Authority;
use crate::fleet::Board;
use crate::fleet::liveness;
use crate::fleet::rows::DrainState;
use crate::ids::{AreaId, RobotId, RolloutId};
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::robot::{Duty, HardwareStop};
use crate::rollout::judgement::failures::is_hard;
use crate::rollout::judgement::{infrastructure, jams, verdict};
use crate::rollout::members::{area_bundles, matching};
use crate::rollout::projection::queue::{is_directive_old, is_late, is_newcomer, is_on, is_retried, waits_out};
use crate::rollout::projection::rows::{Pause, Phase, Rollout, RolloutRobot, Step};
use crate::rollout::projection::spec::AbortScope;
use crate::rollout::projection::state::RolloutProjection;
use crate::time::Now;
use crate::update::{Goal, UpdateReport, UpdateState};

/// One robot in one roll-out, with all that decides what is due for it.
#[derive(Clone, Copy)]
struct Situation<'a> {
    view: &'a RolloutProjection,
    board: &'a Board,
    now: &'a Now,
    rollout: &'a Rollout,
    r: &'a RolloutRobot,
    /// What it said of the directive that it was given, or of a later one.
    report: Option<&'a UpdateReport>,
}

/// What is due for `r` now, if anything.
pub fn decide_move(
    view: &RolloutProjection,
    board: &Board,
    now: &Now,
    rollout: &Rollout,
    r: &RolloutRobot,
) -> Option<Move> {
    if view.duty(&r.robot_id) == Duty::Retired && !r.step.is_over() {
        return Some(Move::Skip(Code::SkippedRetired.into()));
    }
    let is_silent = liveness::presence(board, &r.robot_id, now) == Presence::Offline;
    if r.lost.is_some() && !is_silent {
        return Some(Move::Heard);
    }
    let report = view.report_of(board, r).filter(|report| report.directive_generation >= r.directive_generation);
    let situation = Situation { view, board, now, rollout, r, report };
    let due = match r.step {
        Step::Waiting => situation.waiting(),
        Step::Staging => situation.staging(),
        Step::Staged => situation.staged(),
        Step::Draining => situation.draining(),
        Step::Activating => situation.activating(),
        Step::Trial => situation.trial(),
        Step::Committing => situation.committing(),
        Step::Reverting => situation.reverting(),
        Step::Committed => situation.goes_back().then_some(Move::Revert),
        Step::Skipped if situation.is_tried_again() => Some(Move::Again),
        Step::Skipped => situation.keeps_for_nothing().then_some(Move::Forget),
        Step::RolledBack => None,
        // Somebody mended it.
        Step::Stuck => {
            report.filter(|r| r.state == UpdateState::RolledBack).map(|_| Move::RolledBack(Code::RollbackFailed.into()))
        }
    };
    let is_out = is_silent && r.drain_id.is_some() && r.lost.is_none();
    let is_long = || infrastructure::silent_ms(view, board, now, &r.robot_id) >= rollout.spec.lost_after_ms;
    due.or_else(|| (is_out && is_long()).then_some(Move::Lost))
}

/// Why a robot that has the bundle is not taken out of work now.
pub fn blocked(
    view: &RolloutProjection,
    board: &Board,
    now: &Now,
    rollout: &Rollout,
    r: &RolloutRobot,
) -> Option<Reason> {
    Situation { view, board, now, rollout, r, report: None }.blocked()
}

impl<'a> Situation<'a> {
    fn is_tried_again(self) -> bool {
        let waited = waits_out(self.r).is_some_and(|wait_ms| self.now.ms_since(self.r.since) >= wait_ms);
        let at_the_end = self.rollout.second_pass && !self.r.again && is_retried(self.r);
        self.rollout.may_go_on() && (waited || at_the_end)
    }

    /// It has the bundle for a second try that will not come.
    fn keeps_for_nothing(self) -> bool {
        let staged = self.wants(Goal::Stage) || self.wants(Goal::Activate);
        let ours = self.r.directive_generation > 0 && self.r.never_ran() && self.claimed_by().is_none();
        staged && ours && self.rollout.phase.goes_back()
    }

    /// Whether it was told so already.
    fn wants(self, goal: Goal) -> bool {
        wants(self.view, self.r, goal)
    }

    /// Another roll-out that has the robot.
    fn claimed_by(self) -> Option<&'a RolloutId> {
        matching::claimed_by(self.view, &self.r.robot_id, &self.r.rollout_id)
    }

    fn is_heard(self) -> bool {
        self.view.is_heard(self.board, self.now, &self.r.robot_id)
    }

    /// Its turn has come, and the roll-out does not stand still.
    fn has_its_turn(self) -> bool {
        is_on(self.rollout, self.r) && self.rollout.pauses.is_empty()
    }

    /// Why a robot that does not run the bundle yet will not get it; none: it may.
    fn left_out(self) -> Option<Reason> {
        let Self { view, rollout, r, .. } = self;
        let comes_later = is_newcomer(rollout, r);
        if rollout.phase.goes_back() || (rollout.phase == Phase::Completed && !comes_later) {
            return Some(Code::RolloutEnded.into());
        }
        if comes_later && is_gone(view, rollout) {
            return Some(Code::BundleRevoked.into());
        }
        // Another has come since, or this one served a newcomer badly. Who is tried again was asked for by a person.
        if comes_later && !r.again && !area_bundles::is_served(view, &rollout.rollout_id) {
            return Some(Code::RolloutEnded.into());
        }
        let pin = view.software.get(r.robot_id.as_str()).and_then(|s| s.row.pin.as_ref());
        let pinned = pin.filter(|_| rollout.revert_of.is_none()).map(matching::pin_reason);
        pinned.or_else(|| matching::other_key(view, &r.robot_id))
    }

    fn waiting(self) -> Option<Move> {
        let Self { view, rollout, r, .. } = self;
        if let Some(why) = self.left_out() {
            return Some(Move::Skip(why));
        }
        if !(rollout.phase.runs() || is_newcomer(rollout, r)) || !rollout.pauses.is_empty() {
            return None;
        }
        if let Some(stratum) = matching::stratum_of(view, self.board, &r.robot_id)
            && let Some(bundle) = view.bundles.get(rollout.spec.bundle.as_str())
            && rollout.revert_of.is_none()
            && let Err(reason) = matching::may_have(view, &r.robot_id, &stratum, &bundle.row)
        {
            return Some(Move::Skip(reason));
        }
        // What is not heard keeps nobody waiting, whoever has it.
        if let Some(skip) = self.skips_offline() {
            return Some(skip);
        }
        if let Some(other) = self.claimed_by() {
            return self.skips_busy(other);
        }
        if rollout.revert_of.is_some() {
            return Some(Move::IsStaged);
        }
        // A robot that has never been heard has no session to write to.
        view.sessions.contains_key(r.robot_id.as_str()).then_some(Move::Stage)
    }

    /// Its turn has come, the roll-out does not stand still, and the robot is not heard. A robot that is to go back is
    /// waited for by nobody, and goes back when it comes; one that came later is in nobody's way.
    fn skips_offline(self) -> Option<Move> {
        let planned = self.rollout.revert_of.is_none() && !is_newcomer(self.rollout, self.r);
        let skips = self.has_its_turn() && planned && !self.is_heard();
        skips.then(|| Move::Skip(Code::SkippedOffline.into()))
    }

    /// Another roll-out has the robot and does not let it go: its turn passes.
    fn skips_busy(self, other: &RolloutId) -> Option<Move> {
        let late = self.has_its_turn() && !is_newcomer(self.rollout, self.r) && is_late(self.now, self.rollout, self.r);
        late.then(|| Move::Skip(Reason::from(Code::SkippedBusy).with("rollout_id", other)))
    }

    /// Its turn came long ago, and it has not fetched the bundle.
    fn skips_stuck(self) -> Option<Move> {
        let late = self.has_its_turn() && is_late(self.now, self.rollout, self.r);
        late.then(|| Move::Skip(Code::SkippedStuck.into()))
    }

    fn staging(self) -> Option<Move> {
        if let Some(why) = self.left_out() {
            return Some(Move::Skip(why));
        }
        match self.report.map(|report| report.state) {
            Some(UpdateState::Directed | UpdateState::Downloading) => {}
            Some(UpdateState::Refused) => return Some(self.skips_refused()),
            Some(_) => return Some(Move::IsStaged),
            None if is_directive_old(self.now, self.r.signed) => return Some(Move::SignAnew),
            None => {}
        }
        self.skips_offline().or_else(|| self.skips_stuck()).or_else(|| {
            // What it was told is gone: it is told again.
            (!self.view.desired.contains_key(self.r.robot_id.as_str())).then_some(Move::Stage)
        })
    }

    /// The robot refused what it was told; why, in its own words.
    fn skips_refused(self) -> Move {
        Move::Skip(self.report.and_then(|r| r.reason.clone()).unwrap_or_else(|| Code::BundleUnfit.into()))
    }

    fn staged(self) -> Option<Move> {
        if let Some(why) = self.left_out() {
            return Some(Move::Skip(why));
        }
        match self.report.map(|report| report.state) {
            Some(UpdateState::Refused) => return Some(self.skips_refused()),
            // What was staged is gone: its disk was changed, and it begins again.
            Some(UpdateState::Directed | UpdateState::Downloading) if self.rollout.revert_of.is_none() => {
                return self.skips_offline().or_else(|| self.skips_stuck());
            }
            _ => {}
        }
        match self.blocked() {
            None => self.skips_offline().or_else(|| {
                let comes = self.rollout.revert_of.is_some() || self.is_heard();
                comes.then_some(Move::AskDrain)
            }),
            Some(why) if why.code == Code::BlockedByRollout => self.skips_busy(self.claimed_by()?),
            Some(_) => None,
        }
    }

    /// Why it is not taken out of work now, though it has the bundle.
    fn blocked(self) -> Option<Reason> {
        let Self { view, rollout, r, .. } = self;
        if rollout.pauses.contains(&Pause::Keyless) || is_keyless(view, rollout) {
            return Some(view.keyless.unwrap_or(Code::NoDirectiveKey).into());
        }
        if !rollout.pauses.is_empty() {
            return Some(Reason::from(Code::BlockedByPause).with("pauses", rollout.pauses_text()));
        }
        if !is_on(rollout, r) {
            return Some(Reason::from(Code::BlockedByWave).with("wave", r.wave));
        }
        if let Some(other) = self.claimed_by() {
            return Some(Reason::from(Code::BlockedByRollout).with("rollout_id", other));
        }
        if let Some(area) = self.shut_area() {
            return Some(Reason::from(Code::BlockedByWindow).with("area_id", area));
        }
        let in_flight = rollout.in_flight;
        let is_full = in_flight >= in_flight_max(view, rollout);
        is_full.then(|| Reason::from(Code::BlockedByTurnInWave).with("in_flight", in_flight))
    }

    /// The area of the robot, if no new drain may begin there.
    fn shut_area(self) -> Option<AreaId> {
        let area = area_ahead(self.view, self.board, self.rollout, self.r);
        area.filter(|area| !self.view.policy(area).software.is_open(self.now))
    }

    fn draining(self) -> Option<Move> {
        let Self { view, rollout, r, .. } = self;
        let drain_id = r.drain_id.as_ref()?;
        if view.is_held(&r.robot_id, drain_id) || (view.bugs.any_drain_will_do() && view.is_held_by_any(&r.robot_id)) {
            return Some(Move::Held);
        }
        if self.stands_still() || (is_asked(view, r) && self.shut_area().is_some()) {
            return Some(Move::LeaveDrain);
        }
        let drain = view.drain(drain_id)?;
        // To wait for the budget costs nothing. A person may keep a robot out of work for weeks.
        let behind_person = drain.state == DrainState::Waiting
            && drain.why.as_ref().is_some_and(|why| why.code == Code::RobotDraining)
            && is_late(self.now, rollout, r);
        match drain.state {
            DrainState::Refused => Some(Move::Skip(Code::SkippedBusy.into())),
            _ if behind_person => Some(Move::Skip(drain.why.clone().map_or(Code::SkippedBusy.into(), |why| {
                Reason::new(Code::SkippedBusy, why.text()).with("because", why.code)
            }))),
            _ => None,
        }
    }

    /// It gets no permission now: the roll-out stands still, or somebody has frozen its area. A window that shuts lets
    /// what has begun end.
    fn stands_still(self) -> bool {
        let Self { view, rollout, .. } = self;
        let area = || area_ahead(view, self.board, rollout, self.r);
        let frozen = || area().is_some_and(|area| view.policy(&area).software.frozen);
        let stands = self.left_out().is_some() || !rollout.pauses.is_empty() || is_keyless(view, rollout);
        (stands || frozen()) && !view.bugs.pause_is_forgotten()
    }

    fn activating(self) -> Option<Move> {
        let Self { view, rollout, r, report, .. } = self;
        if rollout.revert_of.is_some() {
            return Some(Move::Revert);
        }
        if let Some(over) = ended(r, report) {
            return Some(over);
        }
        match report.map(|r| r.state) {
            Some(UpdateState::Trial | UpdateState::Committing | UpdateState::Committed) => return Some(Move::OnTrial),
            // It is over for this directive: a permission that was given cannot be used any more.
            Some(UpdateState::Refused) => return Some(self.skips_refused()),
            Some(UpdateState::Probation | UpdateState::RollingBack) => {
                if r.moments.switched.is_none() {
                    return Some(Move::Switched);
                }
                let goes = rollout.phase.goes_back() && !self.wants(Goal::Revert);
                return goes.then_some(Move::GoBack).or_else(|| self.lost());
            }
            _ => {}
        }
        match &r.grant {
            Some(given) => {
                let is_unused = is_permission_unused(view, self.board, self.now, r, given, report);
                is_unused.then_some(Move::NotUsed).or_else(|| self.lost())
            }
            None if self.stands_still() || (!is_on(rollout, r) && !view.bugs.pause_is_forgotten()) => {
                Some(Move::LeaveDrain)
            }
            None if r.ready && self.may_be_granted() => Some(Move::Grant),
            None => {
                let held = r.moments.held.map_or(0, |at| self.now.ms_since(at));
                let late = held >= limits::READY_WITHIN.as_ms();
                late.then(|| {
                    let why = report.and_then(|r| r.reason.as_ref()).map(|why| why.text().to_owned());
                    Move::Skip(Reason::new(Code::SkippedStuck, why.unwrap_or_default()))
                })
            }
        }
    }

    /// Fleet's record says that this drain holds the robot, and it is heard in its newest session.
    fn may_be_granted(self) -> bool {
        let Self { view, r, .. } = self;
        let held = r.drain_id.as_ref().is_some_and(|id| view.is_held(&r.robot_id, id));
        let heard = self.is_heard() && anchor(view, self.board, &r.robot_id).is_some();
        (held || view.bugs.any_drain_will_do()) && heard
    }

    /// The robot is not heard, though most others are. It is taken back until the gate of its wave closes.
    fn lost(self) -> Option<Move> {
        let Self { view, board, now, rollout, r, .. } = self;
        let network = [Pause::Infrastructure, Pause::InfrastructureUnknown];
        let counts_as_lost = r.failure.as_ref().is_some_and(|f| f.code == Code::RobotLost);
        match (infrastructure::is_missing(view, board, now, rollout, r), counts_as_lost) {
            // The roll-out stands still for it: nothing is anybody's fault yet.
            (true, false) if network.iter().any(|p| rollout.pauses.contains(p)) => None,
            (true, false) if infrastructure::check_controls(view, board, now, r).is_ok() => {
                Some(Move::Fail(Code::RobotLost.into()))
            }
            (false, true) if infrastructure::is_open_to(rollout, r) => Some(Move::Found),
            _ => None,
        }
    }

    /// It must leave what it runs.
    fn goes_back(self) -> bool {
        let Self { view, rollout, r, .. } = self;
        let kept = matches!(r.step, Step::Committing | Step::Committed);
        let irreversible = kept && is_irreversible(view, rollout);
        let in_scope = rollout.spec.abort_scope == AbortScope::All || !kept;
        let aborts =
            matches!(rollout.phase, Phase::Aborting | Phase::RollingBack) || (rollout.phase.goes_back() && !kept);
        aborts && in_scope && !irreversible && r.attempted
    }

    fn trial(self) -> Option<Move> {
        let Self { view, board, now, rollout, r, report } = self;
        if let Some(over) = ended(r, report).or_else(|| self.lost()) {
            return Some(over);
        }
        if self.goes_back() {
            return Some(Move::Revert);
        }
        if let Some(why) = &r.failure {
            // The wave is not judged against it yet, or was judged without it: this robot goes back by itself.
            let stays = rollout.phase.runs() && (is_hard(why) || rollout.phase == Phase::Review);
            return (!stays).then_some(Move::Revert);
        }
        if is_newcomer(rollout, r) && is_gone(view, rollout) {
            return Some(Move::Revert);
        }
        let broken = view.control.get(r.robot_id.as_str()).and_then(|c| c.row.breaker);
        if broken.is_some_and(|since| r.moments.on_trial.is_some_and(|at| since >= at)) {
            return Some(Move::Fail(Code::BreakerOnTrial.into()));
        }
        if jams::is_blamed(view, board, now, rollout, r) {
            return Some(Move::Fail(Code::JammedOnTrial.into()));
        }
        let promoted = if is_newcomer(rollout, r) {
            let soaked = r.moments.on_trial.is_some_and(|at| now.ms_since(at) >= rollout.spec.soak_ms);
            soaked && verdict::exposure_of(view, rollout, r).ended() >= rollout.spec.exposure_tasks
        } else {
            r.wave < rollout.promoted
        };
        (promoted && rollout.pauses.is_empty()).then_some(Move::Commit)
    }

    fn committing(self) -> Option<Move> {
        let Self { view, rollout, r, report, .. } = self;
        let all = rollout.spec.abort_scope == AbortScope::All;
        match report.map(|r| r.state) {
            Some(UpdateState::Committed) => Some(Move::Committed),
            _ if rollout.phase.goes_back() && all && !is_irreversible(view, rollout) => Some(Move::Revert),
            _ => ended(r, report),
        }
    }

    /// The robot knows of no update, and runs another version than that of the bundle.
    fn is_set_up_anew(self) -> bool {
        let Self { view, rollout, r, .. } = self;
        let live = self.board.get(&r.robot_id).filter(|live| view.is_settled(live));
        let runs = view.sessions.get(r.robot_id.as_str()).map(|s| &s.row.inventory.software);
        let bundle = view.bundles.get(rollout.spec.bundle.as_str()).map(|b| &b.row.version);
        let is_other = runs.zip(bundle).is_some_and(|(runs, bundle)| !runs.is_empty() && runs != bundle);
        is_other && live.is_some_and(|live| live.report.update.is_none())
    }

    fn reverting(self) -> Option<Move> {
        let Self { view, board, now, r, .. } = self;
        if r.way_back.unstuck && self.is_set_up_anew() {
            return Some(Move::SetUpAnew);
        }
        // What it said before a person mended it is no answer to the order that follows.
        let report = self.report.filter(|said| said.state != UpdateState::Stuck || r.way_back.is_answered_by(said));
        if let Some(over) = ended(r, report) {
            return Some(over);
        }
        let old = r.way_back.signed.is_some_and(|signed| is_directive_old(now, signed));
        if let Some(why) = &r.way_back.refused {
            // Nothing is kept, or two good orders were not taken: to ask again changes nothing.
            let is_final = why.code == Code::NothingKept || (r.way_back.again && !old);
            return Some(if is_final { Move::Stuck(why.clone()) } else { Move::OrderBackAnew });
        }
        let Some(drain_id) = &r.drain_id else { return Some(Move::Revert) };
        // In this drain: in another it was told to go back from something else.
        let told = view.desired.get(r.robot_id.as_str()).and_then(|d| d.row.drain_id.as_ref());
        let is_unsaid = r.way_back.unstuck && r.way_back.generation == 0;
        if self.wants(Goal::Revert) && told == Some(drain_id) && !is_unsaid {
            // What it took does not end; what it did not take yet does.
            let taken = report.is_some_and(|report| report.directive_generation >= r.way_back.generation);
            return (old && !taken).then_some(Move::OrderBackAnew);
        }
        // A robot that its own safety system stopped goes back where it stands: to park would be motion.
        let stopped = board.get(&r.robot_id).is_some_and(|live| live.report.hardware_stop != HardwareStop::None);
        if stopped || view.is_held(&r.robot_id, drain_id) {
            return Some(Move::GoBack);
        }
        let refused = view.drain(drain_id).is_some_and(|d| d.state == DrainState::Refused);
        refused.then_some(Move::LeaveDrain)
    }
}

/// The robot went back, or could not.
fn ended(r: &RolloutRobot, report: Option<&UpdateReport>) -> Option<Move> {
    let report = report?;
    let why = || report.reason.clone().unwrap_or_else(|| Code::RobotWentBack.into());
    match report.state {
        UpdateState::RolledBack if r.attempted => Some(Move::RolledBack(why())),
        UpdateState::Stuck => Some(Move::Stuck(why())),
        _ => None,
    }
}

/// Nobody may be given its bundle any more: a person took it back, or no release lists it.
pub fn is_gone(view: &RolloutProjection, rollout: &Rollout) -> bool {
    let bundle = view.bundles.get(rollout.spec.bundle.as_str()).map(|b| &b.row);
    rollout.revert_of.is_none() && bundle.is_none_or(|b| b.revoked.is_some() || !b.listed)
}

/// What was told to be kept cannot be gone back from.
pub fn is_irreversible(view: &RolloutProjection, rollout: &Rollout) -> bool {
    view.bundles.get(rollout.spec.bundle.as_str()).is_some_and(|b| b.row.is_irreversible)
}

/// Whether no directive for its robots can be signed now, whatever its phase: newcomers of a completed one wait too.
/// False for a roll-out that takes another one back: its robots learnt of the way back with that other one.
pub fn is_keyless(view: &RolloutProjection, rollout: &Rollout) -> bool {
    view.keyless.is_some() && rollout.revert_of.is_none()
}

/// Robots that may be out of work for a roll-out at once: never more than its wave has.
pub fn in_flight_max(view: &RolloutProjection, rollout: &Rollout) -> u32 {
    if view.bugs.in_flight_is_forgotten() {
        return u32::MAX;
    }
    if rollout.phase == Phase::Completed {
        return 1;
    }
    let wave = view.wave_sizes.get(&(rollout.rollout_id.clone(), rollout.wave)).copied().unwrap_or_default();
    rollout.spec.max_in_flight.map_or(wave, |most| most.min(wave)).max(1)
}

/// The area whose rules hold for a robot that changes to something new: where it is, or was seen last. Who goes back
/// asks no rules.
pub(super) fn area_ahead(
    view: &RolloutProjection,
    board: &Board,
    rollout: &Rollout,
    r: &RolloutRobot,
) -> Option<AreaId> {
    let here = || board.get(&r.robot_id).and_then(|live| view.area_of(live));
    let seen = || view.software.get(r.robot_id.as_str()).and_then(|s| s.row.area.clone());
    if rollout.revert_of.is_some() { None } else { here().or_else(seen) }
}

/// The heartbeat of the newest session to which a permission is anchored; none: there is none.
pub(super) fn anchor(view: &RolloutProjection, board: &Board, robot_id: &RobotId) -> Option<Authority> {
    let live = board.get(robot_id)?;
    let session = view.sessions.get(robot_id.as_str())?;
    let (session_epoch, hb) = (live.report.session_epoch, live.report.hb);
    let valid_ms = limits::ACTIVATION_VALID.as_ms();
    (session.row.session_epoch == session_epoch).then_some(Authority { session_epoch, hb, valid_ms })
}

/// Whether the robot was told so already.
pub(super) fn wants(view: &RolloutProjection, r: &RolloutRobot, goal: Goal) -> bool {
    view.desired.get(r.robot_id.as_str()).is_some_and(|d| d.row.goal == goal)
}
