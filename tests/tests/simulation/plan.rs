//! What goes wrong in one run and what is asked for, drawn from its seed alone.

use crate::clock::Skew;
use crate::software::{BAD_AT_START, BAD_WITH_LOAD, GOOD, HANGS};
use midshift_cli::task_list::request;
use midshift_core::site::Site;
use midshift_proto::task::v1::SubmitTaskRequest;
use midshift_sim::workload::{Workload, WorkloadConfig};
use rand::rngs::StdRng;
use rand::seq::IteratorRandom;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeSet;

/// Robots of a run.
pub const ROBOTS: usize = 10;
/// Tasks of a run.
pub const TASKS: usize = 24;
/// Places that people block, of those of the demo site.
const PLACES: [&str; 6] = ["door", "aisle", "crossing", "A01", "B02", "C01"];
/// Faults begin after this and none begins later than the end, milliseconds.
const FAULTS_MS: std::ops::Range<u64> = 8_000..100_000;

/// One thing that goes wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Nothing passes between the server and these robots.
    Partition(BTreeSet<usize>),
    /// Nothing passes from the server to this robot.
    Deaf(usize),
    /// Nothing passes from this robot to the server.
    Mute(usize),
    /// Everything between the server and this robot waits, and then comes at once.
    Hold(usize),
    /// What the server says to these robots waits, and then comes at once; the server hears them all the while.
    HoldDown(BTreeSet<usize>),
    /// The server's process dies. Without power nobody hears that its connections are gone.
    ServerCrash {
        /// With the network.
        power: bool,
    },
    /// An agent's process dies.
    AgentCrash {
        /// The robot's number, from 0.
        robot: usize,
        /// With the network.
        power: bool,
    },
    /// The server's disk answers only sometimes.
    DiskUnknown,
    /// The server's disk is gone.
    DiskGone,
    /// The server's disk is slow.
    DiskSlow,
    /// The clients are cut off.
    ClientCut,
    /// The maker's own safety system stops this robot.
    HardwareStop(usize),
}

impl Fault {
    /// Its name in counts.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Partition(_) => "partition",
            Self::Deaf(_) => "partition one way down",
            Self::Mute(_) => "partition one way up",
            Self::Hold(_) => "messages held back",
            Self::HoldDown(_) => "messages to robots held back",
            Self::ServerCrash { power: false } => "server crash",
            Self::ServerCrash { power: true } => "server power cut",
            Self::AgentCrash { power: false, .. } => "agent crash",
            Self::AgentCrash { power: true, .. } => "agent power cut",
            Self::DiskUnknown => "disk without answers",
            Self::DiskGone => "disk gone",
            Self::DiskSlow => "disk slow",
            Self::ClientCut => "client cut off",
            Self::HardwareStop(_) => "hardware stop",
        }
    }
}

/// One fault in time, milliseconds from the beginning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Window {
    /// What is wrong meanwhile.
    pub fault: Fault,
    /// When it begins.
    pub from_ms: u64,
    /// When it ends.
    pub to_ms: u64,
}

/// Something that people do about software.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Deed {
    /// Begin a roll-out. Its number is its place among those of the run.
    Begin {
        /// Version of the release.
        version: &'static str,
        /// For these.
        robots: BTreeSet<usize>,
        /// In the place of others.
        supersede: bool,
    },
    /// Take the first one back with one more.
    Rollback,
    /// Stand still.
    Pause(usize),
    /// Go on.
    Resume(usize),
    /// End it.
    Abort(usize),
    /// Leave a robot out.
    Exclude(usize, usize),
    /// Keep a robot at what it runs.
    Pin(usize),
    /// Let it take part again.
    Unpin(usize),
    /// Let nobody into a place for so many milliseconds.
    Block(&'static str, u64),
}

/// A whole run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Faults by their beginning.
    pub windows: Vec<Window>,
    /// Clocks of robots.
    pub skews: Vec<Skew>,
    /// What is submitted, and when.
    pub tasks: Vec<(u64, SubmitTaskRequest)>,
    /// What is canceled, and when: indices in `tasks`.
    pub cancels: Vec<(u64, usize)>,
    /// What is done about software, and when.
    pub deeds: Vec<(u64, Deed)>,
    /// Longest way of a message, milliseconds.
    pub latency_ms: u64,
}

impl Plan {
    /// Everything from the seed.
    pub fn draw(seed: u64, site: &Site) -> anyhow::Result<Self> {
        let mut rng = StdRng::seed_from_u64(seed);
        let mut windows: Vec<Window> = (0..rng.random_range(7..14)).map(|_| window(&mut rng)).collect();
        windows.push(crash(&mut rng));
        windows.sort_by_key(|w| w.from_ms);
        let skew = |rng: &mut StdRng| Skew {
            drift: rng.random_range(-150..=150),
            wall_ms: [0, rng.random_range(-3_000..=3_000), rng.random_range(-7_200_000..=7_200_000)]
                [rng.random_range(0..3)],
        };
        let skews = (0..ROBOTS).map(|_| skew(&mut rng)).collect();
        let tasks = tasks(seed, site, &mut rng)?;
        let cancels =
            (0..rng.random_range(0..3)).map(|_| (rng.random_range(10_000..90_000), rng.random_range(0..TASKS)));
        let cancels = cancels.collect();
        let latency_ms = rng.random_range(5..60);
        // From a stream of its own: faults and tasks of a seed stay what they were.
        let mut deeds = deeds(&mut StdRng::seed_from_u64(seed ^ 0x0072_656c_6561_7365));
        deeds.extend(blocks(&mut StdRng::seed_from_u64(seed ^ 0x0062_6c6f_636b)));
        deeds.sort_by_key(|(at, _)| *at);
        Ok(Self { cancels, windows, skews, tasks, deeds, latency_ms })
    }
    /// No fault lasts and nothing is asked for after this, milliseconds.
    pub fn quiet_from_ms(&self) -> u64 {
        let faults = self.windows.iter().map(|w| w.to_ms);
        let deeds = self.deeds.iter().map(|(at, _)| *at);
        let wishes = self.tasks.iter().map(|(at, _)| *at).chain(self.cancels.iter().map(|(at, _)| *at)).chain(deeds);
        faults.chain(wishes).max().unwrap_or(0)
    }
}

/// So many tasks at once, named after the moment.
pub fn background(now_ms: u64, many: usize, site: &Site) -> anyhow::Result<Vec<SubmitTaskRequest>> {
    let config = WorkloadConfig { timeout_ms: 400_000, ..WorkloadConfig::background(now_ms) };
    let mut workload = Workload::new(config, site).ok_or_else(|| anyhow::anyhow!("no stations"))?;
    let named = |i: usize, mut task: SubmitTaskRequest| {
        task.request_id = format!("request-{now_ms}-{i}");
        task.task_id = format!("TASK-{now_ms}-{i:03}");
        task
    };
    Ok((0..many).map(|i| named(i, request(&workload.next_transport()))).collect())
}

fn tasks(seed: u64, site: &Site, rng: &mut StdRng) -> anyhow::Result<Vec<(u64, SubmitTaskRequest)>> {
    let config = WorkloadConfig { timeout_ms: 400_000, ..WorkloadConfig::background(seed) };
    let mut workload = Workload::new(config, site).ok_or_else(|| anyhow::anyhow!("no stations"))?;
    let mut at_ms = 3_000;
    Ok((0..TASKS)
        .map(|i| {
            at_ms += rng.random_range(0..6_000);
            let mut task = request(&workload.next_transport());
            task.request_id = format!("request-{i}");
            task.task_id = format!("TASK-{i:03}");
            (at_ms, task)
        })
        .collect())
}

/// One to three roll-outs over some robots, with what people do about them.
fn deeds(rng: &mut StdRng) -> Vec<(u64, Deed)> {
    let mut deeds = Vec::new();
    let rollouts = rng.random_range(1..=3_usize);
    let mut at_ms = rng.random_range(4_000..25_000);
    for number in 0..rollouts {
        let version = match rng.random_range(0..10) {
            0 | 1 => BAD_AT_START,
            2 => HANGS,
            3 => BAD_WITH_LOAD,
            n => GOOD[n % GOOD.len()],
        };
        let many = rng.random_range(2..=4);
        let robots = (0..ROBOTS).sample(rng, many).into_iter().collect();
        deeds.push((at_ms, Deed::Begin { version, robots, supersede: rng.random_bool(0.6) }));
        let mut then = |from: u64, to: u64, rng: &mut StdRng, deed: Deed| {
            deeds.push((at_ms + rng.random_range(from..to), deed));
        };
        if rng.random_bool(0.5) {
            then(3_000, 40_000, rng, Deed::Pause(number));
            then(12_000, 70_000, rng, Deed::Resume(number));
        }
        match rng.random_range(0..8) {
            0 | 1 => then(5_000, 60_000, rng, Deed::Abort(number)),
            2 => then(2_000, 20_000, rng, Deed::Exclude(number, rng_robot(number))),
            3 => {
                then(0, 10_000, rng, Deed::Pin(rng_robot(number)));
                then(10_000, 40_000, rng, Deed::Unpin(rng_robot(number)));
            }
            _ => {}
        }
        at_ms += rng.random_range(15_000..45_000);
    }
    if rng.random_bool(0.3) {
        deeds.push((rng.random_range(80_000..110_000), Deed::Rollback));
    }
    deeds.sort_by_key(|(at, _)| *at);
    deeds
}

/// Places that people block for a while, some of them twice.
fn blocks(rng: &mut StdRng) -> Vec<(u64, Deed)> {
    let blocks = rng.random_range(0..=3);
    let block = |_| {
        let place = PLACES[rng.random_range(0..PLACES.len())];
        (rng.random_range(4_000..90_000), Deed::Block(place, rng.random_range(5_000..40_000)))
    };
    (0..blocks).map(block).collect()
}

/// Somebody, another for each roll-out.
const fn rng_robot(number: usize) -> usize {
    (number * 3 + 1) % ROBOTS
}

fn crash(rng: &mut StdRng) -> Window {
    let from_ms = rng.random_range(FAULTS_MS);
    let fault = Fault::ServerCrash { power: rng.random_bool(0.5) };
    Window { fault, from_ms, to_ms: from_ms + rng.random_range(300..9_000) }
}

/// One to five robots.
fn some(rng: &mut StdRng) -> BTreeSet<usize> {
    let many = rng.random_range(1..=5);
    (0..ROBOTS).sample(rng, many).into_iter().collect()
}

fn window(rng: &mut StdRng) -> Window {
    let robot = rng.random_range(0..ROBOTS);
    let (fault, lasts_ms) = match rng.random_range(0..16) {
        0 | 1 => (Fault::Partition(some(rng)), 1_000..45_000),
        2 => (Fault::Deaf(robot), 1_000..40_000),
        3 => (Fault::Mute(robot), 1_000..40_000),
        4 | 5 => (Fault::Hold(robot), 1_000..14_000),
        6 => return crash(rng),
        7 | 8 => (Fault::AgentCrash { robot, power: false }, 200..12_000),
        9 => (Fault::AgentCrash { robot, power: true }, 200..40_000),
        10 => (Fault::DiskUnknown, 1_000..15_000),
        11 => ([Fault::DiskGone, Fault::DiskSlow][rng.random_range(0..2)].clone(), 500..6_000),
        12 => (Fault::ClientCut, 1_000..20_000),
        15 => (Fault::HardwareStop(robot), 2_000..40_000),
        _ => (Fault::HoldDown(some(rng)), 1_000..14_000),
    };
    let from_ms = rng.random_range(FAULTS_MS);
    Window { fault, from_ms, to_ms: from_ms + rng.random_range(lasts_ms) }
}
