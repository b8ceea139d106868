//! The .proto files by buf: its rules, what each version says of them, and that none of it is broken.

use crate::fetch_tools::Tools;
use crate::run;
use crate::workspace::Workspace;
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Folders of what each release left, from the root.
pub const RELEASES: &str = "tests/fixtures";
/// Descriptors of every .proto of a version.
const PROTOS: &str = "protos.binpb";

fn buf(workspace: &Workspace, tools: &Tools) -> Command {
    let mut command = workspace.command(&tools.buf);
    command.current_dir(workspace.root.join("proto"));
    command
}

/// Whether the .proto files keep the STANDARD rules.
pub fn lint(workspace: &Workspace, tools: &Tools) -> Result<bool> {
    run::succeeds(buf(workspace, tools).arg("lint"))
}

/// Writes the descriptors of this version into a folder.
pub fn describe(workspace: &Workspace, tools: &Tools, to: &Path) -> Result<bool> {
    run::succeeds(buf(workspace, tools).args(["build", "--exclude-source-info", "-o"]).arg(to.join(PROTOS)))
}

/// Whether the .proto files break nothing of what any recorded version says on the wire.
pub fn breaks_nothing(workspace: &Workspace, tools: &Tools) -> Result<bool> {
    for image in images(&workspace.root.join(RELEASES))? {
        if !run::succeeds(buf(workspace, tools).args(["breaking", "--against"]).arg(image))? {
            return Ok(false);
        }
    }
    Ok(true)
}

/// What is said of .proto files by each version; an error if that is none.
fn images(fixtures: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(fixtures).with_context(|| format!("reading {}", fixtures.display()))?;
    let images = entries.map(|entry| Ok(entry?.path().join(PROTOS))).collect::<Result<Vec<_>>>()?;
    let mut images: Vec<PathBuf> = images.into_iter().filter(|image| image.is_file()).collect();
    images.sort();
    ensure!(!images.is_empty(), "no version has left {PROTOS} in {}", fixtures.display());
    Ok(images)
}

#[cfg(test)]
mod tests {
    use super::{PROTOS, images};
    use std::fs;

    #[test]
    fn every_version_that_left_its_protos_is_held_against() {
        let dir = tempfile::tempdir().expect("a folder");
        assert!(images(dir.path()).is_err());
        for version in ["0.1.0", "0.2.0", "none"] {
            fs::create_dir(dir.path().join(version)).expect("made");
        }
        let left = ["0.1.0", "0.2.0"].map(|version| dir.path().join(version).join(PROTOS));
        left.iter().for_each(|image| fs::write(image, "").expect("written"));
        assert_eq!(images(dir.path()).expect("read"), left);
    }
}
