//! Long sweeps and golden files: calls of `cargo test` with an environment variable that the tests read.
//!
//! Invariant: a sweep that ran no test fails. `MIDSHIFT_SEED` is read by the test that kills programs, `BLESS`
//! by tests with `golden` in their name.

use crate::parts::Count;
use crate::run;
use crate::workspace::Workspace;
use anyhow::{Result, ensure};

/// Kills servers and agents at work, once with each seed of `from .. from + seeds`; whether all held. Ends at the first that does not.
pub fn torture(workspace: &Workspace, from: u64, seeds: u64) -> Result<bool> {
    ensure!(seeds > 0, "--seeds must be at least 1");
    ensure!(run::succeeds(&mut workspace.cargo(&["build", "--workspace", "--bins"]))?, "the programs do not build");
    for seed in from..from.saturating_add(seeds) {
        let mut command =
            workspace.cargo(&["test", "--package", "midshift-tests", "--test", "e2e", "--", "kill::", "--nocapture"]);
        workspace.export_programs(&mut command)?;
        if !counted(command.env("MIDSHIFT_SEED", seed.to_string()))? {
            run::say(&format!("next: cargo xtask torture --from {seed} --seeds 1"));
            return Ok(false);
        }
    }
    Ok(true)
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
