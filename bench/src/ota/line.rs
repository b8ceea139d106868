//! What reaches the server of a robot while it downloads a release at line rate: battery, joint temperature and error code, events, heartbeats,
//! and a fault, without the download and with it in turn.
//!
//! The line is a network namespace with both ways shaped ([`super::netns`]). In it: a real agent with a simulated body, a second robot that
//! only asks and measures answers, and bare TCP. Outside: a real server. All clocks are this machine's.
//! Invariant: it ends by itself, and nothing of it stays: processes and namespace go with the future, however it ends.

use super::heard::{Ages, Watcher, ages, fault_durable_ms};
use super::netns::{self, Namespace};
use super::noise::{Release, Releases};
use super::parts::{JAM, LEAVE, MEND, PULL, TAKE, Taken};
use crate::child::Child;
use crate::figure::{Figure, percentile};
use crate::fsync::place;
use anyhow::{Context, bail, ensure};
use midshift_core::robot::FAULT_JAM;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::rollout_wave::Size;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, sleep, timeout};
use tokio_util::task::AbortOnDropHandle;
use tonic::transport::Channel;

/// The robot that downloads.
const ROBOT: &str = "loader";
/// How often the line's counters are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Everything else than the line must have happened by then.
const WITHIN: Duration = Duration::from_secs(60);
/// Before each leg, what was begun before it settles.
const SETTLE: Duration = Duration::from_secs(3);
/// A line that was not half full for so long carries no download any more: one waits for its disk now and then.
const QUIET: Duration = Duration::from_secs(2);
/// A download of a leg may take so many times as long as the line would.
const SLOW_TIMES: u64 = 3;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct LineArgs {
    /// Rate of the line in both directions, Mbit/s.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    mbit: u32,
    /// Seconds of each leg: the releases are as large as the line carries in them.
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u64).range(3..=600))]
    leg_seconds: u64,
    /// Rounds of each: a quiet line, a download, a bare stream.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    line_rounds: u64,
}

impl LineArgs {
    fn leg(&self) -> Duration {
        Duration::from_secs(self.leg_seconds)
    }
    /// What the line carries in a leg, bytes.
    fn release_bytes(&self) -> u64 {
        u64::from(self.mbit) * 1_000_000 / 8 * self.leg_seconds
    }
    /// All of it must be over by then.
    fn longest(&self) -> Duration {
        WITHIN * 4 + (self.leg() * (3 + SLOW_TIMES as u32) + 4 * WITHIN) * self.line_rounds as u32
    }
}

/// What one leg came to. Moments are UTC unix ms.
#[derive(Debug)]
struct Leg {
    stretch: RangeInclusive<i64>,
    /// From a jam of the body until the server had it.
    jam: Jam,
    /// Megabits a second that went to the robot, with all headers.
    mbit_s: f64,
    taken: Taken,
}

/// From a jam of the body until the server had it, milliseconds.
#[derive(Clone, Copy, Debug)]
struct Jam {
    /// As a durable event of lane CRITICAL.
    event_ms: f64,
    /// As the error code of a heartbeat.
    code_ms: f64,
}

/// All legs of a kind, with what the server had in each.
#[derive(Default)]
struct Kind {
    legs: Vec<Leg>,
    ages: Vec<Ages>,
}

/// A stream of bytes over the line with nothing of midshift.
struct Stream {
    mbit_s: f64,
    bare_ms: Vec<f64>,
}

/// Runs rounds of a quiet line, a download and a bare stream, in turn.
///
/// # Errors
/// What is missing here to make such a line; anything that did not happen in its time.
pub async fn run(args: &LineArgs, dir: Option<&PathBuf>) -> anyhow::Result<Vec<Figure>> {
    let missing = netns::missing();
    if !missing.is_empty() {
        bail!(
            "a line with a rate is a network namespace (ip and tc of iproute2, as root); missing: {}",
            missing.join(", ")
        );
    }
    timeout(args.longest(), measure(args, dir)).await.context("it took too long")?
}

async fn measure(args: &LineArgs, dir: Option<&PathBuf>) -> anyhow::Result<Vec<Figure>> {
    let room = place(dir)?;
    let mut releases = Releases::make(&room.path().join("releases"))?;
    let loads: Vec<Release> =
        (0..args.line_rounds).map(|round| releases.add(round, args.release_bytes())).collect::<Result<_, _>>()?;
    let line = Namespace::make(args.mbit)?;
    let data = room.path().join("data");
    let mut stage = Stage::set(&line, &releases, room.path(), &data).await?;
    releases.push(&stage.server).await?;
    let (mut quiet, mut loaded, mut streams) = (Kind::default(), Kind::default(), Vec::new());
    for load in &loads {
        quiet.legs.push(stage.leg(args.leg()).await?);
        loaded.legs.push(stage.download(args, load).await?);
        streams.push(stage.stream(args.leg() / 4).await?);
    }
    let beats = stage.watcher.beats();
    // Its record is read when nobody writes it.
    drop(stage);
    for kind in [&mut quiet, &mut loaded] {
        let stretches: Vec<_> = kind.legs.iter().map(|leg| leg.stretch.clone()).collect();
        kind.ages = ages(&data, ROBOT, &beats, &stretches).await?;
    }
    Ok(figures(args, &quiet, &loaded, &streams))
}

/// Everybody on both ends of the line.
struct Stage<'a> {
    line: &'a Namespace,
    watcher: Watcher,
    channel: Channel,
    rollouts: RolloutServiceClient<Channel>,
    agent: Child,
    asker: (Child, PathBuf),
    bare: (Child, PathBuf),
    server: Child,
    _bare_server: [AbortOnDropHandle<()>; 2],
}

fn text(path: &Path) -> anyhow::Result<&str> {
    path.to_str().context("a path that is no text")
}

/// What a child measured since the last time.
fn read_moments((child, out): &mut (Child, PathBuf)) -> anyhow::Result<Taken> {
    ensure!(child.ask(TAKE)? > 0, "a child measured nothing, or could not write it to {}", out.display());
    Ok(serde_json::from_slice(&std::fs::read(out)?)?)
}

/// Does something with each connection to an address of the line, until the handle is dropped.
async fn on_line<F>(line: &Namespace, serve: fn(TcpStream) -> F) -> anyhow::Result<(SocketAddr, AbortOnDropHandle<()>)>
where
    F: Future<Output = std::io::Result<()>> + Send + 'static,
{
    let listener = TcpListener::bind((line.here, 0)).await.with_context(|| format!("listening on {}", line.here))?;
    let address = listener.local_addr()?;
    let serving = tokio::spawn(async move {
        let mut connections = tokio::task::JoinSet::new();
        while let Ok((stream, _)) = listener.accept().await {
            connections.spawn(serve(stream));
        }
    });
    Ok((address, AbortOnDropHandle::new(serving)))
}

async fn echo(mut stream: TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let mut buffer = [0; 4 * super::parts::ECHO_BYTES];
    loop {
        match stream.read(&mut buffer).await? {
            0 => return Ok(()),
            length => stream.write_all(&buffer[..length]).await?,
        }
    }
}

async fn pour(mut stream: TcpStream) -> std::io::Result<()> {
    let bytes = vec![0; 64 * 1024];
    loop {
        stream.write_all(&bytes).await?;
    }
}

impl<'a> Stage<'a> {
    /// Starts everybody and waits until the robot is heard.
    async fn set(line: &'a Namespace, releases: &Releases, room: &Path, data: &Path) -> anyhow::Result<Stage<'a>> {
        let (keys, listen) = (releases.keys(), format!("{}:0", line.here));
        let role = ["server", "--data", text(data)?, "--keys", text(&keys)?, "--listen", &listen];
        let server = Child::start(&role, None)?.listening().await?;
        let (echoes, echoing) = on_line(line, echo).await?;
        let (pours, pouring) = on_line(line, pour).await?;
        let (address, entry) = (server.address.to_string(), line.entry());
        let home = room.join("robot");
        std::fs::create_dir_all(&home)?;
        releases.trust()?.write(&home.join("trust.json"))?;
        let role = ["agent", "--server", &address, "--robot", ROBOT, "--home", text(&home)?];
        let agent = Child::start_in(&entry, &role, None)?;
        let (asked, measured) = (room.join("asked.json"), room.join("bare.json"));
        let asker = Child::start_in(&entry, &["asker", "--server", &address, "--out", text(&asked)?], None)?;
        let (echoes, pours) = (echoes.to_string(), pours.to_string());
        let role = ["bare", "--echo", &echoes, "--stream", &pours, "--out", text(&measured)?];
        let bare = Child::start_in(&entry, &role, None)?;
        let channel = server.channel().await?;
        let watcher = Watcher::begin(channel.clone(), ROBOT);
        watcher.until(0, WITHIN, "the robot's first heartbeat", |_| true).await?;
        let rollouts = RolloutServiceClient::new(channel.clone());
        let _bare_server = [echoing, pouring];
        let (asker, bare) = ((asker, asked), (bare, measured));
        Ok(Self { line, watcher, channel, rollouts, agent, asker, bare, server, _bare_server })
    }

    /// Lets everything settle and forgets what was measured before.
    async fn settle(&mut self) -> anyhow::Result<()> {
        sleep(SETTLE).await;
        read_moments(&mut self.asker)?;
        read_moments(&mut self.bare).map(drop)
    }

    fn taken(&mut self) -> anyhow::Result<Taken> {
        Ok(Taken { bare_ms: read_moments(&mut self.bare)?.bare_ms, ..read_moments(&mut self.asker)? })
    }

    /// The body jams; when the server has it, a person mends it.
    async fn jam(&mut self) -> anyhow::Result<Jam> {
        let jammed_ms = i64::try_from(self.agent.ask(JAM)?)?;
        let told = self.watcher.until(jammed_ms, WITHIN, "the jam", |beat| beat.code == Some(FAULT_JAM)).await?;
        // The heartbeat does not wait until the event is durable.
        let end = Instant::now() + WITHIN;
        let event = loop {
            if let Some(event) = fault_durable_ms(self.channel.clone(), ROBOT, FAULT_JAM, jammed_ms).await? {
                break event;
            }
            ensure!(Instant::now() < end, "the server has the error code and no event of it");
            sleep(LOOK_EVERY).await;
        };
        let mended_ms = i64::try_from(self.agent.ask(MEND)?)?;
        self.watcher.until(mended_ms, WITHIN, "the end of the jam", |beat| beat.code.is_none()).await?;
        Ok(Jam { event_ms: (event - jammed_ms) as f64, code_ms: (told.at_ms - jammed_ms) as f64 })
    }

    /// Nothing but robots that report.
    async fn leg(&mut self, long: Duration) -> anyhow::Result<Leg> {
        self.settle().await?;
        let (begun, from_ms, bytes) = (Instant::now(), midshift_agent::clock::wall().0, self.line.bytes_down()?);
        sleep(long / 2).await;
        let jam = self.jam().await?;
        sleep(long.saturating_sub(begun.elapsed())).await;
        let mbit_s = self.rate(bytes, begun)?;
        Ok(Leg { stretch: from_ms..=midshift_agent::clock::wall().0, jam, mbit_s, taken: self.taken()? })
    }

    fn rate(&self, bytes: u64, begun: Instant) -> anyhow::Result<f64> {
        Ok((self.line.bytes_down()? - bytes) as f64 * 8e-6 / begun.elapsed().as_secs_f64())
    }

    /// As [`Stage::leg`], while the robot downloads a release; from when its bytes fill at least half the line until they do not.
    async fn download(&mut self, args: &LineArgs, load: &Release) -> anyhow::Result<Leg> {
        let end = Instant::now() + args.leg() * SLOW_TIMES as u32 + WITHIN;
        self.start(load).await?;
        while self.measure_share(args).await? < 0.5 {
            ensure!(Instant::now() < end, "no download began");
        }
        read_moments(&mut self.asker)?;
        read_moments(&mut self.bare)?;
        let (begun, from_ms, bytes) = (Instant::now(), midshift_agent::clock::wall().0, self.line.bytes_down()?);
        sleep(args.leg() / 2).await;
        let jam = self.jam().await?;
        let (mut to_ms, mut mbit_s, mut filled) = (0, 0.0, Instant::now());
        while filled.elapsed() < QUIET {
            ensure!(Instant::now() < end, "the download did not end");
            if self.measure_share(args).await? >= 0.5 {
                (to_ms, mbit_s, filled) = (midshift_agent::clock::wall().0, self.rate(bytes, begun)?, Instant::now());
            }
        }
        let taken = self.taken()?;
        ensure!(to_ms > from_ms, "the download was over before the middle of its leg");
        // It came whole and is what was signed.
        self.watcher.until(to_ms, WITHIN, "the release to be staged", |beat| beat.is_staged).await?;
        self.abort(load).await?;
        Ok(Leg { stretch: from_ms..=to_ms, jam, mbit_s, taken })
    }

    /// Share of the line that is in use now.
    async fn measure_share(&self, args: &LineArgs) -> anyhow::Result<f64> {
        let (begun, bytes) = (Instant::now(), self.line.bytes_down()?);
        sleep(LOOK_EVERY).await;
        Ok(self.rate(bytes, begun)? / f64::from(args.mbit))
    }

    /// A bare stream instead of a download.
    async fn stream(&mut self, long: Duration) -> anyhow::Result<Stream> {
        self.settle().await?;
        self.bare.0.ask(PULL)?;
        sleep(SETTLE).await;
        read_moments(&mut self.bare)?;
        let (begun, bytes) = (Instant::now(), self.line.bytes_down()?);
        sleep(long).await;
        let (mbit_s, bare_ms) = (self.rate(bytes, begun)?, read_moments(&mut self.bare)?.bare_ms);
        self.bare.0.ask(LEAVE)?;
        Ok(Stream { mbit_s, bare_ms })
    }

    /// Rolls a release out to the robot. Without a launcher it downloads and stages it, and never switches.
    async fn start(&mut self, load: &Release) -> anyhow::Result<()> {
        let (rollout_id, etag, reason) = (load.bundle.clone(), String::new(), String::new());
        let robot_ids = vec![ROBOT.to_owned()];
        let spec = v1::RolloutSpec {
            bundle: load.bundle.clone(),
            selector: Some(v1::RolloutSelector { robot_ids, ..v1::RolloutSelector::default() }),
            waves: vec![v1::RolloutWave { size: Some(Size::Rest(true)) }],
            allow_full_push: true,
            ..v1::RolloutSpec::default()
        };
        let to = &mut self.rollouts;
        to.create_rollout(v1::CreateRolloutRequest { rollout_id: rollout_id.clone(), spec: Some(spec) }).await?;
        let (id, tag, why) = (rollout_id.clone(), etag.clone(), reason.clone());
        to.submit_rollout(v1::SubmitRolloutRequest { rollout_id: id, etag: tag, reason: why }).await?;
        let (id, tag, why) = (rollout_id.clone(), etag.clone(), reason.clone());
        to.approve_rollout(v1::ApproveRolloutRequest { rollout_id: id, etag: tag, reason: why }).await?;
        to.start_rollout(v1::StartRolloutRequest { rollout_id, etag, reason, supersede: false }).await?;
        Ok(())
    }

    /// Ends the roll-out; the robot forgets the release.
    async fn abort(&mut self, load: &Release) -> anyhow::Result<()> {
        let end = Instant::now() + WITHIN;
        loop {
            let request = v1::GetRolloutRequest { rollout_id: load.bundle.clone() };
            let rollout = self.rollouts.get_rollout(request).await?.into_inner().rollout.unwrap_or_default();
            match rollout.phase() {
                v1::RolloutPhase::Aborted => return Ok(()),
                v1::RolloutPhase::Aborting | v1::RolloutPhase::RollingBack => {}
                _ => {
                    let (rollout_id, etag, reason) = (load.bundle.clone(), rollout.etag.clone(), String::new());
                    let asked = self.rollouts.abort_rollout(v1::AbortRolloutRequest { rollout_id, etag, reason }).await;
                    // It moved on meanwhile: looked at again.
                    if let Err(status) = asked
                        && status.code() != tonic::Code::Aborted
                    {
                        return Err(status.into());
                    }
                }
            }
            ensure!(Instant::now() < end, "{} is still {:?}", load.bundle, rollout.phase());
            sleep(LOOK_EVERY).await;
        }
    }
}

fn figures(args: &LineArgs, quiet: &Kind, loaded: &Kind, streams: &[Stream]) -> Vec<Figure> {
    let rates: Vec<f64> = loaded.legs.iter().map(|leg| leg.mbit_s).collect();
    let raw: Vec<f64> = streams.iter().map(|stream| stream.mbit_s).collect();
    let name = format!("download over {} Mbit/s", args.mbit);
    let mut figures = vec![Figure::new("P9", name, "Mbit/s", &rates, Some(("bare TCP stream, same line", &raw)))];
    for (kind, word) in [(quiet, "quiet"), (loaded, "download")] {
        figures.extend(kind.figures(word));
    }
    for (share, word) in SHARES {
        let beside: Vec<f64> = streams.iter().map(|stream| percentile(&stream.bare_ms, share)).collect();
        let alone: Vec<f64> = quiet.legs.iter().map(|leg| percentile(&leg.taken.bare_ms, share)).collect();
        let name = format!("bare stream: bare TCP echo, {word}");
        let limit = format!("bare TCP echo, quiet line, {word}");
        figures.push(Figure::new("P9", name, "ms", &beside, Some((&limit, &alone))));
    }
    figures
}

/// What a figure stands beside.
#[derive(Clone, Copy)]
enum Against {
    /// What the line itself takes.
    Echo,
    /// What the protocol waits by design.
    Period,
}

/// Milliseconds between heartbeats.
const PERIOD: (&str, &[f64]) = ("period of heartbeats", &[1_000.0]);

const SHARES: [(f64, &str); 2] = [(0.5, "p50"), (0.99, "p99")];

impl Kind {
    fn figures(&self, word: &str) -> Vec<Figure> {
        let mut figures = Vec::new();
        let name = |what: &str| format!("{word}: {what}");
        let mut tell = |what: &str, each: &[&Vec<f64>], against: Against| {
            for (share, p) in SHARES {
                let values: Vec<f64> = each.iter().map(|values| percentile(values, share)).collect();
                let bare: Vec<f64> = self.legs.iter().map(|leg| percentile(&leg.taken.bare_ms, share)).collect();
                let echo = format!("bare TCP echo, same leg, {p}");
                let limit = match against {
                    Against::Echo => (&*echo, &*bare),
                    Against::Period => PERIOD,
                };
                figures.push(Figure::new("P9", name(&format!("{what}, {p}")), "ms", &values, Some(limit)));
            }
        };
        let of_ages = |what: fn(&Ages) -> &Vec<f64>| self.ages.iter().map(what).collect::<Vec<_>>();
        let of_legs = |what: fn(&Leg) -> &Vec<f64>| self.legs.iter().map(what).collect::<Vec<_>>();
        tell("battery, joint, error code known", &of_ages(|ages| &ages.known_ms), Against::Echo);
        tell("the same durable, a heartbeat later", &of_ages(|ages| &ages.durable_ms), Against::Period);
        tell("between two heartbeats", &of_ages(|ages| &ages.between_ms), Against::Period);
        tell("heartbeat to its echo", &of_legs(|leg| &leg.taken.echoes_ms), Against::Echo);
        tell("EVENT to its ack", &of_legs(|leg| &leg.taken.acks_ms), Against::Echo);
        let jams = |what: fn(&Jam) -> f64| self.legs.iter().map(|leg| what(&leg.jam)).collect::<Vec<_>>();
        let event = name("a jam to its CRITICAL event, durable");
        figures.push(Figure::new("P9", event, "ms", &jams(|jam| jam.event_ms), Some(PERIOD)));
        let code = name("a jam to its error code in a heartbeat");
        figures.push(Figure::new("P9", code, "ms", &jams(|jam| jam.code_ms), Some(PERIOD)));
        let samples: Vec<f64> = self.ages.iter().map(|ages| ages.known_ms.len() as f64).collect();
        let seconds = |leg: &Leg| (leg.stretch.end() - leg.stretch.start()) as f64 / 1e3;
        let expected: Vec<f64> = self.legs.iter().map(|leg| seconds(leg) / 2.0).collect();
        let limit = Some(("one each 2 s", &*expected));
        figures.push(Figure::new("P9", name("STATUS samples of a leg"), "samples", &samples, limit));
        figures
    }
}
