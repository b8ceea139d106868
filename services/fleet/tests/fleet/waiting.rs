//! Tasks that wait: for another task, for a time, for a robot.

use crate::harness::{Answer, World};
use midshift_core::reason::Code;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;

#[tokio::test(start_paused = true)]
async fn a_task_waits_for_what_it_depends_on_and_asks_a_person_if_that_failed() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::Ignore;
    let after = |id: &'static str| move |raw: &mut midshift_core::task::RawTask| raw.depends_on = vec![id.to_owned()];
    w.submit("T1", "A", "B").await;
    w.submit_with("T2", "A", "B", after("T1")).await;
    w.submit_with("T3", "A", "B", after("T4")).await;
    w.submit("T4", "A", "B").await;
    w.pass_while(20, "its turn comes later", |s| s.task("T2").epoch == 0).await;
    w.cancel("T4", false).await;
    let seen = w.until_phase("T3", Phase::NeedsOperator).await;
    assert_eq!(seen.reason("T3"), Some(Code::DependencyFailed));
    w.r("r1").answer = Answer::Accept;
    w.until_phase("T1", Phase::Succeeded).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_is_not_offered_before_its_time() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let not_before = w.clock.now().utc.plus_ms(60_000);
    w.submit_with("T1", "A", "B", |raw| raw.not_before = Some(not_before)).await;
    w.pass_while(59, "its time has not come", |s| s.phase("T1") == Phase::Queued).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_no_robot_starts_in_time_asks_a_person() {
    let mut w = World::on(CORRIDOR).await;
    w.submit_with("T1", "A", "B", |raw| raw.schedule_to_start_ms = Some(60_000)).await;
    w.pass_while(59, "there is time", |s| s.phase("T1") == Phase::Queued).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.reason("T1"), Some(Code::ScheduleToStart));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_offered_again_and_again_to_a_robot_that_never_answers_asks_a_person() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::Ignore;
    w.submit_with("T1", "A", "B", |raw| raw.schedule_to_start_ms = Some(60_000)).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.reason("T1"), Some(Code::ScheduleToStart));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn the_more_urgent_task_goes_first_and_the_older_one_among_equals() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("older", "A", "B").await;
    w.submit("younger", "A", "B").await;
    w.submit_with("urgent", "A", "B", |raw| raw.priority = Some(0)).await;
    w.robot("r1", "park-a").await;
    let ended = |s: &crate::harness::Seen, id: &str| s.task(id).ended;
    let seen = w.until_phase("younger", Phase::Succeeded).await;
    assert!(ended(&seen, "urgent") < ended(&seen, "older") && ended(&seen, "older") < ended(&seen, "younger"));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn tasks_that_two_processes_numbered_alike_are_all_done_also_after_a_restart() {
    let mut w = World::on(CORRIDOR).await;
    for id in ["T1", "T2", "X1", "X2"] {
        if id == "X1" {
            w.number_from(1);
        }
        w.submit(id, "A", "B").await;
    }
    let seen = w.seen().await;
    assert_eq!((seen.task("T1").number, seen.task("T2").number), (seen.task("X1").number, seen.task("X2").number));
    w.stop_fleet().await;
    w.start_fleet();
    w.robot("r1", "park-a").await;
    for id in ["T1", "X1", "T2", "X2"] {
        w.until_phase(id, Phase::Succeeded).await;
    }
    w.lawful().await;
}
