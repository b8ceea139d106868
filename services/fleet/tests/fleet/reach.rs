//! Callers who may do something in some areas only: r1 stands in the hall, r2 in the quality room, r3 was never heard again.

use crate::harness::World;
use midshift_core::fleet::rows::{Incident, RobotControl, RobotCounter};
use midshift_core::identity::{Caller, TokenId};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::reason::Code as Why;
use midshift_core::site::DEMO;
use midshift_core::time::Utc;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use midshift_proto::refusal_of;
use std::collections::BTreeSet;
use tonic::{Code, Request, Response, Status};

fn asked<T>(by: &Caller, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.extensions_mut().insert(by.clone());
    request
}

/// Anna, with these rights.
fn anna(grants: &[&str]) -> Caller {
    let grants = grants.iter().map(|grant| (*grant).to_owned().into()).collect();
    Caller::holder(TokenId::new("t1").expect("an id"), "anna".into(), grants, false)
}

fn code<T>(answer: Result<Response<T>, Status>) -> Code {
    answer.map_or_else(|refused| refused.code(), |_| Code::Ok)
}

fn cordon(robot_id: &str) -> v1::CordonRobotRequest {
    v1::CordonRobotRequest { robot_id: robot_id.to_owned(), reason: "wheel".to_owned(), ..Default::default() }
}

async fn world() -> World {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    w.robot("r2", "Q01").await;
    // It would park in the hall.
    w.r("r2").drives = false;
    w.step().await;
    w
}

#[tokio::test(start_paused = true)]
async fn a_robot_is_taken_out_of_work_by_whoever_operates_where_it_stands_and_under_its_name() {
    let w = world().await;
    let (anna, blind) = (anna(&["operator@hall", "viewer@quality"]), anna(&["operator@hall"]));
    let gone = w.fleet.cordon_robot(asked(&anna, cordon("r9"))).await.expect_err("not there");
    let unseen = w.fleet.cordon_robot(asked(&blind, cordon("r2"))).await.expect_err("not seen");
    assert_eq!((unseen.code(), refusal_of(&unseen).reason), (gone.code(), refusal_of(&gone).reason));
    assert_eq!(gone.code(), Code::NotFound);
    assert_eq!(code(w.fleet.cordon_robot(asked(&anna, cordon("r2"))).await), Code::PermissionDenied);
    let cordoned = w.seen().await.get::<RobotControl>("r2").is_some_and(|control| control.cordon.is_some());
    assert!(!cordoned, "nothing is written");
    let control = w.fleet.cordon_robot(asked(&anna, cordon("r1"))).await.expect("her area").into_inner().control;
    assert_eq!(control.and_then(|c| c.cordon).map(|c| c.actor), Some("anna".to_owned()));
    let checked = v1::UndrainRobotRequest { robot_id: "r2".to_owned(), validate_only: true, ..Default::default() };
    assert_eq!(code(w.fleet.undrain_robot(asked(&anna, checked)).await), Code::PermissionDenied);
    for (id, seen) in [("r1", Code::Ok), ("r2", Code::NotFound)] {
        let robot_id = id.to_owned();
        let control = v1::GetRobotControlRequest { robot_id: robot_id.clone() };
        assert_eq!(code(w.fleet.get_robot_control(asked(&blind, control.clone())).await), seen, "{id}");
        assert_eq!(code(w.fleet.get_robot_control(asked(&anna, control)).await), Code::Ok, "{id}");
        let why = v1::ExplainRobotRequest { robot_id };
        assert_eq!(code(w.fleet.explain_robot(asked(&blind, why)).await), seen, "{id}");
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_list_of_what_was_decided_about_robots_shows_each_caller_its_own_in_pages() {
    let w = world().await;
    w.fleet.cordon_robot(asked(&anna(&["operator"]), cordon("r2"))).await.expect("the site's");
    let list = async |grants: &[&str], page_size, page_token: &str| {
        let request = v1::ListRobotControlsRequest { page_size, page_token: page_token.to_owned() };
        w.fleet.list_robot_controls(asked(&anna(grants), request)).await.expect("a list").into_inner()
    };
    let ids =
        |page: &v1::ListRobotControlsResponse| page.controls.iter().map(|c| c.robot_id.clone()).collect::<Vec<_>>();
    let first = list(&["viewer"], 1, "").await;
    assert_eq!((ids(&first), first.next_page_token.as_str()), (vec!["r1".to_owned()], "r1"));
    let second = list(&["viewer"], 1, "r1").await;
    assert_eq!((ids(&second), second.next_page_token.as_str()), (vec!["r2".to_owned()], ""));
    let since = second.controls[0].cordon.as_ref().and_then(|cordon| cordon.since).expect("since when");
    assert!(second.list_time.is_some_and(|now| (now.seconds, now.nanos) >= (since.seconds, since.nanos)));
    assert_eq!(ids(&list(&["viewer@hall"], 0, "").await), ["r1"]);
    assert!(ids(&list(&["viewer@packing"], 0, "").await).is_empty());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_process_that_does_not_lead_asks_the_same_of_a_caller() {
    let mut w = World::shared(DEMO).await;
    w.robot("r1", "park-1").await;
    w.robot("r2", "Q01").await;
    // It would park in the hall.
    w.r("r2").drives = false;
    let (standby, _) = w.other_process();
    w.pass(1).await;
    let anna = anna(&["operator@hall", "viewer@quality"]);
    assert_eq!(code(standby.cordon_robot(asked(&anna, cordon("r2"))).await), Code::PermissionDenied);
    standby.cordon_robot(asked(&anna, cordon("r1"))).await.expect("her area");
    let seen = w.until("it is cordoned", |s| s.get::<RobotControl>("r1").is_some_and(|c| c.cordon.is_some())).await;
    assert_eq!(seen.get::<RobotControl>("r1").and_then(|c| c.cordon).map(|c| c.actor), Some("anna".to_owned()));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_nobody_has_heard_is_the_sites() {
    let mut w = world().await;
    w.robot("r3", "park-1").await;
    w.step().await;
    w.board.remove(&RobotId::parse("r3").expect("an id"));
    assert_eq!(code(w.fleet.cordon_robot(asked(&anna(&["operator@hall"]), cordon("r3"))).await), Code::NotFound);
    assert_eq!(code(w.fleet.cordon_robot(asked(&anna(&["operator"]), cordon("r3"))).await), Code::Ok);
}

#[tokio::test(start_paused = true)]
async fn rules_of_an_area_are_seen_and_put_by_whoever_may_there() {
    let w = world().await;
    let anna = anna(&["operator@hall", "viewer@quality"]);
    let get = async |area: &str| {
        let request = v1::GetAreaPolicyRequest { area_id: area.to_owned() };
        w.fleet.get_area_policy(asked(&anna, request)).await.map(|got| got.into_inner().policy)
    };
    assert_eq!(get("packing").await.expect_err("not seen").code(), Code::NotFound);
    for (area, expected) in [("hall", Code::Ok), ("quality", Code::PermissionDenied)] {
        let policy = get(area).await.expect("seen");
        let put = v1::PutAreaPolicyRequest { policy, ..Default::default() };
        assert_eq!(code(w.fleet.put_area_policy(asked(&anna, put)).await), expected, "{area}");
    }
    let mut policy = get("hall").await.expect("seen").expect("rules");
    (policy.area_id, policy.etag) = ("packing".to_owned(), String::new());
    let put = v1::PutAreaPolicyRequest { policy: Some(policy), ..Default::default() };
    assert_eq!(code(w.fleet.put_area_policy(asked(&anna, put)).await), Code::NotFound);
}

#[tokio::test(start_paused = true)]
async fn lists_have_what_lies_where_the_caller_sees() {
    let w = world().await;
    let places = async |by: &Caller| {
        let request = v1::ListPlacesRequest { page_size: 1_000, ..Default::default() };
        let answer = w.fleet.list_places(asked(by, request)).await.expect("a page").into_inner();
        answer.places.into_iter().map(|place| place.place_id).collect::<Vec<_>>()
    };
    let has = |all: &[String], id: &str| all.iter().any(|place| place == id);
    let own = places(&anna(&["viewer@quality"])).await;
    assert!(has(&own, "Q01") && !has(&own, "A01") && !has(&own, "door"), "{own:?}");
    let both = places(&anna(&["viewer@quality", "viewer@hall"])).await;
    assert!(
        has(&both, "Q01") && has(&both, "A01") && has(&both, "door"),
        "a passage lies in all that it leads through"
    );
    let all = places(&anna(&["viewer"])).await;
    assert_eq!(all.len(), w.site.places().len());
    let clear = |place_id: &str| v1::ClearPlaceRequest {
        place_id: place_id.to_owned(),
        reason: "empty".to_owned(),
        etag: "1".to_owned(),
        ..Default::default()
    };
    let anna = anna(&["operator@hall", "viewer@quality"]);
    for (place, expected) in
        [("Q01", Code::PermissionDenied), ("P01", Code::NotFound), ("door", Code::PermissionDenied)]
    {
        assert_eq!(code(w.fleet.clear_place(asked(&anna, clear(place))).await), expected, "{place}");
    }
    let block = |place_id: &str| {
        let (place_id, reason) = (place_id.to_owned(), "a spill".to_owned());
        v1::BlockPlaceRequest { place_id, reason, ..Default::default() }
    };
    for (place, expected) in
        [("Q01", Code::PermissionDenied), ("P01", Code::NotFound), ("door", Code::PermissionDenied), ("A01", Code::Ok)]
    {
        assert_eq!(code(w.fleet.block_place(asked(&anna, block(place))).await), expected, "{place}");
    }
    let own = w.fleet.clear_place(asked(&anna, clear("A01"))).await;
    assert!(!matches!(code(own), Code::PermissionDenied | Code::NotFound), "it is hers");
}

#[tokio::test(start_paused = true)]
async fn an_incident_is_shown_and_closed_where_what_it_is_about_is() {
    let mut w = world().await;
    w.submit("T1", "Q01", "A01").await;
    w.stop_fleet().await;
    let robot = |id: &str| Some(RobotId::parse(id).expect("an id"));
    let incident = |id: &str, robot_id: Option<RobotId>, task_id: Option<&str>| Incident {
        id: id.to_owned(),
        reason: Why::CloneSeen.into(),
        robot_id,
        task_id: task_id.map(|id| TaskId::parse(id).expect("an id")),
        area_id: None,
        opened_unix_ms: Utc(1),
        closed: None,
    };
    let rows = [
        incident("i-r1", robot("r1"), None),
        incident("i-r2", robot("r2"), None),
        incident("i-site", None, None),
        incident("i-t1", None, Some("T1")),
    ];
    w.left_behind(&rows).await;
    let counter = |id: &str| RobotCounter {
        robot_id: RobotId::parse(id).expect("an id"),
        software: "walk-1".to_owned(),
        succeeded: 1,
        failures: Default::default(),
        stats: Default::default(),
        errands: Default::default(),
        attached_ms: 1,
        counted: Default::default(),
        energy_sums: Default::default(),
    };
    w.left_behind(&[counter("r1"), counter("r2")]).await;
    w.start_fleet();
    w.pass(1).await;
    let listed = async |by: &Caller| {
        let answer = w.fleet.list_incidents(asked(by, v1::ListIncidentsRequest::default())).await.expect("a page");
        answer.into_inner().incidents.into_iter().map(|i| i.incident_id).collect::<Vec<_>>()
    };
    assert_eq!(listed(&anna(&["viewer"])).await, ["i-r1", "i-r2", "i-site", "i-t1"]);
    assert_eq!(listed(&anna(&["viewer@hall"])).await, ["i-r1"]);
    assert_eq!(listed(&anna(&["viewer@hall", "viewer@quality"])).await, ["i-r1", "i-r2", "i-t1"]);
    let anna = anna(&["operator@hall", "viewer@quality"]);
    let close = |id: &str| v1::CloseIncidentRequest {
        incident_id: id.to_owned(),
        reason: "looked".to_owned(),
        ..Default::default()
    };
    for (id, expected) in [("i-site", Code::NotFound), ("i-r2", Code::PermissionDenied), ("i-r1", Code::Ok)] {
        assert_eq!(code(w.fleet.close_incident(asked(&anna, close(id))).await), expected, "{id}");
        let get = v1::GetIncidentRequest { incident_id: id.to_owned() };
        let seen = if expected == Code::NotFound { expected } else { Code::Ok };
        assert_eq!(code(w.fleet.get_incident(asked(&anna, get)).await), seen, "{id}");
    }
    let counted = async |by: &Caller| {
        let answer = w.fleet.list_counters(asked(by, v1::ListCountersRequest::default())).await.expect("a page");
        // One that was called from its errand has a counter of that too.
        answer.into_inner().counters.into_iter().map(|c| c.robot_id).collect::<BTreeSet<_>>()
    };
    assert_eq!(counted(&self::anna(&["viewer@hall"])).await, BTreeSet::from(["r1".to_owned()]));
    assert_eq!(counted(&self::anna(&["viewer"])).await, BTreeSet::from(["r1".to_owned(), "r2".to_owned()]));
}

#[tokio::test(start_paused = true)]
async fn why_a_task_waits_is_told_to_whoever_sees_it_and_names_the_robots_that_it_sees() {
    let mut w = world().await;
    w.r("r1").drives = false;
    w.submit_with("T1", "Q01", "Q01", |raw| raw.selector_labels = [("none".to_owned(), "has-it".to_owned())].into())
        .await;
    w.submit_with("T2", "A01", "A01", |raw| raw.selector_labels = [("none".to_owned(), "has-it".to_owned())].into())
        .await;
    w.step().await;
    let explained = async |by: &Caller, id: &str| {
        let answer = w.fleet.explain_task(asked(by, v1::ExplainTaskRequest { task_id: id.to_owned() })).await?;
        let explanation = answer.into_inner().explanation.expect("always set");
        Ok::<_, Status>(explanation.candidates.into_iter().map(|c| c.robot_id).collect::<Vec<_>>())
    };
    let own = anna(&["viewer@hall"]);
    assert_eq!(explained(&own, "T1").await.expect_err("not seen").code(), Code::NotFound);
    assert_eq!(explained(&own, "T2").await.expect("seen"), ["r1"]);
    assert_eq!(explained(&anna(&["viewer"]), "T2").await.expect("seen"), ["r1", "r2"]);
}
