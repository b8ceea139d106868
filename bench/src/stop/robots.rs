//! Many robots on the stop service, and as many sockets on the bare fan-out, in one process.
//!
//! A robot here is the smallest one that keeps its line: it takes over what it is told, checks in once a second, and says at once what it knows, obeys and stands by,
//! then once more when it is durable, as the agent does (its file is in memory). It is resumed with the reset: nobody plans for it. It has no body and no ladder.
//! Invariant: a line or a socket that ends ends the process, so that no robot is left out of a figure. Called by children only.

use super::site::Proof;
use super::{fan, site};
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
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;
use tokio::time::{Instant, interval_at};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

/// Lines and sockets that are being opened at once.
const OPENING: usize = 64;
/// Check-ins on their way to the wire.
const OUTBOUND: usize = 16;

/// How many have both their line and their socket.
pub const ATTACHED: &str = "attached";
/// How many have the answer to a check-in that says they know a stop, and obey one.
pub const STAND: &str = "stand";
/// How many have the answer to a check-in that says they know of no stop.
pub const FREE: &str = "free";
/// How many have the answer to what they wrote to the bare fan-out since it was asked for last.
pub const ANSWERED: &str = "answered";
/// Writes down when each was told and acknowledged; the answer is how many.
pub const TAKE: &str = "take";
/// The same of the bare fan-out.
pub const TAKE_BARE: &str = "take-bare";

/// What to be.
#[derive(Clone, Debug, clap::Args)]
pub struct AttendArgs {
    /// The stop service, host:port.
    #[arg(long)]
    stop: String,
    /// The bare fan-out.
    #[arg(long)]
    fan: SocketAddr,
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

/// When one robot was told and had the answer to its acknowledgement, ns of the machine's monotonic clock.
#[derive(Clone, Copy, Debug, Default, serde::Serialize, serde::Deserialize)]
pub struct Moments {
    /// It read the stop.
    pub told_ns: u64,
    /// It read the answer to what it said then. 0: not yet.
    pub acked_ns: u64,
}

/// What is known of one robot.
#[derive(Default)]
struct Seen {
    is_synced: bool,
    has_socket: bool,
    stops: BTreeSet<String>,
    /// All that it was told is in a check-in that was answered.
    is_answered: bool,
    stop: Moments,
    bare: Moments,
}

/// All of this process.
pub struct All {
    robots: Vec<Mutex<Seen>>,
    args: AttendArgs,
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

impl All {
    /// None of them attached yet.
    pub fn new(args: AttendArgs) -> Self {
        Self { robots: (args.from..args.to).map(|_| Mutex::default()).collect(), args }
    }
    fn count(&self, is_so: impl Fn(&Seen) -> bool) -> u64 {
        self.robots.iter().filter(|robot| is_so(&lock(robot))).count() as u64
    }
    /// See the questions.
    pub fn answer(&self, question: &str) -> u64 {
        match question {
            ATTACHED => self.count(|seen| seen.is_synced && seen.has_socket),
            STAND => self.count(|seen| !seen.stops.is_empty() && seen.is_answered),
            FREE => self.count(|seen| seen.stops.is_empty() && seen.is_answered),
            ANSWERED => self.count(|seen| seen.bare.acked_ns > 0),
            TAKE => self.write(&self.args.out, |seen| &mut seen.stop),
            TAKE_BARE => self.write(&self.args.out, |seen| &mut seen.bare),
            _ => 0,
        }
    }
    /// Writes moments down and begins anew.
    fn write(&self, out: &Path, which: impl Fn(&mut Seen) -> &mut Moments) -> u64 {
        let taken = |robot| std::mem::take(which(&mut lock(robot)));
        let all: Vec<Moments> = self.robots.iter().map(taken).collect();
        let written = serde_json::to_vec(&all).ok().and_then(|text| std::fs::write(out, text).ok());
        written.map_or(0, |()| all.len() as u64)
    }
}

/// Keeps all of them attached until `stop`.
pub async fn run(all: Arc<All>, stop: CancellationToken) -> anyhow::Result<()> {
    let opening = Arc::new(Semaphore::new(OPENING));
    let mut tasks = JoinSet::new();
    for (at, proof) in Proof::read(&all.args.proofs)?.into_iter().enumerate() {
        let (line, socket) = ((all.clone(), opening.clone()), (all.clone(), opening.clone()));
        tasks.spawn(async move { attend(&line.0, &proof, at, &line.1).await });
        tasks.spawn(async move { read_fan(&socket.0, at, &socket.1).await });
    }
    tokio::select! {
        ended = tasks.join_next() => ended.context("no robots")??,
        () = stop.cancelled() => Ok(()),
    }
}

/// One robot on its stop line, to its end.
async fn attend(all: &All, proof: &Proof, at: usize, opening: &Semaphore) -> anyhow::Result<()> {
    let permit = opening.acquire().await?;
    let channel = TcpDial::new(&format!("https://{}", all.args.stop), None)?.with_tls(proof.tls()?).dial().await?;
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
        let now_ns = fan::now_ns();
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

/// One socket of the bare fan-out, to its end.
async fn read_fan(all: &All, at: usize, opening: &Semaphore) -> anyhow::Result<()> {
    let permit = opening.acquire().await?;
    let mut stream = TcpStream::connect(all.args.fan).await?;
    stream.set_nodelay(true)?;
    drop(permit);
    let seen = &all.robots[at];
    lock(seen).has_socket = true;
    let (mut frame, mut answer) = ([0; fan::FRAME_BYTES], [0; fan::ANSWER_BYTES]);
    loop {
        stream.read_exact(&mut frame).await.context("the bare fan-out ended")?;
        let told_ns = fan::now_ns();
        stream.write_all(&[1; fan::ACK_BYTES]).await?;
        stream.read_exact(&mut answer).await?;
        lock(seen).bare = Moments { told_ns, acked_ns: fan::now_ns() };
    }
}
