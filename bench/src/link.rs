//! P1 and P4: what the link costs with many robots that report once a second, and with few that report as fast as they may, beside a
//! bare tonic session that takes the same messages.
//!
//! STATUS is acknowledged at most every two seconds, by design; EVENT at once after its commit. So the time of an acknowledgement is
//! that of an EVENT, from one more robot that sends them one by one under the same load, after the CPU was counted.

use crate::child::{Child, MESSAGES, SESSIONS, files_max};
use crate::figure::{Figure, percentile};
use crate::fsync::Disk;
use crate::submit::place;
use crate::{flood, hall};
use anyhow::{Context, ensure};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// Robots unless the machine allows less.
const ROBOTS: usize = 10_000;
/// Descriptors of a process that are no robot's connection: databases, pipes, the runtime.
const OTHER_FILES: u64 = 200;
/// Processes that the robots are split over.
const SIMULATORS: usize = 2;
/// All robots are attached by then.
const ATTACH_WITHIN: Duration = Duration::from_secs(300);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(200);

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
    /// Rounds of each: midshift, bare tonic, bare tonic that answers; then midshift and bare tonic at the knee.
    #[arg(long, default_value_t = 2)]
    rounds: usize,
    /// Seconds after each leg of midshift in which acknowledgements are asked for, under the same load.
    #[arg(long, default_value_t = 10)]
    ask_seconds: u64,
    /// Where the databases are made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    dir: Option<PathBuf>,
}

/// Whose server.
#[derive(Clone, Copy, PartialEq)]
enum Of {
    Midshift,
    Sink,
    Answering,
}

/// What one leg came to.
#[derive(Default)]
struct Leg {
    messages: f64,
    cpu_s: f64,
    wall_s: f64,
    robot_kib: f64,
    acks_ms: Vec<f64>,
    syncs_ms: Vec<f64>,
}

type Legs = Vec<Leg>;

/// How many robots this machine's limits allow, and which limit it is if it is fewer than were wanted.
pub fn allowed(wanted: Option<usize>) -> anyhow::Result<(usize, Option<String>)> {
    let (wanted, files) = (wanted.unwrap_or(ROBOTS), files_max()?);
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
    let [mut ours, mut sink, mut answering]: [Legs; 3] = Default::default();
    for _ in 0..args.rounds {
        ours.push(steady(&args, robots, Of::Midshift).await?);
        sink.push(steady(&args, robots, Of::Sink).await?);
        answering.push(steady(&args, robots, Of::Answering).await?);
    }
    let [mut our_knee, mut sink_knee]: [Legs; 2] = Default::default();
    for _ in 0..args.rounds {
        our_knee.push(knee(&args, Of::Midshift).await?);
        sink_knee.push(knee(&args, Of::Sink).await?);
    }
    let mut figures = at_one_a_second(robots, &ours, &sink, &answering);
    figures.extend(at_the_knee(args.knee_robots, &our_knee, &sink_knee));
    Ok(figures)
}

fn each(legs: &Legs, what: impl Fn(&Leg) -> f64) -> Vec<f64> {
    legs.iter().map(what).collect()
}

fn per_cpu(leg: &Leg) -> f64 {
    leg.messages / leg.cpu_s
}

fn acks(load: &str, legs: &Legs) -> [Figure; 2] {
    [("p50", 0.5), ("p99", 0.99)].map(|(word, share)| {
        let syncs = each(legs, |l| percentile(&l.syncs_ms, share));
        let acks = each(legs, |l| percentile(&l.acks_ms, share));
        let limit = format!("fdatasync of 4 KiB, {word}");
        Figure::of("P1", format!("{load}: EVENT to its ack, {word}"), "ms", &acks, Some((&limit, &syncs)))
    })
}

fn at_one_a_second(robots: usize, ours: &Legs, sink: &Legs, answering: &Legs) -> Vec<Figure> {
    let name = |what: &str| format!("{robots} x 1 Hz: {what}");
    let bare = "bare tonic sink, same robots";
    let (unit, each_cpu) = ("1/CPU-s", |l: &Leg| l.cpu_s * 1e6 / l.messages);
    let mut figures = vec![
        Figure::of("P1", name("reports"), unit, &each(ours, per_cpu), Some((bare, &each(sink, per_cpu)))),
        Figure::of(
            "P1",
            name("reports, each echoed"),
            unit,
            &each(ours, per_cpu),
            Some(("bare tonic that answers each", &each(answering, per_cpu))),
        ),
        Figure::of("P1", name("CPU of a report"), "us", &each(ours, each_cpu), Some((bare, &each(sink, each_cpu)))),
    ];
    figures.extend(acks(&format!("{robots} x 1 Hz"), ours));
    let (memory, cores) = (|l: &Leg| l.robot_kib, |l: &Leg| l.cpu_s / l.wall_s);
    figures.extend([
        Figure::of("P4", name("memory per robot"), "KiB", &each(ours, memory), Some((bare, &each(sink, memory)))),
        Figure::of("P4", name("server, idle robots"), "cores", &each(ours, cores), Some((bare, &each(sink, cores)))),
    ]);
    figures
}

fn at_the_knee(robots: usize, ours: &Legs, sink: &Legs) -> Vec<Figure> {
    let name = |what: &str| format!("knee, {robots} robots: {what}");
    let bare = "bare tonic sink, same messages";
    let (rate, each_cpu) = (|l: &Leg| l.messages / l.wall_s, |l: &Leg| l.cpu_s * 1e6 / l.messages);
    let mut figures = vec![
        Figure::of("P1", name("durable reports"), "1/CPU-s", &each(ours, per_cpu), Some((bare, &each(sink, per_cpu)))),
        Figure::of("P1", name("CPU of a report"), "us", &each(ours, each_cpu), Some((bare, &each(sink, each_cpu)))),
        Figure::of("P1", name("durable reports"), "1/s", &each(ours, rate), Some((bare, &each(sink, rate)))),
    ];
    figures.extend(acks(&format!("knee, {robots} robots"), ours));
    figures
}

async fn server(of: Of, data: &Path, map: &Path) -> anyhow::Result<Child> {
    let core = Some(0);
    match of {
        Of::Midshift => Child::serve(data, Some(map), core).await,
        Of::Sink => Child::start(&["sink"], core)?.listening().await,
        Of::Answering => Child::start(&["sink", "--answers"], core)?.listening().await,
    }
}

/// One server with all robots, real agents in simulators of their own, each at one report a second.
async fn steady(args: &LinkArgs, robots: usize, of: Of) -> anyhow::Result<Leg> {
    let dir = place(args.dir.as_ref())?;
    let map = hall::map(dir.path(), (robots as f64).sqrt() as usize + 2)?;
    let mut server = server(of, &dir.path().join("data"), &map).await?;
    let bare_kib = server.rss_kib()?;
    let (address, map) = (server.address.to_string(), map.to_str().context("a path that is no text")?);
    let number = |n: usize| n.to_string();
    let mut simulators = Vec::new();
    for part in 0..SIMULATORS {
        let (from, to) = (robots * part / SIMULATORS, robots * (part + 1) / SIMULATORS);
        let (robots, from, to) = (number(robots), number(from), number(to));
        let role = ["robots", "--server", &address, "--site", map, "--robots", &robots, "--from", &from, "--to", &to];
        simulators.push(Child::start(&role, Some(1 + part))?);
    }
    let end = Instant::now() + ATTACH_WITHIN;
    while (server.ask(SESSIONS)? as usize) < robots {
        ensure!(Instant::now() < end, "{} of {robots} robots are attached", server.ask(SESSIONS)?);
        sleep(LOOK_EVERY).await;
    }
    let mut leg = measure(args, &mut server, args.seconds, |server| server.ask(MESSAGES)).await?;
    leg.robot_kib = (server.rss_kib()? - bare_kib) / robots as f64;
    ensure!(server.ask(SESSIONS)? as usize >= robots, "robots were lost");
    ask(args, &server, dir.path(), of, &mut leg).await?;
    Ok(leg)
}

/// One server with few robots that report as fast as their credit lets them.
async fn knee(args: &LinkArgs, of: Of) -> anyhow::Result<Leg> {
    let dir = place(args.dir.as_ref())?;
    let map = hall::map(dir.path(), (args.knee_robots as f64).sqrt() as usize + 2)?;
    let mut server = server(of, &dir.path().join("data"), &map).await?;
    let (address, robots) = (server.address.to_string(), args.knee_robots.to_string());
    let mut role = vec!["flood", "--server", &address, "--robots", &robots];
    if of != Of::Midshift {
        role.push("--unacknowledged");
    }
    let mut flood = Child::start(&role, Some(1))?;
    let count = |server: &mut Child| if of == Of::Midshift { flood.ask("acked") } else { server.ask(MESSAGES) };
    let mut leg = measure(args, &mut server, args.knee_seconds, count).await?;
    ask(args, &server, dir.path(), of, &mut leg).await?;
    Ok(leg)
}

/// Lets the load settle, then counts messages and CPU for some seconds.
async fn measure(
    args: &LinkArgs,
    server: &mut Child,
    seconds: u64,
    mut count: impl FnMut(&mut Child) -> anyhow::Result<u64>,
) -> anyhow::Result<Leg> {
    sleep(Duration::from_secs(args.settle_seconds)).await;
    let (messages, cpu_s, begun) = (count(server)?, server.cpu_s()?, Instant::now());
    sleep(Duration::from_secs(seconds)).await;
    let (wall_s, cpu_s) = (begun.elapsed().as_secs_f64(), server.cpu_since_s(cpu_s)?);
    let messages = (count(server)? - messages) as f64;
    ensure!(messages > 0.0, "no message was counted");
    Ok(Leg { messages, cpu_s, wall_s, ..Leg::default() })
}

/// Under the load that is there, one more robot asks how long an acknowledgement takes, and the disk is asked in turn with it.
async fn ask(args: &LinkArgs, server: &Child, dir: &Path, of: Of, leg: &mut Leg) -> anyhow::Result<()> {
    if of == Of::Midshift {
        let (mut disk, long) = (Disk::beside(dir)?, Duration::from_secs(args.ask_seconds));
        (leg.acks_ms, leg.syncs_ms) = flood::ask(&server.address.to_string(), &mut disk, long).await?;
    }
    Ok(())
}
