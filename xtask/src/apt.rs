//! Packages of Debian or Ubuntu that tools are made with.

use crate::run;
use crate::workspace::Workspace;
use anyhow::{Result, bail};
use std::process::Command;

/// Installs packages of Debian or Ubuntu; as another user it says what to type.
pub fn install(workspace: &Workspace, packages: &[&str]) -> Result<()> {
    let root = run::output(Command::new("id").arg("-u")).is_some_and(|id| id.trim() == "0");
    let apt = run::quietly(Command::new("apt-get").arg("--version"));
    if !root || !apt {
        bail!(
            "missing on this machine: {0}; next: sudo apt-get install {0} (or your system's own)",
            packages.join(" ")
        );
    }
    run::install(workspace.command("apt-get").args(["update", "-q"]))?;
    let mut command = workspace.command("apt-get");
    command.args(["install", "-y", "-q", "--no-install-recommends"]).args(packages);
    run::install(command.env("DEBIAN_FRONTEND", "noninteractive"))
}
