//! What calls cost that only read, one at a time, at a site where thousands of tasks are over: time of each call, and CPU of the server, without
//! that of a database beside it.

use crate::child::Child;
use crate::engine::{Bed, Engine, EngineArgs};
use crate::figure::{Figure, percentile};
use crate::old_sites::old_site::OldSite;
use crate::old_sites::old_tables;
use anyhow::{Context, ensure};
use midshift_agent::clock::wall;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{GetTaskRequest, ListTasksRequest, TaskFilter, TaskState};
use midshift_proto::telemetry::v1::ListRobotsRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_server::storage::Database;
use tokio::time::Instant;
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct ReadsArgs {
    /// Tasks that are over.
    #[arg(long, default_value_t = 30_000)]
    ended: u64,
    /// Calls of each kind in a round; a search through all tasks is asked a tenth as often.
    #[arg(long, default_value_t = 500)]
    calls: usize,
    /// Rounds on each engine.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    #[command(flatten)]
    engine: EngineArgs,
}

/// A kind of call.
#[derive(Clone, Copy, Debug)]
enum Call {
    GetTask,
    ListOne,
    ListHundred,
    ListLive,
    ListOfRobot,
    SearchReference,
    SearchLabel,
    ListRobots,
}

impl Call {
    const ALL: [Self; 8] = [
        Self::GetTask,
        Self::ListOne,
        Self::ListHundred,
        Self::ListLive,
        Self::ListOfRobot,
        Self::SearchReference,
        Self::SearchLabel,
        Self::ListRobots,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::GetTask => "GetTask",
            Self::ListOne => "ListTasks, a page of one",
            Self::ListHundred => "ListTasks, a page of a hundred",
            Self::ListLive => "ListTasks of a live state, none is",
            Self::ListOfRobot => "ListTasks of a robot, a page of one",
            Self::SearchReference => "all pages of an external_ref that no task has",
            Self::SearchLabel => "all pages of a label that no task has",
            Self::ListRobots => "ListRobots, none is enrolled",
        }
    }

    /// Calls of a round.
    fn times(self, calls: usize) -> usize {
        match self {
            Self::SearchReference | Self::SearchLabel => (calls / 10).max(1),
            _ => calls,
        }
    }
}

/// One round of one kind of call.
struct Round {
    took_ms: Vec<f64>,
    cpu_ms: f64,
}

/// Runs rounds of each kind of call on each engine.
pub async fn run(args: ReadsArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    for engine in args.engine.engines(say) {
        figures.extend(measure(&args, &engine, say).await?);
    }
    Ok(figures)
}

async fn measure(args: &ReadsArgs, engine: &Engine, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let bed = engine.bed(args.engine.dir.as_ref())?;
    let server = serve_old_site(args, &bed).await?;
    let mut client = Client::connect(&server).await?;
    let mut rounds: Vec<Vec<Round>> = Call::ALL.iter().map(|_| Vec::new()).collect();
    let mut health = Vec::new();
    for number in 1..=args.rounds {
        health.push(client.round(None, args.calls, &server).await?);
        for (call, rounds) in Call::ALL.into_iter().zip(&mut rounds) {
            rounds.push(client.round(Some(call), call.times(args.calls), &server).await?);
        }
        say(&format!("round {number}{} is over", engine.suffix()));
    }
    Ok(Call::ALL.iter().zip(&rounds).flat_map(|(call, rounds)| figures(*call, engine, rounds, &health)).collect())
}

async fn serve_old_site(args: &ReadsArgs, bed: &Bed<'_>) -> anyhow::Result<Child> {
    let database = Database { store: bed.url().map(str::to_owned) };
    let site = text::parse(DEMO)?;
    let data = bed.path().join("data");
    old_tables::make(&OldSite::with_ended(args.ended, wall()), &database, &data, site.site_id()).await?;
    bed.serve(None, None).await
}

/// Each beside the same of a call that reads nothing.
fn figures(call: Call, engine: &Engine, rounds: &[Round], health: &[Round]) -> [Figure; 3] {
    let figure = |what: &str, of: &dyn Fn(&Round) -> f64| {
        let [values, limit] = [rounds, health].map(|rounds| rounds.iter().map(of).collect::<Vec<_>>());
        let (name, told) = (format!("{}, {what}{}", call.name(), engine.suffix()), format!("health check, {what}"));
        Figure::new("R1", name, "ms", &values, Some((&told, &limit)))
    };
    [
        figure("p50", &|round| percentile(&round.took_ms, 0.5)),
        figure("p99", &|round| percentile(&round.took_ms, 0.99)),
        figure("CPU of the server each", &|round| round.cpu_ms),
    ]
}

struct Client {
    health: HealthClient<Channel>,
    tasks: TaskServiceClient<Channel>,
    robots: TelemetryServiceClient<Channel>,
    /// Of a task that is over, and the robot that did it.
    task_id: String,
    robot_id: String,
}

impl Client {
    async fn connect(server: &Child) -> anyhow::Result<Self> {
        let channel = server.channel().await?;
        let mut tasks = TaskServiceClient::new(channel.clone());
        let page = tasks.list_tasks(ListTasksRequest { page_size: 1, ..ListTasksRequest::default() }).await?;
        let task = page.into_inner().tasks.pop().context("no task is over")?;
        let robots = TelemetryServiceClient::new(channel.clone());
        let health = HealthClient::new(channel);
        Ok(Self { health, tasks, robots, task_id: task.task_id, robot_id: task.robot_id })
    }

    /// Asks for one kind of call again and again; none: for the health of the server, which reads nothing.
    async fn round(&mut self, call: Option<Call>, times: usize, server: &Child) -> anyhow::Result<Round> {
        let (before_s, mut took_ms) = (server.cpu_s()?, Vec::with_capacity(times));
        for _ in 0..times {
            let begun = Instant::now();
            match call {
                Some(call) => self.ask(call).await?,
                None => drop(self.health.check(HealthCheckRequest::default()).await?),
            }
            took_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        }
        Ok(Round { took_ms, cpu_ms: server.cpu_since_s(before_s)? * 1e3 / times as f64 })
    }

    async fn ask(&mut self, call: Call) -> anyhow::Result<()> {
        let filter = match call {
            Call::GetTask => {
                self.tasks.get_task(GetTaskRequest { task_id: self.task_id.clone() }).await?;
                return Ok(());
            }
            Call::ListRobots => {
                self.robots.list_robots(ListRobotsRequest::default()).await?;
                return Ok(());
            }
            Call::ListOne | Call::ListHundred => TaskFilter::default(),
            Call::ListLive => TaskFilter { states: vec![TaskState::Running.into()], ..TaskFilter::default() },
            Call::ListOfRobot => TaskFilter { robot_ids: vec![self.robot_id.clone()], ..TaskFilter::default() },
            Call::SearchReference => TaskFilter { external_ref: "order-0".to_owned(), ..TaskFilter::default() },
            Call::SearchLabel => {
                TaskFilter { labels: [("line".to_owned(), "9".to_owned())].into(), ..TaskFilter::default() }
            }
        };
        let page_size = if matches!(call, Call::ListOne | Call::ListOfRobot) { 1 } else { 100 };
        let is_search = matches!(call, Call::SearchReference | Call::SearchLabel);
        let mut request = ListTasksRequest { filter: Some(filter), page_size, page_token: String::new() };
        loop {
            let page = self.tasks.list_tasks(request.clone()).await?.into_inner();
            ensure!(page.tasks.is_empty() || !is_search, "a task was found that does not exist");
            if !is_search || page.next_page_token.is_empty() {
                return Ok(());
            }
            request.page_token = page.next_page_token;
        }
    }
}
