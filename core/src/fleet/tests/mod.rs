//! A projection with robots that stand idle and tasks that wait, for tests of one cycle.

mod arrivals;
mod backlog;
mod broken_steps;
mod changes;
mod closed_places;
mod drains;
mod energy;
mod figures;
mod incidents;
mod labels;
mod lasting;
mod maps;
mod misreads;
mod opened;
mod order;
mod planner;
mod preemption;
mod robot_energy;
mod rolling;
mod same_key;
mod same_robot;
mod unexplained;

use super::projection::{FleetProjection, RevisedRow};
use super::{Board, Pace, Plan, cycle};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId, TaskId, WaypointId};
use crate::item::{Item, Write};
use crate::planner_policy::{AssignmentPolicy, PlannerPolicy};
use crate::reason::Reason;
use crate::robot::{Inventory, ReportedAttempt, ReportedState, Vitals, WorkState};
use crate::rows::{Record, Revision, Row};
use crate::session::Session;
use crate::site::{CORRIDOR, Site, text};
use crate::task::forms::Transport;
use crate::task::{AttemptPhase, RawTask, TaskIntake, TaskState};
use crate::time::{LinkTime, Now, SiteTime, Utc};
use std::sync::Arc;

/// UTC when every rig begins.
const BEGIN: Utc = Utc(1_780_000_000_000);
/// Fleet has served for so long by then, milliseconds: its timers fire.
const SERVED_MS: u64 = 60_000;

/// Fleet's projection, what robots last said, and a clock.
struct Rig {
    view: FleetProjection,
    board: Board,
    now: Now,
    number: u64,
}

impl Rig {
    fn new() -> Self {
        Self::on(CORRIDOR)
    }

    fn on(site_text: &str) -> Self {
        Self::of_site(Arc::new(text::parse(site_text).expect("a site")))
    }

    fn of_site(site: Arc<Site>) -> Self {
        let begun = Now { utc: Utc(BEGIN.0 - SERVED_MS as i64), wall: BEGIN, ..Now::default() };
        let view = FleetProjection::new(site, begun, begun);
        let now = Now { site: SiteTime(SERVED_MS), link: LinkTime(SERVED_MS), utc: BEGIN, wall: BEGIN, jump: None };
        Self { view, board: Board::new(), now, number: 0 }
    }

    /// The site's planner chooses robots like this.
    fn plan_as(&mut self, policy: AssignmentPolicy) {
        let site_id = self.view.site.site_id().clone();
        self.absorb(&PlannerPolicy { policy, ..PlannerPolicy::default_of(site_id) });
    }

    /// A robot that can pick and place, stands at `waypoint` and is heard.
    fn robot(&mut self, id: &str, waypoint: &str) {
        let robot_id = RobotId::parse(id).expect("an id");
        let inventory =
            Inventory { capabilities: vec!["pick".into(), "place".into()], payload_g: 10_000, ..Inventory::default() };
        let session = Session::new(robot_id.clone(), 1, inventory);
        self.view.sessions.insert(session.id().into(), RevisedRow { revision: Revision(1), row: session });
        let vitals = Vitals { waypoint: WaypointId::parse(waypoint).ok(), battery_permille: 900, ..Vitals::default() };
        let live = NewestHeartbeat {
            robot_id: robot_id.clone(),
            report: ReportedState { hb: 60, session_epoch: 1, vitals, ..ReportedState::default() },
            processed_at: self.now.link,
            processed_site: self.now.site,
            received_unix_ms: self.now.wall.0,
            progress_at: self.now.site,
            clock: None,
        };
        self.board.insert(robot_id, Arc::new(live));
    }

    /// Time passes, and every robot is heard again.
    fn pass(&mut self, ms: u64) {
        self.now.site.0 += ms;
        self.now.link.0 += ms;
        self.now.utc = self.now.utc.plus_ms(ms);
        self.now.wall = self.now.wall.plus_ms(ms);
        for live in self.board.values_mut() {
            let live = Arc::make_mut(live);
            live.processed_at = self.now.link;
            live.report.hb += ms / 1_000;
        }
    }

    /// A transport from A to B, as its admission by a process whose counter stands at `number` writes it.
    fn submit_as(&mut self, id: &str, number: u64, change: impl FnOnce(&mut RawTask)) {
        let form = Transport {
            kind: "transport".into(),
            from_waypoint: "A".into(),
            to_waypoint: "B".into(),
            timeout_ms: Some(600_000),
            ..Transport::default()
        };
        let mut raw = form.into_raw();
        change(&mut raw);
        let intake = TaskIntake {
            task_id: TaskId::parse(id).expect("an id"),
            spec: raw.check("task", &|_| true).expect("a valid task"),
            actor: String::new(),
            request_id: String::new(),
            payload_hash: String::new(),
            created: self.now.utc,
            number,
            type_revision: None,
        };
        self.absorb(&intake);
        self.absorb(&TaskState::born(&intake));
    }

    fn submit(&mut self, id: &str, change: impl FnOnce(&mut RawTask)) {
        self.number += 1;
        self.submit_as(id, self.number, change);
    }

    fn absorb(&mut self, record: &impl Record) {
        let row = Row { key: record.key(), revision: Revision(1), index: record.index(), body: record.body() };
        self.view.absorb(&row.key, row.revision, Some(&row)).expect("a row of ours");
    }

    /// The row as it is after somebody else's write.
    fn change(&mut self, task: &TaskState) {
        let revision = self.view.tasks.get(task.id().as_str()).expect("a task").revision.next();
        let row = Row { key: task.key(), revision, index: task.index(), body: task.body() };
        self.view.absorb(&row.key, revision, Some(&row)).expect("a row of ours");
    }

    /// Ready tasks in the order in which they are served.
    fn order(&self) -> Vec<String> {
        self.view.queue.ready().map(ToString::to_string).collect()
    }

    fn cycle(&mut self, pace: Pace) -> Plan {
        let mut plan = Plan::default();
        cycle(&mut self.view, self.now, &self.board, pace, &mut plan);
        plan
    }

    /// The robot lists an attempt, at a step and a point of its route.
    fn says(&mut self, robot_id: &RobotId, attempt: &AttemptId, state: WorkState, step_index: u32, route_index: u32) {
        let live = Arc::make_mut(self.board.get_mut(robot_id).expect("a robot"));
        let attempt = attempt.clone();
        let listed = ReportedAttempt { attempt, state, step_index, progress: 1, route_index, opened: false };
        live.report.attempts = vec![listed];
    }

    /// The robot drives for an attempt, as its row and its report say.
    fn drives(&mut self, attempt: &AttemptId) {
        let mut known = self.view.attempts.remove(attempt.to_string().as_str()).expect("a row");
        known.row.phase = AttemptPhase::Navigating;
        let robot_id = known.row.robot_id.clone();
        self.view.attempts.insert(attempt.to_string().into(), known);
        self.says(&robot_id, attempt, WorkState::Navigating, 0, 1_000);
    }

    /// Why a task is where it is.
    fn why(&self, task_id: &TaskId) -> Option<Reason> {
        let (task, intake) = self.view.task(task_id).zip(self.view.intake(task_id)).expect("a task");
        super::explanation::wait_reasons::of_task(&self.view, &self.board, &self.now, task, intake)
    }

    fn task(&self, id: &str) -> &TaskState {
        self.view.task(&TaskId::parse(id).expect("an id")).expect("a task")
    }
}

/// Tasks that items give to robots, in order.
fn given(items: &[Item]) -> Vec<String> {
    let given = items.iter().flat_map(|item| &item.rows).filter(|row| row.kind == "task.assigned");
    let put = given.filter(|row| matches!(row.write, Write::Put { .. }));
    put.map(|row| row.key.id.to_string()).collect()
}
