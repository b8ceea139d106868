//! Runs end-to-end tests: each in a process of its own, the longest first, as many at once as the cores have time for.
//!
//! Invariants:
//! 1. A test is started in the order of the list: what it waits for its permits counts for none of its limits.
//! 2. Split stacks, and what else starts many programs, take several permits, so that two of them at most run at once on two busy cores.
//! 3. More permits than those of busy cores are given one test at a time, and only while the cores were idle for half of the last seconds.
//! 4. Tests that run at once have no port in common, also while a server of one is started again.
//! 5. A test that does not end is ended with all that it started, and has failed.

use crate::cores::{Cores, WINDOW};
use crate::programs::{self, TestProgram};
use crate::round::{Count, Round, threads};
use crate::run;
use crate::workspace::Workspace;
use anyhow::{Context, Result, bail, ensure};
use std::cmp::Reverse;
use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

/// The test program.
pub const NAME: &str = "e2e";
/// Modules (`name::`) and single tests that take more than one permit of two a busy core.
const HEAVY: &[(&str, usize)] = &[
    ("followed::", 2),
    ("handed_over::", 2),
    ("identity::the_line_that_enrolls_a_robot_of_a_split_site_", 2),
    ("kill::nothing_is_lost_and_nothing_done_twice_on_postgresql_", 2),
    ("languages::each_client_and_foreign_ones_", 3),
    ("languages::each_client_gives_up_in_time_and_outlives_a_split_stack_", 2),
    ("largest::as_many_batches_at_once_", 2),
    ("night::", 2),
    ("old_site::", 2),
    ("partition::", 2),
    ("played::", 2),
    ("public_address::", 2),
    ("released::", 2),
    ("split::", 3),
    ("split_held::", 2),
    ("split_restored::", 2),
    ("story::", 2),
    ("two_of_each::", 2),
];
/// Seconds that the long ones take where nobody has run them yet, by the beginning of their names.
const LONG: &[(&str, u64)] = &[
    ("story::", 300),
    ("split::a_roll_out_", 190),
    ("mid_shift::a_fleet_takes_", 160),
    ("unheard::", 150),
    ("split::", 130),
    ("partition::", 130),
    ("night::", 130),
    ("languages::each_client_and_foreign_ones_", 120),
    ("kill::", 110),
    ("cut::", 110),
    ("stopped::", 110),
    ("followed::", 100),
    ("identity::a_copied_key_", 100),
    ("played::", 100),
    ("restored::", 100),
    ("stopped_release::", 100),
    ("own_robot::", 75),
    ("ledger_cuts::", 65),
    ("two_of_each::", 65),
    ("clients::grpcurl_", 60),
    ("mid_shift::", 60),
    ("old_site::", 40),
    ("languages::", 35),
    ("minimal_robot::", 35),
    ("rights::", 35),
    ("batches::", 30),
    ("golden_cli::", 30),
    ("held::", 30),
];
/// Modules whose tests share what the first of them makes: one process has them all, with as many threads as permits.
const TOGETHER: &[&str] = &["old_site::"];
/// A test that takes longer hangs; the longest takes four minutes.
const LIMIT: Duration = Duration::from_secs(1_200);
/// Ports that tests may have: below those that the system gives to connections.
const PORTS: Range<usize> = 12_000..32_000;
/// What tells a test which of them are its own.
const PORTS_VARIABLE: &str = "MIDSHIFT_TEST_PORTS";
/// How often tests that run are looked at.
const LOOK: Duration = Duration::from_millis(20);

/// One process: a test, or the tests of one module.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Unit {
    name: String,
    permits: usize,
    /// What it took the last time, or is likely to take; none: seconds.
    expected: Option<Duration>,
}

/// What came of one.
struct Played {
    name: String,
    permits: usize,
    /// Which of those that ran at once it was.
    slot: usize,
    took: Duration,
    outcome: Result<(bool, Count)>,
}

/// How a round of them is played.
#[derive(Default)]
pub struct RoundOptions<'w> {
    /// Beginnings of the names of those that are played; none: all are.
    pub only: Option<Vec<&'w str>>,
    /// A variable of their environment.
    pub variable: Option<(&'w str, &'w str)>,
    /// Whether a thread a core computes beside them.
    pub is_loaded: bool,
}

impl Unit {
    /// Units of these tests, in the order in which they are started: the longest first, and of two that take the same the one with more permits.
    fn in_order(tests: &[String], times: &BTreeMap<String, Duration>, permits: usize) -> VecDeque<Self> {
        let mut names: Vec<&str> = Vec::new();
        for test in tests {
            let name = TOGETHER.iter().copied().find(|module| test.starts_with(module)).unwrap_or(test);
            if !names.contains(&name) {
                names.push(name);
            }
        }
        let unit = |name: &str| {
            let heavy = HEAVY.iter().find(|(heavy, _)| name.starts_with(heavy)).map_or(1, |(_, permits)| *permits);
            let long = || LONG.iter().find(|(long, _)| name.starts_with(long)).map(|(_, s)| Duration::from_secs(*s));
            let expected = times.get(name).copied().or_else(long);
            Self { name: name.to_owned(), permits: heavy.min(permits), expected }
        };
        let mut units: Vec<Self> = names.into_iter().map(unit).collect();
        units.sort_by_key(|unit| (Reverse(unit.expected), Reverse(unit.permits), unit.name.clone()));
        units.into()
    }
}

/// Permits of tests that run at once.
#[derive(Clone, Copy)]
struct Permits {
    /// Those of busy cores.
    busy: usize,
    /// Those of idle ones.
    idle: usize,
}

impl Permits {
    fn new() -> Self {
        Self { busy: threads(), idle: 3 * threads() }
    }

    /// The first in the queue, if it has its permits beside those that are used.
    fn granted(self, queue: &mut VecDeque<Unit>, used: usize, cores: &mut impl FnMut() -> bool) -> Option<Unit> {
        let needed = used + queue.front()?.permits;
        (needed <= self.busy || needed <= self.idle && cores()).then(|| queue.pop_front())?
    }
}

/// Plays them; whether all passed. Tests are added to `count`.
pub fn play(round: &Round<'_>, options: &RoundOptions<'_>, count: &mut Count) -> Result<bool> {
    let program = programs::named(round.programs()?, NAME)?;
    let times = Times::read(round.workspace);
    let tests: Vec<String> = tests(round.workspace, program)?.into_iter().filter(|name| options.plays(name)).collect();
    ensure!(!tests.is_empty(), "no end-to-end test has such a name");
    let folder = round.workspace.target.join("e2e");
    std::fs::create_dir_all(&folder).with_context(|| format!("creating {}", folder.display()))?;
    let queue = Unit::in_order(&tests, &times.0, threads());
    let stop = AtomicBool::new(false);
    let played = std::thread::scope(|scope| {
        for _ in 0..if options.is_loaded { threads() / 2 } else { 0 } {
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let (permits, mut cores) = (Permits::new(), Cores::new());
        let played = all(
            queue,
            permits,
            || cores.are_idle(),
            |unit, slot| round.one(unit, options, program, &folder, ports(slot, permits.idle)),
        );
        stop.store(true, Ordering::Relaxed);
        played
    });
    if options.variable.is_none() && !options.is_loaded {
        times.with(&played).write(round.workspace)?;
    }
    summary(&played, count)
}

/// The share of the ports that one of so many slots has.
fn ports(slot: usize, slots: usize) -> Range<usize> {
    let share = PORTS.len() / slots;
    let first = PORTS.start + slot * share;
    first..first + share
}

/// Starts each when it has its permits, in a slot that no other has meanwhile, and waits for all.
fn all(
    mut queue: VecDeque<Unit>,
    permits: Permits,
    mut are_cores_idle: impl FnMut() -> bool,
    one: impl Fn(&Unit, usize) -> Result<(bool, Count)> + Sync,
) -> Vec<Played> {
    let (mut used, mut slots, mut played) = (0, (0..permits.idle).collect::<Vec<_>>(), Vec::new());
    let (ended, ends) = sync_channel::<Played>(permits.idle);
    std::thread::scope(|scope| {
        loop {
            while let Some(unit) = permits.granted(&mut queue, used, &mut are_cores_idle) {
                used += unit.permits;
                // Each takes a permit at least.
                let slot = slots.pop().unwrap_or_default();
                let (ended, one) = (ended.clone(), &one);
                scope.spawn(move || {
                    let (outcome, took) = run::timed(|| one(&unit, slot));
                    // Nobody listens any more where the other side has panicked.
                    let _ = ended.send(Played { name: unit.name, permits: unit.permits, slot, took, outcome });
                });
            }
            if used == 0 {
                return;
            }
            let one = match ends.recv_timeout(WINDOW) {
                Ok(one) => one,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => return,
            };
            used -= one.permits;
            slots.push(one.slot);
            let word = if one.passed() { "ok" } else { "FAILED" };
            run::print(&format!("test {} ... {word} {:.1} s", one.name, one.took.as_secs_f64()));
            played.push(one);
        }
    });
    played
}

/// Adds them up and names the slowest; whether all passed.
fn summary(played: &[Played], count: &mut Count) -> Result<bool> {
    let mut slowest: Vec<_> = played.iter().map(|one| (one.took, one.name.clone())).collect();
    slowest.sort_by(|a, b| b.cmp(a));
    run::say_slowest(&slowest);
    for one in played {
        match &one.outcome {
            Ok((_, own)) => *count += *own,
            Err(error) => {
                run::tell_person(&format!("{}: {error:#}", one.name));
                count.failed += 1;
            }
        }
    }
    Ok(played.iter().all(Played::passed))
}

impl Played {
    fn passed(&self) -> bool {
        matches!(self.outcome, Ok((true, _)))
    }
}

impl RoundOptions<'_> {
    fn plays(&self, name: &str) -> bool {
        self.only.as_ref().is_none_or(|only| only.iter().any(|begin| name.starts_with(begin)))
    }
}

impl Round<'_> {
    /// Runs one to its end; whether it passed. What it says is shown if it failed.
    fn one(
        &self,
        unit: &Unit,
        options: &RoundOptions<'_>,
        program: &TestProgram,
        folder: &Path,
        ports: Range<usize>,
    ) -> Result<(bool, Count)> {
        let mut command = program.command(self.workspace);
        command.arg(&unit.name);
        if TOGETHER.contains(&unit.name.as_str()) {
            command.env("RUST_TEST_THREADS", unit.permits.to_string());
        } else {
            command.arg("--exact");
        }
        command.envs(options.variable).env(PORTS_VARIABLE, format!("{}..{}", ports.start, ports.end));
        self.surround(&mut command)?;
        let log = format!("{}.log", unit.name.trim_end_matches(':').replace("::", "."));
        ended(&mut command, &folder.join(log))
    }
}

/// Runs a test program to its end; whether its tests passed, and which. What it says goes to `log`, and is shown if they did not.
fn ended(command: &mut Command, log: &Path) -> Result<(bool, Count)> {
    let file = File::create(log).with_context(|| format!("creating {}", log.display()))?;
    let begun = command.stdout(file.try_clone().context("its output")?).stderr(file).spawn();
    let succeeded = run::within(begun.context("starting a test")?, LIMIT, LOOK)?;
    let said = String::from_utf8_lossy(&std::fs::read(log).context("reading what it said")?).into_owned();
    let mut count = Count::default();
    said.lines().for_each(|line| count.add(line));
    let passed = succeeded && count.failed == 0 && count != Count::default();
    if !passed {
        run::print(&format!("---- {}\n{said}", log.display()));
        // A program that was ended has counted nothing.
        count.failed = count.failed.max(1);
    }
    Ok((passed, count))
}

/// Names of its tests.
fn tests(workspace: &Workspace, program: &TestProgram) -> Result<Vec<String>> {
    let output = program.command(workspace).args(["--list", "--format", "terse"]).output().context("listing tests")?;
    if !output.status.success() {
        bail!("listing tests: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    let lines = String::from_utf8_lossy(&output.stdout).into_owned();
    Ok(lines.lines().filter_map(|line| line.strip_suffix(": test")).map(str::to_owned).collect())
}

/// What each took the last time, by name: lines of milliseconds and a name, kept in the target directory.
#[derive(Default)]
struct Times(BTreeMap<String, Duration>);

impl Times {
    fn path(workspace: &Workspace) -> PathBuf {
        workspace.target.join("e2e-times")
    }

    /// None where there is no file: then everything is new.
    fn read(workspace: &Workspace) -> Self {
        let text = std::fs::read_to_string(Self::path(workspace)).unwrap_or_default();
        Self(text.lines().filter_map(|line| line.split_once(' ')).filter_map(Self::line).collect())
    }

    fn line((millis, name): (&str, &str)) -> Option<(String, Duration)> {
        Some((name.to_owned(), Duration::from_millis(millis.parse().ok()?)))
    }

    fn with(mut self, played: &[Played]) -> Self {
        self.0.extend(played.iter().map(|one| (one.name.clone(), one.took)));
        self
    }

    fn write(&self, workspace: &Workspace) -> Result<()> {
        let text: String = self.0.iter().map(|(name, took)| format!("{} {name}\n", took.as_millis())).collect();
        std::fs::write(Self::path(workspace), text).context("noting what each test took")
    }
}

/// Names of all tests as they stand in the sources, `module::name`, with the source of their modules.
#[cfg(test)]
pub fn in_sources() -> Vec<(String, String)> {
    let mut names = Vec::new();
    in_folder(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/tests/e2e"), "", &mut names);
    names
}

#[cfg(test)]
fn in_folder(folder: &Path, above: &str, names: &mut Vec<(String, String)>) {
    for entry in std::fs::read_dir(folder).expect("the suite").flatten() {
        let module = format!("{above}{}", entry.path().file_stem().expect("a name").to_string_lossy());
        if entry.path().is_dir() {
            in_folder(&entry.path(), &format!("{module}::"), names);
            continue;
        }
        let text = std::fs::read_to_string(entry.path()).expect("a file");
        for marked in text.split("#[test]").flat_map(|part| part.split("#[tokio::test")).skip(1) {
            let name = marked.split("fn ").nth(1).and_then(|rest| rest.split('(').next()).expect("a test has a name");
            names.push((format!("{module}::{name}"), marked.to_owned()));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Barrier, Mutex};

    fn queue(tests: &[&str], times: &[(&str, u64)], permits: usize) -> VecDeque<Unit> {
        let tests: Vec<String> = tests.iter().map(|test| (*test).to_owned()).collect();
        let times = times.iter().map(|(name, s)| ((*name).to_owned(), Duration::from_secs(*s))).collect();
        Unit::in_order(&tests, &times, permits)
    }

    #[test]
    fn the_longest_of_the_last_run_is_started_first_or_of_any_run_where_there_was_none() {
        let order = |tests: &[&str], times: &[(&str, u64)]| -> Vec<_> {
            queue(tests, times, 4).into_iter().map(|unit| (unit.name, unit.permits)).collect()
        };
        let known = order(&["a::a", "b::b", "split::c", "new::d"], &[("a::a", 5), ("b::b", 90), ("split::c", 30)]);
        assert_eq!(
            known.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(),
            ["b::b", "split::c", "a::a", "new::d"]
        );
        let first = order(&["a::a", "partition::b", "old_site::c", "old_site::d", "split::e"], &[]);
        let first: Vec<_> = first.iter().map(|(name, permits)| (name.as_str(), *permits)).collect();
        assert_eq!(first, [("split::e", 3), ("partition::b", 2), ("old_site::", 2), ("a::a", 1)]);
    }

    #[test]
    fn never_more_run_at_once_than_have_permits_of_busy_or_of_idle_cores() {
        let tests =
            ["partition::a", "split::a", "split_held::a", "split_restored::a", "two_of_each::a", "x::a", "y::a"];
        let permits = Permits { busy: 4, idle: 12 };
        for (idle, most) in [(false, 4), (true, 12)] {
            // Permits and slots of those that run at each moment at which one is started.
            let (running, moments) = (Mutex::new(BTreeMap::new()), Mutex::new(Vec::new()));
            let all_run = Barrier::new(if idle { 5 } else { 1 });
            let played = all(
                queue(&tests, &[], 4),
                permits,
                || idle,
                |unit, slot| {
                    let mut now = running.lock().unwrap();
                    let other: Option<usize> = now.insert(slot, unit.permits);
                    moments.lock().unwrap().push((other, now.values().copied().collect::<Vec<usize>>()));
                    drop(now);
                    if unit.permits > 1 {
                        all_run.wait();
                    }
                    running.lock().unwrap().remove(&slot);
                    Ok((true, Count::default()))
                },
            );
            let moments = moments.into_inner().unwrap();
            assert_eq!((played.len(), moments.len()), (7, 7));
            for (other, permits) in &moments {
                let heavy = permits.iter().filter(|permits| **permits > 1).count();
                assert!(other.is_none() && permits.iter().sum::<usize>() <= most, "{moments:?}");
                assert!(idle || heavy <= 2, "{moments:?}");
            }
        }
        let shares: Vec<_> = (0..3).map(|slot| ports(slot, 3)).collect();
        assert_eq!(shares, [12_000..18_666, 18_666..25_332, 25_332..31_998], "none has a port of another");
        let one_core = queue(&["split::a"], &[], 2);
        assert_eq!(one_core[0].permits, 2, "it takes what there is");
    }

    #[test]
    fn none_overtakes_the_first_and_more_than_busy_cores_have_is_asked_of_idle_ones() {
        let mut order = queue(&["split::a", "split::b", "x::a", "y::a"], &[], 4);
        let (permits, mut asked) = (Permits { busy: 4, idle: 12 }, 0);
        let mut is = |used, idle: bool, name: Option<&str>| {
            let mut cores = || {
                asked += 1;
                idle
            };
            assert_eq!(permits.granted(&mut order, used, &mut cores).map(|unit| unit.name).as_deref(), name);
            asked
        };
        assert_eq!(is(0, false, Some("split::a")), 0);
        assert_eq!(is(3, false, None), 1, "a small one waits behind it");
        assert_eq!(is(10, true, None), 1, "idle cores have no more than that either");
        assert_eq!(is(3, true, Some("split::b")), 2);
        assert_eq!(is(3, false, Some("x::a")), 2);
        assert_eq!(is(4, true, Some("y::a")), 3);
        assert_eq!(is(0, true, None), 3);
    }

    #[test]
    fn what_passed_is_read_off_what_a_program_says_and_one_that_counts_nothing_has_failed() {
        let workspace = Workspace::find().unwrap();
        let program = TestProgram::this();
        let log = std::env::temp_dir().join(format!("xtask-e2e-{}.log", std::process::id()));
        let one =
            "e2e::tests::the_longest_of_the_last_run_is_started_first_or_of_any_run_where_there_was_none".to_owned();
        assert!(tests(&workspace, &program).unwrap().contains(&one));
        let passed = ended(program.command(&workspace).args([&one, "--exact"]), &log).unwrap();
        assert_eq!(passed, (true, Count { passed: 1, failed: 0, ignored: 0 }));
        let failed = |words: &str| ended(workspace.command("sh").args(["-c", words]), &log).unwrap();
        let one_failed = (false, Count { passed: 0, failed: 1, ignored: 0 });
        assert_eq!([failed("exit 3"), failed("true")], [one_failed, one_failed]);
        std::fs::remove_file(log).unwrap();
    }

    #[test]
    fn whatever_is_heavy_long_or_together_is_there_and_each_split_stack_is_heavy() {
        let names = in_sources();
        let long = LONG.iter().map(|(name, _)| name);
        for name in HEAVY.iter().map(|(name, _)| name).chain(long).chain(TOGETHER) {
            assert!(names.iter().any(|(test, _)| test.starts_with(name)), "no test is called {name}* any more");
        }
        for (test, text) in names {
            let is_split =
                ["Stack::start(", "with_software(", "Factory::split("].iter().any(|word| text.contains(word));
            assert!(!is_split || HEAVY.iter().any(|(heavy, _)| test.starts_with(heavy)), "{test} starts a split stack");
        }
    }
}
