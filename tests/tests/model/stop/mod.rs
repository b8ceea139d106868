//! The stop latch of the service and of robots, looked at in every order in which things can happen: here the law that runs is called in each step, and
//! for each rule left out there is a shortest way to break one.

mod laws;
mod parties;

use super::laws::{assert_way, ends_everywhere};
use laws::is_end;
use midshift_core::stop::ladder::Around;
use parties::{Action, Naive, Parties};
use stateright::{Checker, Model};

/// One robot among people, two stops; its program ends once, and it hears nothing once.
const ONE: Parties =
    Parties { around: &[Around::People], stops: &[None, Some(0)], kills: 0, restarts: 1, silences: 1, naive: None };
/// The same, and the service is killed instead.
const KILLED: Parties = Parties { kills: 1, silences: 0, ..ONE };
/// Two robots, one of them among people, one stop for both; the service is killed.
const TWO: Parties = Parties {
    around: &[Around::People, Around::Robots],
    stops: &[None],
    kills: 1,
    restarts: 0,
    silences: 0,
    naive: None,
};

/// One robot, one stop, a killed service.
const SOLO: Parties = Parties { stops: &[None], ..KILLED };

#[expect(clippy::print_stdout, reason = "how much was looked at belongs to the result")]
fn assert_holds(name: &str, parties: Parties) {
    let checker = parties.checker().spawn_bfs().join();
    checker.assert_properties();
    let states = checker.unique_state_count();
    println!("{name}: {states} states, at most {} steps from the first", checker.max_depth());
    assert!(states > 1_000, "{name}: nothing happened in {states} states");
    let ends = ends_everywhere(&parties, |state| is_end(&parties, state));
    assert_eq!(ends, states, "{name}: states from which everybody can move again");
}

#[test]
fn a_robot_that_begins_again_and_hears_nothing_for_a_while_keeps_every_law() {
    assert_holds("one robot among people, two stops", ONE);
}

#[test]
fn a_service_that_is_killed_loses_no_stop_that_it_answered_for_and_takes_the_others_back() {
    assert_holds("one robot, two stops, a killed service", KILLED);
}

#[test]
fn two_robots_and_a_killed_service_come_to_the_same_stops() {
    assert_holds("two robots, a stop, a killed service", TWO);
}

/// The shortest way in which the parties without one rule break a law: so many steps, these among them in this order.
fn assert_breaks(parties: Parties, naive: Naive, law: &'static str, steps: usize, among: &[Action]) {
    assert_way(Parties { naive: Some(naive), ..parties }, &naive, law, steps, among);
}

const KILL: Action = Action::Kill { written: false };

#[test]
fn a_reset_that_clears_all_takes_away_a_stop_that_nobody_reset() {
    assert_breaks(ONE, Naive::ResetClearsAll, laws::UNION, 4, &[Action::Write]);
    // And robots move under it.
    let among = [Action::Engage(0), Action::Reset(1), Action::HearReset { robot: 0, stop: 1 }];
    assert_breaks(ONE, Naive::ResetClearsAll, laws::NOT_FREED, 10, &among);
}

#[test]
fn a_reset_alone_lets_no_robot_go() {
    let hears = Action::HearReset { robot: 0, stop: 0 };
    let among = [Action::Engage(0), Action::Reset(0), Action::Write, hears];
    assert_breaks(SOLO, Naive::ResetResumes, laws::NOT_FREED, 7, &among);
}

#[test]
fn a_stop_that_is_answered_for_before_it_is_written_is_lost_with_the_service() {
    assert_breaks(SOLO, Naive::AnsweredBeforeWritten, laws::NOT_LOST, 2, &[Action::Engage(0), KILL]);
}

#[test]
fn a_reset_that_is_told_before_it_is_written_leaves_robots_moving_under_a_stop() {
    let among = [Action::Engage(0), Action::Write, Action::Reset(0), KILL, Action::Answered(0)];
    assert_breaks(SOLO, Naive::ResetToldBeforeWritten, laws::OBEYS, 9, &among);
}

#[test]
fn a_robot_that_is_fed_while_it_is_behind_goes_on_under_a_stop_that_did_not_come() {
    let among = [Action::LineUp(0), Action::Engage(0), Action::Answered(0)];
    assert_breaks(SOLO, Naive::FedWhileBehind, laws::OBEYS, 4, &among);
}

#[test]
fn what_is_not_taken_back_from_a_robot_is_a_stop_that_nobody_else_obeys() {
    let among = [Action::Engage(0), Action::Synced(0), KILL, Action::LineUp(0)];
    assert_breaks(SOLO, Naive::NothingTakenBack, laws::AGREE, 6, &among);
}

#[test]
fn a_silence_among_people_that_ends_itself_lets_a_robot_go_that_nobody_looked_at() {
    let among = [Action::Answered(0), Action::Silence(0), Action::Answered(0)];
    assert_breaks(ONE, Naive::SilenceEndsItself, laws::NOT_FREED, 5, &among);
}

#[test]
fn a_robot_that_keeps_nothing_moves_after_a_start_before_it_was_resumed() {
    let among = [Action::Silence(0), Action::Restart(0), Action::Answered(0)];
    assert_breaks(ONE, Naive::NothingKept, laws::NOT_FREED, 8, &among);
}
