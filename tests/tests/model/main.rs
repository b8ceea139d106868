//! Drain, grant and release of robots that change their software, looked at in every order in which things can happen (a model checked
//! with stateright, not the code that runs): each law holds in every state, and for each rule left out there is a shortest way to break one.
//! The stop latch is beside it.

mod laws;
mod protocol;
mod stop;

use laws::{assert_way, ends_everywhere, is_end};
use protocol::{Action, Decision, Naive, Protocol};
use stateright::{Checker, Model};

/// One robot, two roll-outs one right after the other, and a pause.
const TWO_ROLL_OUTS: Protocol = Protocol {
    robots: 1,
    rollouts: 2,
    planners: 1,
    wave: 1,
    tasks: true,
    pauses: 1,
    cuts: 0,
    kills: 0,
    held: 2,
    naive: None,
};
/// The same with a cut session instead.
const CUT: Protocol = Protocol { pauses: 0, cuts: 1, held: 1, ..TWO_ROLL_OUTS };
/// Two planners race for one robot, whose session is cut, and the server is killed.
const RACE: Protocol = Protocol { rollouts: 1, planners: 2, cuts: 1, kills: 1, ..TWO_ROLL_OUTS };
/// Two planners race for two robots of which one may be out of work.
const WAVE: Protocol =
    Protocol { robots: 2, rollouts: 1, planners: 2, tasks: false, pauses: 0, held: 1, ..TWO_ROLL_OUTS };

#[expect(clippy::print_stdout, reason = "how much was looked at belongs to the result")]
fn assert_holds(name: &str, protocol: Protocol) {
    let checker = protocol.checker().spawn_bfs().join();
    checker.assert_properties();
    let states = checker.unique_state_count();
    println!("{name}: {states} states, at most {} steps from the first", checker.max_depth());
    assert!(states > 10_000, "{name}: nothing happened in {states} states");
    assert_eq!(ends_everywhere(&protocol, is_end), states, "{name}: states from which every drain can end");
}

#[test]
fn a_robot_in_two_roll_outs_keeps_every_law_and_every_drain_can_end() {
    assert_holds("one robot, two roll-outs, a pause", TWO_ROLL_OUTS);
}

#[test]
fn a_cut_session_between_two_roll_outs_breaks_no_law() {
    assert_holds("one robot, two roll-outs, a cut session", CUT);
}

#[test]
fn two_planners_and_a_killed_server_break_no_law() {
    assert_holds("one robot, two planners, a pause, a cut session, a killed server", RACE);
}

#[test]
fn two_planners_never_take_more_robots_than_the_wave_allows() {
    assert_holds("two robots, two planners", WAVE);
}

/// The shortest way in which a protocol without one rule breaks a law: so many steps, these among them in this order.
fn assert_breaks(protocol: Protocol, naive: Naive, law: &'static str, steps: usize, among: &[Action]) {
    assert_way(Protocol { naive: Some(naive), ..protocol }, &naive, law, steps, among);
}

const REQUEST: Decision = Decision::Request { robot: 0, rollout: 0 };
const GRANT: Decision = Decision::Grant { robot: 0, rollout: 0 };
const RELEASE: Decision = Decision::Release { robot: 0, rollout: 0 };
const LIFE_PASSES: Action = Action::LifePasses { robot: 0, rollout: 0 };
const FREE: Action = Action::Free { robot: 0, rollout: 0 };

#[test]
fn ids_used_again_let_the_next_roll_out_switch_a_robot_in_the_drain_of_the_last() {
    let next = Decision::Grant { robot: 0, rollout: 1 };
    let among = [Action::Write(REQUEST), Action::Abort(0), Action::Write(next), Action::Activate(0)];
    assert_breaks(TWO_ROLL_OUTS, Naive::DrainIdsUsedAgain, laws::OWN_DRAIN, 14, &among);
    // And the release of the last drain gives it away in the middle of the switch.
    let among = [Action::Write(next), Action::Activate(0)];
    assert_breaks(TWO_ROLL_OUTS, Naive::DrainIdsUsedAgain, laws::ONE_HOLDER, 17, &among);
}

#[test]
fn release_by_time_frees_a_robot_that_switched_and_whose_report_is_lost() {
    let among = [Action::Activate(0), LIFE_PASSES, LIFE_PASSES, Action::Write(RELEASE), FREE];
    assert_breaks(TWO_ROLL_OUTS, Naive::ReleasedByTime, laws::ONE_HOLDER, 15, &among);
}

#[test]
fn a_heartbeat_from_before_the_grant_ended_does_not_prove_that_it_was_not_used() {
    let arrives = Action::HeartbeatArrives { robot: 0, place: 0 };
    let among = [arrives, Action::Activate(0), LIFE_PASSES, Action::Write(RELEASE), FREE];
    assert_breaks(TWO_ROLL_OUTS, Naive::OldHeartbeatBelieved, laws::ONE_HOLDER, 15, &among);
}

#[test]
fn two_planners_without_compare_and_set_take_both_robots_and_release_what_they_grant() {
    let other = Decision::Request { robot: 1, rollout: 0 };
    let both = [Action::Decide(other), Action::Write(other)];
    assert_breaks(WAVE, Naive::NoCompareAndSet, laws::IN_FLIGHT, 4, &both);
    let skewed = [Action::Decide(GRANT), Action::Write(GRANT), Action::Activate(0)];
    assert_breaks(RACE, Naive::NoCompareAndSet, laws::ONE_HOLDER, 13, &skewed);
    let stale = [Action::Decide(GRANT), Action::Write(GRANT)];
    assert_breaks(RACE, Naive::NoCompareAndSet, laws::NO_GRANT, 9, &stale);
}

#[test]
fn a_grant_without_a_life_is_used_long_after_the_pause_that_it_was_in_flight_across() {
    let among = [Action::Write(GRANT), LIFE_PASSES, LIFE_PASSES, Action::Activate(0)];
    assert_breaks(TWO_ROLL_OUTS, Naive::GrantWithoutLife, laws::NOT_LATE, 13, &among);
}

#[test]
fn a_pause_taken_for_immediate_gives_away_a_robot_whose_grant_is_on_its_way() {
    let among = [Action::Write(GRANT), Action::Write(RELEASE), FREE];
    assert_breaks(TWO_ROLL_OUTS, Naive::PauseTakenForImmediate, laws::ONE_HOLDER, 14, &among);
    assert_breaks(TWO_ROLL_OUTS, Naive::PauseTakenForImmediate, laws::NOT_FREED, 11, &[Action::Write(GRANT)]);
}

#[test]
fn a_robot_that_has_not_heard_of_its_drain_is_switched_if_nobody_asks_its_ledger() {
    let among = [Action::Write(GRANT), Action::Activate(0)];
    assert_breaks(TWO_ROLL_OUTS, Naive::LedgerNotAsked, laws::OWN_LEDGER, 7, &among);
}
