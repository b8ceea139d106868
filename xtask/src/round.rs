//! What parts of the suite are run with, and what their tests added up to.

use crate::clients;
use crate::fetch_tools::Tools;
use crate::programs::TestProgram;
use crate::workspace::Workspace;
use anyhow::{Context, Result};
use std::process::Command;
use std::sync::OnceLock;

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
    use super::Count;

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
