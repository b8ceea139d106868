//! `cargo xtask fixtures record`: what a run of this version leaves, for the tests of later versions.
//!
//! Invariant: the folder of a version is written once. What a release left is a fact, and a test that fails on it is not
//! mended by writing it anew.

use crate::e2e::{self, RoundOptions};
use crate::fetch_tools::Tools;
use crate::programs::{self, Choice};
use crate::round::{Count, Round, Scope};
use crate::workspace::Workspace;
use crate::{buf, parts, run};
use anyhow::{Context, Result, ensure};
use clap::Subcommand;
use std::path::{Path, PathBuf};

/// What tests read that write something down: the folder.
const RECORD: &str = "MIDSHIFT_RECORD";
/// Names in what is kept as text.
const KEYS: &str = "stored_keys.txt";

/// What can be done with them.
#[derive(Clone, Copy, Debug, Subcommand)]
pub enum Verb {
    /// Write what a run of this version leaves into tests/fixtures/VERSION, which must not be there. About two minutes beside the build.
    Record,
}

/// Does it; whether it succeeded.
pub fn run(workspace: &Workspace, verb: Verb) -> Result<bool> {
    match verb {
        Verb::Record => record(workspace, env!("CARGO_PKG_VERSION")),
    }
}

fn record(workspace: &Workspace, version: &str) -> Result<bool> {
    let (to, part) = places(&workspace.root.join(buf::RELEASES), version)?;
    let tools = Tools::find(workspace)?;
    ensure!(parts::build(workspace)?, "the programs do not build");
    let variable = (RECORD, part.to_str().context("the folder's name is text")?);
    let (mut round, mut count) = (Round::new(workspace, Scope::Daily, &[]), Count::default());
    round.tools = Some(tools);
    let only = Some(vec!["released::recorded::a_run_on_"]);
    let run = e2e::play(&round, &RoundOptions { only, variable: Some(variable), is_loaded: false }, &mut count)?;
    ensure!(run, "the run failed");
    let simulation = programs::named(round.programs()?, "simulation")?;
    let shift = Choice { filter: Some("frames::a_shift_says_"), variable: Some(variable) };
    ensure!(round.play(&[simulation], shift, &mut count)?, "the shift failed");
    std::fs::copy(workspace.root.join("tests/golden").join(KEYS), part.join(KEYS)).context("copying the names")?;
    let Some(tools) = &round.tools else { return Ok(false) };
    ensure!(buf::describe(workspace, tools, &part)?, "the descriptors were not written");
    std::fs::rename(&part, &to).with_context(|| format!("naming {}", to.display()))?;
    run::tell_person(&format!("next: look at {}, and commit it with the release", to.display()));
    Ok(true)
}

/// Where it will be, and where it is made.
fn places(fixtures: &Path, version: &str) -> Result<(PathBuf, PathBuf)> {
    let to = fixtures.join(version);
    ensure!(
        !to.exists(),
        "{} is there: what {version} left is a fact, and is not written anew; next: raise the version in Cargo.toml",
        to.display()
    );
    // Tests pass over names that begin with a dot.
    let part = fixtures.join(format!(".{version}.part"));
    if part.exists() {
        std::fs::remove_dir_all(&part).with_context(|| format!("taking {} away", part.display()))?;
    }
    std::fs::create_dir_all(&part).with_context(|| format!("making {}", part.display()))?;
    Ok((to, part))
}

#[cfg(test)]
mod tests {
    use super::places;
    use std::fs;

    #[test]
    fn a_version_that_was_recorded_is_not_recorded_again() {
        let dir = tempfile::tempdir().expect("a folder");
        let (to, part) = places(dir.path(), "0.1.0").expect("nothing is there");
        fs::write(part.join("half"), "").expect("written");
        let (_, part) = places(dir.path(), "0.1.0").expect("what was cut off is begun again");
        assert!(!part.join("half").exists());
        fs::rename(part, &to).expect("named");
        let refused = places(dir.path(), "0.1.0").expect_err("refused").to_string();
        assert!(refused.contains("0.1.0 is there"), "{refused}");
        assert!(places(dir.path(), "0.2.0").is_ok());
    }
}
