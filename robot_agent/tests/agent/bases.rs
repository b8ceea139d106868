//! What follows a commit: migrations of data, and how long a set must be kept before a new base may come.

use crate::release::Releases;
use crate::rig::Rig;
use crate::updates::{committed, connected, maintain, name_of, on_trial, relaunch, stage, state, switch, want, why};
use midshift_agent::update::Job;
use midshift_bundle::manifest::{ComponentKind, Migration};
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot_events::RobotEvent;
use midshift_core::time::Utc;
use midshift_core::update::{Goal, UpdateEvent, UpdateState};

// --- migrations

/// Versions that data were brought to. None before its set is committed on the ledger: the bench looks.
pub fn migrations(rig: &Rig) -> Vec<String> {
    let jobs = &rig.updates.as_ref().expect("has them").jobs;
    jobs.iter().filter_map(|job| if let Job::Migrate { due, .. } = job { Some(due.to.clone()) } else { None }).collect()
}

#[test]
fn data_are_brought_to_the_new_version_after_the_commit_and_never_on_trial() {
    let (rig, releases) = connected();
    let bundle = releases.release_as("1.1.0", |m| m.components[0].data_migration = Migration::Reversible);
    let (mut rig, mut order) = on_trial(rig, &releases, &bundle, 1);
    assert_eq!(migrations(&rig), [] as [&str; 0]);
    maintain(&mut rig, None);
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Committed), None));
    assert_eq!(migrations(&rig), ["1.1.0"]);
    let told = |e: &RobotEvent| match e {
        RobotEvent::Update(UpdateEvent::Changed(report)) if report.state == UpdateState::Committed => {
            Some(report.reason.as_ref().map(|r| r.code))
        }
        _ => None,
    };
    let told: Vec<_> = rig.events.iter().filter_map(told).collect();
    assert_eq!(told, [Some(Code::MigrationDue), None]);
    let mut rig = rig.restart();
    rig.connect();
    rig.pass(5_000);
    assert_eq!(migrations(&rig), ["1.1.0"], "once it is done it is not done again");
}

#[test]
fn a_migration_that_fails_is_told_and_tried_again_and_a_newer_bundle_or_the_way_back_comes_first() {
    let (rig, releases) = connected();
    let migrates = |version| releases.release_as(version, |m| m.components[0].data_migration = Migration::Reversible);
    let (mut rig, mut order) = on_trial(rig, &releases, &migrates("1.1.0"), 1);
    rig.updates.as_mut().expect("has them").migration_fails = true;
    maintain(&mut rig, None);
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Committed), Some(Code::MigrationFailed)));
    let tried = migrations(&rig).len();
    rig.pass(10_000);
    assert!(migrations(&rig).len() > tried);
    let second = migrates("1.2.0");
    stage(&mut rig, &releases, &second, 2);
    // Until the pause after the last call is over.
    rig.pass(70_000);
    let (mut rig, mut order) = on_trial(rig, &releases, &second, 2);
    rig.updates.as_mut().expect("has them").migration_fails = false;
    maintain(&mut rig, None);
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Committed), None));
    let last = rig.updates.as_ref().expect("has them").jobs.iter().rev().find_map(|job| match job {
        Job::Migrate { due, .. } => Some((due.from.clone(), due.to.clone())),
        _ => None,
    });
    assert_eq!(last, Some((None, "1.2.0".to_owned())), "1.1.0 was never reached");
    let (mut rig, mut order) = on_trial(rig, &releases, &migrates("1.3.0"), 3);
    rig.updates.as_mut().expect("has them").migration_fails = true;
    maintain(&mut rig, None);
    want(&mut rig, order.to(Goal::Commit));
    rig.pass(120_000);
    want(&mut rig, order.to(Goal::Revert));
    rig.pass(120_000);
    let mut rig = relaunch(rig);
    rig.pass(120_000);
    assert_eq!(state(&rig), Some(UpdateState::RolledBack));
    assert_eq!(rig.store.memory().expect("loaded").ledger.software.due, []);
}

#[test]
fn a_migration_without_a_program_to_do_it_is_refused_before_its_bytes_come() {
    let (mut rig, releases) = connected();
    let bundle = releases.release_as("1.1.0", |m| {
        m.components[0].kind = ComponentKind::Weights;
        m.components[1].data_migration = Migration::Irreversible;
    });
    stage(&mut rig, &releases, &bundle, 1);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)));
    assert_eq!(releases.served(), bundle.length);
}

// --- the operating system

/// A set that is current has been that for a day.
pub fn a_day_passes(rig: &mut Rig, releases: &Releases) {
    time_passes(rig, releases, limits::BASE_SETTLED_MS);
}

fn time_passes(rig: &mut Rig, releases: &Releases, ms: u64) {
    rig.ms += ms;
    releases.pass(ms);
    rig.connect();
}

#[test]
fn a_new_base_is_taken_only_by_a_robot_whose_set_was_kept_for_a_day_and_costs_the_set_before() {
    let (rig, releases) = connected();
    let first = releases.release_base("1.1.0");
    let mut rig = committed(rig, &releases, &first, 1);
    let current = name_of(&rig);
    assert_eq!(switch(&rig).kept(), Some("factory"), "the base it came with is in the other slot");
    time_passes(&mut rig, &releases, limits::BASE_SETTLED_MS - 60_000);
    let second = releases.release_base("1.2.0");
    let before = releases.served();
    stage(&mut rig, &releases, &second, 2);
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BaseTooSoon)));
    assert_eq!(releases.served() - before, second.length, "its bytes did not come");
    assert_eq!(switch(&rig).kept(), Some("factory"));
    let process = releases.release("1.3.0");
    stage(&mut rig, &releases, &process, 3);
    assert_eq!(state(&rig), Some(UpdateState::Staged), "a bundle without a base need not wait");
    assert_eq!(switch(&rig).kept(), Some("factory"));
    a_day_passes(&mut rig, &releases);
    let (mut rig, mut order) = on_trial(rig, &releases, &second, 4);
    let trial = switch(&rig);
    assert_eq!((trial.kept(), trial.previous.as_deref()), (Some(current.as_str()), None), "its slot was taken");
    want(&mut rig, order.to(Goal::Revert));
    let mut rig = relaunch(rig);
    rig.pass(1_000);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), current.as_str()));
}

#[test]
fn a_clock_that_went_back_does_not_count_as_a_day() {
    let (rig, releases) = connected();
    let first = releases.release_base("1.1.0");
    let rig = committed(rig, &releases, &first, 1);
    let mut row = rig.store.memory().expect("loaded").ledger.software;
    row.committed_at = Some(Utc(i64::MAX));
    rig.store.commit_now(&[midshift_agent::store::Op::Software(Box::new(row))]);
    let mut rig = rig.restart();
    rig.connect();
    stage(&mut rig, &releases, &releases.release_base("1.2.0"), 2);
    assert_eq!(why(&rig), Some(Code::BaseTooSoon));
}
