//! The clients in other languages: what they are built with, and how they are generated and built from the .proto files.
//!
//! Invariant: nothing is written beside the sources. `clients/` and `proto/` are copied below `target/tools/clients`, and generated, built
//! and tested there. Only [`install`] uses the network. Called by [`crate::fetch_tools`] and [`crate::parts`].

use crate::workspace::Workspace;
use crate::{apt, go, run};
use anyhow::{Context, Result, ensure};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The system's Node.js.
pub const NODE: &str = "node";
/// What the TypeScript client asks for.
const NODE_NEEDED: u32 = 20;
/// Made beside the copied sources, and kept when they are copied anew.
const MADE: [&str; 8] =
    ["node_modules", "gen", "dist", "bin", "build", "built", "__pycache__", "midshift_client.egg-info"];
/// Programs of the Go client that tests start.
const GO_PROGRAMS: [&str; 4] = ["./cmd/tour", "./cmd/endure", "./cmd/batch", "./cmd/keyfile"];

/// The copy of one client.
fn copy_of(workspace: &Workspace, client: &str) -> PathBuf {
    copies(workspace).join("clients").join(client)
}

fn copies(workspace: &Workspace) -> PathBuf {
    workspace.tools().join("clients")
}

/// A lock file of the sources; its text is the stamp of what was installed by it.
fn locked(workspace: &Workspace, client: &str, file: &str) -> Result<String> {
    let path = workspace.root.join("clients").join(client).join(file);
    std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))
}

/// The client, its lock file, and what is installed by it.
const LOCKS: [(&str, &str, &str); 2] =
    [("typescript", "package-lock.json", "modules of npm"), ("go", "go.sum", "modules of Go")];

fn stamp_of(workspace: &Workspace, client: &str) -> PathBuf {
    copies(workspace).join(format!("{client}.installed"))
}

fn is_installed(workspace: &Workspace, client: &str, file: &str) -> bool {
    let stamp = std::fs::read_to_string(stamp_of(workspace, client));
    stamp.is_ok_and(|stamp| locked(workspace, client, file).is_ok_and(|lock| lock == stamp))
}

/// What the clients cannot be built without and is not there.
pub fn missing(workspace: &Workspace) -> Vec<String> {
    let mut missing = Vec::new();
    if !has_node() {
        missing.push(format!("node {NODE_NEEDED} or newer with npm, programs of the system"));
    }
    if go::usable(workspace).is_none() {
        missing.push("go, a program of the system".to_owned());
    }
    let absent = LOCKS.into_iter().filter(|(client, file, _)| !is_installed(workspace, client, file));
    missing.extend(absent.map(|(client, file, what)| format!("{what} of clients/{client}: {file}")));
    missing
}

/// Installs what is missing.
pub fn install(workspace: &Workspace) -> Result<()> {
    if !has_node() {
        apt::install(workspace, &["nodejs", "npm"])?;
        ensure!(
            has_node(),
            "node {NODE_NEEDED} or newer with npm is needed, and this system's packages have an older one"
        );
    }
    for (client, file, _) in LOCKS.into_iter().filter(|(client, file, _)| !is_installed(workspace, client, file)) {
        copy_all(workspace)?;
        let mut command = match client {
            "go" => {
                let mut command = go::find_or_install(workspace)?.command(workspace);
                command.args(["mod", "download"]);
                command
            }
            _ => {
                let mut command = workspace.command("npm");
                command.args(["ci", "--no-audit", "--no-fund", "--ignore-scripts", "--loglevel", "error"]);
                command
            }
        };
        run::install(command.current_dir(copy_of(workspace, client)))?;
        let stamp = stamp_of(workspace, client);
        std::fs::write(&stamp, locked(workspace, client, file)?)
            .with_context(|| format!("stamping {}", stamp.display()))?;
    }
    Ok(())
}

fn has_node() -> bool {
    let version = run::output(Command::new(NODE).arg("--version"));
    version.and_then(|v| major(&v)).is_some_and(|v| v >= NODE_NEEDED)
        && run::quietly(Command::new("npm").arg("--version"))
}

fn major(version: &str) -> Option<u32> {
    version.trim().strip_prefix('v')?.split('.').next()?.parse().ok()
}

/// Generates and builds all clients, unless this was done with the same sources; whether it succeeded.
pub fn build(workspace: &Workspace, python: &Path) -> Result<bool> {
    let digest = copy_all(workspace)?;
    let stamp = copies(workspace).join("built.digest");
    if std::fs::read_to_string(&stamp).is_ok_and(|built| built == digest) {
        return Ok(true);
    }
    let built = build_python(workspace, python)? && build_go(workspace)? && build_typescript(workspace)?;
    if built {
        std::fs::write(&stamp, digest).with_context(|| format!("stamping {}", stamp.display()))?;
    }
    Ok(built)
}

/// The package as `pip install` makes it, in a folder of its own.
fn build_python(workspace: &Workspace, python: &Path) -> Result<bool> {
    let home = copy_of(workspace, "python");
    remove(&home.join("built"))?;
    remove(&home.join("build"))?;
    let mut pip = workspace.command(python);
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index", "--no-deps"]);
    pip.args(["--no-build-isolation", "--target", "built", "."]).env("PYTHONDONTWRITEBYTECODE", "1");
    run::succeeds(pip.current_dir(home))
}

fn build_go(workspace: &Workspace) -> Result<bool> {
    let home = copy_of(workspace, "go");
    let go = go::usable(workspace).context("no go")?;
    let go = |args: &[&str]| run::succeeds(go.command(workspace).args(args).current_dir(&home));
    Ok(go(&["generate", "."])?
        && go(&[&["build", "-o", "bin/"], &GO_PROGRAMS[..]].concat())?
        && go(&["vet", "./midshift", "./cmd/..."])?
        && go(&["test", "-c", "-o", "bin/midshift.test", "./midshift"])?)
}

fn build_typescript(workspace: &Workspace) -> Result<bool> {
    let home = copy_of(workspace, "typescript");
    remove(&home.join("dist"))?;
    let path = workspace.path_with(Vec::new());
    let npm = |verb: &str| {
        let mut command = workspace.command("npm");
        run::succeeds(command.args(["run", "--silent", verb]).env("PATH", &path).current_dir(&home))
    };
    Ok(npm("generate")? && npm("build")?)
}

/// Tells tests where the built clients are.
pub fn export(workspace: &Workspace, command: &mut Command) {
    command.env("MIDSHIFT_TEST_CLIENTS", copies(workspace).join("clients"));
}

/// Copies `clients/` and `proto/`, without what is made there; a digest of all that was copied.
fn copy_all(workspace: &Workspace) -> Result<String> {
    let mut digest = DefaultHasher::new();
    for name in ["proto/midshift", "proto/buf.yaml", "proto/service_config.json", "clients"] {
        let to = copies(workspace).join(name);
        clear(&to)?;
        copy(&workspace.root.join(name), &to, &mut digest).with_context(|| format!("copying {name}"))?;
    }
    Ok(format!("{:016x}", digest.finish()))
}

fn is_made(path: &Path) -> bool {
    path.file_name().is_some_and(|name| MADE.iter().any(|made| name == *made))
}

fn copy(from: &Path, to: &Path, digest: &mut DefaultHasher) -> std::io::Result<()> {
    if is_made(from) {
        return Ok(());
    }
    from.hash(digest);
    if !from.is_dir() {
        let bytes = std::fs::read(from)?;
        bytes.hash(digest);
        if let Some(folder) = to.parent() {
            std::fs::create_dir_all(folder)?;
        }
        return std::fs::write(to, bytes);
    }
    let mut entries: Vec<_> = std::fs::read_dir(from)?.collect::<std::io::Result<_>>()?;
    entries.sort_by_key(std::fs::DirEntry::file_name);
    entries.into_iter().try_for_each(|entry| copy(&entry.path(), &to.join(entry.file_name()), digest))
}

/// Removes sources that were copied before: what is gone from the sources is gone from the copy.
fn clear(path: &Path) -> Result<()> {
    if is_made(path) || !path.exists() {
        return Ok(());
    }
    if !path.is_dir() {
        return std::fs::remove_file(path).with_context(|| format!("removing {}", path.display()));
    }
    for entry in std::fs::read_dir(path).with_context(|| format!("reading {}", path.display()))? {
        clear(&entry?.path())?;
    }
    Ok(())
}

fn remove(folder: &Path) -> Result<()> {
    if folder.exists() {
        std::fs::remove_dir_all(folder).with_context(|| format!("removing {}", folder.display()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{DefaultHasher, Hasher, clear, copy, major};

    #[test]
    fn a_changed_source_is_another_digest_and_what_was_made_stays() {
        let home = std::env::temp_dir().join(format!("xtask-clients-{}", std::process::id()));
        let (from, to) = (home.join("from"), home.join("to"));
        std::fs::create_dir_all(from.join("src")).unwrap();
        std::fs::create_dir_all(to.join("gen")).unwrap();
        std::fs::write(to.join("gen/made"), "").unwrap();
        std::fs::write(to.join("gone"), "").unwrap();
        let digest_of = |text: &str| {
            std::fs::write(from.join("src/main"), text).unwrap();
            let mut digest = DefaultHasher::new();
            clear(&to).unwrap();
            copy(&from, &to, &mut digest).unwrap();
            digest.finish()
        };
        let first = digest_of("one");
        assert_eq!(first, digest_of("one"));
        assert_ne!(first, digest_of("two"));
        assert_eq!(std::fs::read_to_string(to.join("src/main")).unwrap(), "two");
        assert!(to.join("gen/made").exists() && !to.join("gone").exists());
        std::fs::remove_dir_all(&home).unwrap();
    }

    #[test]
    fn a_version_of_node_is_read() {
        assert_eq!(major("v20.20.2\n"), Some(20));
        assert_eq!(major("command not found"), None);
    }
}
