//! Back from software: what was put away, what was stopped on its way, and which orders lead back from a committed set.

use crate::bases::{a_day_passes, migrations};
use crate::release::Releases;
use crate::rig::action;
use crate::updates::{
    Order, activate, committed, connected, maintain, name_of, on_trial, refused, relaunch, report, stage, state,
    switch, want, why,
};
use midshift_agent::body::BodyNews;
use midshift_agent::core::ExitReason;
use midshift_bundle::manifest::Migration;
use midshift_core::reason::Code;
use midshift_core::robot::HardwareStop;
use midshift_core::step::Effect;
use midshift_core::update::{Goal, UpdateState};

#[test]
fn what_the_launcher_put_away_is_told_and_not_tried_again() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut order = stage(&mut rig, &releases, &bundle, 1);
    activate(&mut rig, &mut order, "drain-1");
    let sets = rig.updates.as_ref().expect("has them").sets.clone();
    sets.fall_back(2);
    let mut rig = relaunch(rig);
    let told = report(&rig).expect("a report");
    assert_eq!((told.state, told.tries), (UpdateState::RolledBack, 2));
    assert_eq!(told.reason.map(|r| r.code), Some(Code::ProgramCrashed));
    want(&mut rig, order.to(Goal::Stage));
    rig.pass(60_000);
    assert_eq!(state(&rig), Some(UpdateState::RolledBack), "the same directive is over");
}

#[test]
fn a_set_that_was_put_away_while_it_was_being_committed_is_fallen_and_moves_no_floor_and_no_data() {
    let (rig, releases) = connected();
    let bundle = releases.release_as("1.1.0", |m| {
        m.components[0].rollback_index = 3;
        m.components[0].data_migration = Migration::Reversible;
    });
    let (rig, mut order) = on_trial(rig, &releases, &bundle, 1);
    // The power went before the switch record was written, and the launcher put the set away.
    let mut software = rig.store.memory().expect("loaded").ledger.software;
    software.update.as_mut().expect("an update").state = UpdateState::Committing;
    rig.store.commit_now(&[midshift_agent::store::Op::Software(Box::new(software))]);
    rig.updates.as_ref().expect("has them").sets.fall_back(2);
    let mut rig = rig.restart();
    rig.connect();
    want(&mut rig, order.to(Goal::Commit));
    rig.pass(5_000);
    let told = report(&rig).expect("a report");
    let why = told.reason.map(|reason| reason.code);
    assert_eq!((told.state, told.tries, why), (UpdateState::RolledBack, 2, Some(Code::ProgramCrashed)));
    let software = rig.store.memory().expect("loaded").ledger.software;
    assert_eq!((software.floors.len(), software.due.len(), software.committed_at), (0, 0, None));
    assert_eq!((migrations(&rig), switch(&rig).running()), (vec![], "factory"));
}

#[test]
fn a_stopped_robot_goes_back_where_it_stands_and_nothing_moves() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let (mut rig, mut order) = on_trial(rig, &releases, &bundle, 1);
    maintain(&mut rig, None);
    rig.work(rig.desired(Some(rig.offer("T1", 1, vec![action("pick", Effect::Repeatable)], vec![]))));
    assert!(rig.body.log().acting.is_some());
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::RollingBack), None), "it works");
    rig.body.set(|b| b.acting = None);
    rig.body.says(BodyNews::HardwareStop(HardwareStop::Manual));
    rig.pass(1_000);
    let acts = rig.body.log().acts;
    let mut rig = relaunch(rig);
    rig.pass(5_000);
    assert_eq!((state(&rig), rig.body.log().acts), (Some(UpdateState::RolledBack), acts));
    assert_eq!(switch(&rig).running(), "factory");
}

#[test]
fn a_kept_set_that_has_rotted_is_not_gone_back_to_and_a_person_is_asked() {
    let (rig, releases) = connected();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let rig = committed(rig, &releases, &first, 1);
    let (mut rig, mut order) = on_trial(rig, &releases, &second, 2);
    let sets = rig.updates.as_ref().expect("has them").sets.clone();
    sets.rot(&first.manifest.components[0].digest);
    let running = switch(&rig).running().to_owned();
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Stuck), Some(Code::KeptSetBad)));
    assert_eq!((switch(&rig).running(), rig.exit), (running.as_str(), None));
}

#[test]
fn a_committed_set_is_reverted_to_the_one_before_it_unless_its_data_cannot_go_back() {
    let (rig, releases) = connected();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let rig = committed(rig, &releases, &first, 1);
    let kept = name_of(&rig);
    let mut rig = committed(rig, &releases, &second, 2);
    let mut order = Order::new(releases.directive(&second, 2));
    order.generation = 100_000;
    want(&mut rig, order.to(Goal::Revert));
    let rig = relaunch(rig);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), kept.as_str()));
    let third = releases.release_as("1.3.0", |m| m.components[1].data_migration = Migration::Irreversible);
    let mut rig = committed(rig, &releases, &third, 2_000);
    let mut order = Order::new(releases.directive(&third, 2_000));
    order.generation = 300_000;
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Committed), None));
}

#[test]
fn a_committed_set_is_left_by_a_directive_of_its_own_after_something_else_was_tried_and_left() {
    let (rig, releases) = connected();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let rig = committed(rig, &releases, &first, 1);
    let kept = name_of(&rig);
    let (mut rig, mut order) = on_trial(rig, &releases, &second, 2);
    want(&mut rig, order.to(Goal::Revert));
    let mut rig = relaunch(rig);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), kept.as_str()));
    let mut order = Order::new(releases.directive(&first, 3));
    order.generation = 100_000;
    want(&mut rig, order.to(Goal::Revert));
    let rig = relaunch(rig);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), "factory"));
    let told = report(&rig).map(|r| (r.bundle.to_string(), r.directive_generation));
    assert_eq!(told, Some((first.digest.to_string(), 3)));
}

#[test]
fn a_directive_that_was_refused_or_is_about_another_bundle_leads_nobody_back_from_a_good_set() {
    let (rig, releases) = connected();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let mut rig = committed(rig, &releases, &first, 1);
    let kept = name_of(&rig);
    let stranger = Releases::new().release("6.6.6");
    let mut order = Order::new(releases.directive(&stranger, 2));
    order.generation = 100_000;
    want(&mut rig, order.to(Goal::Stage));
    assert_eq!(refused(&rig).len(), 1);
    want(&mut rig, order.to(Goal::Revert));
    let mut order = Order::new(releases.directive(&second, 3));
    order.generation = 200_000;
    want(&mut rig, order.to(Goal::Revert));
    rig.pass(5_000);
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Committed), None));
    assert_eq!((switch(&rig).running(), switch(&rig).kept()), (kept.as_str(), Some("factory")));
}

#[test]
fn a_trial_that_the_ledger_knows_nothing_of_is_ended() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let (rig, _) = on_trial(rig, &releases, &bundle, 1);
    rig.store.commit_now(&[midshift_agent::store::Op::Software(Box::default())]);
    let rig = rig.restart();
    assert_eq!(switch(&rig).running(), "factory");
    assert_eq!(rig.exit, Some(ExitReason::Switched), "the program that runs is not the one of the record");
}

#[test]
fn a_robot_that_gave_up_the_set_before_says_once_that_there_is_no_way_back() {
    let (rig, releases) = connected();
    let first = releases.release_base("1.1.0");
    let mut rig = committed(rig, &releases, &first, 1);
    a_day_passes(&mut rig, &releases);
    let (mut rig, mut order) = on_trial(rig, &releases, &releases.release_base("1.2.0"), 2);
    want(&mut rig, order.to(Goal::Revert));
    let mut rig = relaunch(rig);
    rig.pass(1_000);
    assert_eq!((state(&rig), switch(&rig).kept()), (Some(UpdateState::RolledBack), None), "its slot was taken");
    let before = refused(&rig).len();
    let mut back = Order::new(releases.directive(&first, 3));
    back.generation = 10_000;
    want(&mut rig, back.to(Goal::Revert));
    rig.pass(10_000);
    assert_eq!(refused(&rig)[before..], [Code::NothingKept]);
    assert_eq!(state(&rig), Some(UpdateState::RolledBack), "it runs what it ran");
}
