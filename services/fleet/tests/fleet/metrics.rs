//! What a scrape says of the shift.

use crate::harness::World;
use metrics_exporter_prometheus::{PrometheusBuilder, PrometheusRecorder};
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;

/// Whether the page has this line.
fn says(recorder: &PrometheusRecorder, line: &str) -> bool {
    recorder.handle().render().lines().any(|found| found == line)
}

#[tokio::test(start_paused = true)]
async fn a_task_is_counted_when_it_ends_and_what_waits_by_why() {
    let recorder = PrometheusBuilder::new().build_recorder();
    let _of_this_thread = metrics::set_default_local_recorder(&recorder);
    let mut w = World::on(CORRIDOR).await;
    w.submit("T1", "A", "B").await;
    w.pass(2).await;
    assert!(says(&recorder, "midshift_fleet_tasks_waiting{reason=\"WAITING_FOR_ROBOT\"} 1"));
    w.robot("r1", "park-a").await;
    w.until_phase("T1", Phase::Running).await;
    w.pass(2).await;
    assert!(says(&recorder, "midshift_fleet_tasks_waiting{reason=\"WAITING_FOR_ROBOT\"} 0"));
    assert!(says(&recorder, "midshift_fleet_robots{does=\"task\"} 1"));
    w.until_phase("T1", Phase::Succeeded).await;
    w.pass(2).await;
    let labels = "class=\"normal\",type=\"transport\"";
    for line in [
        format!("midshift_fleet_tasks_ended_total{{state=\"SUCCEEDED\",{labels}}} 1"),
        format!("midshift_fleet_task_attempts_total{{{labels}}} 1"),
        format!("midshift_fleet_task_wait_seconds_count{{{labels}}} 1"),
        format!("midshift_fleet_task_completion_seconds_count{{{labels}}} 1"),
        "midshift_fleet_tasks_open 0".to_owned(),
    ] {
        assert!(says(&recorder, &line), "{line}: {}", recorder.handle().render());
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn types_beyond_the_first_are_counted_as_others() {
    let recorder = PrometheusBuilder::new().build_recorder();
    let _of_this_thread = metrics::set_default_local_recorder(&recorder);
    let mut w = World::on(CORRIDOR).await;
    for nth in 0..35 {
        let id = format!("T{nth:02}");
        w.submit_with(&id, "A", "B", |raw| raw.kind = format!("type-{nth:02}")).await;
        w.cancel(&id, false).await;
        w.until_phase(&id, Phase::Canceled).await;
    }
    w.pass(2).await;
    let canceled =
        |kind: &str| format!("midshift_fleet_tasks_ended_total{{state=\"CANCELED\",class=\"normal\",type=\"{kind}\"}}");
    assert!(says(&recorder, &format!("{} 1", canceled("type-31"))));
    assert!(says(&recorder, &format!("{} 3", canceled("other"))));
}
