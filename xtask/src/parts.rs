//! The parts of the suite, in their order, and how each is run.
//!
//! Invariant: no part is skipped; a part that cannot run fails. All cargo calls select the whole workspace, so that features
//! are the same in each and nothing is compiled twice.

use crate::fetch_tools::Tools;
use crate::slowest::Slowest;
use crate::stack::{self, Which};
use crate::workspace::Workspace;
use crate::{clients, dist, docker, engine, run};
use anyhow::Result;
use clap::ValueEnum;
use std::process::Command;

/// Tests that are named after a part of tests.
const SLOWEST_NAMED: usize = 10;

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
    /// The integration suite.
    Suite,
    /// End-to-end tests that show something of PostgreSQL, again with it behind the store.
    Engine,
    /// Examples in the documentation.
    Doc,
    /// Archives of a release: the same twice, whole, and what is in them starts.
    Dist,
    /// The split stack as processes: started, a task done through its proxy, ended.
    Stack,
    /// Both stacks by docker-compose on a docker of its own: each brought up, a task done through its public address, brought down.
    Compose,
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
            Self::Engine => "engine",
            Self::Doc => "doc",
            Self::Dist => "dist",
            Self::Stack => "stack",
            Self::Compose => "compose",
        }
    }

    /// Whether outside tools take part.
    pub fn needs_tools(self) -> bool {
        matches!(
            self,
            Self::Buf | Self::Clients | Self::Unit | Self::Suite | Self::Engine | Self::Stack | Self::Compose
        )
    }

    /// Whether it runs tests, which need the built programs.
    pub fn runs_tests(self) -> bool {
        matches!(self, Self::Unit | Self::Suite | Self::Engine | Self::Doc | Self::Dist | Self::Stack | Self::Compose)
    }

    /// Runs it; whether it succeeded. Tests are added to `count`.
    pub fn run(self, workspace: &Workspace, tools: Option<&Tools>, count: &mut Count) -> Result<bool> {
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
            Self::Unit => count.all(&mut tests(workspace, tools, &["--lib", "--bins"])?),
            Self::Suite => count.all(&mut tests(workspace, tools, &["--test", "*"])?),
            Self::Engine => {
                let (name, value) = engine::VARIABLE;
                count.all(tests(workspace, tools, &engine::selection())?.env(name, value))
            }
            Self::Doc => count.all(&mut tests(workspace, tools, &["--doc"])?),
            Self::Dist => count.one(dist::test(workspace)),
            Self::Stack => count.one(stack::test(workspace, &Which::split(), Some(workspace.midshift()))),
            Self::Compose => count.one(docker::test(workspace, &workspace.midshift())),
        }
    }
}

/// Builds the programs, the example of a robot's too. Tests as well: a build without them has other features, and everything would be compiled twice.
pub fn build(workspace: &Workspace) -> Result<bool> {
    run::succeeds(&mut workspace.cargo(&["build", "--workspace", "--bins", "--examples", "--tests"]))
}

/// `cargo test` of these targets, which hear where the programs are.
fn tests(workspace: &Workspace, tools: Option<&Tools>, targets: &[&str]) -> Result<Command> {
    let mut command = workspace.cargo(&["test", "--workspace", "--no-fail-fast"]);
    // What failed is said in a line; a hundred lines of where it was hide it.
    command.args(targets).env("RUST_BACKTRACE", "0");
    command.env("RUST_TEST_THREADS", threads().to_string());
    workspace.export_programs(&mut command)?;
    if let Some(tools) = tools {
        tools.export(&mut command);
        clients::export(workspace, &mut command);
    }
    Ok(command)
}

/// Tests that run at once. Most of them wait for programs that they started: two tests a core keep the cores busy.
fn threads() -> usize {
    2 * std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

impl Count {
    /// Runs test programs to the end, adds theirs up, and names the slowest tests; whether all succeeded.
    #[expect(clippy::disallowed_methods, reason = "seconds of the tests by the wall, for a person")]
    fn all(&mut self, tests: &mut Command) -> Result<bool> {
        let begun = std::time::Instant::now();
        let mut slowest = Slowest::new(threads());
        let passed = run::reading(tests, |line| {
            self.add(line);
            slowest.add(line, begun.elapsed());
        });
        let list = slowest.list(SLOWEST_NAMED);
        let lines: Vec<_> = list.iter().map(|(took, name)| format!("{:>6.1} s  {name}", took.as_secs_f64())).collect();
        run::print_line(&format!("the slowest tests:\n{}", lines.join("\n")));
        passed
    }

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
