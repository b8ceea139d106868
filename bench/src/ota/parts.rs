//! Children of the measurements of software: a server with releases, a robot with a real agent, a robot that only asks, bare TCP, and a
//! download alone.
//!
//! Invariant: clocks of all of them are this machine's, so moments can be compared. Called by [`crate::child`].

use crate::questions::answer_questions;
use crate::robot;
use anyhow::Context;
use midshift::robots::{AgentRun, Config, IdentityFlags, StopFlags};
use midshift_agent::bulk::Bulk;
use midshift_agent::dial::TcpDial;
use midshift_agent::sets::FileRef;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::update::io::{UpdateWorker, Worker};
use midshift_agent::update::remote::GrpcRemote;
use midshift_agent::update::{Done, Failure, Job};
use midshift_core::robot::Lane;
use midshift_core::time::Clock;
use midshift_server::serve::{Serve, Software};
use midshift_sim::faults::Injected;
use midshift_sim::handle::SimHandle;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// Makes a robot's body jam; the answer is the moment, UTC unix ms.
pub const JAM: &str = "jam";
/// A person mends it.
pub const MEND: &str = "mend";
/// Writes down what was measured since the last time; the answer is how many.
pub const TAKE: &str = "take";
/// Begins to take a bare stream in.
pub const PULL: &str = "pull";
/// Leaves it.
pub const LEAVE: &str = "leave";
/// Whether a download is over: 1 if it is.
pub const OVER: &str = "over";

/// Time between two events of the robot that only asks.
const ASK_EVERY: Duration = Duration::from_millis(100);
/// Time between two of its heartbeats.
const BEAT_EVERY: Duration = Duration::from_millis(250);
/// Time between two bare echoes.
const ECHO_EVERY: Duration = Duration::from_millis(50);
/// Bytes of a bare echo: a heartbeat with a STATUS sample has about as many.
pub const ECHO_BYTES: usize = 256;
/// A download that failed is tried again after this.
const AGAIN: Duration = Duration::from_millis(20);

/// Milliseconds of what was measured, by what it was.
#[derive(Debug, Default, serde::Serialize, serde::Deserialize)]
pub struct Taken {
    /// From an EVENT's making to its acknowledgement at the robot.
    pub acks_ms: Vec<f64>,
    /// From a heartbeat's sending to its echo at the robot.
    pub echoes_ms: Vec<f64>,
    /// From a bare message's sending to its return.
    pub bare_ms: Vec<f64>,
}

/// What a child of these is.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Part {
    /// `midshift serve` with releases, on any address.
    Server {
        #[arg(long)]
        data: PathBuf,
        #[arg(long)]
        keys: PathBuf,
        #[arg(long)]
        listen: SocketAddr,
    },
    /// What `midshift agent run` runs, without a launcher: it stages and never switches.
    Agent {
        #[arg(long)]
        server: String,
        #[arg(long)]
        robot: String,
        /// Its folder, with trust.json.
        #[arg(long)]
        home: PathBuf,
    },
    /// A robot that sends events and heartbeats and measures how long their answers take.
    Asker {
        #[arg(long)]
        server: String,
        /// Where [`Taken`] is written.
        #[arg(long)]
        out: PathBuf,
    },
    /// Bare TCP: messages that come back, and a stream.
    Bare {
        #[arg(long)]
        echo: SocketAddr,
        #[arg(long)]
        stream: SocketAddr,
        #[arg(long)]
        out: PathBuf,
    },
    /// A robot's download of one file, tried again until it is there.
    Fetch {
        #[arg(long)]
        server: String,
        /// Its folder of sets.
        #[arg(long)]
        sets: PathBuf,
        #[arg(long)]
        digest: String,
        #[arg(long)]
        length: u64,
    },
}

/// Plays a part until `stop`. `address` is one that nobody has, for parts that have none of their own.
pub async fn play(part: Part, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    match part {
        Part::Server { data, keys, listen } => serve(data, keys, listen, stop).await,
        Part::Agent { server, robot, home } => agent(server, robot, &home, address, stop).await,
        Part::Asker { server, out } => {
            let taken = Arc::new(Mutex::new(Taken::default()));
            let measured = taken.clone();
            answer_questions(address, stop.clone(), move |_| write(&out, &taken))?;
            tokio::select! {
                ended = ask(&server, &measured) => ended,
                () = stop.cancelled() => Ok(()),
            }
        }
        Part::Bare { echo, stream, out } => bare(echo, stream, out, address, stop).await,
        Part::Fetch { server, sets, digest, length } => {
            let wanted = FileRef { digest: digest.parse().ok().context("no digest")?, length };
            let is_over = Arc::new(AtomicBool::new(false));
            let told = is_over.clone();
            answer_questions(address, stop.clone(), move |_| u64::from(told.load(Relaxed)))?;
            tokio::select! {
                ended = fetch(&server, &sets, wanted) => ended?,
                () = stop.cancelled() => return Ok(()),
            }
            is_over.store(true, Relaxed);
            stop.cancelled().await;
            Ok(())
        }
    }
}

/// A server of everything but stops, in plain text, with room for so much software.
pub fn insecure_server(data: PathBuf, listen: SocketAddr, ota_keys: Option<PathBuf>, ota_quota_gib: u64) -> Serve {
    Serve {
        roles: Vec::new(),
        drain_seconds: None,
        no_software: false,
        stop_listen: SocketAddr::from(([127, 0, 0, 1], midshift_core::stop::PORT)),
        init_stop: false,
        no_stop: true,
        log: Default::default(),
        site: None,
        data,
        listen,
        insecure: true,
        names: Vec::new(),
        first_token_file: None,
        root_file: None,
        identity: None,
        spare_token: false,
        force_map: false,
        share: Default::default(),
        keep: Default::default(),
        trust: None,
        database: Default::default(),
        beacon_listen: None,
        software: Software { ota_keys, ota_quota_gib, ota_spare_gib: 0, ota_keep_days: 7 },
    }
}

async fn serve(data: PathBuf, keys: PathBuf, listen: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    let free = std::net::TcpListener::bind(listen).with_context(|| format!("listening on {listen}"))?;
    let listen = free.local_addr()?;
    drop(free);
    answer_questions(listen, stop.clone(), |_| 0)?;
    midshift_server::serve::run(insecure_server(data, listen, Some(keys), 64), stop, &|_| ()).await
}

async fn agent(
    server: String,
    robot: String,
    home: &Path,
    address: SocketAddr,
    stop: CancellationToken,
) -> anyhow::Result<()> {
    let held: Arc<OnceLock<(SimHandle, Arc<dyn Clock>)>> = Arc::default();
    let in_hand = held.clone();
    answer_questions(address, stop.clone(), move |what| {
        let Some((body, clock)) = in_hand.get() else { return 0 };
        let now = clock.now();
        match what {
            JAM => body.inject(now.site, Injected::Jam),
            MEND => body.lock().clear(now.site),
            _ => return 0,
        }
        now.wall.0.unsigned_abs()
    })?;
    let config = Config {
        robot_id: robot,
        server,
        data: home.join("data"),
        enroll_file: None,
        sets: Some(home.join("sets")),
        trust: Some(home.join("trust.json")),
        clock_unsynced: false,
        identity: IdentityFlags::default(),
        stop: StopFlags::default(),
    };
    let run = AgentRun { config, site: None, start: None, seed: 1, body_speed: 1.0, no_faults: true, person: false };
    let hand = move |body: &SimHandle, clock: &Arc<dyn Clock>| {
        // Nobody else sets it.
        let _ = held.set((body.clone(), clock.clone()));
    };
    midshift::robots::agent_in_hand(run, hand, stop).await?;
    Ok(())
}

/// Writes down what was measured and begins anew; how many values it was, 0 if it could not be written.
fn write(out: &Path, taken: &Mutex<Taken>) -> u64 {
    let taken = std::mem::take(&mut *taken.lock().unwrap_or_else(PoisonError::into_inner));
    let written = serde_json::to_vec(&taken).ok().and_then(|text| std::fs::write(out, text).ok());
    written.map_or(0, |()| (taken.acks_ms.len() + taken.echoes_ms.len() + taken.bare_ms.len()) as u64)
}

fn ms_since(begun: Instant) -> f64 {
    begun.elapsed().as_secs_f64() * 1e3
}

/// A number that is waited for, and since when.
type Asked = Option<(u64, Instant)>;

async fn ask(server: &str, taken: &Mutex<Taken>) -> anyhow::Result<()> {
    let (mut sender, mut receiver, _) = robot::attach(server, "asker", None).await?;
    let (mut events, mut beats) = (tokio::time::interval(ASK_EVERY), tokio::time::interval(BEAT_EVERY));
    let [mut event, mut beat]: [Asked; 2] = [None, None];
    loop {
        tokio::select! {
            heard = receiver.receive() => {
                let (heard, mut taken) = (heard?, taken.lock().unwrap_or_else(PoisonError::into_inner));
                let durable = heard.acks.iter().filter(|ack| ack.lane == Lane::Event).map(|ack| ack.seq).max();
                if let (Some(seq), Some((asked, begun))) = (durable, event) && seq >= asked {
                    taken.acks_ms.push(ms_since(begun));
                    event = None;
                }
                if let (Some(echo), Some((asked, begun))) = (&heard.echo, beat) && echo.hb >= asked {
                    taken.echoes_ms.push(ms_since(begun));
                    beat = None;
                }
            }
            _ = events.tick() => if event.is_none() {
                let begun = Instant::now();
                sender.send_mode().await?;
                event = Some((sender.produced(Lane::Event), begun));
            },
            _ = beats.tick() => if beat.is_none() {
                let begun = Instant::now();
                sender.beat(false).await?;
                beat = Some((sender.reported.hb, begun));
            },
        }
    }
}

async fn bare(
    echo: SocketAddr,
    stream: SocketAddr,
    out: PathBuf,
    address: SocketAddr,
    stop: CancellationToken,
) -> anyhow::Result<()> {
    let taken = Arc::new(Mutex::new(Taken::default()));
    let (measured, (asked, pulls)) = (taken.clone(), watch::channel(false));
    answer_questions(address, stop.clone(), move |what| match what {
        TAKE => write(&out, &taken),
        _ => u64::from(asked.send_replace(what == PULL)),
    })?;
    tokio::select! {
        ended = echoes(echo, &measured) => ended,
        ended = pull(stream, pulls) => ended,
        () = stop.cancelled() => Ok(()),
    }
}

async fn echoes(server: SocketAddr, taken: &Mutex<Taken>) -> anyhow::Result<()> {
    let mut stream = TcpStream::connect(server).await?;
    stream.set_nodelay(true)?;
    let (mut every, mut message) = (tokio::time::interval(ECHO_EVERY), [7; ECHO_BYTES]);
    loop {
        every.tick().await;
        let begun = Instant::now();
        stream.write_all(&message).await?;
        stream.read_exact(&mut message).await?;
        taken.lock().unwrap_or_else(PoisonError::into_inner).bare_ms.push(ms_since(begun));
    }
}

/// Takes the stream in while it is asked for.
async fn pull(server: SocketAddr, mut asked: watch::Receiver<bool>) -> anyhow::Result<()> {
    let mut buffer = vec![0; 256 * 1024];
    loop {
        asked.wait_for(|asked| *asked).await?;
        let mut stream = TcpStream::connect(server).await?;
        while *asked.borrow() {
            anyhow::ensure!(stream.read(&mut buffer).await? > 0, "the stream ended");
        }
    }
}

async fn fetch(server: &str, sets: &Path, wanted: FileRef) -> anyhow::Result<()> {
    let remote = GrpcRemote::new(Bulk::new(Arc::new(TcpDial::bulk(&midshift_cli::endpoint::uri(server), None)?)));
    let mut worker = UpdateWorker::new(Box::new(DiskSets::open(sets)?), Arc::new(remote));
    loop {
        let job = Job::Fetch { wanted, bases: Vec::new(), rate_bytes_s: 0 };
        match worker.work(job, CancellationToken::new()).await {
            Done::Ok => return Ok(()),
            Done::Failed(Failure::Later(_)) => tokio::time::sleep(AGAIN).await,
            other => anyhow::bail!("the download ended: {other:?}"),
        }
    }
}
