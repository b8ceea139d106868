//! The power goes at any moment of an update, or of the way back from one: the process that makes it is killed at each
//! of its calls that change the disk, and the launcher starts what is left.
//!
//! `strace` kills it as it enters the call. Without being asked a seeded sample of the calls is cut;
//! `MIDSHIFT_SITES=all` cuts every one. A kill does not lose what was not synced: for that the trace of a whole run is
//! judged.

use crate::durability::{self, Event, events, judge, names};
use crate::sets::{bytes, component, noise, patch, put_content, set, wanted};
use crate::strace::{Sites, Victim, killed_at, run, sites, strace, traced};
use midshift_agent::boot::{BASE, BOOT, Boot};
use midshift_agent::launcher::SWITCH;
use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::{CHUNK_BYTES, Sets};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::start_policy::TRIES_MAX;
use midshift_agent::store::{Op, Store};
use midshift_agent::switch::Switch;
use midshift_agent::update::SoftwareRow;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::ComponentKind;
use midshift_bundle::set::SetManifest;
use midshift_durable::{make_folder, record};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

/// The records of a robot's software and their second copies.
const RECORDS: [&str; 4] = ["switch", "switch.copy", "boot", "boot.copy"];
/// Names the folder to the process that is to be killed.
const UPDATE_IN: &str = "MIDSHIFT_TEST_UPDATE_IN";
/// Names what it is to go through.
const COURSE: &str = "MIDSHIFT_TEST_COURSE";
/// The test that goes through it.
const GOES: &str = "a_course_ends_and_gone_through_once_more_it_changes_nothing";

/// What a robot goes through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Course {
    /// From v1 to v2, committed.
    Update,
    /// Back from v2 on probation.
    BackFromProbation,
    /// Back from v2 on trial.
    BackFromTrial,
    /// Back from v2 when it was committed.
    BackFromCommitted,
}

impl Course {
    const ALL: [Self; 4] = [Self::Update, Self::BackFromProbation, Self::BackFromTrial, Self::BackFromCommitted];

    /// Cuts of a sample.
    fn sample(self) -> usize {
        if self == Self::Update { 48 } else { 8 }
    }

    /// A robot that has it before itself: v1 and v0 are committed, and v2 stands where it goes back from. What it runs
    /// without v2.
    fn begin(self, folder: &Path) -> SetManifest {
        let [_, kept] = robot(folder);
        let steps = match self {
            Self::Update => 0,
            Self::BackFromProbation => 1,
            Self::BackFromTrial => 2,
            Self::BackFromCommitted => 3,
        };
        update(folder, steps, &mut |_| ());
        kept
    }

    /// Goes through it, from wherever it was cut off before.
    fn go(self, folder: &Path) {
        match self {
            Self::Update => update(folder, UPDATE_STEPS, &mut |_| ()),
            _ => back(folder, &mut |_| ()),
        }
    }

    /// What runs, what is kept beside it, when it was gone through.
    fn end(self, kept: &SetManifest) -> (SetManifest, Option<SetManifest>) {
        if self == Self::Update { (next().0, Some(kept.clone())) } else { (kept.clone(), None) }
    }
}

/// Policy weights in every set; those of v2 come as a patch.
fn weights(version: u64) -> Vec<u8> {
    [noise(version, 1_000), noise(7, 400_000)].concat()
}

/// The operating system, another in every set.
fn base(version: u64) -> Vec<u8> {
    noise(70 + version, 3_000)
}

/// A program that says which set it is of and ends well, whatever follows.
fn program(version: &str) -> Vec<u8> {
    format!("#!/bin/sh\n# {version}\necho $MIDSHIFT_SET\nexit 0\n").into_bytes()
}

/// What is updated to: a program of three chunks, settings, weights and an operating system.
fn next() -> (SetManifest, [Vec<u8>; 4]) {
    let program = [program("v2"), bytes(3, 2 * CHUNK_BYTES + 1_000)].concat();
    let contents = [program, b"settings of v2".to_vec(), weights(2), base(2)];
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
        let contents = [program(version), b"settings".to_vec(), weights(number), base(number)];
        let set = set_with(version, &contents);
        for content in &contents {
            put_content(&mut sets, content);
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

/// Steps of a whole update beside what comes before the first and after the last: tried, proven, committed.
const UPDATE_STEPS: usize = 3;

/// An update up to so many steps, from wherever an earlier one was cut off. Each side effect is told to the ledger
/// first.
fn update(folder: &Path, steps: usize, ledger: &mut dyn FnMut(&str)) {
    let mut sets = DiskSets::open(folder).expect("opens");
    let (next, contents) = next();
    let name = next.id().to_string();
    let mut switch = sets.holdings().expect("tells").switch;
    if steps >= 1 && switch.running() != name {
        let [program, settings, grip, base] = &contents;
        ledger("downloading");
        for content in [program, settings, base] {
            fetch(&mut sets, content);
        }
        if !sets.missing(&wanted(grip)).expect("tells").is_empty() {
            let way = patch(&weights(1), grip);
            fetch(&mut sets, &way);
            sets.decode(&wanted(grip), Some(&Digest::of_content(&weights(1))), &wanted(&way)).expect("leads there");
        }
        ledger("staged");
        sets.stage(&next).expect("stages");
        switch = sets.holdings().expect("tells").switch;
        ledger("switching");
        switch.try_out(&name);
        sets.write_switch(&mut switch).expect("writes");
    }
    if steps >= 2 && switch.trial.as_ref().is_some_and(|trial| !trial.is_proven) {
        ledger("trial");
        switch.prove();
        sets.write_switch(&mut switch).expect("writes");
    }
    if steps >= 3 && switch.trial.is_some() {
        ledger("committing");
        switch.commit();
        sets.write_switch(&mut switch).expect("writes");
    }
    if steps >= UPDATE_STEPS {
        ledger("committed");
        sets.collect(&BTreeSet::new()).expect("collects");
    }
}

/// The way back to the kept set, as the updater has it: read again, switched to, and what is not needed any more
/// deleted.
fn back(folder: &Path, ledger: &mut dyn FnMut(&str)) {
    let mut sets = DiskSets::open(folder).expect("opens");
    let mut switch = sets.holdings().expect("tells").switch;
    if switch.running() == next().0.id().to_string() {
        ledger("rolling back");
        let kept = switch.kept().expect("a way back").parse().expect("a set");
        sets.verify(&kept).expect("is whole");
        if switch.trial.is_some() {
            switch.go_back();
        } else {
            switch.undo_commit();
        }
        sets.write_switch(&mut switch).expect("writes");
    }
    ledger("rolled back");
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

/// The launcher starts the set that the switch record names, on its own base, and puts nothing away.
fn assert_boots(folder: &Path, when: &str) {
    let running = DiskSets::open(folder).expect("opens").holdings().expect("tells").switch.running().to_owned();
    let record = tempfile::tempdir().expect("a folder");
    let mut launcher = Command::new(env!("CARGO_BIN_EXE_midshift-launcher"));
    launcher.arg("--record").arg(record.path().join("tries")).arg("--sets").arg(folder);
    let output = launcher.args(["--", "sh", "-c", "echo factory"]).output().expect("the launcher");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{when}: {}: {said}", output.status);
    assert_eq!(String::from_utf8_lossy(&output.stdout), format!("{running}\n"), "{when}: {said}");
    let base = fs::read_to_string(folder.join(&running).join(BASE)).expect("names its base");
    let boot = Boot::read(&folder.join(BOOT)).expect("reads");
    assert_eq!(boot.slot_of(base.trim()), Some(boot.booted), "{when}: {said}");
}

/// It came to its end and left nothing behind.
fn assert_ended(course: Course, folder: &Path, kept: &SetManifest, when: &str) {
    assert_bootable(folder, when);
    let switch = DiskSets::open(folder).expect("opens").holdings().expect("tells").switch;
    let (current, previous) = course.end(kept);
    let ids = [Some(&current), previous.as_ref()].map(|set| set.map(|set| set.id().to_string()));
    let stands = (Some(switch.current), switch.previous, switch.trial);
    assert_eq!(stands, (ids[0].clone(), ids[1].clone(), None), "{when}");
    let names = |folder: &Path| -> BTreeSet<String> {
        let entries = fs::read_dir(folder).expect("is there").map(|entry| entry.expect("an entry").file_name());
        entries.map(|name| name.to_string_lossy().into_owned()).collect()
    };
    let mut there: BTreeSet<String> =
        RECORDS.into_iter().chain(["content", "base-a", "base-b"]).map(str::to_owned).collect();
    there.extend(ids.into_iter().flatten());
    assert_eq!(names(folder), there, "{when}");
    let components = current.components.values().chain(previous.iter().flat_map(|set| set.components.values()));
    assert_eq!(names(&folder.join("content")), components.map(|c| c.digest.to_string()).collect(), "{when}");
}

#[test]
fn a_course_ends_and_gone_through_once_more_it_changes_nothing() {
    if let Some(folder) = std::env::var_os(UPDATE_IN) {
        // In the process that is to be killed.
        let told = std::env::var(COURSE).expect("a course");
        let course = Course::ALL.into_iter().find(|course| format!("{course:?}") == told).expect("one of them");
        return course.go(Path::new(&folder));
    }
    for course in Course::ALL {
        let folder = tempfile::tempdir().expect("a folder");
        let kept = course.begin(folder.path());
        for _ in 0..2 {
            course.go(folder.path());
            assert_ended(course, folder.path(), &kept, "without a cut");
            assert_boots(folder.path(), "without a cut");
        }
    }
}

/// Runs one of these tests on a folder in a process of its own.
fn at<T>(test: &str, course: &str, folder: &Path, verb: impl FnOnce(&Victim<'_>) -> T) -> T {
    let environment = [(UPDATE_IN, folder.as_os_str().to_owned()), (COURSE, course.into())];
    verb(&Victim { test: &format!("power::{test}"), environment: &environment, folder })
}

/// Cuts a course at a sample of its calls, or at all of them: what is left is started, and it ends all the same. What
/// was cut.
fn cut(course: Course) -> String {
    let seed = std::env::var("MIDSHIFT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
    let all = std::env::var("MIDSHIFT_SITES").is_ok_and(|sites| sites == "all");
    let told = format!("{course:?}");
    let folder = tempfile::tempdir().expect("a folder");
    let kept = course.begin(folder.path());
    let Sites { calls: mut cuts, paths } = at(GOES, &told, folder.path(), sites);
    assert_ended(course, folder.path(), &kept, "under strace");
    let found = cuts.len();
    assert!(found > course.sample(), "{found} calls change the disk: {cuts:?}");
    if !all {
        cuts.shuffle(&mut StdRng::seed_from_u64(seed));
        cuts.truncate(course.sample());
    }
    let new = next().0.id().to_string();
    let mut on_new = 0;
    for site in &cuts {
        let when = format!("{course:?} killed at {site:?}, MIDSHIFT_SEED={seed}");
        let folder = tempfile::tempdir().expect("a folder");
        let kept = course.begin(folder.path());
        at(GOES, &told, folder.path(), |victim| killed_at(victim, &paths, site));
        assert_bootable(folder.path(), &when);
        assert_boots(folder.path(), &when);
        let switch = DiskSets::open(folder.path()).expect("opens").holdings().expect("tells").switch;
        on_new += usize::from(switch.running() == new);
        course.go(folder.path());
        assert_ended(course, folder.path(), &kept, &when);
    }
    assert!((1..cuts.len()).contains(&on_new), "of {} cuts {on_new} left the new set running", cuts.len());
    format!(
        "{course:?}: {found} calls change the disk; {} of them were cut, {on_new} with the new set running; the launcher started each; MIDSHIFT_SEED={seed}",
        cuts.len()
    )
}

#[test]
fn wherever_the_power_goes_a_whole_set_is_started_and_the_update_ends() {
    println!("{}", cut(Course::Update));
}

#[test]
fn wherever_the_power_goes_on_the_way_back_a_whole_set_is_started_and_the_kept_one_runs_in_the_end() {
    for course in [Course::BackFromProbation, Course::BackFromTrial, Course::BackFromCommitted] {
        println!("{}", cut(course));
    }
}

/// The whole life of a robot's software, from a machine without anything: sets, switch record and boot record, each
/// step on its ledger first.
fn live(home: &Path) {
    let (data, sets) = (home.join("robot/data"), home.join("robot/sets"));
    make_folder(&data).expect("makes");
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    let mut store = runtime.block_on(SqliteStore::open(&data.join("agent.db"))).expect("opens");
    let mut directive_generation = 0;
    let mut ledger = |_: &str| {
        directive_generation += 1;
        let row = SoftwareRow { directive_generation, ..SoftwareRow::default() };
        runtime.block_on(store.commit(&[Op::Software(Box::new(row))])).expect("commits");
    };
    ledger("set up");
    robot(&sets);
    ledger("downloading");
    DiskSets::open(&sets).expect("opens").fetch_as_it_is(&wanted(b"no way is shorter")).expect("notes");
    update(&sets, 2, &mut ledger);
    back(&sets, &mut ledger);
    update(&sets, UPDATE_STEPS, &mut ledger);
    back(&sets, &mut ledger);
}

/// No hole is in a trace, and leaving any sync out makes one, but those in `theirs`: a database syncs as it likes; and
/// but that of a new slot's name, which a boot record that has a copy to take away makes durable once more, and its
/// first one does not. How many syncs.
fn assert_durable(found: &[Event], there: &BTreeSet<String>, theirs: &str) -> usize {
    assert_eq!(judge(found, there), Vec::<String>::new());
    let is_ours = |event: &Event| matches!(event, Event::Synced(path) if !path.starts_with(theirs));
    let is_slot = |event: &Event| matches!(event, Event::Synced(path) if path.contains("/base-"));
    let is_named = |at: &usize| is_ours(&found[*at]) && !(*at > 0 && is_slot(&found[*at - 1]));
    let syncs: Vec<usize> = (0..found.len()).filter(is_named).collect();
    let is_needless = |at: &&usize| judge(&[&found[..**at], &found[**at + 1..]].concat(), there).is_empty();
    let needless: Vec<&[Event]> =
        syncs.iter().filter(is_needless).map(|at| &found[at.saturating_sub(3)..found.len().min(at + 2)]).collect();
    assert!(needless.is_empty(), "nobody needs the last but one of {needless:#?}");
    syncs.len()
}

#[test]
fn what_a_robot_relies_on_was_synced_before() {
    let test = "what_a_robot_relies_on_was_synced_before";
    if let Some(home) = std::env::var_os(UPDATE_IN) {
        return live(Path::new(&home));
    }
    let home = tempfile::tempdir().expect("a folder");
    let root = home.path().canonicalize().expect("is there");
    let there = names(&root);
    let calls = ["-e".to_owned(), format!("trace={}", durability::CALLS)];
    let (output, trace) = at(test, "", &root, |victim| traced(victim, &calls));
    assert!(output.status.success(), "{}: {trace}", output.status);
    let found = events(&trace, &root.to_string_lossy());
    let data = root.join("robot/data").to_string_lossy().into_owned();
    let syncs = assert_durable(&found, &there, &data);
    let is_row =
        |event: &Event| matches!(event, Event::Synced(path) if path.starts_with(&data) && path.ends_with("-wal"));
    let unwritten: Vec<Event> = found.iter().filter(|event| !is_row(event)).cloned().collect();
    assert_ne!(judge(&unwritten, &there), Vec::<String>::new(), "nothing waits for the ledger");
    let names = found.iter().filter(|event| matches!(event, Event::Renamed(..))).count();
    println!("{} calls, {names} names given, {syncs} syncs: each is needed and none is missing", found.len());
}

#[test]
fn what_a_launcher_relies_on_was_synced_before_it_starts_a_program() {
    let home = tempfile::tempdir().expect("a folder");
    let root = home.path().canonicalize().expect("is there");
    let (sets, tries) = (root.join("sets"), root.join("tries"));
    let kept = Course::BackFromProbation.begin(&sets);
    let there = names(&root);
    let mut found = Vec::new();
    // The new set ends without having proven anything: after two tries it is put away.
    for _ in 0..=TRIES_MAX {
        let (mut command, log) = strace(&["-e".to_owned(), format!("trace={}", durability::CALLS)]);
        command.arg(env!("CARGO_BIN_EXE_midshift-launcher")).arg("--record").arg(&tries).arg("--sets").arg(&sets);
        command.args(["--", "false"]);
        let (output, trace) = run(command, &log);
        assert!(output.status.success(), "{}: {trace}", output.status);
        let events = events(&trace, &root.to_string_lossy());
        let writes_tries = |event: &Event| matches!(event, Event::Renamed(_, to) if tries.as_os_str() == to.as_str());
        let starts = events.iter().position(|event| *event == Event::Started).expect("starts a program");
        assert!(events[..starts].iter().any(writes_tries), "{events:?}");
        found.extend(events);
    }
    assert_eq!(Switch::read(&sets.join(SWITCH)).expect("reads").running(), kept.id().to_string());
    let named = |name: &str| found.iter().any(|event| matches!(event, Event::Renamed(_, to) if to.ends_with(name)));
    assert!([SWITCH, BOOT].into_iter().all(|record| named(&format!("/sets/{record}"))), "{found:?}");
    assert_durable(&found, &there, "-");
}

#[test]
fn wherever_the_power_goes_while_a_torn_switch_record_is_written_anew_it_can_be_read() {
    if let Some(folder) = std::env::var_os(UPDATE_IN) {
        let path = Path::new(&folder).join(SWITCH);
        return Switch::read(&path).expect("its copy is whole").write(&path).expect("writes");
    }
    let test = "wherever_the_power_goes_while_a_torn_switch_record_is_written_anew_it_can_be_read";
    let torn = || {
        let folder = tempfile::tempdir().expect("a folder");
        robot(folder.path());
        fs::write(folder.path().join(SWITCH), "midshift-switch 1\n").expect("tears");
        folder
    };
    let folder = torn();
    let Sites { calls, paths } = at(test, "", folder.path(), sites);
    assert!(calls.len() > 10, "{calls:?}");
    for site in &calls {
        let folder = torn();
        at(test, "", folder.path(), |victim| killed_at(victim, &paths, site));
        assert_bootable(folder.path(), &format!("killed at {site:?}"));
    }
}

#[test]
fn twin_a_switch_record_that_is_written_where_it_lies_is_lost_with_the_power() {
    if let Some(folder) = std::env::var_os(UPDATE_IN) {
        let path = Path::new(&folder).join(SWITCH);
        let text = fs::read_to_string(&path).expect("is there");
        return fs::write(&path, text).expect("writes");
    }
    let twin = "twin_a_switch_record_that_is_written_where_it_lies_is_lost_with_the_power";
    let folder = tempfile::tempdir().expect("a folder");
    robot(folder.path());
    let Sites { calls, paths } = at(twin, "", folder.path(), sites);
    let [write] = &calls[..] else { panic!("{calls:?}") };
    assert_bootable(folder.path(), "without a cut");
    at(twin, "", folder.path(), |victim| killed_at(victim, &paths, write));
    assert_bootable(folder.path(), "torn, and its copy is whole");
    fs::remove_file(record::copy_of(&folder.path().join(SWITCH))).expect("removes");
    assert!(DiskSets::open(folder.path()).expect("opens").holdings().is_err(), "the naive way is good enough");
}
