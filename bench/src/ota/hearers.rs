//! Many robots that keep their sessions, beat once a second and hear what software they should have. They fetch nothing, so that
//! what the server spends is spent on telling them.
//!
//! Invariant: a robot whose session ends comes back and proves its succession; what it was told before is not counted twice. Called by
//! children only.

use crate::robot::{self, RobotReceiver, RobotSender};
use anyhow::Context;
use midshift_core::ids::{BundleId, WaypointId};
use midshift_core::limits;
use midshift_core::robot::{Inventory, Lane, ReportedState};
use midshift_core::robot_events::RobotEvent;
use midshift_core::update::{DesiredUpdate, Goal, UpdateEvent, UpdateReport, UpdateState};
use midshift_proto::session::{Hello, LanePosition, Previous};
use midshift_sim::body::MODEL;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio::time::{Instant, interval_at, sleep, timeout};
use tokio_util::sync::CancellationToken;

/// Sessions that are being opened at once.
const OPENING: usize = 64;
/// A robot whose session ended comes back after this, and up to twice as long.
const BACK_AFTER: Duration = Duration::from_millis(200);
/// A server that does not answer for so long is given up, as a real agent does.
const SILENT_AFTER: Duration = Duration::from_secs(10);
/// What nobody was told yet, as an answer.
pub const NEVER: u64 = u64::MAX;

/// What to be.
#[derive(Clone, Debug, clap::Args)]
pub struct HearersArgs {
    /// The server, host:port.
    #[arg(long)]
    pub server: String,
    /// How many.
    #[arg(long)]
    pub robots: usize,
    /// Each says that it has taken its directive for this bundle, as a real one would at once. Without it they only hear.
    #[arg(long)]
    pub takes: Option<String>,
}

/// Name of robot `index`.
pub fn name(index: usize) -> String {
    format!("rbt-{index:05}")
}

/// Number of the robot of this name.
pub fn index(name: &str) -> Option<usize> {
    name.strip_prefix("rbt-")?.parse().ok()
}

/// What one robot was told.
#[derive(Default)]
struct Told {
    /// When it first had a directive.
    first: Option<Instant>,
    /// Generations with a directive, each once.
    generations: Vec<u64>,
}

/// What all were told.
pub struct Heard {
    robots: Vec<Mutex<Told>>,
    with_directive: AtomicUsize,
}

impl Heard {
    /// Nothing yet.
    pub fn new(robots: usize) -> Self {
        Self { robots: (0..robots).map(|_| Mutex::default()).collect(), with_directive: AtomicUsize::new(0) }
    }
    fn count_offer(&self, index: usize, update: &DesiredUpdate) {
        let mut told = self.robots[index].lock().unwrap_or_else(PoisonError::into_inner);
        if told.first.is_none() {
            told.first = Some(Instant::now());
            self.with_directive.fetch_add(1, Relaxed);
        }
        if !told.generations.contains(&update.generation) {
            told.generations.push(update.generation);
        }
    }
    /// `offered`: robots that have had a directive. `age N`: microseconds since robot N had its first. `count N`: different generations it was
    /// told. `generation N`: the newest.
    pub fn answer(&self, question: &str) -> u64 {
        let Some((what, number)) = question.split_once(' ') else { return self.with_directive.load(Relaxed) as u64 };
        let robot = number.parse::<usize>().ok().and_then(|at| self.robots.get(at));
        let Some(told) = robot.map(|told| told.lock().unwrap_or_else(PoisonError::into_inner)) else { return NEVER };
        match what {
            "age" => told.first.map_or(NEVER, |at| at.elapsed().as_micros() as u64),
            "count" => told.generations.len() as u64,
            _ => told.generations.last().copied().unwrap_or(NEVER),
        }
    }
}

/// Keeps all of them attached until `stop`.
pub async fn run(args: HearersArgs, heard: Arc<Heard>, stop: CancellationToken) -> anyhow::Result<()> {
    let takes = args.takes.as_deref().map(BundleId::parse).transpose()?;
    let opening = Arc::new(Semaphore::new(OPENING));
    let mut all = JoinSet::new();
    for index in 0..args.robots {
        let (server, takes) = (args.server.clone(), takes.clone());
        let (heard, opening) = (heard.clone(), opening.clone());
        let hello = first_hello(index)?;
        all.spawn(async move { Hearer { index, server, takes, heard, opening }.live(hello).await });
    }
    tokio::select! {
        ended = all.join_next() => ended.context("no robots")??,
        () = stop.cancelled() => Ok(()),
    }
}

fn first_hello(index: usize) -> anyhow::Result<Hello> {
    let mut hello = robot::hello(&name(index), Some(WaypointId::parse(&format!("c{index}"))?))?;
    hello.inventory = Inventory { model: MODEL.to_owned(), software: "1.0.0".to_owned(), ..hello.inventory };
    Ok(hello)
}

/// One of them.
struct Hearer {
    index: usize,
    server: String,
    takes: Option<BundleId>,
    heard: Arc<Heard>,
    opening: Arc<Semaphore>,
}

impl Hearer {
    /// From session to session.
    async fn live(&self, mut hello: Hello) -> anyhow::Result<()> {
        loop {
            let permit = self.opening.acquire().await?;
            let opened = timeout(SILENT_AFTER, robot::open(&self.server, hello.clone())).await;
            drop(permit);
            if let Ok(Ok((mut sender, mut receiver, welcome))) = opened {
                // How it ended does not matter: it comes back.
                let _ = self.attend(&mut sender, &mut receiver).await;
                let said = &sender.reported;
                let next_seq = said.produced.get(&Lane::Event).map_or(1, |last| last + 1);
                hello.lanes = [(Lane::Event, LanePosition { first_seq: next_seq, next_seq })].into();
                hello.reported = ReportedState { hb: 0, session_epoch: 0, ..said.clone() };
                hello.store_id = welcome.store_id;
                let (session_epoch, secret) = (welcome.session_epoch, welcome.session_secret);
                hello.previous = Some(Previous { session_epoch, secret });
            }
            sleep(BACK_AFTER + BACK_AFTER.mul_f64((self.index % 100) as f64 / 100.0)).await;
        }
    }
    /// One session, to its end.
    async fn attend(&self, sender: &mut RobotSender, receiver: &mut RobotReceiver) -> anyhow::Result<()> {
        sender.beat(false).await?;
        let period = Duration::from_millis(limits::HEARTBEAT.as_ms());
        // Robots do not beat at one moment.
        let mut beat = interval_at(Instant::now() + period.mul_f64((self.index % 1_000) as f64 / 1_000.0), period);
        loop {
            tokio::select! {
                down = timeout(SILENT_AFTER, receiver.receive()) => {
                    let down = down??;
                    if let Some(work) = &down.work {
                        sender.reported.applied_work = work.generation;
                    }
                    if let Some(update) = &down.update {
                        self.obey(sender, update).await?;
                    }
                }
                _ = beat.tick() => sender.beat(false).await?,
            }
        }
    }
    async fn obey(&self, sender: &mut RobotSender, update: &DesiredUpdate) -> anyhow::Result<()> {
        let is_news = update.generation > sender.reported.applied_update;
        sender.reported.applied_update = update.generation;
        if update.goal != Goal::Stage || update.directive.is_empty() {
            return Ok(());
        }
        self.heard.count_offer(self.index, update);
        let Some(bundle) = self.takes.clone().filter(|_| is_news) else { return Ok(()) };
        let report = UpdateReport {
            state: UpdateState::Directed,
            bundle,
            directive_generation: update.generation,
            set: None,
            drain_id: None,
            grant_id: 0,
            tries: 0,
            progress_permille: 0,
            reason: None,
        };
        sender.reported.update = Some(report.clone());
        sender.send_events(vec![RobotEvent::Update(UpdateEvent::Changed(report))]).await
    }
}
