//! Turns of a stop and of a bare write loop, each with the same robots.

use super::disturbance::Disturbance;
use super::fan;
use super::robots::{ANSWERED, ATTACHED, FREE, Moments, STAND, TAKE, TAKE_BARE};
use super::site::Site;
use crate::child::Child;
use crate::figure::{Figure, percentile};
use anyhow::{Context, ensure};
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::stop::v1::{EngageRequest, Fleet, ResetRequest, Scope, scope};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::time::{Instant, sleep, timeout};

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
    pub robots: Vec<usize>,
    /// What goes on beside; more than once: each by itself. Without it all of them.
    #[arg(long, value_enum)]
    pub beside: Vec<Disturbance>,
    /// Turns of each: a stop, a bare write loop.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub rounds: u64,
    /// Milliseconds before each turn in which the one before settles.
    #[arg(long, default_value_t = 1_000)]
    pub settle_ms: u64,
    /// Where everything is made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    pub dir: Option<PathBuf>,
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
pub struct Turns {
    stops: Vec<Turn>,
    bare: Vec<Turn>,
}

impl Turns {
    /// As they are told.
    pub fn figures(&self, name: &str) -> Vec<Figure> {
        let of = |what: &str, value: &dyn Fn(&Turn) -> f64, limit: &str| {
            let [stops, bare]: [Vec<f64>; 2] = [&self.stops, &self.bare].map(|turns| turns.iter().map(value).collect());
            Figure::new("P8", format!("{name}: {what}"), "ms", &stops, Some((limit, &bare)))
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
    client: StopServiceClient<midshift_cli::endpoint::Line>,
    /// Ended before those that they dial.
    simulators: Vec<(Child, PathBuf)>,
    fan: Child,
    _stop: Child,
}

/// A path for a command line.
pub fn text(path: &Path) -> anyhow::Result<&str> {
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
    async fn run_fan(&mut self) -> anyhow::Result<Turn> {
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
pub async fn turns(
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
        turns.bare.push(stage.run_fan().await?);
    }
    Ok(turns)
}
