//! The services of a shift in one process: intake, telemetry and fleet's reconciler, all real, on the model of the store.
//!
//! Left out are what serves no work: the port, identity, roll-outs, stops, housekeeping, and the files of a disk.

use super::background_task::BackgroundTask;
use super::clock::VirtualClock;
use super::plan_log::{PlanLog, PlannerPace};
use super::task_records::TaskRecords;
use anyhow::Context;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::limits;
use midshift_core::site::Site;
use midshift_core::time::Clock;
use midshift_fleet::FleetService;
use midshift_proto::access::local;
use midshift_proto::fleet::v1::fleet_service_server::FleetService as Face;
use midshift_proto::fleet::v1::{
    AreaPolicy, ClearPlaceRequest, Duty, ExplainRobotRequest, ExplainTaskRequest, GetAreaPolicyRequest,
    ListPlacesRequest, ListRobotControlsRequest, Place, PlannerPolicy, PutAreaPolicyRequest, PutPlannerRequest,
    RobotExplanation, TaskExplanation, UncordonRobotRequest,
};
use midshift_store::{LiveBoard, MemoryFrames, MemoryStore, Store, StoreId};
use midshift_task::TaskService;
use midshift_telemetry::TelemetryService;
use std::sync::Arc;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// Bytes of STATUS that are kept: nobody reads it.
const FRAME_BYTES: u64 = 1 << 20;
/// Entries that each log keeps: far more than any reader is behind.
const LOG_ENTRIES: usize = 20_000;

/// A planner that runs.
struct Planner {
    task: BackgroundTask,
    /// What people ask. A planner ends once nobody can ask it any more.
    face: FleetService,
}

/// The services.
pub struct ControlPlane {
    /// Intake of tasks.
    pub tasks: TaskService,
    /// Sessions of robots.
    pub telemetry: TelemetryService,
    /// The store as the planner sees it.
    pub plan_log: Arc<PlanLog>,
    site: Arc<Site>,
    site_text: String,
    clock: Arc<VirtualClock>,
    board: Arc<LiveBoard<NewestHeartbeat>>,
    sessions: BackgroundTask,
    planner: Option<Planner>,
}

impl ControlPlane {
    /// Opens a site with an empty store and starts everything.
    ///
    /// # Errors
    /// If the store cannot be read.
    pub async fn open(
        site: Arc<Site>,
        site_text: String,
        clock: Arc<VirtualClock>,
        records: Arc<TaskRecords>,
        pace: PlannerPace,
    ) -> anyhow::Result<Self> {
        let store_id = StoreId(Arc::from("shift"));
        let any_clock: Arc<dyn Clock> = clock.clone();
        let model = MemoryStore::new(site.site_id().clone(), store_id, any_clock.clone());
        let model = Arc::new(model.with_log_entries_max(LOG_ENTRIES));
        let store: Arc<dyn Store> = model.clone();
        let plan_log = Arc::new(PlanLog::new(model, clock.clone(), records, pace));
        let board = LiveBoard::new();
        let parts = midshift_telemetry::Parts {
            store: store.clone(),
            frames: Arc::new(MemoryFrames::new(any_clock.clone(), FRAME_BYTES)),
            board: board.clone(),
            heard: None,
            clock: any_clock.clone(),
            bugs: Default::default(),
        };
        let telemetry = TelemetryService::new(parts, CancellationToken::new());
        let running = telemetry.clone().run();
        let sessions = BackgroundTask::spawn("telemetry", |_| async move { Ok(running.await?) });
        let parts = midshift_task::Parts { store, site: site.clone(), clock: any_clock, bugs: Default::default() };
        let tasks = TaskService::open(parts, CancellationToken::new()).await?;
        let mut plane = Self { tasks, telemetry, plan_log, site, site_text, clock, board, sessions, planner: None };
        plane.start_planner();
        Ok(plane)
    }

    /// Starts fleet's reconciler, if it does not run.
    pub fn start_planner(&mut self) {
        if self.planner.is_some() {
            return;
        }
        let parts = midshift_fleet::Parts {
            store: self.plan_log.clone(),
            board: self.board.clone(),
            site: self.site.clone(),
            site_text: self.site_text.clone(),
            map: Default::default(),
            clock: self.clock.clone(),
            bugs: Default::default(),
        };
        let (face, reconciler) = FleetService::new(parts);
        let task = BackgroundTask::spawn("the planner", |ends| async move { Ok(reconciler.run(ends).await?) });
        self.planner = Some(Planner { task, face });
    }

    /// Whether nobody plans.
    pub fn is_planner_away(&self) -> bool {
        self.planner.is_none()
    }

    /// Ends fleet's reconciler, as when its process is stopped.
    ///
    /// # Errors
    /// It had failed before.
    pub async fn stop_planner(&mut self) -> anyhow::Result<()> {
        match self.planner.take() {
            Some(planner) => planner.task.stop().await,
            None => Ok(()),
        }
    }

    /// Puts another policy for each area for which there is one, as a person does.
    ///
    /// # Errors
    /// A policy that is refused, or there is no planner that could take it.
    pub async fn change_policies(&self, change: impl Fn(AreaPolicy) -> Option<AreaPolicy>) -> anyhow::Result<()> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        for area in self.site.areas() {
            let asked = GetAreaPolicyRequest { area_id: area.area_id.to_string() };
            let policy = face.get_area_policy(local(asked)).await?.into_inner().policy.unwrap_or_default();
            if let Some(policy) = change(policy) {
                let put = PutAreaPolicyRequest { policy: Some(policy), ..PutAreaPolicyRequest::default() };
                face.put_area_policy(local(put)).await?;
            }
        }
        Ok(())
    }

    /// Places that robots hold, as an operator lists them.
    ///
    /// # Errors
    /// There is no planner that could say so.
    pub async fn list_held_places(&self) -> anyhow::Result<Vec<Place>> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        let request = ListPlacesRequest { in_use: true, page_size: limits::PAGE_MAX as u32, ..Default::default() };
        Ok(face.list_places(local(request)).await?.into_inner().places)
    }

    /// Clears a place, as the operator does who has looked.
    ///
    /// # Errors
    /// It is refused.
    pub async fn clear_place(&self, place: &Place) -> anyhow::Result<()> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        let (place_id, etag) = (place.place_id.clone(), place.etag.clone());
        let reason = "looked: the robot is not there".to_owned();
        face.clear_place(local(ClearPlaceRequest { place_id, etag, reason, ..Default::default() })).await?;
        Ok(())
    }

    /// Robots that their breaker took out of work.
    ///
    /// # Errors
    /// There is no planner that could say so.
    pub async fn list_broken_off(&self) -> anyhow::Result<Vec<String>> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        let mut broken_off = Vec::new();
        let mut request = ListRobotControlsRequest { page_size: limits::PAGE_MAX as u32, ..Default::default() };
        loop {
            let page = face.list_robot_controls(local(request.clone())).await?.into_inner();
            let controls = page.controls.into_iter().filter(|control| control.duty() == Duty::BrokenOff);
            broken_off.extend(controls.map(|control| control.robot_id));
            if page.next_page_token.is_empty() {
                return Ok(broken_off);
            }
            request.page_token = page.next_page_token;
        }
    }

    /// Lets a robot work again, as the operator does who has looked at it.
    ///
    /// # Errors
    /// It is refused.
    pub async fn reinstate_robot(&self, robot_id: String) -> anyhow::Result<()> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        face.uncordon_robot(local(UncordonRobotRequest { robot_id, ..Default::default() })).await?;
        Ok(())
    }

    /// Why a robot does what it does.
    ///
    /// # Errors
    /// There is no planner that could say so, or it does not know the robot.
    pub async fn explain_robot(&self, robot_id: &RobotId) -> anyhow::Result<RobotExplanation> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        let request = ExplainRobotRequest { robot_id: robot_id.to_string() };
        Ok(face.explain_robot(local(request)).await?.into_inner().explanation.unwrap_or_default())
    }

    /// Why each of these tasks is where it is. All are asked at once, so that one turn of the planner answers many. One
    /// that the planner does not know yet is left out.
    ///
    /// # Errors
    /// There is no planner that could say so.
    pub async fn explain_tasks(&self, task_ids: impl Iterator<Item = &TaskId>) -> anyhow::Result<Vec<TaskExplanation>> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        let mut asked = JoinSet::new();
        for task_id in task_ids {
            let (face, request) = (face.clone(), ExplainTaskRequest { task_id: task_id.to_string() });
            asked.spawn(async move { face.explain_task(local(request)).await });
        }
        let answers = asked.join_all().await.into_iter().flatten();
        Ok(answers.filter_map(|answer| answer.into_inner().explanation).collect())
    }

    /// Resolves with why, if a service fails: the shift is over then.
    pub async fn await_failure(&mut self) -> anyhow::Error {
        let planner = async {
            match &mut self.planner {
                Some(planner) => planner.task.await_failure().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            failed = planner => failed,
            failed = self.sessions.await_failure() => failed,
        }
    }

    /// Puts how robots are chosen, as a person does.
    ///
    /// # Errors
    /// It is refused, or the planner is away.
    pub async fn put_planner(&self, policy: PlannerPolicy) -> anyhow::Result<()> {
        let face = &self.planner.as_ref().context("the planner is away")?.face;
        face.put_planner(local(PutPlannerRequest { policy: Some(policy), ..PutPlannerRequest::default() })).await?;
        Ok(())
    }
}
