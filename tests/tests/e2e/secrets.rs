//! What nobody may be told: every secret that the tests of this program know of is looked for in each log when its program ends, and in all that a command prints
//! that is not there to print one.

use anyhow::{Context, ensure};
use midshift_core::identity::Secret;
use midshift_tests::postgres::PASSWORD;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::{Mutex, PoisonError};

/// Names of secrets that this run uses.
static SECRETS: Mutex<BTreeMap<String, &'static str>> = Mutex::new(BTreeMap::new());
/// Names of what people may read, and what must be in no log.
static WORDS: Mutex<BTreeMap<String, &'static str>> = Mutex::new(BTreeMap::new());
/// Commands that print a secret, which is their purpose.
const PRINTS: [[&str; 2]; 3] = [["token", "create"], ["robot", "enroll"], ["robot", "replace"]];

type Known = Mutex<BTreeMap<String, &'static str>>;

fn remember(known: &Known, what: &'static str, text: &str) {
    known.lock().unwrap_or_else(PoisonError::into_inner).insert(text.to_owned(), what);
}

fn told(known: &Known, text: &str) -> Vec<&'static str> {
    let known = known.lock().unwrap_or_else(PoisonError::into_inner);
    known.iter().filter(|(secret, _)| text.contains(secret.as_str())).map(|(_, what)| *what).collect()
}

/// From now on no program may have written `secret` into its log when it ends, and no command may print it.
pub fn keep_secret(what: &'static str, secret: &str) {
    remember(&SECRETS, what, secret);
}

/// From now on no program may have written these words of a person into its log when it ends.
pub fn keep_from_logs(what: &'static str, words: &str) {
    remember(&WORDS, what, words);
}

/// What of a token or an enrolment nobody may know: its third part.
pub fn secret_part(line: &str) -> anyhow::Result<&str> {
    line.split('.').nth(2).filter(|secret| secret.len() >= 32).with_context(|| format!("no secret in {line}"))
}

/// What of a private key nobody may know: its first line.
pub fn keep_key(what: &'static str, pem: &str) -> anyhow::Result<()> {
    let key = pem.lines().skip_while(|line| !line.contains("PRIVATE KEY-----")).nth(1);
    keep_secret(what, key.filter(|line| line.len() >= 48).context("a private key in PEM")?);
    Ok(())
}

/// Keeps every private key in a file of this folder, of servers and of the people of releases. There is one at least.
pub fn keep_keys(folder: &Path) -> anyhow::Result<()> {
    let (mut folders, mut keys) = (vec![folder.to_owned()], 0);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|kind| kind == "pem" || kind == "key") {
                let text = std::fs::read_to_string(&path)?;
                if text.contains("PRIVATE KEY-----") {
                    keep_key("a private key", &text)?;
                    keys += 1;
                }
            }
        }
    }
    ensure!(keys > 0, "no private key in {}", folder.display());
    Ok(())
}

/// The secrets and the words that are in a log, whatever else is in it.
pub fn told_by_log(log: &[u8]) -> Vec<&'static str> {
    let log = String::from_utf8_lossy(log);
    let password = log.contains(PASSWORD).then_some("the database's password");
    told(&SECRETS, &log).into_iter().chain(told(&WORDS, &log)).chain(password).collect()
}

/// Runs a command to its end. It may print no secret, but for one that is there for that: what that prints is a secret from then on.
pub fn heard(command: &mut Command) -> anyhow::Result<Output> {
    let output = command.output().with_context(|| format!("running {command:?}"))?;
    let arguments: Vec<_> = command.get_args().collect();
    let may =
        arguments.windows(2).any(|pair| PRINTS.iter().any(|[first, second]| pair[0] == *first && pair[1] == *second));
    for printed in [&output.stdout, &output.stderr] {
        let text = String::from_utf8_lossy(printed);
        if may {
            let is_secret = |word: &&str| {
                [Secret::TOKEN, Secret::ENROLMENT].iter().any(|kind| word.starts_with(&format!("{kind}.")))
            };
            let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || "._-".contains(c)));
            words
                .filter(is_secret)
                .filter_map(|word| secret_part(word).ok())
                .for_each(|word| keep_secret("a printed secret", word));
        } else {
            let told = told(&SECRETS, &text);
            ensure!(told.is_empty(), "{arguments:?} prints {told:?}");
        }
    }
    Ok(output)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::harness::{Running, folder, until};
    use std::time::Duration;

    async fn said(text: &str, then: impl FnOnce(&Path)) {
        let dir = folder().expect("a folder");
        let log = dir.path().join("log");
        let mut command = Command::new("sh");
        let running = Running::start(command.args(["-c", &format!("printf '{text}\\n'; exec sleep 60")]), &log);
        let written = async || Ok(std::fs::read(&log).ok().filter(|text| text.ends_with(b"\n")));
        until("its log", Duration::from_secs(30), written).await.expect("a line");
        then(&log);
        drop(running);
    }

    #[tokio::test]
    #[should_panic(expected = "tells [\"a word\"]")]
    async fn a_program_that_writes_a_secret_into_its_log_fails_its_test() {
        keep_secret("a word", "xyzzy-only-here");
        said("xyzzy-only-here", |_| {}).await;
    }

    #[tokio::test]
    #[should_panic(expected = "tells [\"a word beside bytes\"]")]
    async fn a_secret_beside_bytes_that_are_no_text_is_found_too() {
        keep_secret("a word beside bytes", "plugh-only-here");
        said("\\377\\376 plugh-only-here", |_| {}).await;
    }

    #[tokio::test]
    #[should_panic(expected = "is not there")]
    async fn a_program_whose_log_is_gone_fails_its_test() {
        said("nothing", |log| std::fs::remove_file(log).expect("it was there")).await;
    }

    #[test]
    fn a_command_that_prints_a_secret_fails_unless_it_is_there_for_that() {
        keep_secret("a printed word", "frotz-only-here");
        let told = heard(Command::new("echo").arg("frotz-only-here")).expect_err("it tells");
        assert!(told.to_string().contains("a printed word"), "{told:#}");
        let secret = "0123456789abcdef0123456789abcdef";
        let token = format!("{}.t1.{secret}", Secret::TOKEN);
        heard(Command::new("echo").args(["token", "create", &token])).expect("it may");
        assert!(heard(Command::new("echo").arg(secret)).is_err(), "what was printed is a secret from then on");
    }
}
