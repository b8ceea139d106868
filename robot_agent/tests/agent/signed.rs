//! What runs is what was signed and committed: held against its documents at each start and while it runs, and what
//! follows if it is not.

use crate::release::{Bundle, Releases};
use crate::rig::{Rig, action};
use crate::sets::{put_content, set};
use crate::updates::{Order, committed, connected, name_of, on_trial, relaunch, stage, state, switch, want, why};
use midshift_agent::core::ExitReason;
use midshift_agent::memory::MemoryStore;
use midshift_agent::sets::Sets;
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::storage::Proven;
use midshift_agent::store::Op;
use midshift_agent::switch::{FACTORY, Switch};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::Migration;
use midshift_core::reason::Code;
use midshift_core::robot::FAULT_SOFTWARE;
use midshift_core::step::Effect;
use midshift_core::update::{Goal, UpdateState};
use std::collections::BTreeSet;

const DAY_MS: u64 = 24 * 3_600_000;
/// Longer than any pause between two tries.
const PAUSE_MS: u64 = 70_000;

fn disk(rig: &Rig) -> MemorySets {
    rig.updates.as_ref().expect("has them").sets.clone()
}

/// Offers a task; the codes of its refusals.
fn offered(rig: &mut Rig, task: &str) -> Vec<String> {
    let steps = vec![action("pick", Effect::Repeatable)];
    rig.work(rig.desired(Some(rig.offer(task, 1, steps, vec![]))));
    rig.pass(1_000);
    rig.refusals()
}

fn works(rig: &Rig) -> bool {
    rig.body.log().acting.is_some()
}

/// The process ends and is started again, and the server is there.
fn started_again(rig: Rig) -> Rig {
    let mut rig = rig.restart();
    rig.connect();
    rig
}

/// Puts a set onto the disk that nobody signed, and names it in the switch record as committed.
fn forged(rig: &Rig) -> String {
    forged_and(rig, Switch::commit)
}

/// The same, with the record as `change` makes it of one that has the set on trial.
fn forged_and(rig: &Rig, change: impl FnOnce(&mut Switch)) -> String {
    let mut sets = disk(rig);
    let forged = set("6.6.6", b"forged program", b"forged settings");
    put_content(&mut sets, b"forged program");
    put_content(&mut sets, b"forged settings");
    sets.stage(&forged).expect("stages");
    let mut switch = sets.holdings().expect("tells").switch;
    switch.try_out(&forged.id().to_string());
    change(&mut switch);
    sets.write_switch(&mut switch).expect("writes");
    forged.id().to_string()
}

fn is_there(rig: &Rig, set: &str) -> bool {
    disk(rig).holdings().expect("tells").set(set).is_some()
}

/// The committed set runs and works.
fn runs_and_works(rig: Rig, name: &str) -> Rig {
    let mut rig = started_again(rig);
    assert_eq!((rig.exit, switch(&rig).running()), (None, name));
    assert_eq!(offered(&mut rig, "T50"), [] as [&str; 0]);
    assert!(works(&rig));
    rig
}

#[test]
fn a_committed_set_works_after_each_start_whatever_has_expired_or_was_signed_by_others_since() {
    let (rig, releases) = connected();
    let mut rig = committed(rig, &releases, &releases.release("1.1.0"), 1);
    let name = name_of(&rig);
    releases.rotate((5, 6));
    releases.pass(DAY_MS);
    releases.cut(true);
    rig.ms += 400 * DAY_MS;
    runs_and_works(rig, &name);
}

#[test]
fn a_set_that_nobody_signed_and_the_switch_record_names_gets_no_work_and_the_committed_one_runs_again() {
    let (rig, releases) = connected();
    let rig = committed(rig, &releases, &releases.release("1.1.0"), 1);
    let good = name_of(&rig);
    let bad = forged(&rig);
    let rig = rig.restart();
    assert_eq!((rig.exit, switch(&rig).running()), (Some(ExitReason::Switched), good.as_str()));
    assert!(is_there(&rig, &bad), "nothing is deleted before ledger and record agree");
    let mut rig = runs_and_works(rig, &good);
    rig.pass(2_000);
    assert!(!is_there(&rig, &bad));
}

#[test]
fn a_robot_that_never_took_software_goes_back_from_a_set_that_nobody_signed_to_what_it_came_with() {
    let (rig, _releases) = connected();
    forged(&rig);
    let rig = rig.restart();
    assert_eq!((rig.exit, switch(&rig).running()), (Some(ExitReason::Switched), FACTORY));
    runs_and_works(rig, FACTORY);
}

/// A robot whose committed set has a changed program.
fn with_changed_program(rig: Rig, releases: &Releases, bundle: &Bundle) -> Rig {
    let rig = committed(rig, releases, bundle, 1);
    disk(&rig).rot(&bundle.manifest.components[0].digest);
    rig
}

#[test]
fn a_changed_program_gets_no_work_is_told_and_is_had_anew() {
    let (rig, releases) = connected();
    let rig = with_changed_program(rig, &releases, &releases.release("1.1.0"));
    let name = name_of(&rig);
    releases.cut(true);
    let mut rig = started_again(rig);
    assert_eq!((offered(&mut rig, "T1"), works(&rig)), (vec!["RUNNING_SET_BAD".to_owned()], false));
    let told = rig.reported.as_ref().and_then(|reported| reported.fault.clone()).expect("a heartbeat says it");
    assert_eq!((told.code, told.message.contains("RUNNING_SET_BAD")), (FAULT_SOFTWARE, true));
    releases.cut(false);
    rig.pass(PAUSE_MS);
    assert_eq!(rig.exit, Some(ExitReason::Switched), "it is started from the mended file");
    let rig = runs_and_works(rig, &name);
    assert_eq!(state(&rig), Some(UpdateState::Committed));
    disk(&rig).verify(&name.parse().expect("an id")).expect("is whole");
    assert!(rig.reported.is_some_and(|reported| reported.fault.is_none()));
}

#[test]
fn a_set_whose_manifest_is_not_what_its_name_says_is_put_right() {
    let (rig, releases) = connected();
    let rig = committed(rig, &releases, &releases.release("1.1.0"), 1);
    let name = name_of(&rig);
    disk(&rig).lose_page(&name.parse().expect("an id"));
    let rig = rig.restart();
    assert_eq!(rig.exit, Some(ExitReason::Switched));
    runs_and_works(rig, &name);
}

#[test]
fn files_beside_the_program_are_read_after_each_start_and_once_a_day() {
    for is_restarted in [true, false] {
        let (rig, releases) = connected();
        let bundle = releases.release("1.1.0");
        let mut rig = committed(rig, &releases, &bundle, 1);
        let name = name_of(&rig);
        rig = runs_and_works(rig, &name);
        rig.body.done();
        rig.pass(5_000);
        releases.cut(true);
        disk(&rig).rot(&bundle.manifest.components[1].digest);
        assert_eq!(offered(&mut rig, "T60"), [] as [&str; 0], "nobody has looked");
        rig.body.done();
        rig.pass(5_000);
        if is_restarted {
            rig = started_again(rig);
        } else {
            rig.ms += DAY_MS;
        }
        rig.pass(2_000);
        assert_eq!(offered(&mut rig, "T70"), ["RUNNING_SET_BAD"], "restarted: {is_restarted}");
    }
}

#[test]
fn what_cannot_be_had_anew_is_gone_back_from_if_the_way_is_open() {
    type Change = fn(&Rig);
    let open: Change = |_| {};
    let below: Change = |rig| {
        let mut software = rig.store.memory().expect("loaded").ledger.software;
        software.floors.insert("gait".to_owned(), 9);
        rig.store.commit_now(&[Op::Software(Box::new(software))]);
    };
    let kept_is_forged: Change = |rig| {
        let mut sets = disk(rig);
        let mut switch = sets.holdings().expect("tells").switch;
        switch.previous = Some("abc".to_owned());
        sets.write_switch(&mut switch).expect("writes");
    };
    let cases = [
        (Migration::None, open, true),
        (Migration::Irreversible, open, false),
        (Migration::None, below, false),
        (Migration::None, kept_is_forged, false),
    ];
    for (n, (data_migration, change, is_open)) in cases.into_iter().enumerate() {
        let (rig, releases) = connected();
        let first = releases.release("1.1.0");
        let second = releases.release_as("1.2.0", |m| m.components[1].data_migration = data_migration);
        let rig = committed(rig, &releases, &first, 1);
        let kept = name_of(&rig);
        let rig = committed(rig, &releases, &second, 2);
        change(&rig);
        disk(&rig).rot(&second.manifest.components[0].digest);
        releases.corrupt(true);
        let mut rig = started_again(rig);
        rig.pass(PAUSE_MS);
        if is_open {
            let mut rig = relaunch(rig);
            assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::RolledBack), Some(Code::RunningSetBad)));
            assert_eq!(switch(&rig).running(), kept);
            assert_eq!((offered(&mut rig, "T1"), works(&rig)), (vec![], true));
        } else {
            assert_eq!((rig.exit, state(&rig)), (None, Some(UpdateState::Stuck)), "case {n}");
            assert_eq!(why(&rig), Some(Code::RunningSetBad), "case {n}");
            assert_eq!(offered(&mut rig, "T1"), ["RUNNING_SET_BAD"], "case {n}");
        }
    }
}

#[test]
fn a_stuck_robot_works_again_once_its_bytes_come() {
    let (rig, releases) = connected();
    let bundle = releases.release_as("1.1.0", |m| m.components[1].data_migration = Migration::Irreversible);
    let rig = with_changed_program(rig, &releases, &bundle);
    let name = name_of(&rig);
    releases.corrupt(true);
    let mut rig = started_again(rig);
    rig.pass(PAUSE_MS);
    assert_eq!(state(&rig), Some(UpdateState::Stuck));
    releases.corrupt(false);
    let rig = rig.restart();
    assert_eq!(rig.exit, Some(ExitReason::Switched), "each start asks once more");
    let rig = runs_and_works(rig, &name);
    assert_eq!(state(&rig), Some(UpdateState::Committed));
}

#[test]
fn a_changed_program_on_trial_is_gone_back_from() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let (rig, _) = on_trial(rig, &releases, &bundle, 1);
    disk(&rig).rot(&bundle.manifest.components[0].digest);
    let mut rig = relaunch(rig.restart());
    rig.pass(1_000);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::RolledBack), Some(Code::RunningSetBad)));
    assert_eq!(switch(&rig).running(), FACTORY);
}

/// The process is killed when the ledger says that the set on trial is being committed, before the switch record does.
fn begun_to_commit(mut rig: Rig, mut order: Order) -> Rig {
    rig.slow_disk = true;
    want(&mut rig, order.to(Goal::Commit));
    let (_, ops) = rig.unwritten.take().expect("the ledger comes first");
    rig.store.commit_now(&ops);
    assert_eq!((state(&rig), is_intended(&rig)), (Some(UpdateState::Committing), true));
    assert!(switch(&rig).trial.is_some());
    rig
}

/// The ledger has a commit that the switch record is about to say.
fn is_intended(rig: &Rig) -> bool {
    let ledger = rig.store.memory().expect("loaded").ledger;
    ledger.proven.is_some_and(|proven| proven.intended.is_some())
}

#[test]
fn a_changed_program_is_not_committed_though_the_ledger_has_begun_to() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let (rig, order) = on_trial(rig, &releases, &bundle, 1);
    let rig = begun_to_commit(rig, order);
    disk(&rig).rot(&bundle.manifest.components[0].digest);
    let mut rig = relaunch(rig.restart());
    rig.pass(1_000);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::RolledBack), Some(Code::RunningSetBad)));
    assert_eq!((switch(&rig).running(), is_intended(&rig)), (FACTORY, false));
    assert_eq!(rig.store.memory().expect("loaded").ledger.software.committed_at, None);
}

#[test]
fn a_commit_whose_set_was_put_away_before_it_is_believed_of_no_later_record() {
    let (rig, releases) = connected();
    let (rig, order) = on_trial(rig, &releases, &releases.release("1.1.0"), 1);
    let rig = begun_to_commit(rig, order);
    let name = name_of(&rig);
    disk(&rig).fall_back(2);
    let rig = started_again(rig);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::RolledBack), Some(Code::ProgramCrashed)));
    assert!(!is_intended(&rig));
    // The record that was never written, by somebody else.
    let mut sets = disk(&rig);
    let mut record = switch(&rig);
    record.try_out(&name);
    record.commit();
    sets.write_switch(&mut record).expect("writes");
    let rig = rig.restart();
    assert_eq!((rig.exit, switch(&rig).running()), (Some(ExitReason::Switched), FACTORY));
}

#[test]
fn a_set_on_trial_that_nobody_signed_is_ended_beside_an_update_that_goes_on() {
    for on_its_way in [UpdateState::Directed, UpdateState::Downloading, UpdateState::Staged] {
        let (mut rig, releases) = connected();
        let mut order = stage(&mut rig, &releases, &releases.release("1.1.0"), 1);
        let mut software = rig.store.memory().expect("loaded").ledger.software;
        let update = software.update.as_mut().expect("is staged");
        update.state = on_its_way;
        if on_its_way == UpdateState::Directed {
            update.set = None;
        }
        rig.store.commit_now(&[Op::Software(Box::new(software))]);
        let bad = forged_and(&rig, |_| {});
        assert_eq!(switch(&rig).running(), bad);
        let rig = rig.restart();
        assert_eq!((rig.exit, switch(&rig).running()), (Some(ExitReason::Switched), FACTORY), "{on_its_way:?}");
        assert_eq!(state(&rig), Some(on_its_way));
        let mut rig = started_again(rig);
        want(&mut rig, order.to(Goal::Stage));
        rig.pass(2_000);
        let told = rig.reported.as_ref().and_then(|reported| reported.update.as_ref()).map(|update| update.state);
        assert_eq!((state(&rig), told), (Some(UpdateState::Staged), Some(UpdateState::Staged)), "{on_its_way:?}");
        assert_eq!((offered(&mut rig, "T1"), works(&rig)), (vec![], true), "{on_its_way:?}");
    }
}

#[test]
fn a_set_that_an_agent_without_documents_committed_is_believed_once() {
    let (rig, releases) = connected();
    let mut rig = committed(rig, &releases, &releases.release("1.1.0"), 1);
    let good = name_of(&rig);
    // The ledger as such an agent has left it.
    let software = rig.store.memory().expect("loaded").ledger.software;
    rig.store = MemoryStore::new();
    rig.store.load_now("ring-2");
    rig.store.commit_now(&[Op::Software(Box::new(software))]);
    let rig = runs_and_works(rig, &good);
    forged(&rig);
    rig.body.set(|body| body.acting = None);
    let rig = rig.restart();
    assert_eq!((rig.exit, switch(&rig).running()), (Some(ExitReason::Switched), good.as_str()));
}

#[test]
fn documents_are_kept_of_what_may_run_and_of_no_more() {
    let (rig, releases) = connected();
    let first = releases.release("1.1.0");
    let mut rig = committed(rig, &releases, &first, 1);
    let mut bundles = vec![first.digest];
    for n in 2..=5 {
        // `behaviour` stays that of the first.
        let next = releases.release_as(&format!("1.{n}.0"), |m| m.components[1].name = "tone".to_owned());
        rig = committed(rig, &releases, &next, n);
        bundles.push(next.digest);
    }
    let proven = rig.store.memory().expect("loaded").ledger.proven.expect("was written");
    let kept: BTreeSet<Digest> = [bundles[0], bundles[3], bundles[4]].into();
    assert_eq!(proven.releases.keys().copied().collect::<BTreeSet<_>>(), kept);
    assert_eq!((proven.sets.len(), proven.believed.len()), (2, 0));
    let name = name_of(&rig);
    releases.cut(true);
    runs_and_works(rig, &name);
}

#[test]
fn a_set_counts_only_with_its_documents_and_what_stands_in_them() {
    let (rig, releases) = connected();
    let rig = committed(rig, &releases, &releases.release("1.1.0"), 1);
    let proven = rig.store.memory().expect("loaded").ledger.proven.expect("was written");
    let good = proven.sets.values().next().expect("one set").clone();
    assert_eq!(proven.check(&good), Ok(()));
    let mut without = Proven::clone(&proven);
    without.releases.clear();
    assert!(without.check(&good).is_err(), "its documents are gone");
    let forged = set("6.6.6", b"forged program", b"forged settings");
    let mut with = Proven::clone(&proven);
    assert!(with.check(&forged).is_err(), "no such set was staged");
    with.sets.insert(forged.id(), forged.clone());
    assert!(with.check(&forged).is_err(), "what is in it stands in no document");
}
