//! Legal messages at their limits, and decisions that the store never takes: the planner goes on.

use crate::harness::World;
use midshift_core::fleet::rows::Incident;
use midshift_core::ids::StopId;
use midshift_core::robot::StopLevel;
use midshift_core::rows::{Record, Table};
use midshift_core::site::CORRIDOR;
use midshift_core::stop::record::StopRecord;
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

fn names(count: usize) -> Vec<StopId> {
    (0..count).map(|n| StopId::parse(&format!("STOP-{n}")).expect("an id")).collect()
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_waits_for_as_many_resumes_as_a_message_takes_is_held_and_stops_no_planner() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    for stop_id in names(256) {
        w.r("r1").stands_for(&stop_id);
    }
    w.pass(5).await;
    w.submit_with("T1", "A", "B", |raw| raw.robot_id = "r2".to_owned()).await;
    assert_eq!((w.seen().await.tokens("r1").len(), w.shaky.refused()), (256, 0));
    w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(w.shaky.refused(), 0, "nothing was composed that the store never takes");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn hundreds_of_stops_that_are_reset_at_once_all_wait_for_a_resume() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let record = |stop_id: StopId, reset| {
        let stop = Stop::new(stop_id, Scope::Fleet, StopLevel::Halt, crate::harness::BEGIN);
        StopRecord { stop, reset }
    };
    for stop_id in names(200) {
        w.stop(&record(stop_id, None)).await;
    }
    w.until("all of them hold it", |s| s.tokens("r1").len() == 200).await;
    for stop_id in names(200) {
        let reset = Reset::new(stop_id.clone(), crate::harness::BEGIN);
        w.stop(&record(stop_id, Some(reset))).await;
    }
    w.pass(5).await;
    let tokens = w.seen().await.tokens("r1");
    assert_eq!(tokens.iter().filter(|t| t.starts_with("resume:")).count(), 200, "{}", tokens.len());
    assert_eq!(w.shaky.refused(), 0, "nothing was composed that the store never takes");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_decision_that_the_store_refuses_twice_is_put_aside_until_a_person_closes_its_incident() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r2", "park-b").await;
    w.pass(2).await;
    w.shaky.refuse(Some(Table::DesiredPolicy));
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.robot_id = "r1".to_owned()).await;
    w.submit_with("T2", "B", "A", |raw| raw.robot_id = "r2".to_owned()).await;
    w.until_phase("T2", Phase::Succeeded).await;
    assert!(w.shaky.refused() <= 4, "it was composed {} times", w.shaky.refused());
    let seen = w.seen().await;
    let open = seen.open_incidents("DECISION_PUT_ASIDE");
    assert!(!open.is_empty() && open.iter().all(|i| i.robot_id.as_ref().is_some_and(|r| r.as_str() == "r1")));
    assert_eq!((seen.phase("T1"), seen.phase("T2")), (Phase::Queued, Phase::Succeeded));
    w.shaky.refuse(None);
    w.pass_while(20, "it stays put aside", |s| s.phase("T1") == Phase::Queued).await;
    for incident in &open {
        close(&w, incident).await;
    }
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_decision_that_was_put_aside_is_made_again_once_the_robot_comes_anew() {
    let mut w = World::on(CORRIDOR).await;
    w.shaky.refuse(Some(Table::DesiredPolicy));
    w.robot("r1", "park-a").await;
    // It becomes known, and gets the rules of the areas: both write the row that is refused.
    w.until("both are put aside", |s| s.open_incidents("DECISION_PUT_ASIDE").len() == 2).await;
    w.shaky.refuse(None);
    w.submit("T1", "A", "B").await;
    w.pass_while(20, "it stays put aside", |s| s.phase("T1") == Phase::Queued).await;
    w.connect("r1").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_decision_that_the_store_refuses_is_taken_back_alone_and_no_projection_is_read_again() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r2", "park-b").await;
    w.pass(2).await;
    let read = w.shaky.projections_read();
    w.shaky.refuse(Some(Table::DesiredPolicy));
    w.robot("r1", "park-a").await;
    w.submit("T1", "B", "A").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.shaky.refuse(Some(Table::Timer));
    w.submit("T2", "B", "A").await;
    w.until("its deadline cannot be written", |s| !s.open_incidents("DECISION_PUT_ASIDE").is_empty()).await;
    w.shaky.refuse(None);
    assert!(w.shaky.refused() >= 2, "the store refused {} items", w.shaky.refused());
    assert_eq!(w.shaky.projections_read(), read, "no projection was built anew");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_event_that_cannot_be_obeyed_is_passed_over_and_those_after_it_are_obeyed() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.submit_with("T1", "A", "B", |raw| raw.robot_id = "r1".to_owned()).await;
    w.until_phase("T1", Phase::Running).await;
    let read = w.shaky.projections_read();
    w.shaky.refuse(Some(Table::RobotCounter));
    w.until("its end is passed over", |s| !s.open_incidents("ENTRY_PASSED_OVER").is_empty()).await;
    w.shaky.refuse(None);
    w.submit_with("T2", "B", "A", |raw| raw.robot_id = "r2".to_owned()).await;
    w.until_phase("T2", Phase::Succeeded).await;
    assert_eq!(w.shaky.projections_read(), read, "no projection was built anew");
    w.lawful().await;
}

async fn close(w: &World, incident: &Incident) {
    let request =
        v1::CloseIncidentRequest { incident_id: incident.id(), reason: "looked".to_owned(), ..Default::default() };
    w.fleet.close_incident(local(request)).await.expect("closed");
}
