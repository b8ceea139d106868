//! P9: what a download costs more that is cut off. The bytes are counted where a line would carry them: in a relay between robot and server, so
//! that what was under way when it was cut off counts too.
//!
//! A connection is lost by closing it; a process is killed by SIGKILL and started again. Called by [`super::device`].

use super::noise::{Release, Releases};
use super::parts::OVER;
use crate::child::Child;
use crate::figure::Figure;
use anyhow::{Context, ensure};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt, copy};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep};
use tokio_util::task::AbortOnDropHandle;

/// A download must be over within this.
const WITHIN: Duration = Duration::from_secs(300);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(2);

/// Downloads that are cut off.
#[derive(Clone, Debug, clap::Args)]
pub struct ResumeArgs {
    /// Size of a download that is cut off, MiB.
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u64).range(2..=4_096))]
    resume_mib: u64,
    /// How many times it is cut off.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=100))]
    cuts: u64,
    /// Downloads of each kind: uncut, connections lost, processes killed.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    device_rounds: u64,
}

/// How a download is cut off.
#[derive(Clone, Copy, PartialEq)]
enum Cut {
    Never,
    Connection,
    Process,
}

/// Passes bytes on and counts those to the robot.
struct Relay {
    address: SocketAddr,
    bytes: Arc<AtomicU64>,
    /// Rises when all connections are to be closed.
    cut: watch::Sender<u64>,
    _serving: AbortOnDropHandle<()>,
}

async fn relay(
    near: TcpStream,
    server: SocketAddr,
    bytes: Arc<AtomicU64>,
    mut cut: watch::Receiver<u64>,
) -> std::io::Result<()> {
    cut.mark_unchanged();
    let far = TcpStream::connect(server).await?;
    near.set_nodelay(true)?;
    far.set_nodelay(true)?;
    let ((mut from_robot, mut to_robot), (mut from_server, mut to_server)) = (near.into_split(), far.into_split());
    let down = async {
        let mut buffer = vec![0; 16 * 1024];
        loop {
            let length = from_server.read(&mut buffer).await?;
            if length == 0 {
                return to_robot.shutdown().await;
            }
            to_robot.write_all(&buffer[..length]).await?;
            bytes.fetch_add(length as u64, Relaxed);
        }
    };
    tokio::select! {
        // Both ends are closed as they are.
        _ = cut.changed() => Ok(()),
        ended = async { tokio::try_join!(down, copy(&mut from_robot, &mut to_server)).map(drop) } => ended,
    }
}

impl Relay {
    async fn begin(server: SocketAddr) -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let (address, bytes, (cut, is_cut)) = (listener.local_addr()?, Arc::new(AtomicU64::new(0)), watch::channel(0));
        let counted = bytes.clone();
        let serving = tokio::spawn(async move {
            let mut connections = JoinSet::new();
            while let Ok((near, _)) = listener.accept().await {
                connections.spawn(relay(near, server, counted.clone(), is_cut.clone()));
            }
        });
        Ok(Self { address, bytes, cut, _serving: AbortOnDropHandle::new(serving) })
    }
    fn passed(&self) -> u64 {
        self.bytes.load(Relaxed)
    }
}

/// Downloads of each kind in turn.
pub async fn run(args: &ResumeArgs, seed: u64, room: &Path) -> anyhow::Result<Vec<Figure>> {
    let mut releases = Releases::make(&room.join("releases"))?;
    let release = releases.add(1, args.resume_mib << 20)?;
    let (data, keys) = (room.join("data"), releases.keys());
    let text = |path: &Path| path.to_str().context("a path that is no text").map(str::to_owned);
    let role = ["server", "--data", &text(&data)?, "--keys", &text(&keys)?, "--listen", "127.0.0.1:0"];
    let server = Child::start(&role, None)?.listening().await?;
    releases.push(&server).await?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let [mut uncut, mut lost, mut killed]: [Vec<f64>; 3] = Default::default();
    // The first one waits until the server has found that there is no encoded target.
    download(&server, &release, room, Cut::Never, &[]).await?;
    for _ in 0..args.device_rounds {
        for (cut, all) in [(Cut::Never, &mut uncut), (Cut::Connection, &mut lost), (Cut::Process, &mut killed)] {
            let mut points: Vec<u64> = (0..args.cuts).map(|_| rng.random_range(0..release.file.length)).collect();
            points.sort_unstable();
            all.push(download(&server, &release, room, cut, &points).await? as f64);
        }
    }
    let mib = |bytes: &[f64]| bytes.iter().map(|bytes| bytes / 1_048_576.0).collect::<Vec<_>>();
    let size = format!("{} MiB download", args.resume_mib);
    let whole = [args.resume_mib as f64];
    let mut figures =
        vec![Figure::new("P9", format!("{size}: bytes of it"), "MiB", &mib(&uncut), Some(("the file", &whole)))];
    let most = uncut.iter().copied().fold(f64::INFINITY, f64::min);
    for (word, bytes) in [("lost connections", &lost), ("killed processes", &killed)] {
        let name = format!("{size}, {} {word}", args.cuts);
        let again: Vec<f64> = bytes.iter().map(|bytes| (bytes - most) * 100.0 / most).collect();
        let each: Vec<f64> = bytes.iter().map(|bytes| (bytes - most) / 1024.0 / args.cuts as f64).collect();
        let limit = Some(("uncut", &*mib(&uncut)));
        figures.extend([
            Figure::new("P9", format!("{name}: bytes of it"), "MiB", &mib(bytes), limit),
            Figure::new("P9", format!("{name}: again, share"), "%", &again, None),
            Figure::new("P9", format!("{name}: again for each"), "KiB", &each, None),
        ]);
    }
    Ok(figures)
}

/// One download into an empty folder; bytes that came to the robot for it, until it has the whole file checked.
async fn download(server: &Child, release: &Release, room: &Path, cut: Cut, points: &[u64]) -> anyhow::Result<u64> {
    let sets = tempfile::tempdir_in(room)?;
    let relay = Relay::begin(server.address).await?;
    let (address, length) = (relay.address.to_string(), release.file.length.to_string());
    let (folder, digest) = (sets.path().to_str().context("a path that is no text")?, release.file.digest.to_string());
    let role = ["fetch", "--server", &address, "--sets", folder, "--digest", &digest, "--length", &length];
    let mut robot = Child::start(&role, None)?;
    let (end, mut points) = (Instant::now() + WITHIN, points.iter().copied().peekable());
    let mut cuts = 0;
    while robot.ask(OVER)? == 0 {
        ensure!(Instant::now() < end, "a download of {length} bytes was not over within {WITHIN:?}");
        if cut != Cut::Never && points.next_if(|at| relay.passed() >= *at).is_some() {
            cuts += 1;
            match cut {
                Cut::Process => {
                    drop(robot);
                    relay.cut.send_modify(|cuts| *cuts += 1);
                    robot = Child::start(&role, None)?;
                }
                _ => relay.cut.send_modify(|cuts| *cuts += 1),
            }
        }
        sleep(LOOK_EVERY).await;
    }
    ensure!(cut == Cut::Never || points.peek().is_none(), "only {cuts} cuts came before the end");
    Ok(relay.passed())
}
