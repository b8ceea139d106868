//! Takes the steps of the table: writes the row, and asks for the job that follows.
//!
//! Invariant: what is decided is written down before it is done.

use super::conditions::Case;
use super::machine::{Condition, Step};
use crate::core::interface::ExitReason;
use crate::core::state::AgentCore;
use crate::sets::FileRef;
use crate::storage::{SoftwareRow, Update};
use crate::update::{Job, migration};
use midshift_bundle::set::{SetManifest, raised};
use midshift_core::reason::Reason;
use midshift_core::update::UpdateState;

impl AgentCore {
    /// Takes the step that follows a condition. Some: the process ends.
    pub(super) fn take_step(&mut self, case: Case<'_>, condition: Condition, step: Step) -> Option<ExitReason> {
        let Case { now, update, holdings } = case;
        let reason = self.reason_for(case, condition);
        match step {
            Step::Wait => {}
            Step::EndProcess => return Some(ExitReason::Switched),
            Step::Settle => return self.settle(now, holdings),
            Step::RefuseWayBack => {
                self.refuse_way_back();
                return self.settle(now, holdings);
            }
            // After a restart: what the repository lists is asked for again, and the directive is not.
            Step::RefreshAgain => self.refresh_again(now),
            Step::FetchManifest => {
                self.ask_for(Job::Manifest {
                    wanted: FileRef { digest: update.bundle, length: update.manifest_length },
                });
            }
            Step::FetchContent | Step::StageSet => update.set.iter().for_each(|set| self.gather(set)),
            Step::Refuse => self.move_to(UpdateState::Refused, reason),
            Step::TakeNewerOrder => {
                self.begin_update(now);
            }
            Step::ReportBlock => reason.into_iter().for_each(|reason| self.note_blocked(reason)),
            Step::LeaveGrant => self.leave_grant(case),
            Step::AskForGrant => self.ask_for_grant(now, update),
            Step::BeginSwitch => self.begin_switch(update),
            Step::TakeSwitchBack => {
                // The record was not written. Its grant counts as used, so that another is asked for at once.
                self.update.asked = None;
                self.move_to(UpdateState::Staged, reason);
            }
            Step::WriteTrial => {
                let mut switch = holdings.switch.clone();
                update.set_name().iter().for_each(|name| switch.try_out(name));
                self.write_switch(switch);
            }
            Step::GoBack => reason.into_iter().for_each(|reason| self.go_back(update.clone(), reason)),
            Step::AwaitProbation => {
                self.wake_when_lost();
                self.wake_site = self.probation_ends_at(update);
            }
            Step::AwaitServer => self.wake_when_lost(),
            Step::BeginTrial => {
                self.wake_when_lost();
                self.move_to(UpdateState::Trial, None);
                self.prove(case);
            }
            Step::Prove => self.prove(case),
            Step::BeginCommit => {
                let mut switch = holdings.switch.clone();
                switch.commit();
                self.intend(&switch);
                self.put_update(Update { state: UpdateState::Committing, ..update.clone() });
            }
            Step::WriteCommit => {
                let mut switch = holdings.switch.clone();
                switch.commit();
                self.write_switch(switch);
            }
            Step::NotePutAway | Step::EndRollBack => self.move_to(UpdateState::RolledBack, reason),
            Step::Commit => self.commit(case),
            Step::GetStuck => self.move_to(UpdateState::Stuck, reason),
            Step::VerifyKeptSet => case.kept_set().into_iter().for_each(|kept| self.ask_for(Job::Verify(kept))),
        }
        None
    }

    /// Has the next content of a set fetched, or the set made of it.
    fn gather(&mut self, set: &SetManifest) {
        let fetched = &self.update.fetched;
        let there: u64 = set.components.values().filter(|c| fetched.contains(&c.digest)).map(|c| c.length).sum();
        let missing = set.components.values().find(|c| !fetched.contains(&c.digest));
        let job = match missing {
            Some(c) => {
                let rate_bytes_s = self.update.desired.as_ref().map_or(0, |d| d.rate_bytes_s);
                let bases = self.update.holdings.as_ref().map(|holdings| holdings.bases(c)).unwrap_or_default();
                Job::Fetch { wanted: FileRef { digest: c.digest, length: c.length }, bases, rate_bytes_s }
            }
            None => Job::Stage(Box::new(set.clone())),
        };
        self.update.progress = (there, set.components.values().map(|c| c.length).sum());
        self.ask_for(job);
    }

    /// Another grant is needed, and this one is not looked at again.
    fn leave_grant(&mut self, case: Case<'_>) {
        let Some(grant) = self.unused_grant().cloned() else { return };
        if self.may_act(case.now, &grant.authority, "activation").is_err() {
            self.update.stale_grant = grant.grant_id;
            self.update.asked = None;
            self.ask_for_grant(case.now, case.update);
        }
    }

    fn begin_switch(&mut self, update: &Update) {
        let Some(grant) = self.unused_grant().cloned() else { return };
        self.update.granted_until = self.sent.ends(&grant.authority);
        let row = SoftwareRow { grant_id: grant.grant_id, ..self.memory.ledger.software.clone() };
        self.put_software(row);
        let (state, drain_id) = (UpdateState::Switching, Some(grant.drain_id));
        self.put_update(Update { state, drain_id, reason: None, ..update.clone() });
    }

    fn wake_when_lost(&mut self) {
        self.lost_server_at().into_iter().for_each(|lost_at| self.wake_at(lost_at));
    }

    fn prove(&mut self, case: Case<'_>) {
        if case.holdings.switch.trial.as_ref().is_some_and(|t| !t.is_proven) {
            let mut switch = case.holdings.switch.clone();
            switch.prove();
            self.write_switch(switch);
        }
    }

    /// Floors rise and migrations become due only once the switch record names the set as committed.
    fn commit(&mut self, case: Case<'_>) {
        let Case { now, update, holdings } = case;
        let kept = holdings.switch.kept().and_then(|kept| holdings.set(kept)).unwrap_or_default();
        let mut row = SoftwareRow { committed_at: Some(now.utc), ..self.memory.ledger.software.clone() };
        if let Some(set) = update.set.as_ref().filter(|_| update.raises_floor) {
            row.floors = raised(&row.floors, set, &kept);
        }
        if let Some(set) = &update.set {
            row.due = migration::due(set, &kept, &row.due);
        }
        let reason = row.due.first().map(Self::is_due);
        self.put_software(row);
        self.put_update(Update { state: UpdateState::Committed, reason, ..update.clone() });
    }

    pub(super) fn go_back(&mut self, update: Update, reason: Reason) {
        if update.state == UpdateState::Committed && !self.memory.ledger.software.due.is_empty() {
            self.put_software(SoftwareRow { due: Vec::new(), ..self.memory.ledger.software.clone() });
        }
        let drain_id = self.update.desired.as_ref().and_then(|d| d.drain_id.clone()).or(update.drain_id.clone());
        self.put_update(Update { state: UpdateState::RollingBack, drain_id, reason: Some(reason), ..update });
    }
}
