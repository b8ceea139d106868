//! The parts of the suite, in their order, and how each is run.
//!
//! Invariant: no part is skipped; a part that cannot run fails. All cargo calls select the whole workspace, so that features
//! are the same in each and nothing is compiled twice.

use crate::programs::{Choice, TestProgram};
use crate::round::{Count, Round, Scope};
use crate::stack::{self, Which};
use crate::workspace::Workspace;
use crate::{buf, clients, deny, dist, docker, e2e, engine, quick, run};
use anyhow::Result;
use clap::ValueEnum;

/// One part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum Part {
    /// Everything is formatted.
    Fmt,
    /// No lint fires.
    Clippy,
    /// The documentation builds without a warning.
    Rustdoc,
    /// The .proto files keep buf's STANDARD rules, and break nothing that a release says.
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
                Ok(buf::lint(workspace, tools)? && buf::breaks_nothing(workspace, tools)?)
            }
            Self::Build => build(workspace),
            Self::Clients => {
                let Some(tools) = tools else { return Ok(false) };
                clients::build(workspace, &tools.python)
            }
            Self::Unit => round.play(&chosen(round, |program| program.is_inside)?, Choice::default(), count),
            Self::Suite => {
                let programs = chosen(round, |program| !program.is_inside && program.name != e2e::NAME)?;
                round.play(&programs, Choice::default(), count)
            }
            Self::E2e => {
                let only = (!round.only.is_empty()).then(|| round.only.iter().map(String::as_str).collect());
                e2e::play(round, &e2e::RoundOptions { only, ..e2e::RoundOptions::default() }, count)
            }
            Self::Engine => e2e::play(round, &engine::round_options(round.scope), count),
            Self::Quick => quick::run(round, count),
            Self::Loaded => {
                e2e::play(round, &e2e::RoundOptions { is_loaded: true, ..e2e::RoundOptions::default() }, count)
            }
            Self::Doc => {
                let mut command = workspace.cargo(&["test", "--workspace", "--no-fail-fast", "--doc"]);
                run::reading(&mut command, |line| {
                    count.add(line);
                    run::print(line);
                })
            }
            Self::Dist => count.one(dist::test(workspace)),
            Self::Stack => count.one(stack::test(workspace, &Which::split(), Some(workspace.midshift()))),
            Self::Compose => count.one(docker::test(workspace, &workspace.midshift())),
            Self::Deny => count.one(deny::check(workspace)),
        }
    }
}

fn chosen<'r>(round: &'r Round<'_>, which: impl Fn(&TestProgram) -> bool) -> Result<Vec<&'r TestProgram>> {
    Ok(round.programs()?.iter().filter(|program| which(program)).collect())
}

/// Builds the programs, the example of a robot's too. Tests as well: a build without them has other features, and everything would be compiled twice.
pub fn build(workspace: &Workspace) -> Result<bool> {
    run::succeeds(&mut workspace.cargo(&["build", "--workspace", "--bins", "--examples", "--tests"]))
}
