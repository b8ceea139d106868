//! Takes what came of a job: bytes, sets and records that are there now, or what to try again.
//!
//! Invariant: a result changes the row or what is known of the disk, and begins nothing but a look at the disk.

use crate::core::state::AgentCore;
use crate::launcher::switch::Switch;
use crate::sets::{FileRef, Holdings};
use crate::storage::Update;
use crate::update::{Done, Failure, Job, io, migration, retry};
use midshift_bundle::manifest::{Manifest, Migration};
use midshift_bundle::set::{Fit, SetManifest};
use midshift_core::ids::SetId;
use midshift_core::limits;
use midshift_core::reason::{Code, Reason};
use midshift_core::time::Now;
use midshift_core::update::UpdateState;

impl AgentCore {
    /// Takes what came of the job under way.
    pub(crate) fn job_done(&mut self, now: &Now, done: Done) {
        let Some(job) = self.update.running.take() else { return };
        let done = self.believe_what_came(done);
        if std::mem::take(&mut self.update.drops) && matches!(job, Job::Fetch { .. }) && !matches!(done, Done::Ok) {
            return;
        }
        if !matches!(done, Done::Failed(_)) {
            self.update.pause = None;
        }
        match (job, done) {
            (_, Done::Holdings(holdings)) => self.take_holdings(*holdings),
            (Job::Refresh { .. }, Done::Refreshed { refreshed, key_sets }) => {
                self.refreshed(now, *refreshed, &key_sets)
            }
            (Job::Manifest { wanted }, Done::Manifest { manifest, bytes }) => {
                self.plan(now, &wanted, &manifest, &bytes)
            }
            (Job::Fetch { wanted, .. }, Done::Ok) => {
                self.update.fetched.insert(wanted.digest);
            }
            (Job::Stage(set), Done::Ok) => {
                let has_base = set.base().is_some();
                self.hold(|holdings| {
                    holdings.sets.insert(set.id(), *set);
                });
                if has_base {
                    // It may have cost the set before its place in the switch record.
                    self.update.holdings = None;
                }
                self.move_to(UpdateState::Staged, None);
            }
            (Job::Write(_), Done::Written(switch)) => {
                self.hold(|holdings| holdings.switch = switch);
                if let Some(holdings) = self.update.holdings.clone() {
                    self.note_committed(&holdings);
                }
            }
            (Job::Check { file, .. }, Done::Ok) => self.checked(&file),
            (Job::Mend(_), Done::Ok) => self.mended(),
            (Job::Verify(set), Done::Ok) => self.verified(&set),
            (Job::Migrate { due, .. }, Done::Ok) => self.migrated(&due),
            (Job::Collect(_), Done::Ok) => {
                self.update.collected = true;
                // What is told of sets and room is true again.
                self.ask_for(Job::Look);
            }
            (job, Done::Failed(Failure::Later(why))) => self.put_off(now, &job, &why),
            (job, Done::Failed(Failure::Refused(reason))) => self.job_refused(now, job, reason),
            (job, _) => tracing::error!(job = job.as_str(), "a job ended as another"),
        }
    }

    fn put_off(&mut self, now: &Now, job: &Job, why: &str) {
        let failures = self.update.pause.map_or(0, |(_, failures)| failures) + 1;
        let pause = retry::pause(&self.config.robot_id, failures);
        tracing::info!(robot_id = %self.config.robot_id, job = job.as_str(), why, pause_ms = pause.as_ms(), "update is put off");
        self.update.pause = Some((now.link + pause, failures));
        if let Job::Migrate { due, .. } = job {
            self.not_migrated(due, why);
        }
        if matches!(job, Job::Mend(_)) {
            self.not_mended();
        }
        if matches!(job, Job::Stage(_)) {
            // Content that was there has changed on the disk: look for all of it again.
            self.update.fetched.clear();
        }
    }

    fn job_refused(&mut self, now: &Now, job: Job, reason: Reason) {
        match job {
            Job::Verify(_) => self.move_to(UpdateState::Stuck, Some(reason)),
            Job::Check { .. } => self.condemn(reason),
            Job::Mend(_) => self.give_up_mending(),
            Job::Refresh { .. } => self.refuse_directive(reason),
            Job::Manifest { .. } | Job::Fetch { .. } | Job::Stage(_) => {
                self.move_to(UpdateState::Refused, Some(reason))
            }
            Job::Look | Job::Write(_) | Job::Migrate { .. } | Job::Collect(_) => self.put_off(now, &job, reason.text()),
        }
    }

    /// What comes of the bundle on this robot, or why it does not fit.
    fn plan(&mut self, now: &Now, wanted: &FileRef, manifest: &Manifest, bytes: &[u8]) {
        let Some(update) = self.memory.ledger.software.update.clone() else { return };
        let Some(holdings) = self.update.holdings.clone() else { return };
        let current = holdings.set(&holdings.switch.current).unwrap_or_default();
        let config = self.update.config.as_ref();
        let fit = Fit {
            model: self.inventory.model.clone(),
            floors: self.memory.ledger.software.floors.clone(),
            floor: update.rollback_floor,
            allows_safety_related: config.is_some_and(|c| c.allows_safety_related),
            bugs: midshift_bundle::bugs::Bugs::default(),
        };
        let set = match current.with(wanted.digest, manifest, &fit) {
            Ok(set) => set,
            Err(unfit) => {
                let text = unfit.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ");
                let codes = unfit.iter().map(|u| u.code()).collect::<Vec<_>>().join(",");
                let reason = Reason::new(Code::BundleUnfit, text).with("codes", codes);
                return self.move_to(UpdateState::Refused, Some(reason));
            }
        };
        if set.id() == current.id() {
            return self.move_to(UpdateState::Refused, Some(Reason::from(Code::SkippedCurrent)));
        }
        if let Some(component) = manifest.components.iter().find(|c| !self.lists(&c.digest, c.length)) {
            let reason = Reason::from(Code::BundleUnfit).with("unlisted", &component.name);
            return self.move_to(UpdateState::Refused, Some(reason));
        }
        if !migration::is_possible(&set) {
            let reason =
                Reason::new(Code::BundleUnfit, "a component migrates data, and no program of the set can do it");
            return self.move_to(UpdateState::Refused, Some(reason));
        }
        if let Err(reason) = self.may_take_base(now, &current, &set) {
            return self.move_to(UpdateState::Refused, Some(reason));
        }
        let base = set.base().filter(|_| set.changes_base(&current)).map_or(0, |base| base.length);
        // A file that comes encoded is there until its component is made of it.
        let encoded = manifest.components.iter().map(|c| c.length).filter(|length| io::may_come_encoded(*length)).max();
        let needed = manifest.components.iter().map(|c| c.length).sum::<u64>() + encoded.unwrap_or(0) + base;
        if needed > holdings.free_bytes {
            let reason =
                Reason::from(Code::NoRoom).with("needed_bytes", needed).with("free_bytes", holdings.free_bytes);
            return self.move_to(UpdateState::Refused, Some(reason));
        }
        if let Err(reason) = self.keep_release(bytes, &set) {
            return self.move_to(UpdateState::Refused, Some(reason));
        }
        let is_irreversible = manifest.components.iter().any(|c| c.data_migration == Migration::Irreversible);
        let (raises_floor, state) = (manifest.raises_floor, UpdateState::Downloading);
        self.put_update(Update { state, set: Some(set), raises_floor, is_irreversible, ..update });
    }

    /// A new base takes the slot of the set before, so the one that runs must have proved itself.
    fn may_take_base(&self, now: &Now, current: &SetManifest, set: &SetManifest) -> Result<(), Reason> {
        let committed = self.memory.ledger.software.committed_at.filter(|_| set.changes_base(current));
        let Some(committed) = committed else { return Ok(()) };
        // A clock that went back says nothing of the time since.
        let kept_ms = if now.utc >= committed { now.utc.ms_since(committed) } else { 0 };
        if kept_ms >= limits::BASE_SETTLED_MS {
            return Ok(());
        }
        Err(Reason::from(Code::BaseTooSoon).with("wait_ms", limits::BASE_SETTLED_MS - kept_ms))
    }

    /// What the disk says after a start, held against the ledger. The switch record wins.
    fn take_holdings(&mut self, holdings: Holdings) {
        let switch = holdings.switch.clone();
        self.note_committed(&holdings);
        self.update.holdings = Some(holdings);
        let Some(update) = self.memory.ledger.software.update.clone() else { return };
        let Some(name) = update.set_name() else { return };
        let runs = switch.trial.as_ref().is_some_and(|t| t.set == name);
        let fallen = switch.fallen.as_ref().filter(|f| f.set == name);
        let active = matches!(
            update.state,
            UpdateState::Switching | UpdateState::Probation | UpdateState::Trial | UpdateState::Committing
        );
        if let Some(fallen) = fallen.filter(|_| active) {
            let reason = Reason::from(Code::ProgramCrashed).with("tries", fallen.tries);
            let (state, tries) = (UpdateState::RolledBack, fallen.tries);
            // What a commit was about to say is not said any more.
            self.intend(&switch);
            return self.put_update(Update { state, tries, reason: Some(reason), ..update });
        }
        match update.state {
            UpdateState::Switching if runs => self.move_to(UpdateState::Probation, None),
            // The power went before the record was written: the grant was not used.
            UpdateState::Switching => self.move_to(UpdateState::Staged, None),
            UpdateState::Probation | UpdateState::Trial if !runs => {
                self.move_to(UpdateState::RolledBack, Some(Reason::from(Code::SetPutAway)));
            }
            _ => {}
        }
    }

    /// The kept set was read again and is whole: it runs from the next start on.
    fn verified(&mut self, set: &SetId) {
        let Some(holdings) = &self.update.holdings else { return };
        let mut switch: Switch = holdings.switch.clone();
        if switch.trial.is_some() {
            switch.go_back();
        } else {
            switch.undo_commit();
        }
        if switch.running() == set.as_str() {
            self.update.went_back = true;
            self.write_switch(switch);
        }
    }
}
