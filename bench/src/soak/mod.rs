//! A long run of a site at work: tasks, watches that come and go, and roll-outs there and back, for as long as is asked. What must not grow is told
//! of the last third of the run beside the second one; and whether every task that was acknowledged is there at the end.

mod load;
mod samples;

use crate::arguments::parse_time;
use crate::engine::{Bed, Engine, EngineArgs};
use crate::figure::Figure;
use crate::ota::server::rollouts::Rollouts;
use crate::ota::server::scene::{Floor, attached};
use crate::outcome::{RunOutcome, unless_stopped};
use anyhow::ensure;
use load::{Released, Submitted};
use samples::{Sample, Thirds};
use std::time::Duration;
use tokio::time::{Instant, MissedTickBehavior, interval};

/// How often memory and files are looked at.
const LOOK_EVERY: Duration = Duration::from_secs(5);
/// Cells of the floor for each robot.
const CELLS_EACH: usize = 4;
/// Open tasks of each robot above which the robots are too slow for the rate.
const OPEN_PER_ROBOT: u64 = 4;
/// Tasks that a server has and that are not over.
const OPEN: &str = "midshift_fleet_tasks_open";

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct SoakArgs {
    /// Minutes of the run on each engine, once the robots are there.
    #[arg(long, default_value_t = 90.0, value_parser = parse_time)]
    minutes: f64,
    /// Simulated robots at work.
    #[arg(long, default_value_t = 500)]
    robots: usize,
    /// Tasks a second.
    #[arg(long, default_value_t = 4)]
    rate: u32,
    /// Minutes between the end of a roll-out and the next one.
    #[arg(long, default_value_t = 5.0, value_parser = parse_time)]
    rollout_minutes: f64,
    #[command(flatten)]
    engine: EngineArgs,
}

/// What a run came to.
struct Run {
    samples: Vec<Sample>,
    submitted: Submitted,
    released: Released,
    missing: usize,
    unfinished: usize,
}

/// Runs on one engine after the other.
pub async fn run(args: SoakArgs, say: &dyn Fn(&str)) -> RunOutcome {
    let mut outcome = RunOutcome::default();
    let all = async {
        for engine in args.engine.engines(say) {
            let run = async {
                let bed = engine.bed(args.engine.dir.as_ref())?;
                soak(&args, &engine, &bed, say).await
            };
            let run = run.await;
            let part = format!("soak{}", engine.suffix());
            if let Ok(Run { missing, unfinished, .. }) = run
                && missing + unfinished > 0
            {
                outcome.failed.push(format!("{part}: {missing} tasks are not there, {unfinished} have no end"));
            }
            outcome.add(&part, run.map(|run| figures_of(&engine, &run)));
        }
    };
    let ended_early = unless_stopped(all).await;
    outcome.failed.extend(ended_early);
    outcome
}

async fn soak(args: &SoakArgs, engine: &Engine, bed: &Bed<'_>, say: &dyn Fn(&str)) -> anyhow::Result<Run> {
    let floor = Floor::make(args.engine.dir.as_ref(), args.robots * CELLS_EACH)?;
    let mut server = floor.serve_on(bed.url()).await?;
    floor.people.push(&server).await?;
    let _swarm = floor.swarm(args.robots)?;
    let mut rollouts = Rollouts::connect(&server).await?;
    attached(&mut server, &mut rollouts, args.robots).await?;
    let begun = Instant::now();
    let long = Duration::from_secs_f64(args.minutes * 60.0);
    let releasing =
        load::release_again_and_again(&server, Duration::from_secs_f64(args.rollout_minutes * 60.0)).await?;
    let watching = load::watch_again_and_again(&server).await?;
    let mut submitted = Submitted::new(&server, &floor.site).await?;
    let mut samples = Vec::new();
    let mut due = interval(Duration::from_secs(1) / args.rate.max(1));
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut look = interval(LOOK_EVERY);
    while begun.elapsed() < long && releasing.goes_on() && watching.goes_on() {
        tokio::select! {
            _ = look.tick() => {
                let open = server.ask(OPEN)?;
                ensure!(open <= OPEN_PER_ROBOT * args.robots as u64, "{open} tasks are open: ask for a lower --rate");
                let sample = Sample::look_at(&server, bed, &floor, begun.elapsed(), submitted.take_times()).await?;
                say(&format!("{sample}, {open} tasks open{}", engine.suffix()));
                samples.push(sample);
            }
            _ = due.tick() => submitted.submit().await?,
        }
    }
    watching.stop().await?;
    let released = releasing.stop().await?;
    let (missing, unfinished) = submitted.await_ends(&server).await?;
    server.end()?;
    Ok(Run { samples, submitted, released, missing, unfinished })
}

fn figures_of(engine: &Engine, run: &Run) -> Vec<Figure> {
    let thirds = Thirds::cut_run(&run.samples);
    let name = |what: &str| format!("{what}, last third{}", engine.suffix());
    let beside = |what: &str, unit, of: &dyn Fn(&[Sample]) -> Vec<f64>| {
        let (second, last) = (of(thirds.second), of(thirds.last));
        Figure::new("soak", name(what), unit, &last, Some(("second third", &second)))
    };
    let count = |what: &str, n: usize| Figure::new("soak", format!("{what}{}", engine.suffix()), "", &[n as f64], None);
    vec![
        beside("RssAnon of the server", "MiB", &|samples| samples.iter().map(|s| s.own_mib).collect()),
        beside("submit, p50", "ms", &|samples| samples::percentiles(samples, 0.5)),
        beside("submit, p99", "ms", &|samples| samples::percentiles(samples, 0.99)),
        beside("files", "MB/min", &|samples| vec![samples::growth_mb_a_minute(samples)]),
        count("tasks acknowledged", run.submitted.count()),
        count("of them not there at the end", run.missing),
        count("of them without an end 10 min later", run.unfinished),
        count("roll-outs and ways back that ended", run.released.ended),
        count("roll-outs that were aborted", run.released.aborted),
    ]
}
