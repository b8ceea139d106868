//! Rules of the planner, as people see and put them.

use crate::harness::World;
use crate::unknown::rewritten;
use midshift_core::audit::{AuditRow, DONE};
use midshift_core::fleet::assignment::rolling::matching;
use midshift_core::identity::{Caller, TokenId};
use midshift_core::planner_policy::{AssignmentPolicy, PlannerPolicy};
use midshift_core::reason::Code as Why;
use midshift_core::rows::{Record, Table};
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_fleet::FleetService;
use midshift_proto::access::local;
use midshift_proto::convert::duration;
use midshift_proto::convert::fleet::encode_planner;
use midshift_proto::convert::plan::parse_plan;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService as Face;
use midshift_proto::refusal_of;
use midshift_store::Query;
use tonic::{Code, Request, Status};

async fn rules(fleet: &FleetService) -> v1::PlannerPolicy {
    let answer = fleet.get_planner(local(v1::GetPlannerRequest {})).await.expect("rules").into_inner();
    answer.policy.expect("rules")
}

async fn put(fleet: &FleetService, policy: v1::PlannerPolicy) -> Result<v1::PlannerPolicy, Status> {
    let request = v1::PutPlannerRequest { policy: Some(policy), ..Default::default() };
    Ok(fleet.put_planner(local(request)).await?.into_inner().policy.expect("rules"))
}

/// What the planner of the process that answers goes by.
async fn followed(fleet: &FleetService) -> PlannerPolicy {
    fleet.query_projection(|view, _, _| view.planner()).await.expect("it runs")
}

/// Anna, with these rights, asks.
fn anna<T>(grants: &[&str], message: T) -> Request<T> {
    let grants = grants.iter().map(|grant| (*grant).to_owned().into()).collect();
    let by = Caller::holder(TokenId::new("t1").expect("an id"), "anna".into(), grants, false);
    let mut request = Request::new(message);
    request.extensions_mut().insert(by);
    request
}

async fn audited(w: &World) -> Vec<AuditRow> {
    let rows = w.store.list(Query::all(Table::FleetAudit)).await.expect("a store");
    rows.iter().map(|row| AuditRow::read(&row.body).expect("a row")).collect()
}

#[tokio::test(start_paused = true)]
async fn rules_of_the_planner_are_the_default_until_a_person_puts_others_which_outlive_a_restart() {
    let mut w = World::on(CORRIDOR).await;
    let default = PlannerPolicy::default_of(w.site.site_id().clone());
    assert_eq!(rules(&w.fleet).await, encode_planner(&default, None));
    let fifo = PlannerPolicy { policy: AssignmentPolicy::FifoNearest, hysteresis_ms: 1_500, ..default };
    let shown = put(&w.fleet, encode_planner(&fifo, None)).await.expect("put");
    assert_eq!(shown, v1::PlannerPolicy { etag: "1".to_owned(), ..encode_planner(&fifo, None) });
    assert_eq!((rules(&w.fleet).await, followed(&w.fleet).await), (shown.clone(), fifo.clone()));
    w.stop_fleet().await;
    w.start_fleet();
    w.pass(1).await;
    assert_eq!((rules(&w.fleet).await, followed(&w.fleet).await), (shown, fifo));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn rules_of_the_planner_are_put_whole_and_only_over_those_that_were_seen() {
    let w = World::on(CORRIDOR).await;
    let seen = put(&w.fleet, rules(&w.fleet).await).await.expect("the first");
    let changed = v1::PlannerPolicy { ageing_permille: Some(7), ..seen.clone() };
    let changed = put(&w.fleet, changed).await.expect("as it was seen");
    assert_eq!((changed.ageing_permille, changed.etag.as_str()), (Some(7), "2"));
    let late = put(&w.fleet, v1::PlannerPolicy { lateness_permille: Some(8), ..seen }).await.expect_err("moved");
    assert_eq!((late.code(), refusal_of(&late).code), (Code::Aborted, Some(Why::EtagMismatch)));
    assert_eq!(rules(&w.fleet).await, changed);
    let horizon = Some(duration(1_000));
    let whole = put(&w.fleet, v1::PlannerPolicy { horizon, ..Default::default() }).await.expect("whatever it is");
    assert_eq!((whole.horizon, whole.ageing_permille), (horizon, Some(200)), "what is absent takes its default");
    let mut request = v1::PutPlannerRequest { policy: Some(changed), validate_only: true, ..Default::default() };
    let stale = w.fleet.put_planner(local(request.clone())).await.expect_err("moved");
    assert_eq!(stale.code(), Code::Aborted);
    request.policy.as_mut().expect("rules").etag.clear();
    let checked = w.fleet.put_planner(local(request)).await.expect("it would do").into_inner().policy;
    assert_eq!(checked, Some(whole), "nothing is written");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn all_that_is_wrong_with_rules_of_the_planner_is_told_at_once() {
    let w = World::on(CORRIDOR).await;
    let mut before_now = duration(0);
    before_now.seconds = -1;
    let policy = v1::PlannerPolicy {
        site_id: "elsewhere".to_owned(),
        policy: Some(0),
        horizon: Some(duration(61_000)),
        urgent_travel_weight: Some(0),
        normal_travel_weight: Some(101),
        background_travel_weight: Some(101),
        ageing_permille: Some(10_001),
        lateness_permille: Some(10_001),
        hysteresis: Some(before_now),
        energy_ms_per_wh: Some(10_001),
        ..Default::default()
    };
    let request_id = "not one".to_owned();
    let request = v1::PutPlannerRequest { policy: Some(policy), request_id, ..Default::default() };
    let refused = w.fleet.put_planner(local(request)).await.expect_err("wrong");
    assert_eq!(refused.code(), Code::InvalidArgument);
    let mut fields: Vec<String> = refusal_of(&refused).violations.into_iter().map(|v| v.field).collect();
    fields.sort();
    let rules = [
        "ageing_permille",
        "background_travel_weight",
        "energy_ms_per_wh",
        "horizon",
        "hysteresis",
        "lateness_permille",
        "normal_travel_weight",
        "policy",
        "site_id",
        "urgent_travel_weight",
    ];
    let expected: Vec<String> = rules.iter().map(|rule| format!("policy.{rule}")).collect();
    assert_eq!(fields, [expected, vec!["request_id".to_owned()]].concat());
    let nothing = w.fleet.put_planner(local(v1::PutPlannerRequest::default())).await.expect_err("nothing is put");
    assert_eq!(refusal_of(&nothing).violations[0].field, "policy");
    assert_eq!(w.seen().await.all::<PlannerPolicy>(), []);
}

#[tokio::test(start_paused = true)]
async fn rules_of_the_planner_are_the_sites_and_whoever_puts_them_is_noted() {
    let w = World::on(CORRIDOR).await;
    let area = format!("operator@{}", w.site.areas()[0].area_id);
    let request =
        || v1::PutPlannerRequest { policy: Some(Default::default()), request_id: "p1".into(), ..Default::default() };
    for grants in [&[area.as_str()][..], &["viewer", &area], &["dispatcher"]] {
        let refused = w.fleet.put_planner(anna(grants, request())).await.expect_err("not hers");
        assert_eq!((refused.code(), refusal_of(&refused).code), (Code::PermissionDenied, Some(Why::NotPermitted)));
    }
    let unseen = w.fleet.get_planner(anna(&[&area], v1::GetPlannerRequest {})).await.expect_err("not hers");
    assert_eq!(unseen.code(), Code::PermissionDenied);
    assert!(w.fleet.get_planner(anna(&["viewer"], v1::GetPlannerRequest {})).await.is_ok());
    assert_eq!(w.seen().await.all::<PlannerPolicy>(), []);
    w.fleet.put_planner(anna(&["operator"], request())).await.expect("an operator of the site");
    let [put] = w.seen().await.all::<PlannerPolicy>().try_into().expect("one row");
    let notes: Vec<AuditRow> = audited(&w).await.into_iter().filter(|row| row.action == "planner.put").collect();
    let outcomes: Vec<&str> = notes.iter().map(|row| row.outcome.as_str()).collect();
    assert_eq!(outcomes, ["NOT_PERMITTED", "NOT_PERMITTED", "NOT_PERMITTED", DONE]);
    let done = &notes[3];
    assert_eq!((done.actor.as_str(), done.request_id.as_str()), ("anna", "p1"));
    assert_eq!(done.about, [format!("site:{}", w.site.site_id())]);
    assert_eq!(done.with["policy"], *put.body());
    let written = w.written().await;
    let change = written.iter().find(|entry| entry.table == Some(Table::PlannerPolicy)).expect("it is in the feed");
    assert_eq!((&*change.kind, &*change.actor), ("planner.policy_put", "anna"));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn rules_of_the_planner_that_a_standby_put_are_followed_by_the_leader() {
    let mut w = World::shared(CORRIDOR).await;
    let (standby, _way) = w.other_process();
    w.pass(11).await;
    let horizon = Some(duration(7_000));
    let seen = rules(&standby).await;
    put(&standby, v1::PlannerPolicy { horizon, ..seen }).await.expect("put");
    w.pass(1).await;
    assert_eq!(followed(&w.fleet).await.horizon_ms, 7_000);
    assert_eq!(rules(&w.fleet).await, rules(&standby).await);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn rules_of_the_planner_of_a_newer_version_are_left_as_they_are_and_robots_work_by_the_default() {
    let mut w = World::on(CORRIDOR).await;
    let default = PlannerPolicy::default_of(w.site.site_id().clone());
    let put_before = PlannerPolicy { horizon_ms: 0, ..default.clone() };
    put(&w.fleet, encode_planner(&put_before, None)).await.expect("put");
    let id = default.id();
    rewritten(&w, Table::PlannerPolicy, &id, ("\"rolling\"", "\"by_auction\""), None).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    for is_restarted in [false, true] {
        if is_restarted {
            w.stop_fleet().await;
            w.start_fleet();
            w.pass(1).await;
        }
        assert_eq!(followed(&w.fleet).await, default, "restarted: {is_restarted}");
        let refused = put(&w.fleet, encode_planner(&default, None)).await.expect_err("nobody writes over it");
        assert_eq!(refusal_of(&refused).code, Some(Why::RowUnknown), "restarted: {is_restarted}");
        assert_eq!(w.seen().await.open_incidents("ROW_UNKNOWN").len(), 1, "restarted: {is_restarted}");
    }
    rewritten(&w, Table::PlannerPolicy, &id, ("\"by_auction\"", "\"rolling\""), None).await;
    w.pass(1).await;
    assert_eq!(followed(&w.fleet).await, put_before);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_plan_is_shown_with_all_that_it_was_decided_by_to_who_may_read_the_site() {
    let mut w = World::on(CORRIDOR).await;
    let list = |w: &World| {
        let fleet = w.fleet.clone();
        async move { fleet.list_plans(local(v1::ListPlansRequest {})).await.expect("plans").into_inner().plans }
    };
    assert_eq!(list(&w).await, []);
    let none = w.fleet.get_plan(local(v1::GetPlanRequest { number: None })).await.expect_err("none was made");
    assert_eq!((none.code(), refusal_of(&none).code), (Code::NotFound, Some(Why::PlanNotFound)));
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Assigned).await;
    let plans = list(&w).await;
    let first = plans.last().expect("a plan");
    assert_eq!((first.number, first.robots, first.tasks, first.pairs, first.decisions), (1, 1, 1, 1, 1));
    let plan = w.fleet.get_plan(local(v1::GetPlanRequest { number: Some(1) })).await.expect("it").into_inner().plan;
    let plan = plan.expect("always set");
    assert_eq!((plan.robots[0].robot_id.as_str(), plan.tasks[0].task_id.as_str()), ("r1", "T1"));
    let read = parse_plan(plan).expect("as it was shown");
    assert_eq!(matching::choose_pairs(&read.policy, read.at, &read.weighed), read.made);
    let area = format!("viewer@{}", w.site.areas()[0].area_id);
    let unseen = w.fleet.list_plans(anna(&[&area], v1::ListPlansRequest {})).await.expect_err("not hers");
    let unread = w.fleet.get_plan(anna(&[&area], v1::GetPlanRequest { number: None })).await.expect_err("not hers");
    assert_eq!([unseen.code(), unread.code()], [Code::PermissionDenied; 2]);
    assert!(w.fleet.get_plan(anna(&["viewer"], v1::GetPlanRequest { number: Some(1) })).await.is_ok());
    w.lawful().await;
}
