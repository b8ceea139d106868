//! A disk without room when the launcher puts a set away: a set that is whole is started all the same, and its agent
//! knows which.

use crate::sets::{put_content, set};
use midshift_agent::launcher::{PROGRAM, SWITCH};
use midshift_agent::sets::Sets;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::start_policy::TRIES_MAX;
use midshift_agent::switch::{FACTORY, FailedTrial, Switch};
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs;
use std::path::Path;
use std::process::Command;

/// A robot with a set on trial whose program cannot live; its name.
fn on_trial(folder: &Path) -> String {
    let mut sets = DiskSets::open(folder).expect("opens");
    let (program, settings) = (b"#!/bin/sh\nexit 1\n", b"settings");
    let set = set("v1", program, settings);
    put_content(&mut sets, program);
    put_content(&mut sets, settings);
    sets.stage(&set).expect("stages");
    let mut switch = sets.holdings().expect("tells").switch;
    switch.try_out(&set.id().to_string());
    sets.write_switch(&mut switch).expect("writes");
    assert!(folder.join(set.id().to_string()).join(PROGRAM).exists());
    set.id().to_string()
}

#[test]
fn on_a_full_disk_the_launcher_starts_the_kept_set_and_says_what_it_could_not_write() {
    let folder = tempfile::tempdir().expect("a folder");
    let (sets, tries, ran) = (folder.path().join("sets"), folder.path().join("tries"), folder.path().join("ran"));
    let name = on_trial(&sets);
    let before = fs::read_to_string(sets.join(SWITCH)).expect("is there");
    let trace = folder.path().join("trace");
    let strace = std::env::var_os("MIDSHIFT_TEST_STRACE").unwrap_or_else(|| OsString::from("strace"));
    // No byte more goes into what the launcher writes.
    let mut command = Command::new(&strace);
    command.args(["-qq", "-o"]).arg(&trace).args(["-e", "trace=write", "-e", "inject=write:error=ENOSPC"]);
    for full in [sets.join(SWITCH), tries.clone()] {
        command.arg("-P").arg(full.with_extension("new"));
    }
    command.arg(env!("CARGO_BIN_EXE_midshift-launcher")).arg("--record").arg(&tries).arg("--sets").arg(&sets);
    command.args(["--", "sh", "-c", "echo $MIDSHIFT_SET > $0"]).arg(&ran);
    let output = command.output().unwrap_or_else(|e| panic!("{}: {e}", strace.display()));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}: {said}", output.status);
    assert_eq!(fs::read_to_string(&ran).expect("it was started"), format!("{FACTORY}\n"));
    let full =
        fs::read_to_string(&trace).expect("a trace").matches("ENOSPC (No space left on device) (INJECTED)").count();
    assert_eq!(full, 6, "two tries of {name}, the switch record twice, the start of the kept set and its end: {said}");
    assert!(said.contains(&format!("set {name} did not live in {TRIES_MAX} tries; back to {FACTORY}")), "{said}");
    let why = format!("{} cannot be written: No space left on device", sets.join(SWITCH).display());
    assert!(said.contains(&why), "{said}");
    assert_eq!(fs::read_to_string(sets.join(SWITCH)).expect("is there"), before, "whole as it was");
}

#[test]
fn an_agent_that_was_started_from_the_kept_set_takes_the_trial_for_put_away_and_writes_so_with_what_it_writes_next() {
    let folder = tempfile::tempdir().expect("a folder");
    let name = on_trial(folder.path());
    let mut sets = DiskSets::open(folder.path()).expect("opens");
    sets.started_from(&name).expect("tells");
    assert_eq!(sets.holdings().expect("tells").switch.running(), name, "nothing was put away");
    sets.started_from(FACTORY).expect("tells");
    let mut switch = sets.holdings().expect("tells").switch;
    let fallen = Some(FailedTrial { set: name.clone(), tries: TRIES_MAX });
    assert_eq!((switch.running(), &switch.fallen), (FACTORY, &fallen));
    sets.collect(&BTreeSet::new()).expect("collects");
    assert!(folder.path().join(&name).exists(), "the record on the disk names it still");
    sets.write_switch(&mut switch).expect("writes");
    let written = Switch::read(&folder.path().join(SWITCH)).expect("reads");
    assert_eq!((written.number, written.running(), &written.fallen), (2, FACTORY, &fallen));
    // Another trial is another matter.
    switch.try_out(&name);
    sets.write_switch(&mut switch).expect("writes");
    assert_eq!(sets.holdings().expect("tells").switch.running(), name);
}
