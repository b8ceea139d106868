//! Makes old sites: stores in which much is over, with the rows that the services would have left behind.
//!
//! Invariants:
//! 1. Each row is a record of `core`, in an item of its own service: an old site reads back as one that grew.
//! 2. The same shape makes the same rows, whatever the engine.
//!
//! [`OldSite::write`] commits all of them. `old_tables` puts most tasks straight into the tables of a database, which is faster.
//!
//! Uses nothing but `core` and `store`, so that any crate's tests can include this file.

use midshift_core::audit::Note;
use midshift_core::authority::Authority;
use midshift_core::fleet::rows::{Cordon, FleetMark, RobotControl, RobotCounter};
use midshift_core::gates::TaskTally;
use midshift_core::ids::{AttemptId, BundleId, RobotId, RolloutId, Subject, TaskId};
use midshift_core::item::{Expect, Fact, Item};
use midshift_core::presence::Presence;
use midshift_core::presence::PresenceRow;
use midshift_core::robot::{Inventory, Lane};
use midshift_core::robot_events::{InboxEntry, InboxItem, WorkStats};
use midshift_core::rollout::rows::{
    Act, Bundle, OtaMark, Phase as RolloutPhase, RobotSoftware, Rollout, RolloutRobot, Step,
};
use midshift_core::rollout::spec::RolloutSpec;
use midshift_core::rows::{Log, Seq, Writer};
use midshift_core::session::{LaneMark, Session};
use midshift_core::task::forms::Transport;
use midshift_core::task::requests::RequestKey;
use midshift_core::task::{Attempt, AttemptPhase, Phase, TaskIntake, TaskSpec, TaskState};
use midshift_core::time::Utc;
use midshift_store::{Retention, Store};
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

/// Milliseconds of a day.
pub const DAY_MS: i64 = 86_400_000;
/// Tasks of one item: with their request_ids and second attempts it stays below the rows of one.
const TASKS_PER_ITEM: u64 = 50;
/// Items of one commit.
const ITEMS_PER_COMMIT: usize = 64;
/// Entries that each log still has: older ones went, as they do at a site.
pub const ENTRIES_KEPT: u64 = 20_000;
/// Roll-outs that are over, one every two days or so: each robot that works kept the bundle of each.
pub const ROLLOUTS: u64 = 12;

/// What an old site is made of.
#[derive(Clone, Copy, Debug)]
pub struct OldSite {
    /// Tasks that have ended, `old-1` the first. Every third has failed, at its second attempt.
    pub ended: u64,
    /// Robots that did them, `old-r1` the first; each has a session, a mark of its ring, and a counter of its software.
    pub robots: u64,
    /// Robots beside them that were retired when the first task ended.
    pub retired: u64,
    /// When the first task ended, UTC.
    pub from: Utc,
    /// When the last one ended.
    pub until: Utc,
}

impl OldSite {
    /// `ended` tasks of the 29 days before `now`, done by fifty robots; eight more were retired.
    pub fn with_ended(ended: u64, now: Utc) -> Self {
        Self { ended, robots: 50, retired: 8, from: Utc(now.0 - 29 * DAY_MS), until: Utc(now.0 - 1) }
    }

    /// When the task of this number ended.
    pub fn ended_at(&self, number: u64) -> Utc {
        let span = i128::from(self.until.0 - self.from.0);
        let passed = span * i128::from(number.saturating_sub(1)) / i128::from(self.ended.max(1));
        Utc(self.from.0 + i64::try_from(passed).unwrap_or_default())
    }

    /// Writes all of it into an empty store. Fleet and ota have read its log.
    ///
    /// # Panics
    /// If the store refuses a row.
    pub async fn write(&self, store: &dyn Store) {
        self.begin(store).await;
        self.write_tasks(store, 1..=self.ended).await;
        self.finish(store).await;
    }

    /// Writes robots, and what they once got of software.
    pub async fn begin(&self, store: &dyn Store) {
        let mut items: Vec<Item> = (1..=self.robots + self.retired).flat_map(|robot| self.robot(robot)).collect();
        items.extend((1..=ROLLOUTS).map(|number| self.rollout(number)));
        commit(store, items).await;
    }

    /// Writes these tasks, as services do: with their entries in the logs, in the audit and in the inbox.
    pub async fn write_tasks(&self, store: &dyn Store, numbers: RangeInclusive<u64>) {
        let spec = spec();
        let mut items = Vec::new();
        for numbers in Self::slices(numbers) {
            items.extend(self.tasks(numbers, &spec));
            if items.len() >= ITEMS_PER_COMMIT {
                commit(store, std::mem::take(&mut items)).await;
                forget(store).await;
            }
        }
        commit(store, items).await;
    }

    /// Lets old entries go. Fleet and ota have read what is left.
    pub async fn finish(&self, store: &dyn Store) {
        let head = forget(store).await;
        let mut fleet = Item::new(Writer::Fleet, "fleet");
        fleet.put_row(&FleetMark { seq: head }, Expect::Absent, "fleet.consumed");
        let mut ota = Item::new(Writer::Ota, "ota");
        ota.put_row(&OtaMark { seq: head }, Expect::Absent, "ota.consumed");
        commit(store, vec![fleet, ota]).await;
    }

    /// Tasks of one item each.
    pub fn slices(numbers: RangeInclusive<u64>) -> impl Iterator<Item = Range<u64>> {
        let end = numbers.end() + 1;
        numbers.step_by(TASKS_PER_ITEM as usize).map(move |from| from..(from + TASKS_PER_ITEM).min(end))
    }

    /// An item of each service that had to do with these tasks: fifty at most.
    pub fn tasks(&self, numbers: Range<u64>, spec: &TaskSpec) -> Vec<Item> {
        let [mut task, fleet] = self.rows(numbers.clone(), spec);
        task.audit(submitted());
        vec![task, fleet, self.inbox(numbers)]
    }

    /// The rows of intake and of fleet of these tasks.
    pub fn rows(&self, numbers: Range<u64>, spec: &TaskSpec) -> [Item; 2] {
        let [mut task, mut fleet] = [Writer::Task, Writer::Fleet].map(|writer| Item::new(writer, writer.as_str()));
        for number in numbers {
            let at = self.ended_at(number);
            let intake = intake(number, at, spec);
            let state = self.state(&intake, at);
            for epoch in 1..=state.epoch {
                fleet.create(&self.attempt(&state, epoch, at), "attempt.succeeded");
            }
            let key = RequestKey {
                id: format!("submit:{}", intake.request_id),
                payload_hash: String::new(),
                task_id: Some(intake.task_id.clone()),
                request: None,
                at_unix_ms: at.0,
            };
            task.create(&intake, "task.admitted").create(&state, "task.admitted").create(&key, "request.answered");
        }
        [task, fleet]
    }

    /// What the robots of these tasks told.
    pub fn inbox(&self, numbers: Range<u64>) -> Item {
        let mut telemetry = Item::new(Writer::Telemetry, "telemetry");
        telemetry.facts = numbers.map(|number| event(self.robot_of(number).as_str(), number)).collect();
        telemetry
    }

    fn robot_of(&self, number: u64) -> RobotId {
        robot_id(1 + number % self.robots.max(1))
    }

    /// A roll-out by which each robot that works got its bundle; the last one's is what they run.
    pub fn rollout(&self, number: u64) -> Item {
        let at = Utc(self.from.0 + 2 * DAY_MS * number as i64);
        let act = Act { actor: "anna".to_owned(), person: None, reason: String::new(), at };
        let bundle = bundle(number);
        let rollout_id = RolloutId::parse(&format!("old-rollout-{number}")).expect("an id");
        let mut ota = Item::new(Writer::Ota, "ota");
        ota.create(&release(bundle.clone(), number, at), "bundle.published");
        ota.create(&completed(&rollout_id, &bundle, act), "rollout.completed");
        for place in 1..=self.robots {
            ota.create(&committed(&rollout_id, robot_id(place), place, at), "rollout_robot.committed");
            if number == ROLLOUTS {
                let mut software = RobotSoftware::new(robot_id(place));
                software.committed = Some(bundle.clone());
                software.previous = Some(self::bundle(number - 1));
                software.version = version(number);
                software.since = at;
                ota.create(&software, "software.reported");
            }
        }
        ota
    }

    fn state(&self, intake: &TaskIntake, at: Utc) -> TaskState {
        let has_failed = intake.number.is_multiple_of(3);
        TaskState {
            phase: if has_failed { Phase::Failed } else { Phase::Succeeded },
            epoch: if has_failed { 2 } else { 1 },
            robot_id: Some(self.robot_of(intake.number)),
            next_step: if has_failed { 0 } else { intake.spec.steps.len() as u32 },
            ended: Some(at),
            changed: at,
            ..TaskState::born(intake)
        }
    }

    fn attempt(&self, state: &TaskState, epoch: u64, at: Utc) -> Attempt {
        let is_good = state.phase == Phase::Succeeded;
        Attempt {
            attempt: AttemptId { subject: Subject::Task(state.task_id.clone()), epoch },
            robot_id: state.robot_id.clone().unwrap_or_else(|| robot_id(1)),
            errand: None,
            goal: None,
            phase: if is_good { AttemptPhase::Succeeded } else { AttemptPhase::Failed },
            uncertain: None,
            offer: Authority { session_epoch: 1, hb: 1, valid_ms: 30_000 },
            step_index: state.next_step,
            reported: None,
            is_opened: is_good,
            offered: Utc(at.0 - 60_000),
            accepted: Some(Utc(at.0 - 59_000)),
            ended: Some(at),
            fault: None,
            refusal: None,
            stats: WorkStats::default(),
            software: "1.0.0".to_owned(),
            visited: None,
        }
    }

    /// What is known of a robot; those beyond the ones that work were retired when the first task ended.
    pub fn robot(&self, number: u64) -> Vec<Item> {
        let robot_id = robot_id(number);
        let is_retired = number > self.robots;
        let [mut fleet, mut telemetry] = [Writer::Fleet, Writer::Telemetry].map(|w| Item::new(w, w.as_str()));
        let mut control = RobotControl::new(robot_id.clone());
        let why = Cordon { reason: "sold".to_owned(), actor: "anna".to_owned(), since: self.from };
        control.retired = is_retired.then_some(why);
        let counter = RobotCounter {
            robot_id: robot_id.clone(),
            software: "1.0.0".to_owned(),
            succeeded: self.ended / self.robots.max(1),
            failures: Default::default(),
            stats: WorkStats::default(),
            errands: WorkStats::default(),
            attached_ms: 1,
            counted: if is_retired { self.from } else { self.until },
            energy_sums: Default::default(),
        };
        fleet.create(&control, "robot.retired").create(&counter, "robot.counted");
        let presence = PresenceRow::new(robot_id.clone(), Presence::Offline, self.from.0);
        let mark = LaneMark { event: 1, at_unix_ms: self.until.0, ..LaneMark::fresh(robot_id.clone(), "ring") };
        telemetry.create(&presence, "presence.offline").create(&mark, "lane.durable");
        telemetry.create(&session(robot_id, self.from), "session.begun");
        vec![fleet, telemetry]
    }
}

/// The robot of this number.
pub fn robot_id(number: u64) -> RobotId {
    RobotId::parse(&format!("old-r{number}")).expect("an id")
}

/// The task of this number.
pub fn task_id(number: u64) -> TaskId {
    TaskId::parse(&format!("old-{number}")).expect("an id")
}

/// What each of the tasks asked for.
pub fn spec() -> TaskSpec {
    let transport = Transport {
        kind: "transport".to_owned(),
        from_waypoint: "A".to_owned(),
        to_waypoint: "B".to_owned(),
        timeout_ms: Some(3_600_000),
        ..Transport::default()
    };
    transport.into_raw().check("task", &|_| true).expect("a good task")
}

/// What intake notes of a request that admits tasks.
pub fn submitted() -> Note {
    Note::new("task.submit")
}

fn bundle(number: u64) -> BundleId {
    BundleId::parse(&format!("{number:064x}")).expect("an id")
}

fn version(number: u64) -> String {
    format!("1.{number}.0")
}

fn release(bundle: BundleId, number: u64, at: Utc) -> Bundle {
    Bundle {
        bundle,
        name: "agent".to_owned(),
        version: version(number),
        manifest_length: 1_000,
        length: 1_000_000,
        room: 0,
        hardware: Default::default(),
        needs: "restart".to_owned(),
        hard_stop_codes: Default::default(),
        is_irreversible: false,
        has_base: false,
        requires: Default::default(),
        rollback_index: None,
        listed: false,
        revoked: None,
        published: at,
        ended: Some(at),
    }
}

fn completed(rollout_id: &RolloutId, bundle: &BundleId, act: Act) -> Rollout {
    Rollout {
        rollout_id: rollout_id.clone(),
        spec: Arc::new(RolloutSpec::new(bundle.clone())),
        phase: RolloutPhase::Completed,
        wave: 2,
        pauses: Default::default(),
        version: 9,
        generation: 1,
        in_flight: 0,
        soak: None,
        exposure: None,
        wave_sizes: Vec::new(),
        promoted: 3,
        verdicts: Vec::new(),
        abort: None,
        second_pass: false,
        revert_of: None,
        supersedes: Default::default(),
        superseded_by: None,
        tasks: Default::default(),
        counted: Default::default(),
        efforts: Default::default(),
        created: act.clone(),
        approved: Some(act.clone()),
        started: Some(act.at),
        resumed: None,
        since: act.at,
        outcome: None,
        refusals_seen: Default::default(),
    }
}

fn committed(rollout_id: &RolloutId, robot_id: RobotId, place: u64, at: Utc) -> RolloutRobot {
    RolloutRobot {
        rollout_id: rollout_id.clone(),
        robot_id,
        wave: 2,
        rank: place,
        step: Step::Committed,
        since: at,
        from_version: String::new(),
        directive_generation: 1,
        signed: at,
        way_back: Default::default(),
        drain_id: None,
        ready: false,
        grant: None,
        not_used: false,
        attempted: true,
        failure: None,
        why: None,
        again: false,
        before: TaskTally::default(),
        effort_before: Default::default(),
        moments: Default::default(),
        lost: None,
    }
}

fn intake(number: u64, ended: Utc, spec: &TaskSpec) -> TaskIntake {
    TaskIntake {
        task_id: task_id(number),
        spec: spec.clone(),
        actor: "wms".to_owned(),
        request_id: format!("old-request-{number}"),
        payload_hash: String::new(),
        created: Utc(ended.0 - 120_000),
        number,
        type_revision: None,
    }
}

fn session(robot_id: RobotId, from: Utc) -> Session {
    let inventory = Inventory { software: "1.0.0".to_owned(), ..Inventory::default() };
    Session {
        secret: "secret".into(),
        boot_id: "boot".to_owned(),
        ring: "ring".to_owned(),
        ..Session::new(robot_id, from.0.unsigned_abs(), inventory)
    }
}

fn event(robot_id: &str, seq: u64) -> Fact {
    let entry = InboxEntry {
        robot_id: RobotId::parse(robot_id).expect("an id"),
        session_epoch: 1,
        ring: "ring".to_owned(),
        lane: Lane::Event,
        what: InboxItem::Poison { seq, detail: "old".to_owned() },
        stamp_in_future: false,
    };
    let body = serde_json::to_string(&entry).expect("plain data");
    Fact { log: Log::RobotInbox, subject: Arc::from(robot_id), kind: "robot.poison", body: Arc::from(body) }
}

/// Lets all entries go but the newest; the head.
async fn forget(store: &dyn Store) -> Seq {
    let floor = *store.wake().borrow();
    let keep = Retention { before_unix_ms: i64::MIN, entries_max: ENTRIES_KEPT, floor };
    store.prune(keep).await.expect("prunes");
    floor
}

/// Writes items into a store that has none of their rows.
pub async fn commit(store: &dyn Store, items: Vec<Item>) {
    for applied in store.commit(items).await {
        applied.expect("an empty store takes all of it");
    }
}
