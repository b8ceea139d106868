//! The witness: sees each commit, each write of a robot's ledger, each order to a body and where bodies are, and holds them
//! against the invariants.
//!
//! Invariant: it takes part in nothing. What it says is broken is broken at that moment, by what was done, not by what somebody
//! believes. Called by the disks, by the bodies and by the loop of a run.

use crate::changes::{Changes, Look};
use crate::clock::TrueTime;
use crate::law_names::{GOES_ON, ONCE};
use crate::laws::{Grants, Offers};
use crate::stderr::print_line;
use midshift_agent::store::Op;
use midshift_agent::switch::Switch;
use midshift_bundle::set::SetManifest;
use midshift_core::desired_state::DesiredWork;
use midshift_core::fleet::rows::{Place, PlaceHolder};
use midshift_core::ids::{PlaceId, RobotId, Subject, TaskId};
use midshift_core::reason::Code;
use midshift_core::robot::Lane;
use midshift_core::robot::WorkState;
use midshift_core::robot_events::{InboxEntry, InboxItem, RobotEvent, SampleBody};
use midshift_core::rollout::rows::Rollout;
use midshift_core::rows::{Entry, Log, Record, Seq, Table};
use midshift_core::step::StepKind;
use midshift_core::task::machine::Phase;
use midshift_core::task::{Attempt, AttemptPhase, TaskIntake, TaskState};
use midshift_core::update::{DesiredUpdate, UpdateEvent};
use midshift_sim::handle::SimHandle;
use midshift_sim::world::{SharedWorld, lock};
use midshift_store::{Frame, MemoryStore, Store};
use midshift_tests::player::Player;
use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

/// Findings kept in words.
const FINDINGS_MAX: usize = 20;
/// Entries of one page.
const PAGE: usize = 5_000;

/// The value of a future that never waits.
pub fn ready<T>(future: impl Future<Output = T>) -> T {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => value,
        Poll::Pending => unreachable!("a store in memory never waits"),
    }
}

/// What one robot's ledger says.
#[derive(Default)]
struct Ledger {
    holder: Option<(Subject, u64)>,
    passed: BTreeMap<Subject, u64>,
    passed_twice: BTreeSet<(Subject, u64)>,
    finished: BTreeSet<Subject>,
    inside: BTreeMap<PlaceId, u64>,
    restarted: bool,
    session_epoch: u64,
}

/// STATUS of one robot.
#[derive(Default)]
struct Status {
    ring: Arc<str>,
    stored: u64,
    produced: u64,
}

/// All that was seen.
pub struct Observer {
    time: TrueTime,
    store: Arc<MemoryStore>,
    world: Option<SharedWorld>,
    seq: Seq,
    hash: u64,
    findings: Vec<String>,
    checks: BTreeMap<&'static str, u64>,
    counts: BTreeMap<String, u64>,
    tasks: BTreeMap<TaskId, TaskState>,
    requests: BTreeMap<String, TaskId>,
    attempts: BTreeMap<Subject, BTreeMap<u64, Attempt>>,
    places: BTreeMap<PlaceId, Place>,
    inbox: BTreeMap<(RobotId, Lane), (String, u64)>,
    status: BTreeMap<RobotId, Status>,
    ledgers: BTreeMap<RobotId, Ledger>,
    offers: Offers,
    grants: Grants,
    within: BTreeMap<RobotId, BTreeSet<PlaceId>>,
    changes: Changes,
    /// Robots that say what they like, whose numbers and claims are no law.
    players: BTreeMap<RobotId, Arc<Mutex<Player>>>,
    trace: bool,
}

/// A handle; clones see the same.
#[derive(Clone)]
pub struct Shared(Arc<Mutex<Observer>>);

impl Shared {
    /// A witness of `store`.
    pub fn new(time: TrueTime, store: Arc<MemoryStore>) -> Self {
        Self(Arc::new(Mutex::new(Observer::new(time, store))))
    }
    /// What it knows now.
    pub fn lock(&self) -> MutexGuard<'_, Observer> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Something was committed.
    pub fn committed(&self) {
        self.lock().committed();
    }
    /// A robot's ledger was written.
    pub fn ledger(&self, robot_id: &RobotId, ops: &[Op]) {
        self.lock().ledger(robot_id, ops);
    }
    /// STATUS was stored.
    pub fn stored(&self, frames: &[Frame]) {
        self.lock().stored(frames);
    }
    /// A robot's switch record was written.
    pub fn switched(&self, robot_id: &RobotId, switch: &Switch, set: Option<&SetManifest>) {
        self.lock().switched(robot_id, switch, set, "switch record written");
    }
    /// A robot is started from its switch record.
    pub fn starts(&self, robot_id: &RobotId, switch: &Switch, set: Option<&SetManifest>) {
        self.lock().switched(robot_id, switch, set, "program started");
    }
    /// A body begins an action of a task.
    pub fn acts(&self, robot_id: &RobotId, task_id: &TaskId, step: &StepKind) {
        self.lock().acts(robot_id, task_id, step);
    }
}

impl Observer {
    fn new(time: TrueTime, store: Arc<MemoryStore>) -> Self {
        Self {
            time,
            store,
            world: None,
            seq: Seq(0),
            hash: 0xcbf2_9ce4_8422_2325,
            findings: Vec::new(),
            checks: BTreeMap::new(),
            counts: BTreeMap::new(),
            tasks: BTreeMap::new(),
            requests: BTreeMap::new(),
            attempts: BTreeMap::new(),
            places: BTreeMap::new(),
            inbox: BTreeMap::new(),
            status: BTreeMap::new(),
            ledgers: BTreeMap::new(),
            offers: Offers::default(),
            grants: Grants::default(),
            within: BTreeMap::new(),
            changes: Changes::default(),
            players: BTreeMap::new(),
            trace: std::env::var_os("MIDSHIFT_SIM_TRACE").is_some(),
        }
    }
    /// The world of items to look at when a task changes hands.
    pub fn watch_world(&mut self, world: SharedWorld) {
        self.world = Some(world);
    }
    /// This robot says what it likes.
    pub fn behaves_badly(&mut self, player: Arc<Mutex<Player>>) {
        let robot_id = player.lock().unwrap_or_else(PoisonError::into_inner).robot_id().clone();
        self.players.insert(robot_id, player);
    }
    /// Every robot that was given this task.
    pub fn given_to(&self, task_id: &TaskId) -> BTreeSet<RobotId> {
        let attempts = self.attempts.get(&Subject::Task(task_id.clone()));
        attempts.into_iter().flat_map(BTreeMap::values).map(|a| a.robot_id.clone()).collect()
    }
    /// Places that one of these robots holds, as the rows have it.
    pub fn places_of(&self, robots: &BTreeSet<RobotId>) -> Vec<PlaceId> {
        let held = self.places.values().filter(|p| p.holders.iter().any(|h| robots.contains(&h.robot_id)));
        held.map(|p| p.place_id.clone()).collect()
    }
    /// What was found broken.
    pub fn findings(&self) -> &[String] {
        &self.findings
    }
    /// How often each law was looked at.
    pub fn checks(&self) -> &BTreeMap<&'static str, u64> {
        &self.checks
    }
    /// What was seen happen, by name.
    pub fn counts(&self) -> &BTreeMap<String, u64> {
        &self.counts
    }
    /// One number of all that was committed and written, in its order and at its time.
    pub fn hash(&self) -> u64 {
        self.hash
    }
    /// Where tasks are.
    pub fn tasks(&self) -> &BTreeMap<TaskId, TaskState> {
        &self.tasks
    }
    /// The newest attempt of each subject that is not over.
    pub fn live(&self) -> impl Iterator<Item = &Attempt> {
        self.attempts.values().flat_map(BTreeMap::values).filter(|a| !a.phase.is_terminal())
    }
    /// Whether this robot's ledger has a holder.
    pub fn is_held(&self, robot_id: &RobotId) -> bool {
        self.ledgers.get(robot_id).is_some_and(|l| l.holder.is_some())
    }
    /// The highest number of STATUS that the server has of this robot, and that the robot has on its disk.
    pub fn status(&self, robot_id: &RobotId) -> (u64, u64) {
        self.status.get(robot_id).map_or((0, 0), |s| (s.stored, s.produced))
    }
    /// The agent of this robot was started again.
    pub fn restarted(&mut self, robot_id: &RobotId) {
        self.ledgers.entry(robot_id.clone()).or_default().restarted = true;
    }
    /// Notes something that is broken.
    pub fn find(&mut self, what: String) {
        if self.findings.len() < FINDINGS_MAX {
            self.findings.push(format!("{:>9.3} s: {what}", self.time.us() as f64 / 1e6));
        }
    }
    /// Counts something that happened.
    pub fn count(&mut self, what: impl Into<String>) {
        *self.counts.entry(what.into()).or_insert(0) += 1;
    }

    /// How much of something there is at the end.
    pub fn peak(&mut self, what: String) -> &mut u64 {
        self.counts.entry(what).or_insert(0)
    }

    /// Looks at a law once.
    pub fn check(&mut self, law: &'static str, holds: bool, what: impl FnOnce() -> String) {
        *self.checks.entry(law).or_insert(0) += 1;
        if !holds {
            self.find(format!("{law}: {}", what()));
        }
    }
    fn looks(&mut self, looks: Vec<Look>) {
        for (law, holds, what) in looks {
            self.check(law, holds, || what);
        }
    }
    /// What was seen of software.
    pub fn changes(&mut self) -> &mut Changes {
        &mut self.changes
    }
    /// Looks at what must hold of software at the end.
    pub fn changes_ended(&mut self) {
        let looks = self.changes.ended();
        self.looks(looks);
    }
    fn switched(&mut self, robot_id: &RobotId, switch: &Switch, set: Option<&SetManifest>, what: &str) {
        let us = self.time.us();
        let line = format!("{us} {robot_id} {what} {switch:?}");
        if self.trace {
            print_line(&line);
        }
        self.digest(&line);
        self.count(what);
        let looks = self.changes.switched(robot_id, switch, set, us);
        self.looks(looks);
    }
    fn digest(&mut self, text: &str) {
        for byte in text.bytes() {
            self.hash = (self.hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    // --- what is committed

    fn committed(&mut self) {
        loop {
            let store = self.store.clone();
            let page = match ready(store.feed(self.seq, &Log::ALL, PAGE)) {
                Ok(page) => page,
                Err(midshift_store::Error::CursorExpired { oldest, .. }) => {
                    self.seq = oldest;
                    continue;
                }
                Err(error) => return self.find(format!("the feed cannot be read: {error}")),
            };
            for entry in &page.entries {
                self.entry(entry);
            }
            self.seq = page.next;
            if page.next >= page.head {
                break;
            }
        }
        self.hold_together();
    }

    fn entry(&mut self, entry: &Entry) {
        // Ids of sessions and requests are drawn by the process itself, and a request_id's row names that of its request.
        let secret = matches!(entry.table, Some(Table::Session | Table::TaskRequest | Table::RequestKey));
        let subject = if secret { "" } else { &*entry.subject };
        let body = entry.body.as_deref().filter(|_| !secret).unwrap_or_default();
        let line = format!("{} {subject} {} {} {body}", self.time.us(), entry.kind, entry.seq.0);
        if self.trace {
            print_line(&line);
        }
        self.digest(&line);
        match entry.table {
            Some(Table::TaskIntake) => self.decoded(entry, Self::intake),
            Some(Table::TaskState) => self.decoded(entry, Self::task),
            Some(Table::Attempt) => self.decoded(entry, Self::attempt),
            Some(Table::PlaceGrant) => self.decoded(entry, Self::place),
            Some(Table::DesiredWork) => self.decoded(entry, Self::desired),
            Some(Table::Rollout) => self.decoded(entry, Self::rollout),
            Some(Table::DrainRequest) => self.decoded(entry, |this, row| this.changes.put_request(row)),
            Some(Table::Drain) => self.decoded(entry, |this, row| this.changes.put_drain(row)),
            Some(Table::DesiredUpdate) => self.decoded(entry, |this, row: DesiredUpdate| {
                let looks = this.changes.put_desired(&row);
                this.looks(looks);
            }),
            None if entry.log == Log::RobotInbox => self.heard(entry),
            _ => {}
        }
    }

    fn decoded<R: Record>(&mut self, entry: &Entry, take: impl FnOnce(&mut Self, R)) {
        match entry.body.as_deref().map(serde_json::from_str) {
            Some(Ok(row)) => take(self, row),
            Some(Err(error)) => self.find(format!("{} {} cannot be read: {error}", entry.kind, entry.subject)),
            None => {}
        }
    }

    fn intake(&mut self, intake: TaskIntake) {
        let first = self.requests.insert(intake.request_id.clone(), intake.task_id.clone());
        self.check("I1 one task a request", first.is_none(), || format!("{intake:?} after {first:?}"));
    }

    fn task(&mut self, task: TaskState) {
        let old = self.tasks.get(&task.task_id).cloned();
        let stays = old.as_ref().is_none_or(|o| !o.phase.is_terminal() || o.phase == task.phase);
        self.check("I3 an ended task stays ended", stays, || format!("{old:?} became {task:?}"));
        let rises = old.as_ref().is_none_or(|o| o.epoch <= task.epoch);
        self.check("I2 epochs rise", rises, || format!("{old:?} became {task:?}"));
        if old.as_ref().is_none_or(|o| o.phase != task.phase) {
            let code = task.reason.as_ref().map_or("", |r| r.code.as_str());
            self.count(match task.phase {
                Phase::NeedsOperator | Phase::Failed => format!("task {} {code}", task.phase.as_str()),
                phase => format!("task {}", phase.as_str()),
            });
        }
        self.tasks.insert(task.task_id.clone(), task);
    }

    fn attempt(&mut self, attempt: Attempt) {
        if !self.players.is_empty() && attempt.attempt.subject.task_id().is_some() {
            self.stays_with_its_robot(&attempt);
        }
        let (subject, epoch) = (attempt.attempt.subject.clone(), attempt.attempt.epoch);
        let known = self.attempts.entry(subject.clone()).or_default();
        let highest = known.keys().next_back().copied().unwrap_or(0);
        let new = !known.contains_key(&epoch);
        let robot_id = attempt.robot_id.clone();
        if attempt.uncertain.is_some() && known.get(&epoch).is_none_or(|a| a.uncertain.is_none()) {
            self.count("attempt uncertain");
        }
        self.attempts.entry(subject.clone()).or_default().insert(epoch, attempt);
        if !new {
            return;
        }
        self.check("I2 epochs rise", epoch > highest, || format!("{subject}/{epoch} granted after {highest}"));
        let looks = self.changes.given(&robot_id);
        self.looks(looks);
        let Some(task_id) = subject.task_id() else { return self.count("errand given") };
        self.count(if epoch == 1 { "task given" } else { "task given again" });
        let elsewhere = self.world.clone().and_then(|world| {
            let world = lock(&world);
            let of_task = |work: &midshift_sim::journal::Work| work.task_id == *task_id;
            let mut others = world.carrying().filter(|(r, c)| **r != robot_id && c.work.as_ref().is_some_and(of_task));
            others.next().map(|(r, _)| r.clone())
        });
        self.check("I6 a load stays with its robot", elsewhere.is_none(), || {
            format!("{task_id} was given to {robot_id} while {elsewhere:?} carries its item")
        });
    }

    /// Beside players a robot has its work until it says itself that it is over: nobody else ends it, and nobody is given it before. What a
    /// person gives up is LOST.
    fn stays_with_its_robot(&mut self, new: &Attempt) {
        let of_task = self.attempts.get(&new.attempt.subject).cloned().unwrap_or_default();
        let old = of_task.get(&new.attempt.epoch);
        let ran = old.is_some_and(|old| old.accepted.is_some() && !old.phase.is_terminal());
        let ends = new.phase.is_terminal() && new.phase != AttemptPhase::Lost;
        let is_taken_away = ran && ends && self.keeps(new);
        if self.players.contains_key(&new.robot_id) {
            self.check(ONCE, !is_taken_away, || format!("its robot has it still: {new:?}"));
        } else {
            let goes_on = !is_taken_away && new.uncertain.is_none();
            self.check(GOES_ON, goes_on, || format!("its robot works on it: {new:?}"));
        }
        if old.is_none() {
            let has = |a: &&Attempt| !a.phase.is_terminal() || (a.accepted.is_some() && self.keeps(a));
            let before = of_task.values().find(has);
            self.check(ONCE, before.is_none(), || format!("{new:?} after {before:?}"));
        }
    }
    /// Whether its robot has it: an honest one by its ledger, a player if it never said otherwise.
    fn keeps(&self, a: &Attempt) -> bool {
        if let Some(player) = self.players.get(&a.robot_id) {
            return player.lock().unwrap_or_else(PoisonError::into_inner).keeps(&a.attempt);
        }
        let holder = self.ledgers.get(&a.robot_id).and_then(|ledger| ledger.holder.as_ref());
        holder.is_some_and(|(subject, epoch)| *subject == a.attempt.subject && *epoch == a.attempt.epoch)
    }

    /// What must hold of all rows together after a commit.
    fn hold_together(&mut self) {
        let mut robots: BTreeMap<RobotId, String> = BTreeMap::new();
        let mut broken = Vec::new();
        for (subject, attempts) in &self.attempts {
            let live: Vec<&Attempt> = attempts.values().rev().take(4).filter(|a| !a.phase.is_terminal()).collect();
            if live.len() > 1 {
                broken.push(format!("{subject} has {} live attempts: {live:?}", live.len()));
            }
            for attempt in live {
                let name = attempt.attempt.to_string();
                if let Some(other) = robots.insert(attempt.robot_id.clone(), name.clone()) {
                    broken.push(format!("{} holds {other} and {name}", attempt.robot_id));
                }
            }
        }
        self.check("I2 one lease a task and one holder a robot", broken.is_empty(), || broken.join("; "));
    }

    fn place(&mut self, place: Place) {
        // A grant that a player has is one of its own invention, or one that it says it is inside on.
        let of_law = |h: &&PlaceHolder| h.grant_id != 0 && !self.players.contains_key(&h.robot_id);
        let granted = place.holders.iter().filter(of_law).count();
        self.check("I7 grants within capacity", granted <= place.capacity as usize, || format!("{place:?}"));
        self.places.insert(place.place_id.clone(), place);
    }

    fn desired(&mut self, work: DesiredWork) {
        let us = self.time.us();
        if let Some(assignment) = &work.assignment {
            self.offers.give(&assignment.attempt, assignment.offer, us);
        }
        for grant in &work.grants {
            if let Some(entry) = grant.entry {
                self.grants.give(&work.robot_id, grant.grant_id, entry, us);
            }
        }
    }

    fn rollout(&mut self, row: Rollout) {
        let us = self.time.us();
        let before = self.changes.rollout(row.rollout_id.as_str()).map(|old| (old.phase, old.pauses.clone()));
        if before.as_ref().is_none_or(|(phase, _)| *phase != row.phase) {
            self.count(format!("rollout {:?}", row.phase));
        }
        let known = before.map(|(_, pauses)| pauses).unwrap_or_default();
        row.pauses.difference(&known).for_each(|pause| self.count(format!("rollout paused {pause:?}")));
        self.changes.put_rollout(row, us);
    }

    fn heard(&mut self, entry: &Entry) {
        let Some(Ok(said)) = entry.body.as_deref().map(serde_json::from_str::<InboxEntry>) else {
            return self.find(format!("an event of {} cannot be read", entry.subject));
        };
        let last = self.inbox.entry((said.robot_id.clone(), said.lane)).or_insert((said.ring.clone(), 0));
        let before = if last.0 == said.ring { last.1 } else { 0 };
        let seq = match &said.what {
            InboxItem::Sample(sample) => sample.seq,
            InboxItem::Poison { seq, .. } => *seq,
            InboxItem::Gap(gap) => gap.to_seq,
        };
        *last = (said.ring.clone(), seq);
        if self.players.contains_key(&said.robot_id) {
            return;
        }
        let gap = matches!(said.what, InboxItem::Gap(_) | InboxItem::Poison { .. });
        self.check("I9 events in order, once, without gaps", seq == before + 1 && !gap, || {
            format!("{before} was followed by {said:?}")
        });
        if let InboxItem::Sample(sample) = said.what
            && let SampleBody::Event(event) = sample.body
        {
            self.event(&said.robot_id, event);
        }
    }

    fn event(&mut self, robot_id: &RobotId, event: RobotEvent) {
        match event {
            RobotEvent::Update(UpdateEvent::Ready { drain_id, .. }) => self.changes.ready(robot_id, drain_id),
            RobotEvent::Update(UpdateEvent::Changed(report)) => {
                let code = report.reason.map(|r| format!(" {}", r.code)).unwrap_or_default();
                self.count(format!("robot {:?}{code}", report.state));
            }
            RobotEvent::StaleAuthority { what, .. } => self.count(format!("robot refused a stale {what}")),
            RobotEvent::Attempt(report) if report.state == WorkState::Refused => {
                let code = report.refusal.map_or(Code::Internal, |r| r.code);
                self.count(format!("robot refused {code}"));
            }
            RobotEvent::Fault { cleared: false, .. } => self.count("robot fault"),
            _ => {}
        }
    }

    // --- what the server keeps of STATUS

    /// Whether a robot says what it likes: the gaps that it announces are its own.
    pub fn is_player(&self, robot_id: &RobotId) -> bool {
        self.players.contains_key(robot_id)
    }
    fn stored(&mut self, frames: &[Frame]) {
        for frame in frames {
            let status = self.status.entry(frame.robot_id.clone()).or_default();
            if status.ring != frame.ring {
                (status.ring, status.stored) = (frame.ring.clone(), 0);
            }
            let before = std::mem::replace(&mut status.stored, frame.last_seq);
            self.check("I9 status in order, once, without gaps", frame.first_seq == before + 1, || {
                format!("{} {}-{} after {before}", frame.robot_id, frame.first_seq, frame.last_seq)
            });
        }
    }

    // --- what robots write

    fn ledger(&mut self, robot_id: &RobotId, ops: &[Op]) {
        let kinds: String = ops.iter().map(kind).collect::<Vec<_>>().join(",");
        let line = format!("{} {robot_id} {kinds}", self.time.us());
        if self.trace {
            print_line(&line);
        }
        self.digest(&line);
        for op in ops {
            self.op(robot_id, op);
        }
    }

    fn op(&mut self, robot_id: &RobotId, op: &Op) {
        let us = self.time.us();
        self.change(robot_id, op, us);
        let ledger = self.ledgers.entry(robot_id.clone()).or_default();
        match op {
            Op::Session(session) => {
                ledger.session_epoch = session.session_epoch;
                self.count("session begun");
            }
            Op::Epoch(subject, epoch, _) => {
                let passed = ledger.passed.entry(subject.clone()).or_insert(0);
                if *passed >= *epoch {
                    ledger.passed_twice.insert((subject.clone(), *epoch));
                }
                *passed = (*passed).max(*epoch);
            }
            Op::Finish(report, ..) if report.state == WorkState::Succeeded => {
                ledger.finished.insert(report.attempt.subject.clone());
            }
            Op::Holder(Some(holder)) => {
                let taken = (holder.attempt.subject.clone(), holder.attempt.epoch);
                if ledger.holder.as_ref() == Some(&taken) {
                    return;
                }
                let passed = ledger.passed_twice.contains(&taken);
                let finished = ledger.finished.contains(&taken.0);
                let session = ledger.session_epoch;
                ledger.holder = Some(taken);
                let attempt = &holder.attempt;
                self.check("I4 no passed epoch and no finished task is taken", !passed && !finished, || {
                    format!("{robot_id} took {attempt}: passed {passed}, finished {finished}")
                });
                let late = self.offers.judge(attempt, session, us);
                self.check("I5 no offer is taken late", late.is_none(), || {
                    format!("{robot_id} took {attempt}: {}", late.unwrap_or_default())
                });
            }
            Op::Holder(None) => ledger.holder = None,
            Op::Places(row) => {
                let entered: Vec<(PlaceId, u64)> = row.inside.iter().map(|(p, g)| (p.clone(), *g)).collect();
                let (before, restarted) = (std::mem::take(&mut ledger.inside), std::mem::take(&mut ledger.restarted));
                let session = ledger.session_epoch;
                ledger.inside.extend(entered.iter().cloned());
                for (place_id, grant_id) in entered {
                    // After a restart everything it had set out for counts as entered, whenever that was.
                    if grant_id == 0 || restarted || before.contains_key(&place_id) {
                        continue;
                    }
                    let late = self.grants.judge(robot_id, grant_id, session, us);
                    self.check("I5 no grant is used late", late.is_none(), || {
                        format!("{robot_id} entered {place_id}: {}", late.unwrap_or_default())
                    });
                }
            }
            Op::Append(Lane::Status, sample) => {
                self.status.entry(robot_id.clone()).or_default().produced = sample.seq;
            }
            Op::Free(lane, seq) => {
                let kept = match lane {
                    Lane::Status => self.status.get(robot_id).map_or(0, |s| s.stored),
                    _ => self.inbox.get(&(robot_id.clone(), *lane)).map_or(0, |(_, last)| *last),
                };
                self.check("I9 what is acknowledged is kept", *seq <= kept, || {
                    format!("{robot_id} freed {} {seq}, the server has {kept}", lane.as_str())
                });
            }
            _ => {}
        }
    }

    fn change(&mut self, robot_id: &RobotId, op: &Op, us: u64) {
        let looks = match op {
            Op::Holder(holder) => self.changes.holder(robot_id, holder.as_deref()),
            Op::Maintenance(drain_id) => {
                self.changes.maintenance(robot_id, drain_id.clone());
                return;
            }
            Op::Places(row) => {
                self.changes.places(robot_id, row.inside.keys().chain(row.committed.keys()).cloned());
                return;
            }
            Op::Software(row) => self.changes.software(robot_id, row, us),
            _ => return,
        };
        self.looks(looks);
    }

    fn acts(&mut self, robot_id: &RobotId, task_id: &TaskId, step: &StepKind) {
        let looks = self.changes.acts(robot_id);
        self.looks(looks);
        let holder = self.ledgers.get(robot_id).and_then(|l| l.holder.clone());
        let subject = Subject::Task(task_id.clone());
        let newest = self.attempts.get(&subject).and_then(|a| a.keys().next_back().copied()).unwrap_or(0);
        let own = holder.as_ref().filter(|(s, _)| *s == subject).map(|(_, epoch)| *epoch);
        self.check("I5 nobody acts after the task was given on", own == Some(newest), || {
            format!("{robot_id} begins {step:?} of {task_id} as {holder:?}, the newest epoch is {newest}")
        });
    }

    // --- where bodies are

    /// Looks at every body.
    pub fn bodies(&mut self, robots: &[SimHandle]) {
        let now = self.time.site();
        let mut full: BTreeMap<PlaceId, Vec<RobotId>> = BTreeMap::new();
        for robot in robots {
            let robot_id = robot.robot_id().clone();
            let inside: BTreeSet<PlaceId> = {
                let mut body = robot.lock();
                body.advance(now);
                body.inside().clone()
            };
            let known = self.within.remove(&robot_id).unwrap_or_default();
            let mut within = BTreeSet::new();
            for place_id in &inside {
                full.entry(place_id.clone()).or_default().push(robot_id.clone());
                let row = self.places.get(place_id).cloned();
                let held = row.as_ref().is_some_and(|p| p.holder(&robot_id).is_some());
                // Where a robot stands when it is first heard is known to the server a moment later.
                if held || known.contains(place_id) {
                    within.insert(place_id.clone());
                    self.check("I6 floor under a robot is not given away", held, || {
                        format!("{robot_id} is in {place_id}, whose row is {row:?}")
                    });
                }
            }
            self.within.insert(robot_id, within);
        }
        for (place_id, inside) in full {
            let Some(place) = self.places.get(&place_id) else { continue };
            let holds = inside.len() <= place.capacity as usize;
            self.check("I7 bodies within capacity", holds, || format!("{place_id} holds {inside:?}"));
        }
    }
}

fn kind(op: &Op) -> &'static str {
    match op {
        Op::Session(_) => "session",
        Op::Applied(_) => "applied",
        Op::Policy(_) => "policy",
        Op::Holder(_) => "holder",
        Op::Places(_) => "places",
        Op::Maintenance(_) => "maintenance",
        Op::Software(_) => "software",
        Op::Trusted(_) => "trusted",
        Op::Proven(_) => "proven",
        Op::Device(_) => "device",
        Op::Epoch(..) => "epoch",
        Op::Finish(..) => "finish",
        Op::Closed(_) => "closed",
        Op::Forget(_) => "forget",
        Op::Append(..) => "append",
        Op::Free(..) => "free",
        Op::Gap(_) => "gap",
        Op::Jump(..) => "jump",
    }
}
