//! Callers who may do something in some areas only, at the process that leads and at the one that does not.

use super::*;
use midshift_core::audit::AuditRow;
use midshift_core::identity::{Caller, TokenId};
use midshift_store::Query;
use tonic::{Code, Request, Response, Status};

fn asked<T>(by: &Caller, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.extensions_mut().insert(by.clone());
    request
}

fn holder(name: &str, grants: &[&str]) -> Caller {
    let grants = grants.iter().map(|grant| (*grant).to_owned().into()).collect();
    Caller::holder(TokenId::new("t1").expect("an id"), name.into(), grants, false)
}

fn code<T>(answer: Result<Response<T>, Status>) -> Code {
    answer.map_or_else(|refused| refused.code(), |_| Code::Ok)
}

fn spec(areas: &[&str]) -> Option<v1::RolloutSpec> {
    let wave = v1::RolloutWave { size: Some(v1::rollout_wave::Size::Rest(true)) };
    let area_ids = areas.iter().map(ToString::to_string).collect();
    Some(v1::RolloutSpec {
        bundle: "walk-1.0.0".to_owned(),
        selector: Some(v1::RolloutSelector { area_ids, ..Default::default() }),
        waves: vec![wave],
        allow_full_push: true,
        ..Default::default()
    })
}

#[tokio::test(start_paused = true)]
async fn roll_outs_are_written_seen_and_approved_by_whoever_may_where_they_are_for() {
    let world = World::new();
    let leader = world.process().await;
    release(&leader.ota, &files("walk", "1.0.0")).await;
    let standby = world.process().await;
    secs(2).await;
    let anna = holder("anna", &["ota-author@hall", "ota-full-push@hall", "ota-approver@hall", "viewer@quality"]);
    let blind = holder("ben", &["ota-approver@hall"]);
    let carl = holder("carl", &["ota-author", "ota-full-push"]);
    for process in [&leader, &standby] {
        for areas in [&["quality"][..], &[]] {
            let (id, spec) = ("no".to_owned(), spec(areas));
            let plan = v1::PlanRolloutRequest { rollout_id: id.clone(), spec: spec.clone() };
            assert_eq!(code(Face::plan_rollout(&process.face, asked(&anna, plan)).await), Code::PermissionDenied);
            let create = v1::CreateRolloutRequest { rollout_id: id, spec };
            assert_eq!(code(Face::create_rollout(&process.face, asked(&anna, create)).await), Code::PermissionDenied);
        }
    }
    for (id, area, by) in [("hall", "hall", &anna), ("quality", "quality", &carl)] {
        let create = v1::CreateRolloutRequest { rollout_id: id.to_owned(), spec: spec(&[area]) };
        Face::create_rollout(&standby.face, asked(by, create)).await.expect("the author's area");
    }
    assert_eq!(world.row::<Rollout>("hall").await.expect("a row").0.created.actor, "anna");
    secs(1).await;
    for process in [&leader, &standby] {
        let listed = async |by: &Caller| {
            let answer = Face::list_rollouts(&process.face, asked(by, v1::ListRolloutsRequest::default())).await;
            let rollouts = answer.expect("a page").into_inner().rollouts;
            let mut ids: Vec<String> = rollouts.into_iter().map(|rollout| rollout.rollout_id).collect();
            ids.sort();
            ids
        };
        assert_eq!(listed(&anna).await, ["hall", "quality"]);
        assert_eq!(listed(&blind).await, ["hall"]);
        let begins = async |by: &Caller, prefix: &str| {
            let request = v1::ListRolloutsRequest { rollout_id_prefix: prefix.to_owned(), ..Default::default() };
            let page = Face::list_rollouts(&process.face, asked(by, request)).await.expect("a page").into_inner();
            page.rollouts.into_iter().map(|rollout| rollout.rollout_id).collect::<Vec<_>>()
        };
        assert_eq!(begins(&anna, "q").await, ["quality"], "by the beginning of the id");
        assert_eq!(begins(&blind, "q").await, Vec::<String>::new(), "and nobody sees more by it");
        for (id, expected) in [("hall", Code::Ok), ("quality", Code::NotFound)] {
            let rollout_id = id.to_owned();
            let get = v1::GetRolloutRequest { rollout_id: rollout_id.clone() };
            assert_eq!(code(Face::get_rollout(&process.face, asked(&blind, get)).await), expected, "{id}");
            let robots = v1::ListRolloutRobotsRequest { rollout_id, ..Default::default() };
            assert_eq!(code(Face::list_rollout_robots(&process.face, asked(&blind, robots)).await), expected, "{id}");
        }
        let approve = async |by: &Caller, id: &str| {
            let request = v1::ApproveRolloutRequest { rollout_id: id.to_owned(), ..Default::default() };
            let refused = Face::approve_rollout(&process.face, asked(by, request)).await.expect_err("a draft");
            midshift_proto::refusal_of(&refused).reason
        };
        assert_eq!(approve(&anna, "hall").await, "NOT_YOUR_OWN");
        assert_eq!(approve(&blind, "hall").await, "NOT_ALLOWED_NOW", "somebody else only comes too early");
        assert_eq!(approve(&anna, "quality").await, "NOT_PERMITTED");
        assert_eq!(approve(&blind, "quality").await, "ROLLOUT_NOT_FOUND");
    }
    let rows = world.store.list(Query::all(Table::OtaAudit)).await.expect("rows");
    let rows = rows.iter().map(|row| serde_json::from_str::<AuditRow>(&row.body).expect("a row"));
    let denied: Vec<String> = rows
        .filter(|row| row.action == "rollout.approve" && row.actor == "anna")
        .map(|row| format!("{} {}", row.about.join(" "), row.outcome))
        .collect();
    let twice = ["rollout:hall NOT_YOUR_OWN", "rollout:quality NOT_PERMITTED"].repeat(2);
    assert_eq!(denied, twice, "by the one that leads and by the other");
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn nobody_watches_a_roll_out_that_it_may_not_see() {
    let world = World::new();
    let process = world.process().await;
    release(&process.ota, &files("walk", "1.0.0")).await;
    secs(2).await;
    let create = v1::CreateRolloutRequest { rollout_id: "quality".to_owned(), spec: spec(&["quality"]) };
    Face::create_rollout(&process.face, local(create)).await.expect("everything");
    let first = async |by: &Caller| {
        let request = v1::WatchRolloutRequest { rollout_id: "quality".to_owned(), ..Default::default() };
        let mut stream = Face::watch_rollout(&process.face, asked(by, request)).await.expect("a stream").into_inner();
        tokio_stream::StreamExt::next(&mut stream).await.expect("a message").map_err(|status| status.code())
    };
    assert_eq!(first(&holder("ben", &["viewer@hall"])).await.map(drop), Err(Code::NotFound));
    assert!(first(&holder("ben", &["viewer@quality"])).await.is_ok());
    process.end().await;
}
