//! All rows at one moment, with names for what tests ask.

use midshift_core::desired_state::{DesiredPolicy, DesiredWork};
use midshift_core::fleet::rows::{
    HoldToken, HolderState, Incident, Place, RobotAuthority, RobotControl, RobotHolder, Timer,
};
use midshift_core::ids::AttemptId;
use midshift_core::reason::Code;
use midshift_core::rows::{Key, Record, Row};
use midshift_core::task::state::Errand;
use midshift_core::task::{Attempt, Phase, TaskState};
use std::collections::BTreeMap;

pub struct Seen {
    rows: BTreeMap<Key, Row>,
}

impl Seen {
    pub fn of(rows: Vec<Row>) -> Self {
        Self { rows: rows.into_iter().map(|r| (r.key.clone(), r)).collect() }
    }
    pub fn get<R: Record>(&self, id: &str) -> Option<R> {
        self.rows.get(&Key::new(R::TABLE, id)).map(|r| r.decode().expect("a row"))
    }
    pub fn all<R: Record>(&self) -> Vec<R> {
        self.rows.values().filter(|r| r.key.table == R::TABLE).map(|r| r.decode().expect("a row")).collect()
    }
    pub fn task(&self, id: &str) -> TaskState {
        self.get(id).unwrap_or_else(|| panic!("no task {id}"))
    }
    pub fn phase(&self, id: &str) -> Phase {
        self.task(id).phase
    }
    /// Code of the task's reason.
    pub fn reason(&self, id: &str) -> Option<Code> {
        self.task(id).reason.map(|r| r.code)
    }
    /// Robot that the task is or was given to.
    pub fn robot_of(&self, id: &str) -> Option<String> {
        self.task(id).robot_id.map(|r| r.to_string())
    }
    /// The newest attempt of a task.
    pub fn attempt(&self, id: &str) -> Attempt {
        let attempt = self.task(id).attempt_id().unwrap_or_else(|| panic!("{id} was never granted"));
        self.get(&attempt.to_string()).unwrap_or_else(|| panic!("no attempt {attempt}"))
    }
    pub fn is_uncertain(&self, id: &str) -> bool {
        self.attempt(id).uncertain.is_some()
    }
    /// The attempt that holds the robot.
    pub fn holder(&self, robot: &str) -> Option<AttemptId> {
        match self.get::<RobotAuthority>(robot).map(|a| a.holder) {
            Some(RobotHolder::Attempt(id)) => Some(id),
            _ => None,
        }
    }
    pub fn is_free(&self, robot: &str) -> bool {
        self.holder(robot).is_none()
    }
    /// Kind and goal of the robot's errand.
    pub fn errand(&self, robot: &str) -> Option<(Errand, String)> {
        let a: Attempt = self.get(&self.holder(robot)?.to_string())?;
        Some((a.errand?, a.goal?.to_string()))
    }
    pub fn work(&self, robot: &str) -> DesiredWork {
        self.get(robot).unwrap_or_else(|| panic!("nothing desired of {robot}"))
    }
    /// How far the robot may drive on its route.
    pub fn released(&self, robot: &str) -> Option<u32> {
        self.work(robot).assignment?.released_index
    }
    pub fn policy(&self, robot: &str) -> DesiredPolicy {
        self.get(robot).unwrap_or_else(|| panic!("no rules for {robot}"))
    }
    pub fn place(&self, id: &str) -> Place {
        self.get(id).unwrap_or_else(|| panic!("no place {id}"))
    }
    /// Robots that hold the place, with how far they are.
    pub fn holders(&self, place: &str) -> Vec<(String, HolderState)> {
        self.place(place).holders.iter().map(|h| (h.robot_id.to_string(), h.state)).collect()
    }
    pub fn has(&self, robot: &str, place: &str) -> bool {
        self.holders(place).iter().any(|(r, _)| r == robot)
    }
    pub fn control(&self, robot: &str) -> RobotControl {
        self.get(robot).unwrap_or_else(|| panic!("no control of {robot}"))
    }
    pub fn tokens(&self, robot: &str) -> Vec<String> {
        self.all::<HoldToken>().into_iter().filter(|h| h.robot_id.as_str() == robot).map(|h| h.token).collect()
    }
    pub fn timer(&self, id: &str) -> Option<Timer> {
        self.get(id)
    }
    /// Writes of a row so far.
    pub fn revision(&self, table: &str, id: &str) -> u64 {
        let row = self.rows.iter().find(|(key, _)| key.table.name() == table && &*key.id == id);
        row.unwrap_or_else(|| panic!("no {table} {id}")).1.revision.0
    }
    pub fn incidents(&self) -> Vec<Code> {
        self.all::<Incident>().into_iter().map(|i| i.reason.code).collect()
    }
    /// Incidents with this code that nobody has closed.
    pub fn open_incidents(&self, code: &str) -> Vec<Incident> {
        let open = self.all::<Incident>().into_iter().filter(|i| i.closed.is_none());
        open.filter(|i| i.reason.code.as_str() == code).collect()
    }
    /// What a person who debugs a test wants to see.
    pub fn told(&self) -> String {
        let quiet = ["place_grant", "site", "desired_policy", "task_intake", "robot_counter"];
        let rows = self.rows.values().filter(|r| !quiet.contains(&r.key.table.name()));
        rows.map(|r| format!("{} {} r{}: {}\n", r.key.table.name(), r.key.id, r.revision.0, r.body)).collect()
    }
}
