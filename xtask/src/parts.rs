//! The parts of the suite, in their order, and how each is run.
//!
//! Invariant: no part is skipped; a part that cannot run fails. All cargo calls select the whole workspace, so that features
//! are the same in each and nothing is compiled twice.

use crate::fetch_tools::Tools;
use crate::slowest::Slowest;
use crate::stack::{self, Which};
use crate::workspace::Workspace;
use crate::{clients, deny, dist, docker, e2e, engine, quick, run};
use anyhow::Result;
use clap::ValueEnum;
use std::process::Command;

/// One part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum Part {
    /// Everything is formatted.
    Fmt,
    /// No lint fires.
    Clippy,
    /// The documentation builds without a warning.
    Rustdoc,
    /// The .proto files keep buf's STANDARD rules.
    Buf,
    /// The programs build; tests get their paths.
    Build,
    /// The clients in other languages are generated from the .proto files and built.
    Clients,
    /// Tests inside the crates.
    Unit,
    /// The integration tests of the crates, and of the whole without its programs.
    Suite,
    /// End-to-end tests: real programs, each test in a process of its own.
    E2e,
    /// End-to-end tests that show something of PostgreSQL, again with it behind the store.
    Engine,
    /// The daily loop, beside the tests inside the crates: model, architecture, and a handful of the simulation and of end-to-end tests.
    Quick,
    /// End-to-end tests on a machine whose cores are busy with something else.
    Loaded,
    /// Examples in the documentation.
    Doc,
    /// Archives of a release: the same twice, whole, and what is in them starts.
    Dist,
    /// The split stack as processes: started, a task done through its proxy, ended.
    Stack,
    /// Both stacks by docker-compose on a docker of its own: each brought up, a task done through its public address, brought down.
    Compose,
    /// Licences, advisories, bans and sources of all dependencies, by cargo-deny.
    Deny,
}

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

impl Part {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fmt => "fmt",
            Self::Clippy => "clippy",
            Self::Rustdoc => "rustdoc",
            Self::Buf => "buf",
            Self::Build => "build",
            Self::Clients => "clients",
            Self::Unit => "unit",
            Self::Suite => "suite",
            Self::E2e => "e2e",
            Self::Engine => "engine",
            Self::Quick => "quick",
            Self::Loaded => "loaded",
            Self::Doc => "doc",
            Self::Dist => "dist",
            Self::Stack => "stack",
            Self::Compose => "compose",
            Self::Deny => "deny",
        }
    }

    /// Whether it belongs to a run for which no part is named.
    pub fn is_in(self, scope: Scope) -> bool {
        match self {
            Self::Quick => false,
            Self::Loaded | Self::Deny => scope == Scope::Nightly,
            _ => true,
        }
    }

    /// Whether it runs end-to-end tests.
    pub fn runs_programs(self) -> bool {
        matches!(self, Self::E2e | Self::Engine | Self::Loaded)
    }

    /// Whether outside tools take part.
    pub fn needs_tools(self) -> bool {
        let talks_to_them = matches!(
            self,
            Self::Buf | Self::Clients | Self::Unit | Self::Suite | Self::Quick | Self::Stack | Self::Compose
        );
        talks_to_them || self.runs_programs()
    }

    /// Whether it runs tests, which need the built programs.
    pub fn runs_tests(self) -> bool {
        let has_tests = matches!(
            self,
            Self::Unit | Self::Suite | Self::Quick | Self::Doc | Self::Dist | Self::Stack | Self::Compose
        );
        has_tests || self.runs_programs()
    }

    /// Runs it; whether it succeeded. Tests are added to `count`.
    pub fn run(self, round: &Round<'_>, count: &mut Count) -> Result<bool> {
        let (workspace, tools) = (round.workspace, round.tools.as_ref());
        match self {
            Self::Fmt => run::succeeds(&mut workspace.cargo(&["fmt", "--all", "--check"])),
            Self::Clippy => {
                run::succeeds(&mut workspace.cargo(&["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"]))
            }
            Self::Rustdoc => {
                let mut command = workspace.cargo(&["doc", "--workspace", "--no-deps"]);
                run::succeeds(command.env("RUSTDOCFLAGS", "-D warnings"))
            }
            Self::Buf => {
                let Some(tools) = tools else { return Ok(false) };
                let mut lint = workspace.command(&tools.buf);
                run::succeeds(lint.arg("lint").current_dir(workspace.root.join("proto")))
            }
            Self::Build => build(workspace),
            Self::Clients => {
                let Some(tools) = tools else { return Ok(false) };
                clients::build(workspace, &tools.python)
            }
            Self::Unit => round.tests(&["--lib", "--bins"], count),
            Self::Suite => {
                let tests = workspace.tests.iter().filter(|name| *name != e2e::NAME);
                round.tests(&tests.flat_map(|name| ["--test", name.as_str()]).collect::<Vec<_>>(), count)
            }
            Self::E2e => e2e::play(round, &e2e::Way::default(), count),
            Self::Engine => e2e::play(round, &engine::way(round.scope), count),
            Self::Quick => quick::run(round, count),
            Self::Loaded => e2e::play(round, &e2e::Way { is_loaded: true, ..e2e::Way::default() }, count),
            Self::Doc => round.tests(&["--doc"], count),
            Self::Dist => count.one(dist::test(workspace)),
            Self::Stack => count.one(stack::test(workspace, &Which::split(), Some(workspace.midshift()))),
            Self::Compose => count.one(docker::test(workspace, &workspace.midshift())),
            Self::Deny => count.one(deny::check(workspace)),
        }
    }
}

/// Builds the programs, the example of a robot's too. Tests as well: a build without them has other features, and everything would be compiled twice.
pub fn build(workspace: &Workspace) -> Result<bool> {
    run::succeeds(&mut workspace.cargo(&["build", "--workspace", "--bins", "--examples", "--tests"]))
}

/// Tests that run at once. Most of them wait for programs that they started: two tests a core keep the cores busy.
pub fn threads() -> usize {
    2 * std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

impl Round<'_> {
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

    /// Runs the tests of these targets.
    pub fn tests(&self, targets: &[&str], count: &mut Count) -> Result<bool> {
        self.tests_with(targets, None, count)
    }

    /// The same with a variable in their environment. The slowest are named.
    #[expect(clippy::disallowed_methods, reason = "seconds of the tests by the wall, for a person")]
    pub fn tests_with(&self, targets: &[&str], variable: Option<(&str, &str)>, count: &mut Count) -> Result<bool> {
        let mut command = self.workspace.cargo(&["test", "--workspace", "--no-fail-fast"]);
        command.args(targets).env("RUST_TEST_THREADS", threads().to_string()).envs(variable);
        self.surround(&mut command)?;
        let begun = std::time::Instant::now();
        let mut slowest = Slowest::new(threads());
        let passed = run::reading(&mut command, |line| {
            count.add(line);
            slowest.add(line, begun.elapsed());
        });
        run::say_slowest(&slowest.list());
        passed
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
    fn one(&mut self, passed: Result<bool>) -> Result<bool> {
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
