//! Takes desired work in: what is older is refused, what is stale moves nobody, what is taken is on the ledger first.
//!
//! Invariant: an attempt is accepted at most once in the life of the ledger, and a refused one never later.

use super::state::AgentCore;
use super::work::{CHARGE, Ending, PARK, Work};
use crate::storage::{Holder, Op};
use midshift_core::authority::Authority;
use midshift_core::desired_state::{Assignment, DesiredWork, LoadWord};
use midshift_core::ids::DrainId;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::WorkState;
use midshift_core::robot::{Lane, Mode, StopLevel};
use midshift_core::robot_events::{AttemptReport, RobotEvent, UNREADABLE_WORK, WorkStats};
use midshift_core::step::StepKind;
use midshift_core::time::Now;
use std::sync::Arc;

/// Refused attempts remembered beside the ledger, so that a repeat of the same desired state is not answered twice.
const REFUSED_REMEMBERED: usize = 32;

/// Characters of what is wrong with a section that are told.
const UNREADABLE_DETAIL_CHARS: usize = 200;

impl AgentCore {
    /// Obeys section work.
    pub(crate) fn on_work(&mut self, now: &Now, desired: DesiredWork) {
        let mut applied = self.memory.ledger.applied;
        if desired.generation < applied.work {
            tracing::warn!(generation = desired.generation, applied = applied.work, "older work refused");
            return;
        }
        applied.work = desired.generation;
        self.work_unreadable = false;
        self.write(Op::Applied(applied), false);
        for attempt in &desired.closed {
            if self.memory.ledger.unclosed.contains_key(attempt) {
                self.write(Op::Closed(attempt.clone()), false);
            }
        }
        let given_back = self.places.desired(&desired.grants, now.link);
        given_back.into_iter().for_each(|e| self.emit(Lane::Event, e));
        let (is_held, resume) = (desired.held, desired.resume);
        self.mind_maintenance(desired.maintenance.clone());
        self.obey_load_word(now, desired.load_word);
        let assignment = desired.assignment.clone();
        self.desired = Some(desired);
        self.obey(now);
        self.mind_hold(now, is_held, resume);
        self.on_assignment(now, assignment);
    }

    /// The server sent work that this program cannot read: until it sends some that it can, the robot goes no further
    /// than without authority.
    pub(crate) fn cannot_read_work(&mut self, why: &str) {
        if self.config.bugs.newer_work_is_ignored() {
            return;
        }
        if !std::mem::replace(&mut self.work_unreadable, true) {
            tracing::error!(robot_id = %self.config.robot_id, "section work cannot be read; going on as if authority had ended");
            let detail = why.chars().take(UNREADABLE_DETAIL_CHARS).collect();
            self.emit(Lane::Event, RobotEvent::StaleAuthority { what: UNREADABLE_WORK.to_owned(), detail });
        }
    }

    /// A permission to go on counts while nothing stops the robot; it is looked at again when the stop is over.
    pub(crate) fn mind_hold(&mut self, now: &Now, is_held: bool, resume: Option<Authority>) {
        if self.work.is_none() {
            self.resume_needed = false;
        } else if is_held {
            self.resume_needed = true;
        } else if let Some(resume) = resume.filter(|_| self.resume_needed && !self.is_stopped())
            && self.may_act(now, &resume, "resume").is_ok()
        {
            self.resume_needed = false;
        }
    }

    /// The drain that holds the robot goes onto the ledger only when no attempt does.
    fn mind_maintenance(&mut self, drain_id: Option<DrainId>) {
        let taken = drain_id.filter(|_| self.work.is_none());
        if taken != self.memory.ledger.maintenance {
            self.write(Op::Maintenance(taken), true);
        }
    }

    /// Whether `authority` is valid now.
    pub(crate) fn is_valid(&self, now: &Now, authority: &Authority) -> Result<(), String> {
        if self.config.bugs.authority_from_receipt() {
            return Ok(());
        }
        self.sent.check(authority, now.link).map_err(|stale| stale.to_string())
    }

    /// Whether `authority` lets the robot act now; a refusal is said as an event.
    pub(crate) fn may_act(&mut self, now: &Now, authority: &Authority, what: &str) -> Result<(), String> {
        let checked = self.is_valid(now, authority);
        if let Err(detail) = &checked {
            let told = self.stale_told.contains(&(0, authority.session_epoch, authority.hb)) && what == "resume";
            if !told {
                let event = RobotEvent::StaleAuthority { what: what.to_owned(), detail: detail.clone() };
                self.emit(Lane::Event, event);
                self.stale_told.insert((0, authority.session_epoch, authority.hb));
            }
        }
        checked
    }

    /// Obeys a person's word that the robot carries nothing, where its body knows its load by memory alone.
    fn obey_load_word(&mut self, now: &Now, word: Option<LoadWord>) {
        let Some(word) = word.filter(|_| self.inventory.load_by_memory) else { return };
        let Some(load) = self.body.load() else { return };
        let is_meant = self.session_epoch() == Some(word.session_epoch) && self.listed_load.was_in(&load, word.hb);
        if !is_meant {
            return;
        }
        tracing::warn!(robot_id = %self.config.robot_id, "a person says that it carries nothing; its load is forgotten");
        self.body.forget_load(now.site);
        self.take_news(now);
        self.beat_at_once(now);
    }

    fn on_assignment(&mut self, now: &Now, assignment: Option<Assignment>) {
        let Some(assignment) = assignment else {
            if let Some(work) = &mut self.work {
                work.ending.get_or_insert(Ending::Abort);
            }
            return;
        };
        match &mut self.work {
            Some(work) if work.holder.attempt == assignment.attempt => {
                if assignment.stop {
                    work.ending.get_or_insert(Ending::Abort);
                }
                let same_way = work
                    .order
                    .as_ref()
                    .is_some_and(|o| o.route_number == assignment.route_number && o.route == assignment.route);
                if !same_way {
                    work.located = false;
                }
                work.order = Some(Arc::new(assignment));
            }
            Some(work) => {
                if self.config.bugs.ignore_holder() {
                    self.body.stop(now.site, StopLevel::Halt);
                    self.work = None;
                } else {
                    work.ending.get_or_insert(Ending::Abort);
                }
                self.consider(now, assignment);
            }
            None => self.consider(now, assignment),
        }
    }

    /// An offer: takes it or says why not.
    fn consider(&mut self, now: &Now, assignment: Assignment) {
        let attempt = assignment.attempt.clone();
        let fenced = !self.config.bugs.no_epoch_fence();
        if fenced && (self.refused.contains(&attempt) || self.answer_from_ledger(&assignment)) {
            return;
        }
        if fenced && self.memory.ledger.highest_epoch(&attempt.subject) >= attempt.epoch {
            let passed = self.memory.ledger.highest_epoch(&attempt.subject);
            return self.refuse(now, &assignment, Reason::from(Code::StaleEpoch).with("passed", passed));
        }
        if assignment.stop {
            // The server takes back what was never taken: it must not be taken later.
            return self.write(Op::Epoch(attempt.subject, attempt.epoch, now.wall.0), true);
        }
        if self.is_observed() {
            return self.refuse(now, &assignment, Code::RobotObserved.into());
        }
        if let Err(detail) = self.may_act(now, &assignment.offer, "offer") {
            return self.refuse(now, &assignment, Reason::new(Code::StaleAuthority, detail));
        }
        if self.mode != Mode::Automatic {
            return self.refuse(now, &assignment, Code::NotAutomatic.into());
        }
        if self.is_stopped() {
            return self.refuse(now, &assignment, Reason::from(Code::RobotStopped).with("by", "fleet stop"));
        }
        if self.memory.ledger.maintenance.is_some() || self.changes_software() {
            return self.refuse(now, &assignment, Code::InMaintenance.into());
        }
        if let Some(reason) = self.software_refusal() {
            return self.refuse(now, &assignment, reason);
        }
        if let Some(fault) = &self.unfit {
            let why = Reason::from(Code::RobotFault).with("fault_code", fault.code);
            return self.refuse(now, &assignment, why);
        }
        if let Some(work) = &self.work {
            let holder = work.holder.attempt.to_string();
            return self.refuse(now, &assignment, Reason::from(Code::AnotherHolder).with("holder", holder));
        }
        if let Some(action) = self.unsupported(&assignment) {
            return self.refuse(now, &assignment, Reason::from(Code::UnsupportedAction).with("action", action));
        }
        if self.place_on_route(now, &assignment, assignment.from_step).is_none() {
            let at = self.last_waypoint(now).map_or_else(String::new, |w| w.to_string());
            return self.refuse(now, &assignment, Reason::from(Code::UnknownWaypoint).with("robot_at", at));
        }
        self.accept(now, assignment);
    }

    /// What ended here is answered from memory, once in a process. True: answered or already said.
    fn answer_from_ledger(&mut self, assignment: &Assignment) -> bool {
        let attempt = &assignment.attempt;
        let Some(report) = self.memory.ledger.ended(&attempt.subject).cloned() else { return false };
        let same = report.attempt == *attempt;
        if !same && report.state != WorkState::Succeeded {
            return false;
        }
        let listed = self.memory.ledger.unclosed.contains_key(attempt);
        if !(same && listed) && self.answered.insert(attempt.clone()) {
            self.emit(Lane::Event, RobotEvent::Attempt(AttemptReport::clone(&report)));
            if !same {
                let why = Reason::from(Code::AlreadyFinished).with("epoch", report.attempt.epoch);
                self.tell_refusal(assignment, why);
            }
        }
        true
    }

    fn unsupported(&self, assignment: &Assignment) -> Option<String> {
        let names = assignment.steps.iter().skip(assignment.from_step as usize).filter_map(|s| match &s.kind {
            StepKind::Action { name, .. } => Some(name),
            StepKind::Goto { .. } | StepKind::Wait { .. } => None,
        });
        let known =
            |name: &&String| [CHARGE, PARK].contains(&name.as_str()) || self.inventory.capabilities.contains(name);
        names.filter(|n| !known(n)).map(String::clone).next()
    }

    fn refuse(&mut self, now: &Now, assignment: &Assignment, why: Reason) {
        let attempt = assignment.attempt.clone();
        self.write(Op::Epoch(attempt.subject, attempt.epoch, now.wall.0), true);
        self.tell_refusal(assignment, why);
    }

    fn tell_refusal(&mut self, assignment: &Assignment, why: Reason) {
        let attempt = assignment.attempt.clone();
        tracing::info!(robot_id = %self.config.robot_id, %attempt, reason = why.name(), "refused");
        if self.refused.len() == REFUSED_REMEMBERED {
            self.refused.pop_front();
        }
        self.refused.push_back(attempt.clone());
        let report = AttemptReport {
            attempt,
            state: WorkState::Refused,
            step_index: assignment.from_step,
            opened: false,
            refusal: Some(why),
            fault: None,
            stats: WorkStats::default(),
        };
        self.emit(Lane::Event, RobotEvent::Attempt(report));
    }

    /// The holder and the epoch are durable before anybody hears of it and before the body moves.
    fn accept(&mut self, now: &Now, assignment: Assignment) {
        let body = self.body.state(now.site);
        let attempt = assignment.attempt.clone();
        let holder = Holder {
            attempt: attempt.clone(),
            step: assignment.from_step,
            opened: false,
            intent: None,
            unknown: false,
            elapsed_ms: 0,
            duration_ms: 0,
            base_odometer_mm: body.odometer_mm,
            base_loaded_mm: body.loaded_odometer_mm,
            base_energy_mwh: body.energy_mwh,
            hottest_joint_decidegrees: body.hottest_joint_decidegrees,
        };
        tracing::info!(robot_id = %self.config.robot_id, %attempt, "accepted");
        self.resume_needed = self.desired.as_ref().is_some_and(|d| d.held);
        self.work = Some(Work { order: Some(Arc::new(assignment)), ..Work::new(holder) });
        self.write(Op::Epoch(attempt.subject, attempt.epoch, now.wall.0), true);
        self.write_holder(true);
        self.wait_until_durable();
    }
}
