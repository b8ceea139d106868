//! Where things are: the root of the repository, cargo's target directory, the tools, the built programs.
//!
//! Invariant: every path that xtask uses comes from here, so that `CARGO_TARGET_DIR` holds everywhere.

use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The programs under test, built once, and how tests hear of them.
const PROGRAMS: [(&str, &str); 4] = [
    ("MIDSHIFT_TEST_BIN", "midshift"),
    ("MIDSHIFT_TEST_STOP", "midshift-stop"),
    ("MIDSHIFT_TEST_LAUNCHER", "midshift-launcher"),
    ("MIDSHIFT_TEST_OWN_ROBOT", "examples/own_robot"),
];

/// Paths of this checkout.
pub struct Workspace {
    /// The directory of the root Cargo.toml.
    pub root: PathBuf,
    /// Cargo's target directory.
    pub target: PathBuf,
    /// The version that all crates share.
    version: Option<String>,
    /// This program, as it was called: a build of everything may put a new one in its place, and then the system says that it is deleted.
    pub this: PathBuf,
}

impl Workspace {
    /// Asks cargo.
    pub fn find() -> Result<Self> {
        let output = Command::new(cargo())
            .args(["metadata", "--no-deps", "--format-version", "1"])
            .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")))
            .output()
            .context("running cargo metadata")?;
        ensure!(output.status.success(), "cargo metadata: {}", String::from_utf8_lossy(&output.stderr).trim());
        let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).context("reading cargo metadata")?;
        let path = |key: &str| metadata[key].as_str().map(PathBuf::from).with_context(|| format!("no {key}"));
        let this = std::env::current_exe().context("this program")?;
        let ours = |package: &&serde_json::Value| package["name"] == "midshift";
        let midshift = metadata["packages"].as_array().and_then(|all| all.iter().find(ours));
        let version = midshift.and_then(|package| package["version"].as_str()).map(str::to_owned);
        Ok(Self { root: path("workspace_root")?, target: path("target_directory")?, version, this })
    }

    /// The version of midshift at hand.
    pub fn version(&self) -> Result<String> {
        self.version.clone().context("cargo knows of no package midshift")
    }

    /// Where downloaded tools are kept.
    pub fn tools(&self) -> PathBuf {
        self.target.join("tools")
    }

    /// The midshift program that the suite builds.
    pub fn midshift(&self) -> PathBuf {
        self.target.join("debug").join(format!("midshift{}", std::env::consts::EXE_SUFFIX))
    }

    /// A PATH that begins with the pinned tools and `more`.
    pub fn path_with(&self, more: Vec<PathBuf>) -> std::ffi::OsString {
        let own = std::env::var_os("PATH").unwrap_or_default();
        let first = [self.tools().join("bin")].into_iter().chain(more);
        std::env::join_paths(first.chain(std::env::split_paths(&own))).unwrap_or(own)
    }

    /// A command that runs in the root.
    pub fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new(program);
        command.current_dir(&self.root).stdin(std::process::Stdio::null());
        command
    }

    /// A cargo command that runs in the root.
    pub fn cargo(&self, args: &[&str]) -> Command {
        let mut command = self.command(cargo());
        command.args(args);
        command
    }

    /// Tells tests where the debug programs are; an error names the one that was not built.
    pub fn export_programs(&self, command: &mut Command) -> Result<()> {
        for (variable, name) in PROGRAMS {
            let path = self.target.join("debug").join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
            ensure!(path.is_file(), "the build left no {}", path.display());
            command.env(variable, path);
        }
        Ok(())
    }
}

fn cargo() -> std::ffi::OsString {
    std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into())
}
