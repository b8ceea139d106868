//! Holds what runs against what was signed and committed, before the robot takes work and while it runs; and what
//! follows if it does not hold.
//!
//! At each start: is the set that runs the committed one, or the one on trial; do its manifest and the documents agree;
//! has its program the bytes that were signed. Then file by file beside everything else, after each start and once a
//! day. What the robot came with has no documents: it is what its maker put there, and holds. Invariant: with a set
//! that does not hold no work is taken and nothing is deleted. A robot that asks for the bytes anew, or goes back, ends
//! up with a committed set that was read whole, or stays without work.

use crate::core::interface::ExitReason;
use crate::core::state::AgentCore;
use crate::launcher::PROGRAM;
use crate::launcher::switch::{FACTORY, Switch};
use crate::sets::Holdings;
use crate::storage::proven::{Committed, Proven};
use crate::storage::{Op, SoftwareRow, Update};
use crate::update::{Integrity, IntegrityFault, Job};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::Migration;
use midshift_bundle::release::Release;
use midshift_bundle::set::SetManifest;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{FAULT_SOFTWARE, Fault, FaultClass};
use midshift_core::time::{LinkDuration, Now};
use midshift_core::update::UpdateState;
use std::collections::BTreeSet;
use std::sync::Arc;

/// The files of the set that runs are read again so often.
const READ_EVERY: LinkDuration = LinkDuration(24 * 3_600_000);
/// Failures in a row to have the bytes anew, a minute apart in the end, after which another way is taken.
const MEND_TRIES_MAX: u32 = 10;

/// What the machine does next.
pub(super) enum Next {
    /// What it would do anyway.
    GoesOn,
    /// It waits for a job.
    Waits,
    /// The process ends.
    Ends(ExitReason),
}

/// The switch record with what was committed. A set before that it has given up since stays given up.
fn repaired(switch: &Switch, committed: Committed) -> Switch {
    let is_given_up = switch.current == committed.current && switch.previous != committed.previous;
    let previous = committed.previous.filter(|_| !is_given_up);
    Switch { current: committed.current, previous, trial: None, ..switch.clone() }
}

impl AgentCore {
    /// Whether work may be done with what runs. A robot whose software is not changed has nothing to hold it against.
    pub(crate) fn runs_what_was_signed(&self) -> bool {
        self.update.config.is_none() || matches!(self.update.integrity, Integrity::Holds)
    }

    /// Why work is not taken with what runs.
    pub(crate) fn software_refusal(&self) -> Option<Reason> {
        match &self.update.integrity {
            Integrity::Bad(bad) => Some(bad.reason.clone()),
            _ => (!self.runs_what_was_signed()).then(|| Code::InMaintenance.into()),
        }
    }

    fn proven(&self) -> Proven {
        self.memory.ledger.proven.as_deref().cloned().unwrap_or_default()
    }

    fn put_proven(&mut self, proven: Proven) {
        if self.memory.ledger.proven.as_deref() != Some(&proven) {
            self.write(Op::Proven(Arc::new(proven)), true);
        }
    }

    // --- what is kept

    /// Keeps the documents of a bundle and what comes of it, before its bytes are asked for.
    pub(super) fn keep_release(&mut self, manifest: &[u8], set: &SetManifest) -> Result<(), Reason> {
        let refused = |why: String| Reason::new(Code::MetadataRefused, why);
        let listed = self.update.listed.as_ref();
        let (root, targets) = listed.and_then(|l| l.trusted.documents()).ok_or_else(|| refused(String::new()))?;
        let release = Release::verified(root, targets, manifest).map_err(|error| refused(error.to_string()))?;
        let mut proven = self.proven();
        proven.releases.insert(release.bundle(), Arc::new(release));
        proven.sets.insert(set.id(), set.clone());
        proven.check(set).map_err(refused)?;
        let running = self.update.holdings.as_ref().and_then(|h| h.switch.running().parse().ok());
        proven.prune(&[Some(set.id()), running].into_iter().flatten().collect());
        self.put_proven(proven);
        Ok(())
    }

    /// A directive was taken by an agent that keeps documents.
    pub(super) fn note_directive(&mut self, generation: u64) {
        if self.memory.ledger.proven.as_ref().map_or(0, |proven| proven.directive_generation) != generation {
            let proven = self.proven();
            self.put_proven(Proven { directive_generation: generation, ..proven });
        }
    }

    /// What the disk says is held against the ledger: what an agent without documents did is taken over once, and what
    /// the switch record was about to say counts once it says so.
    pub(super) fn note_committed(&mut self, holdings: &Holdings) {
        let software = &self.memory.ledger.software;
        let update = software.update.as_ref();
        let is_older = match &self.memory.ledger.proven {
            Some(proven) => software.directive_generation > proven.directive_generation,
            None => software.directive_generation > 0 || update.is_some(),
        };
        let set = update.and_then(|u| u.set.clone());
        let mut proven = self.proven();
        if is_older {
            proven.directive_generation = software.directive_generation;
            proven.adopt(holdings, set.as_ref());
            let sets: Vec<String> = proven.sets.keys().map(ToString::to_string).collect();
            tracing::warn!(robot_id = %self.config.robot_id, ?sets, "sets without release documents are believed by their manifests, once");
        } else {
            let says = |meant: &Committed| *meant == Committed::named_by(&holdings.switch);
            let Some(meant) = proven.intended.take().filter(says) else { return };
            proven.committed = meant;
        }
        let running = holdings.switch.running().parse().ok();
        let others: BTreeSet<Digest> = [set.map(|set| set.id()), running].into_iter().flatten().collect();
        proven.prune(&others);
        self.put_proven(proven);
    }

    /// Writes down what the switch record is about to say of committed sets.
    pub(super) fn intend(&mut self, switch: &Switch) {
        let (proven, meant) = (self.proven(), Committed::named_by(switch));
        let intended = Some(meant).filter(|meant| *meant != proven.committed);
        if proven.intended != intended {
            self.put_proven(Proven { intended, ..proven });
        }
    }

    /// Writes the switch record, after the ledger has what it will say.
    pub(super) fn write_switch(&mut self, switch: Switch) {
        self.intend(&switch);
        self.ask_for(Job::Write(switch));
    }

    /// Whether a set may be gone back to, as far as its manifest tells.
    pub(super) fn is_proven(&self, name: &str, holdings: &Holdings) -> bool {
        name == FACTORY || holdings.set(name).is_some_and(|set| self.proven().check(&set).is_ok())
    }

    // --- what runs

    /// What the shell saw on the disk before the start: to be told, nothing is decided on it.
    pub fn saw(&mut self, holdings: Option<Holdings>) {
        self.holds_as_it_came(holdings.as_ref());
        self.update.seen = holdings;
    }
    /// What is on the disk, as it was seen last. None: its software is not changed, or the disk cannot be read.
    pub(crate) fn holdings(&self) -> Option<&Holdings> {
        self.update.holdings.as_ref().or(self.update.seen.as_ref())
    }

    /// What the robot came with runs, and nothing else was ever committed: there is nothing to look for.
    pub(super) fn holds_as_it_came(&mut self, holdings: Option<&Holdings>) {
        let is_factory = holdings.is_some_and(|holdings| holdings.switch.running() == FACTORY);
        if is_factory && self.proven().committed.current == FACTORY {
            self.update.integrity = Integrity::Holds;
        }
    }

    /// Whether what runs holds is found out before anything else is done.
    pub(super) fn hold_running(&mut self, now: &Now, holdings: &Holdings) -> Next {
        if self.update.leaves.is_some_and(|number| holdings.switch.number > number) {
            return Next::Ends(ExitReason::Switched);
        }
        match &self.update.integrity {
            Integrity::Holds => Next::GoesOn,
            Integrity::Bad(_) => self.remedy(now, holdings),
            Integrity::Unknown if self.ends_anyway(&holdings.switch) => self.end_beside_an_update(holdings),
            Integrity::Unknown => match self.held(holdings) {
                Ok(Some(set)) => {
                    self.ask_for(Job::Check { set: set.id(), file: PROGRAM.to_owned() });
                    Next::Waits
                }
                Ok(None) => {
                    self.acquit();
                    Next::GoesOn
                }
                Err(why) => {
                    self.condemn(Reason::new(Code::RunningSetBad, why));
                    self.remedy(now, holdings)
                }
            },
        }
    }

    /// It is on trial, and the ledger knows of no such trial: the machine ends it.
    fn ends_anyway(&self, switch: &Switch) -> bool {
        let update = self.memory.ledger.software.update.as_ref();
        let trial = switch.trial.as_ref().map(|trial| &trial.set);
        trial.is_some() && update.and_then(Update::set_name).as_ref() != trial
    }

    /// An update that has switched nothing yet keeps the machine from it: then it is ended here.
    fn end_beside_an_update(&mut self, holdings: &Holdings) -> Next {
        let state = self.memory.ledger.software.update.as_ref().map(|u| u.state);
        if !matches!(state, Some(UpdateState::Directed | UpdateState::Downloading | UpdateState::Staged)) {
            return Next::GoesOn;
        }
        self.update.leaves = Some(holdings.switch.number);
        self.end_unknown_trial(&holdings.switch);
        Next::Waits
    }

    /// The set that runs if its program is to be looked at; none: it has none.
    fn held(&self, holdings: &Holdings) -> Result<Option<SetManifest>, String> {
        let (switch, proven) = (&holdings.switch, self.proven());
        let name = switch.running();
        if switch.trial.is_none() && name != proven.committed.current {
            return Err(format!("{name} runs, and {} was committed", proven.committed.current));
        }
        if name == FACTORY {
            return Ok(None);
        }
        let set = holdings.set(name).ok_or_else(|| "its manifest is not the one that it is named by".to_owned())?;
        proven.check(&set)?;
        Ok(Some(set).filter(|set| set.program().is_some()))
    }

    /// A file of the set that runs has the bytes that were signed.
    pub(super) fn checked(&mut self, file: &str) {
        if file == PROGRAM && matches!(self.update.integrity, Integrity::Unknown) {
            self.acquit();
        }
    }

    /// What runs holds. A robot that was stuck with it is so no more.
    fn acquit(&mut self) {
        self.update.integrity = Integrity::Holds;
        let software = self.memory.ledger.software.clone();
        let is_ours = |u: &Update| u.reason.as_ref().is_some_and(|reason| reason.code == Code::RunningSetBad);
        let stuck = software.update.clone().filter(|u| u.state == UpdateState::Stuck && is_ours(u));
        let runs = self.update.holdings.as_ref().filter(|h| h.switch.trial.is_none()).map(|h| h.switch.current.clone());
        if let Some(update) = stuck.filter(|u| u.set_name() == runs) {
            let update = Update { state: UpdateState::Committed, reason: None, ..update };
            self.put_software(SoftwareRow { update: Some(update), ..software });
        }
    }

    /// Reads the next file of the set that runs, beside everything else.
    pub(super) fn check_files(&mut self, now: &Now, holdings: &Holdings) {
        let state = self.memory.ledger.software.update.as_ref().map(|u| u.state);
        let changes = matches!(
            state,
            Some(UpdateState::Switching | UpdateState::Committing | UpdateState::RollingBack | UpdateState::Stuck)
        );
        let Ok(id) = holdings.switch.running().parse::<Digest>() else { return };
        if changes || !matches!(self.update.integrity, Integrity::Holds) {
            return;
        }
        if self.update.read_at.is_none_or(|at| now.link.since(at) >= READ_EVERY) {
            self.update.read_at = Some(now.link);
            let set = holdings.sets.get(&id);
            self.update.unread = set.iter().flat_map(|set| set.components.keys().cloned()).collect();
        }
        if let Some(file) = self.update.unread.pop() {
            self.ask_for(Job::Check { set: id, file });
        }
    }

    /// What runs does not hold: the robot takes no work, and says so.
    pub(super) fn condemn(&mut self, reason: Reason) {
        tracing::error!(robot_id = %self.config.robot_id, reason = reason.name(), why = reason.text(), "what runs is not what was signed and committed");
        let message = format!("{}: {}", reason.name(), reason.text()).chars().take(200).collect();
        self.fault_changed(Fault { code: FAULT_SOFTWARE, class: FaultClass::Mechanical, message }, true);
        self.update.integrity =
            Integrity::Bad(IntegrityFault { reason, tries: 0, is_given_up: false, is_mended: false });
    }

    // --- what follows if it does not hold

    fn remedy(&mut self, now: &Now, holdings: &Holdings) -> Next {
        let Integrity::Bad(bad) = &self.update.integrity else { return Next::GoesOn };
        let (reason, is_given_up, is_mended) = (bad.reason.clone(), bad.is_given_up, bad.is_mended);
        let update = self.memory.ledger.software.update.clone();
        let state = update.as_ref().map(|u| u.state);
        if let Some(update) = update.filter(|_| holdings.switch.trial.is_some()) {
            if matches!(update.state, UpdateState::Probation | UpdateState::Trial | UpdateState::Committing) {
                self.go_back(update, reason);
            }
            return Next::GoesOn;
        }
        if state == Some(UpdateState::RollingBack) {
            return Next::GoesOn;
        }
        if is_given_up {
            // A newer bundle that is on its way leads out of it too.
            if state.is_some_and(|state| state == UpdateState::Stuck || !state.is_over()) {
                return Next::GoesOn;
            }
            self.leave_committed(holdings, reason);
            return Next::Waits;
        }
        let (committed, set) = self.committed_set();
        if is_mended || committed.current == FACTORY {
            if self.body.standstill(now.site) {
                let switch = repaired(&holdings.switch, committed);
                self.update.leaves = Some(switch.number);
                self.write_switch(switch);
            }
            return Next::Waits;
        }
        match set {
            Some(set) => self.ask_for(Job::Mend(Box::new(set))),
            None => self.give_up_mending(),
        }
        Next::Waits
    }

    /// What the ledger has as committed; its manifest, if that is proven.
    fn committed_set(&self) -> (Committed, Option<SetManifest>) {
        let proven = self.proven();
        let id = proven.committed.current.parse::<Digest>().ok();
        let set = id.and_then(|id| proven.sets.get(&id)).filter(|set| proven.check(set).is_ok()).cloned();
        (proven.committed, set)
    }

    /// The committed set lies there as it was signed: it is started anew.
    pub(super) fn mended(&mut self) {
        if let Integrity::Bad(bad) = &mut self.update.integrity {
            bad.is_mended = true;
        }
    }

    /// Its bytes cannot be had now.
    pub(super) fn not_mended(&mut self) {
        if let Integrity::Bad(bad) = &mut self.update.integrity {
            bad.tries += 1;
            bad.is_given_up |= bad.tries >= MEND_TRIES_MAX;
        }
    }

    /// Its bytes cannot be had.
    pub(super) fn give_up_mending(&mut self) {
        if let Integrity::Bad(bad) = &mut self.update.integrity {
            bad.is_given_up = true;
        }
    }

    /// Goes back from the committed set, or stays where it is without work.
    fn leave_committed(&mut self, holdings: &Holdings, reason: Reason) {
        let proven = self.proven();
        let software = self.memory.ledger.software.clone();
        let is_committed = holdings.switch.current == proven.committed.current;
        let way_back =
            proven.way_back(&software.floors).filter(|way| holdings.switch.previous.as_deref() == Some(*way));
        let id = proven.committed.current.parse::<Digest>().ok();
        let set = id.and_then(|id| proven.sets.get(&id)).cloned().unwrap_or_default();
        let is_irreversible = set.components.values().any(|c| c.data_migration == Migration::Irreversible);
        let update = Update {
            state: UpdateState::Committed,
            bundle: set.bundle.unwrap_or_else(|| set.id()),
            manifest_length: 0,
            rollback_floor: 0,
            set: Some(set),
            raises_floor: false,
            is_irreversible,
            drain_id: None,
            tries: 0,
            probation_ms: 0,
            reason: None,
        };
        self.put_software(SoftwareRow { update: Some(update.clone()), ..software });
        let goes_back = is_committed && way_back.is_some();
        self.go_back(update, reason);
        if !goes_back {
            self.move_to(UpdateState::Stuck, None);
        }
    }
}
