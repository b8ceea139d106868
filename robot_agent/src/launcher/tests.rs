//! The launcher with real children.

use super::boot::{BASE, BOOT, Boot, Image, Slot};
use super::choose::{boot_into, change_boot};
use super::record::{read_tries, write_tries};
use super::start_policy::TRIES_MAX;
use super::switch::{self, Switch};
use super::*;
use std::fs;
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn given(text: &str) -> Result<Orders, String> {
    Orders::read(text.split(' ').map(str::to_owned))
}

/// A robot's folder, and what its launcher was told: PROGRAM is a shell with this script.
fn robot(script: &str) -> (TempDir, Orders) {
    let folder = tempfile::tempdir().expect("a folder");
    let arguments = vec!["-c".to_owned(), script.to_owned()];
    let orders = Orders {
        record: folder.path().join("tries"),
        sets: None,
        // Longer than a shell may take to begin on a machine that is busy.
        hang: Duration::from_secs(60),
        patience: start_policy::ENVIRONMENT_WAIT,
        beacon: None,
        program: "sh".to_owned(),
        arguments,
    };
    (folder, orders)
}

/// A robot whose sets hold these programs, each a script that writes its set into `ran` first; the factory's ends well.
fn with_sets(programs: &[(&str, &str)]) -> (TempDir, Orders) {
    let (folder, mut orders) = robot("echo $MIDSHIFT_SET >> $0; exit 0");
    let sets = folder.path().join("sets");
    let ran = folder.path().join("ran");
    for (set, script) in programs {
        let program = sets.join(set).join(PROGRAM);
        fs::create_dir_all(program.parent().expect("a folder")).expect("makes");
        write_program(&program, &format!("echo $MIDSHIFT_SET >> {}\n{script}", ran.display()));
    }
    fs::create_dir_all(&sets).expect("makes");
    orders.arguments.push(ran.display().to_string());
    orders.sets = Some(sets);
    (folder, orders)
}

/// By a child: a file that this process has had open for writing may not be run while another test starts a child of
/// its own.
fn write_program(path: &Path, script: &str) {
    let write = "printf '#!/bin/sh\\n%s\\n' \"$1\" > \"$2\" && chmod +x \"$2\"";
    let status = Command::new("sh").args(["-c", write, "sh", script]).arg(path).status();
    assert!(status.expect("runs").success());
}

fn on_trial(orders: &Orders, set: &str) {
    let path = orders.sets.as_ref().expect("has sets").join(SWITCH);
    let mut switch = Switch::read(&path).expect("reads");
    switch.try_out(set);
    switch.write(&path).expect("writes");
}

/// As [`on_trial`] where the record cannot be written: by way of another folder.
fn on_trial_by(set: &str, beside: &Path) {
    let elsewhere = beside.join(SWITCH);
    let mut switch = Switch::default();
    switch.try_out(set);
    switch.write(&elsewhere).expect("writes");
    fs::remove_file(midshift_durable::record::copy_of(&elsewhere)).expect("removes");
    fs::rename(elsewhere, beside.with_extension("")).expect("moves");
}

/// What a launcher that has just begun starts.
fn chosen(orders: &Orders) -> Start {
    let (mut unwritten, mut environment) = (Unwritten::default(), Environment::default());
    choose(orders, &read_tries(&orders.record).expect("reads"), &mut unwritten, &mut environment, Duration::ZERO)
        .expect("chooses")
}

fn record(orders: &Orders) -> Switch {
    Switch::read(&orders.sets.as_ref().expect("has sets").join(SWITCH)).expect("reads")
}

fn ran(folder: &TempDir) -> Vec<String> {
    let text = fs::read_to_string(folder.path().join("ran")).unwrap_or_default();
    text.lines().map(str::to_owned).collect()
}

#[test]
fn the_command_line_is_read_whole_or_refused() {
    let orders =
        given("--record r --hang 3 --sets s --beacon h:7422 --robot-id x -- agent run --robot-id x").expect("reads");
    assert_eq!((orders.hang, orders.program.as_str(), orders.arguments.len()), (Duration::from_secs(3), "agent", 3));
    assert_eq!(orders.beacon, Some(("h:7422".to_owned(), "x".to_owned())));
    let wrong = [
        "--record r",
        "-- agent",
        "--record r --",
        "--hang 0 --record r -- agent",
        "--what",
        "--record r --beacon h:1 -- a",
    ];
    for wrong in wrong {
        assert!(given(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn a_program_that_fails_is_started_again_until_it_ends_well_and_its_tries_are_on_the_disk_before_it_runs() {
    let (folder, mut orders) = robot("");
    let (record, seen) = (orders.record.display(), folder.path().join("seen"));
    orders.arguments[1] = format!("cat {record} >> {0}; test $(wc -l < {0}) -ge 3", seen.display());
    keep_running(&orders).expect("runs");
    assert_eq!(
        fs::read_to_string(&seen).expect("was written"),
        "tries 1 of factory\ntries 2 of factory\ntries 3 of factory\n"
    );
    assert_eq!(read_tries(&orders.record).expect("reads").count_of("factory"), 0);
}

#[test]
fn a_program_without_a_pulse_is_killed() {
    let (_folder, mut orders) = robot("echo a line is no pulse; exec sleep 600");
    orders.hang = Duration::from_secs(1);
    let start = chosen(&orders);
    let (mut tries, mut environment, mut beacon) = (start.tries.clone(), Environment::default(), Beacon::new(&orders));
    let run =
        Run { orders: &orders, start: &start, tries: &mut tries, environment: &mut environment, beacon: &mut beacon };
    let ending = run_once(run).expect("runs");
    assert_eq!(ending, Ending::Hung);
}

#[test]
fn a_set_on_trial_that_cannot_live_is_put_away_and_the_one_before_it_runs() {
    let (folder, orders) = with_sets(&[("v1", "exit 1")]);
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory"]);
    let after = record(&orders);
    assert_eq!((after.running(), after.trial.as_ref()), ("factory", None));
    assert_eq!(after.fallen, Some(switch::FailedTrial { set: "v1".to_owned(), tries: TRIES_MAX }));
}

#[test]
fn a_set_on_trial_that_hangs_is_put_away_too() {
    let (folder, mut orders) = with_sets(&[("v1", "exec sleep 600")]);
    orders.hang = Duration::from_secs(3);
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory"]);
}

#[test]
fn a_program_that_switched_is_followed_by_the_set_it_wrote_at_once_and_not_counted_as_failed() {
    let (folder, orders) = with_sets(&[("v1", "exit 0"), ("v0", "")]);
    let sets = orders.sets.clone().expect("has sets");
    let mut next = Switch::default();
    next.try_out("v1");
    next.number = 9;
    next.write(&folder.path().join("next")).expect("writes");
    let script = format!("cp {}/next {}/{SWITCH}; exit {SWITCHED}", folder.path().display(), sets.display());
    write_program(&sets.join("v0").join(PROGRAM), &script);
    on_trial(&orders, "v0");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1"]);
    let tries = read_tries(&orders.record).expect("reads");
    assert_eq!(
        (tries.count_of("v0"), tries.count_of("v1")),
        (0, 1),
        "the second one is on probation and has proven nothing"
    );
}

#[test]
fn a_set_on_probation_that_ends_well_or_to_switch_and_changes_nothing_is_put_away_too() {
    let (folder, orders) = with_sets(&[("v1", "exit 75")]);
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory"]);
    let (folder, orders) = with_sets(&[("v1", "exit 0")]);
    on_trial(&orders, "v1");
    // Whoever keeps the launcher running starts it again.
    for _ in 0..3 {
        keep_running(&orders).expect("runs");
    }
    assert_eq!(ran(&folder), ["v1", "v1", "factory"]);
    assert_eq!(record(&orders).trial, None);
}

#[test]
fn a_second_launcher_of_a_robot_starts_nothing_while_the_first_one_lives() {
    let (folder, orders) = with_sets(&[]);
    let (_alone, without_sets) = robot("exit 0");
    for orders in [&orders, &without_sets] {
        let first = LauncherLock::acquire(orders).expect("is free");
        let error = keep_running(orders).expect_err("is refused");
        assert_eq!(error.kind(), io::ErrorKind::WouldBlock, "{error}");
        drop(first);
    }
    assert_eq!(ran(&folder), [] as [&str; 0]);
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["factory"]);
}

#[test]
fn a_program_that_its_environment_failed_has_had_no_try() {
    let (folder, orders) = with_sets(&[("v1", "test $(wc -l < ${0%/*}/../../ran) -ge 3 && exit 1; exit 74")]);
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(
        ran(&folder),
        ["v1", "v1", "v1", "v1", "factory"],
        "two failures of its own after two of its environment"
    );
}

#[test]
fn a_set_whose_environment_fails_it_alone_is_put_away() {
    let (folder, mut orders) = with_sets(&[("v1", "exit 74")]);
    orders.patience = Duration::ZERO;
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "factory"]);
    let after = record(&orders);
    let fallen = after.fallen.as_ref().map(|fallen| fallen.set.as_str());
    assert_eq!((after.running(), fallen), ("factory", Some("v1")));
}

#[test]
fn a_set_on_trial_is_not_blamed_for_an_environment_that_fails_the_kept_set_too() {
    let (folder, mut orders) = with_sets(&[("v1", "test -e ${0%/*}/../../broken && exit 74; exit 0")]);
    orders.patience = Duration::ZERO;
    let broken = folder.path().join("broken");
    fs::write(&broken, "").expect("writes");
    orders.arguments[1] = format!("echo $MIDSHIFT_SET >> $0; rm {} && exit 74; exit 0", broken.display());
    on_trial(&orders, "v1");
    let before = record(&orders);
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "factory", "v1"]);
    assert_eq!(record(&orders), before, "it is still on trial");
}

#[test]
fn a_record_that_cannot_be_written_stops_no_robot_and_its_tries_are_counted_all_the_same() {
    let (folder, mut orders) = with_sets(&[("v1", "exit 1")]);
    orders.record = folder.path().join("not-there").join("tries");
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory"]);
}

/// Makes a record that is replaced whole unwritable, whoever asks: where its new text would be put lies a folder.
fn block(orders: &Orders, record: &str) -> PathBuf {
    let beside = orders.sets.as_ref().expect("has sets").join(record).with_extension("new");
    fs::create_dir(&beside).expect("makes");
    beside
}

#[test]
fn a_set_is_put_away_though_the_switch_record_cannot_be_written_and_stays_so_while_the_launcher_lives() {
    let (folder, mut orders) = with_sets(&[("v1", "exit 1")]);
    // The factory's fails once; then the disk has room again.
    let beside = block(&orders, SWITCH);
    let script = format!("echo $MIDSHIFT_SET >> $0; rmdir {}", beside.display());
    orders.arguments[1] = format!("{script} && exit 1; exit 0");
    on_trial_by("v1", &beside);
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory", "factory"], "it is not tried once more");
    let after = record(&orders);
    assert_eq!((after.number, after.running()), (2, "factory"), "it was written when there was room");
    assert_eq!(after.fallen, Some(switch::FailedTrial { set: "v1".to_owned(), tries: TRIES_MAX }));
}

#[test]
fn what_could_not_be_written_does_not_hold_over_what_the_agent_has_written_since() {
    let (folder, mut orders) = with_sets(&[("v1", "exit 1"), ("v2", "exit 0")]);
    let beside = block(&orders, SWITCH);
    let mut next = Switch { number: 1, ..Switch::default() };
    next.try_out("v2");
    next.write(&folder.path().join("next")).expect("writes");
    let sets = orders.sets.clone().expect("has sets");
    let copy = format!("cp {}/next {}/{SWITCH}", folder.path().display(), sets.display());
    orders.arguments[1] = format!("echo $MIDSHIFT_SET >> $0; {copy}; exit {SWITCHED}");
    on_trial_by("v1", &beside);
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory", "v2"]);
    assert_eq!(record(&orders), next);
}

#[test]
fn a_boot_record_that_cannot_be_written_leaves_the_machine_on_its_base_and_starts_a_set_that_runs_on_it() {
    let (folder, orders) = with_sets(&[("v1", "exit 0")]);
    with_base(&orders, "v1", "b1", 4);
    on_trial(&orders, "v1");
    let before = boot(&orders);
    block(&orders, BOOT);
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["factory"], "v1 needs another base");
    assert_eq!(boot(&orders), before);
    assert_eq!(record(&orders).fallen.map(|fallen| fallen.set), Some("v1".to_owned()));
}

#[test]
fn a_program_that_cannot_be_looked_at_is_not_taken_for_one_that_the_set_does_not_bring() {
    let (folder, orders) = with_sets(&[]);
    let set = orders.sets.as_ref().expect("has sets").join("v1");
    fs::create_dir(&set).expect("makes");
    std::os::unix::fs::symlink(PROGRAM, set.join(PROGRAM)).expect("makes");
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["factory"], "its program ran as no other set");
    assert_eq!(record(&orders).fallen, Some(switch::FailedTrial { set: "v1".to_owned(), tries: TRIES_MAX }));
}

#[test]
fn tries_that_cannot_be_read_speak_against_a_set_on_probation_and_against_no_other() {
    let (folder, orders) = with_sets(&[("v1", "exit 0")]);
    fs::create_dir(&orders.record).expect("makes");
    on_trial(&orders, "v1");
    let path = orders.sets.as_ref().expect("has sets").join(SWITCH);
    let mut switch = record(&orders);
    switch.prove();
    switch.write(&path).expect("writes");
    keep_running(&orders).expect("runs");
    on_trial(&orders, "v1");
    for _ in 0..2 {
        keep_running(&orders).expect("runs");
    }
    assert_eq!(ran(&folder), ["v1", "factory", "factory"]);
    assert_eq!(record(&orders).fallen, Some(switch::FailedTrial { set: "v1".to_owned(), tries: TRIES_MAX }));
}

#[test]
fn a_power_cut_counts_as_a_try_and_tries_of_another_set_do_not() {
    let (_folder, orders) = with_sets(&[("v1", ""), ("v2", "")]);
    on_trial(&orders, "v1");
    for tries in [1, 2] {
        let start = chosen(&orders);
        assert_eq!((start.set.as_str(), start.tries.count_of("v1")), ("v1", tries));
        write_tries(&orders.record, &start.tries).expect("writes");
    }
    assert_eq!(chosen(&orders).set, "factory", "twice the power went while it started");
    on_trial(&orders, "v2");
    assert_eq!(chosen(&orders).tries.count_of("v2"), 1);
}

#[test]
fn a_committed_set_is_never_put_away_and_a_set_on_probation_does_not_clear_its_tries() {
    let (_folder, orders) = with_sets(&[("v1", "")]);
    let path = orders.sets.as_ref().expect("has sets").join(SWITCH);
    on_trial(&orders, "v1");
    assert!(!is_trusted(&orders, &chosen(&orders)));
    let mut switch = record(&orders);
    switch.prove();
    switch.write(&path).expect("writes");
    assert!(is_trusted(&orders, &chosen(&orders)));
    switch.commit();
    switch.write(&path).expect("writes");
    write_tries(&orders.record, &Tries::new("v1", 7)).expect("writes");
    assert_eq!(chosen(&orders).set, "v1");
}

#[test]
fn a_damaged_switch_record_starts_nothing() {
    let (folder, orders) = with_sets(&[("v1", "")]);
    fs::write(orders.sets.as_ref().expect("has sets").join(SWITCH), "midshift-switch 1\nnumber").expect("writes");
    let error = keep_running(&orders).expect_err("is refused");
    assert!(error.to_string().contains("damaged"), "{error}");
    assert_eq!(ran(&folder), Vec::<String>::new());
}

#[test]
fn while_no_agent_runs_a_beacon_says_which_set_is_tried() {
    let ear = UdpSocket::bind("127.0.0.1:0").expect("binds");
    let (_folder, mut orders) = with_sets(&[("v1", "exit 1")]);
    orders.beacon = Some((ear.local_addr().expect("bound").to_string(), "r1".to_owned()));
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    let mut text = [0; 256];
    let heard = ear.recv(&mut text).expect("heard");
    let words: Vec<_> = str::from_utf8(&text[..heard]).expect("text").split_whitespace().collect();
    assert_eq!(words[..5], ["midshift-beacon", "1", "r1", "v1", "1"]);
    assert!(words[5].parse::<u64>().is_ok());
}

/// Gives a set a base, in the spare slot, of which `lies` bytes are there of 4.
fn with_base(orders: &Orders, set: &str, base: &str, lies: usize) {
    let sets = orders.sets.as_ref().expect("has sets");
    fs::write(sets.join(set).join(BASE), base).expect("writes");
    change_boot(sets, |boot| {
        fs::write(sets.join(boot.spare().file()), &b"base"[..lies]).expect("writes");
        boot.put_spare(Some(Image { name: base.to_owned(), length: 4 }));
    })
    .expect("writes");
}

fn boot(orders: &Orders) -> Boot {
    Boot::read(&orders.sets.as_ref().expect("has sets").join(BOOT)).expect("reads")
}

#[test]
fn for_a_set_with_another_base_the_machine_starts_again_and_back_again_when_it_is_put_away() {
    let (folder, orders) = with_sets(&[("v1", "cat ${0%/*}/../boot >> ${0%/*}/../seen; exit 1")]);
    with_base(&orders, "v1", "b1", 4);
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["v1", "v1", "factory"]);
    let seen = fs::read_to_string(folder.path().join("sets/seen")).expect("was written");
    assert_eq!(seen.matches("booted b").count(), 2, "{seen}");
    assert_eq!(seen.matches("trying b 1").count(), 2, "the machine started once: {seen}");
    let after = boot(&orders);
    assert_eq!((after.booted, after.good, after.trying), (Slot::A, Slot::A, None));
}

#[test]
fn a_base_that_does_not_start_puts_its_set_away_without_a_start_of_the_program() {
    let (folder, orders) = with_sets(&[("v1", "exit 0")]);
    with_base(&orders, "v1", "b1", 3);
    on_trial(&orders, "v1");
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["factory"]);
    assert_eq!(record(&orders).fallen.map(|fallen| fallen.set), Some("v1".to_owned()));
    assert_eq!((boot(&orders).booted, boot(&orders).trying), (Slot::A, None));
}

#[test]
fn a_machine_that_keeps_dying_before_the_launcher_comes_leaves_the_new_base_for_good() {
    let (folder, orders) = with_sets(&[("v1", "exit 0")]);
    with_base(&orders, "v1", "b1", 4);
    on_trial(&orders, "v1");
    let sets = orders.sets.as_ref().expect("has sets");
    // The launcher asked for the base, and the power goes at each start of the machine.
    assert!(boot_into(sets, &record(&orders), 0).expect("starts"));
    machine_starts(sets).expect("starts");
    assert_eq!(boot(&orders).booted, Slot::B);
    keep_running(&orders).expect("runs");
    assert_eq!(ran(&folder), ["factory"]);
}

#[test]
fn a_committed_base_is_good_at_the_next_start_and_the_one_before_it_is_gone_back_to() {
    let (folder, orders) = with_sets(&[("v1", "exit 0")]);
    with_base(&orders, "v1", "b1", 4);
    on_trial(&orders, "v1");
    let path = orders.sets.as_ref().expect("has sets").join(SWITCH);
    let mut switch = record(&orders);
    switch.commit();
    switch.write(&path).expect("writes");
    for _ in 0..4 {
        keep_running(&orders).expect("runs");
        let now = boot(&orders);
        assert_eq!((now.booted, now.good, now.trying), (Slot::B, Slot::B, None));
    }
    switch.undo_commit();
    switch.write(&path).expect("writes");
    keep_running(&orders).expect("runs");
    assert_eq!((boot(&orders).booted, boot(&orders).good), (Slot::A, Slot::A));
    assert_eq!(ran(&folder), ["v1", "v1", "v1", "v1", "factory"]);
}
