//! A step that several robots fail at one place: no more are sent there for it, until a try or a person says that it can be done.

use crate::harness::{Seen, World, jam};
use midshift_core::fleet::WAITS_FOR;
use midshift_core::fleet::rows::Incident;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

/// The incident of the shelf at A, if it is open.
fn broken(seen: &Seen) -> Option<Incident> {
    seen.open_incidents("PLACE_BROKEN").pop()
}

/// Three robots, each of which failed the pick at A once.
async fn three_failed() -> World {
    let mut w = World::on(CORRIDOR).await;
    for (n, at) in [(1, "park-a"), (2, "park-b"), (3, "B")] {
        let (task_id, robot_id) = (format!("T{n}"), format!("r{n}"));
        w.robot(&robot_id, at).await;
        w.r(&robot_id).fails = Some((1, jam()));
        assert_eq!(broken(&w.seen().await), None, "after {} robots", n - 1);
        w.submit_with(&task_id, "A", "B", |raw| raw.robot_id = robot_id).await;
        w.until_phase(&task_id, Phase::NeedsOperator).await;
    }
    w
}

async fn verdict(w: &World, task_id: &str) -> midshift_proto::common::v1::Reason {
    let request = v1::ExplainTaskRequest { task_id: task_id.to_owned() };
    let told = w.fleet.explain_task(local(request)).await.expect("told").into_inner();
    told.explanation.and_then(|told| told.verdict).unwrap_or_default()
}

#[tokio::test(start_paused = true)]
async fn what_three_robots_failed_at_a_place_waits_ten_minutes_for_one_try_and_goes_on_once_that_did_it() {
    let mut w = three_failed().await;
    let incident = broken(&w.seen().await).expect("an incident");
    assert_eq!(incident.reason.metadata["robots"], "r1, r2, r3");
    for id in ["T4", "T5"] {
        w.submit(id, "A", "B").await;
    }
    w.submit("back", "B", "A").await;
    let seen = w.until_phase("back", Phase::Succeeded).await;
    assert_eq!((seen.phase("T4"), seen.phase("T5")), (Phase::Queued, Phase::Queued), "another step at A is no matter");
    let told = verdict(&w, "T4").await;
    assert_eq!((told.code.as_str(), told.metadata["action"].as_str()), ("PLACE_BROKEN", "pick"));
    assert!(told.metadata[WAITS_FOR].contains("midshift incident close PLACE_BROKEN:A:pick"), "{told:?}");
    let seen = w.until("one is let through", |s| s.phase("T4") != Phase::Queued).await;
    assert!(seen.task("T4").changed >= incident.opened_unix_ms.plus_ms(600_000) && seen.phase("T5") == Phase::Queued);
    let seen = w.until("it is picked", |s| broken(s).is_none()).await;
    assert_eq!(seen.phase("T4"), Phase::Running);
    w.until_phase("T5", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_probe_that_fails_keeps_the_others_back_for_ten_minutes_more_and_the_incident_stays_as_old_as_it_is() {
    let mut w = three_failed().await;
    let opened = broken(&w.seen().await).expect("an incident");
    for id in ["T4", "T5"] {
        w.submit(id, "A", "B").await;
    }
    let seen = w.until("one is let through", |s| s.phase("T4") != Phase::Queued).await;
    let robot_id = seen.robot_of("T4").expect("a robot");
    w.r(&robot_id).fails = Some((1, jam()));
    let seen = w.until_phase("T4", Phase::NeedsOperator).await;
    let (still, failed) = (broken(&seen).expect("still broken"), seen.task("T4").changed);
    assert_eq!(still.reason.metadata["again_time"], failed.plus_ms(600_000).rfc3339());
    assert_eq!(
        (still.opened_unix_ms, &still.reason.metadata["robots"]),
        (opened.opened_unix_ms, &"r1, r2, r3".to_owned())
    );
    let seen = w.until("the next one is", |s| s.phase("T5") != Phase::Queued).await;
    assert!(seen.task("T5").changed >= failed.plus_ms(600_000));
}

#[tokio::test(start_paused = true)]
async fn a_person_who_has_looked_lets_tasks_go_there_at_once_and_what_failed_before_counts_no_more() {
    let mut w = three_failed().await;
    w.submit("T4", "A", "B").await;
    w.pass_while(5, "it waits", |s| s.phase("T4") == Phase::Queued).await;
    let incident_id = broken(&w.seen().await).expect("an incident").id;
    let close = v1::CloseIncidentRequest { incident_id, reason: "filled".to_owned(), ..Default::default() };
    w.fleet.close_incident(local(close)).await.expect("closed");
    let seen = w.until("it is given", |s| s.phase("T4") != Phase::Queued).await;
    let robot_id = seen.robot_of("T4").expect("a robot");
    w.r(&robot_id).fails = Some((1, jam()));
    let seen = w.until_phase("T4", Phase::NeedsOperator).await;
    assert_eq!(broken(&seen), None, "one more is not three");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn who_plans_next_has_not_seen_the_failures_and_sends_nobody_there_either() {
    let mut w = three_failed().await;
    w.submit("T4", "A", "B").await;
    w.stop_fleet().await;
    w.start_fleet();
    w.pass_while(500, "it waits still", |s| s.phase("T4") == Phase::Queued).await;
    w.until_phase("T4", Phase::Succeeded).await;
    assert_eq!(broken(&w.seen().await), None);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_did_it_between_two_that_failed_it_begins_the_count_anew() {
    let mut w = World::on(CORRIDOR).await;
    for (n, at, fault) in [(1, "park-a", true), (2, "park-b", true), (3, "B", false), (4, "charge", true)] {
        let (task_id, robot_id) = (format!("T{n}"), format!("r{n}"));
        w.robot(&robot_id, at).await;
        w.r(&robot_id).fails = fault.then(|| (1, jam()));
        w.submit_with(&task_id, "A", "B", |raw| raw.robot_id = robot_id).await;
        let ends = if fault { Phase::NeedsOperator } else { Phase::Succeeded };
        w.until_phase(&task_id, ends).await;
    }
    assert_eq!(broken(&w.seen().await), None);
}
