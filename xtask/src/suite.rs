//! `cargo xtask test`: tools, parts in order, the table of minutes, the closing line.
//!
//! Invariant: the first part that fails ends the run, the table is printed all the same, and the last line on stdout is
//! `N passed, N failed` whenever tests ran.

use crate::fetch_tools::Tools;
use crate::parts::Part;
use crate::round::{Count, Round, Scope};
use crate::run::{self, timed};
use crate::workspace::Workspace;
use crate::{deny, docker, sweep};
use anyhow::{Result, ensure};
use clap::{Args, ValueEnum};
use std::time::Duration;

/// What of the suite is run.
#[derive(Args)]
pub struct TestArgs {
    /// First install what the tests of real components need (grpcurl, buf, a Python with gRPC, the modules of the clients) into
    /// target/tools, and strace, Go, Node.js and docker into the system; for a nightly run cargo-deny as well.
    #[arg(long)]
    install: bool,
    /// Leave out the part `compose`, which needs docker.
    #[arg(long)]
    no_docker: bool,
    /// Everything, and nothing ends it early: also each end-to-end test on PostgreSQL and on a loaded machine, cargo-deny, and all sweeps of
    /// `cargo xtask torture`. It takes hours.
    #[arg(long, conflicts_with = "parts")]
    nightly: bool,
    /// Of the end-to-end tests those alone whose names begin so, as `split::`. Again for more.
    #[arg(long, value_name = "BEGINNING", requires = "parts")]
    only: Vec<String>,
    /// Parts to run, in the suite's order whatever the order here; none: all. `quick` is the daily loop.
    #[arg(value_enum)]
    parts: Vec<Part>,
}

/// One line of the table.
struct Line {
    name: String,
    took: Duration,
    passed: bool,
    /// What runs it again.
    again: String,
}

/// Runs what is asked for, or everything if nothing is named; whether all passed.
pub fn test(workspace: &Workspace, args: &TestArgs) -> Result<bool> {
    let scope = if args.nightly { Scope::Nightly } else { Scope::Daily };
    let mut parts = in_order(&args.parts, scope);
    if args.no_docker {
        parts.retain(|part| *part != Part::Compose);
        run::tell_person("--no-docker: the part `compose` is left out");
    }
    ensure!(args.only.is_empty() || parts.contains(&Part::E2e), "--only chooses tests of the part `e2e`: name it too");
    let (mut lines, mut count) = (Vec::new(), Count::default());
    let mut round = Round::new(workspace, scope, &args.only);
    if parts.iter().any(|part| part.needs_tools()) {
        let (found, took) = timed(|| if args.install { Tools::install(workspace) } else { Tools::find(workspace) });
        round.tools = Some(found?);
        if args.install && parts.contains(&Part::Compose) {
            docker::install(workspace)?;
        }
        if args.install && parts.contains(&Part::Deny) {
            deny::install(workspace)?;
        }
        lines.push(Line { name: "tools".to_owned(), took, passed: true, again: String::new() });
    }
    for part in parts {
        let again = format!("test {}", part.name());
        lines.push(line(part.name().to_owned(), again, || part.run(&round, &mut count)));
        // Nothing runs without the programs.
        if lines.last().is_some_and(|line| !line.passed) && (scope == Scope::Daily || part == Part::Build) {
            return Ok(closed(&lines, count));
        }
    }
    if scope == Scope::Nightly {
        for sweep in sweep::Sweep::ALL {
            let again = format!("torture {}", sweep.name());
            lines.push(line(again.clone(), again, || sweep.nightly(workspace, &mut count)));
        }
    }
    Ok(closed(&lines, count))
}

fn line(name: String, again: String, run: impl FnOnce() -> Result<bool>) -> Line {
    run::tell_person(&format!("\n== {name}"));
    let (outcome, took) = timed(run);
    let passed = outcome.unwrap_or_else(|error| {
        run::tell_person(&format!("error: {error:#}"));
        false
    });
    Line { name, took, passed, again }
}

/// The table, what to try next, and the closing line; whether all passed.
fn closed(lines: &[Line], count: Count) -> bool {
    print_table(lines, count);
    for failed in lines.iter().filter(|line| !line.passed) {
        run::tell_person(&format!("failed: {}; next: cargo xtask {}", failed.name, failed.again));
    }
    if count != Count::default() {
        run::print(&format!("{} passed, {} failed", count.passed, count.failed));
    }
    lines.iter().all(|line| line.passed) && count.failed == 0
}

/// The suite's order, each part once, and the programs and clients before the tests that start them.
fn in_order(asked: &[Part], scope: Scope) -> Vec<Part> {
    let brought = |part: &Part| match part {
        Part::Build => asked.iter().any(|p| p.runs_tests()),
        Part::Clients => asked.iter().any(|p| p.runs_programs()),
        Part::Unit => asked.contains(&Part::Quick),
        _ => false,
    };
    let wanted = |part: &Part| if asked.is_empty() { part.is_in(scope) } else { asked.contains(part) || brought(part) };
    Part::value_variants().iter().copied().filter(wanted).collect()
}

fn print_table(lines: &[Line], count: Count) {
    run::print("\npart                minutes");
    for line in lines {
        let minutes = line.took.as_secs_f64() / 60.0;
        run::print(&format!("{:<20}{minutes:>7.2}{}", line.name, if line.passed { "" } else { "  FAILED" }));
    }
    let all: Duration = lines.iter().map(|line| line.took).sum();
    run::print(&format!("{:<20}{:>7.2}", "all", all.as_secs_f64() / 60.0));
    if count.ignored > 0 {
        run::print(&format!("{} tests are marked ignored and did not run", count.ignored));
    }
}

#[cfg(test)]
mod tests {
    use super::{Part, Scope, in_order};
    use clap::ValueEnum;

    #[test]
    fn parts_run_in_the_suites_order_and_tests_bring_the_build() {
        let in_order = |asked: &[Part]| in_order(asked, Scope::Daily);
        assert_eq!(in_order(&[Part::E2e, Part::Fmt]), [Part::Fmt, Part::Build, Part::Clients, Part::E2e]);
        assert_eq!(in_order(&[Part::Engine]), [Part::Build, Part::Clients, Part::Engine]);
        assert_eq!(in_order(&[Part::Quick]), [Part::Build, Part::Unit, Part::Quick]);
        assert_eq!(in_order(&[Part::Unit]), [Part::Build, Part::Unit]);
        assert_eq!(in_order(&[Part::Clippy]), [Part::Clippy]);
        assert_eq!(in_order(&[]).len(), 14);
    }

    #[test]
    fn a_night_has_every_part_but_the_one_that_repeats_others() {
        let (daily, nightly) = (in_order(&[], Scope::Daily), in_order(&[], Scope::Nightly));
        assert!(daily.iter().all(|part| nightly.contains(part)));
        let missing = Part::value_variants().iter().filter(|part| !nightly.contains(part));
        assert_eq!(missing.collect::<Vec<_>>(), [&Part::Quick]);
    }
}
