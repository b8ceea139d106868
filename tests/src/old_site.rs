//! Makes old sites: stores in which much is over, with the rows that the services would have left behind.
//!
//! Invariants:
//! 1. Each row is a record of `core`, written by its own service through the store's items: an old site reads back as one that grew.
//! 2. The same shape makes the same rows, whatever the engine.
//!
//! Uses nothing but `core` and `store`, so that any crate's tests can include this file.

use midshift_core::audit::Note;
use midshift_core::authority::Authority;
use midshift_core::fleet::rows::{Cordon, FleetMark, RobotControl, RobotCounter};
use midshift_core::ids::{AttemptId, RobotId, Subject, TaskId};
use midshift_core::robot::{Inventory, Lane, Presence};
use midshift_core::rollout::rows::OtaMark;
use midshift_core::rows::{Expect, Fact, Item, Log, Seq, Writer};
use midshift_core::task::forms::Transport;
use midshift_core::task::state::RequestKey;
use midshift_core::task::{Attempt, AttemptPhase, Phase, TaskIntake, TaskSpec, TaskState};
use midshift_core::time::Utc;
use midshift_core::work::{InboxEntry, InboxItem, LaneMark, PresenceRow, Session, WorkStats};
use midshift_store::{Retention, Store};
use std::sync::Arc;

/// Milliseconds of a day.
pub const DAY_MS: i64 = 86_400_000;
/// Tasks of one item: with their request_ids and second attempts it stays below the rows of one.
const TASKS_PER_ITEM: u64 = 50;
/// Items of one commit.
const ITEMS_PER_COMMIT: usize = 64;
/// Entries that each log still has: older ones went, as they do at a site.
const ENTRIES_KEPT: u64 = 20_000;

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
        let spec = spec();
        let mut items = Vec::new();
        for robot in 1..=self.robots + self.retired {
            items.extend(self.robot(robot));
        }
        for from in (1..=self.ended).step_by(TASKS_PER_ITEM as usize) {
            let numbers = from..(from + TASKS_PER_ITEM).min(self.ended + 1);
            items.extend(self.tasks(numbers, &spec));
            if items.len() >= ITEMS_PER_COMMIT {
                commit(store, std::mem::take(&mut items)).await;
                forget(store).await;
            }
        }
        commit(store, items).await;
        let head = forget(store).await;
        let mut fleet = Item::new(Writer::Fleet, "fleet");
        fleet.put(&FleetMark { seq: head }, Expect::Absent, "fleet.consumed");
        let mut ota = Item::new(Writer::Ota, "ota");
        ota.put(&OtaMark { seq: head }, Expect::Absent, "ota.consumed");
        commit(store, vec![fleet, ota]).await;
    }

    /// An item of intake, and one of each service that had to do with these tasks: fifty at most.
    pub fn tasks(&self, numbers: std::ops::Range<u64>, spec: &TaskSpec) -> Vec<Item> {
        let [mut task, mut fleet] = [Writer::Task, Writer::Fleet].map(|writer| Item::new(writer, writer.as_str()));
        let mut telemetry = Item::new(Writer::Telemetry, "telemetry");
        task.audit(Note::new("task.submit"));
        for number in numbers {
            let at = self.ended_at(number);
            let intake = intake(number, at, spec);
            let state = self.state(&intake, at);
            for epoch in 1..=state.epoch {
                fleet.create(&self.attempt(&state, epoch, at), "attempt.succeeded");
            }
            let robot = state.robot_id.as_ref().map_or("", RobotId::as_str);
            telemetry.facts.push(event(robot, number));
            let key = RequestKey {
                id: format!("submit:{}", intake.request_id),
                payload_hash: String::new(),
                task_id: Some(intake.task_id.clone()),
                at_unix_ms: at.0,
            };
            task.create(&intake, "task.admitted").create(&state, "task.admitted").create(&key, "request.answered");
        }
        vec![task, fleet, telemetry]
    }

    fn state(&self, intake: &TaskIntake, at: Utc) -> TaskState {
        let has_failed = intake.number.is_multiple_of(3);
        TaskState {
            phase: if has_failed { Phase::Failed } else { Phase::Succeeded },
            epoch: if has_failed { 2 } else { 1 },
            robot_id: Some(robot_id(1 + intake.number % self.robots.max(1))),
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
            opened: is_good,
            offered: Utc(at.0 - 60_000),
            accepted: Some(Utc(at.0 - 59_000)),
            ended: Some(at),
            fault: None,
            refusal: None,
            stats: WorkStats::default(),
            software: "1.0.0".to_owned(),
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
            attached_ms: 1,
            counted: if is_retired { self.from } else { self.until },
        };
        fleet.create(&control, "robot.retired").create(&counter, "robot.counted");
        let presence =
            PresenceRow { robot_id: robot_id.clone(), presence: Presence::Offline, since_unix_ms: self.from.0 };
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

fn intake(number: u64, ended: Utc, spec: &TaskSpec) -> TaskIntake {
    TaskIntake {
        task_id: task_id(number),
        spec: spec.clone(),
        actor: "wms".to_owned(),
        request_id: format!("old-request-{number}"),
        payload_hash: String::new(),
        created: Utc(ended.0 - 120_000),
        number,
    }
}

fn session(robot_id: RobotId, from: Utc) -> Session {
    Session {
        robot_id,
        session_epoch: from.0.unsigned_abs(),
        secret: "secret".into(),
        boot_id: "boot".to_owned(),
        ring: "ring".to_owned(),
        inventory: Inventory { software: "1.0.0".to_owned(), ..Inventory::default() },
        applied_work: 0,
        applied_update: 0,
        places: Vec::new(),
        clock_offset_ms: None,
        installed: None,
        device_key: None,
        device_key_changed: false,
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
