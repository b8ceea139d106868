//! A stack as its users see it: the ports that it publishes, what signs in, and one task through it.

use crate::run;
use crate::workspace::Workspace;
use anyhow::Result;
use std::path::{Path, PathBuf};

/// A task of the demo site.
const TASK: [&str; 9] = ["task", "submit", "--from", "A01", "--to", "B03", "--sku", "SKU-1", "--wait"];
/// Ports that the file publishes; a stack of a test has free ones.
pub const PORTS: [&str; 5] = [
    "MIDSHIFT_PUBLIC_PORT",
    "MIDSHIFT_ROBOTS_PORT",
    "MIDSHIFT_MACHINES_PORT",
    "MIDSHIFT_STOP_PORT",
    "MIDSHIFT_ONE_BOX_PORT",
];
/// What the first start left for whoever signs in, below the folder of volumes.
const ROOT: &str = "site/ca.pem";
const TOKEN: &str = "token/token";

/// What signs in to a stack: files with the site's root and its first token.
pub struct Site {
    /// The site's root certificate, PEM.
    pub root: PathBuf,
    /// May do everything.
    pub token: PathBuf,
}

impl Site {
    /// Of a stack with its state in `folder`.
    pub fn below(folder: &Path) -> Self {
        let volumes = folder.join("volumes");
        Self { root: volumes.join(ROOT), token: volumes.join(TOKEN) }
    }
}

/// One task through the public address, to its end.
pub fn submit_task(workspace: &Workspace, midshift: &Path, public: &str, site: &Site) -> Result<bool> {
    let mut command = workspace.command(midshift);
    command.args(TASK).args(["--server", public, "--ca"]).arg(&site.root).arg("--token-file").arg(&site.token);
    run::succeeds(&mut command)
}
