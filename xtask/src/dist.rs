//! `cargo xtask dist`: what a release consists of, made by one command: an archive of the programs with what an operator needs beside them, the
//! source, the images, and a file of digests.
//!
//! Invariant: only files that are committed go in, beside the programs; the same commit and programs give the same archive, byte by byte; what was
//! made has been started before it is named. Nothing is uploaded.

use crate::workspace::Workspace;
use crate::{docker, images, run};
use anyhow::{Context, Result, bail, ensure};
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Programs of an archive.
const PROGRAMS: [&str; 3] = ["midshift", "midshift-stop", "midshift-launcher"];
/// Packages that they are of.
const PACKAGES: [&str; 3] = ["midshift", "midshift-stop", "midshift-agent"];
/// What goes with them, files and folders of the repository.
const BESIDE: [&str; 15] = [
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "LICENSE",
    "README.md",
    "SECURITY.md",
    "STYLE.md",
    "clients",
    "deploy",
    "docs",
    "ota_bundles/README.md",
    "proto",
    "robot_agent/examples/own_robot.rs",
    "robot_agent/src/body.rs",
    "sites",
];

/// What to make.
#[derive(clap::Args)]
pub struct Options {
    /// Where it goes; unless told, target/release-VERSION.
    #[arg(long)]
    to: Option<PathBuf>,
    /// Archives only: for a machine without docker.
    #[arg(long)]
    no_image: bool,
    /// Images stand on the libraries of this machine, for where no public image can be pulled; without it on those that deploy/Dockerfile names.
    #[arg(long, conflicts_with = "no_image")]
    machine_bases: bool,
}

/// Makes it all of the commit at hand. An error says what keeps this commit from being a release.
pub fn dist(workspace: &Workspace, options: &Options) -> Result<bool> {
    let changes = git(workspace, &["status", "--porcelain"])?;
    ensure!(changes.is_empty(), "there is what no commit has; commit or remove it first:\n{changes}");
    let version = workspace.version()?;
    let notes = std::fs::read_to_string(workspace.root.join("CHANGELOG.md")).context("reading CHANGELOG.md")?;
    ensure!(is_told(&notes, &version), "CHANGELOG.md has no heading \"## {version}\": say first what is in it");
    let left = workspace.root.join("tests/fixtures").join(&version);
    ensure!(left.is_dir(), "nobody has kept what a run of {version} leaves; next: cargo xtask fixtures record");
    let to = options.to.clone().unwrap_or_else(|| workspace.target.join(format!("release-{version}")));
    ensure!(!to.exists(), "{} is there already; remove it or name another folder by --to", to.display());
    let packages = PACKAGES.iter().flat_map(|package| ["-p", package]);
    let build: Vec<&str> = ["build", "--locked", "--profile", "dist", "--bins"].into_iter().chain(packages).collect();
    if !run::succeeds(&mut workspace.cargo(&build))? {
        return Ok(false);
    }
    let temporary = Temporary::new()?;
    let made = temporary.path.join("made");
    let programs = workspace.target.join("dist");
    archives(workspace, &version, &programs, &temporary.path, &made)?;
    check_archive(&made.join(format!("{}.tar.gz", name_of(&version))), &temporary.path, &version)?;
    if !options.no_image {
        let bases = if options.machine_bases { images::Bases::OfThisMachine } else { images::Bases::AsWritten };
        let program = programs.join(PROGRAMS[0]);
        docker::with_any(&temporary.path, |docker| {
            save(docker, &temporary.path, workspace, &program, bases, &version, &made)
        })?;
    }
    digests(&made)?;
    // Whole or not at all: the folder gets its name when everything is in it.
    let part = to.with_extension("part");
    let copied = run::succeeds(Command::new("cp").arg("-r").arg(&made).arg(&part)).is_ok_and(|copied| copied);
    if !copied || std::fs::rename(&part, &to).is_err() {
        let _ = std::fs::remove_dir_all(&part);
        bail!("{} could not be written", to.display());
    }
    for line in std::fs::read_to_string(to.join("SHA256SUMS")).context("reading digests")?.lines() {
        run::print(line);
    }
    run::tell_person(&format!(
        "in {}; next: tag the commit v{version}, sign SHA256SUMS, publish the folder",
        to.display()
    ));
    Ok(true)
}

/// The archives of the debug programs, twice: the same bytes, whole by their digests, and what is in them starts and is refused as a release, since
/// programs of tests have naive rules in them. Whether all of that holds.
pub fn test(workspace: &Workspace) -> Result<bool> {
    let (version, temporary) = (workspace.version()?, Temporary::new()?);
    let programs = temporary.path.join("programs");
    std::fs::create_dir_all(&programs).context("making a folder")?;
    for name in PROGRAMS {
        let to = programs.join(name);
        std::fs::copy(workspace.target.join("debug").join(name), &to).with_context(|| format!("copying {name}"))?;
        // Debug information is four fifths of it.
        run::quietly(Command::new("strip").arg("-g").arg(to));
    }
    let made = [1, 2].map(|n| temporary.path.join(format!("made-{n}")));
    for folder in &made {
        archives(workspace, &version, &programs, &temporary.path, folder)?;
        digests(folder)?;
    }
    let [first, second] = made.each_ref().map(|folder| std::fs::read_to_string(folder.join("SHA256SUMS")));
    let (first, second) = (first.context("digests")?, second.context("digests")?);
    ensure!(first == second, "the same programs give two archives:\n{first}{second}");
    ensure!(first.lines().count() == 2, "not the archives that a release has:\n{first}");
    let whole = run::succeeds(Command::new("sha256sum").args(["-c", "SHA256SUMS"]).current_dir(&made[0]))?;
    let archive = made[0].join(format!("{}.tar.gz", name_of(&version)));
    let refused = check_archive(&archive, &temporary.path, &version).err().map(|error| format!("{error:#}"));
    let names_them = |refused: &String| refused.contains(&format!("midshift {version} with seeded bugs"));
    ensure!(refused.as_ref().is_some_and(names_them), "programs of tests are not refused as such: {refused:?}");
    Ok(whole)
}

/// Refuses an archive whose programs do not start, are not of that version, or say anything beside it: what is for tests alone says so.
fn check_archive(archive: &Path, temporary: &Path, version: &str) -> Result<()> {
    let said = starts(archive, temporary)?;
    let wanted = PROGRAMS.map(|name| format!("{name} {version}"));
    ensure!(said == wanted, "programs of a release say their version and nothing else; these say {said:?}");
    Ok(())
}

/// What the programs of an archive say of their version. They start, and the first one finds what lies beside it.
fn starts(archive: &Path, temporary: &Path) -> Result<Vec<String>> {
    let folder = temporary.join("unpacked");
    std::fs::create_dir_all(&folder).context("making a folder")?;
    ensure!(run::succeeds(Command::new("tar").arg("-xzf").arg(archive).arg("-C").arg(&folder))?, "it does not unpack");
    let root =
        folder.join(archive.file_name().and_then(|name| name.to_str()?.strip_suffix(".tar.gz")).context("no archive")?);
    let mut all = Vec::new();
    for name in PROGRAMS {
        let said = run::output(Command::new(root.join("bin").join(name)).arg("--version"));
        all.push(said.with_context(|| format!("{name} does not say its version"))?.trim().to_owned());
    }
    let mut lint = Command::new(root.join("bin").join(PROGRAMS[0]));
    lint.args(["map", "lint", "sites/demo.site.toml"]).current_dir(&root);
    ensure!(run::succeeds(&mut lint)?, "it does not find what lies beside it");
    Ok(all)
}

fn archives(workspace: &Workspace, version: &str, programs: &Path, temporary: &Path, to: &Path) -> Result<()> {
    let name = name_of(version);
    let stage = temporary.join("stage");
    let root = stage.join(&name);
    if root.exists() {
        std::fs::remove_dir_all(&root).context("removing an earlier stage")?;
    }
    let copy = |from: &Path, at: PathBuf| -> Result<()> {
        std::fs::create_dir_all(at.parent().context("a folder")?)?;
        std::fs::copy(from, &at).with_context(|| format!("copying {}", from.display()))?;
        Ok(())
    };
    for program in PROGRAMS {
        copy(&programs.join(program), root.join("bin").join(program))?;
    }
    for file in git(workspace, &[&["ls-files", "-z"][..], &BESIDE].concat())?.split_terminator('\0') {
        copy(&workspace.root.join(file), root.join(file))?;
    }
    std::fs::create_dir_all(to).with_context(|| format!("making {}", to.display()))?;
    let moment = git(workspace, &["log", "-1", "--format=%ct"])?;
    let mut tar = Command::new("tar");
    tar.args(["--sort=name", "--owner=0", "--group=0", "--numeric-owner", "--mode=go=u,go-w", "-I", "gzip -n"]);
    tar.arg(format!("--mtime=@{}", moment.trim())).arg("-cf").arg(to.join(format!("{name}.tar.gz")));
    ensure!(run::succeeds(tar.arg("-C").arg(&stage).arg(&name))?, "tar failed");
    let source = format!("midshift-{version}-source");
    let archive = to.join(format!("{source}.tar.gz"));
    let mut git = workspace.command("git");
    git.args(["-c", "tar.tar.gz.command=gzip -n", "archive", "--format=tar.gz", &format!("--prefix={source}/"), "-o"]);
    ensure!(run::succeeds(git.arg(archive).arg("HEAD"))?, "git archive failed");
    Ok(())
}

/// Both images, started once, in one file each.
fn save(
    docker: &dyn Fn() -> Command,
    temporary: &Path,
    workspace: &Workspace,
    program: &Path,
    bases: images::Bases,
    version: &str,
    to: &Path,
) -> Result<()> {
    let [midshift, proxy] = ["midshift", "midshift-proxy"].map(|name| format!("{name}:{version}"));
    images::packed(docker, temporary, &workspace.root, program, bases, [&midshift, &proxy])?;
    let said = run::output(docker().args(["run", "--rm", "--network", "none", "--read-only", &midshift, "--version"]));
    let said =
        said.context("the image does not start: were its programs built for newer libraries than its base has?")?;
    let mut beside = docker();
    beside.args(["run", "--rm", "--network", "none", "--read-only", "--entrypoint", "/usr/local/bin/midshift-stop"]);
    let beside = run::output(beside.args([&midshift, "--version"])).context("its stop service does not start")?;
    let (said, wanted) =
        ([said.trim(), beside.trim()], [PROGRAMS[0], PROGRAMS[1]].map(|name| format!("{name} {version}")));
    ensure!(said == wanted, "an image of a release says its version and nothing else; this one says {said:?}");
    let mut check = docker();
    check.args(["run", "--rm", "--network", "none", "--entrypoint", "haproxy", &proxy, "-v"]);
    ensure!(run::succeeds(&mut check)?, "the image of the proxy does not start");
    for image in [&midshift, &proxy] {
        let file = to.join(format!("{}-image.tar", image.replace(':', "-")));
        ensure!(run::succeeds(docker().arg("save").arg("-o").arg(&file).arg(image))?, "docker save failed");
        ensure!(run::succeeds(Command::new("gzip").arg("-n").arg(&file))?, "gzip failed");
        // docker makes it for one user alone; the rest of a release is for everybody.
        let packed = file.with_extension("tar.gz");
        std::fs::set_permissions(&packed, Permissions::from_mode(0o644)).context("letting others read an image")?;
    }
    Ok(())
}

/// One file with the digest of each.
fn digests(folder: &Path) -> Result<()> {
    let mut names: Vec<String> = std::fs::read_dir(folder)
        .with_context(|| format!("reading {}", folder.display()))?
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect::<Result<_>>()?;
    names.sort();
    let said = run::output(Command::new("sha256sum").args(&names).current_dir(folder)).context("sha256sum")?;
    std::fs::write(folder.join("SHA256SUMS"), said).context("writing digests")
}

/// The name of an archive: `midshift-VERSION-ARCHITECTURE-SYSTEM`.
fn name_of(version: &str) -> String {
    format!("midshift-{version}-{}-{}", std::env::consts::ARCH, std::env::consts::OS)
}

/// Whether a changelog has the heading of a version, alone or with its date behind it.
fn is_told(notes: &str, version: &str) -> bool {
    let after = |line: &str| line.strip_prefix("## ").and_then(|line| line.strip_prefix(version)).map(str::to_owned);
    notes.lines().filter_map(after).any(|rest| rest.is_empty() || rest.starts_with(' '))
}

fn git(workspace: &Workspace, arguments: &[&str]) -> Result<String> {
    run::output(workspace.command("git").args(arguments)).with_context(|| format!("git {}", arguments.join(" ")))
}

/// A folder that goes when it is let go.
struct Temporary {
    path: PathBuf,
}

impl Temporary {
    fn new() -> Result<Self> {
        let path = std::env::temp_dir().join(format!("midshift-dist-{}", std::process::id()));
        std::fs::create_dir_all(&path).with_context(|| format!("making {}", path.display()))?;
        Ok(Self { path })
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::{PROGRAMS, Temporary, check_archive, is_told};
    use anyhow::{Context, Result, ensure};
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;
    use std::path::Path;
    use std::process::Command;

    #[test]
    fn a_release_needs_a_heading_of_its_own_version() {
        let notes = "# Changelog\n\n## Unreleased\n\n- 0.2.0\n\n## 0.1.0 (2026-11-22)\n";
        assert!(is_told(notes, "0.1.0") && is_told("## 0.2.0\n", "0.2.0"));
        assert!(!is_told(notes, "0.2.0") && !is_told(notes, "0.1") && !is_told("## 0.1.01", "0.1.0"));
    }

    /// Whether an archive would be released whose programs say this.
    fn judge(folder: &Path, said: [&str; 3]) -> Result<()> {
        let bin = folder.join("it/bin");
        std::fs::create_dir_all(&bin)?;
        for (name, said) in PROGRAMS.into_iter().zip(said) {
            std::fs::write(bin.join(name), format!("#!/bin/sh\necho '{said}'\n"))?;
            std::fs::set_permissions(bin.join(name), Permissions::from_mode(0o755))?;
        }
        let archive = folder.join("it.tar.gz");
        let packed = Command::new("tar").arg("-czf").arg(&archive).arg("-C").arg(folder).arg("it").status();
        ensure!(packed.context("tar")?.success(), "tar failed");
        check_archive(&archive, folder, "0.2.0")
    }

    #[test]
    fn an_archive_is_refused_whose_programs_say_more_or_less_than_their_version() {
        let temporary = Temporary::new().expect("a folder");
        let good = ["midshift 0.2.0", "midshift-stop 0.2.0", "midshift-launcher 0.2.0"];
        judge(&temporary.path.join("good"), good).expect("it is a release");
        let [midshift, stop, launcher] = good;
        let bad = [
            ["midshift 0.2.0 with seeded bugs, for tests only", stop, launcher],
            ["midshift 0.1.0", stop, launcher],
            [midshift, "midshift-stop 0.1.0", launcher],
            [midshift, stop, "midshift-launcher 0.2.0 with seeded bugs, for tests only"],
            [midshift, stop, ""],
        ];
        for (nth, said) in bad.into_iter().enumerate() {
            let refused = judge(&temporary.path.join(nth.to_string()), said).expect_err("it is no release").to_string();
            assert!(refused.contains(&format!("{said:?}")), "{refused}");
        }
    }
}
