//! P8: from an engaged stop to its acknowledgement by every robot, in turn with a bare loop that writes to as many sockets of the same process under the
//! same load.
//!
//! Invariant: the stop service is a process of its own on the first core, as is the bare loop; robots are on the others; robots' check-ins go on in the turns of both.
//! Called by `main`. Rooms: here the turns and figures; `scene` what goes on beside; `site` who may come in; `robots`, `fan` and `pull` are children.

mod fan;
mod pull;
mod robots;
mod scene;
mod site;

use crate::child::Child;
use crate::figure::{Figure, percentile};
use crate::link;
use crate::ota::{Told, unless_stopped};
use anyhow::{Context, ensure};
use midshift::door::Share;
use midshift_core::limits::CONNECTIONS_MAX;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::stop::v1::{EngageRequest, Fleet, ResetRequest, Scope, scope};
use robots::{ANSWERED, ATTACHED, FREE, Moments, STAND, TAKE, TAKE_BARE};
use site::Site;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

/// Sizes of the fleet unless told otherwise, or as many as the limit of open files allows.
const ROBOTS: [usize; 2] = [1_000, 10_000];
/// Processes that the robots are split over.
const SIMULATORS: usize = 2;
/// All robots are attached by then.
const ATTACH_WITHIN: Duration = Duration::from_secs(300);
/// A turn is over by then.
const TURN_WITHIN: Duration = Duration::from_secs(60);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct StopArgs {
    /// Robots; more than once: each size by itself. Without it 1,000 and 10,000, or as many as the limit of open files allows.
    #[arg(long)]
    robots: Vec<usize>,
    /// What goes on beside; more than once: each by itself. Without it all of them.
    #[arg(long, value_enum)]
    beside: Vec<scene::Beside>,
    /// Turns of each: a stop, a bare write loop.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=100))]
    rounds: u64,
    /// Milliseconds before each turn in which the one before settles.
    #[arg(long, default_value_t = 1_000)]
    settle_ms: u64,
    /// Where everything is made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    dir: Option<PathBuf>,
}

/// Children of this measurement.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Part {
    /// `midshift-stop` on a data directory.
    StopServe {
        /// The data directory.
        #[arg(long)]
        data: PathBuf,
    },
    /// The bare loop.
    Fan,
    /// Robots on both.
    Attend(robots::AttendArgs),
    /// Downloads without an end.
    Pull(pull::PullArgs),
}

/// Plays a part until `stop`. `address` is one that nobody has.
pub async fn play(part: Part, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    match part {
        Part::StopServe { data } => {
            crate::questions::answer_questions(address, stop.clone(), |_| 0)?;
            let serve = midshift_stop::program::Args {
                site: None,
                data,
                listen: address,
                insecure: false,
                // All robots of a run come from one address.
                share: Share { connections_per_address: Some(CONNECTIONS_MAX), ..Share::default() },
                log: Default::default(),
                follows: false,
            };
            midshift_stop::program::run(serve, stop).await
        }
        Part::Fan => fan::serve(address, stop).await,
        Part::Attend(args) => {
            let all = Arc::new(robots::All::of(args));
            let asked = all.clone();
            crate::questions::answer_questions(address, stop.clone(), move |question| asked.answer(question))?;
            robots::run(all, stop).await
        }
        Part::Pull(args) => pull::run(args, address, stop).await,
    }
}

/// Runs every size and situation. What cannot be made here is named and takes no other with it; Ctrl-C and SIGTERM end all, and what was made goes.
pub async fn run(args: StopArgs, say: &dyn Fn(&str)) -> Told {
    let mut told = Told::default();
    let ended = unless_stopped(all(&args, &mut told, say)).await;
    told.failed.extend(ended);
    told
}

async fn all(args: &StopArgs, told: &mut Told, say: &dyn Fn(&str)) {
    let sizes = if args.robots.is_empty() { ROBOTS.to_vec() } else { args.robots.clone() };
    for wanted in sizes {
        let robots = match link::allowed(Some(wanted)) {
            Ok((robots, note)) => {
                note.iter().for_each(|note| say(note));
                robots
            }
            Err(error) => return told.failed.push(format!("{error:#}")),
        };
        let site = match proven(args, robots).await {
            Ok(site) => site,
            Err(error) => return told.failed.push(format!("{robots} robots are not enrolled: {error:#}")),
        };
        for beside in scene::Beside::all(&args.beside) {
            let name = format!("{robots} robots, {}", beside.words());
            say(&name);
            told.add(&name, scene::measure(args, &site, robots, beside, say).await.map(|turns| turns.figures(&name)));
        }
    }
}

/// A site with so many robots.
async fn proven(args: &StopArgs, robots: usize) -> anyhow::Result<Site> {
    let room = crate::fsync::place(args.dir.as_ref())?;
    Site::with(robots, room.path()).await
}

/// What one turn came to, milliseconds from the moment of asking.
struct Turn {
    /// Each robot had read it.
    told_ms: Vec<f64>,
    /// Each robot had the answer to its acknowledgement.
    acked_ms: Vec<f64>,
    /// Who asked was told that all have acknowledged.
    known_ms: f64,
}

/// All turns of one size and situation.
#[derive(Default)]
struct Turns {
    stops: Vec<Turn>,
    bare: Vec<Turn>,
}

impl Turns {
    fn figures(&self, name: &str) -> Vec<Figure> {
        let of = |what: &str, value: &dyn Fn(&Turn) -> f64, limit: &str| {
            let [stops, bare]: [Vec<f64>; 2] = [&self.stops, &self.bare].map(|turns| turns.iter().map(value).collect());
            Figure::of("P8", format!("{name}: {what}"), "ms", &stops, Some((limit, &bare)))
        };
        vec![
            of("stop read, p99", &|turn| percentile(&turn.told_ms, 0.99), "bare write loop, read, p99"),
            of("stop acknowledged, p50", &|turn| percentile(&turn.acked_ms, 0.5), "bare write loop, acknowledged, p50"),
            of(
                "stop acknowledged, p99",
                &|turn| percentile(&turn.acked_ms, 0.99),
                "bare write loop, acknowledged, p99",
            ),
            of("stop acknowledged by all", &|turn| percentile(&turn.acked_ms, 1.0), "bare write loop, by all"),
            of("all shown to who engaged", &|turn| turn.known_ms, "bare write loop, all read back"),
        ]
    }
}

/// Everybody who takes part.
struct Stage {
    robots: usize,
    client: StopServiceClient<midshift_cli::way::Line>,
    /// Ended before those that they dial.
    simulators: Vec<(Child, PathBuf)>,
    fan: Child,
    _stop: Child,
}

fn text(path: &Path) -> anyhow::Result<&str> {
    path.to_str().context("a path that is no text")
}

impl Stage {
    /// Starts the stop service on `data` and the bare loop, and waits until every robot is on both. What children write is below `room`.
    async fn set(site: &Site, robots: usize, data: &Path, room: &Path) -> anyhow::Result<Self> {
        site.admit(data)?;
        let stop = Child::start(&["stop-serve", "--data", text(data)?], Some(0))?.listening().await?;
        let fan = Child::start(&["fan"], Some(0))?.listening().await?;
        let (address, fan_address) = (stop.address.to_string(), fan.address.to_string());
        let mut simulators = Vec::new();
        for part in 0..SIMULATORS {
            let [out, proofs] = ["moments", "proofs"].map(|name| room.join(format!("{name}-{part}.json")));
            let [from, to] = [part, part + 1].map(|n| robots * n / SIMULATORS);
            site.hand_out(from..to, &proofs)?;
            let [from, to] = [from, to].map(|n| n.to_string());
            let role = ["attend", "--stop", &address, "--fan", &fan_address, "--from", &from, "--to", &to, "--out"];
            let role = [&role[..], &[text(&out)?, "--proofs", text(&proofs)?]].concat();
            simulators.push((Child::start(&role, Some(1 + part))?, out));
        }
        let client = StopServiceClient::new(site.way(&address)?.connect().await?);
        let mut stage = Self { robots, client, simulators, fan, _stop: stop };
        stage.until(ATTACHED, ATTACH_WITHIN).await?;
        stage.until(FREE, ATTACH_WITHIN).await?;
        Ok(stage)
    }

    /// Waits until that is so of every robot.
    async fn until(&mut self, what: &str, within: Duration) -> anyhow::Result<()> {
        let end = Instant::now() + within;
        loop {
            let counts = self.simulators.iter_mut().map(|(child, _)| child.ask(what));
            let count = counts.sum::<anyhow::Result<u64>>()? as usize;
            if count >= self.robots {
                return Ok(());
            }
            ensure!(Instant::now() < end, "of {} robots {count} are {what}", self.robots);
            sleep(LOOK_EVERY).await;
        }
    }

    /// What the robots wrote down since `begun_ns`.
    fn turn(&mut self, what: &str, begun_ns: u64, known_ns: u64) -> anyhow::Result<Turn> {
        let ms = |at_ns: u64| at_ns.saturating_sub(begun_ns) as f64 / 1e6;
        let mut turn = Turn { told_ms: Vec::new(), acked_ms: Vec::new(), known_ms: ms(known_ns) };
        for (child, out) in &mut self.simulators {
            ensure!(child.ask(what)? > 0, "moments could not be written to {}", out.display());
            let moments: Vec<Moments> = serde_json::from_slice(&std::fs::read(out)?)?;
            ensure!(moments.iter().all(|m| m.told_ns > begun_ns && m.acked_ns > m.told_ns), "a robot was left out");
            turn.told_ms.extend(moments.iter().map(|m| ms(m.told_ns)));
            turn.acked_ms.extend(moments.iter().map(|m| ms(m.acked_ns)));
        }
        Ok(turn)
    }

    /// Stops the fleet, waits until all have confirmed, and resets it.
    async fn stop(&mut self) -> anyhow::Result<Turn> {
        let scope = Some(Scope { scope: Some(scope::Scope::Fleet(Fleet {})) });
        let request = EngageRequest { scope, reason: "a measurement".to_owned(), ..EngageRequest::default() };
        let begun_ns = fan::now_ns();
        let mut answers = self.client.engage(request).await?.into_inner();
        let mut stop_id = String::new();
        let (robots, mut confirmed) = (self.robots as u32, 0);
        while confirmed < robots {
            let answer = timeout(TURN_WITHIN, answers.message()).await.context("robots do not confirm")??;
            let answer = answer.with_context(|| format!("{confirmed} of {robots} robots have confirmed"))?;
            confirmed = answer.counts.unwrap_or_default().standstill_confirmed;
            stop_id.extend(answer.stop.map(|stop| stop.stop_id));
        }
        let known_ns = fan::now_ns();
        drop(answers);
        self.until(STAND, TURN_WITHIN).await?;
        let turn = self.turn(TAKE, begun_ns, known_ns)?;
        self.client.reset(ResetRequest { stop_id, reason: "measured".to_owned(), ..ResetRequest::default() }).await?;
        self.until(FREE, TURN_WITHIN).await?;
        Ok(turn)
    }

    /// The bare loop once.
    async fn tell(&mut self) -> anyhow::Result<Turn> {
        let begun_ns = fan::now_ns();
        let told = self.fan.ask(fan::TELL)? as usize;
        ensure!(told == self.robots, "{told} of {} sockets could be written to", self.robots);
        let end = Instant::now() + TURN_WITHIN;
        while (self.fan.ask(fan::ACKED)? as usize) < self.robots {
            ensure!(Instant::now() < end, "not all sockets answer");
            sleep(Duration::from_millis(1)).await;
        }
        let known_ns = fan::now_ns();
        self.until(ANSWERED, TURN_WITHIN).await?;
        self.turn(TAKE_BARE, begun_ns, known_ns)
    }
}

/// The turns; `before` brings about before each what goes on beside.
async fn turns(
    args: &StopArgs,
    site: &Site,
    robots: usize,
    data: &Path,
    room: &Path,
    mut before: impl AsyncFnMut() -> anyhow::Result<()>,
) -> anyhow::Result<Turns> {
    let mut stage = Stage::set(site, robots, data, room).await?;
    let mut turns = Turns::default();
    for _ in 0..args.rounds {
        sleep(Duration::from_millis(args.settle_ms)).await;
        before().await?;
        turns.stops.push(stage.stop().await?);
        sleep(Duration::from_millis(args.settle_ms)).await;
        before().await?;
        turns.bare.push(stage.tell().await?);
    }
    Ok(turns)
}
