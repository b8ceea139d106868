//! What parts of the suite are run with, how test programs are run, two at once, and what their tests added up to.
//!
//! Invariant: what a program says is shown when it has ended, so that no two are mixed; one that fails keeps no other from running.

use crate::fetch_tools::Tools;
use crate::programs::{Choice, TestProgram};
use crate::slowest::Slowest;
use crate::workspace::Workspace;
use crate::{clients, run};
use anyhow::{Context, Result};
use std::collections::VecDeque;
use std::process::Command;
use std::sync::mpsc::sync_channel;
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

/// Programs that run at once: a test that waits, or the last long one of a program, leaves a core to the other.
const AT_ONCE: usize = 2;

/// How much is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// What is run before something lands.
    Daily,
    /// Everything, also what takes hours.
    Nightly,
}

/// What parts are run with.
pub struct Round<'w> {
    /// The checkout.
    pub workspace: &'w Workspace,
    /// Tools of tests, if a part needs them.
    pub tools: Option<Tools>,
    /// How much is asked for.
    pub scope: Scope,
    /// Beginnings of the names of those end-to-end tests that are asked for; none: all.
    pub only: &'w [String],
    /// Test programs, once they are built.
    built: OnceLock<Vec<TestProgram>>,
}

/// What cargo's closing lines added up to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Count {
    /// Tests that passed.
    pub passed: u64,
    /// Tests that failed.
    pub failed: u64,
    /// Tests marked as ignored.
    pub ignored: u64,
}

/// Tests that run at once. Most of them wait for programs that they started: two tests a core keep the cores busy.
pub fn threads() -> usize {
    2 * std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

impl<'w> Round<'w> {
    /// Nothing built yet.
    pub fn new(workspace: &'w Workspace, scope: Scope, only: &'w [String]) -> Self {
        Self { workspace, tools: None, scope, only, built: OnceLock::new() }
    }

    /// Tells tests where programs, tools and clients are.
    pub fn surround(&self, command: &mut Command) -> Result<()> {
        // What failed is said in a line; a hundred lines of where it was hide it.
        command.env("RUST_BACKTRACE", "0");
        self.workspace.export_programs(command)?;
        if let Some(tools) = &self.tools {
            tools.export(command);
            clients::export(self.workspace, command);
        }
        Ok(())
    }

    /// Test programs of the workspace, built at the first call.
    pub fn programs(&self) -> Result<&[TestProgram]> {
        if self.built.get().is_none() {
            // Who was first has built the same.
            let _ = self.built.set(TestProgram::build_all(self.workspace)?);
        }
        self.built.get().map(Vec::as_slice).context("they were built")
    }
}

/// What one printed, with when, and whether it succeeded.
struct Ended {
    name: String,
    lines: Vec<(String, Duration)>,
    succeeded: Result<bool>,
}

impl Ended {
    /// What its tests added up to; whether it passed. One that says no result, or that failed though no test of it did, has failed.
    fn judge(&self) -> (Count, bool) {
        let mut count = Count::default();
        self.lines.iter().for_each(|(line, _)| count.add(line));
        let has_result = self.lines.iter().any(|(line, _)| line.starts_with("test result: "));
        let succeeded = matches!(self.succeeded, Ok(true)) && has_result;
        count.failed += u64::from(!succeeded && count.failed == 0);
        (count, succeeded && count.failed == 0)
    }

    /// Shows what it printed, with how it came out where no test says so.
    fn show(&self, times: &mut Slowest) {
        run::print(&format!("\n---- {}", self.name));
        for (line, at) in &self.lines {
            times.add(line, *at);
            run::print(line);
        }
        match &self.succeeded {
            Err(error) => run::tell_person(&format!("{}: {error:#}", self.name)),
            Ok(_) if !self.judge().1 => run::tell_person(&format!("{} failed, or ended without a result", self.name)),
            Ok(_) => {}
        }
    }
}

impl Round<'_> {
    /// Runs tests of these programs; whether all passed. The slowest are named.
    #[expect(clippy::disallowed_methods, reason = "seconds of the tests by the wall, for a person")]
    pub fn play(&self, programs: &[&TestProgram], choice: Choice<'_>, count: &mut Count) -> Result<bool> {
        let mut order = programs.to_vec();
        order.sort_by_key(|program| program.rank());
        let queue = Mutex::new(VecDeque::from(order));
        let (ended, ends) = sync_channel(AT_ONCE);
        let begun = std::time::Instant::now();
        let one = |program: &TestProgram| -> Ended {
            let mut lines = Vec::new();
            let succeeded = self.test_command(program, choice).and_then(|mut command| {
                run::reading(&mut command, |line| lines.push((line.to_owned(), begun.elapsed())))
            });
            Ended { name: program.label(), lines, succeeded }
        };
        let (before, mut passed, mut slowest) = (count.passed, true, Vec::new());
        std::thread::scope(|scope| {
            for _ in 0..AT_ONCE {
                let (queue, one, ended) = (&queue, &one, ended.clone());
                scope.spawn(move || {
                    // A panic of the other one leaves the queue as it is.
                    let next = || queue.lock().unwrap_or_else(std::sync::PoisonError::into_inner).pop_front();
                    while let Some(program) = next() {
                        // Nobody listens any more where the other side has panicked.
                        let _ = ended.send(one(program));
                    }
                });
            }
            drop(ended);
            for one in ends {
                let mut times = Slowest::new(threads());
                one.show(&mut times);
                let (own, has_passed) = one.judge();
                *count += own;
                passed &= has_passed;
                slowest.extend(times.list());
            }
        });
        if choice.filter.is_some() && count.passed == before {
            run::tell_person("no test has such a name");
            passed = false;
        }
        slowest.sort_by(|a, b| b.cmp(a));
        run::say_slowest(&slowest);
        Ok(passed)
    }

    fn test_command(&self, program: &TestProgram, choice: Choice<'_>) -> Result<Command> {
        let mut command = program.command(self.workspace);
        command.args(choice.filter).env("RUST_TEST_THREADS", threads().to_string()).envs(choice.variable);
        self.surround(&mut command)?;
        Ok(command)
    }
}

impl std::ops::AddAssign for Count {
    fn add_assign(&mut self, other: Self) {
        self.passed += other.passed;
        self.failed += other.failed;
        self.ignored += other.ignored;
    }
}

impl Count {
    /// A part that is one test.
    pub fn one(&mut self, passed: Result<bool>) -> Result<bool> {
        let good = matches!(passed, Ok(true));
        self.passed += u64::from(good);
        self.failed += u64::from(!good);
        passed
    }

    /// Adds a closing line of a test program; every other line changes nothing.
    pub fn add(&mut self, line: &str) {
        let Some((_, numbers)) = line.strip_prefix("test result: ").and_then(|rest| rest.split_once(". ")) else {
            return;
        };
        for field in numbers.split(';') {
            let mut words = field.split_whitespace();
            let (Some(Ok(number)), Some(word)) = (words.next().map(str::parse::<u64>), words.next()) else { continue };
            match word {
                "passed" => self.passed += number,
                "failed" => self.failed += number,
                "ignored" => self.ignored += number,
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Count, Ended};
    use std::time::Duration;

    #[test]
    fn a_program_passes_only_with_a_result_and_whoever_fails_is_counted() {
        let ended = |lines: &[&str], succeeded| {
            let lines = lines.iter().map(|line| ((*line).to_owned(), Duration::ZERO)).collect();
            let (count, passed) = Ended { name: "core wire".into(), lines, succeeded }.judge();
            (passed, count.passed, count.failed)
        };
        let good = "test result: ok. 7 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.02s";
        let bad = "test result: FAILED. 3 passed; 2 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.02s";
        assert_eq!(ended(&[good], Ok(true)), (true, 7, 0));
        assert_eq!(ended(&[bad], Ok(false)), (false, 3, 2));
        assert_eq!(ended(&["running 7 tests"], Ok(true)), (false, 0, 1), "a test ended the process");
        assert_eq!(ended(&["running 7 tests"], Ok(false)), (false, 0, 1), "a signal did");
        assert_eq!(ended(&[], Err(anyhow::anyhow!("no such file"))), (false, 0, 1));
    }

    #[test]
    fn closing_lines_add_up_and_other_lines_do_not_count() {
        let mut count = Count::default();
        count.add("test result: ok. 7 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out; finished in 0.02s");
        count.add("test result: FAILED. 3 passed; 2 failed; 0 ignored; 0 measured; 4 filtered out; finished in 1.50s");
        count.add("test a_result::is_ok ... ok");
        count.add("8 passed; 8 failed");
        assert_eq!(count, Count { passed: 10, failed: 2, ignored: 1 });
    }
}
