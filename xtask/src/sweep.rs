//! Long sweeps and golden files: calls of `cargo test` with an environment variable that the tests read.
//!
//! Invariant: a sweep that ran no test fails. `MIDSHIFT_SEEDS` and `MIDSHIFT_SEED_FROM` are read by the simulation, `BLESS`
//! by tests with `golden` in their name.

use crate::parts::Count;
use crate::run;
use crate::workspace::Workspace;
use anyhow::{Result, ensure};

/// Runs the simulation with seeds `from .. from + seeds`; whether all held.
pub fn torture(workspace: &Workspace, from: u64, seeds: u64) -> Result<bool> {
    ensure!(seeds > 0, "--seeds must be at least 1");
    let mut command =
        workspace.cargo(&["test", "--package", "midshift-tests", "--test", "*", "--", "simulation", "--nocapture"]);
    command.env("MIDSHIFT_SEEDS", seeds.to_string()).env("MIDSHIFT_SEED_FROM", from.to_string());
    let passed = counted(&mut command)?;
    if !passed {
        run::say("next: cargo xtask torture --from SEED --seeds 1, with the seed printed above");
    }
    Ok(passed)
}

/// Runs the tests that hold golden files and lets them write what they see.
pub fn golden(workspace: &Workspace) -> Result<bool> {
    ensure!(run::succeeds(&mut workspace.cargo(&["build", "--workspace", "--bins"]))?, "the programs do not build");
    let mut command = workspace.cargo(&["test", "--workspace", "--tests", "--", "golden"]);
    workspace.export_programs(&mut command)?;
    let passed = counted(command.env("BLESS", "1"))?;
    run::say("next: git diff, and read it before you commit it");
    Ok(passed)
}

/// Formats, then [`golden`].
pub fn tidy(workspace: &Workspace) -> Result<bool> {
    Ok(run::succeeds(&mut workspace.cargo(&["fmt", "--all"]))? && golden(workspace)?)
}

fn counted(command: &mut std::process::Command) -> Result<bool> {
    let mut count = Count::default();
    let succeeded = run::reading(command, |line| count.add(line))?;
    run::print(&format!("{} passed, {} failed", count.passed, count.failed));
    ensure!(!succeeded || count.passed > 0, "no test matched");
    Ok(succeeded)
}
