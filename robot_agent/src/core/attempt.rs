//! Executes one attempt: its steps in order, its pauses, its end, and what a restart means for it.
//!
//! Invariant: the ledger knows of a step that must not be done twice before the body begins it, and of an end before
//! anybody hears of it. Drives live in `drive`, offers in `offer`.

use super::governor;
use super::state::AgentCore;
use super::work::{CHARGE, Doing, Ending, PARK, Pause, Work};
use crate::body::{BodyNews, BodyOrder, Checked};
use crate::storage::{Intent, Op};
use midshift_core::ids::WaypointId;
use midshift_core::robot::WorkState;
use midshift_core::robot::{FAULT_TIMEOUT, Fault, FaultClass, HardwareStop, Lane, Mode, ReportedAttempt, StopLevel};
use midshift_core::robot_events::{AttemptReport, RobotEvent, WorkStats};
use midshift_core::step::{Effect, StepKind, WorkStep};
use midshift_core::time::{LinkTime, Now, SiteDuration, SiteTime};
use std::sync::Arc;

/// Charging ends here if neither the action nor the area says, permille.
const CHARGE_STOP_PERMILLE: u16 = 900;
/// Orders in one step of the core at most; what is left waits for the next.
const ORDERS_AT_ONCE: usize = 64;

fn timeout(what: &str) -> Fault {
    Fault { code: FAULT_TIMEOUT, class: FaultClass::Recoverable, message: format!("{what} took longer than allowed") }
}

impl AgentCore {
    /// Whether the robot may go on now.
    pub(crate) fn pause(&self, now: &Now) -> Pause {
        if self.mode != Mode::Automatic || self.hardware_stop != HardwareStop::None || self.is_stopped() {
            return Pause::Now;
        }
        let waits = self.is_held() || self.suspends() || !self.has_lease(now) || !self.runs_what_was_signed();
        if waits { Pause::WindDown } else { Pause::No }
    }

    /// It is asked to hand its attempt back at a step boundary, and it may: it carries nothing and is not inside an
    /// action.
    fn suspends(&self) -> bool {
        let asked = |w: &Work| {
            w.order.as_ref().is_some_and(|o| o.suspend) && w.holder.intent.is_none() && w.doing != Doing::Acting
        };
        self.work.as_ref().is_some_and(asked) && self.body.load().is_none()
    }

    /// Hold tokens stand, or the last was taken away and nobody has let the robot go on yet.
    fn is_held(&self) -> bool {
        self.resume_needed || self.desired.as_ref().is_some_and(|d| d.held)
    }

    /// Until when it may go on with an attempt: from the sending of the newest heartbeat that was echoed.
    fn lease_until(&self) -> Option<LinkTime> {
        self.sent.lease_from().map(|from| from + self.authority)
    }

    fn has_lease(&self, now: &Now) -> bool {
        let echoed = self.echo_after.is_none_or(|after| self.sent.lease_from().is_some_and(|from| from >= after));
        echoed
            && !self.work_unreadable
            && !self.is_observed()
            && self.lease_until().is_some_and(|until| now.link <= until)
    }

    /// Lets the clocks of the attempt run. `start_to_close` stands still while the work is held.
    pub(crate) fn elapse(&mut self, now: &Now) {
        let passed = now.site.since(self.last_site).as_ms();
        self.last_site = now.site;
        let held = self.is_held() || self.is_stopped();
        let Some(work) = &mut self.work else { return };
        work.holder.duration_ms += passed;
        if !held && !work.holder.unknown {
            work.holder.elapsed_ms += passed;
            work.step_elapsed_ms += passed;
        }
        let hottest = self.body.state(now.site).hottest_joint_decidegrees;
        work.holder.hottest_joint_decidegrees = work.holder.hottest_joint_decidegrees.max(hottest);
    }

    /// When the attempt or its step takes too long.
    pub(crate) fn times_out_at(&self, now: &Now) -> Option<SiteTime> {
        let work = self.work.as_ref().filter(|w| w.ending.is_none() && !w.holder.unknown)?;
        let order = work.order.as_ref()?;
        let attempt = order.timeout_ms.saturating_sub(work.holder.elapsed_ms);
        let step = work.step().and_then(|s| s.timeout_ms).map(|t| t.saturating_sub(work.step_elapsed_ms));
        Some(now.site + SiteDuration(step.map_or(attempt, |s| s.min(attempt)) + 1))
    }

    /// What the body says, until it says nothing more.
    pub(crate) fn take_news(&mut self, now: &Now) {
        for _ in 0..ORDERS_AT_ONCE {
            let news = self.body.poll(now.site);
            if news.is_empty() {
                return;
            }
            news.into_iter().for_each(|n| self.on_news(now, n));
        }
    }

    fn on_news(&mut self, now: &Now, news: BodyNews) {
        match news {
            BodyNews::Reached(waypoint) => self.on_reached(now, &waypoint),
            BodyNews::Done => self.on_done(),
            BodyNews::Failed(fault) => {
                if self.work.as_ref().is_some_and(|w| w.doing != Doing::Nothing) {
                    self.step_failed(now, fault);
                }
            }
            BodyNews::Mode(mode) => self.on_mode(now, mode),
            BodyNews::HardwareStop(stop) => {
                self.emit(Lane::Critical, RobotEvent::HardwareStop(stop));
                self.hardware_stop = stop;
                if stop == HardwareStop::None {
                    self.echo_after = Some(now.link);
                }
            }
            BodyNews::Load(load) => {
                self.listed_load.clear();
                self.emit(Lane::Event, RobotEvent::Load(load));
            }
            BodyNews::Fault(fault, stands) => self.fault_changed(fault, stands),
        }
    }

    fn on_done(&mut self) {
        let Some(work) = &mut self.work else { return };
        match work.doing {
            Doing::Driving => {
                work.doing = Doing::Nothing;
                work.path.clear();
            }
            Doing::Acting => {
                work.doing = Doing::Nothing;
                self.complete_step();
            }
            Doing::Nothing | Doing::Charging | Doing::Parking => {}
        }
    }

    /// A person took over or gave back. What was under way is dropped; before going on the robot looks what was done.
    fn on_mode(&mut self, now: &Now, mode: Mode) {
        if mode == self.mode {
            return;
        }
        self.emit(Lane::Event, RobotEvent::Mode(mode));
        self.mode = mode;
        if mode == Mode::Automatic {
            self.echo_after = Some(now.link);
            self.note_where_it_stands();
            self.judge_intent();
            return;
        }
        self.heading = None;
        if let Some(work) = self.work.as_mut() {
            if work.doing != Doing::Nothing {
                self.body.stop(now.site, StopLevel::Halt);
            }
            work.doing = Doing::Nothing;
            (work.paused, work.located, work.recheck, work.intent_fresh) = (false, false, true, false);
            work.path.clear();
        }
    }

    /// After a break inside a step that must not be done twice: if the body cannot tell, nobody knows.
    pub(crate) fn judge_intent(&mut self) {
        let Some(work) = self.work.as_mut().filter(|w| !w.holder.unknown && !w.intent_fresh) else { return };
        let Some(intent) = &work.holder.intent else { return };
        if self.body.check(&intent.kind, work.holder.attempt.subject.task_id()) == Checked::Unknown {
            work.holder.unknown = true;
            work.holder.opened = true;
            self.write_holder(true);
        }
    }

    /// Gives orders until the body is busy, the work waits, or something must be durable first.
    pub(crate) fn advance(&mut self, now: &Now) {
        for _ in 0..ORDERS_AT_ONCE {
            if !self.is_durable() {
                self.restrain(now);
                break;
            }
            if !self.advance_once(now) {
                break;
            }
            self.take_news(now);
        }
        if self.work.is_some()
            && let Some(until) = self.lease_until().filter(|until| *until >= now.link)
        {
            self.wake_at(until + midshift_core::time::LinkDuration(1));
        }
        self.report_changed_state(now);
    }

    /// While something must be durable first, nothing new begins; but what must end or stand does not wait for a disk.
    fn restrain(&mut self, now: &Now) {
        let pause = self.pause(now);
        let Some(work) = self.work.as_ref().filter(|w| w.doing == Doing::Driving && !w.paused) else { return };
        let pause = if work.ending.is_some() && pause == Pause::No { Pause::WindDown } else { pause };
        if !self.mind_pause(now, pause == Pause::Now, true) {
            self.shorten(now, pause);
        }
    }

    fn advance_once(&mut self, now: &Now) -> bool {
        let pause = self.pause(now);
        if pause == Pause::No {
            self.goes_on();
        }
        self.check_timeouts(now);
        let Some(work) = self.work.as_ref() else { return false };
        if work.ending.is_some() {
            return self.wind_up(now, pause);
        }
        match work.doing {
            Doing::Nothing => self.begin(now, pause),
            Doing::Driving => {
                if self.mind_pause(now, pause == Pause::Now, pause != Pause::No) {
                    return true;
                }
                !self.is_paused() && self.drive(now, pause)
            }
            Doing::Acting => {
                let may_pause = work.step().is_some_and(|s| s.pause_allowed);
                let stand = pause == Pause::Now || (pause == Pause::WindDown && may_pause);
                // What stood by a stop goes on by permission only, also where it may not be paused.
                let keep = stand || (pause != Pause::No && self.has_stood());
                self.mind_pause(now, stand, keep)
            }
            Doing::Charging => self.mind_charge(now),
            Doing::Parking => {
                let done = self.body.standstill(now.site);
                if done {
                    self.set_doing(Doing::Nothing);
                    self.complete_step();
                }
                done
            }
        }
    }

    fn is_paused(&self) -> bool {
        self.work.as_ref().is_some_and(|w| w.paused)
    }

    fn set_doing(&mut self, doing: Doing) {
        if let Some(work) = &mut self.work {
            work.doing = doing;
        }
    }

    /// Pauses the body if it must stand, lets it go on only if nothing keeps it. True: it was told something.
    fn mind_pause(&mut self, now: &Now, stand: bool, keep: bool) -> bool {
        let Some(work) = &mut self.work else { return false };
        if stand && !work.paused {
            work.paused = true;
            self.body.pause(now.site);
            return true;
        }
        if !stand && !keep && work.paused {
            work.paused = false;
            self.body.resume(now.site);
            return true;
        }
        false
    }

    fn check_timeouts(&mut self, now: &Now) {
        let Some(work) = self.work.as_mut().filter(|w| w.ending.is_none() && !w.holder.unknown) else { return };
        let Some(order) = &work.order else { return };
        if work.holder.elapsed_ms > order.timeout_ms {
            work.ending = Some(Ending::Fail(timeout("the attempt")));
            return;
        }
        let Some(step) = order.steps.get(work.holder.step as usize) else { return };
        if step.timeout_ms.is_none_or(|t| work.step_elapsed_ms <= t) {
            return;
        }
        if step.continue_on_fail && (step.cancel_allowed || work.doing != Doing::Acting) {
            self.body.stop(now.site, StopLevel::Halt);
            self.step_failed(now, timeout("the step"));
        } else {
            work.ending = Some(Ending::Fail(timeout("the step")));
        }
    }

    /// On the way to an end: to the next safe point, then the end.
    fn wind_up(&mut self, now: &Now, pause: Pause) -> bool {
        let Some(work) = &mut self.work else { return false };
        match work.doing {
            Doing::Nothing => {
                let all_done = work.order.as_ref().is_some_and(|o| work.holder.step as usize >= o.steps.len());
                match work.ending.clone() {
                    _ if all_done => self.finish(now, WorkState::Succeeded, None),
                    Some(Ending::Fail(fault)) => self.finish(now, WorkState::Failed, Some(fault)),
                    _ => self.finish(now, WorkState::Aborted, None),
                }
                true
            }
            // It goes on charging until it drives: only its errand ends.
            Doing::Charging | Doing::Parking => {
                work.doing = Doing::Nothing;
                true
            }
            Doing::Driving if pause == Pause::Now || work.paused => {
                self.body.stop(now.site, StopLevel::Halt);
                work.doing = Doing::Nothing;
                true
            }
            Doing::Driving => self.drive(now, Pause::WindDown),
            Doing::Acting => {
                if pause == Pause::Now || work.step().is_none_or(|s| s.cancel_allowed) {
                    self.interrupt_action(now);
                    return true;
                }
                self.mind_pause(now, false, pause != Pause::No && self.has_stood())
            }
        }
    }

    /// Stops an action before its end and asks the body how far it came.
    fn interrupt_action(&mut self, now: &Now) {
        self.body.stop(now.site, StopLevel::Halt);
        let Some(work) = &mut self.work else { return };
        work.doing = Doing::Nothing;
        let Some(step) = work.step().cloned() else { return };
        if step.effect == Effect::Repeatable {
            return;
        }
        match self.body.check(&step.kind, work.holder.attempt.subject.task_id()) {
            Checked::Done => self.complete_step(),
            Checked::NotDone => {
                work.holder.intent = None;
                self.write_holder(true);
            }
            Checked::Unknown => {
                work.holder.opened |= step.effect == Effect::AtMostOnce;
                self.write_holder(true);
            }
        }
    }

    /// Between two orders: what is next.
    fn begin(&mut self, now: &Now, pause: Pause) -> bool {
        let Some(work) = &self.work else { return false };
        let Some(order) = work.order.clone() else { return false };
        if work.holder.unknown {
            return false;
        }
        let Some(step) = order.steps.get(work.holder.step as usize) else {
            self.finish(now, WorkState::Succeeded, None);
            return true;
        };
        if self.suspends() && self.at_boundary(work) {
            self.finish(now, WorkState::Suspended, None);
            return true;
        }
        if pause != Pause::No {
            return false;
        }
        match &step.kind {
            StepKind::Goto { .. } => self.drive(now, pause),
            StepKind::Action { name, .. } if name == CHARGE => {
                self.body.charge(now.site, true);
                self.mark_started(Doing::Charging);
                true
            }
            StepKind::Action { name, .. } if name == PARK => {
                self.body.park(now.site);
                self.mark_started(Doing::Parking);
                true
            }
            StepKind::Action { .. } | StepKind::Wait { .. } => self.act(now, step),
        }
    }

    fn mark_started(&mut self, doing: Doing) {
        if let Some(work) = &mut self.work {
            work.started = true;
            work.recheck = false;
            work.intent_fresh = false;
            work.paused = false;
            work.doing = doing;
        }
    }

    /// Begins an action: what must not be done twice is written down first, what may have been done is looked at first.
    fn act(&mut self, now: &Now, step: &WorkStep) -> bool {
        let Some(work) = &mut self.work else { return false };
        let once = step.effect == Effect::AtMostOnce;
        let unsure = match step.effect {
            Effect::AtMostOnce => work.holder.intent.is_some() && !work.intent_fresh,
            Effect::CheckFirst => work.recheck,
            Effect::Repeatable => false,
        };
        if unsure {
            match self.body.check(&step.kind, work.holder.attempt.subject.task_id()) {
                Checked::Done => {
                    self.complete_step();
                    return true;
                }
                Checked::Unknown if once => {
                    work.holder.unknown = true;
                    work.holder.opened = true;
                    self.write_holder(true);
                    return false;
                }
                Checked::NotDone | Checked::Unknown => {}
            }
        } else if once && work.holder.intent.is_none() {
            work.holder.intent = Some(Intent { step: work.holder.step, kind: step.kind.clone() });
            work.intent_fresh = true;
            self.write_holder(true);
            self.wait_until_durable();
            return true;
        }
        self.body.work_for(work.holder.attempt.subject.task_id(), work.holder.step);
        match self.body.start(now.site, BodyOrder::Act(step.kind.clone())) {
            Ok(()) => self.mark_started(Doing::Acting),
            Err(fault) => self.step_failed(now, fault),
        }
        true
    }

    fn mind_charge(&mut self, now: &Now) -> bool {
        let Some(work) = &self.work else { return false };
        let asked = match work.step().map(|s| &s.kind) {
            Some(StepKind::Action { params, .. }) => params.get("stop_permille").and_then(serde_json::Value::as_u64),
            _ => None,
        };
        let area = work.order.as_ref().and_then(|o| o.route.last()).map(|p| &p.area_id);
        let policy = area.and_then(|a| governor::policy_of(&self.memory.ledger.policy, a));
        let stop = asked.unwrap_or(u64::from(policy.map_or(CHARGE_STOP_PERMILLE, |p| p.charge_stop_permille)));
        if u64::from(self.body.state(now.site).battery_permille) < stop.min(1000) {
            return false;
        }
        self.body.charge(now.site, false);
        self.set_doing(Doing::Nothing);
        self.complete_step();
        true
    }

    /// The step at hand is done.
    pub(crate) fn complete_step(&mut self) {
        self.progressed();
        let Some(work) = &mut self.work else { return };
        work.holder.opened |= work.step().is_some_and(|s| s.effect == Effect::AtMostOnce);
        self.next_step();
    }

    fn next_step(&mut self) {
        let Some(work) = &mut self.work else { return };
        let next = work.holder.step + 1;
        let resume = work.order.as_ref().filter(|o| o.from_step == work.holder.step).map(|o| o.resume_step);
        work.holder.step = next.max(resume.unwrap_or(0));
        work.holder.intent = None;
        (work.recheck, work.intent_fresh, work.step_elapsed_ms) = (false, false, 0);
        let more = work.order.as_ref().is_some_and(|o| (work.holder.step as usize) < o.steps.len());
        self.write_holder(true);
        if more {
            let state = self.work_state(Pause::No);
            self.report_state(state);
        }
    }

    /// The step at hand failed: the attempt ends, unless the step says otherwise.
    pub(crate) fn step_failed(&mut self, now: &Now, fault: Fault) {
        self.progressed();
        let Some(work) = &mut self.work else { return };
        work.doing = Doing::Nothing;
        work.path.clear();
        let Some(step) = work.step().cloned() else { return };
        if step.effect == Effect::AtMostOnce {
            let checked = self.body.check(&step.kind, work.holder.attempt.subject.task_id());
            work.holder.opened |= checked != Checked::NotDone;
        }
        match (&work.ending, step.continue_on_fail) {
            (Some(_), _) => {}
            (None, true) => self.next_step(),
            (None, false) => self.finish(now, WorkState::Failed, Some(fault)),
        }
    }

    pub(crate) fn write_holder(&mut self, urgent: bool) {
        let holder = self.work.as_ref().map(|w| Box::new(w.holder.clone()));
        self.write(Op::Holder(holder), urgent);
    }

    /// The attempt is over: written with its answer before anybody hears of it.
    pub(crate) fn finish(&mut self, now: &Now, state: WorkState, fault: Option<Fault>) {
        let Some(work) = self.work.take() else { return };
        let report = AttemptReport { fault, ..self.report_of(&work, state, now) };
        let listed = self.listed(&work, state);
        self.answered.insert(report.attempt.clone());
        self.write(Op::Holder(None), true);
        self.write(Op::Finish(Arc::new(report.clone()), listed, now.wall.0), true);
        self.places.give_back_all().into_iter().for_each(|e| self.emit(Lane::Event, e));
        self.emit(Lane::Event, RobotEvent::Attempt(report));
        // Fleet gives the next work by where the robot stands now, not by where it was a heartbeat ago.
        self.beat_at_once(now);
    }

    fn listed(&self, work: &Work, state: WorkState) -> ReportedAttempt {
        ReportedAttempt {
            attempt: work.holder.attempt.clone(),
            state,
            step_index: work.holder.step,
            progress: self.progress(),
            route_index: work.reached.unwrap_or(0) as u32,
            opened: work.holder.opened,
        }
    }

    pub(crate) fn reported_attempts(&self, now: &Now) -> Vec<ReportedAttempt> {
        let live = self.work.as_ref().map(|w| self.listed(w, self.work_state(self.pause(now))));
        live.into_iter().chain(self.memory.ledger.unclosed.values().cloned()).collect()
    }

    fn report_of(&self, work: &Work, state: WorkState, now: &Now) -> AttemptReport {
        let (body, holder) = (self.body.state(now.site), &work.holder);
        AttemptReport {
            attempt: holder.attempt.clone(),
            state,
            step_index: holder.step,
            opened: holder.opened,
            refusal: None,
            fault: None,
            stats: WorkStats {
                path_mm: body.odometer_mm.saturating_sub(holder.base_odometer_mm),
                loaded_path_mm: body.loaded_odometer_mm.saturating_sub(holder.base_loaded_mm),
                duration_ms: holder.duration_ms,
                energy_mwh: body.energy_mwh.saturating_sub(holder.base_energy_mwh),
                hottest_joint_decidegrees: holder.hottest_joint_decidegrees,
            },
        }
    }

    /// What the robot does with its attempt.
    fn work_state(&self, pause: Pause) -> WorkState {
        let Some(work) = &self.work else { return WorkState::Aborted };
        let stands = work.paused || work.doing == Doing::Nothing;
        if work.holder.unknown {
            return WorkState::StepUnknown;
        }
        if work.ending.is_some() {
            return WorkState::Stopping;
        }
        let held = self.is_held() || pause == Pause::Now;
        if stands && (held || (work.started && (pause != Pause::No || work.order.is_none()))) {
            return WorkState::Paused;
        }
        if !work.started {
            return WorkState::Accepted;
        }
        match work.step().map(|s| &s.kind) {
            Some(StepKind::Goto { .. }) => WorkState::Navigating,
            _ => WorkState::Executing,
        }
    }

    /// Says what it does with its attempt, if that changed.
    fn report_changed_state(&mut self, now: &Now) {
        let pause = self.pause(now);
        let state = self.work_state(pause);
        let Some(work) = &self.work else { return };
        if work.told != Some((state, work.holder.step)) {
            self.report_state(state);
        }
    }

    fn report_state(&mut self, state: WorkState) {
        let now = Now { site: self.last_site, ..Now::default() };
        let Some(work) = &self.work else { return };
        let report = self.report_of(work, state, &now);
        if let Some(work) = &mut self.work {
            work.told = Some((state, work.holder.step));
        }
        self.emit(Lane::Event, RobotEvent::Attempt(report));
    }

    /// Where the body is or was last.
    pub(crate) fn last_waypoint(&self, now: &Now) -> Option<WaypointId> {
        self.body.state(now.site).waypoint
    }
}
