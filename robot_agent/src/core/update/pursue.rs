//! Pursues the update: when the next step is decided, when its job is handed out, and what is done without an update.
//!
//! Invariant: a job is handed out only once what explains it is durable, and at most one is under way. The switch
//! record wins over the ledger, unless it has on trial what the ledger has committed.

use super::conditions::Case;
use super::integrity::Next;
use super::machine;
use crate::core::interface::{ExitReason, Output};
use crate::core::state::AgentCore;
use crate::sets::Holdings;
use crate::storage::Op;
use crate::update::Job;
use midshift_bundle::digest::Digest;
use midshift_bundle::set::SetManifest;
use midshift_core::time::{LinkDuration, Now};
use midshift_core::update::{DesiredUpdate, Goal, UpdateState};
use std::collections::BTreeSet;

/// Without an update under way the disk is looked at so often: the room on it is told to the server.
const LOOK_EVERY: LinkDuration = LinkDuration(60_000);

impl AgentCore {
    /// Takes section `update` in.
    pub(crate) fn on_update(&mut self, desired: DesiredUpdate) {
        let mut applied = self.memory.ledger.applied;
        if desired.generation < applied.update {
            tracing::warn!(generation = desired.generation, applied = applied.update, "older update refused");
            return;
        }
        if desired.generation > applied.update {
            applied.update = desired.generation;
            self.write(Op::Applied(applied), false);
        }
        self.update.desired = Some(desired);
    }

    /// Hands the next job out once what explains it is durable.
    pub(crate) fn start_job(&mut self, out: &mut Vec<Output>) {
        if self.update.drops && !self.update.dropping {
            out.push(Output::DropJob);
        }
        self.update.dropping = self.update.drops;
        if self.update.running.is_none()
            && let Some((job, barrier)) = self.update.next.take()
        {
            if self.durable_up_to(barrier) {
                self.update.running = Some(job.clone());
                out.push(Output::Job(Box::new(job)));
            } else {
                self.update.next = Some((job, barrier));
            }
        }
    }

    /// Decides what is next, if nothing is under way.
    pub(crate) fn pursue_update(&mut self, now: &Now) -> Option<ExitReason> {
        self.take_switch_back(now);
        self.note_floor(now);
        if self.update.config.is_none() || self.update.next.is_some() {
            return None;
        }
        if let Some(running) = &self.update.running {
            self.update.drops |= self.is_stale(running);
            return None;
        }
        if let Some((until, _)) = self.update.pause.filter(|(until, _)| now.link < *until) {
            self.wake_at(until);
            return None;
        }
        self.update.begun.get_or_insert((now.link, now.site));
        let Some(holdings) = self.update.holdings.clone() else {
            self.ask_for(Job::Look);
            return None;
        };
        match self.hold_running(now, &holdings) {
            Next::GoesOn => {}
            Next::Waits => return None,
            Next::Ends(reason) => return Some(reason),
        }
        let ends = self.pursue(now, &holdings);
        if ends.is_none() && self.update.next.is_none() {
            self.check_files(now, &holdings);
        }
        ends
    }

    /// The next step of the update, or of the robot without one.
    fn pursue(&mut self, now: &Now, holdings: &Holdings) -> Option<ExitReason> {
        let Some(update) = self.memory.ledger.software.update.clone() else { return self.settle(now, holdings) };
        let case = Case { now, update: &update, holdings };
        let (condition, step) = machine::decide(update.state, |condition| self.holds(case, condition));
        self.take_step(case, condition, step)
    }

    /// A download that is wanted no more, or at another rate.
    fn is_stale(&self, running: &Job) -> bool {
        let Job::Fetch { rate_bytes_s, .. } = running else { return false };
        let desired = self.update.desired.as_ref();
        desired.is_some_and(|d| d.rate_bytes_s != *rate_bytes_s || (d.goal == Goal::Revert && self.names(d)))
    }

    /// No update, or one that is over: looks for a new directive, then tidies up.
    pub(super) fn settle(&mut self, now: &Now, holdings: &Holdings) -> Option<ExitReason> {
        let update = self.memory.ledger.software.update.as_ref();
        let is_stuck = update.is_some_and(|u| u.state == UpdateState::Stuck);
        if !is_stuck && self.end_unknown_trial(&holdings.switch) {
            return None;
        }
        if self.update.went_back {
            return Some(ExitReason::Switched);
        }
        // A newer bundle comes before a migration that fails.
        if self.begin_way_back(now, holdings) || self.begin_update(now) || (!is_stuck && self.migrate(holdings)) {
            return None;
        }
        // Nothing is deleted while record and ledger do not agree on what was committed.
        if !self.update.collected && self.runs_what_was_signed() {
            self.ask_for(Job::Collect(self.needed()));
        } else if now.link.since(*self.update.looked.get_or_insert(now.link)) >= LOOK_EVERY {
            self.update.looked = Some(now.link);
            self.ask_for(Job::Look);
        }
        None
    }

    /// Content and sets that are needed beside those that the switch record names.
    fn needed(&self) -> BTreeSet<Digest> {
        let update = self.memory.ledger.software.update.as_ref().filter(|u| !u.state.is_over());
        let set = update.and_then(|u| u.set.as_ref());
        let mut needed: BTreeSet<Digest> =
            set.iter().flat_map(|set| set.components.values().map(|c| c.digest)).collect();
        needed.extend(set.map(SetManifest::id));
        needed.extend(update.map(|u| u.bundle));
        needed
    }

    /// Looks at a directive that was not looked at yet. True: a job is on its way.
    pub(super) fn begin_update(&mut self, now: &Now) -> bool {
        let Some(desired) = self.update.desired.as_ref() else { return false };
        let wanted = matches!(desired.goal, Goal::Stage | Goal::Activate) && !self.is_observed();
        if !wanted || self.names(desired) {
            return false;
        }
        match self.trusted() {
            Ok(trusted) => {
                self.ask_to_refresh(now, trusted, self.reading(now));
                true
            }
            Err(reason) => {
                self.refuse_directive(reason);
                false
            }
        }
    }
}
