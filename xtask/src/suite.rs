//! `cargo xtask test`: tools, parts in order, the table of minutes, the closing line.
//!
//! Invariant: the first part that fails ends the run, the table is printed all the same, and the last line on stdout is
//! `N passed, N failed` whenever tests ran.

use crate::fetch_tools::Tools;
use crate::parts::{Count, Part};
use crate::workspace::Workspace;
use crate::{docker, run};
use anyhow::Result;
use clap::ValueEnum;
use std::time::Duration;

/// One line of the table.
struct Line {
    name: &'static str,
    took: Duration,
    passed: bool,
}

/// Runs `asked`, or everything if nothing is asked; whether all passed.
pub fn test(workspace: &Workspace, install: bool, no_docker: bool, asked: &[Part]) -> Result<bool> {
    let mut parts = in_order(asked);
    if no_docker {
        parts.retain(|part| *part != Part::Compose);
        run::print_line("--no-docker: the part `compose` is left out");
    }
    let mut lines = Vec::new();
    let mut count = Count::default();
    let mut tools = None;
    if parts.iter().any(|part| part.needs_tools()) {
        let (found, took) = timed(|| if install { Tools::install(workspace) } else { Tools::find(workspace) });
        tools = Some(found?);
        if install && parts.contains(&Part::Compose) {
            docker::install(workspace)?;
        }
        lines.push(Line { name: "tools", took, passed: true });
    }
    for part in parts {
        run::print_line(&format!("\n== {}", part.name()));
        let (outcome, took) = timed(|| part.run(workspace, tools.as_ref(), &mut count));
        let passed = outcome.unwrap_or_else(|error| {
            run::print_line(&format!("error: {error:#}"));
            false
        });
        lines.push(Line { name: part.name(), took, passed });
        if !passed {
            break;
        }
    }
    let passed = lines.iter().all(|line| line.passed) && count.failed == 0;
    print_table(&lines, count);
    if let Some(failed) = lines.iter().find(|line| !line.passed) {
        run::print_line(&format!("failed: {0}; next: cargo xtask test {0}", failed.name));
    }
    if count != Count::default() {
        run::print(&format!("{} passed, {} failed", count.passed, count.failed));
    }
    Ok(passed)
}

/// The suite's order, each part once, and the programs and clients before the tests that start them.
fn in_order(asked: &[Part]) -> Vec<Part> {
    let brought = |part: &Part| match part {
        Part::Build => asked.iter().any(|p| p.runs_tests()),
        Part::Clients => asked.contains(&Part::Suite) || asked.contains(&Part::Engine),
        _ => false,
    };
    let wanted = |part: &Part| asked.is_empty() || asked.contains(part) || brought(part);
    Part::value_variants().iter().copied().filter(wanted).collect()
}

fn print_table(lines: &[Line], count: Count) {
    run::print("\npart      minutes");
    for line in lines {
        let minutes = line.took.as_secs_f64() / 60.0;
        run::print(&format!("{:<10}{minutes:>7.2}{}", line.name, if line.passed { "" } else { "  FAILED" }));
    }
    let all: Duration = lines.iter().map(|line| line.took).sum();
    run::print(&format!("{:<10}{:>7.2}", "all", all.as_secs_f64() / 60.0));
    if count.ignored > 0 {
        run::print(&format!("{} tests are marked ignored and did not run", count.ignored));
    }
}

#[expect(clippy::disallowed_methods, reason = "minutes of the suite by the wall, for a person")]
fn timed<T>(what: impl FnOnce() -> T) -> (T, Duration) {
    let started = std::time::Instant::now();
    let outcome = what();
    (outcome, started.elapsed())
}

#[cfg(test)]
mod tests {
    use super::{Part, in_order};

    #[test]
    fn parts_run_in_the_suites_order_and_tests_bring_the_build() {
        assert_eq!(in_order(&[Part::Suite, Part::Fmt]), [Part::Fmt, Part::Build, Part::Clients, Part::Suite]);
        assert_eq!(in_order(&[Part::Engine]), [Part::Build, Part::Clients, Part::Engine]);
        assert_eq!(in_order(&[Part::Unit]), [Part::Build, Part::Unit]);
        assert_eq!(in_order(&[Part::Clippy]), [Part::Clippy]);
        assert_eq!(in_order(&[]).len(), 13);
    }
}
