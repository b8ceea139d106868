//! The ledger of work: which epochs were passed, what is held, what was finished, and where the robot stands.
//!
//! Invariant: an epoch that was passed is never taken again, and a finished task keeps its answer. Pure values: applying an
//! [`Op`] is the only way to change a ledger. Called by the core, which decides, and by the stores, which keep.

use crate::device::DeviceKey;
use crate::store::Op;
use crate::update::SoftwareRow;
use crate::update::proven::Proven;
use midshift_bundle::trust::Trusted;
use midshift_core::identity::SessionSecret;
use midshift_core::ids::{AttemptId, DrainId, PlaceId, Subject};
use midshift_core::limits;
use midshift_core::policy::AreaPolicy;
use midshift_core::robot::ReportedAttempt;
use midshift_core::work::{AttemptReport, StepKind, WorkState};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The newest session, which proves the next one's succession.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SessionMemory {
    /// Its epoch.
    pub session_epoch: u64,
    /// Its secret.
    pub secret: SessionSecret,
    /// The store it was with.
    pub store_id: String,
}

/// Highest generations applied.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Applied {
    /// Section work.
    pub work: u64,
    /// Section policy.
    pub policy: u64,
    /// Section update.
    #[serde(default)]
    pub update: u64,
}

/// A step that must not be done twice, from before it began until its end was written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intent {
    /// Which step.
    pub step: u32,
    /// What it is.
    pub kind: StepKind,
}

/// The holder: the one attempt that this robot executes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Holder {
    /// The attempt that is executed.
    pub attempt: AttemptId,
    /// Steps done = index of the step at hand.
    pub step: u32,
    /// The first irreversible step is done or unknown.
    pub opened: bool,
    /// A step under way that must not be done twice.
    pub intent: Option<Intent>,
    /// Nobody knows whether that step was done.
    pub unknown: bool,
    /// Milliseconds of site time spent so far, without holds.
    pub elapsed_ms: u64,
    /// Milliseconds of site time since acceptance, with holds.
    pub duration_ms: u64,
    /// Millimetres the body had driven at acceptance.
    pub base_odometer_mm: u64,
    /// Of these, with a load.
    pub base_loaded_mm: u64,
    /// Milliwatt-hours the body had spent at acceptance.
    pub base_energy_mwh: u64,
    /// Tenths of a degree, highest seen.
    pub hottest_joint_decidegrees: i32,
}

/// Places the robot is in, may be in after a crash, and grants that are used up.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlacesRow {
    /// Its contour reaches in, with the grant it entered on (0: none).
    pub inside: BTreeMap<PlaceId, u64>,
    /// It was told to drive into these: after a crash they count as entered.
    pub committed: BTreeMap<PlaceId, u64>,
    /// Grants used up or given back that may still stand in the last desired state.
    pub used: BTreeSet<u64>,
}

/// What is remembered of one subject.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SubjectRow {
    /// Highest epoch seen.
    pub epoch: u64,
    /// Robot's wall clock at the last change, unix milliseconds.
    pub at_unix_ms: i64,
    /// How its last attempt here ended.
    pub report: Option<Arc<AttemptReport>>,
}

/// Everything a robot must remember about its work.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ledger {
    /// Newest session.
    pub session: SessionMemory,
    /// Generations of sections that were applied.
    pub applied: Applied,
    /// Rules of the areas, so that a restart never drives without them.
    pub policy: Vec<AreaPolicy>,
    /// The holder.
    pub holder: Option<Holder>,
    /// Places and grants.
    pub places: PlacesRow,
    /// The drain that holds the robot: never beside `holder`.
    pub maintenance: Option<DrainId>,
    /// What it remembers of its software.
    pub software: SoftwareRow,
    /// What is believed of the repository.
    pub trusted: Option<Arc<Trusted>>,
    /// What may run, and why; none: no agent that keeps documents has changed its software.
    pub proven: Option<Arc<Proven>>,
    /// The key of this machine; none before its first start.
    pub device: Option<DeviceKey>,
    /// Ended attempts that the server has not yet said it stored.
    pub unclosed: BTreeMap<AttemptId, ReportedAttempt>,
    subjects: BTreeMap<Subject, SubjectRow>,
    by_age: BTreeSet<(i64, Subject)>,
}

impl Ledger {
    /// Highest epoch of a subject. 0: never seen.
    pub fn highest_epoch(&self, subject: &Subject) -> u64 {
        self.subjects.get(subject).map_or(0, |row| row.epoch)
    }

    /// How the last attempt of a subject ended here.
    pub fn ended(&self, subject: &Subject) -> Option<&Arc<AttemptReport>> {
        self.subjects.get(subject)?.report.as_ref()
    }

    /// The report of a subject that succeeded: it is never done again.
    pub fn finished(&self, subject: &Subject) -> Option<&Arc<AttemptReport>> {
        self.ended(subject).filter(|r| r.state == WorkState::Succeeded)
    }

    /// Subjects remembered.
    pub fn subjects(&self) -> &BTreeMap<Subject, SubjectRow> {
        &self.subjects
    }

    /// A few subjects that may be forgotten: older than the limit, beyond the number that is always kept, not held.
    pub fn forgettable(&self, wall_unix_ms: i64) -> Vec<Op> {
        let spare = self.subjects.len().saturating_sub(limits::LEDGER_IDS_MIN);
        let oldest_ms = wall_unix_ms - (limits::REMEMBER_DAYS * 86_400_000) as i64;
        let held = self.holder.as_ref().map(|h| &h.attempt.subject);
        let old =
            self.by_age.iter().take(spare.min(8)).filter(|(at, subject)| *at < oldest_ms && Some(subject) != held);
        old.map(|(_, subject)| Op::Forget(subject.clone())).collect()
    }

    /// Puts one subject, for a store that reads it back.
    pub fn put_subject(&mut self, subject: Subject, row: SubjectRow) {
        if let Some(old) = self.subjects.get(&subject) {
            self.by_age.remove(&(old.at_unix_ms, subject.clone()));
        }
        self.by_age.insert((row.at_unix_ms, subject.clone()));
        self.subjects.insert(subject, row);
    }

    /// Applies one operation; others than those of the ledger change nothing.
    pub fn apply(&mut self, op: &Op) {
        match op {
            Op::Session(memory) => self.session = memory.clone(),
            Op::Applied(applied) => self.applied = *applied,
            Op::Policy(areas) => self.policy.clone_from(areas),
            Op::Holder(holder) => self.holder = holder.as_deref().cloned(),
            Op::Places(places) => self.places = places.clone(),
            Op::Maintenance(drain_id) => self.maintenance.clone_from(drain_id),
            Op::Software(row) => self.software = SoftwareRow::clone(row),
            Op::Trusted(trusted) => self.trusted = Some(trusted.clone()),
            Op::Proven(proven) => self.proven = Some(proven.clone()),
            Op::Device(key) => self.device = Some(key.clone()),
            Op::Epoch(subject, epoch, at_unix_ms) => {
                let old = self.subjects.get(subject);
                let epoch = (*epoch).max(old.map_or(0, |row| row.epoch));
                let row = SubjectRow { epoch, at_unix_ms: *at_unix_ms, report: old.and_then(|row| row.report.clone()) };
                self.put_subject(subject.clone(), row);
            }
            Op::Finish(report, listed, at_unix_ms) => {
                let subject = report.attempt.subject.clone();
                let epoch = self.highest_epoch(&subject).max(report.attempt.epoch);
                self.put_subject(subject, SubjectRow { epoch, at_unix_ms: *at_unix_ms, report: Some(report.clone()) });
                self.unclosed.insert(report.attempt.clone(), listed.clone());
            }
            Op::Closed(attempt) => {
                self.unclosed.remove(attempt);
            }
            Op::Forget(subject) => {
                if let Some(row) = self.subjects.remove(subject) {
                    self.by_age.remove(&(row.at_unix_ms, subject.clone()));
                }
            }
            _ => {}
        }
    }
}
