//! Finds a Go that can build the tools and the Go client, or fetches one.
//!
//! Invariant: a Go that is already there and new enough is used as it is. Called by [`crate::fetch_tools`] and [`crate::clients`].

use crate::apt;
use crate::run;
use crate::workspace::Workspace;
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

/// What the pinned buf and the Go client ask for.
const NEEDED: (u32, u32) = (1, 24);
/// The first Go that fetches a newer one by itself.
const SWITCHES: (u32, u32) = (1, 21);
/// The Go that an older one fetches as a module, checked against the public checksum database.
const TOOLCHAIN: &str = "v0.0.1-go1.24.13";

/// A Go command, and what it needs in its environment.
pub struct Go {
    program: PathBuf,
    toolchain: &'static str,
}

impl Go {
    /// `go install MODULE@VERSION` into the tools' `bin`.
    pub fn install(&self, workspace: &Workspace, module_at_version: &str) -> Result<()> {
        let mut command = self.command(workspace);
        command.args(["install", module_at_version]).env("GOBIN", workspace.tools().join("bin"));
        run::install(&mut command)
    }

    /// This Go, with the pinned tools and itself on the PATH of what it starts.
    pub fn command(&self, workspace: &Workspace) -> Command {
        let mut command = workspace.command(&self.program);
        // CGO off: no C compiler is needed. Writable cache: `cargo clean` can delete what lies under target/.
        command
            .env("GOTOOLCHAIN", self.toolchain)
            .env("CGO_ENABLED", "0")
            .env("GOFLAGS", "-modcacherw -buildvcs=false");
        let own = self.program.parent().filter(|dir| !dir.as_os_str().is_empty()).map(Path::to_owned);
        command.env("PATH", workspace.path_with(own.into_iter().collect())).env_remove("GOROOT");
        command
    }
}

/// The Go on this machine, or the one fetched before; none: an install is needed.
pub fn usable(workspace: &Workspace) -> Option<Go> {
    match find()? {
        (program, v) if v >= NEEDED => Some(Go { program, toolchain: "local" }),
        (program, v) if v >= SWITCHES => Some(Go { program, toolchain: "auto" }),
        _ => {
            let program = fetched(workspace).join("bin/go");
            program.exists().then_some(Go { program, toolchain: "local" })
        }
    }
}

/// The Go on this machine, after an install if there was none or it was too old.
pub fn find_or_install(workspace: &Workspace) -> Result<Go> {
    if let Some(go) = usable(workspace) {
        return Ok(go);
    }
    if find().is_none() {
        apt::install(workspace, &["golang-go", "ca-certificates"])?;
    }
    if let Some(go) = usable(workspace) {
        return Ok(go);
    }
    let (old, _) = find().context("no working go after installing golang-go")?;
    fetch_toolchain(workspace, &old)?;
    usable(workspace).context("no working go after fetching a newer one")
}

fn find() -> Option<(PathBuf, (u32, u32))> {
    [PathBuf::from("go"), PathBuf::from("/usr/local/go/bin/go"), PathBuf::from("/usr/lib/go/bin/go")]
        .into_iter()
        .find_map(|program| version(&program).map(|version| (program, version)))
}

fn version(program: &Path) -> Option<(u32, u32)> {
    // In a directory without go.mod, and without switching: the version of this very program.
    let mut command = Command::new(program);
    parse_version(&run::output(command.arg("version").env("GOTOOLCHAIN", "local").current_dir(std::env::temp_dir()))?)
}

fn parse_version(text: &str) -> Option<(u32, u32)> {
    let number = text.split_whitespace().find_map(|word| word.strip_prefix("go1."))?;
    let minor: String = number.chars().take_while(char::is_ascii_digit).collect();
    Some((1, minor.parse().ok()?))
}

/// The newer Go as a module of this machine.
fn module() -> String {
    let arch = match std::env::consts::ARCH {
        "x86_64" => "amd64",
        "aarch64" => "arm64",
        other => other,
    };
    format!("golang.org/toolchain@{TOOLCHAIN}.{}-{arch}", std::env::consts::OS)
}

/// Where the newer Go lies once it was fetched.
fn fetched(workspace: &Workspace) -> PathBuf {
    workspace.tools().join("go/pkg/mod").join(module())
}

/// A Go before 1.21 does not switch by itself, but it can fetch the newer one, which is a module like any other.
fn fetch_toolchain(workspace: &Workspace, old: &Path) -> Result<()> {
    let home = workspace.tools().join("go");
    let mut command = workspace.command(old);
    command.args(["mod", "download", &module()]).env("GOPATH", &home).env("GOFLAGS", "-modcacherw").current_dir("/");
    run::install(&mut command)?;
    let root = fetched(workspace);
    // Modules carry no execute bits.
    let mut chmod = workspace.command("chmod");
    ensure!(
        run::quietly(chmod.args(["-R", "u+x"]).arg(root.join("bin")).arg(root.join("pkg/tool"))),
        "making {} executable",
        root.display()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::parse_version;

    #[test]
    fn a_version_is_read_whatever_its_patch() {
        assert_eq!(parse_version("go version go1.19.8 linux/amd64"), Some((1, 19)));
        assert_eq!(parse_version("go version go1.26rc1 linux/arm64"), Some((1, 26)));
        assert_eq!(parse_version("gcc 12"), None);
    }
}
