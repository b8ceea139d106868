//! P5: from a submit to the offer in the hands of an idle robot, beside the raw limit of the engine in the same run.

use crate::engine::{Engine, EngineArgs};
use crate::figure::{Figure, percentile};
use crate::grid_map;
use crate::robot::{self, RobotReceiver, RobotSender};
use crate::submit::transports;
use anyhow::{Context, ensure};
use midshift_core::desired_state::Assignment;
use midshift_core::ids::WaypointId;
use midshift_core::limits;
use midshift_core::robot::WorkState;
use midshift_core::robot_events::{AttemptReport, RobotEvent, WorkStats};
use midshift_core::site::grid;
use midshift_proto::task::v1::SubmitTaskRequest;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use std::time::Duration;
use tokio::time::{Instant, interval};
use tonic::transport::Channel;

/// Commits on the way of an offer: the task, the grant, and one that may be under way before either.
const COMMITS: f64 = 3.0;
/// What everything but the commits may take, milliseconds.
const REST_MS: f64 = 5.0;
/// Side of the free grid the robot stands on.
const SIDE: usize = 20;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct OfferArgs {
    /// Submits of one round, one at a time, each to an idle robot.
    #[arg(long, default_value_t = 200)]
    submits: usize,
    /// Rounds; in each, every submit is followed by one append to the disk, or one single commit.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Runs rounds of submits and of the raw limit, in turn, against one server on each engine.
pub async fn run(args: OfferArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    for engine in args.engine.engines(say) {
        figures.extend(on(&args, &engine).await?);
    }
    Ok(figures)
}

async fn on(args: &OfferArgs, engine: &Engine) -> anyhow::Result<Vec<Figure>> {
    let bed = engine.bed(args.engine.dir.as_ref())?;
    let map = grid_map::write(bed.path(), SIDE)?;
    let site = grid::parse_map("bench", &std::fs::read_to_string(&map)?)?;
    let requests = transports(&site, args.submits * args.rounds)?;
    let server = bed.serve(Some(&map), None).await?;
    let here = site.waypoints().first().context("an empty site")?.waypoint_id.clone();
    let mut robot = Idle::attach(&server.address.to_string(), "rbt-1", here).await?;
    let mut client = TaskServiceClient::new(server.channel().await?);
    let (mut offered, mut durable, mut raws) = (Vec::new(), Vec::new(), Vec::new());
    let mut baseline = bed.baseline().await?;
    for (round, requests) in requests.chunks(args.submits.max(1)).enumerate() {
        let (mut to_robot, mut to_client, mut by_itself) = (Vec::new(), Vec::new(), Vec::new());
        for (number, request) in requests.iter().enumerate() {
            let request = SubmitTaskRequest { request_id: format!("bench-{round}-{number}"), ..request.clone() };
            let (robot_ms, client_ms) = one(&mut client, &mut robot, request).await?;
            to_robot.push(robot_ms);
            to_client.push(client_ms);
            by_itself.push(baseline.measure_ms().await?);
        }
        offered.push(to_robot);
        durable.push(to_client);
        raws.push(by_itself);
    }
    let each = |rounds: &[Vec<f64>], share: f64| rounds.iter().map(|r| percentile(r, share)).collect::<Vec<_>>();
    let (p50, p99) = (each(&raws, 0.5), each(&raws, 0.99));
    let allowed: Vec<f64> = p50.iter().map(|ms| COMMITS * ms + REST_MS).collect();
    let name = |what: &str| format!("submit to offer at an idle robot, {what}{}", engine.suffix());
    let [told_p50, told_p99] = ["p50", "p99"].map(|what| format!("{}, {what}", engine.limit()));
    let told_allowed = format!("3 x {told_p50} + 5 ms");
    let answered = format!("submit to its durable answer, p50{}", engine.suffix());
    Ok(vec![
        Figure::new("P5", name("p50"), "ms", &each(&offered, 0.5), Some((&told_allowed, &allowed))),
        Figure::new("P5", name("p50, by the raw limit"), "ms", &each(&offered, 0.5), Some((&told_p50, &p50))),
        Figure::new("P5", name("p99, by the raw limit"), "ms", &each(&offered, 0.99), Some((&told_p99, &p99))),
        Figure::new("P5", answered, "ms", &each(&durable, 0.5), Some((&told_p50, &p50))),
    ])
}

/// Submits one task and lets the robot do it: milliseconds until the robot had its offer, and until the client had its answer.
pub async fn one(
    client: &mut TaskServiceClient<Channel>,
    robot: &mut Idle,
    request: SubmitTaskRequest,
) -> anyhow::Result<(f64, f64)> {
    let begun = Instant::now();
    let since = || begun.elapsed().as_secs_f64() * 1e3;
    let answered = async {
        let answer = client.submit_task(request).await?.into_inner();
        anyhow::Ok((answer.task.context("an answer without a task")?.task_id, since()))
    };
    let offered = async {
        let assignment = robot.offered().await?;
        anyhow::Ok((assignment, since()))
    };
    let ((task_id, client_ms), (assignment, robot_ms)) = tokio::try_join!(answered, offered)?;
    let subject = assignment.attempt.subject.to_string();
    ensure!(subject == task_id, "submitted {task_id}, offered {subject}");
    robot.finish(assignment).await?;
    Ok((robot_ms, client_ms))
}

/// A robot that does everything in no time.
pub struct Idle {
    sender: RobotSender,
    receiver: RobotReceiver,
}

impl Idle {
    /// A new one at a waypoint, which the server knows to be idle.
    pub async fn attach(server: &str, name: &str, here: WaypointId) -> anyhow::Result<Self> {
        let (sender, receiver, _) = robot::attach(server, name, Some(here)).await?;
        let mut robot = Self { sender, receiver };
        robot.known_idle().await?;
        Ok(robot)
    }
    /// Does whatever it is given, until the session is over.
    pub async fn work(mut self) -> anyhow::Result<()> {
        loop {
            let assignment = self.offered().await?;
            self.finish(assignment).await?;
        }
    }
    /// Waits for work, beating; says when it came.
    async fn offered(&mut self) -> anyhow::Result<Assignment> {
        let mut beat = interval(Duration::from_millis(limits::HEARTBEAT.as_ms()));
        beat.reset();
        loop {
            tokio::select! {
                down = self.receiver.receive() => {
                    let Some(work) = down?.work else { continue };
                    self.sender.reported.applied_work = work.generation;
                    if let Some(assignment) = work.assignment {
                        return Ok(assignment);
                    }
                }
                _ = beat.tick() => self.sender.beat(false).await?,
            }
        }
    }
    /// Accepts and is done with it, then waits until the server knows that it is idle again.
    async fn finish(&mut self, assignment: Assignment) -> anyhow::Result<()> {
        let report = |state, step_index| {
            RobotEvent::Attempt(AttemptReport {
                attempt: assignment.attempt.clone(),
                state,
                step_index,
                opened: step_index > 0,
                refusal: None,
                fault: None,
                stats: WorkStats::default(),
            })
        };
        let steps = assignment.steps.len() as u32;
        self.sender.send_events(vec![report(WorkState::Accepted, 0), report(WorkState::Succeeded, steps)]).await?;
        loop {
            let Some(work) = self.receiver.receive().await?.work else { continue };
            self.sender.reported.applied_work = work.generation;
            if work.assignment.is_none_or(|still| still.attempt != assignment.attempt) {
                return self.known_idle().await;
            }
        }
    }
    /// Beats, and waits until that beat is processed.
    async fn known_idle(&mut self) -> anyhow::Result<()> {
        self.sender.beat(false).await?;
        let hb = self.sender.reported.hb;
        loop {
            let down = self.receiver.receive().await?;
            if let Some(work) = &down.work {
                self.sender.reported.applied_work = work.generation;
            }
            if down.echo.is_some_and(|echo| echo.hb == hb) {
                return Ok(());
            }
        }
    }
}
