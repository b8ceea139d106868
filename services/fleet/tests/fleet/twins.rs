//! Why the rules are as they are: each scenario is played with the rule, which holds, and with the naive one, which does not.

use crate::harness::{Answer, World};
use midshift_core::fleet::bugs::{Bugs, SeededBug};
use midshift_core::robot::WorkState;
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::Phase;

async fn world(bugs: &[SeededBug]) -> World {
    let mut w = World::with(CORRIDOR, Bugs::seeded(bugs)).await;
    w.pass(11).await;
    w
}

/// Fleet is restarted while the robot at work is out of reach for ten seconds. Whether another robot was given its task meanwhile.
async fn restarted_while_a_robot_is_out_of_reach(bugs: &[SeededBug]) -> bool {
    let mut w = world(bugs).await;
    w.robot("r1", "park-b").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").drives = false;
    w.robot("r2", "park-a").await;
    w.r("r1").cut();
    w.stop_fleet().await;
    w.pass(5).await;
    w.start_fleet();
    let mut twice = false;
    for _ in 0..20 {
        w.pass(1).await;
        let other = w.seen().await.holder("r2").is_some_and(|a| a.subject.task_id().is_some());
        // The first robot's authority lasts 30 s: it still works on it.
        twice |= other && !w.r("r1").is_idle();
    }
    twice
}

#[tokio::test(start_paused = true)]
async fn a_restart_of_fleet_lets_no_second_robot_hold_a_task_and_a_rule_without_leases_does() {
    assert!(!restarted_while_a_robot_is_out_of_reach(&[]).await);
    assert!(restarted_while_a_robot_is_out_of_reach(&[SeededBug::SilenceFreesTask]).await);
}

/// A robot finishes, restarts with an empty memory, and its heartbeat comes before its completion. What fleet believes of the
/// task before the completion comes.
async fn completed_before_it_was_heard(bugs: &[SeededBug]) -> Phase {
    let mut w = world(bugs).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("all is granted", |s| s.has("r1", "B")).await;
    w.r("r1").tells = false;
    for _ in 0..120 {
        if w.r("r1").is_idle() {
            break;
        }
        w.pass(1).await;
    }
    assert!(w.r("r1").is_idle(), "it is done");
    w.r("r1").forgets_its_work();
    w.beat("r1");
    w.pass(10).await;
    w.r("r1").tells = true;
    let believed = w.seen().await.phase("T1");
    w.until_phase("T1", Phase::Succeeded).await;
    believed
}

#[tokio::test(start_paused = true)]
async fn a_completion_that_comes_after_its_heartbeat_is_taken_and_a_rule_that_believes_the_heartbeat_loses_it() {
    assert_eq!(completed_before_it_was_heard(&[]).await, Phase::Running);
    assert_ne!(completed_before_it_was_heard(&[SeededBug::HeartbeatOvertakesEvents]).await, Phase::Running);
}

/// A robot stands in the corridor and is not heard for two minutes. Whether another was let in.
async fn silent_in_the_corridor(bugs: &[SeededBug]) -> bool {
    let mut w = world(bugs).await;
    w.robot("r1", "A").await;
    w.robot("r2", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| (raw.robot_id, raw.stall_ms) = ("r1".to_owned(), Some(3_600_000))).await;
    w.until("r1 is inside", |s| s.has("r1", "corridor") && !s.has("r1", "A")).await;
    (w.r("r1").drives, w.r("r2").drives) = (false, false);
    w.r("r1").cut();
    w.submit_with("T2", "A", "park-b", |raw| raw.robot_id = "r2".to_owned()).await;
    w.pass(35).await;
    // It drives on; the world itself would object to a second body in the corridor, so it is looked at before that.
    w.r("r2").drives = true;
    for _ in 0..85 {
        if w.seen().await.has("r2", "corridor") {
            return true;
        }
        w.pass(1).await;
    }
    false
}

#[tokio::test(start_paused = true)]
async fn silence_frees_no_place_and_a_rule_that_does_lets_a_second_robot_in() {
    assert!(!silent_in_the_corridor(&[]).await);
    assert!(silent_in_the_corridor(&[SeededBug::TimeoutFreesPlace]).await);
}

/// Two reconcilers plan for the same robots at once. Whether all they wrote keeps the laws.
async fn two_planners(blind: bool) -> bool {
    let mut w = World::with(DEMO, Bugs::seeded(&[SeededBug::EverybodyLeads])).await;
    if blind {
        w.shaky.be_blind();
    }
    w.second_reconciler();
    w.pass(11).await;
    for (n, at) in ["park-1", "park-2", "park-3", "park-4"].iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    let goals = ["D01", "A01", "L1-in", "B03", "P02", "D03", "L2-out", "A02"];
    for n in 0..16 {
        w.submit(&format!("T{n}"), goals[n % 8], goals[(n * 3 + 1) % 8]).await;
    }
    w.pass(20).await;
    assert!(w.shaky.conflicts() + w.shaky.overwritten() > 0, "they raced");
    let written = w.written().await;
    std::panic::catch_unwind(|| crate::harness::hold(&written)).is_ok()
}

#[tokio::test(start_paused = true)]
async fn two_planners_give_no_robot_two_holders_and_a_store_where_the_last_writer_wins_does() {
    assert!(two_planners(false).await);
    assert!(!two_planners(true).await);
}

/// A robot says that it is done with a task that was given to another one since. What the task is then.
async fn told_done_by_the_robot_before(bugs: &[SeededBug]) -> Phase {
    let mut w = world(bugs).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Running).await;
    let old = seen.task("T1").attempt_id().expect("an attempt");
    w.r("r1").forgets_its_work();
    w.r("r2").works = false;
    w.until("another has it", |s| s.phase("T1") == Phase::Running && s.task("T1").epoch == 2).await;
    w.r("r1").reports(old, WorkState::Succeeded);
    w.pass(5).await;
    w.seen().await.phase("T1")
}

#[tokio::test(start_paused = true)]
async fn a_late_completion_ends_nothing_and_where_it_counts_a_task_is_done_that_nobody_did() {
    assert_eq!(told_done_by_the_robot_before(&[]).await, Phase::Running);
    assert_eq!(told_done_by_the_robot_before(&[SeededBug::LateReportsCount]).await, Phase::Succeeded);
}

/// Two robots want the same station. Whether it is ever given to more than it holds.
async fn two_for_one_station(bugs: &[SeededBug]) -> bool {
    let mut w = world(bugs).await;
    w.robot("r1", "wait-a").await;
    w.robot("r2", "wait-a").await;
    // Nobody drives: what is looked at is what is given.
    for robot in ["r1", "r2"] {
        w.r(robot).drives = false;
        w.submit_with(&format!("T-{robot}"), "A", "B", |raw| raw.robot_id = robot.to_owned()).await;
    }
    w.pass(20).await;
    let station = w.seen().await.place("A");
    assert!(!station.holders.is_empty(), "it is given");
    station.holders.len() > station.capacity as usize
}

#[tokio::test(start_paused = true)]
async fn a_place_is_given_to_as_many_as_it_holds_and_a_rule_that_forgets_that_gives_it_twice() {
    assert!(!two_for_one_station(&[]).await);
    assert!(two_for_one_station(&[SeededBug::CapacityIsForgotten]).await);
}

/// A robot wants through the corridor to the station of one that wants through it the other way, and that waits behind two that do. Whether
/// one of these two gets away within half an hour.
async fn one_against_three(bugs: &[SeededBug]) -> bool {
    let mut w = world(bugs).await;
    // Nobody has another place to go to.
    let stand = [("r1", "wait-a"), ("r2", "wait-b"), ("r3", "wait-b"), ("r4", "B"), ("r5", "park-a"), ("r6", "park-b")];
    for (robot, at) in stand {
        w.robot(robot, at).await;
    }
    let lasts = Some(24 * 3_600_000);
    for (robot, from, to) in [("r1", "B", "A"), ("r2", "A", "B"), ("r3", "A", "B"), ("r4", "A", "B")] {
        w.submit_with(robot, from, to, |raw| {
            (raw.robot_id, raw.stall_ms, raw.timeout_ms) = (robot.to_owned(), lasts, lasts);
        })
        .await;
        w.pass(3).await;
    }
    for _ in 0..180 {
        w.pass(10).await;
        let seen = w.seen().await;
        if ["r2", "r3"].iter().any(|robot| !seen.has(robot, "wait-b")) {
            return true;
        }
    }
    false
}

#[tokio::test(start_paused = true)]
async fn a_stretch_is_granted_whole_and_where_places_are_granted_one_by_one_robots_wait_for_each_other_for_ever() {
    assert!(one_against_three(&[]).await);
    assert!(!one_against_three(&[SeededBug::GrantsOneByOne]).await);
}

/// Whether a task of the lowest class comes first at last though a more urgent one comes every ten minutes and goes first.
async fn comes_first_at_last(bugs: &[SeededBug]) -> bool {
    let mut w = world(bugs).await;
    w.submit_with("old", "A", "B", |raw| raw.priority = Some(9)).await;
    for n in 0..12 {
        w.submit_with(&format!("new-{n}"), "A", "B", |raw| raw.priority = Some(2)).await;
        w.pass(600).await;
        let first = w.fleet.query_projection(|view, _, _| view.queue.ready().next().cloned()).await;
        let first = first.expect("an answer").expect("a task that is ready");
        if first.as_str() == "old" {
            return true;
        }
        w.cancel(first.as_str(), false).await;
    }
    false
}

#[tokio::test(start_paused = true)]
async fn nobody_starves_behind_more_urgent_work_and_without_promotion_somebody_does() {
    assert!(comes_first_at_last(&[]).await);
    assert!(!comes_first_at_last(&[SeededBug::NobodyIsPromoted]).await);
}

/// A robot says of its attempt, in the word of a newer version, a state that this build does not know. Whether a person is told.
async fn said_in_a_newer_word(bugs: &[SeededBug]) -> bool {
    let mut w = world(bugs).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Running).await;
    let attempt = seen.task("T1").attempt_id().expect("an attempt");
    w.r("r1").reports(attempt, WorkState::Unknown(99));
    w.pass(5).await;
    !w.seen().await.open_incidents("REPORT_IMPLAUSIBLE").is_empty()
}

#[tokio::test(start_paused = true)]
async fn a_state_of_a_newer_version_is_told_to_a_person_and_a_rule_that_takes_it_acts_upon_it() {
    assert!(said_in_a_newer_word(&[]).await);
    assert!(!said_in_a_newer_word(&[SeededBug::UnknownStatesAreTaken]).await);
}

/// A robot that never left its place says that it is done. What the task is then.
async fn told_done_by_a_robot_that_never_left(bugs: &[SeededBug]) -> Phase {
    let mut w = world(bugs).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::LetGo(WorkState::Succeeded);
    w.submit("T1", "A", "B").await;
    w.pass(5).await;
    w.seen().await.phase("T1")
}

#[tokio::test(start_paused = true)]
async fn a_success_from_elsewhere_is_asked_about_and_where_it_is_believed_a_task_is_done_that_nobody_did() {
    assert_eq!(told_done_by_a_robot_that_never_left(&[]).await, Phase::NeedsOperator);
    assert_eq!(told_done_by_a_robot_that_never_left(&[SeededBug::SuccessIsBelieved]).await, Phase::Succeeded);
}
