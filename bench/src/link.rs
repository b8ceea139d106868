//! P1 and P4: what the link costs with many robots that report once a second, and with few that report as fast as they may, beside a
//! bare tonic session that takes the same messages.
//!
//! STATUS is acknowledged at most every two seconds, by design; EVENT at once after its commit. So the time of an acknowledgement is
//! that of an EVENT, from one more robot that sends them one by one under the same load, after the CPU was counted. On PostgreSQL the
//! CPU is the server's own; what the database spends beside it is told for itself.

use crate::child::{Child, MESSAGES, SESSIONS, raise_files_max};
use crate::engine::{Bed, Engine, EngineArgs};
use crate::figure::{Figure, percentile};
use crate::simulators::{await_sessions, start_robots};
use crate::{grid_map, saturation};
use anyhow::ensure;
use std::path::Path;
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// Robots unless the machine allows less.
const ROBOTS: usize = 10_000;
/// Descriptors of a process that are no robot's connection: databases, pipes, the runtime.
const OTHER_FILES: u64 = 200;
/// Bytes of one report on the wire.
const REPORT_BYTES: usize = 170;
/// Rows of PostgreSQL's limit, and how many of them share a commit.
const COPIED: usize = 100_000;
const COPIED_AT_ONCE: usize = 1_000;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct LinkArgs {
    /// Robots at one report a second. Without it 10,000, or as many as the limit of open files allows.
    #[arg(long)]
    robots: Option<usize>,
    /// Robots at the knee.
    #[arg(long, default_value_t = 32)]
    knee_robots: usize,
    /// Seconds measured of each leg at one report a second. Ten thousand robots want 60.
    #[arg(long, default_value_t = 30)]
    seconds: u64,
    /// Seconds measured of each leg at the knee.
    #[arg(long, default_value_t = 8)]
    knee_seconds: u64,
    /// Seconds before each of them that are not measured.
    #[arg(long, default_value_t = 4)]
    settle_seconds: u64,
    /// Rounds of each: midshift on each engine, bare tonic, bare tonic that answers; then midshift and bare tonic at the knee.
    #[arg(long, default_value_t = 2)]
    rounds: usize,
    /// Seconds after each leg of midshift in which acknowledgements are asked for, under the same load.
    #[arg(long, default_value_t = 10)]
    ask_seconds: u64,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Whose server.
#[derive(Clone, Copy)]
enum Of<'a> {
    Midshift(&'a Engine),
    Sink,
    Answering,
}

impl Of<'_> {
    /// What is kept by nobody needs a place all the same: for the map.
    fn engine(&self) -> &Engine {
        match self {
            Self::Midshift(engine) => engine,
            Self::Sink | Self::Answering => &Engine::Sqlite,
        }
    }
}

/// What one leg came to.
#[derive(Default)]
struct Leg {
    messages: f64,
    cpu_s: f64,
    wall_s: f64,
    robot_kib: f64,
    acks_ms: Vec<f64>,
    raws_ms: Vec<f64>,
    database_cpu_s: Option<f64>,
    copied_per_s: Option<f64>,
}

type Legs = Vec<Leg>;

/// How many robots this machine's limits allow, and which limit it is if it is fewer than were wanted.
pub fn allowed(wanted: Option<usize>) -> anyhow::Result<(usize, Option<String>)> {
    let (wanted, files) = (wanted.unwrap_or(ROBOTS), raise_files_max()?);
    let robots = wanted.min(usize::try_from(files.saturating_sub(OTHER_FILES))?);
    let note = format!(
        "{robots} of {wanted} robots: the hard limit of RLIMIT_NOFILE is {files} and the server needs a descriptor for each"
    );
    Ok((robots, (robots < wanted).then_some(note)))
}

/// Runs rounds of midshift, the sinks and the disk, in turn: first at one report a second, then at the knee.
pub async fn run(args: LinkArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let (robots, note) = allowed(args.robots)?;
    if let Some(note) = note {
        say(&note);
    }
    let engines = args.engine.engines(say);
    let legs = || engines.iter().map(|_| Legs::new()).collect::<Vec<_>>();
    let (mut ours, [mut sink, mut answering]) = (legs(), <[Legs; 2]>::default());
    for _ in 0..args.rounds {
        for (engine, ours) in engines.iter().zip(&mut ours) {
            ours.push(steady(&args, robots, Of::Midshift(engine)).await?);
        }
        sink.push(steady(&args, robots, Of::Sink).await?);
        answering.push(steady(&args, robots, Of::Answering).await?);
    }
    let (mut our_knee, mut sink_knee) = (legs(), Legs::new());
    for _ in 0..args.rounds {
        for (engine, ours) in engines.iter().zip(&mut our_knee) {
            ours.push(knee(&args, Of::Midshift(engine)).await?);
        }
        sink_knee.push(knee(&args, Of::Sink).await?);
    }
    let steady = engines.iter().zip(&ours).flat_map(|(e, ours)| at_one_a_second(e, robots, ours, &sink, &answering));
    let knee = engines.iter().zip(&our_knee).flat_map(|(e, ours)| at_the_knee(e, args.knee_robots, ours, &sink_knee));
    Ok(steady.chain(knee).collect())
}

fn each(legs: &Legs, what: impl Fn(&Leg) -> f64) -> Vec<f64> {
    legs.iter().map(what).collect()
}

fn per_cpu(leg: &Leg) -> f64 {
    leg.messages / leg.cpu_s
}

fn acks(engine: &Engine, load: &str, legs: &Legs) -> [Figure; 2] {
    [("p50", 0.5), ("p99", 0.99)].map(|(word, share)| {
        let raws = each(legs, |l| percentile(&l.raws_ms, share));
        let acks = each(legs, |l| percentile(&l.acks_ms, share));
        let limit = format!("{}, {word}", engine.limit());
        let name = format!("{load}: EVENT to its ack, {word}{}", engine.suffix());
        Figure::new("P1", name, "ms", &acks, Some((&limit, &raws)))
    })
}

/// What PostgreSQL itself spends on a report; nothing of an engine that is the server itself.
fn database_cpu(name: String, legs: &Legs) -> Option<Figure> {
    let database: Vec<f64> = legs.iter().filter_map(|l| Some(l.database_cpu_s? * 1e6 / l.messages)).collect();
    let own = each(legs, |l| l.cpu_s * 1e6 / l.messages);
    (!database.is_empty()).then(|| Figure::new("P1", name, "us", &database, Some(("midshift's own", &own))))
}

fn at_one_a_second(engine: &Engine, robots: usize, ours: &Legs, sink: &Legs, answering: &Legs) -> Vec<Figure> {
    let name = |what: &str| format!("{robots} x 1 Hz: {what}{}", engine.suffix());
    let bare = "bare tonic sink, same robots";
    let (unit, each_cpu) = ("1/CPU-s", |l: &Leg| l.cpu_s * 1e6 / l.messages);
    let mut figures = vec![
        Figure::new("P1", name("reports"), unit, &each(ours, per_cpu), Some((bare, &each(sink, per_cpu)))),
        Figure::new(
            "P1",
            name("reports, each echoed"),
            unit,
            &each(ours, per_cpu),
            Some(("bare tonic that answers each", &each(answering, per_cpu))),
        ),
        Figure::new("P1", name("CPU of a report"), "us", &each(ours, each_cpu), Some((bare, &each(sink, each_cpu)))),
    ];
    figures.extend(acks(engine, &format!("{robots} x 1 Hz"), ours));
    figures.extend(database_cpu(name("CPU of the database for a report"), ours));
    let (memory, cores) = (|l: &Leg| l.robot_kib, |l: &Leg| l.cpu_s / l.wall_s);
    figures.extend([
        Figure::new("P4", name("memory per robot"), "KiB", &each(ours, memory), Some((bare, &each(sink, memory)))),
        Figure::new("P4", name("server, idle robots"), "cores", &each(ours, cores), Some((bare, &each(sink, cores)))),
    ]);
    figures
}

fn at_the_knee(engine: &Engine, robots: usize, ours: &Legs, sink: &Legs) -> Vec<Figure> {
    let name = |what: &str| format!("knee, {robots} robots: {what}{}", engine.suffix());
    let bare = "bare tonic sink, same messages";
    let (rate, each_cpu) = (|l: &Leg| l.messages / l.wall_s, |l: &Leg| l.cpu_s * 1e6 / l.messages);
    let mut figures = vec![
        Figure::new("P1", name("durable reports"), "1/CPU-s", &each(ours, per_cpu), Some((bare, &each(sink, per_cpu)))),
        Figure::new("P1", name("CPU of a report"), "us", &each(ours, each_cpu), Some((bare, &each(sink, each_cpu)))),
        Figure::new("P1", name("durable reports"), "1/s", &each(ours, rate), Some((bare, &each(sink, rate)))),
    ];
    figures.extend(acks(engine, &format!("knee, {robots} robots"), ours));
    figures.extend(database_cpu(name("CPU of the database for a report"), ours));
    let copied: Vec<f64> = ours.iter().filter_map(|l| l.copied_per_s).collect();
    if !copied.is_empty() {
        let limit = format!("COPY of rows of {REPORT_BYTES} B, {COPIED_AT_ONCE} a commit");
        figures.push(Figure::new(
            "P1",
            name("durable reports, by COPY"),
            "1/s",
            &each(ours, rate),
            Some((&limit, &copied)),
        ));
    }
    figures
}

async fn server(of: Of<'_>, bed: &Bed<'_>, map: &Path) -> anyhow::Result<Child> {
    let core = Some(0);
    match of {
        Of::Midshift(_) => bed.serve(Some(map), core).await,
        Of::Sink => Child::start(&["sink"], core)?.listening().await,
        Of::Answering => Child::start(&["sink", "--answers"], core)?.listening().await,
    }
}

/// One server with all robots, real agents in simulators of their own, each at one report a second.
async fn steady(args: &LinkArgs, robots: usize, of: Of<'_>) -> anyhow::Result<Leg> {
    let bed = of.engine().bed(args.engine.dir.as_ref())?;
    let map = grid_map::write(bed.path(), (robots as f64).sqrt() as usize + 2)?;
    let mut server = server(of, &bed, &map).await?;
    let bare_kib = server.rss_kib()?;
    let _robots = start_robots(&server, &map, robots)?;
    await_sessions(&mut server, robots).await?;
    let mut leg = measure(args, of, &mut server, args.seconds, |server| server.ask(MESSAGES)).await?;
    leg.robot_kib = (server.rss_kib()? - bare_kib) / robots as f64;
    ensure!(server.ask(SESSIONS)? as usize >= robots, "robots were lost");
    ask(args, &server, &bed, of, &mut leg).await?;
    Ok(leg)
}

/// One server with few robots that report as fast as their credit lets them.
async fn knee(args: &LinkArgs, of: Of<'_>) -> anyhow::Result<Leg> {
    let bed = of.engine().bed(args.engine.dir.as_ref())?;
    let map = grid_map::write(bed.path(), (args.knee_robots as f64).sqrt() as usize + 2)?;
    let mut server = server(of, &bed, &map).await?;
    let (address, robots) = (server.address.to_string(), args.knee_robots.to_string());
    let mut role = vec!["flood", "--server", &address, "--robots", &robots];
    if !matches!(of, Of::Midshift(_)) {
        role.push("--unacknowledged");
    }
    let mut flood = Child::start(&role, Some(1))?;
    let count = |server: &mut Child| match of {
        Of::Midshift(_) => flood.ask("acked"),
        Of::Sink | Of::Answering => server.ask(MESSAGES),
    };
    let mut leg = measure(args, of, &mut server, args.knee_seconds, count).await?;
    ask(args, &server, &bed, of, &mut leg).await?;
    drop((flood, server));
    leg.copied_per_s = bed.copied_per_s(COPIED, REPORT_BYTES, COPIED_AT_ONCE).await?;
    Ok(leg)
}

/// Lets the load settle, then counts messages and CPU for some seconds.
async fn measure(
    args: &LinkArgs,
    of: Of<'_>,
    server: &mut Child,
    seconds: u64,
    mut count: impl FnMut(&mut Child) -> anyhow::Result<u64>,
) -> anyhow::Result<Leg> {
    sleep(Duration::from_secs(args.settle_seconds)).await;
    let (messages, cpu_s, begun) = (count(server)?, server.cpu_s()?, Instant::now());
    let database_s = of.engine().cpu_s()?;
    sleep(Duration::from_secs(seconds)).await;
    let (wall_s, cpu_s) = (begun.elapsed().as_secs_f64(), server.cpu_since_s(cpu_s)?);
    let messages = (count(server)? - messages) as f64;
    ensure!(messages > 0.0, "no message was counted");
    let database_cpu_s = of.engine().cpu_s()?.zip(database_s).map(|(after_s, before_s)| after_s - before_s);
    Ok(Leg { messages, cpu_s, wall_s, database_cpu_s, ..Leg::default() })
}

/// Under the load that is there, one more robot asks how long an acknowledgement takes, and the raw limit is asked in turn with it.
async fn ask(args: &LinkArgs, server: &Child, bed: &Bed<'_>, of: Of<'_>, leg: &mut Leg) -> anyhow::Result<()> {
    if matches!(of, Of::Midshift(_)) {
        let (mut baseline, long) = (bed.baseline().await?, Duration::from_secs(args.ask_seconds));
        (leg.acks_ms, leg.raws_ms) = saturation::measure_acks(&server.address.to_string(), &mut baseline, long).await?;
    }
    Ok(())
}
