//! The power goes at any moment of an update: the process that makes it is killed at each of its calls that change the disk.
//!
//! `strace` kills it as it enters the call. Without being asked a seeded sample of the calls is cut; `MIDSHIFT_SITES=all` cuts every one.

use crate::sets::{bytes, component, noise, patch, put, set, wanted};
use midshift_agent::launcher::SWITCH;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::{CHUNK_BYTES, Sets};
use midshift_agent::switch::Switch;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::ComponentKind;
use midshift_bundle::set::SetManifest;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, ExitStatus};

/// Names the folder to the process that is to be killed.
const UPDATE_IN: &str = "MIDSHIFT_TEST_UPDATE_IN";
/// Calls that change what is on a disk. One that opens a new file leaves the same as the next one that writes to it finds.
const CALLS: &str = "write,pwrite64,fsync,fdatasync,rename,renameat,renameat2,link,linkat,unlink,unlinkat,rmdir,mkdir,mkdirat,ftruncate,chmod,fchmodat";
/// The test that makes an update.
const UPDATE: &str = "an_update_ends_and_made_once_more_it_changes_nothing";
/// Cuts of a sample.
const SAMPLE: usize = 48;

/// Policy weights in every set; those of v2 come as a patch.
fn weights(version: u64) -> Vec<u8> {
    [noise(version, 1_000), noise(7, 400_000)].concat()
}

/// The operating system, another in every set.
fn base(version: u64) -> Vec<u8> {
    noise(70 + version, 3_000)
}

/// What is updated to: a program of three chunks, settings, weights and an operating system.
fn next() -> (SetManifest, [Vec<u8>; 4]) {
    let contents = [bytes(3, 2 * CHUNK_BYTES + 1_000), b"settings of v2".to_vec(), weights(2), base(2)];
    (set_with("v2", &contents), contents)
}

fn set_with(version: &str, [program, settings, weights, base]: &[Vec<u8>; 4]) -> SetManifest {
    let mut set = set(version, program, settings);
    for (name, kind, content) in [("grip", ComponentKind::Weights, weights), ("os", ComponentKind::Base, base)] {
        set.components.insert(name.to_owned(), component(name, kind, content));
    }
    set
}

/// A robot that runs v1 and keeps v0.
fn robot(folder: &Path) -> [SetManifest; 2] {
    let mut sets = DiskSets::open(folder).expect("opens");
    let mut switch = Switch::default();
    [(0, "v0"), (1, "v1")].map(|(number, version)| {
        let program = format!("program {version}").into_bytes();
        let contents = [program, b"settings".to_vec(), weights(number), base(number)];
        let set = set_with(version, &contents);
        for content in &contents {
            put(&mut sets, content);
        }
        sets.stage(&set).expect("stages");
        switch = sets.holdings().expect("tells").switch;
        switch.try_out(&set.id().to_string());
        switch.commit();
        sets.write_switch(&mut switch).expect("writes");
        set
    })
}

/// Fetches what is missing of a file.
fn fetch(sets: &mut DiskSets, content: &[u8]) {
    let wanted = wanted(content);
    for range in sets.missing(&wanted).expect("tells") {
        for from in range.clone().step_by(CHUNK_BYTES as usize) {
            let to = range.end.min(from + CHUNK_BYTES);
            sets.write(&wanted, from, &content[from as usize..to as usize]).expect("writes");
            sets.sync(&wanted).expect("syncs");
        }
    }
    sets.seal(&wanted).expect("seals");
}

/// The whole update, from wherever an earlier one was cut off.
fn update(folder: &Path) {
    let mut sets = DiskSets::open(folder).expect("opens");
    let (next, contents) = next();
    let name = next.id().to_string();
    let mut switch = sets.holdings().expect("tells").switch;
    if switch.running() != name {
        let [program, settings, grip, base] = &contents;
        for content in [program, settings, base] {
            fetch(&mut sets, content);
        }
        if !sets.missing(&wanted(grip)).expect("tells").is_empty() {
            let way = patch(&weights(1), grip);
            fetch(&mut sets, &way);
            sets.decode(&wanted(grip), Some(&Digest::of(&weights(1))), &wanted(&way)).expect("leads there");
        }
        sets.stage(&next).expect("stages");
        switch = sets.holdings().expect("tells").switch;
        switch.try_out(&name);
        sets.write_switch(&mut switch).expect("writes");
    }
    if switch.trial.as_ref().is_some_and(|trial| !trial.is_proven) {
        switch.prove();
        sets.write_switch(&mut switch).expect("writes");
    }
    if switch.trial.is_some() {
        switch.commit();
        sets.write_switch(&mut switch).expect("writes");
    }
    sets.collect(&BTreeSet::new()).expect("collects");
}

/// What runs and what is kept can be started, each on its own base.
fn assert_bootable(folder: &Path, when: &str) {
    let mut sets = DiskSets::open(folder).expect("opens");
    let switch = sets.holdings().unwrap_or_else(|e| panic!("{when}: {e}")).switch;
    for name in [Some(switch.running()), switch.kept()].into_iter().flatten() {
        let id: Digest = name.parse().unwrap_or_else(|e| panic!("{when}: {name}: {e:?}"));
        sets.verify(&id).unwrap_or_else(|e| panic!("{when}: {e}"));
    }
}

/// The update came to its end and left nothing behind.
fn assert_ended(folder: &Path, kept: &SetManifest, when: &str) {
    assert_bootable(folder, when);
    let holdings = DiskSets::open(folder).expect("opens").holdings().expect("tells");
    let (next, _) = next();
    let (current, previous) = (next.id().to_string(), kept.id().to_string());
    let switch = holdings.switch;
    let stands = (switch.current.as_str(), switch.previous.as_deref(), switch.trial.as_ref());
    assert_eq!(stands, (current.as_str(), Some(previous.as_str()), None), "{when}");
    let names = |folder: &Path| -> BTreeSet<String> {
        let entries = fs::read_dir(folder).expect("is there").map(|entry| entry.expect("an entry").file_name());
        entries.map(|name| name.to_string_lossy().into_owned()).collect()
    };
    let mut there: BTreeSet<String> = ["switch", "content", "boot", "base-a", "base-b"].map(str::to_owned).into();
    there.extend([current, previous]);
    assert_eq!(names(folder), there, "{when}");
    let components = next.components.values().chain(kept.components.values());
    assert_eq!(names(&folder.join("content")), components.map(|c| c.digest.to_string()).collect(), "{when}");
}

#[test]
fn an_update_ends_and_made_once_more_it_changes_nothing() {
    if let Some(folder) = std::env::var_os(UPDATE_IN) {
        // In the process that is to be killed.
        return update(Path::new(&folder));
    }
    let folder = tempfile::tempdir().expect("a folder");
    let [_, kept] = robot(folder.path());
    for _ in 0..2 {
        update(folder.path());
        assert_ended(folder.path(), &kept, "without a cut");
    }
}

/// Calls that change a folder, as one whole run made them.
struct Sites {
    /// The name of each, and the how manieth of that name it is.
    calls: Vec<(String, usize)>,
    /// What they touched, below the folder.
    paths: BTreeSet<String>,
}

/// One of these tests on a folder in a process of its own, under `strace` with these arguments; how it ended, and the trace.
fn traced(test: &str, folder: &Path, arguments: &[String]) -> (ExitStatus, String) {
    let log = tempfile::NamedTempFile::new().expect("a file");
    let strace = std::env::var_os("MIDSHIFT_TEST_STRACE").unwrap_or_else(|| OsString::from("strace"));
    let mut command = Command::new(&strace);
    command.args(["-f", "-qq", "-y", "-o"]).arg(log.path()).args(arguments);
    command.arg(std::env::current_exe().expect("this test")).args(["--exact", &format!("power::{test}")]);
    let output = command.env(UPDATE_IN, folder).output();
    let output = output.unwrap_or_else(|e| panic!("{}: {e}: run `cargo xtask test --install`", strace.display()));
    (output.status, fs::read_to_string(log.path()).expect("a trace"))
}

/// Runs it to its end and finds the calls that touch its folder.
fn sites(test: &str, folder: &Path) -> Sites {
    let (status, trace) = traced(test, folder, &["-e".to_owned(), format!("trace={CALLS}")]);
    assert!(status.success(), "{status}: {trace}");
    let folder = folder.to_string_lossy();
    let mut count: BTreeMap<&str, usize> = BTreeMap::new();
    let mut sites = Sites { calls: Vec::new(), paths: BTreeSet::new() };
    for line in trace.lines().filter(|line| line.contains(&*folder)) {
        // strace fills a thread's number up to five places: of a small one more than one space follows.
        let name =
            line.split_whitespace().nth(1).and_then(|call| call.split('(').next()).expect("a thread, then a call");
        let number = count.entry(name).or_default();
        *number += 1;
        sites.calls.push((name.to_owned(), *number));
        let below = line.match_indices(&*folder).map(|(at, _)| &line[at + folder.len()..]);
        sites.paths.extend(below.filter_map(|rest| rest.split(['>', '"']).next()).map(str::to_owned));
    }
    sites
}

/// Kills it as it enters a call.
fn killed_at(test: &str, folder: &Path, paths: &BTreeSet<String>, (name, number): &(String, usize)) {
    let whole = folder.to_string_lossy();
    let only = paths.iter().flat_map(|path| ["-P".to_owned(), format!("{whole}{path}")]);
    let inject = format!("inject={name}:signal=SIGKILL:when={number}");
    let arguments: Vec<String> =
        only.chain(["-e".to_owned(), format!("trace={name}"), "-e".to_owned(), inject]).collect();
    let (status, trace) = traced(test, folder, &arguments);
    let last = trace.lines().rev().find(|line| line.contains('('));
    let is_there = last.is_some_and(|call| call.contains(&*whole) && call.ends_with("= ?"));
    assert!(is_there && status.signal() == Some(9), "not killed at {name} {number}: {status}: {trace}");
}

#[test]
fn wherever_the_power_goes_a_whole_set_can_be_started_and_the_update_ends() {
    let seed = std::env::var("MIDSHIFT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
    let all = std::env::var("MIDSHIFT_SITES").is_ok_and(|sites| sites == "all");
    let folder = tempfile::tempdir().expect("a folder");
    let [_, kept] = robot(folder.path());
    let Sites { calls: mut cuts, paths } = sites(UPDATE, folder.path());
    assert_ended(folder.path(), &kept, "under strace");
    let found = cuts.len();
    assert!(found > SAMPLE, "{found} calls change the disk: {cuts:?}");
    if !all {
        cuts.shuffle(&mut StdRng::seed_from_u64(seed));
        cuts.truncate(SAMPLE);
    }
    let mut unfinished = 0;
    for site in &cuts {
        let when = format!("killed at {site:?}, MIDSHIFT_SEED={seed}");
        let folder = tempfile::tempdir().expect("a folder");
        let [_, kept] = robot(folder.path());
        killed_at(UPDATE, folder.path(), &paths, site);
        assert_bootable(folder.path(), &when);
        let switch = DiskSets::open(folder.path()).expect("opens").holdings().expect("tells").switch;
        unfinished += usize::from(switch.current == kept.id().to_string());
        update(folder.path());
        assert_ended(folder.path(), &kept, &when);
    }
    assert!(unfinished > 0, "no cut came before the commit");
    println!(
        "{found} calls of an update change the disk; {} of them were cut, {unfinished} before its commit; MIDSHIFT_SEED={seed}",
        cuts.len()
    );
}

#[test]
fn twin_a_switch_record_that_is_written_where_it_lies_is_lost_with_the_power() {
    if let Some(folder) = std::env::var_os(UPDATE_IN) {
        let path = Path::new(&folder).join(SWITCH);
        let text = fs::read_to_string(&path).expect("is there");
        return fs::write(&path, text.replace("number 2", "number 3")).expect("writes");
    }
    let twin = "twin_a_switch_record_that_is_written_where_it_lies_is_lost_with_the_power";
    let folder = tempfile::tempdir().expect("a folder");
    robot(folder.path());
    let Sites { calls, paths } = sites(twin, folder.path());
    let [write] = &calls[..] else { panic!("{calls:?}") };
    assert_bootable(folder.path(), "without a cut");
    killed_at(twin, folder.path(), &paths, write);
    assert!(DiskSets::open(folder.path()).expect("opens").holdings().is_err(), "the naive way is good enough");
}
