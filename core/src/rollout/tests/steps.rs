//! Every step of a robot beside every state that it may report: what follows, and that each has a way to an end.

use super::*;
use crate::rollout::robots::{due, machine};

/// A rig with roll-out `ro` applying wave 0 and robot 0 made to stand at `step` in it.
fn at(rig: &mut Rig, step: Step) -> RolloutRobot {
    let n = rig.order()[0];
    let mut r = rig.robot_in("ro", n);
    r.step = step;
    r.since = rig.now.utc;
    r.attempted = step.is_active() || matches!(step, Step::Committed | Step::RolledBack);
    r.grant = None;
    r
}

fn applying() -> (Rig, Rollout) {
    let mut rig = Rig::new(6);
    rig.fleet_sleeps = true;
    rig.start(spec());
    rig.until(5, |r| r.phase() == Phase::Applying);
    rig.pass(0);
    let rollout = rig.rollout("ro");
    (rig, rollout)
}

fn reported(rig: &Rig, r: &RolloutRobot, state: Option<UpdateState>) -> Board {
    let mut board = rig.board.clone();
    let live = board.get_mut(&r.robot_id).expect("it is heard");
    let report = state.map(|state| fresh_report(state, &bundle_id(2), r.directive_generation));
    Arc::make_mut(live).report.update = report;
    board
}

/// What is due in short; each such move stands in the table.
fn name_of_move(rig: &Rig, board: &Board, rollout: &Rollout, r: &RolloutRobot) -> String {
    let Some(due) = due::decide_move(&rig.ota, board, &rig.now, rollout, r) else { return "-".to_owned() };
    assert!(machine::next(r.step, &due).is_some(), "{due:?} at {:?}", r.step);
    format!("{due:?}").split(['(', ' ', '{']).next().unwrap_or_default().to_owned()
}

#[test]
fn every_step_and_every_report_has_the_move_that_the_table_says() {
    let (mut rig, rollout) = applying();
    let mut table = String::new();
    for step in Step::ALL {
        let r = at(&mut rig, step);
        let states = UpdateState::ALL.into_iter().map(Some).chain([None]);
        let moves: Vec<String> = states
            .map(|state| {
                let board = reported(&rig, &r, state);
                name_of_move(&rig, &board, &rollout, &r)
            })
            .collect();
        table += &format!("{step:?}: {}\n", moves.join(" "));
    }
    // Directed Downloading Staged Switching Probation Trial Committing RollingBack Committed RolledBack Refused Stuck
    // none
    let expected = "\
Waiting: Stage Stage Stage Stage Stage Stage Stage Stage Stage Stage Stage Stage Stage
Staging: - - IsStaged IsStaged IsStaged IsStaged IsStaged IsStaged IsStaged IsStaged Skip IsStaged IsStaged
Staged: - - AskDrain AskDrain AskDrain AskDrain AskDrain AskDrain AskDrain AskDrain Skip AskDrain AskDrain
Draining: - - - - - - - - - - - - -
Activating: - - - - Switched OnTrial OnTrial Switched OnTrial RolledBack Skip Stuck -
Trial: - - - - - - - - - RolledBack - Stuck -
Committing: - - - - - - - - Committed RolledBack - Stuck -
Reverting: Revert Revert Revert Revert Revert Revert Revert Revert Revert RolledBack Revert Stuck Revert
Committed: - - - - - - - - - - - - -
RolledBack: - - - - - - - - - - - - -
Skipped: - - - - - - - - - - - - -
Stuck: - - - - - - - - - RolledBack - - -
";
    assert_eq!(table, expected);
}

#[test]
fn a_robot_that_refuses_after_it_was_given_permission_is_over_and_its_drain_is_released_as_reported() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Dawdles;
    rig.until(20, |r| r.robot_in("ro", n).grant.is_some());
    rig.report(n, UpdateState::Refused);
    rig.tick();
    assert_eq!(rig.step(n), Step::Skipped);
    assert_eq!(rig.releases(), [ReleasedBy::Reported]);
}

#[test]
fn whoever_is_retired_is_waited_for_at_no_step() {
    let (mut rig, rollout) = applying();
    let n = rig.order()[0];
    rig.retire(n);
    rig.ota_turn();
    for step in Step::ALL {
        let r = at(&mut rig, step);
        for state in UpdateState::ALL.into_iter().map(Some).chain([None]) {
            let due = name_of_move(&rig, &reported(&rig, &r, state), &rollout, &r);
            assert_eq!(due == "Skip", !step.is_over(), "{step:?} {state:?}");
        }
    }
}

#[test]
fn after_an_abort_no_step_but_a_stuck_one_keeps_the_bundle_whatever_is_reported() {
    let (mut rig, _) = applying();
    rig.must("ro", Verb::Abort);
    let rollout = rig.rollout("ro");
    for step in Step::ALL {
        let mut r = at(&mut rig, step);
        r.drain_id = None;
        for state in UpdateState::ALL.into_iter().map(Some).chain([None]) {
            let due = name_of_move(&rig, &reported(&rig, &r, state), &rollout, &r);
            let ok = match step {
                Step::Waiting | Step::Staging | Step::Staged => due == "Skip",
                Step::Draining => due == "-",
                Step::Activating => {
                    ["LeaveDrain", "Switched", "OnTrial", "RolledBack", "Stuck", "Skip"].contains(&due.as_str())
                }
                Step::Trial | Step::Reverting | Step::Committed => {
                    ["Revert", "RolledBack", "Stuck"].contains(&due.as_str())
                }
                Step::Committing => ["Revert", "Committed"].contains(&due.as_str()),
                Step::RolledBack | Step::Skipped => ["-", "Forget"].contains(&due.as_str()),
                Step::Stuck => ["-", "RolledBack"].contains(&due.as_str()),
            };
            assert!(ok, "{step:?} {state:?}: {due}");
        }
    }
}

#[test]
fn whoever_waits_for_a_wave_is_told_which_robots_of_it_are_not_decided() {
    let (rig, rollout) = applying();
    let order = rig.order();
    let r = rig.robot_in("ro", order[2]);
    let by = crate::rollout::explain::blocked(&rig.ota, &rig.board, &rig.now, &rollout, &r).expect("it waits").by;
    let named = by.metadata.get("robot_ids").map(String::as_str);
    assert_eq!((by.code, named), (Code::BlockedByWave, Some(robot_id(order[0]).as_str())));
}

#[test]
fn each_waiting_robot_has_one_reason_and_who_is_done_has_none() {
    let (mut rig, rollout) = applying();
    for step in Step::ALL {
        let r = at(&mut rig, step);
        let board = reported(&rig, &r, None);
        let blocked = crate::rollout::explain::blocked(&rig.ota, &board, &rig.now, &rollout, &r);
        assert_eq!(blocked.is_none(), step.is_over(), "{step:?}");
        if let Some(blocked) = blocked {
            assert!(!blocked.by.code.next_step().is_empty(), "{step:?}: what a person can do");
        }
    }
}
