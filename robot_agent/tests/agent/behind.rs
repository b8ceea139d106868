//! A switch record that is older than the ledger, as when a card was put back: what was committed stays so, and nothing
//! is told that is not.

use crate::rig::Rig;
use crate::updates::{Order, connected, name_of, on_trial, state, switch, want};
use midshift_agent::core::ExitReason;
use midshift_agent::sets::Sets;
use midshift_agent::switch::{FACTORY, Switch};
use midshift_core::update::{Goal, UpdateState};

/// A robot that has committed a set, and the switch record of its trial.
fn committed_after() -> (Rig, Order, Switch) {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let (mut rig, mut order) = on_trial(rig, &releases, &bundle, 1);
    let older = switch(&rig);
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!(state(&rig), Some(UpdateState::Committed));
    (rig, order, older)
}

/// Puts a switch record there and starts the robot.
fn restart_with(rig: Rig, mut record: Switch) -> Rig {
    let mut sets = rig.updates.as_ref().expect("has them").sets.clone();
    sets.write_switch(&mut record).expect("writes");
    let mut rig = rig.restart();
    rig.connect();
    rig.pass(5_000);
    rig
}

#[test]
fn a_committed_set_that_an_older_switch_record_has_on_trial_is_committed_there_and_not_gone_back_from() {
    let (rig, _, older) = committed_after();
    let (name, trial) = (name_of(&rig), older.trial.clone());
    assert_eq!(trial.map(|trial| trial.set), Some(name.clone()));
    let rig = restart_with(rig, older);
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Committed), None::<ExitReason>));
    let after = switch(&rig);
    assert_eq!((after.current, after.previous, after.trial), (name, Some(FACTORY.to_owned()), None));
}

#[test]
fn a_committed_set_that_an_older_switch_record_let_the_launcher_put_away_is_started_again() {
    let (rig, _, mut older) = committed_after();
    let name = name_of(&rig);
    older.fall_back(2);
    let rig = restart_with(rig, older);
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Committed), Some(ExitReason::Switched)));
    assert_eq!(switch(&rig).running(), name, "floors have risen with it: nothing below them runs");
}
