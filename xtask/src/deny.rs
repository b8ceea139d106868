//! `cargo deny check`: whether every dependency may be here, by deny.toml. It fetches the list of advisories.
//!
//! Invariant: pinned, in `target/tools`, and installed by `cargo xtask test --install --nightly` alone: to build it takes minutes.

use crate::run;
use crate::workspace::Workspace;
use anyhow::{Result, ensure};
use std::path::PathBuf;

const VERSION: &str = "0.20.2";

fn program(workspace: &Workspace) -> PathBuf {
    workspace.tools().join("bin/cargo-deny")
}

fn is_there(workspace: &Workspace) -> bool {
    let version = run::output(workspace.command(program(workspace)).arg("--version"));
    version.is_some_and(|version| version.split_whitespace().last() == Some(VERSION))
}

/// Installs it if it is missing.
pub fn install(workspace: &Workspace) -> Result<()> {
    if is_there(workspace) {
        return Ok(());
    }
    let mut install =
        workspace.cargo(&["install", "cargo-deny", "--locked", "--force", "--version", VERSION, "--root"]);
    // Not with the flags of this workspace, nor in its target directory.
    install.arg(workspace.tools()).env("RUSTFLAGS", "").env_remove("CARGO_TARGET_DIR");
    run::install(&mut install)
}

/// Whether nothing is here that may not be.
pub fn check(workspace: &Workspace) -> Result<bool> {
    ensure!(
        is_there(workspace),
        "missing: cargo-deny {VERSION} in {}\nnext: cargo xtask test --install --nightly",
        workspace.tools().display()
    );
    run::succeeds(workspace.command(program(workspace)).arg("check"))
}
