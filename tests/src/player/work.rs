//! What it does of its work: it takes offers, says that it drives and acts step by step, and ends, as far as its habits let it.
//!
//! It has no body: it says of itself what a robot would say that does the work, and is nowhere else than where it says that it is.

use super::Player;
use super::habit::Habit;
use super::job::Job;
use midshift_core::desired_state::{Assignment, DesiredWork};
use midshift_core::ids::{AttemptId, PlaceId};
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{FAULT_SEMANTIC, Fault, FaultClass, Load, ReportedAttempt, WorkState};
use midshift_core::robot_events::{AttemptReport, PlaceNews, RobotEvent, WorkStats};
use midshift_core::step::{Effect, StepKind, WorkStep};
use rand::RngExt;
use rand::seq::IndexedRandom;

impl Player {
    /// Hears what it should do.
    pub(super) fn asked(&mut self, work: DesiredWork, now_ms: u64) {
        if self.work.as_ref().is_some_and(|old| old.generation > work.generation) {
            return;
        }
        self.state.attempts.retain(|listed| !work.closed.contains(&listed.attempt));
        let listed: Vec<PlaceId> = work.grants.iter().map(|grant| grant.place_id.clone()).collect();
        let gone: Vec<_> =
            self.state.places.extract_if(.., |held| !held.inside && !listed.contains(&held.place_id)).collect();
        for held in gone {
            self.place(&held.place_id, held.grant_id, PlaceNews::NotEntered);
        }
        for grant in &work.grants {
            if !self.state.places.iter().any(|held| held.place_id == grant.place_id && held.grant_id == grant.grant_id)
            {
                self.holds(&grant.place_id, grant.grant_id, false);
            }
        }
        self.applied = self.applied.max(work.generation);
        self.wanted(work.assignment.clone(), now_ms);
        self.work = Some(work);
    }
    fn wanted(&mut self, wanted: Option<Assignment>, now_ms: u64) {
        let at_hand = self.job.as_ref().map(|job| job.assignment.attempt.clone());
        match (wanted, at_hand) {
            (Some(wanted), Some(at_hand)) if wanted.attempt == at_hand => {
                let ends = if wanted.stop { Some(WorkState::Aborted) } else { None };
                let ends = if wanted.suspend { Some(WorkState::Suspended) } else { ends };
                if let Some(job) = &mut self.job {
                    job.assignment = wanted;
                }
                if let Some(state) = ends.filter(|_| !self.habits.contains(&Habit::NeverEnds)) {
                    self.end(state);
                }
            }
            (_, Some(_)) => {
                if !self.shows(Habit::NeverEnds, 1.0) {
                    self.end(WorkState::Aborted);
                }
            }
            (Some(wanted), None) => {
                if !self.state.attempts.iter().any(|listed| listed.attempt == wanted.attempt) && !wanted.stop {
                    self.offered(now_ms);
                }
            }
            (None, None) => self.answer_at = None,
        }
    }
    fn offered(&mut self, now_ms: u64) {
        if self.answer_at.is_some() || self.shows(Habit::NeverAnswers, 1.0) {
            return;
        }
        let late_ms = if self.shows(Habit::AnswersLate, 1.0) { self.rng.random_range(3_000..25_000) } else { 0 };
        self.answer_at = Some(now_ms + 100 + late_ms);
    }
    /// Does what is due of its work.
    pub(super) fn go_on(&mut self, now_ms: u64) {
        if self.answer_at.is_some_and(|at| at <= now_ms) {
            self.answer_at = None;
            self.answer(now_ms);
        }
        let Some(job) = self.job.as_mut().filter(|job| job.due <= now_ms) else { return };
        let Some(step) = job.assignment.steps.get(job.step as usize).cloned() else { return };
        let released = match &step.kind {
            StepKind::Goto { .. } => is_released(&job.assignment, job.step),
            StepKind::Action { .. } | StepKind::Wait { .. } => true,
        };
        job.due = now_ms + self.rng.random_range(1_000..3_000);
        if self.shows(Habit::NeverMovesOn, 1.0) || !released {
            return;
        }
        self.did(&step);
    }
    fn answer(&mut self, now_ms: u64) {
        let wanted = self.work.as_ref().and_then(|work| work.assignment.clone());
        let Some(assignment) = wanted.filter(|_| self.job.is_none() && self.in_charge) else { return };
        if self.shows(Habit::Refuses, 0.8) {
            let code = Code::ALL.choose(&mut self.rng).copied().unwrap_or(Code::StaleEpoch);
            let refusal = Some(Reason::from(code));
            let report = report_of(&assignment.attempt, WorkState::Refused, assignment.from_step, false);
            self.event(RobotEvent::Attempt(AttemptReport { refusal, ..report }));
            return;
        }
        let (attempt, step) = (assignment.attempt.clone(), assignment.from_step);
        self.state.attempts.retain(|listed| listed.attempt != attempt);
        self.state.attempts.push(ReportedAttempt {
            attempt: attempt.clone(),
            state: WorkState::Accepted,
            step_index: step,
            progress: 1,
            route_index: 0,
            opened: false,
        });
        self.job = Some(Job { assignment, step, due: now_ms + 500 });
        self.report_work(WorkState::Accepted);
        if self.shows(Habit::FallsSilent, 0.7) {
            self.quiet_until = now_ms + self.rng.random_range(2_000..45_000);
        }
        if self.shows(Habit::LetsGo, 0.8) {
            let states = [WorkState::Aborted, WorkState::Suspended, WorkState::Refused];
            let state = states.choose(&mut self.rng).copied().unwrap_or(WorkState::Aborted);
            self.end(state);
        } else if self.shows(Habit::CallsImpossible, 0.8) {
            self.end(WorkState::Failed);
        } else if self.shows(Habit::NeverGoes, 0.8) {
            let steps = self.job.as_ref().map_or(0, |job| job.assignment.steps.len() as u32);
            if let Some(listed) = self.listed() {
                listed.step_index = steps;
            }
            self.end(WorkState::Succeeded);
        }
    }
    /// A step is done.
    fn did(&mut self, step: &WorkStep) {
        let Some(job) = &mut self.job else { return };
        let (at, end) = (job.step, job.assignment.steps.len() as u32);
        job.step = if at == job.assignment.from_step { (at + 1).max(job.assignment.resume_step) } else { at + 1 };
        let (next, subject) = (job.step, job.assignment.attempt.subject.clone());
        match &step.kind {
            StepKind::Goto { waypoint } => {
                self.state.vitals.waypoint = Some(waypoint.clone());
                self.state.vitals.odometer_mm += 5_000;
                self.arrived();
            }
            StepKind::Action { name, .. } if step.effect == Effect::AtMostOnce => {
                let load = Load { task_id: subject.task_id().cloned(), item: "thing".to_owned() };
                self.state.load = (name == "pick").then_some(load);
                self.event(RobotEvent::Load(self.state.load.clone()));
            }
            StepKind::Action { .. } | StepKind::Wait { .. } => {}
        }
        let opens = step.effect == Effect::AtMostOnce;
        if let Some(listed) = self.listed() {
            (listed.step_index, listed.progress, listed.opened) = (next, listed.progress + 1, listed.opened || opens);
        }
        if next >= end { self.end(WorkState::Succeeded) } else { self.report_work(WorkState::Executing) }
    }
    /// It is in the places of its way one after the other, and stays in the last.
    fn arrived(&mut self) {
        let (mut inside, granted): (Vec<_>, Vec<_>) = self.state.places.drain(..).partition(|held| held.inside);
        let stays = granted.last().map(|held| held.place_id.clone());
        for held in &granted {
            self.place(&held.place_id, held.grant_id, PlaceNews::Entered);
        }
        inside.extend(granted);
        for held in inside {
            if stays.as_ref().is_none_or(|last| *last == held.place_id) {
                self.holds(&held.place_id, held.grant_id, true);
            } else {
                self.place(&held.place_id, held.grant_id, PlaceNews::Left);
            }
        }
    }
    fn end(&mut self, state: WorkState) {
        let Some(listed) = self.listed() else { return self.job = None };
        listed.state = state;
        let report = report_of(&listed.attempt, state, listed.step_index, listed.opened);
        let refusal = (state == WorkState::Refused).then(|| Code::AnotherHolder.into());
        let fault = (state == WorkState::Failed).then(|| Fault {
            code: FAULT_SEMANTIC,
            class: FaultClass::Semantic,
            message: "not as asked".to_owned(),
        });
        self.job = None;
        self.event(RobotEvent::Attempt(AttemptReport { refusal, fault, ..report }));
        self.beat_at = 0;
    }
    /// What it lists of the attempt at hand.
    pub(super) fn listed(&mut self) -> Option<&mut ReportedAttempt> {
        let attempt = self.job.as_ref().map(|job| job.assignment.attempt.clone())?;
        self.state.attempts.iter_mut().find(|listed| listed.attempt == attempt)
    }
    fn report_work(&mut self, state: WorkState) {
        let Some(listed) = self.listed() else { return };
        listed.state = state;
        let report = report_of(&listed.attempt, state, listed.step_index, listed.opened);
        self.event(RobotEvent::Attempt(report));
    }
    pub(super) fn place(&mut self, place_id: &PlaceId, grant_id: u64, news: PlaceNews) {
        self.event(RobotEvent::Place { place_id: place_id.clone(), grant_id, news });
    }
}

/// Whether it may drive to the end of this step.
fn is_released(assignment: &Assignment, step: u32) -> bool {
    let end = assignment.route.iter().position(|point| point.ends_step == Some(step));
    end.is_none_or(|end| assignment.released_index.is_some_and(|released| released as usize >= end))
}

/// News of an attempt.
pub(super) fn report_of(attempt: &AttemptId, state: WorkState, step_index: u32, opened: bool) -> AttemptReport {
    let stats = WorkStats { path_mm: 1_000, duration_ms: 1_000, ..WorkStats::default() };
    AttemptReport { attempt: attempt.clone(), state, step_index, opened, refusal: None, fault: None, stats }
}
