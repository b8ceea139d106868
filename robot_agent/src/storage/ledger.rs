//! The ledger of work: which epochs were passed, what is held, what was finished, and where the robot stands.
//!
//! Invariant: an epoch that was passed is never taken again, and a finished task keeps its answer. Pure values:
//! applying an [`Op`] is the only way to change a ledger. Called by the core, which decides, and by the stores, which
//! keep.

use super::device::DeviceKey;
use super::op::Op;
use super::proven::Proven;
pub use super::rows::{Applied, Holder, Intent, PlacesRow, SessionMemory, SubjectRow};
use super::software::SoftwareRow;
use midshift_bundle::trust::Trusted;
use midshift_core::desired_state::AreaRules;
use midshift_core::ids::{AttemptId, DrainId, Subject};
use midshift_core::limits;
use midshift_core::robot::ReportedAttempt;
use midshift_core::robot::WorkState;
use midshift_core::robot_events::AttemptReport;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Everything a robot must remember about its work.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ledger {
    /// Newest session.
    pub session: SessionMemory,
    /// Generations of sections that were applied.
    pub applied: Applied,
    /// Rules of the areas, so that a restart never drives without them.
    pub policy: Vec<AreaRules>,
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
