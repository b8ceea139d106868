//! The machine of a robot on the bench: a folder of sets, the real launcher that starts one of them, and what may be
//! wrong at a start.
//!
//! Invariant: a start fails unless what it starts, and what is kept beside that, is whole and of signed bundles.

use crate::crowded::CrowdedSets;
use crate::release::Bundle;
use midshift_agent::boot::{BASE, BOOT, Boot};
use midshift_agent::launcher::SWITCH;
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::switch::{FACTORY, Switch};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::Component;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::Command;
use tempfile::TempDir;

const LAUNCHER: &str = env!("CARGO_BIN_EXE_midshift-launcher");
/// Launchers that the power may take with them before one stays: more than a set on trial has tries.
const LAUNCHES_MAX: u32 = 6;
/// Number of SIGKILL.
const KILL: i32 = 9;
/// The program of every set. One that dies (`$1`) ends, or takes the power with it. Another says which set it is of; if
/// there is a second launcher (`$3`), it says how that one ended.
const PROGRAM: &str = r#"
if [ "$MIDSHIFT_SET" = "$1" ]; then
    [ "$2" = power ] && kill -9 $PPID
    exit 1
fi
echo "$MIDSHIFT_SET"
[ -z "$3" ] || { "$3" --record "$4.second" --sets "$5" -- echo twice 2>/dev/null; echo "second $?"; }
exit 0
"#;

/// What outlives an agent, and what is wrong with it at its next start.
pub struct Machine {
    home: TempDir,
    /// The set that was started last.
    pub started: String,
    /// A set whose program never lives.
    pub dying: Option<String>,
    /// The disk has no room: no launcher writes a record.
    pub is_full: bool,
    /// Somebody starts a second launcher while the first one runs.
    pub is_doubled: bool,
    /// A set on trial was put away by a launcher.
    pub put_away: bool,
    /// Launchers that the power took at a start.
    pub killed: u64,
}

impl Machine {
    /// One that was never started. It lies in memory where that can be had: nothing here depends on what a disk loses
    /// with the power.
    pub fn new() -> Self {
        Self {
            home: tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a folder"),
            started: FACTORY.to_owned(),
            dying: None,
            is_full: false,
            is_doubled: false,
            put_away: false,
            killed: 0,
        }
    }
    /// The folder of its sets.
    pub fn sets(&self) -> PathBuf {
        self.home.path().join("sets")
    }
    fn tries(&self) -> PathBuf {
        self.home.path().join("tries")
    }
    /// The switch record on its disk.
    pub fn record(&self) -> Switch {
        Switch::read(&self.sets().join(SWITCH)).expect("reads")
    }

    /// The launcher starts a set; the sets as its agent opens them.
    pub fn start(&mut self, bundles: &[Bundle]) -> CrowdedSets {
        let before = self.record();
        // A folder where the new text of a record would be put: it cannot be written, whoever asks.
        let records = [self.sets().join(SWITCH), self.sets().join(BOOT), self.tries()];
        let in_the_way = records.map(|record| record.with_extension("new"));
        if self.is_full {
            in_the_way.iter().for_each(|folder| fs::create_dir(folder).expect("makes"));
        }
        let said = self.launch();
        if self.is_full {
            in_the_way.iter().for_each(|folder| fs::remove_dir(folder).expect("removes"));
        }
        let after = self.record();
        let refused: &[&str] = if self.is_doubled { &["second 1"] } else { &[] };
        let (started, rest) = said.split_first().expect("says which set it is of");
        assert_eq!(rest, refused, "one launcher a robot");
        if self.is_full {
            let may_run = [before.running(), before.current.as_str()];
            assert!(may_run.contains(&started.as_str()), "{started} was started: {before:?}");
        } else {
            assert_eq!(started, after.running(), "{before:?} became {after:?}");
        }
        self.put_away |= before.trial.is_some() && started != before.running();
        for set in [Some(started.as_str()), after.kept()].into_iter().flatten().filter(|set| *set != FACTORY) {
            self.judge(set, bundles).unwrap_or_else(|problem| panic!("{problem}; {before:?} became {after:?}"));
        }
        (self.started, self.is_doubled) = (started.clone(), false);
        CrowdedSets::open(&self.sets(), &self.started, self.is_full)
    }

    /// What the launcher passed on of the program that lived.
    fn launch(&mut self) -> Vec<String> {
        let (record, sets) = (self.tries(), self.sets());
        for _ in 0..LAUNCHES_MAX {
            let mut launcher = Command::new(LAUNCHER);
            launcher.arg("--record").arg(&record).arg("--sets").arg(&sets);
            launcher.args(["--", "sh", "-c", PROGRAM, "sh", self.dying.as_deref().unwrap_or_default()]);
            // Without room no try is written down: a launcher that lives has to count them.
            launcher.arg(if self.is_full { "ends" } else { "power" });
            launcher.arg(if self.is_doubled { LAUNCHER } else { "" }).arg(&record).arg(&sets);
            let output = launcher.output().expect("the launcher");
            if output.status.signal() == Some(KILL) {
                self.killed += 1;
                continue;
            }
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{}: {said}", output.status);
            return String::from_utf8_lossy(&output.stdout).lines().map(str::to_owned).collect();
        }
        panic!("{:?} was still tried after {LAUNCHES_MAX} starts", self.dying);
    }

    /// Whether a set is whole on the disk and is what these bundles brought.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn judge(&self, set: &str, bundles: &[Bundle]) -> Result<(), String> {
        let id: Digest = set.parse().map_err(|_| format!("{set} is no set"))?;
        let mut sets = DiskSets::open(&self.sets()).map_err(|e| e.to_string())?;
        sets.verify(&id).map_err(|e| format!("{set} is not whole: {e}"))?;
        let holdings = sets.holdings().map_err(|e| e.to_string())?;
        let there = holdings.sets.get(&id).ok_or_else(|| format!("{set} is not there"))?;
        let bundle = bundles.iter().find(|bundle| there.bundle == Some(bundle.digest));
        let bundle = bundle.ok_or_else(|| format!("nobody signed the bundle of {set}"))?;
        let has_all = bundle.manifest.components.iter().all(|c| there.components.get(&c.name) == Some(c));
        let is_signed = |c: &Component| bundles.iter().any(|bundle| bundle.manifest.components.contains(c));
        if has_all && there.components.values().all(is_signed) {
            Ok(())
        } else {
            Err(format!("{set} is not what was signed: {there:?}"))
        }
    }

    /// Whether the machine runs on the base of the set that was started last.
    pub fn is_on_its_base(&self) -> bool {
        let named = fs::read_to_string(self.sets().join(&self.started).join(BASE));
        let base = named.map_or(FACTORY.to_owned(), |name| name.trim().to_owned());
        let boot = Boot::read(&self.sets().join(BOOT)).expect("reads");
        boot.slot_of(&base) == Some(boot.booted)
    }
}
