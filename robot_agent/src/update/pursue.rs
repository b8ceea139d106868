//! The machine: from what is wanted, what the ledger says and what is on the disk to the next job.
//!
//! Invariant: level-triggered. It may be called at any moment and any number of times; what it decides is written down before it is done.

use super::standing::Next;
use super::{Done, Failure, Job, SoftwareRow, Update, again, io, migrate};
use crate::core::{AgentCore, ExitReason, Output};
use crate::sets::{Holdings, Wanted};
use crate::store::Op;
use crate::switch::Switch;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{Manifest, Migration};
use midshift_bundle::set::{Fit, SetManifest, raised};
use midshift_core::ids::{DrainId, PlaceId, SetId};
use midshift_core::limits;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{Fault, HardwareStop, Lane, Mode};
use midshift_core::time::{LinkDuration, Now, SiteDuration};
use midshift_core::update::{DesiredUpdate, Goal, UpdateEvent, UpdateState};
use midshift_core::work::RobotEvent;
use std::collections::BTreeSet;

/// A grant that did not come is asked for again after this.
const ASK_AGAIN: LinkDuration = LinkDuration(10_000);
/// Without an update under way the disk is looked at so often: the room on it is told to the server.
const LOOK_EVERY: LinkDuration = LinkDuration(60_000);
/// A set on probation that does not reach its server for so long is gone back from.
const LOST_SERVER: LinkDuration = LinkDuration(600_000);
/// At the end of a probation the server must have answered within this, or within half of the probation where that is less.
const REACHED_WITHIN: LinkDuration = LinkDuration(30_000);

impl AgentCore {
    /// Takes section `update` in.
    pub(crate) fn on_update(&mut self, desired: DesiredUpdate) {
        let mut applied = self.kept.ledger.applied;
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
        let Some(update) = self.kept.ledger.software.update.clone() else {
            return self.without_update(now, holdings);
        };
        match update.state {
            UpdateState::Directed => self.directed(now, &update),
            UpdateState::Downloading => self.downloading(&update),
            UpdateState::Staged => self.staged(now, update),
            UpdateState::Switching => return self.switching(now, &update, holdings),
            UpdateState::Probation => self.probation(now, update, holdings),
            UpdateState::Trial => self.trial(update, holdings),
            UpdateState::Committing => self.committing(now, update, holdings),
            UpdateState::RollingBack => return self.rolling_back(now, update, holdings),
            UpdateState::Committed if self.wants_back(&update) => {
                if holdings.switch.kept().is_none() {
                    self.refuse_way_back();
                    return self.without_update(now, holdings);
                }
                self.go_back(update, Reason::from(Code::RevertAsked));
            }
            _ => return self.without_update(now, holdings),
        }
        None
    }

    /// A download that is wanted no more, or at another rate.
    fn is_stale(&self, running: &Job) -> bool {
        let Job::Fetch { rate_bytes_s, .. } = running else { return false };
        let desired = self.update.desired.as_ref();
        desired.is_some_and(|d| d.rate_bytes_s != *rate_bytes_s || (d.goal == Goal::Revert && self.names(d)))
    }

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
            (_, Done::Holdings(holdings)) => self.look(*holdings),
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

    fn hold(&mut self, change: impl FnOnce(&mut Holdings)) {
        if let Some(holdings) = &mut self.update.holdings {
            change(holdings);
        }
    }

    pub(super) fn ask_for(&mut self, job: Job) {
        let barrier = self.written();
        self.update.next = Some((job, barrier));
    }

    fn put_off(&mut self, now: &Now, job: &Job, why: &str) {
        let failures = self.update.pause.map_or(0, |(_, failures)| failures) + 1;
        let pause = again::pause(&self.config.robot_id, failures);
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

    // --- the row

    pub(super) fn put_software(&mut self, row: SoftwareRow) {
        self.note_directive(row.directive);
        self.write(Op::Software(Box::new(row)), true);
    }

    /// Moves the update on, on the ledger and in a report.
    pub(super) fn move_to(&mut self, state: UpdateState, reason: Option<Reason>) {
        let Some(update) = self.kept.ledger.software.update.clone() else { return };
        let reason = reason.or(update.reason.clone());
        self.put_update(Update { state, reason, ..update });
    }

    pub(super) fn put_update(&mut self, update: Update) {
        let from = self.kept.ledger.software.update.as_ref().filter(|u| u.bundle == update.bundle).map(|u| u.state);
        if from.is_some_and(|from| from != update.state && !from.transitions().contains(&update.state)) {
            tracing::error!(?from, to = ?update.state, "no step of an update");
            return;
        }
        tracing::info!(robot_id = %self.config.robot_id, bundle = %update.bundle, state = ?update.state, reason = update.reason.as_ref().map(|reason| reason.name()), "update");
        self.update.collected = false;
        self.put_software(SoftwareRow { update: Some(update), ..self.kept.ledger.software.clone() });
        if let Some(report) = self.update_report() {
            self.emit(Lane::Event, RobotEvent::Update(UpdateEvent::Changed(report)));
        }
    }

    /// What the robot says of its update.
    pub(crate) fn update_report(&self) -> Option<midshift_core::update::UpdateReport> {
        let (there, needed) = self.update.progress;
        let permille = there.saturating_mul(1000).checked_div(needed).unwrap_or(0);
        self.kept.ledger.software.report(permille.min(1000) as u16)
    }

    // --- nothing is on its way

    /// No update, or one that is over: looks for a new directive, then tidies up.
    fn without_update(&mut self, now: &Now, holdings: &Holdings) -> Option<ExitReason> {
        let update = self.kept.ledger.software.update.as_ref();
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
        let update = self.kept.ledger.software.update.as_ref().filter(|u| !u.state.is_over());
        let set = update.and_then(|u| u.set.as_ref());
        let mut needed: BTreeSet<Digest> =
            set.iter().flat_map(|set| set.components.values().map(|c| c.digest)).collect();
        needed.extend(set.map(SetManifest::id));
        needed.extend(update.map(|u| u.bundle));
        needed
    }

    /// Looks at a directive that was not looked at yet. True: a job is on its way.
    fn begin_update(&mut self, now: &Now) -> bool {
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

    /// The newest directive is not taken; it is not looked at again.
    pub(super) fn refuse_directive(&mut self, reason: Reason) {
        let Some(desired) = &self.update.desired else { return };
        tracing::warn!(robot_id = %self.config.robot_id, reason = reason.name(), "directive refused");
        self.update.judged = Some(desired.directive.clone());
        let refused = UpdateEvent::DirectiveRefused { generation: desired.generation, reason };
        self.emit(Lane::Event, RobotEvent::Update(refused));
    }

    // --- bytes

    fn directed(&mut self, now: &Now, update: &Update) {
        if self.update.listed.is_none() {
            // After a restart: what the repository lists is asked for again, and the directive is not.
            return self.refresh_again(now);
        }
        self.ask_for(Job::Manifest { wanted: Wanted { digest: update.bundle, length: update.manifest_length } });
    }

    /// What comes of the bundle on this robot, or why it does not fit.
    fn plan(&mut self, now: &Now, wanted: &Wanted, manifest: &Manifest, bytes: &[u8]) {
        let Some(update) = self.kept.ledger.software.update.clone() else { return };
        let Some(holdings) = self.update.holdings.clone() else { return };
        let current = holdings.set(&holdings.switch.current).unwrap_or_default();
        let config = self.update.config.as_ref();
        let fit = Fit {
            model: self.inventory.model.clone(),
            floors: self.kept.ledger.software.floors.clone(),
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
        if !migrate::is_possible(&set) {
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
        let committed = self.kept.ledger.software.committed_at.filter(|_| set.changes_base(current));
        let Some(committed) = committed else { return Ok(()) };
        // A clock that went back says nothing of the time since.
        let kept_ms = if now.utc >= committed { now.utc.ms_since(committed) } else { 0 };
        if kept_ms >= limits::BASE_SETTLED_MS {
            return Ok(());
        }
        Err(Reason::from(Code::BaseTooSoon).with("wait_ms", limits::BASE_SETTLED_MS - kept_ms))
    }

    fn downloading(&mut self, update: &Update) {
        let Some(set) = &update.set else { return self.move_to(UpdateState::Refused, None) };
        if self.is_dropped() {
            return self.move_to(UpdateState::Refused, Some(Reason::from(Code::RevertAsked)));
        }
        let fetched = &self.update.fetched;
        let there: u64 = set.components.values().filter(|c| fetched.contains(&c.digest)).map(|c| c.length).sum();
        let missing = set.components.values().find(|c| !fetched.contains(&c.digest));
        let job = match missing {
            Some(c) => {
                let rate_bytes_s = self.update.desired.as_ref().map_or(0, |d| d.rate_bytes_s);
                let bases = self.update.holdings.as_ref().map(|holdings| holdings.bases(c)).unwrap_or_default();
                Job::Fetch { wanted: Wanted { digest: c.digest, length: c.length }, bases, rate_bytes_s }
            }
            None => Job::Stage(Box::new(set.clone())),
        };
        self.update.progress = (there, set.components.values().map(|c| c.length).sum());
        self.ask_for(job);
    }

    /// The server wants the update no more, before it ran.
    fn is_dropped(&self) -> bool {
        self.update.desired.as_ref().is_some_and(|d| d.goal == Goal::Revert && self.is_the_newest(d))
    }

    /// Whether the section's directive needs no look: it was looked at, or is the one that was taken last.
    pub(super) fn names(&self, desired: &DesiredUpdate) -> bool {
        self.update.judged.as_ref() == Some(&desired.directive) || self.is_the_newest(desired)
    }

    // --- the switch

    fn staged(&mut self, now: &Now, update: Update) {
        if self.is_dropped() {
            return self.move_to(UpdateState::Refused, Some(Reason::from(Code::RevertAsked)));
        }
        let Some(desired) = self.update.desired.clone() else { return };
        if !self.names(&desired) {
            // A newer directive replaces what has not run.
            self.begin_update(now);
            return;
        }
        let Some(drain_id) = desired.drain_id.clone().filter(|_| desired.goal == Goal::Activate) else { return };
        if let Err(reason) = self.may_activate(now, &drain_id) {
            self.note_blocked(reason);
            return;
        }
        let passed = self.kept.ledger.software.grant_id.max(self.update.stale_grant);
        let grant = desired.grant.filter(|g| g.drain_id == drain_id && g.grant_id > passed);
        if let Some(grant) = &grant
            && self.may_act(now, &grant.authority, "activation").is_err()
        {
            // Another is needed, and this one is not looked at again.
            self.update.stale_grant = grant.grant_id;
            self.update.asked = None;
            return self.ask_for_grant(now, drain_id, &update);
        }
        match grant {
            Some(grant) => {
                self.update.granted_until = self.sent.ends(&grant.authority);
                let row = SoftwareRow { grant_id: grant.grant_id, ..self.kept.ledger.software.clone() };
                self.put_software(row);
                self.put_update(Update {
                    state: UpdateState::Switching,
                    drain_id: Some(drain_id),
                    reason: None,
                    ..update
                });
            }
            None => self.ask_for_grant(now, drain_id, &update),
        }
    }

    fn note_blocked(&mut self, reason: Reason) {
        let Some(update) = self.kept.ledger.software.update.clone() else { return };
        if update.reason.as_ref() != Some(&reason) {
            self.put_update(Update { reason: Some(reason), ..update });
        }
    }

    fn ask_for_grant(&mut self, now: &Now, drain_id: DrainId, update: &Update) {
        let again = |(id, at): &(DrainId, _)| *id == drain_id && now.link.since(*at) < ASK_AGAIN;
        if self.update.asked.as_ref().is_some_and(again) {
            self.wake_at(now.link + ASK_AGAIN);
            return;
        }
        let Some(set) = update.set_name().and_then(|name| SetId::parse(&name).ok()) else { return };
        self.update.asked = Some((drain_id.clone(), now.link));
        self.emit(Lane::Event, RobotEvent::Update(UpdateEvent::Ready { drain_id, set }));
    }

    /// Whether the robot may change its software forward now: without work, load, stop or passage, in this drain, charged and cool.
    fn may_activate(&self, now: &Now, drain_id: &DrainId) -> Result<(), Reason> {
        let no = |what: &str| Err(Reason::from(Code::ActivationBlocked).with("by", what));
        let state = self.body.state(now.site);
        let launched = self.update.config.as_ref().is_some_and(|c| c.is_launched);
        match () {
            () if !self.is_held_by(drain_id) => no("drain"),
            () if self.config.bugs.activates_anyway() => Ok(()),
            () if self.work.is_some() => no("attempt"),
            () if self.body.load().is_some() => no("load"),
            () if self.is_in_passage() => no("passage"),
            () if self.hardware_stop != HardwareStop::None || self.is_stopped() => no("stop"),
            () if self.mode != Mode::Automatic => no("mode"),
            () if !self.body.standstill(now.site) => no("motion"),
            () if state.battery_permille < limits::ACTIVATE_BATTERY_PERMILLE => no("battery"),
            () if state.hottest_joint_decidegrees > limits::ACTIVATE_JOINT_DECIDEGREES => no("temperature"),
            () if !launched => no("no launcher"),
            () => Ok(()),
        }
    }

    /// Whether this drain holds the robot.
    fn is_held_by(&self, drain_id: &DrainId) -> bool {
        let held = self.kept.ledger.maintenance.as_ref();
        held == Some(drain_id) || (self.config.bugs.any_drain_will_do() && held.is_some())
    }

    /// Whether the software changes, or is not yet believed: no work is taken.
    pub(crate) fn changes_software(&self) -> bool {
        let state = self.kept.ledger.software.update.as_ref().map(|u| u.state);
        matches!(state, Some(UpdateState::Switching | UpdateState::Probation | UpdateState::RollingBack))
    }

    /// It holds a place beside the one it stands on.
    fn is_in_passage(&self) -> bool {
        // Not the waypoint that it passed last: it may have left it since.
        let here = self.body.stands_on();
        let standing = |place: &PlaceId| here.iter().any(|w| w.as_str() == place.as_str());
        let row = &self.kept.ledger.places;
        row.inside.keys().chain(row.committed.keys()).any(|place| !standing(place))
    }

    /// Whether what let the switch begin holds still: its grant lives, and nothing came between.
    fn may_switch(&self, now: &Now, update: &Update) -> Result<(), Reason> {
        let blocked = |what: &str| Reason::from(Code::ActivationBlocked).with("by", what);
        self.may_activate(now, update.drain_id.as_ref().ok_or_else(|| blocked("drain"))?)?;
        let lives = self.update.granted_until.is_some_and(|until| now.link <= until);
        if lives || self.config.bugs.authority_from_receipt() { Ok(()) } else { Err(blocked("grant")) }
    }

    /// A switch that waits for the disk is not made once something came between.
    fn take_switch_back(&mut self, now: &Now) {
        let update = self.kept.ledger.software.update.as_ref().filter(|u| u.state == UpdateState::Switching);
        let waits = matches!(self.update.next, Some((Job::Write(_), _)));
        if waits && update.is_some_and(|update| self.may_switch(now, update).is_err()) {
            self.update.next = None;
        }
    }

    fn switching(&mut self, now: &Now, update: &Update, holdings: &Holdings) -> Option<ExitReason> {
        let name = update.set_name()?;
        if holdings.switch.running() == name {
            return Some(ExitReason::Switched);
        }
        if let Err(reason) = self.may_switch(now, update) {
            // The record was not written. Its grant counts as used, so that another is asked for at once.
            self.update.asked = None;
            self.move_to(UpdateState::Staged, Some(reason));
            return None;
        }
        let mut switch = holdings.switch.clone();
        switch.try_out(&name);
        self.write_switch(switch);
        None
    }

    /// What the disk says after a start, held against the ledger. The switch record wins.
    fn look(&mut self, holdings: Holdings) {
        let switch = holdings.switch.clone();
        self.note_committed(&holdings);
        self.update.holdings = Some(holdings);
        let Some(update) = self.kept.ledger.software.update.clone() else { return };
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

    // --- on trial

    fn probation(&mut self, now: &Now, update: Update, holdings: &Holdings) {
        if let Err(reason) = self.self_test() {
            return self.go_back(update, reason);
        }
        if self.wants_back(&update) {
            return self.go_back(update, Reason::from(Code::RevertAsked));
        }
        let Some((link, site)) = self.update.begun else { return };
        let lost_at = self.update.server_reached.unwrap_or(link) + LOST_SERVER;
        if now.link >= lost_at {
            return self.go_back(update, Reason::from(Code::LostServer));
        }
        self.wake_at(lost_at);
        if now.site.since(site) < SiteDuration(update.probation_ms) {
            self.wake_site = Some(site + SiteDuration(update.probation_ms));
            return;
        }
        // An answer of long ago proves nothing of what runs now: the next one is waited for.
        let recent = REACHED_WITHIN.min(LinkDuration(update.probation_ms / 2));
        if self.update.server_reached.is_none_or(|at| now.link.since(at) > recent) {
            return;
        }
        self.move_to(UpdateState::Trial, None);
        self.prove(holdings);
    }

    /// What the maker's own test, made when the agent started, found broken.
    fn self_test(&self) -> Result<(), Reason> {
        let failed = |fault: Fault| Reason::new(Code::SelfTestFailed, fault.message).with("fault_code", fault.code);
        self.unfit.clone().map_or(Ok(()), |fault| Err(failed(fault)))
    }

    fn prove(&mut self, holdings: &Holdings) {
        if holdings.switch.trial.as_ref().is_some_and(|t| !t.is_proven) {
            let mut switch = holdings.switch.clone();
            switch.prove();
            self.write_switch(switch);
        }
    }

    fn trial(&mut self, update: Update, holdings: &Holdings) {
        if self.wants_back(&update) {
            return self.go_back(update, Reason::from(Code::RevertAsked));
        }
        let commit = self.update.desired.as_ref().is_some_and(|d| d.goal == Goal::Commit && self.is_the_newest(d));
        if commit {
            let mut switch = holdings.switch.clone();
            switch.commit();
            self.intend(&switch);
            return self.put_update(Update { state: UpdateState::Committing, ..update });
        }
        self.prove(holdings);
    }

    /// Floors rise and migrations become due only once the switch record names the set as committed.
    fn committing(&mut self, now: &Now, update: Update, holdings: &Holdings) {
        let name = update.set_name();
        if holdings.switch.trial.as_ref().is_some_and(|trial| Some(&trial.set) == name.as_ref()) {
            let mut switch = holdings.switch.clone();
            switch.commit();
            return self.write_switch(switch);
        }
        if holdings.switch.trial.is_some() || Some(&holdings.switch.current) != name.as_ref() {
            return self.move_to(UpdateState::RolledBack, Some(Reason::from(Code::SetPutAway)));
        }
        let kept = holdings.switch.kept().and_then(|kept| holdings.set(kept)).unwrap_or_default();
        let mut row = SoftwareRow { committed_at: Some(now.utc), ..self.kept.ledger.software.clone() };
        if let Some(set) = update.set.as_ref().filter(|_| update.raises_floor) {
            row.floors = raised(&row.floors, set, &kept);
        }
        if let Some(set) = &update.set {
            row.due = migrate::due(set, &kept, &row.due);
        }
        let reason = row.due.first().map(Self::is_due);
        self.put_software(row);
        self.put_update(Update { state: UpdateState::Committed, reason, ..update });
    }

    // --- back

    /// The server wants this update gone. A robot that stands goes back also while it is stopped or has a task.
    fn wants_back(&self, update: &Update) -> bool {
        // Not what was only looked at and refused: that is about another bundle.
        let wanted = self.update.desired.as_ref().is_some_and(|d| d.goal == Goal::Revert && self.is_the_newest(d));
        wanted && !(update.state == UpdateState::Committed && update.is_irreversible)
    }

    pub(super) fn go_back(&mut self, update: Update, reason: Reason) {
        if update.state == UpdateState::Committed && !self.kept.ledger.software.due.is_empty() {
            self.put_software(SoftwareRow { due: Vec::new(), ..self.kept.ledger.software.clone() });
        }
        let drain_id = self.update.desired.as_ref().and_then(|d| d.drain_id.clone()).or(update.drain_id.clone());
        self.put_update(Update { state: UpdateState::RollingBack, drain_id, reason: Some(reason), ..update });
    }

    fn rolling_back(&mut self, now: &Now, update: Update, holdings: &Holdings) -> Option<ExitReason> {
        let name = update.set_name()?;
        if holdings.switch.running() != name {
            if self.update.went_back {
                return Some(ExitReason::Switched);
            }
            match self.self_test() {
                Ok(()) => self.put_update(Update { state: UpdateState::RolledBack, ..update }),
                Err(reason) => self.move_to(UpdateState::Stuck, Some(reason)),
            }
            return None;
        }
        // A task that is held or stopped does not keep the robot from going back; one that goes on does, until it is drained.
        let stopped = self.hardware_stop != HardwareStop::None || self.is_stopped();
        let works = self.work.is_some() && !stopped && !self.resume_needed && self.runs_what_was_signed();
        if works || !self.body.standstill(now.site) {
            return None;
        }
        let kept = holdings.switch.kept().and_then(|kept| SetId::parse(kept).ok());
        match kept {
            Some(kept) if !self.is_proven(kept.as_str(), holdings) => {
                let reason = Reason::new(Code::KeptSetBad, "its manifest is none that was signed and committed");
                self.move_to(UpdateState::Stuck, Some(reason));
            }
            Some(kept) => self.ask_for(Job::Verify(kept)),
            None => self.move_to(UpdateState::Stuck, Some(Reason::from(Code::NothingKept))),
        }
        None
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
