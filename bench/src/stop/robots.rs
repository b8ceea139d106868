//! Many robots on the stop service, and as many sockets on each bare loop, in one process.
//!
//! A robot here is the smallest one that keeps its line: it takes over what it is told, checks in once a second, and says at once what it knows, obeys and stands by,
//! then once more when it is durable, as the agent does (its file is in memory). It is resumed with the reset: nobody plans for it. It has no body and no ladder.
//! Invariant: a line that ends ends the process, so that no robot is left out of a figure. Called by children only.

use super::moments::{Moments, now_ns};
use super::readers::Readers;
use super::site::{self, Proof};
use anyhow::{Context, bail};
use midshift_agent::dial::{Dial, TcpDial};
use midshift_core::limits;
use midshift_proto::common::v1::StopLevel;
use midshift_proto::stop::v1::attend_request::Message as Up;
use midshift_proto::stop::v1::attend_response::Message as Down;
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use midshift_proto::stop::v1::{Attend, AttendRequest, CheckIn, SilenceStage};
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;
use tokio::time::{Instant, interval_at};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

/// Lines and sockets that are being opened at once.
const OPENING: usize = 64;
/// Check-ins on their way to the wire.
const OUTBOUND: usize = 16;

/// How many have their line and their sockets, at most.
pub const ATTACHED: &str = "attached";
/// How many have the answer to a check-in that says they know a stop, and obey one.
pub const STAND: &str = "stand";
/// How many have the answer to a check-in that says they know of no stop.
pub const FREE: &str = "free";
/// How many have the answer to what they wrote to the bare loop over TLS since it was asked for last.
pub const ANSWERED_TLS: &str = "answered-tls";
/// The same of the bare loop in plain text.
pub const ANSWERED_PLAIN: &str = "answered-plain";
/// Writes down when each was told and acknowledged; the answer is how many.
pub const TAKE: &str = "take";
/// The same of the bare loop over TLS.
pub const TAKE_TLS: &str = "take-tls";
/// The same of the bare loop in plain text.
pub const TAKE_PLAIN: &str = "take-plain";

/// What to be.
#[derive(Clone, Debug, clap::Args)]
pub struct AttendArgs {
    /// The stop service, host:port.
    #[arg(long)]
    stop: String,
    /// The bare loop over TLS.
    #[arg(long)]
    tls_fan: SocketAddr,
    /// The bare loop in plain text.
    #[arg(long)]
    plain_fan: SocketAddr,
    /// First robot of this process, from 0.
    #[arg(long)]
    from: usize,
    /// One past the last.
    #[arg(long)]
    to: usize,
    /// What each of them shows.
    #[arg(long)]
    proofs: PathBuf,
    /// Where moments are written.
    #[arg(long)]
    out: PathBuf,
}

/// What is known of one robot.
#[derive(Default)]
struct Seen {
    is_synced: bool,
    stops: BTreeSet<String>,
    /// All that it was told is in a check-in that was answered.
    is_answered: bool,
    stop: Moments,
}

/// All of this process.
pub struct All {
    robots: Vec<Mutex<Seen>>,
    tls: Readers,
    plain: Readers,
    opening: Semaphore,
    args: AttendArgs,
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

impl All {
    /// None of them attached yet.
    pub fn new(args: AttendArgs) -> Self {
        let robots: Vec<_> = (args.from..args.to).map(|_| Mutex::default()).collect();
        let [tls, plain] = [robots.len(); 2].map(Readers::new);
        Self { robots, tls, plain, opening: Semaphore::new(OPENING), args }
    }
    fn count(&self, is_so: impl Fn(&Seen) -> bool) -> u64 {
        self.robots.iter().filter(|robot| is_so(&lock(robot))).count() as u64
    }
    /// See the questions.
    pub fn answer(&self, question: &str) -> u64 {
        match question {
            ATTACHED => self.count(|seen| seen.is_synced).min(self.tls.count_open()).min(self.plain.count_open()),
            STAND => self.count(|seen| !seen.stops.is_empty() && seen.is_answered),
            FREE => self.count(|seen| seen.stops.is_empty() && seen.is_answered),
            ANSWERED_TLS => self.tls.count_answered(),
            ANSWERED_PLAIN => self.plain.count_answered(),
            TAKE => self.write(&self.take_stops()),
            TAKE_TLS => self.write(&self.tls.take_moments()),
            TAKE_PLAIN => self.write(&self.plain.take_moments()),
            _ => 0,
        }
    }
    /// Takes the moments of stops and begins anew.
    fn take_stops(&self) -> Vec<Moments> {
        self.robots.iter().map(|robot| std::mem::take(&mut lock(robot).stop)).collect()
    }
    /// Writes moments down; the answer is how many.
    fn write(&self, moments: &[Moments]) -> u64 {
        let written = serde_json::to_vec(moments).ok().and_then(|text| std::fs::write(&self.args.out, text).ok());
        written.map_or(0, |()| moments.len() as u64)
    }
}

/// Keeps all of them attached until `stop`.
pub async fn run(all: Arc<All>, stop: CancellationToken) -> anyhow::Result<()> {
    let mut tasks = JoinSet::new();
    let dial = |address: &str| TcpDial::new(address, None);
    for (at, proof) in Proof::read(&all.args.proofs)?.into_iter().enumerate() {
        let tls = proof.tls()?;
        let line = dial(&format!("https://{}", all.args.stop))?.with_tls(tls.clone());
        let over_tls = dial(&format!("https://{}", all.args.tls_fan))?.with_tls(tls);
        let plain = dial(&format!("http://{}", all.args.plain_fan))?;
        let robots = all.clone();
        tasks.spawn(async move { attend(&robots, line, at).await });
        let robots = all.clone();
        tasks.spawn(async move { robots.tls.read_frames(at, over_tls, &robots.opening).await });
        let robots = all.clone();
        tasks.spawn(async move { robots.plain.read_frames(at, plain, &robots.opening).await });
    }
    tokio::select! {
        ended = tasks.join_next() => ended.context("no robots")??,
        () = stop.cancelled() => Ok(()),
    }
}

/// One robot on its stop line, to its end.
async fn attend(all: &All, dial: TcpDial, at: usize) -> anyhow::Result<()> {
    let permit = all.opening.acquire().await?;
    let channel = dial.dial().await?;
    let (up, outbound) = mpsc::channel(OUTBOUND);
    let robot_id = site::robot_id(all.args.from + at);
    let first = Attend { boot_id: format!("{robot_id}-boot"), robot_id, ..Attend::default() };
    up.send(AttendRequest { message: Some(Up::Attend(first)) }).await?;
    let mut down = StopLinkServiceClient::new(channel).attend(ReceiverStream::new(outbound)).await?.into_inner();
    let mut robot = Robot { seen: &all.robots[at], up, generation: 0, is_durable: true, nonce: 0, news: u64::MAX };
    let period = Duration::from_millis(limits::CHECK_IN.as_ms());
    // Robots do not check in at one moment.
    let mut beat = interval_at(Instant::now() + period.mul_f64((at % 1_000) as f64 / 1_000.0), period);
    let mut permit = Some(permit);
    loop {
        tokio::select! {
            message = down.message() => {
                let said = message?.context("the stop service ended the line")?;
                let message = said.message.context("the stop service says nothing")?;
                robot.take_message(message, said.facts_generation).await?;
                permit = permit.filter(|_| !lock(robot.seen).is_synced);
            }
            _ = beat.tick() => robot.check_in().await?,
        }
    }
}

/// One end of a line.
struct Robot<'a> {
    seen: &'a Mutex<Seen>,
    up: mpsc::Sender<AttendRequest>,
    generation: u64,
    is_durable: bool,
    nonce: u64,
    /// First check-in that says what it was told last.
    news: u64,
}

impl Robot<'_> {
    async fn take_message(&mut self, message: Down, facts_generation: u64) -> anyhow::Result<()> {
        let now_ns = now_ns();
        match message {
            Down::Facts(facts) => {
                let is_synced = {
                    let mut seen = lock(self.seen);
                    if !facts.stops.is_empty() {
                        seen.stop = Moments { told_ns: now_ns, acked_ns: 0 };
                    }
                    seen.stops.extend(facts.stops.into_iter().map(|stop| stop.stop_id));
                    seen.stops.retain(|stop_id| !facts.resets.iter().any(|reset| reset.stop_id == *stop_id));
                    seen.is_answered = false;
                    seen.is_synced
                };
                if is_synced {
                    self.generation = self.generation.max(facts_generation);
                    self.say_news().await?;
                }
            }
            Down::Synced(synced) => {
                self.generation = synced.generation;
                lock(self.seen).is_synced = true;
                self.say_news().await?;
            }
            Down::CheckInAnswer(answer) if answer.nonce >= self.news => {
                let mut seen = lock(self.seen);
                if !seen.is_answered {
                    seen.is_answered = true;
                    seen.stop.acked_ns = now_ns;
                }
            }
            Down::CheckInAnswer(_) => {}
            Down::MoveOver(_) => bail!("the stop service asks for another line"),
        }
        Ok(())
    }
    /// At once, and again when it is kept.
    async fn say_news(&mut self) -> anyhow::Result<()> {
        self.news = self.nonce + 1;
        self.is_durable = false;
        self.check_in().await?;
        self.is_durable = true;
        self.check_in().await
    }
    async fn check_in(&mut self) -> anyhow::Result<()> {
        self.nonce += 1;
        let inside: Vec<String> = lock(self.seen).stops.iter().cloned().collect();
        let obeys = if inside.is_empty() { StopLevel::None } else { StopLevel::Halt };
        let check_in = CheckIn {
            nonce: self.nonce,
            generation: self.generation,
            durable: self.is_durable,
            obeys: obeys.into(),
            standstill: true,
            awaiting_resume: inside.clone(),
            inside,
            silence: SilenceStage::Heard.into(),
            without_people: false,
        };
        self.up.send(AttendRequest { message: Some(Up::CheckIn(check_in)) }).await.context("the line has ended")
    }
}
