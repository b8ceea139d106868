//! Robots that stand with their work: on trial that counts against the bundle, unless the others stand too.

use super::*;
use crate::ids::{AttemptId, Subject};
use crate::robot::WorkState;
use crate::robot::{ReportedAttempt, StopLevel};

/// The robot has work, and has not got on with it since the rig began, or gets on with it now.
fn has_work(rig: &mut Rig, n: usize, gets_on: bool) {
    let attempt = AttemptId { subject: Subject::parse(&format!("T{n}")).expect("an id"), epoch: 1 };
    let (state, progress_at) = (WorkState::Navigating, if gets_on { rig.now.site } else { SiteTime(0) });
    let listed = ReportedAttempt { attempt, state, step_index: 0, progress: 0, route_index: 0, opened: false };
    let live = Arc::make_mut(rig.board.get_mut(&robot_id(n)).expect("it is heard"));
    (live.report.attempts, live.progress_at) = (vec![listed], progress_at);
}

/// One canary on trial that stands with its work, held by a stop or waiting for a place or neither, and five others
/// with work, of which so many get on, for as long as a jam takes.
fn stands(others_get_on: usize, held: bool, waits: bool) -> (Rig, usize) {
    let mut rig = Rig::new(6);
    rig.works = false;
    rig.checks_rebuild = false;
    rig.start(RolloutSpec { soak_ms: 3_600_000, ..spec() });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    let order = rig.order();
    for _ in 0..31 {
        rig.pass(10_000);
        for (place, n) in order.iter().enumerate() {
            has_work(&mut rig, *n, place > 0 && place <= others_get_on);
        }
        if waits {
            let now = rig.now.utc;
            rig.control(order[0], |control| control.waited_for_place = Some(now));
        }
        if held {
            let live = rig.board.get_mut(&robot_id(order[0])).expect("it is heard");
            Arc::make_mut(live).report.stop_level = StopLevel::Halt;
        }
        rig.turn();
    }
    (rig, order[0])
}

#[test]
fn a_canary_that_stands_with_its_work_while_others_get_on_fails_its_trial() {
    let (rig, n) = stands(5, false, false);
    assert_eq!(rig.robot_in("ro", n).failure.map(|f| f.code), Some(Code::JammedOnTrial));
    assert!(rig.rollout("ro").abort.is_some_and(|abort| abort.reason.code == Code::FailureAmongFew));
}

#[test]
fn where_the_others_stand_too_or_a_stop_or_a_place_holds_it_nothing_is_held_against_the_bundle() {
    for (others_get_on, held, waits) in [(3, false, false), (0, false, false), (5, true, false), (5, false, true)] {
        let (rig, n) = stands(others_get_on, held, waits);
        assert_eq!(rig.robot_in("ro", n).failure, None, "{others_get_on} {held} {waits}");
    }
}
