//! Answers what the table asks: each condition by what is wanted, what the ledger says and what is on the disk.
//!
//! Invariant: an answer changes nothing and says nothing.

use super::machine::Condition;
use crate::core::state::AgentCore;
use crate::sets::Holdings;
use crate::storage::Update;
use midshift_core::ids::{DrainId, SetId};
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{Fault, HardwareStop};
use midshift_core::time::{LinkDuration, LinkTime, Now, SiteDuration, SiteTime};
use midshift_core::update::{ActivationGrant, DesiredUpdate, Goal, UpdateState};

/// A set on probation that does not reach its server for so long is gone back from.
const LOST_SERVER: LinkDuration = LinkDuration(600_000);
/// At the end of a probation the server must have answered within this, or within half of the probation where that is
/// less.
const REACHED_WITHIN: LinkDuration = LinkDuration(30_000);

/// What the next step is decided about.
#[derive(Clone, Copy)]
pub(super) struct Case<'a> {
    /// The moment.
    pub(super) now: &'a Now,
    /// The update under way.
    pub(super) update: &'a Update,
    /// What is on the disk.
    pub(super) holdings: &'a Holdings,
}

impl Case<'_> {
    /// The set of the update does not run: the kept one does.
    fn runs_another(&self) -> bool {
        self.update.set_name().is_some_and(|name| self.holdings.switch.running() != name)
    }

    /// The set before the one of the update, if the switch record keeps one.
    pub(super) fn kept_set(&self) -> Option<SetId> {
        self.holdings.switch.kept().and_then(|kept| SetId::parse(kept).ok())
    }
}

impl AgentCore {
    /// Whether a condition holds.
    pub(super) fn holds(&self, case: Case<'_>, condition: Condition) -> bool {
        let Case { now, update, holdings } = case;
        let switch = &holdings.switch;
        // Its name is a digest, which is not made for nothing.
        let name = || update.set_name();
        let on_trial = switch.trial.as_ref().map(|trial| &trial.set);
        match condition {
            Condition::Unlisted => self.update.listed.is_none(),
            Condition::NoSet => update.set.is_none(),
            Condition::Unwanted => self.is_dropped(),
            Condition::ContentMissing => {
                let fetched = &self.update.fetched;
                update.set.iter().flat_map(|set| set.components.values()).any(|c| !fetched.contains(&c.digest))
            }
            Condition::NewerOrder => self.update.desired.as_ref().is_some_and(|desired| !self.names(desired)),
            Condition::NotToActivate => self.drain_to_activate_in().is_none(),
            Condition::ActivationBlocked => self.blocks_activation(now).is_some(),
            Condition::GrantStale => self.unused_grant().is_some_and(|g| self.is_valid(now, &g.authority).is_err()),
            Condition::Granted => self.unused_grant().is_some(),
            Condition::SetRuns => name().is_some_and(|name| switch.running() == name),
            Condition::SwitchBlocked => self.may_switch(now, update).is_err(),
            Condition::SelfTestFailed => self.self_test().is_err(),
            Condition::WantedBack => self.wants_back(update),
            Condition::ServerLost => self.lost_server_at().is_some_and(|lost_at| now.link >= lost_at),
            Condition::ProbationRuns => self.probation_ends_at(update).is_none_or(|end| now.site < end),
            Condition::ServerNotHeard => {
                // An answer of long ago proves nothing of what runs now: the next one is waited for.
                let recent = REACHED_WITHIN.min(LinkDuration(update.probation_ms / 2));
                self.update.server_reached.is_none_or(|at| now.link.since(at) > recent)
            }
            Condition::CommitWanted => {
                let desired = self.update.desired.as_ref();
                desired.is_some_and(|d| d.goal == Goal::Commit && self.is_the_newest(d))
            }
            Condition::OnTrialInRecord => on_trial.is_some() && on_trial == name().as_ref(),
            Condition::RecordNamesAnother => on_trial.is_some() || Some(&switch.current) != name().as_ref(),
            Condition::WentBack => case.runs_another() && self.update.went_back,
            Condition::KeptSetUnfit => case.runs_another() && self.self_test().is_err(),
            Condition::KeptSetRuns => case.runs_another(),
            Condition::Busy => {
                // A task that is held or stopped does not keep the robot from going back; one that goes on does, until
                // it is drained.
                let stopped = self.hardware_stop != HardwareStop::None || self.is_stopped();
                let works = self.work.is_some() && !stopped && !self.resume_needed && self.runs_what_was_signed();
                works || !self.body.standstill(now.site)
            }
            Condition::NothingKept => case.kept_set().is_none(),
            Condition::KeptSetUnproven => case.kept_set().is_some_and(|kept| !self.is_proven(kept.as_str(), holdings)),
            Condition::WayBackClosed => self.wants_back(update) && switch.kept().is_none(),
            Condition::Otherwise => true,
        }
    }

    /// Why a step is taken for this condition, as it is reported; none: nothing new is said.
    pub(super) fn reason_for(&self, case: Case<'_>, condition: Condition) -> Option<Reason> {
        match condition {
            Condition::Unwanted | Condition::WantedBack => Some(Code::RevertAsked.into()),
            Condition::ActivationBlocked => self.blocks_activation(case.now),
            Condition::SwitchBlocked => self.may_switch(case.now, case.update).err(),
            Condition::SelfTestFailed | Condition::KeptSetUnfit => self.self_test().err(),
            Condition::ServerLost => Some(Code::LostServer.into()),
            Condition::RecordNamesAnother => Some(Code::SetPutAway.into()),
            Condition::NothingKept => Some(Code::NothingKept.into()),
            Condition::KeptSetUnproven => {
                Some(Reason::new(Code::KeptSetBad, "its manifest is none that was signed and committed"))
            }
            _ => None,
        }
    }

    /// The server wants the update no more, before it ran.
    fn is_dropped(&self) -> bool {
        self.update.desired.as_ref().is_some_and(|d| d.goal == Goal::Revert && self.is_the_newest(d))
    }

    /// Whether the section's directive needs no look: it was looked at, or is the one that was taken last.
    pub(super) fn names(&self, desired: &DesiredUpdate) -> bool {
        self.update.judged.as_ref() == Some(&desired.directive) || self.is_the_newest(desired)
    }

    /// The drain in which the newest section asks for activation.
    pub(super) fn drain_to_activate_in(&self) -> Option<&DrainId> {
        self.update.desired.as_ref().filter(|d| d.goal == Goal::Activate)?.drain_id.as_ref()
    }

    fn blocks_activation(&self, now: &Now) -> Option<Reason> {
        self.drain_to_activate_in().and_then(|drain_id| self.may_activate(now, drain_id).err())
    }

    /// The grant for that drain, if it was neither used nor came too late.
    pub(super) fn unused_grant(&self) -> Option<&ActivationGrant> {
        let drain_id = self.drain_to_activate_in()?;
        let passed = self.memory.ledger.software.grant_id.max(self.update.stale_grant);
        let grant = self.update.desired.as_ref()?.grant.as_ref();
        grant.filter(|grant| grant.drain_id == *drain_id && grant.grant_id > passed)
    }

    /// When a set on probation is gone back from for want of its server; none: no update was pursued yet.
    pub(super) fn lost_server_at(&self) -> Option<LinkTime> {
        let (begun, _) = self.update.begun?;
        Some(self.update.server_reached.unwrap_or(begun) + LOST_SERVER)
    }

    /// When the probation is over; none: no update was pursued yet.
    pub(super) fn probation_ends_at(&self, update: &Update) -> Option<SiteTime> {
        self.update.begun.map(|(_, begun)| begun + SiteDuration(update.probation_ms))
    }

    /// What the maker's own test, made when the agent started, found broken.
    fn self_test(&self) -> Result<(), Reason> {
        let failed = |fault: Fault| Reason::new(Code::SelfTestFailed, fault.message).with("fault_code", fault.code);
        self.unfit.clone().map_or(Ok(()), |fault| Err(failed(fault)))
    }

    /// The server wants this update gone. A robot that stands goes back also while it is stopped or has a task.
    fn wants_back(&self, update: &Update) -> bool {
        // Not what was only looked at and refused: that is about another bundle.
        self.is_dropped() && !(update.state == UpdateState::Committed && update.is_irreversible)
    }
}
