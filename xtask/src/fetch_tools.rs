//! The outside programs that tests of real components talk to, pinned, under `target/tools`; and strace and PostgreSQL, which are
//! the system's.
//!
//! Invariant: without `--install` nothing is fetched and nothing is skipped: what is missing is listed and the suite fails.
//! A tool counts as there when its program exists and its stamp names the pinned version, so a second install is quick.

use crate::workspace::Workspace;
use crate::{apt, clients, go, run};
use anyhow::{Context, Result, bail, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

const GRPCURL: &str = "github.com/fullstorydev/grpcurl/cmd/grpcurl@v1.9.3";
const BUF: &str = "github.com/bufbuild/buf/cmd/buf@v1.57.2";
/// Its package and program of the system.
const STRACE: &str = "strace";
/// Its package and program of the system.
const HAPROXY: &str = "haproxy";
/// Its package and program of the system.
const OPENSSL: &str = "openssl";
/// What the Python client needs; it pins gRPC for all of Python here.
const PYTHON_CLIENT: &str = include_str!("../../clients/python/requirements.txt");
const PYTHON: &[&str] = &["tuf==7.0.1", "securesystemslib[crypto]==1.6.0", "cryptography==50.0.2"];
/// Its package, and where it has the server's programs, by version.
const POSTGRESQL: &str = "postgresql";
const POSTGRESQL_PROGRAMS: &str = "/usr/lib/postgresql";
/// Oldest version that is tried out.
const POSTGRESQL_MIN: u32 = 15;

/// Paths of the tools.
pub struct Tools {
    /// The program grpcurl.
    pub grpcurl: PathBuf,
    /// The program buf.
    pub buf: PathBuf,
    /// A Python that can import grpc, grpc_tools and tuf.
    pub python: PathBuf,
    /// strace, of any version that can inject signals.
    pub strace: PathBuf,
    /// HAProxy, 2.6 or newer.
    pub haproxy: PathBuf,
    /// OpenSSL, 3.0 or newer.
    pub openssl: PathBuf,
    /// Node.js, the system's.
    pub node: PathBuf,
}

impl Tools {
    /// Where they are or will be.
    fn new(workspace: &Workspace) -> Self {
        let tools = workspace.tools();
        Self {
            grpcurl: tools.join("bin/grpcurl"),
            buf: tools.join("bin/buf"),
            python: tools.join("venv/bin/python"),
            strace: STRACE.into(),
            haproxy: HAPROXY.into(),
            openssl: OPENSSL.into(),
            node: clients::NODE.into(),
        }
    }

    fn each(&self) -> [(&'static str, &PathBuf, String); 3] {
        [
            ("grpcurl", &self.grpcurl, GRPCURL.to_owned()),
            ("buf", &self.buf, BUF.to_owned()),
            ("python with gRPC and TUF", &self.python, python_packages().join(" ")),
        ]
    }

    /// All tools, or an error that lists the missing ones.
    pub fn find(workspace: &Workspace) -> Result<Self> {
        let tools = Self::new(workspace);
        let mut missing: Vec<_> =
            tools.each().into_iter().filter(|t| !present(t.1, &t.2)).map(|t| format!("  {}: {}", t.0, t.2)).collect();
        if !tools.has_strace() {
            missing.push(format!("  {STRACE}, a program of the system"));
        }
        if !tools.has_haproxy() {
            missing.push(format!("  {HAPROXY}, a program of the system"));
        }
        if !tools.has_openssl() {
            missing.push(format!("  {OPENSSL} 3.0 or newer, a program of the system"));
        }
        missing.extend(clients::missing(workspace).into_iter().map(|what| format!("  {what}")));
        if !has_postgresql(Path::new(POSTGRESQL_PROGRAMS)) {
            missing.push(format!("  {POSTGRESQL} {POSTGRESQL_MIN} or newer, server programs of the system"));
        }
        if missing.is_empty() {
            return Ok(tools);
        }
        bail!(
            "missing, in {} unless it says otherwise:\n{}\nnext: cargo xtask test --install",
            workspace.tools().display(),
            missing.join("\n")
        )
    }

    /// Installs what is missing.
    pub fn install(workspace: &Workspace) -> Result<Self> {
        let tools = Self::new(workspace);
        std::fs::create_dir_all(workspace.tools().join("bin")).context("creating target/tools/bin")?;
        let absent = [(&tools.grpcurl, GRPCURL), (&tools.buf, BUF)].into_iter().filter(|t| !present(t.0, t.1));
        let absent: Vec<_> = absent.collect();
        if !absent.is_empty() {
            let go = go::find_or_install(workspace)?;
            for (program, module) in absent {
                go.install(workspace, module)?;
                stamp(program, module)?;
            }
        }
        if !present(&tools.python, &python_packages().join(" ")) {
            install_python(workspace, &tools.python)?;
        }
        if !tools.has_strace() {
            apt::install(workspace, &[STRACE])?;
        }
        if !tools.has_haproxy() {
            apt::install(workspace, &[HAPROXY])?;
        }
        if !tools.has_openssl() {
            apt::install(workspace, &[OPENSSL])?;
        }
        clients::install(workspace)?;
        if !has_postgresql(Path::new(POSTGRESQL_PROGRAMS)) {
            apt::install(workspace, &[POSTGRESQL])?;
        }
        Self::find(workspace)
    }

    fn has_haproxy(&self) -> bool {
        run::quietly(Command::new(&self.haproxy).arg("-v"))
    }

    fn has_openssl(&self) -> bool {
        let version = run::output(Command::new(&self.openssl).arg("version"));
        version.is_some_and(|version| version.strip_prefix("OpenSSL ").is_some_and(|v| v >= "3"))
    }

    fn has_strace(&self) -> bool {
        run::quietly(Command::new(&self.strace).arg("-V"))
    }

    /// Tells tests where the tools are.
    pub fn export(&self, command: &mut Command) {
        command.env("MIDSHIFT_TEST_GRPCURL", &self.grpcurl);
        command.env("MIDSHIFT_TEST_BUF", &self.buf);
        command.env("MIDSHIFT_TEST_PYTHON", &self.python);
        command.env("MIDSHIFT_TEST_STRACE", &self.strace);
        command.env("MIDSHIFT_TEST_HAPROXY", &self.haproxy);
        command.env("MIDSHIFT_TEST_NODE", &self.node);
        command.env("MIDSHIFT_TEST_OPENSSL", &self.openssl);
    }
}

fn python_packages() -> Vec<&'static str> {
    let clients = PYTHON_CLIENT.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    clients.chain(PYTHON.iter().copied()).collect()
}

/// Whether tests can start a server of their own. One that the system runs is of no use and in no way.
fn has_postgresql(programs: &Path) -> bool {
    let versions = std::fs::read_dir(programs).into_iter().flatten().flatten().map(|entry| entry.path());
    let new_enough = |path: &PathBuf| {
        let version = path.file_name().and_then(|name| name.to_str()?.parse::<u32>().ok());
        version.is_some_and(|version| version >= POSTGRESQL_MIN)
    };
    versions.filter(new_enough).any(|path| ["initdb", "postgres"].iter().all(|p| path.join("bin").join(p).is_file()))
}

fn install_python(workspace: &Workspace, python: &Path) -> Result<()> {
    let can_make_venvs = || run::quietly(Command::new("python3").args(["-c", "import venv, ensurepip"]));
    if !can_make_venvs() {
        apt::install(workspace, &["python3", "python3-venv"])?;
        ensure!(can_make_venvs(), "python3 cannot make virtual environments");
    }
    let venv = workspace.tools().join("venv");
    let mut make = workspace.command("python3");
    ensure!(run::succeeds(make.args(["-m", "venv", "--clear"]).arg(&venv))?, "creating {}", venv.display());
    let mut pip = workspace.command(python);
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:"])
        .args(python_packages());
    run::install(&mut pip)?;
    stamp(python, &python_packages().join(" "))
}

/// The stamp of the venv's Python lies in the venv, so that making it anew removes it.
fn stamp_of(program: &Path) -> PathBuf {
    program.with_extension("installed")
}

fn stamp(program: &Path, version: &str) -> Result<()> {
    ensure!(program.exists(), "the install left no {}", program.display());
    std::fs::write(stamp_of(program), version).with_context(|| format!("stamping {}", program.display()))
}

fn present(program: &Path, version: &str) -> bool {
    program.exists() && std::fs::read_to_string(stamp_of(program)).is_ok_and(|stamp| stamp == version)
}

#[cfg(test)]
mod tests {
    use super::{has_postgresql, present, stamp};

    #[test]
    fn a_tool_of_another_version_is_not_there() {
        let directory = std::env::temp_dir().join(format!("xtask-{}", std::process::id()));
        std::fs::create_dir_all(&directory).unwrap();
        let program = directory.join("tool");
        assert!(stamp(&program, "v1").is_err(), "an install that left nothing is stamped");
        std::fs::write(&program, "").unwrap();
        stamp(&program, "v1").unwrap();
        assert!(present(&program, "v1"));
        assert!(!present(&program, "v2"));
        std::fs::remove_dir_all(&directory).unwrap();
    }

    #[test]
    fn postgresql_is_there_when_a_new_enough_version_has_its_server_programs() {
        let directory = std::env::temp_dir().join(format!("xtask-pg-{}", std::process::id()));
        let add = |file: &str| {
            let path = directory.join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
            has_postgresql(&directory)
        };
        assert!(!has_postgresql(&directory), "no directory");
        assert!(!add("14/bin/initdb") && !add("14/bin/postgres"), "too old");
        assert!(!add("16/bin/initdb"), "a client only");
        assert!(add("16/bin/postgres"));
        std::fs::remove_dir_all(&directory).unwrap();
    }
}
