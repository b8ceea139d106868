//! Faults: what is tried again, what a person hears of, and when a robot is taken out of dispatch.

use crate::harness::{Answer, World, jam, obstacle};
use midshift_core::reason::Code;
use midshift_core::robot::Duty;
use midshift_core::robot::WorkState;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_core::task::raw::RawRetry;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

fn twice() -> Option<RawRetry> {
    Some(RawRetry { max_retry_times: 2, interval_ms: Some(10_000), jitter: Some(0.0), ..RawRetry::default() })
}

#[tokio::test(start_paused = true)]
async fn a_recoverable_fault_is_tried_again_after_its_back_off_and_a_person_is_asked_when_all_are_spent() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.retry = twice()).await;
    for (attempt, back_off_ms) in [(1, 10_000), (2, 20_000)] {
        w.r("r1").fails = Some((0, obstacle()));
        let seen = w.until("it waits", |s| s.phase("T1") == Phase::RetryWait && s.task("T1").epoch == attempt).await;
        let task = seen.task("T1");
        assert_eq!(task.retry_at.expect("an end").ms_since(task.changed), back_off_ms);
        assert_eq!(task.failures, attempt as u32);
        w.pass_while(back_off_ms / 1_000 - 2, "it waits out its back-off", |s| s.phase("T1") == Phase::RetryWait).await;
        w.r("r1").fails = Some((0, obstacle()));
        w.until("it is tried again", |s| s.task("T1").epoch == attempt + 1).await;
    }
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.reason("T1"), Some(Code::AttemptsSpent));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn another_robot_is_preferred_for_the_retry_of_a_task_that_is_not_opened() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("near", "park-a").await;
    w.robot("other", "park-b").await;
    w.r("near").fails = Some((0, obstacle()));
    w.submit_with("T1", "A", "B", |raw| raw.retry = twice()).await;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(seen.robot_of("T1").as_deref(), Some("other"));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_opened_task_is_tried_again_only_by_the_robot_that_carries_it_and_without_a_second_pick() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r1").fails = Some((2, obstacle()));
    w.submit_with("T1", "A", "B", |raw| raw.retry = twice()).await;
    let seen = w.until_phase("T1", Phase::RetryWait).await;
    assert_eq!(seen.task("T1").opened_robot_id.as_ref().map(|r| r.as_str()), Some("r1"));
    assert_eq!(seen.task("T1").next_step, 2);
    let seen = w.until("it is offered again", |s| s.task("T1").epoch == 2).await;
    assert_eq!(seen.robot_of("T1").as_deref(), Some("r1"));
    let work = seen.work("r1").assignment.expect("an assignment");
    assert_eq!((work.from_step, work.resume_step), (2, 2));
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_mechanical_fault_is_never_tried_again() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").fails = Some((0, jam()));
    w.submit_with("T1", "A", "B", |raw| raw.retry = twice()).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!((seen.reason("T1"), seen.task("T1").epoch), (Some(Code::FaultNotRecoverable), 1));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn three_failures_in_ten_minutes_take_a_robot_out_of_dispatch_until_a_person_says_so() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    for n in 1..=3 {
        w.r("r1").fails = Some((0, jam()));
        let id = format!("T{n}");
        w.submit(&id, "A", "B").await;
        w.until_phase(&id, Phase::NeedsOperator).await;
    }
    let seen = w.seen().await;
    assert_eq!(seen.control("r1").duty(), Duty::BrokenOff);
    assert_eq!(seen.incidents(), [Code::RobotBreakerOpened]);
    w.submit("T4", "A", "B").await;
    w.pass_while(700, "it gets no work, however long ago", |s| s.phase("T4") == Phase::Queued).await;
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
    w.fleet.uncordon_robot(local(uncordon)).await.expect("uncordoned");
    w.until_phase("T4", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_a_restarted_robot_dropped_is_tried_again_without_a_retry_being_asked_for() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").forgets_its_work();
    w.until_phase("T1", Phase::RetryWait).await;
    w.r("r1").drives = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_drops_a_task_again_and_again_is_noticed_by_a_person() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    for epoch in 1..=4 {
        w.until("it runs", |s| s.phase("T1") == Phase::Running && s.task("T1").epoch == epoch).await;
        w.r("r1").forgets_its_work();
    }
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.reason("T1"), Some(Code::RobotDroppedIt));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_takes_too_long_is_tried_again_only_once_the_robot_has_stopped() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.r("r1").confirms = false;
    w.submit_with("T1", "A", "B", |raw| {
        raw.retry = twice();
        raw.timeout_ms = Some(40_000);
        raw.stall_ms = Some(3_600_000);
    })
    .await;
    w.until_phase("T1", Phase::Running).await;
    let seen = w.until_phase("T1", Phase::Stopping).await;
    assert_eq!(seen.reason("T1"), Some(Code::StartToClose));
    w.pass_while(10, "not before the robot confirms", |s| s.phase("T1") == Phase::Stopping && !s.is_free("r1")).await;
    w.r("r1").confirms = true;
    w.until_phase("T1", Phase::RetryWait).await;
    w.r("r1").drives = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_without_progress_is_stopped_but_not_while_it_waits_for_a_place() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.retry = twice()).await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").works = false;
    let seen = w.until_phase("T1", Phase::Stopping).await;
    assert_eq!(seen.reason("T1"), Some(Code::Stalled));
    w.r("r1").works = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_a_robot_failed_is_kept_a_minute_for_another_that_is_busy() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("near", "park-a").await;
    w.robot("other", "park-b").await;
    w.pass(2).await;
    w.r("other").drives = false;
    w.submit_with("T1", "A", "B", |raw| {
        raw.robot_id = "other".to_owned();
        raw.stall_ms = Some(3_600_000);
    })
    .await;
    w.until_phase("T1", Phase::Running).await;
    w.r("near").fails = Some((0, obstacle()));
    w.submit_with("T2", "A", "B", |raw| raw.retry = twice()).await;
    w.until("it waits again", |s| s.phase("T2") == Phase::Queued && s.task("T2").epoch == 1).await;
    w.pass_while(50, "it is kept for the other", |s| s.phase("T2") == Phase::Queued).await;
    let seen = w.until("it is given again", |s| s.task("T2").epoch == 2).await;
    assert_eq!(seen.robot_of("T2").as_deref(), Some("near"), "nobody else was free");
    w.lawful().await;
}

/// Beside a robot that ends whatever it takes an honest one does four tasks, and the first is broken off. Gives back how
/// many of them it had.
async fn beside_one_that_ends(state: WorkState) -> usize {
    let mut w = World::on(CORRIDOR).await;
    w.robot("near", "park-a").await;
    w.robot("other", "park-b").await;
    w.pass(2).await;
    w.r("near").answer = Answer::LetGo(state);
    let tasks = ["T1", "T2", "T3", "T4"];
    for id in tasks {
        w.submit_with(id, "A", "B", |raw| raw.retry = twice()).await;
    }
    for id in tasks {
        let seen = w.until("it is over", |s| s.phase(id).is_terminal() || s.phase(id) == Phase::NeedsOperator).await;
        assert_eq!((seen.phase(id), seen.robot_of(id).as_deref()), (Phase::Succeeded, Some("other")), "{state:?} {id}");
        assert!(seen.task(id).epoch <= 2, "{state:?} {id}: passed over once it failed");
    }
    let seen = w.seen().await;
    assert_eq!(seen.control("near").duty(), Duty::BrokenOff, "{state:?}");
    assert_eq!(seen.incidents(), [Code::RobotBreakerOpened], "{state:?}");
    assert!(seen.control("other").failures.is_empty(), "{state:?}");
    w.lawful().await;
    tasks.into_iter().filter(|id| !seen.task(id).failed_robots.is_empty()).count()
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_takes_work_and_lets_it_go_is_broken_off_and_keeps_no_task_from_another() {
    for state in [WorkState::Aborted, WorkState::Suspended, WorkState::Refused] {
        assert_eq!(beside_one_that_ends(state).await, 3, "{state:?}: the third opens its breaker");
    }
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_calls_impossible_another_does_and_three_that_others_did_break_it_off() {
    assert_eq!(beside_one_that_ends(WorkState::Failed).await, 3);
}

#[tokio::test(start_paused = true)]
async fn what_two_robots_call_impossible_goes_to_a_person_and_counts_against_neither() {
    let mut w = World::on(CORRIDOR).await;
    for (robot, at) in [("r1", "park-a"), ("r2", "park-b")] {
        w.robot(robot, at).await;
        w.r(robot).answer = Answer::LetGo(WorkState::Failed);
    }
    w.pass(2).await;
    for id in ["T1", "T2", "T3"] {
        w.submit_with(id, "A", "B", |raw| raw.retry = twice()).await;
        let seen = w.until_phase(id, Phase::NeedsOperator).await;
        assert_eq!((seen.reason(id), seen.task(id).epoch), (Some(Code::FaultNotRecoverable), 2));
    }
    assert!(w.seen().await.incidents().is_empty());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_the_only_robot_calls_impossible_goes_to_a_person_at_once() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::LetGo(WorkState::Failed);
    w.submit_with("T1", "A", "B", |raw| raw.retry = twice()).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!((seen.reason("T1"), seen.task("T1").epoch), (Some(Code::FaultNotRecoverable), 1));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_lets_go_after_it_came_anew_does_not_count_against_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    for epoch in 1..=3 {
        let seen = w.until("it runs", |s| s.phase("T1") == Phase::Running && s.task("T1").epoch == epoch).await;
        w.connect("r1").await;
        w.r("r1").forgets_its_work();
        w.r("r1").reports(seen.task("T1").attempt_id().expect("an attempt"), WorkState::Aborted);
        w.until_phase("T1", Phase::RetryWait).await;
    }
    w.r("r1").drives = true;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert!(seen.control("r1").failures.is_empty());
    w.lawful().await;
}
