//! What the updater believes: the repository's word, the keys that sign directives, and whether a directive holds
//! against both.
//!
//! Invariant: what the repository says is written down before a directive is held against it; a new key counts only by
//! the rule of [`midshift_bundle::key_set`].

use crate::core::state::AgentCore;
use crate::storage::{HeldKeys, Op, SoftwareRow, Update};
use crate::update::{Done, Job};
use midshift_bundle::bugs::Bugs;
use midshift_bundle::digest::Digest;
use midshift_bundle::directive::{Directive, Expected, Rejection};
use midshift_bundle::key_set::Current;
use midshift_bundle::trust::{self, Reading, Refreshed, Trusted};
use midshift_core::reason::{Code, Reason};
use midshift_core::time::{Now, Utc};
use midshift_core::update::{DesiredUpdate, UpdateState};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Why a directive is not taken, for the server.
pub(super) fn refusal_of(rejection: &Rejection) -> Reason {
    let code = match rejection {
        Rejection::NotSigned => Code::BadSignature,
        _ => Code::DirectiveRefused,
    };
    Reason::new(code, rejection.to_string())
}

impl AgentCore {
    pub(super) fn reading(&self, now: &Now) -> Reading {
        let is_synced = self.update.config.as_ref().is_some_and(|c| c.clock_synced);
        Reading { utc: now.wall, is_synced }
    }

    /// What it believes. A person may have put another root into its trust file since; of other people also the sets of
    /// directive keys count anew.
    pub(super) fn trusted(&mut self) -> Result<Trusted, Reason> {
        let unreadable = |e: trust::Error| Reason::new(Code::MetadataRefused, e.to_string());
        let root = self.update.config.as_ref().map(|c| c.root.clone());
        let Some(before) = self.memory.ledger.trusted.clone() else {
            return Trusted::new(&root.unwrap_or_default()).map_err(unreadable);
        };
        let Some(root) = root else { return Ok(Trusted::clone(&before)) };
        let trusted = before.from_root(&root).map_err(unreadable)?;
        if trusted != *before {
            if !trusted.shares_root_key(&before).map_err(unreadable)? {
                self.put_software(SoftwareRow { keys: None, ..self.memory.ledger.software.clone() });
            }
            self.write(Op::Trusted(Arc::new(trusted.clone())), true);
        }
        Ok(trusted)
    }

    /// Notes since when the time floor is what it is, by the robot's own clock.
    pub(super) fn note_floor(&mut self, now: &Now) {
        let floor = self.memory.ledger.trusted.as_ref().map_or(Utc(0), |trusted| trusted.time_floor());
        if self.update.floor.is_none_or(|(known, _)| known != floor) {
            self.update.floor = Some((floor, now.link));
        }
    }

    /// What it knows of the time by itself: its floor and its own clock since, or what a proven server told last. 0:
    /// nothing.
    fn own_time(&self, now: &Now) -> Utc {
        let told = self.update.told.unwrap_or(Utc(0));
        match self.update.floor {
            Some((floor, since)) if floor > Utc(0) => floor.plus_ms(now.link.since(since).as_ms()).max(told),
            _ => told,
        }
    }

    /// The server told the time with the echo of a heartbeat: what it proved itself for raises the floor, within
    /// bounds.
    pub(crate) fn told_the_time(&mut self, time: Utc) {
        if !self.config.server_is_proven {
            return;
        }
        self.update.told = Some(time);
        if let Some(trusted) = self.memory.ledger.trusted.as_ref().and_then(|trusted| trusted.raise_time_floor(time)) {
            self.write(Op::Trusted(Arc::new(trusted)), false);
        }
    }

    /// Whose directives it takes: of the keys that were handed over last. Keys that a person put into its trust file
    /// since count instead.
    fn directive_keys(&self) -> Current {
        let own = self.update.config.as_ref().map(|c| c.directive_keys.clone()).unwrap_or_default();
        let held = self.memory.ledger.software.keys.as_ref();
        let number = held.map_or(0, |held| held.number);
        match held.filter(|held| held.from.iter().eq(own.keys())) {
            Some(held) => Current { number, keys: held.keys.iter().map(|key| (key.id(), key.clone())).collect() },
            None => Current { number, keys: own },
        }
    }

    /// Goes over to the newest set of keys that was handed over.
    fn take_keys(&mut self, listed: &BTreeMap<u64, Vec<u8>>) {
        let before = self.directive_keys();
        let mut current = before.clone();
        for (number, rejection) in current.follow(listed) {
            tracing::warn!(robot_id = %self.config.robot_id, number, %rejection, "a set of directive keys was passed over");
        }
        if current == before {
            return;
        }
        let keys: Vec<String> = current.keys.keys().map(ToString::to_string).collect();
        tracing::info!(robot_id = %self.config.robot_id, number = current.number, ?keys, "directives are taken of other keys");
        let from = self.update.config.iter().flat_map(|c| c.directive_keys.keys().copied()).collect();
        let held = HeldKeys { number: current.number, keys: current.keys.into_values().collect(), from };
        self.put_software(SoftwareRow { keys: Some(held), ..self.memory.ledger.software.clone() });
    }

    pub(super) fn ask_to_refresh(&mut self, now: &Now, trusted: Trusted, clock: Reading) {
        let trusted = trusted.knowing(self.own_time(now));
        let keys_after = self.directive_keys().number;
        self.update.asks_for_keys = false;
        self.ask_for(Job::Refresh { trusted: Box::new(trusted), clock, keys_after });
    }

    pub(super) fn refresh_again(&mut self, now: &Now) {
        match self.trusted() {
            Ok(trusted) => {
                let is_synced = false;
                let clock = Reading { utc: trusted.time_floor(), is_synced };
                self.ask_to_refresh(now, trusted, clock);
            }
            Err(reason) => self.move_to(UpdateState::Refused, Some(reason)),
        }
    }

    /// Writes down what is believed of a refresh that failed, a newer root first of all. The time floor may have risen
    /// meanwhile.
    pub(super) fn believe_what_came(&mut self, done: Done) -> Done {
        match done {
            Done::Believed { trusted, failure } => {
                let floor = self.memory.ledger.trusted.as_ref().map_or(Utc(0), |known| known.time_floor());
                self.write(Op::Trusted(Arc::new(trusted.at_least(floor))), true);
                Done::Failed(failure)
            }
            done => done,
        }
    }

    /// The repository has answered: what it says is believed first, then the directive is held against it.
    pub(super) fn refreshed(&mut self, now: &Now, mut refreshed: Refreshed, key_sets: &BTreeMap<u64, Vec<u8>>) {
        // What it was told meanwhile counts beside what was signed.
        if let Some(later) = self.update.told.and_then(|time| refreshed.trusted.raise_time_floor(time)) {
            refreshed.trusted = later;
        }
        self.write(Op::Trusted(Arc::new(refreshed.trusted.clone())), true);
        self.take_keys(key_sets);
        let time = refreshed.trusted.now(self.reading(now));
        self.update.listed = Some(Arc::new(refreshed));
        let Some(desired) = self.update.desired.clone() else { return };
        self.update.keys_asked = Some(desired.directive.clone());
        if std::mem::take(&mut self.update.asks_for_keys) {
            // The order to go back is held against them at its place.
            return;
        }
        if self.is_the_newest(&desired) {
            // What it asked for stands on the ledger, or is over.
            self.update.judged = Some(desired.directive);
            return;
        }
        match self.accept_directive(&desired, time) {
            Ok(_) if self.goes_back_first(&desired) => {}
            Ok(directive) => {
                self.update.judged = Some(desired.directive.clone());
                self.update.fetched.clear();
                let update = Update {
                    state: UpdateState::Directed,
                    bundle: directive.manifest,
                    manifest_length: directive.manifest_length,
                    rollback_floor: directive.rollback_floor,
                    set: None,
                    raises_floor: false,
                    is_irreversible: false,
                    drain_id: None,
                    tries: 0,
                    probation_ms: desired.probation_ms,
                    reason: None,
                };
                let row = self.memory.ledger.software.with(&directive, &desired);
                self.put_software(row);
                self.put_update(update);
            }
            Err(reason) => self.refuse_directive(reason),
        }
    }

    /// A newer order has come to a robot that is stuck with a set on trial: its kept set is read again and gone back
    /// to, and the order is looked at after that. One that is stuck still does not take it.
    fn goes_back_first(&mut self, desired: &DesiredUpdate) -> bool {
        let on_trial = self.update.holdings.as_ref().is_some_and(|holdings| holdings.switch.trial.is_some());
        let stuck = self.memory.ledger.software.update.clone().filter(|u| on_trial && u.state == UpdateState::Stuck);
        let Some(update) = stuck else { return false };
        if self.update.back_first.as_ref() == Some(&desired.directive) {
            self.refuse_directive(update.reason.unwrap_or_else(|| Code::KeptSetBad.into()));
            return true;
        }
        self.update.back_first = Some(desired.directive.clone());
        let (state, reason) = (UpdateState::RollingBack, Some(Reason::from(Code::RevertAsked)));
        let drain_id = desired.drain_id.clone().or(update.drain_id.clone());
        self.put_update(Update { state, drain_id, reason, ..update });
        true
    }

    fn accept_directive(&self, desired: &DesiredUpdate, now: Utc) -> Result<Directive, Reason> {
        let bugs = self.config.bugs;
        let newest = if bugs.replays_are_taken() { 0 } else { self.memory.ledger.software.directive_generation };
        let directive = self.verify_directive(desired, newest, now).map_err(|rejection| refusal_of(&rejection))?;
        if self.lists(&directive.manifest, directive.manifest_length) || bugs.unlisted_is_fine() {
            Ok(directive)
        } else {
            Err(Reason::new(Code::DirectiveRefused, "no release lists its bundle"))
        }
    }

    pub(super) fn verify_directive(
        &self,
        desired: &DesiredUpdate,
        generation: u64,
        now: Utc,
    ) -> Result<Directive, Rejection> {
        let keys = &self.directive_keys().keys;
        let (robot_id, bugs) = (&self.config.robot_id, Bugs::default());
        let expected = Expected { robot_id, keys, generation, now, bugs };
        Directive::verify(desired.directive.as_bytes(), &expected)
    }

    /// Whether the envelope is the one that was taken last: after a restart it comes again. What was taken does not
    /// expire, nor with its key.
    pub(super) fn is_the_newest(&self, desired: &DesiredUpdate) -> bool {
        let software = &self.memory.ledger.software;
        if software.envelope == Some(Digest::of_content(desired.directive.as_bytes())) {
            return true;
        }
        let newest = software.directive_generation;
        newest > 0 && self.verify_directive(desired, newest - 1, Utc(0)).is_ok_and(|d| d.generation == newest)
    }

    pub(super) fn lists(&self, digest: &Digest, length: u64) -> bool {
        let listed = self.update.listed.as_ref();
        listed.is_some_and(|l| l.targets.values().any(|t| t.digest == *digest && t.length == length))
    }
}
