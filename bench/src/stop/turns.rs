//! Turns of a stop and of both bare write loops, each with the same robots.

use super::disturbance::Disturbance;
use super::fan::{ACKED, TELL};
use super::moments::now_ns;
use super::robots::{ANSWERED_PLAIN, ANSWERED_TLS, ATTACHED, FREE, STAND, TAKE, TAKE_PLAIN, TAKE_TLS};
use super::simulators::{Simulators, Turn, text};
use super::site::Site;
use crate::child::Child;
use crate::figure::{Figure, percentile};
use anyhow::{Context, ensure};
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::stop::v1::{EngageRequest, Fleet, ResetRequest, Scope, scope};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::time::{Instant, sleep, timeout};

/// All robots are attached by then.
const ATTACH_WITHIN: Duration = Duration::from_secs(300);
/// A turn is over by then.
const TURN_WITHIN: Duration = Duration::from_secs(60);

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct StopArgs {
    /// Robots; more than once: each size by itself. Without it 1,000 and 10,000, or as many as the limit of open files allows.
    #[arg(long)]
    pub robots: Vec<usize>,
    /// What goes on beside; more than once: each by itself. Without it all of them.
    #[arg(long, value_enum)]
    pub beside: Vec<Disturbance>,
    /// Turns of each: a stop, a bare write loop over TLS, one in plain text.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub rounds: u64,
    /// Milliseconds before each turn in which the one before settles.
    #[arg(long, default_value_t = 1_000)]
    pub settle_ms: u64,
    /// Where everything is made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    pub dir: Option<PathBuf>,
}

/// All turns of one size and situation.
#[derive(Default)]
pub struct Turns {
    stops: Vec<Turn>,
    tls: Vec<Turn>,
    plain: Vec<Turn>,
}

fn acked_p99(turn: &Turn) -> f64 {
    percentile(&turn.acked_ms, 0.99)
}

impl Turns {
    /// As they are told: the stop beside the loop over TLS, and so is the loop in plain text.
    pub fn figures(&self, name: &str) -> Vec<Figure> {
        let beside_tls = |turns: &[Turn], what: &str, value: &dyn Fn(&Turn) -> f64, limit: &str| {
            let [turns, tls]: [Vec<f64>; 2] = [turns, &self.tls].map(|turns| turns.iter().map(value).collect());
            Figure::new(
                "P8",
                format!("{name}: {what}"),
                "ms",
                &turns,
                Some((&format!("TLS write loop, {limit}"), &tls)),
            )
        };
        let of_stop =
            |what: &str, value: &dyn Fn(&Turn) -> f64, limit: &str| beside_tls(&self.stops, what, value, limit);
        vec![
            of_stop("stop read, p99", &|turn| percentile(&turn.told_ms, 0.99), "read, p99"),
            of_stop("stop acknowledged, p50", &|turn| percentile(&turn.acked_ms, 0.5), "acknowledged, p50"),
            of_stop("stop acknowledged, p99", &acked_p99, "acknowledged, p99"),
            of_stop("stop acknowledged by all", &|turn| percentile(&turn.acked_ms, 1.0), "by all"),
            of_stop("all shown to who engaged", &|turn| turn.known_ms, "all read back"),
            beside_tls(&self.plain, "plain write loop, p99", &acked_p99, "acknowledged, p99"),
        ]
    }
}

/// One bare loop, and what its robots are asked.
struct BareLoop {
    fan: Child,
    answered: &'static str,
    take: &'static str,
}

impl BareLoop {
    /// Runs it once.
    async fn run(&mut self, simulators: &mut Simulators) -> anyhow::Result<Turn> {
        let (begun_ns, robots) = (now_ns(), simulators.robots());
        let told = self.fan.ask(TELL)? as usize;
        ensure!(told == robots, "{told} of {robots} sockets could be written to");
        let end = Instant::now() + TURN_WITHIN;
        while (self.fan.ask(ACKED)? as usize) < robots {
            ensure!(Instant::now() < end, "not all sockets answer");
            sleep(Duration::from_millis(1)).await;
        }
        let known_ns = now_ns();
        simulators.until(self.answered, TURN_WITHIN).await?;
        simulators.take_turn(self.take, begun_ns, known_ns)
    }
}

/// Everybody who takes part.
struct Stage {
    client: StopServiceClient<midshift_cli::endpoint::Line>,
    /// Ended before those that they dial.
    simulators: Simulators,
    tls: BareLoop,
    plain: BareLoop,
    _stop: Child,
}

impl Stage {
    /// Starts the stop service on `data` and the bare loops, and waits until every robot is on all of them. What children write is below `room`.
    async fn set(site: &Site, robots: usize, data: &Path, room: &Path) -> anyhow::Result<Self> {
        site.admit(data)?;
        let stop = Child::start(&["stop-serve", "--data", text(data)?], Some(0))?.listening().await?;
        let tls = Child::start(&["fan", "--data", text(data)?], Some(0))?.listening().await?;
        let plain = Child::start(&["fan"], Some(0))?.listening().await?;
        let mut simulators = Simulators::start(site, robots, room, [&stop, &tls, &plain])?;
        let client = StopServiceClient::new(site.way(&stop.address.to_string())?.connect().await?);
        simulators.until(ATTACHED, ATTACH_WITHIN).await?;
        simulators.until(FREE, ATTACH_WITHIN).await?;
        let tls = BareLoop { fan: tls, answered: ANSWERED_TLS, take: TAKE_TLS };
        let plain = BareLoop { fan: plain, answered: ANSWERED_PLAIN, take: TAKE_PLAIN };
        Ok(Self { client, simulators, tls, plain, _stop: stop })
    }

    /// Stops the fleet, waits until all have confirmed, and resets it.
    async fn stop(&mut self) -> anyhow::Result<Turn> {
        let scope = Some(Scope { scope: Some(scope::Scope::Fleet(Fleet {})) });
        let request = EngageRequest { scope, reason: "a measurement".to_owned(), ..EngageRequest::default() };
        let begun_ns = now_ns();
        let mut answers = self.client.engage(request).await?.into_inner();
        let mut stop_id = String::new();
        let (robots, mut confirmed) = (self.simulators.robots() as u32, 0);
        while confirmed < robots {
            let answer = timeout(TURN_WITHIN, answers.message()).await.context("robots do not confirm")??;
            let answer = answer.with_context(|| format!("{confirmed} of {robots} robots have confirmed"))?;
            confirmed = answer.counts.unwrap_or_default().standstill_confirmed;
            stop_id.extend(answer.stop.map(|stop| stop.stop_id));
        }
        let known_ns = now_ns();
        drop(answers);
        self.simulators.until(STAND, TURN_WITHIN).await?;
        let turn = self.simulators.take_turn(TAKE, begun_ns, known_ns)?;
        self.client.reset(ResetRequest { stop_id, reason: "measured".to_owned(), ..ResetRequest::default() }).await?;
        self.simulators.until(FREE, TURN_WITHIN).await?;
        Ok(turn)
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
    let settle = || sleep(Duration::from_millis(args.settle_ms));
    for _ in 0..args.rounds {
        settle().await;
        before().await?;
        turns.stops.push(stage.stop().await?);
        settle().await;
        before().await?;
        turns.tls.push(stage.tls.run(&mut stage.simulators).await?);
        settle().await;
        before().await?;
        turns.plain.push(stage.plain.run(&mut stage.simulators).await?);
    }
    Ok(turns)
}
