//! The program of the stop service: where it is, and whether it is of the same version as this one.
//!
//! Invariant: no server starts beside a program of another version. A stop service that is gone is started again
//! whichever version lies there now: somebody is just replacing both, and any is better than none.

use anyhow::{Context, anyhow, bail};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// Its name.
const NAME: &str = "midshift-stop";
/// What both are told to say of themselves.
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// It says its version within this.
const SAYS_WITHIN: Duration = Duration::from_secs(10);

/// The program of the stop service, beside this one: where this was named when it was started, or where it lies.
///
/// # Errors
/// There is none; it says what to do.
pub fn find() -> anyhow::Result<PathBuf> {
    let named = midshift_os::program().context("finding this program")?;
    let lies = std::env::current_exe().context("finding this program")?;
    beside(&[&named, &lies])
}

fn beside(programs: &[&Path]) -> anyhow::Result<PathBuf> {
    let mut found = programs.iter().map(|program| program.with_file_name(NAME));
    let first = found.next().context("this program lies nowhere")?;
    if first.is_file() {
        return Ok(first);
    }
    found.find(|program| program.is_file()).ok_or_else(|| {
        anyhow!(
            "there is no {}, the program of the stop service, which belongs beside midshift\n  \
             try: put the {NAME} of midshift {VERSION} there (from source: `cargo build --release` makes both), or --no-stop \
             if the stop service runs elsewhere",
            first.display()
        )
    })
}

/// Refuses to begin beside a program that is missing or of another version.
///
/// # Errors
/// It is missing, of another version, or does not say of which; it says what to do.
pub async fn check_program() -> anyhow::Result<()> {
    check_version(&find()?).await
}

/// Refuses a program of another version.
///
/// # Errors
/// It is of another version, or does not say of which; it says what to do.
pub async fn check_version(program: &Path) -> anyhow::Result<()> {
    let asked = tokio::process::Command::new(program).arg("--version").kill_on_drop(true).output();
    let said = tokio::time::timeout(SAYS_WITHIN, asked).await.map_err(|_| anyhow!("it does not answer"));
    let said = said.and_then(|said| Ok(said?)).with_context(|| format!("asking {} its version", program.display()))?;
    is_same(&String::from_utf8_lossy(&said.stdout), program)
}

/// `said` is NAME VERSION; a program that was built for tests says more.
fn is_same(said: &str, program: &Path) -> anyhow::Result<()> {
    let mut words = said.split_whitespace();
    if words.next() == Some(NAME) && words.next() == Some(VERSION) {
        return Ok(());
    }
    bail!(
        "{} is of another version: it says {:?}, and this is midshift {VERSION}\n  \
         try: put both programs of one release there (from source: `cargo build --release` makes both), or --no-stop if \
         the stop service runs elsewhere",
        program.display(),
        said.trim()
    )
}

/// Becomes the stop service, in the same process. Comes back only with why that was not possible.
pub fn replace_this(arguments: &[String]) -> anyhow::Error {
    match find() {
        Ok(program) => {
            let error = Command::new(&program).args(arguments).exec();
            anyhow::Error::from(error).context(format!("starting {}", program.display()))
        }
        Err(error) => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_lies_beside_the_name_of_this_program_or_beside_its_file_and_one_that_is_missing_is_told_with_what_to_do() {
        let dir = tempfile::tempdir().expect("a folder");
        let [named, lies] = ["named", "lies"].map(|name| dir.path().join(name));
        [&named, &lies].into_iter().for_each(|folder| std::fs::create_dir(folder).expect("made"));
        let [linked, real] = [named.join("midshift"), lies.join("midshift")];
        let missing = beside(&[&linked, &real]).expect_err("there is none").to_string();
        assert!(missing.contains(&format!("there is no {}", named.join(NAME).display())), "{missing}");
        assert!(missing.contains("cargo build") && missing.contains("--no-stop"), "{missing}");
        for folder in [&lies, &named] {
            std::fs::write(folder.join(NAME), "").expect("written");
            assert_eq!(beside(&[&linked, &real]).expect("found"), folder.join(NAME));
        }
    }

    #[test]
    fn one_of_another_version_is_refused_by_both_versions_and_with_what_to_do() {
        let program = Path::new("/opt/midshift-stop");
        for said in ["", " with seeded bugs, for tests only"] {
            is_same(&format!("{NAME} {VERSION}{said}\n"), program).expect("the same");
        }
        for said in ["midshift-stop 0.0.1", &format!("another {VERSION}"), NAME, ""] {
            let refused = is_same(said, program).expect_err("another one").to_string();
            assert!(refused.contains(&format!("{said:?}")) && refused.contains(VERSION), "{refused}");
            assert!(refused.contains("try: put both programs of one release there"), "{refused}");
        }
    }

    #[tokio::test]
    async fn a_program_is_asked_and_one_that_cannot_be_is_named() {
        assert!(
            check_version(Path::new("/bin/true")).await.is_err_and(|error| error.to_string().contains("/bin/true"))
        );
        let nobody = check_version(Path::new("/nobody/midshift-stop")).await.expect_err("it is not there");
        assert!(nobody.to_string().contains("/nobody/midshift-stop"), "{nobody:#}");
    }
}
