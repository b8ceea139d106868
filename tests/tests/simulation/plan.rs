//! What goes wrong in one run and what is asked for, drawn from its seed alone.

use crate::clock::Skew;
use midshift::background::request;
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
        /// Whose.
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
        }
    }
}

/// One fault in time, milliseconds from the beginning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Window {
    /// What.
    pub fault: Fault,
    /// From.
    pub from_ms: u64,
    /// To.
    pub to_ms: u64,
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
        Ok(Self { cancels: cancels.collect(), windows, skews, tasks, latency_ms: rng.random_range(5..60) })
    }
    /// No fault lasts and nothing is asked for after this, milliseconds.
    pub fn quiet_from_ms(&self) -> u64 {
        let faults = self.windows.iter().map(|w| w.to_ms);
        let wishes = self.tasks.iter().map(|(at, _)| *at).chain(self.cancels.iter().map(|(at, _)| *at));
        faults.chain(wishes).max().unwrap_or(0)
    }
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
    let (fault, lasts_ms) = match rng.random_range(0..15) {
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
        _ => (Fault::HoldDown(some(rng)), 1_000..14_000),
    };
    let from_ms = rng.random_range(FAULTS_MS);
    Window { fault, from_ms, to_ms: from_ms + rng.random_range(lasts_ms) }
}
