//! Test programs: found among what cargo builds, and run without it.
//!
//! Invariant: they are built with all tests of the workspace, as the suite builds them: of one alone the crates below have other features, and
//! are compiled once more.

use crate::workspace::Workspace;
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Programs that take long, the longest first.
const LONG: [&str; 5] = ["simulation", "agent", "smoke", "model", "edge"];

/// A built test program.
#[derive(Debug, PartialEq, Eq)]
pub struct TestProgram {
    /// Name of its target.
    pub name: String,
    /// Its tests are inside a crate.
    pub is_inside: bool,
    path: PathBuf,
    /// The folder of its package, where cargo would run it.
    folder: PathBuf,
}

/// Which tests of programs run, and how.
#[derive(Clone, Copy, Default)]
pub struct Choice<'c> {
    /// Those with this in their name; none: all.
    pub filter: Option<&'c str>,
    /// A variable of their environment.
    pub variable: Option<(&'c str, &'c str)>,
}

impl TestProgram {
    /// Builds all of the workspace; gives them back by name.
    pub fn build_all(workspace: &Workspace) -> Result<Vec<Self>> {
        let how = ["test", "--workspace", "--tests", "--no-run", "--message-format", "json-render-diagnostics"];
        let output = workspace.cargo(&how).stderr(Stdio::inherit()).output().context("running cargo")?;
        ensure!(output.status.success(), "the tests do not build");
        let lines = String::from_utf8_lossy(&output.stdout).into_owned();
        let mut programs: Vec<Self> = lines.lines().filter_map(Self::read).collect();
        ensure!(!programs.is_empty(), "cargo names no test program");
        programs.sort_by(|a, b| (&a.name, &a.path).cmp(&(&b.name, &b.path)));
        Ok(programs)
    }

    /// A line of cargo's, if it tells of one.
    fn read(line: &str) -> Option<Self> {
        let told: serde_json::Value = serde_json::from_str(line).ok()?;
        let path = told["executable"].as_str().filter(|_| told["profile"]["test"] == true)?;
        Some(Self {
            name: told["target"]["name"].as_str()?.to_owned(),
            is_inside: told["target"]["kind"][0] != "test",
            path: path.into(),
            folder: Path::new(told["manifest_path"].as_str()?).parent()?.to_owned(),
        })
    }

    /// Runs it where cargo would.
    pub fn command(&self, workspace: &Workspace) -> Command {
        let mut command = workspace.command(&self.path);
        command.current_dir(&self.folder).env("CARGO_MANIFEST_DIR", &self.folder);
        command
    }

    /// The program that runs.
    #[cfg(test)]
    pub fn this() -> Self {
        let path = std::env::current_exe().expect("it runs");
        Self { name: "xtask".to_owned(), is_inside: true, path, folder: env!("CARGO_MANIFEST_DIR").into() }
    }

    /// How a person tells it from others: its folder and its name.
    pub fn label(&self) -> String {
        let folder = self.folder.file_name().unwrap_or_default().to_string_lossy();
        format!("{folder} {}{}", self.name, if self.is_inside { ", inside" } else { "" })
    }

    /// Its place among those that wait.
    pub fn rank(&self) -> usize {
        LONG.iter().position(|name| self.name == *name && !self.is_inside).unwrap_or(LONG.len())
    }
}

/// The integration tests of this name.
pub fn named<'p>(programs: &'p [TestProgram], name: &str) -> Result<&'p TestProgram> {
    let is_it = |program: &&TestProgram| program.name == name && !program.is_inside;
    programs.iter().find(is_it).with_context(|| format!("cargo built no tests of the name {name}"))
}

#[cfg(test)]
mod tests {
    use super::TestProgram;

    #[test]
    fn a_test_program_is_what_cargo_built_as_one() {
        let line = |kind: &str, name: &str, is_test: bool, executable: &str| {
            format!(
                r#"{{"reason":"compiler-artifact","manifest_path":"/repo/core/Cargo.toml","target":{{"kind":["{kind}"],"name":"{name}"}},"profile":{{"test":{is_test}}},"executable":{executable}}}"#
            )
        };
        let of = |line: &str| TestProgram::read(line).map(|program| (program.name, program.is_inside));
        assert_eq!(of(&line("lib", "midshift_core", true, "\"/t/a\"")), Some(("midshift_core".into(), true)));
        assert_eq!(of(&line("test", "wire", true, "\"/t/b\"")), Some(("wire".into(), false)));
        assert_eq!(of(&line("bin", "midshift", false, "\"/t/c\"")), None, "a program for use");
        assert_eq!(of(&line("lib", "midshift_core", true, "null")), None, "a library");
        assert_eq!(of("Compiling midshift-core"), None);
        let program = TestProgram::read(&line("test", "wire", true, "\"/t/b\"")).expect("one");
        assert_eq!(program.folder.to_str(), Some("/repo/core"));
    }

    #[test]
    fn long_programs_are_started_first() {
        let rank = |name: &str, is_inside| {
            TestProgram { name: name.into(), is_inside, path: "".into(), folder: "".into() }.rank()
        };
        assert!(rank("simulation", false) < rank("edge", false) && rank("edge", false) < rank("wire", false));
        assert_eq!(rank("edge", true), rank("wire", false));
    }
}
