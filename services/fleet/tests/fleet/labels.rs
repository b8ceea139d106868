//! Labels that people give robots: what is asked wrongly, what is asked twice, and who then gets a task.

use crate::harness::World;
use midshift_core::reason::Code;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use std::collections::BTreeMap;

/// Says that the robot is on this floor.
fn on_floor(robot_id: &str, floor: &str) -> v1::LabelRobotRequest {
    let labels = BTreeMap::from([("floor".to_owned(), floor.to_owned())]);
    v1::LabelRobotRequest { robot_id: robot_id.to_owned(), labels, ..Default::default() }
}

/// The labels by people that the robot has then.
async fn label(w: &World, request: v1::LabelRobotRequest) -> Result<BTreeMap<String, String>, tonic::Status> {
    let labeled = w.fleet.label_robot(local(request)).await?.into_inner();
    Ok(labeled.control.expect("a control").labels)
}

async fn refused(w: &World, request: v1::LabelRobotRequest) -> midshift_proto::status::Answer {
    midshift_proto::refusal_of(&label(w, request).await.expect_err("it is wrong"))
}

#[tokio::test(start_paused = true)]
async fn labels_that_say_too_little_too_much_or_of_nobody_are_refused_with_every_reason() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let wrong = async |request: v1::LabelRobotRequest| {
        let wrong = refused(&w, request).await;
        assert_eq!(wrong.grpc, tonic::Code::InvalidArgument);
        wrong.violations.into_iter().map(|violation| violation.field).collect::<Vec<_>>()
    };
    let unnamed = v1::LabelRobotRequest { request_id: "a b".to_owned(), ..on_floor("", "2") };
    assert_eq!(wrong(unnamed).await, ["robot_id", "request_id"]);
    let nothing = v1::LabelRobotRequest { labels: BTreeMap::new(), ..on_floor("r1", "2") };
    assert_eq!(wrong(nothing).await, ["labels"]);
    let mut both = v1::LabelRobotRequest { removed: vec!["floor".to_owned()], ..on_floor("r1", "2") };
    both.labels.insert("line".to_owned(), "x".repeat(64));
    assert_eq!(wrong(both).await, ["removed", "labels[line]"]);
    let many = (0..=32).map(|n| (format!("k{n}"), "v".to_owned())).collect();
    assert_eq!(wrong(v1::LabelRobotRequest { labels: many, ..on_floor("r1", "2") }).await, ["labels"]);
    let unknown = refused(&w, on_floor("r9", "2")).await;
    assert_eq!((unknown.grpc, unknown.code), (tonic::Code::NotFound, Some(Code::RobotNotFound)));
    let stale = v1::LabelRobotRequest { etag: "77".to_owned(), ..on_floor("r1", "2") };
    assert_eq!(refused(&w, stale).await.code, Some(Code::EtagMismatch));
    let check = v1::LabelRobotRequest { validate_only: true, ..on_floor("r1", "2") };
    assert_eq!(label(&w, check).await.expect("nothing is against it"), BTreeMap::new());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn labels_are_given_once_whatever_is_lost_of_the_answer() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let once = |floor: &str| v1::LabelRobotRequest { request_id: "label-1".to_owned(), ..on_floor("r1", floor) };
    assert_eq!(label(&w, once("2")).await.expect("is done"), on_floor("r1", "2").labels);
    label(&w, on_floor("r1", "3")).await.expect("is done");
    let since = on_floor("r1", "3").labels;
    assert_eq!(label(&w, once("2")).await.expect("was done"), since, "and not done again");
    w.stop_fleet().await;
    w.start_fleet();
    assert_eq!(label(&w, once("2")).await.expect("was done"), since, "nor after a restart");
    assert_eq!(refused(&w, once("4")).await.grpc, tonic::Code::AlreadyExists, "it says something else");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_waits_for_a_label_begins_when_a_person_gives_it_to_a_robot() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.selector_labels = on_floor("r1", "2").labels).await;
    w.pass_while(20, "nobody has the label", |s| s.phase("T1") == Phase::Queued).await;
    label(&w, on_floor("r1", "2")).await.expect("is done");
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}
