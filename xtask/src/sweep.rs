//! Long sweeps and golden files: test programs with an environment variable that the tests read.
//!
//! Invariant: a sweep that ran no test fails. `MIDSHIFT_SEED` is read by the test that kills programs, by stories and by
//! nights, `MIDSHIFT_STORY` by stories, `MIDSHIFT_NIGHT` by nights, `MIDSHIFT_SEEDS` and `MIDSHIFT_SEED_FROM` by the
//! simulation, by players over sockets and by drawn cuts of updates, `MIDSHIFT_SPLIT_ROBOTS` by the split stack,
//! `MIDSHIFT_OLD_TASKS` by old sites, `MIDSHIFT_SITES` by the power cuts and kills at calls, `BLESS` by tests with
//! `golden` in their name.

use crate::fetch_tools::Tools;
use crate::parts;
use crate::programs::{self, TestProgram};
use crate::round::Count;
use crate::run;
use crate::workspace::Workspace;
use anyhow::{Result, ensure};
use clap::ValueEnum;
use std::process::Command;

/// Robots of a split stack under load.
const SPLIT_ROBOTS: &str = "200";
/// Hours of a soak on each engine, unless told.
const SOAK_HOURS: f64 = 1.5;
/// Most of them: two months.
const SOAK_HOURS_MAX: f64 = 1_500.0;
/// Tasks that are over at an old site.
const OLD_TASKS: &str = "1000000";

/// One kind of fault sweep.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Sweep {
    /// Servers and agents killed at work.
    Kills,
    /// Shifts of the deterministic simulation, with roll-outs of software.
    Simulation,
    /// Robots that behave badly beside honest ones, in the deterministic simulation.
    Players,
    /// The same over real sockets against real servers.
    Sockets,
    /// A process of each service of a split stack killed or replaced in turn while 200 robots work and a release goes out to them, and then a bad one; as
    /// often as --seeds says, it draws nothing.
    Split,
    /// Updates in which the power goes at drawn moments and the next start finds a set that dies, a full disk, a wrong clock or a second launcher; then
    /// the power goes at each call of an update, and of the ways back from one, that changes the disk: all of them, whatever the seeds.
    Updates,
    /// The stop service, and a robot that keeps what it is told of stops, are killed at each call that changes their files: all of them, whatever the seeds.
    Latch,
    /// Robots at work in the deterministic simulation while stops are engaged and reset, lines to the stop service are cut, and everybody is killed.
    Stops,
    /// Shifts with a roll-out and its way back in the deterministic simulation, of servers and agents that are one version apart.
    Skew,
    /// Twenty robots, five of them launcher and agent processes, get a good release and three bad ones: about ten minutes a seed.
    Stories,
    /// Twelve robots under launchers at a server get a good release and three bad ones, with kills of everybody, a
    /// freeze, a pause, a full disk and a robot that falls silent for ever: about a quarter of an hour a seed.
    Night,
    /// Starts, takeovers, lists, pruning and backups at a site where a million tasks are over, on both engines; it draws nothing.
    OldSites,
    /// 500 robots at work, watches that come and go, roll-outs there and back, on each engine: every task that was acknowledged is looked for at the end, and
    /// memory, times and files of the last third are told beside those of the second. As long as --hours says; it draws nothing.
    Soak,
}

/// What runs every night by `torture --nightly`.
pub const NIGHTLY: [Sweep; 3] = [Sweep::Stories, Sweep::Night, Sweep::OldSites];
/// Whole stories and whole nights of every night.
pub const NIGHTLY_SEEDS: u64 = 4;

impl Sweep {
    /// All, in the order in which they are run.
    pub const ALL: [Self; 13] = [
        Self::Kills,
        Self::Simulation,
        Self::Players,
        Self::Sockets,
        Self::Split,
        Self::Updates,
        Self::Latch,
        Self::Stops,
        Self::Skew,
        Self::Stories,
        Self::Night,
        Self::OldSites,
        Self::Soak,
    ];

    fn seeds(self) -> u64 {
        match self {
            Self::Kills => 20,
            Self::Simulation => 2_000,
            Self::Players | Self::Updates => 5_000,
            Self::Sockets => 1_000,
            Self::Stops => 100,
            Self::Skew => 500,
            Self::Split | Self::Latch | Self::Night | Self::OldSites | Self::Soak => 1,
            Self::Stories => 2,
        }
    }

    /// Whether what it does comes of seeds.
    const fn draws(self) -> bool {
        match self {
            Self::Kills | Self::Simulation | Self::Players | Self::Sockets => true,
            Self::Updates | Self::Stops | Self::Skew | Self::Stories | Self::Night => true,
            Self::Split | Self::Latch | Self::OldSites | Self::Soak => false,
        }
    }

    /// Its name on the command line.
    pub fn name(self) -> String {
        self.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()
    }

    /// Runs it as every night; whether all laws held. Tests are added to `count`.
    pub fn nightly(self, workspace: &Workspace, count: &mut Count) -> Result<bool> {
        let seeds = if matches!(self, Self::Stories | Self::Night) { NIGHTLY_SEEDS } else { self.seeds() };
        let mut runs = Runs { workspace, count: Count::default(), hours: SOAK_HOURS };
        let held = self.run(&mut runs, 1, seeds);
        *count += runs.count;
        held
    }

    fn run(self, runs: &mut Runs<'_>, from: u64, seeds: u64) -> Result<bool> {
        match self {
            Self::Kills => runs.each_seed("kills", "kill::", from, seeds),
            Self::Stories => runs.each_seed("stories", "story::", from, seeds),
            Self::Night => runs.each_seed("night", "night::", from, seeds),
            Self::Simulation => runs.seeded("simulation", "many_seeds_keep_every_law", from, seeds),
            Self::Players => runs.seeded("simulation", "played::many_seeds", from, seeds),
            Self::Sockets => runs.over_sockets(from, seeds),
            Self::Stops => runs.seeded("simulation", "stopped::in_cuts_and_kills", from, seeds),
            Self::Skew => runs.seeded("simulation", "skew::", from, seeds),
            Self::Split => runs.split(seeds),
            Self::OldSites => runs.counted(runs.test("e2e", "old_site::")?.env("MIDSHIFT_OLD_TASKS", OLD_TASKS)),
            Self::Soak => runs.soak(),
            Self::Updates => {
                let drawn = runs.seeded("agent", "drawn_cuts::", from, seeds)?;
                Ok(drawn && runs.every_site("agent", "power::")?)
            }
            Self::Latch => Ok(runs.every_site("stop", "killed::")? && runs.every_site("agent", "stop_cuts::")?),
        }
    }
}

/// How much of each sweep.
#[derive(Clone, Copy, Debug, Default)]
pub struct Amount {
    /// The first seed.
    pub from: Option<u64>,
    /// How many.
    pub seeds: Option<u64>,
    /// How long a soak lasts on each engine.
    pub hours: Option<f64>,
}

/// Runs these sweeps, or all; whether all laws held.
pub fn torture(workspace: &Workspace, sweeps: &[Sweep], amount: Amount) -> Result<bool> {
    ensure!(amount.seeds != Some(0), "--seeds must be at least 1");
    let from = first_seed(sweeps, amount.from)?;
    let hours = soak_hours(sweeps, amount.hours)?;
    let (mut runs, mut held) = (Runs { workspace, count: Count::default(), hours }, true);
    for sweep in Sweep::ALL.into_iter().filter(|s| sweeps.is_empty() || sweeps.contains(s)) {
        held &= sweep.run(&mut runs, from, amount.seeds.unwrap_or(sweep.seeds()))?;
    }
    Ok(held)
}

/// The first seed of these sweeps, or of all.
fn first_seed(sweeps: &[Sweep], from: Option<u64>) -> Result<u64> {
    let draws = sweeps.is_empty() || sweeps.iter().any(|sweep| sweep.draws());
    ensure!(from.is_none() || draws, "--from names a seed, and what you named draws nothing: leave it out");
    Ok(from.unwrap_or(1))
}

/// How long a soak of these sweeps, or of all, lasts.
fn soak_hours(sweeps: &[Sweep], hours: Option<f64>) -> Result<f64> {
    let soaks = sweeps.is_empty() || sweeps.contains(&Sweep::Soak);
    ensure!(hours.is_none() || soaks, "--hours is for soak, which you did not name: leave it out");
    let hours = hours.unwrap_or(SOAK_HOURS);
    ensure!(hours > 0.0 && hours <= SOAK_HOURS_MAX, "--hours must be more than 0 and at most {SOAK_HOURS_MAX}");
    Ok(hours)
}

/// Runs of test programs, and what their tests added up to.
struct Runs<'w> {
    workspace: &'w Workspace,
    count: Count,
    /// How long a soak lasts.
    hours: f64,
}

impl Runs<'_> {
    /// The workspace's one test program of this name.
    fn test(&self, target: &str, filter: &str) -> Result<Command> {
        let programs = TestProgram::build_all(self.workspace)?;
        let mut command = programs::named(&programs, target)?.command(self.workspace);
        command.args([filter, "--nocapture"]);
        Ok(command)
    }

    /// Tests that cut a process off at its calls: at every one.
    fn every_site(&mut self, target: &str, filter: &str) -> Result<bool> {
        self.counted(self.test(target, filter)?.env("MIDSHIFT_SITES", "all"))
    }

    /// Tests that play as many seeds as their environment says.
    fn seeded(&mut self, target: &str, filter: &str, from: u64, seeds: u64) -> Result<bool> {
        let mut command = self.test(target, filter)?;
        self.counted(command.env("MIDSHIFT_SEED_FROM", from.to_string()).env("MIDSHIFT_SEEDS", seeds.to_string()))
    }

    /// Tests of real programs, which are built.
    fn programs(&self, filter: &str) -> Result<Command> {
        ensure!(parts::build(self.workspace)?, "the programs do not build");
        let mut command = self.test("e2e", filter)?;
        self.workspace.export_programs(&mut command)?;
        Ok(command)
    }

    /// Real programs, seeds beside each other.
    fn over_sockets(&mut self, from: u64, seeds: u64) -> Result<bool> {
        let mut command = self.programs("played::")?;
        self.counted(command.env("MIDSHIFT_SEED_FROM", from.to_string()).env("MIDSHIFT_SEEDS", seeds.to_string()))
    }

    /// Real programs, once with each seed of `from .. from + seeds`. Ends at the first that breaks a law.
    fn each_seed(&mut self, sweep: &str, filter: &str, from: u64, seeds: u64) -> Result<bool> {
        for seed in from..from.saturating_add(seeds) {
            let mut command = self.programs(filter)?;
            command.env("MIDSHIFT_SEED", seed.to_string()).env("MIDSHIFT_STORY", "all").env("MIDSHIFT_NIGHT", "all");
            if !self.counted(&mut command)? {
                run::tell_person(&format!("next: cargo xtask torture {sweep} --from {seed} --seeds 1"));
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// As often as `seeds` says: chance is the machine's.
    fn split(&mut self, seeds: u64) -> Result<bool> {
        let tools = Tools::find(self.workspace)?;
        for _ in 0..seeds {
            let mut command = self.programs("split::tasks_go_on")?;
            tools.export(&mut command);
            if !self.counted(command.env("MIDSHIFT_SPLIT_ROBOTS", SPLIT_ROBOTS))? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// The bench's own run, which fails where a task is lost.
    fn soak(&self) -> Result<bool> {
        let minutes = (self.hours * 60.0).to_string();
        let arguments = ["run", "--release", "-p", "midshift-bench", "--", "soak", "--minutes", &minutes];
        run::succeeds(&mut self.workspace.cargo(&arguments))
    }

    fn counted(&mut self, command: &mut Command) -> Result<bool> {
        let mut count = Count::default();
        let succeeded = run::reading(command, |line| {
            count.add(line);
            run::print(line);
        })?;
        self.count += count;
        run::print(&format!("{} passed, {} failed", count.passed, count.failed));
        ensure!(!succeeded || count.passed > 0, "no test matched");
        Ok(succeeded)
    }
}

/// Runs the tests that hold golden files, in every test program whatever fails, and lets them write what they see.
pub fn golden(workspace: &Workspace) -> Result<bool> {
    ensure!(parts::build(workspace)?, "the programs do not build");
    let mut command = workspace.cargo(&["test", "--workspace", "--tests", "--no-fail-fast", "--", "golden"]);
    workspace.export_programs(&mut command)?;
    let passed = Runs { workspace, count: Count::default(), hours: SOAK_HOURS }.counted(command.env("BLESS", "1"))?;
    run::tell_person("next: git diff, and read it before you commit it");
    Ok(passed)
}

/// Formats, then [`golden`].
pub fn tidy(workspace: &Workspace) -> Result<bool> {
    Ok(run::succeeds(&mut workspace.cargo(&["fmt", "--all"]))? && golden(workspace)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_first_seed_is_refused_where_nothing_is_drawn() {
        assert_eq!(first_seed(&[], Some(7)).expect("some draw"), 7);
        assert_eq!(first_seed(&[Sweep::Split, Sweep::Kills], Some(7)).expect("one draws"), 7);
        assert_eq!(first_seed(&[Sweep::Split], None).expect("no seed"), 1);
        assert!(first_seed(&[Sweep::Split, Sweep::Latch], Some(7)).is_err());
    }

    #[test]
    fn hours_are_refused_where_nothing_soaks_and_where_they_are_none() {
        assert_eq!(soak_hours(&[Sweep::Soak, Sweep::Kills], Some(8.0)).expect("a soak"), 8.0);
        assert_eq!(soak_hours(&[], None).expect("all"), SOAK_HOURS);
        assert!(soak_hours(&[Sweep::Kills], Some(8.0)).is_err());
        assert!([0.0, -1.0, f64::NAN, f64::INFINITY, 1e20].iter().all(|hours| soak_hours(&[], Some(*hours)).is_err()));
    }
}
