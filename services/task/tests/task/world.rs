//! A service over a store in memory, and somebody who plays fleet: either by core's own law or row by row.

use midshift_core::fleet::projection::{self, FleetProjection};
use midshift_core::fleet::rows::HoldToken;
use midshift_core::fleet::{Board, LOGS, Plan, absorb};
use midshift_core::identity::RobotIdentity;
use midshift_core::ids::{AttemptId, RobotId, SiteId, StopId, Subject, TaskId};
use midshift_core::item::Item;
use midshift_core::robot::StopLevel;
use midshift_core::rows::{Key, Record, Revision, Seq, Writer};
use midshift_core::site::{DEMO, Site, text};
use midshift_core::stop::record::StopRecord;
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_core::task::bugs::Bugs;
use midshift_core::task::{Attempt, AttemptPhase, Phase, TaskState};
use midshift_core::time::{Clock, Now, SiteTime, Utc};
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_request::Body, watch_tasks_response};
use midshift_store::{MemoryStore, Store, StoreId, load};
use midshift_task::{Parts, TaskService};
use std::sync::Arc;
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

/// 2027-01-15, 08:00 UTC.
pub const NOON: Utc = Utc(1_800_000_000_000);

struct At(Utc);

impl Clock for At {
    fn now(&self) -> Now {
        Now { site: SiteTime(1_000), utc: self.0, wall: self.0, ..Now::default() }
    }
    fn rate_permille(&self) -> u32 {
        1000
    }
}

pub struct World {
    pub store: Arc<MemoryStore>,
    pub service: TaskService,
    pub site: Arc<Site>,
    pub shutdown: CancellationToken,
}

impl World {
    pub async fn new() -> Self {
        Self::keeping(200_000).await
    }
    /// A world whose logs keep so many entries.
    pub async fn keeping(entries: usize) -> Self {
        let site = Arc::new(text::parse(DEMO).expect("the demo parses"));
        let site_id = SiteId::parse("demo").expect("a valid id");
        let store = MemoryStore::new(site_id, StoreId(Arc::from("store-1")), Arc::new(At(NOON)));
        Self::over(Arc::new(store.with_log_entries_max(entries)), site).await
    }
    /// The service started anew over a store, with a site.
    pub async fn over(store: Arc<MemoryStore>, site: Arc<Site>) -> Self {
        Self::with(store, site, Bugs::default()).await
    }
    /// As [`World::over`], with naive rules.
    pub async fn with(store: Arc<MemoryStore>, site: Arc<Site>, bugs: Bugs) -> Self {
        let shutdown = CancellationToken::new();
        let parts = Parts { store: store.clone(), site: site.clone(), clock: Arc::new(At(NOON)), bugs };
        let service = TaskService::open(parts, shutdown.clone()).await.expect("a store opens");
        Self { store, service, site, shutdown }
    }
    /// The clock that stands at noon.
    pub fn clock(&self) -> Arc<dyn Clock> {
        Arc::new(At(NOON))
    }
    /// The service as it is so many milliseconds after noon.
    pub async fn later(&self, ms: i64) -> TaskService {
        let clock = Arc::new(At(Utc(NOON.0 + ms)));
        let parts = Parts { store: self.store.clone(), site: self.site.clone(), clock, bugs: Bugs::default() };
        TaskService::open(parts, self.shutdown.clone()).await.expect("a store opens")
    }
    /// A client that calls the service in this process, through its codec.
    pub fn client(&self) -> TaskServiceClient<Routes> {
        TaskServiceClient::new(self.service.add_to(Routes::default()))
    }
    pub async fn get(&self, task_id: &str) -> v1::Task {
        let request = v1::GetTaskRequest { task_id: task_id.to_owned() };
        self.service.get_task(local(request)).await.expect("a task").into_inner().task.expect("always set")
    }
    pub async fn state(&self, task_id: &str) -> (TaskState, Revision) {
        load(self.store.as_ref(), task_id).await.expect("a store that answers").expect("a task")
    }
    /// Fleet obeys everything that is new, once.
    pub async fn fleet_turns(&self) {
        let now = At(NOON).now();
        let mut view = FleetProjection::new(self.site.clone(), now, now);
        let snapshot = self.store.read(&projection::alive(), projection::named).await.expect("a snapshot");
        view.load(&snapshot.rows, snapshot.seq).expect("rows that can be read");
        let begin = view.marks.get("fleet").map_or(NOON_SEQ, |m| m.row.seq);
        let page = self.store.feed(begin, LOGS, 5_000).await.expect("a feed");
        let mut plan = Plan::default();
        absorb(&mut view, now, &Board::new(), &page.entries, &mut plan);
        for applied in self.store.commit(plan.items).await {
            applied.expect("fleet is alone here");
        }
    }
    /// Fleet obeys as soon as something is committed after `seq`.
    pub async fn fleet_turns_after(&self, seq: Seq) {
        self.store_moves_after(seq).await;
        self.fleet_turns().await;
    }
    pub async fn store_moves_after(&self, seq: Seq) {
        self.store.wake().wait_for(|head| *head > seq).await.expect("an open store");
    }
    pub fn head(&self) -> Seq {
        *self.store.wake().borrow()
    }
    /// Fleet writes rows of a task in one item, the attempt first, as its law does.
    pub async fn fleet_writes(&self, task: &TaskState, attempt: Option<&Attempt>) {
        let store = self.store.as_ref();
        let mut item = Item::new(Writer::Fleet, "fleet");
        if let Some(attempt) = attempt {
            match load::<Attempt>(store, &attempt.id()).await.expect("a store that answers") {
                Some((_, revision)) => item.update(attempt, revision, "attempt.changed"),
                None => item.create(attempt, "attempt.created"),
            };
        }
        let (_, revision) = self.state(&task.id()).await;
        item.update(task, revision, "task.changed");
        self.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    }
    /// Robots that are enrolled.
    pub async fn enrols(&self, robots: &[&str]) {
        let mut item = Item::new(Writer::Identity, "anna");
        for robot in robots {
            let robot = RobotIdentity::new(RobotId::parse(robot).expect("an id"));
            item.create(&robot, "robot.enrolled");
        }
        self.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    }
    /// The copy of a fleet stop that was engaged, and reset if so.
    pub async fn copies_stop(&self, stop_id: &str, is_reset: bool) {
        let stop_id = StopId::parse(stop_id).expect("an id");
        let reset = Reset::new(stop_id.clone(), NOON);
        let stop = Stop::new(stop_id, Scope::Fleet, StopLevel::Halt, NOON);
        let mut item = Item::new(Writer::Stop, "stop-follower");
        item.create(&StopRecord { stop, reset: is_reset.then_some(reset) }, "stop.copied");
        self.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    }
    /// Fleet takes one token of r1 away, if any, and writes the other.
    pub async fn fleet_holds(&self, old: Option<&str>, token: &str) {
        let robot_id = RobotId::parse("r1").expect("an id");
        let mut item = Item::new(Writer::Fleet, "fleet");
        if let Some(old) = old.map(|old| HoldToken::id_of(&robot_id, old)) {
            let (_, revision) =
                load::<HoldToken>(self.store.as_ref(), &old).await.expect("a store that answers").expect("a token");
            item.delete(Key::new(HoldToken::TABLE, old), revision, "hold.replaced");
        }
        item.create(&HoldToken { robot_id, token: token.to_owned(), since: NOON }, "hold.stopped");
        self.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    }
    /// Fleet gives the task to a robot that works on it.
    pub async fn runs(&self, task_id: &str, epoch: u64) -> (TaskState, Attempt) {
        let (mut task, _) = self.state(task_id).await;
        let attempt = attempt(&task.task_id, epoch, AttemptPhase::Navigating);
        (task.phase, task.epoch, task.robot_id) = (Phase::Running, epoch, Some(attempt.robot_id.clone()));
        self.fleet_writes(&task, Some(&attempt)).await;
        (task, attempt)
    }
    pub async fn watch(&self, filter: Option<v1::TaskFilter>, cursor: &str) -> Watch {
        let request = v1::WatchTasksRequest { filter, cursor: cursor.to_owned() };
        let stream = self.service.watch_tasks(local(request)).await.expect("a watch").into_inner();
        Watch::over(stream)
    }
}

/// Where the numbers of a store begin.
const NOON_SEQ: Seq = Seq(NOON.0.unsigned_abs());

type Message = Result<v1::WatchTasksResponse, tonic::Status>;

pub struct Watch(std::pin::Pin<Box<dyn Stream<Item = Message> + Send>>);

impl Watch {
    /// Of what a service streams.
    pub fn over(stream: impl Stream<Item = Message> + Send + 'static) -> Self {
        Self(Box::pin(stream))
    }
    pub async fn message(&mut self) -> v1::WatchTasksResponse {
        self.0.next().await.expect("a message").expect("no refusal")
    }
    pub async fn refusal(&mut self) -> tonic::Status {
        loop {
            if let Err(status) = self.0.next().await.expect("an end with a reason") {
                return status;
            }
        }
    }
    /// Reads until the stream ends.
    pub async fn drained(&mut self) {
        while self.0.next().await.is_some() {}
    }
    /// Passes existing tasks; the cursor of the bookmark behind them.
    pub async fn bookmark(&mut self) -> String {
        loop {
            let message = self.message().await;
            if matches!(message.item, Some(watch_tasks_response::Item::Bookmark(_))) {
                return message.cursor;
            }
        }
    }
    /// The next change, with its cursor.
    pub async fn change(&mut self) -> (v1::TaskChange, String) {
        loop {
            let message = self.message().await;
            if let Some(watch_tasks_response::Item::Change(change)) = message.item {
                return (change, message.cursor);
            }
        }
    }
    /// The task of the next change.
    pub async fn changed(&mut self) -> v1::Task {
        self.change().await.0.task.expect("always set")
    }
}

pub fn attempt(task_id: &TaskId, epoch: u64, phase: AttemptPhase) -> Attempt {
    Attempt {
        attempt: AttemptId { subject: Subject::Task(task_id.clone()), epoch },
        robot_id: RobotId::parse("rbt-01").expect("a valid id"),
        errand: None,
        goal: None,
        phase,
        uncertain: None,
        offer: midshift_core::authority::Authority { session_epoch: 1, hb: 1, valid_ms: 5_000 },
        step_index: 0,
        reported: None,
        is_opened: false,
        offered: NOON,
        accepted: Some(NOON),
        ended: None,
        fault: None,
        refusal: None,
        stats: Default::default(),
        software: String::new(),
        visited: None,
    }
}

pub fn transport(request_id: &str, to: &str) -> SubmitTaskRequest {
    let flat = v1::FlatTask {
        task_type: "transport".into(),
        from_waypoint: "A01".into(),
        to_waypoint: to.into(),
        item_sku: "SKU-1".into(),
        timeout_seconds: Some(300),
        ..v1::FlatTask::default()
    };
    SubmitTaskRequest { request_id: request_id.into(), body: Some(Body::Flat(flat)), ..SubmitTaskRequest::default() }
}

/// A drive to A01 in the full form.
pub fn patrol(request_id: &str, depends_on: &[&str]) -> SubmitTaskRequest {
    let goto = v1::step::Kind::Goto(v1::Goto { waypoint: "A01".into() });
    let spec = v1::TaskSpec {
        r#type: "patrol".into(),
        steps: vec![v1::Step { kind: Some(goto), ..v1::Step::default() }],
        timeout: Some(prost_types::Duration { seconds: 60, nanos: 0 }),
        depends_on: depends_on.iter().map(ToString::to_string).collect(),
        ..v1::TaskSpec::default()
    };
    SubmitTaskRequest { request_id: request_id.into(), body: Some(Body::Spec(spec)), ..SubmitTaskRequest::default() }
}

pub async fn submit(service: &TaskService, request: SubmitTaskRequest) -> Result<v1::Task, tonic::Status> {
    let answer = service.submit_task(local(request)).await?;
    Ok(answer.into_inner().task.expect("an admitted task"))
}

pub async fn count(service: &TaskService) -> usize {
    let page = service.list_tasks(local(v1::ListTasksRequest::default())).await.expect("a page");
    page.into_inner().tasks.len()
}

/// The reason code of a refusal.
pub fn reason(status: &tonic::Status) -> String {
    midshift_proto::refusal_of(status).reason
}
