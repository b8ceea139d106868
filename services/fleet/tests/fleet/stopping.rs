//! Cancel and what it waits for.

use crate::harness::{Answer, World};
use midshift_core::fleet::rows::HolderState;
use midshift_core::ids::TaskId;
use midshift_core::reason::Code;
use midshift_core::robot::WorkState;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{AfterStopping, Ask, AttemptPhase, Phase, Resolution};

#[tokio::test(start_paused = true)]
async fn a_waiting_task_is_canceled_at_once() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("T1", "A", "B").await;
    w.cancel("T1", false).await;
    let seen = w.until_phase("T1", Phase::Canceled).await;
    assert_eq!((seen.reason("T1"), seen.task("T1").epoch), (Some(Code::CanceledByPerson), 0));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_running_task_is_canceled_only_when_the_robot_has_stopped() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").confirms = false;
    w.cancel("T1", false).await;
    let seen = w.until_phase("T1", Phase::Stopping).await;
    assert_eq!(
        (seen.task("T1").then, seen.work("r1").assignment.map(|a| a.stop)),
        (Some(AfterStopping::Canceled), Some(true))
    );
    w.pass_while(10, "the robot is kept", |s| s.phase("T1") == Phase::Stopping && !s.is_free("r1")).await;
    let attempt = w.seen().await.task("T1").attempt_id().expect("an attempt");
    w.r("r1").reports(attempt, WorkState::Aborted);
    let seen = w.until_phase("T1", Phase::Canceled).await;
    assert_eq!(seen.attempt("T1").phase, AttemptPhase::Aborted);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_completion_that_arrives_while_it_stops_wins_over_the_wish() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").confirms = false;
    w.submit("T1", "A", "B").await;
    w.until("the item is at B", |s| s.has("r1", "B")).await;
    w.cancel("T1", false).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_cancel_nobody_confirms_asks_a_person_and_closes_the_places_until_the_robot_reports() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.r("r1").cut();
    w.cancel("T1", false).await;
    w.until_phase("T1", Phase::Stopping).await;
    w.pass_while(14, "a robot has 15 s", |s| s.phase("T1") == Phase::Stopping).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!((seen.reason("T1"), seen.attempt("T1").phase), (Some(Code::StopNotConfirmed), AttemptPhase::Lost));
    assert!(seen.place("A").quarantine.is_some() && seen.has("r1", "A"));
    w.pass_while(600, "never freed by time", |s| s.place("A").quarantine.is_some() && !s.is_free("r1")).await;
    w.r("r1").mend();
    w.connect("r1").await;
    w.until("the robot has reported", |s| s.place("A").quarantine.is_none() && s.is_free("r1")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_forced_cancel_ends_the_record_and_keeps_the_robot_until_it_reports() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.r("r1").confirms = false;
    w.cancel("T1", true).await;
    let seen = w.until_phase("T1", Phase::Canceled).await;
    let attempt = seen.task("T1").attempt_id().expect("an attempt");
    assert_eq!(seen.holder("r1").as_ref(), Some(&attempt));
    assert!(seen.work("r1").assignment.is_none(), "it is told to stop");
    w.submit("T2", "A", "B").await;
    w.pass_while(60, "the robot is kept", |s| s.holder("r1").as_ref() == Some(&attempt)).await;
    assert!(w.seen().await.place("A").quarantine.is_some());
    w.r("r1").confirms = true;
    w.r("r1").works = true;
    w.r("r1").reports(attempt, WorkState::Aborted);
    w.r("r1").forgets_its_work();
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

/// A task that was canceled while nobody knew what its robot did; the robot can be heard again, and has not been.
async fn canceled_while_nobody_knew() -> World {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").cut();
    w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    w.cancel("T1", false).await;
    w.until("the wish is kept", |s| s.task("T1").then == Some(AfterStopping::Canceled)).await;
    w.r("r1").mend();
    w
}

#[tokio::test(start_paused = true)]
async fn a_canceled_task_whose_robot_comes_back_from_the_unknown_is_still_canceled() {
    let mut w = canceled_while_nobody_knew().await;
    w.connect("r1").await;
    let seen = w.until_phase("T1", Phase::Canceled).await;
    assert_eq!(seen.reason("T1"), Some(Code::CanceledByPerson));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_stop_wished_for_while_nobody_knew_ends_also_if_the_robot_never_confirms_it() {
    let mut w = canceled_while_nobody_knew().await;
    w.r("r1").confirms = false;
    w.connect("r1").await;
    w.until_phase("T1", Phase::Stopping).await;
    w.pass(20).await;
    let seen = w.seen().await;
    assert_eq!((seen.phase("T1"), seen.reason("T1")), (Phase::NeedsOperator, Some(Code::StopNotConfirmed)));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_deadline_that_passes_stops_the_robot_and_then_expires() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    let deadline = w.clock.now().utc.plus_ms(20_000);
    w.submit_with("T1", "A", "B", |raw| raw.deadline = Some(deadline)).await;
    w.submit_with("T2", "A", "B", |raw| raw.deadline = Some(deadline)).await;
    w.until_phase("T1", Phase::Running).await;
    let seen = w.until_phase("T2", Phase::Expired).await;
    assert_eq!((seen.task("T2").epoch, seen.reason("T2")), (0, Some(Code::DeadlinePassed)));
    let seen = w.until_phase("T1", Phase::Expired).await;
    assert_eq!(seen.attempt("T1").phase, AttemptPhase::Aborted);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_given_up_to_a_person_is_not_run_elsewhere_while_its_robot_may_still_run_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r2").answer = Answer::Ignore;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").confirms = false;
    w.cancel("T1", false).await;
    w.until_phase("T1", Phase::NeedsOperator).await;
    let task_id = TaskId::parse("T1").expect("an id");
    w.ask(Ask::Resolve { task_id, resolution: Resolution::Requeue }).await;
    w.until_phase("T1", Phase::Queued).await;
    w.pass_while(60, "the robot that still lists it has authority", |s| s.task("T1").epoch == 1).await;
    w.r("r1").confirms = true;
    w.r("r2").answer = Answer::Accept;
    w.r("r1").drives = true;
    let attempt = w.seen().await.task("T1").attempt_id().expect("an attempt");
    w.r("r1").reports(attempt, WorkState::Aborted);
    w.r("r1").forgets_its_work();
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}
