//! What robots report, held against the law: an implausible report frees nothing and moves nothing forward.

use crate::harness::{Seen, World, obstacle};
use midshift_core::ids::{AttemptId, TaskId};
use midshift_core::robot::Load;
use midshift_core::robot::WorkState;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_core::task::raw::RawRetry;

fn twice() -> Option<RawRetry> {
    Some(RawRetry { max_retry_times: 2, interval_ms: Some(1_000), jitter: Some(0.0), ..RawRetry::default() })
}

/// A robot that stands in A and does not pick yet; and its attempt.
async fn at_the_pick() -> (World, AttemptId) {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit_with("T1", "A", "B", |raw| (raw.retry, raw.stall_ms) = (twice(), Some(3_600_000))).await;
    let seen = w.until("it stands in A", |s| s.has("r1", "A") && !s.has("r1", "park-a")).await;
    let attempt = seen.task("T1").attempt_id().expect("an attempt");
    (w, attempt)
}

fn is_implausible(s: &Seen) -> bool {
    !s.open_incidents("REPORT_IMPLAUSIBLE").is_empty() && s.is_uncertain("T1")
}

#[tokio::test(start_paused = true)]
async fn success_before_the_last_step_is_not_believed() {
    let (mut w, attempt) = at_the_pick().await;
    w.r("r1").reports(attempt, WorkState::Succeeded);
    w.pass(3).await;
    let seen = w.seen().await;
    assert_eq!((seen.phase("T1"), seen.is_free("r1")), (Phase::Running, false));
    assert_eq!(seen.open_incidents("REPORT_IMPLAUSIBLE").len(), 1);
    w.r("r1").works = true;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(seen.task("T1").epoch, 1, "the same attempt went on");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_step_beyond_the_task_is_neither_stored_nor_sent_on() {
    let (mut w, _) = at_the_pick().await;
    w.r("r1").says_step = Some(1_000);
    w.until("nobody knows", is_implausible).await;
    w.pass_while(30, "it is not seen as running while it says so", is_implausible).await;
    let seen = w.seen().await;
    assert!(seen.task("T1").next_step <= 4 && seen.attempt("T1").step_index <= 4);
    assert_eq!(seen.open_incidents("REPORT_IMPLAUSIBLE").len(), 1, "once");
    w.r("r1").says_step = None;
    w.r("r1").works = true;
    w.until("it is known again", |s| s.phase("T1") == Phase::Succeeded || !s.is_uncertain("T1")).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_end_with_an_impossible_step_frees_nobody() {
    let (mut w, attempt) = at_the_pick().await;
    w.robot("r2", "park-b").await;
    w.r("r1").says_step = Some(77);
    w.r("r1").fails = Some((1, obstacle()));
    w.until("nobody knows", is_implausible).await;
    w.pass_while(60, "its robot keeps it", |s| {
        s.holder("r1").as_ref() == Some(&attempt) && s.task("T1").epoch == 1 && s.task("T1").next_step <= 4
    })
    .await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_step_that_goes_back_within_an_attempt_is_implausible() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.stall_ms = Some(3_600_000)).await;
    w.until("it has picked", |s| s.phase("T1") == Phase::Running && s.attempt("T1").step_index >= 2).await;
    w.r("r1").drives = false;
    w.r("r1").says_step = Some(0);
    w.until("nobody knows", is_implausible).await;
    assert!(w.seen().await.attempt("T1").step_index >= 2, "what was reported before stands");
    w.r("r1").says_step = None;
    w.r("r1").drives = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_load_binds_a_task_though_the_robot_never_says_that_it_opened_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r1").hides_opened = true;
    w.r("r1").fails = Some((2, obstacle()));
    w.submit_with("T1", "A", "B", |raw| {
        raw.retry = Some(RawRetry { exclude_failed_robot: true, ..twice().expect("some") });
    })
    .await;
    w.until("it has failed with the item on it", |s| s.task("T1").failures == 1).await;
    assert!(w.r("r1").load.is_some());
    w.pass_while(60, "nobody else gets it", |s| s.robot_of("T1").as_deref() == Some("r1")).await;
    assert_eq!(w.seen().await.task("T1").opened_robot_id.map(|r| r.to_string()).as_deref(), Some("r1"));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_load_that_the_heartbeat_alone_tells_binds_its_task() {
    let (mut w, _) = at_the_pick().await;
    w.robot("r2", "park-b").await;
    // It has picked and has said nothing of it but what it carries.
    w.r("r1").load = Some(Load { task_id: Some(TaskId::parse("T1").expect("an id")), item: "box".to_owned() });
    w.pass(3).await;
    w.r("r1").forgets_its_work();
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.task("T1").opened_robot_id.map(|r| r.to_string()).as_deref(), Some("r1"));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_step_that_the_heartbeat_alone_tells_as_opened_keeps_the_task_from_a_second_robot() {
    let (mut w, attempt) = at_the_pick().await;
    w.robot("r2", "park-b").await;
    w.r("r1").lists_alone(&attempt, 2, true);
    w.until("it is kept", |s| s.attempt("T1").is_opened && s.attempt("T1").step_index == 2).await;
    w.r("r1").forgets_its_work();
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.task("T1").opened_robot_id.map(|r| r.to_string()).as_deref(), Some("r1"), "nobody else gets it");
    w.lawful().await;
}
