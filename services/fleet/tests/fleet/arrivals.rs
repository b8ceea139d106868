//! Robots that say that a task is done: those that were never where it is done are not believed, and honest ones are, whatever happened.

use crate::harness::{Answer, World};
use midshift_core::reason::Code;
use midshift_core::robot::WorkState;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{AttemptPhase, Phase};
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

const CODE: &str = "GOAL_NOT_ENTERED";

#[tokio::test(start_paused = true)]
async fn a_robot_that_never_left_its_place_ends_no_task_and_gets_none_until_a_person_has_looked() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::LetGo(WorkState::Succeeded);
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    let open = seen.open_incidents(CODE);
    assert_eq!((seen.reason("T1"), seen.attempt("T1").phase), (Some(Code::GoalNotEntered), AttemptPhase::Failed));
    assert_eq!((seen.is_free("r1"), open.len()), (true, 1));
    assert_eq!(open[0].robot_id.as_ref().map(ToString::to_string).as_deref(), Some("r1"));
    w.r("r1").answer = Answer::Accept;
    w.submit("T2", "A", "B").await;
    w.pass_while(10, "nobody has looked at it", |s| s.phase("T2") == Phase::Queued && s.is_free("r1")).await;
    let (incident_id, reason) = (open[0].id.clone(), "its plug was out".to_owned());
    let close = v1::CloseIncidentRequest { incident_id, reason, ..Default::default() };
    w.fleet.close_incident(local(close)).await.expect("closed");
    let seen = w.until_phase("T2", Phase::Succeeded).await;
    assert_eq!((seen.phase("T1"), seen.open_incidents(CODE).len()), (Phase::NeedsOperator, 0));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_honest_robot_whose_words_and_heartbeats_come_late_is_believed() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.has("r1", "A") && !s.has("r1", "park-a")).await;
    // Its events wait with it; heartbeats tell of places and steps that no event has told of yet.
    for _ in 0..6 {
        w.r("r1").tells = false;
        w.pass(4).await;
        w.r("r1").tells = true;
        w.pass(2).await;
    }
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!((seen.task("T1").epoch, seen.open_incidents(CODE).len()), (1, 0));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_honest_robot_whose_server_starts_anew_on_its_way_is_believed() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.until("it has left A", |s| s.attempt("T1").step_index >= 2 && !s.has("r1", "A")).await;
    w.stop_fleet().await;
    w.start_fleet();
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    let visited = seen.attempt("T1").visited.expect("it was told whole").places;
    assert_eq!(visited.iter().map(ToString::to_string).collect::<Vec<_>>(), ["A", "B"]);
    assert_eq!(seen.open_incidents(CODE).len(), 0);
    w.lawful().await;
}
