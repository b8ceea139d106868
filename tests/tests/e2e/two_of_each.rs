//! Two processes of each service that may have several, with clients at both: what they are told, and what they bring about, is what one process would.

use crate::harness::{channel, folder, until};
use crate::kill::{all_over, judge};
use crate::robots::{Robots, with_robots};
use crate::rolled_out::{call, done};
use crate::room::LIMIT;
use crate::split::events_have_no_hole;
use crate::stack::Stack;
use anyhow::{Context, ensure};
use midshift_cli::task_list::request;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{
    CordonRobotRequest, ExplainTaskRequest, GetRobotControlRequest, RobotControl, UncordonRobotRequest,
};
use midshift_proto::identity::v1::audit_service_client::AuditServiceClient;
use midshift_proto::identity::v1::{AuditRow, ListAuditRequest};
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{ListRolloutsRequest, WatchRolloutRequest};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::watch_tasks_response::Item;
use midshift_proto::task::v1::{
    CancelTaskRequest, FlatTask, ListTasksRequest, SubmitTaskRequest, SubmitTasksRequest, SubmitTasksResponse,
    TaskState, WatchTasksRequest, WatchTasksResponse, submit_task_request::Body,
};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{Event, ListEventsRequest, ListRobotsRequest, Presence, Robot, WatchRobotsRequest};
use midshift_sim::workload::{Workload, WorkloadConfig};
use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::net::SocketAddr;
use std::process::Output;
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;
use tonic::{Code, Status, Streaming};

const ROBOTS: usize = 8;
/// Tasks that are sent to both intakes at once, one by one and in a batch, and that one of them admits alone.
const ONE_BY_ONE: usize = 3;
const IN_A_BATCH: usize = 4;
const ALONE: usize = 5;
/// The robot that a person takes out of work, and the task that waits for it.
const CORDONED: &str = "rbt-02";
const WAITING: &str = "waiting";
const ROLLOUT: &str = "two-of-each";

/// Where the two processes of a service listen.
type Both = [SocketAddr; 2];

fn both(stack: &mut Stack, role: &str) -> anyhow::Result<Both> {
    Ok([stack.address(role, 0)?, stack.address(role, 1)?])
}

/// Asks both at once.
async fn at_once<T, F: Future<Output = anyhow::Result<T>>>(
    at: Both,
    ask: impl Fn(SocketAddr) -> F,
) -> anyhow::Result<[T; 2]> {
    let (first, second) = tokio::try_join!(ask(at[0]), ask(at[1]))?;
    Ok([first, second])
}

/// Messages of a stream as they come, until this is dropped.
struct Watch<M> {
    told: watch::Receiver<Vec<M>>,
    _reading: AbortOnDropHandle<()>,
}

impl<M: Send + Sync + 'static> Watch<M> {
    fn over(mut stream: Streaming<M>) -> Self {
        let (keep, told) = watch::channel(Vec::new());
        let reading = async move {
            while let Ok(Some(message)) = stream.message().await {
                keep.send_modify(|told| told.push(message));
            }
        };
        Self { told, _reading: AbortOnDropHandle::new(tokio::spawn(reading)) }
    }
    /// Waits until a message fits.
    async fn tells(&mut self, what: &str, fits: impl Fn(&M) -> bool) -> anyhow::Result<()> {
        let told = self.told.wait_for(|told| told.iter().any(&fits));
        let told = tokio::time::timeout(LIMIT, told).await.with_context(|| format!("in vain: {what}"))?;
        told.map(|_| ()).with_context(|| format!("the stream ended before {what}"))
    }
}

/// A change of a task: its id and etag, what happened, the state, and the cursor behind it.
type Change = (String, String, String, TaskState, String);

fn change(message: &WatchTasksResponse) -> Option<Change> {
    let Some(Item::Change(change)) = &message.item else { return None };
    let task = change.task.as_ref()?;
    let kind = change.kind.clone();
    Some((task.task_id.clone(), task.etag.clone(), kind, task.state(), message.cursor.clone()))
}

impl Watch<WatchTasksResponse> {
    async fn at(address: SocketAddr, cursor: &str) -> anyhow::Result<Self> {
        let request = WatchTasksRequest { filter: None, cursor: cursor.to_owned() };
        let stream = TaskServiceClient::new(channel(address)?).watch_tasks(request).await?.into_inner();
        Ok(Self::over(stream))
    }
    async fn tells_of(&mut self, task_id: &str, state: TaskState) -> anyhow::Result<()> {
        let fits = |told: &WatchTasksResponse| change(told).is_some_and(|told| told.0 == task_id && told.3 == state);
        self.tells(&format!("{task_id} {state:?}"), fits).await
    }
    /// All changes up to the end of a task.
    fn until_canceled(&self, task_id: &str) -> Vec<Change> {
        let changes: Vec<Change> = self.told.borrow().iter().filter_map(change).collect();
        let end = changes.iter().position(|told| told.0 == task_id && told.3 == TaskState::Canceled);
        changes.into_iter().take(end.map_or(0, |end| end + 1)).collect()
    }
}

fn transports(site: &Site, name: &str, count: usize) -> anyhow::Result<Vec<SubmitTaskRequest>> {
    let mut workload = Workload::new(WorkloadConfig::background(17), site).context("the site has stations")?;
    let request = |i| SubmitTaskRequest { request_id: format!("{name}-{i}"), ..request(&workload.next_transport()) };
    Ok((0..count).map(request).collect())
}

async fn submit(at: SocketAddr, request: SubmitTaskRequest) -> anyhow::Result<Result<String, Status>> {
    let answer = TaskServiceClient::new(channel(at)?).submit_task(request).await;
    Ok(answer.map(|answer| answer.into_inner().task.unwrap_or_default().task_id))
}

/// The same request at both at once is one task, one by one and in a batch; the same id with another body is admitted once.
async fn each_request_is_one_task(intakes: Both, site: &Site) -> anyhow::Result<BTreeSet<String>> {
    let mut admitted = BTreeSet::new();
    for request in transports(site, "one", ONE_BY_ONE)? {
        let [first, second] = at_once(intakes, async |at| Ok(submit(at, request.clone()).await??)).await?;
        ensure!(first == second, "{} became {first} and {second}", request.request_id);
        admitted.insert(first);
        let other = SubmitTaskRequest { request_id: format!("{}-else", request.request_id), ..request };
        let [left, right] = ["B01", "B02"].map(|to| SubmitTaskRequest { body: flat("", to), ..other.clone() });
        let (left, right) = tokio::try_join!(submit(intakes[0], left), submit(intakes[1], right))?;
        let (Ok(id), Err(refused)) = (if left.is_ok() { (left, right) } else { (right, left) }) else {
            anyhow::bail!("{} was not admitted once", other.request_id);
        };
        ensure!(refused.code() == Code::AlreadyExists, "{refused}");
        admitted.insert(id);
    }
    let items = transports(site, "many", IN_A_BATCH)?.into_iter().map(|item| SubmitTasksRequest { item: Some(item) });
    let items: Vec<_> = items.collect();
    let [first, second]: [SubmitTasksResponse; 2] = at_once(intakes, async |at| {
        let mut client = TaskServiceClient::new(channel(at)?);
        Ok(client.submit_tasks(tokio_stream::iter(items.clone())).await?.into_inner())
    })
    .await?;
    let ids = |answer: &SubmitTasksResponse| -> Vec<String> {
        answer.results.iter().map(|result| result.clone().outcome).map(|o| format!("{o:?}")).collect()
    };
    ensure!(ids(&first) == ids(&second), "{first:?} {second:?}");
    Ok(admitted)
}

/// A transport by this robot, or by any.
fn flat(robot_id: &str, to_waypoint: &str) -> Option<Body> {
    Some(Body::Flat(FlatTask {
        task_type: "transport".to_owned(),
        robot_id: robot_id.to_owned(),
        from_waypoint: "A01".to_owned(),
        to_waypoint: to_waypoint.to_owned(),
        timeout_seconds: Some(600),
        ..FlatTask::default()
    }))
}

/// Every task, in pages that both are asked for in turn.
async fn listed(intakes: Both) -> anyhow::Result<Vec<(String, u64)>> {
    let (mut page_token, mut all) = (String::new(), Vec::new());
    for nth in 0.. {
        let request = ListTasksRequest { filter: None, page_size: 4, page_token };
        let page = TaskServiceClient::new(channel(intakes[nth % 2])?).list_tasks(request).await?.into_inner();
        all.extend(page.tasks.into_iter().map(|task| (task.task_id, task.number)));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    Ok(all)
}

/// What one admits after many that the other admitted is the newest to both, and numbers rise.
async fn lists_are_newest_first(
    intakes: Both,
    site: &Site,
    watches: &mut [Watch<WatchTasksResponse>; 2],
) -> anyhow::Result<()> {
    let mut admitted = Vec::new();
    for request in transports(site, "alone", ALONE)? {
        admitted.push(submit(intakes[0], request).await??);
    }
    for nth in [1, 0, 1] {
        // Who was told of a task at a process and submits there has the newer one.
        let last = admitted.last().context("some were admitted")?;
        watches[nth].tells(last, |told| change(told).is_some_and(|told| told.0 == *last)).await?;
        let [request] = &transports(site, &format!("turn-{}", admitted.len()), 1)?[..] else { unreachable!() };
        admitted.push(submit(intakes[nth], request.clone()).await??);
    }
    let (one_way, other_way) = (listed(intakes).await?, listed([intakes[1], intakes[0]]).await?);
    ensure!(one_way == other_way, "{one_way:?} {other_way:?}");
    ensure!(one_way.is_sorted_by(|newer, older| newer.1 >= older.1), "numbers fall: {one_way:?}");
    let ids: Vec<&String> = one_way.iter().map(|(id, _)| id).collect();
    ensure!(ids.iter().collect::<BTreeSet<_>>().len() == ids.len(), "one is listed twice: {ids:?}");
    let newest: Vec<&String> = admitted.iter().rev().collect();
    ensure!(ids[..newest.len()] == newest, "newest first: {ids:?} begins with {newest:?}");
    Ok(())
}

/// What the audit has of an action and what it is about, the same from both.
async fn audited(intakes: Both, subject: &str, action: &str) -> anyhow::Result<Vec<AuditRow>> {
    let request = ListAuditRequest {
        subject: subject.to_owned(),
        action_prefix: action.to_owned(),
        ..ListAuditRequest::default()
    };
    let [first, second] = at_once(intakes, async |at| {
        let answer = AuditServiceClient::new(channel(at)?).list_audit(request.clone()).await?;
        Ok(answer.into_inner().rows)
    })
    .await?;
    ensure!(first == second, "{first:?} {second:?}");
    Ok(first)
}

async fn control(at: SocketAddr) -> anyhow::Result<RobotControl> {
    let request = GetRobotControlRequest { robot_id: CORDONED.to_owned() };
    let answer = FleetServiceClient::new(channel(at)?).get_robot_control(request).await?.into_inner();
    answer.control.context("a robot that is known")
}

/// A robot is taken out of work at both at once by one request, and both show it alike.
async fn cordoned_once(fleets: Both, intakes: Both) -> anyhow::Result<()> {
    let request = CordonRobotRequest {
        robot_id: CORDONED.to_owned(),
        request_id: "cordon-1".to_owned(),
        reason: "looked at".to_owned(),
        ..CordonRobotRequest::default()
    };
    at_once(fleets, async |at| {
        Ok(FleetServiceClient::new(channel(at)?).cordon_robot(request.clone()).await?.into_inner())
    })
    .await?;
    until("both show the cordon alike", LIMIT, async || {
        let [first, second] = at_once(fleets, control).await?;
        Ok((first.cordon.is_some() && first == second).then_some(()))
    })
    .await?;
    let rows = audited(intakes, &format!("robot:{CORDONED}"), "robot.cordon").await?;
    ensure!(rows.len() == 1, "one cordon is one row: {rows:?}");
    Ok(())
}

/// A task waits for the robot that is out of work: both say why alike. It is canceled at both at once by one request.
async fn explained_and_canceled_once(intakes: Both, fleets: Both) -> anyhow::Result<()> {
    let body = flat(CORDONED, "B03");
    let request = SubmitTaskRequest { task_id: WAITING.to_owned(), body, ..SubmitTaskRequest::default() };
    at_once(intakes, async |at| Ok(submit(at, request.clone()).await??)).await?;
    until("both say alike why it waits", LIMIT, async || {
        let asked = at_once(fleets, async |at| {
            let request = ExplainTaskRequest { task_id: WAITING.to_owned() };
            let answer = FleetServiceClient::new(channel(at)?).explain_task(request).await;
            Ok(answer.ok().and_then(|answer| answer.into_inner().explanation))
        });
        let [Some(first), Some(second)] = asked.await? else { return Ok(None) };
        let is_alike = first.verdict.is_some() && first.verdict == second.verdict && first.filtered == second.filtered;
        Ok(is_alike.then_some(()))
    })
    .await?;
    let cancel = CancelTaskRequest {
        task_id: WAITING.to_owned(),
        request_id: "cancel-1".to_owned(),
        reason: "not needed".to_owned(),
        ..CancelTaskRequest::default()
    };
    at_once(intakes, async |at| {
        Ok(TaskServiceClient::new(channel(at)?).cancel_task(cancel.clone()).await?.into_inner())
    })
    .await?;
    let rows = audited(intakes, &format!("task:{WAITING}"), "task.cancel").await?;
    ensure!(rows.len() == 1, "one cancel is one row: {rows:?}");
    Ok(())
}

/// Each change once, in one order, from both; and whoever goes on at the other from any cursor misses none.
async fn watches_are_alike(intakes: Both, watches: &[Watch<WatchTasksResponse>; 2]) -> anyhow::Result<()> {
    let [first, second] = [0, 1].map(|nth| watches[nth].until_canceled(WAITING));
    ensure!(first == second, "{first:#?} {second:#?}");
    let once: BTreeSet<(&String, &String)> = first.iter().map(|told| (&told.0, &told.1)).collect();
    ensure!(once.len() == first.len(), "a change was told twice: {first:#?}");
    ensure!(first.len() > 3 * ONE_BY_ONE, "little has changed: {first:#?}");
    for (nth, at) in [(first.len() / 3, 1), (first.len() / 2, 0)] {
        let mut rest = Watch::at(intakes[at], &first[nth].4).await?;
        rest.tells_of(WAITING, TaskState::Canceled).await?;
        ensure!(rest.until_canceled(WAITING) == first[nth + 1..], "from the cursor of {:?}", first[nth]);
    }
    Ok(())
}

/// Every event there is, in pages that both are asked for in turn.
async fn events(gateways: Both) -> anyhow::Result<Vec<Event>> {
    let (mut cursor, mut all) = (String::new(), Vec::new());
    for nth in 0.. {
        let request = ListEventsRequest { page_size: 20, cursor, ..ListEventsRequest::default() };
        let page = TelemetryServiceClient::new(channel(gateways[nth % 2])?).list_events(request).await?.into_inner();
        all.extend(page.events);
        cursor = page.cursor;
        if page.caught_up {
            break;
        }
    }
    Ok(all)
}

/// Robots of both gateways are shown alike by both, and events come in one order, without a hole.
async fn gateways_are_alike(gateways: Both, public: SocketAddr) -> anyhow::Result<()> {
    let (one_way, other_way) = (events(gateways).await?, events([gateways[1], gateways[0]]).await?);
    let least = one_way.len().min(other_way.len());
    ensure!(one_way[..least] == other_way[..least], "events in another order");
    events_have_no_hole(public, ROBOTS).await?;
    let known = |robots: &[Robot]| -> BTreeMap<String, (u64, i32, String)> {
        let known = |robot: &Robot| (robot.session_epoch, robot.presence, robot.ring.clone());
        robots.iter().map(|robot| (robot.robot_id.clone(), known(robot))).collect()
    };
    until("both list the robots alike", LIMIT, async || {
        let [first, second] = at_once(gateways, async |at| {
            let mut client = TelemetryServiceClient::new(channel(at)?);
            Ok(client.list_robots(ListRobotsRequest::default()).await?.into_inner().robots)
        })
        .await?;
        let is_online = |robot: &Robot| robot.presence() == Presence::Online;
        let is_whole = first.len() == ROBOTS && first.iter().all(is_online);
        Ok((is_whole && known(&first) == known(&second)).then_some(()))
    })
    .await?;
    let [first, second] = at_once(gateways, async |at| {
        let request = WatchRobotsRequest { filter: None, period_ms: 50 };
        let stream = TelemetryServiceClient::new(channel(at)?).watch_robots(request).await?.into_inner();
        let mut watch = Watch::over(stream);
        watch.tells("all robots", |told| told.snapshot_complete).await?;
        let told = watch.told.borrow();
        let whole = told.iter().take_while(|told| !told.snapshot_complete).count() + 1;
        Ok(told.iter().take(whole).flat_map(|told| told.robots.clone()).collect::<Vec<_>>())
    })
    .await?;
    ensure!(first.len() == ROBOTS && known(&first) == known(&second), "{first:?} {second:?}");
    Ok(())
}

/// A roll-out that both are asked for at once is written down once, and a watch at each tells it.
async fn rollouts_are_alike(otas: Both) -> anyhow::Result<()> {
    let asked = async |at: SocketAddr, words: &'static [&'static str]| {
        let call = move || call(&[words, &["--server", &at.to_string()]].concat());
        tokio::task::spawn_blocking(call).await?
    };
    // Rows of a release are its leader's, a moment after it was published.
    until("both know the release", LIMIT, async || {
        let [first, second] = at_once(otas, |at| asked(at, &["bundle", "ls"])).await?;
        let knows = |said: &Output| String::from_utf8_lossy(&said.stdout).contains("1.5.0");
        Ok((knows(&first) && knows(&second)).then_some(()))
    })
    .await?;
    const CREATE: &[&str] = &["rollout", "create", ROLLOUT, "--bundle", "walk-1.5.0", "--waves", "1,rest"];
    let made = at_once(otas, |at| asked(at, CREATE)).await?;
    ensure!(made.iter().all(|made| made.status.success()), "whoever asks the same hears the same: {made:?}");
    let [first, second] = at_once(otas, async |at| {
        let mut client = RolloutServiceClient::new(channel(at)?);
        let rollouts = until("it is listed", LIMIT, async || {
            let listed = client.clone().list_rollouts(ListRolloutsRequest::default()).await?.into_inner().rollouts;
            Ok((!listed.is_empty()).then_some(listed))
        });
        ensure!(rollouts.await?.len() == 1, "one roll-out");
        let request = WatchRolloutRequest { rollout_id: ROLLOUT.to_owned(), ..Default::default() };
        Ok(Watch::over(client.watch_rollout(request).await?.into_inner()))
    })
    .await?;
    let mut etags = Vec::new();
    for mut watch in [first, second] {
        watch.tells("the roll-out", |told| told.rollout.is_some()).await?;
        etags.extend(watch.told.borrow().iter().filter_map(|told| Some(told.rollout.as_ref()?.etag.clone())));
    }
    etags.dedup();
    ensure!(etags.len() == 1, "both tell the same one: {etags:?}");
    watches_go_forward(otas).await
}

/// The version of a roll-out that a process answers to a command with.
async fn acted(at: SocketAddr, words: &[&str]) -> anyhow::Result<u64> {
    let at = at.to_string();
    let said = tokio::task::block_in_place(|| call(&[words, &["--server", &at, "-o", "json"]].concat()))?;
    ensure!(said.status.success(), "{words:?}: {}", String::from_utf8_lossy(&said.stderr));
    let answer: serde_json::Value = serde_json::from_slice(&said.stdout)?;
    Ok(answer["etag"].as_str().context("an etag")?.parse()?)
}

/// Watches that begin one after the other tell first nothing older than `newest`, or than what was told before; the last version.
async fn told_forward(rollout_id: &str, mut newest: u64, watched: [SocketAddr; 3]) -> anyhow::Result<u64> {
    for at in watched {
        let request = WatchRolloutRequest { rollout_id: rollout_id.to_owned(), ..Default::default() };
        let mut watch = RolloutServiceClient::new(channel(at)?).watch_rollout(request).await?.into_inner();
        let told = watch.message().await?.and_then(|told| told.rollout).context("a roll-out")?;
        let told: u64 = told.etag.parse()?;
        ensure!(told >= newest, "{at} tells {told} of {rollout_id} after {newest}");
        newest = told;
    }
    Ok(newest)
}

/// Whoever has the answer of one process, or was told by its watch, and goes on at the other is told nothing older there.
async fn watches_go_forward(otas: Both) -> anyhow::Result<()> {
    for (nth, [here, there]) in [otas, [otas[1], otas[0]]].into_iter().enumerate() {
        let id = &format!("forward-{nth}");
        let made = acted(here, &["rollout", "create", id, "--bundle", "walk-1.5.0", "--waves", "1,rest"]).await?;
        let told = told_forward(id, made, [there, here, there]).await?;
        let aborted = acted(there, &["rollout", "abort", id, "--reason", "tried"]).await?;
        ensure!(aborted > told, "it was changed: {aborted} after {told}");
        told_forward(id, aborted, [here, there, here]).await?;
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_processes_of_each_service_are_one_to_clients_at_both() -> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, ROBOTS)?;
    let samples = dir.path().join("samples");
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    let keys = samples.join("keys").display().to_string();
    let mut stack = Stack::start(dir.path(), &text::render(&site), &[], &["--ota-keys", &keys]).await?;
    let (public, repository) = (stack.public.to_string(), samples.join("repository").display().to_string());
    done(&["bundle", "push", "--server", &public, &repository])?;
    let robots = Robots::start(dir.path(), stack.robots, stack.public, &site).await?;
    let [intakes, fleets] = [both(&mut stack, "task")?, both(&mut stack, "fleet")?];
    let [gateways, otas] = [both(&mut stack, "telemetry")?, both(&mut stack, "ota")?];
    let mut watches = at_once(intakes, async |at| {
        let mut watch = Watch::at(at, "").await?;
        watch.tells("that it began", |told| matches!(told.item, Some(Item::Bookmark(_)))).await?;
        Ok(watch)
    })
    .await?;
    cordoned_once(fleets, intakes).await?;
    each_request_is_one_task(intakes, &site).await?;
    lists_are_newest_first(intakes, &site, &mut watches).await?;
    let uncordon = UncordonRobotRequest { robot_id: CORDONED.to_owned(), ..UncordonRobotRequest::default() };
    FleetServiceClient::new(channel(fleets[1])?).uncordon_robot(uncordon).await?;
    let count = 2 * ONE_BY_ONE + IN_A_BATCH + ALONE + 3;
    let ended = all_over(stack.public, count).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    let cordon = CordonRobotRequest {
        robot_id: CORDONED.to_owned(),
        reason: "looked at again".to_owned(),
        ..CordonRobotRequest::default()
    };
    FleetServiceClient::new(channel(fleets[0])?).cordon_robot(cordon).await?;
    explained_and_canceled_once(intakes, fleets).await?;
    for watch in &mut watches {
        watch.tells_of(WAITING, TaskState::Canceled).await?;
    }
    watches_are_alike(intakes, &watches).await?;
    gateways_are_alike(gateways, stack.public).await?;
    rollouts_are_alike(otas).await
}
