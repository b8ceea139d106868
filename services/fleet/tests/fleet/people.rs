//! What people ask of fleet: rules of areas, cordons, answers to NEEDS_OPERATOR.

use crate::harness::{World, jam};
use midshift_core::ids::TaskId;
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::{Ask, Phase, Resolution};
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

#[tokio::test(start_paused = true)]
async fn rules_put_for_an_area_reach_every_robot() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.until("both have the site's rules", |s| {
        ["r1", "r2"].iter().all(|r| s.get::<midshift_core::desired_state::DesiredPolicy>(r).is_some())
    })
    .await;
    let get = v1::GetAreaPolicyRequest { area_id: "rooms".to_owned() };
    let mut policy = w.fleet.get_area_policy(local(get)).await.expect("rules").into_inner().policy.expect("rules");
    assert_eq!(policy.speed_limit_mm_s, Some(1_500));
    policy.speed_limit_mm_s = Some(600);
    let put = v1::PutAreaPolicyRequest { policy: Some(policy), ..Default::default() };
    w.fleet.put_area_policy(local(put)).await.expect("put");
    let before = w.seen().await;
    let limit = |s: &crate::harness::Seen, r: &str| s.policy(r).areas[0].speed_limit_mm_s;
    w.until("both have the new rules", |s| ["r1", "r2"].iter().all(|r| limit(s, r) == Some(600))).await;
    w.robot("r3", "A").await;
    let seen =
        w.until("who comes later too", |s| s.get::<midshift_core::desired_state::DesiredPolicy>("r3").is_some()).await;
    assert_eq!(limit(&seen, "r3"), Some(600));
    assert!(seen.policy("r1").generation >= before.policy("r1").generation);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_area_where_people_walk_is_slow_until_a_person_puts_another_limit() {
    let mut w = World::on(CORRIDOR.replace("speed_limit_mm_s = 1500", "people = true").leak()).await;
    w.robot("r1", "park-a").await;
    let limits = |s: &crate::harness::Seen| {
        let areas = s.get::<midshift_core::desired_state::DesiredPolicy>("r1").map(|p| p.areas).unwrap_or_default();
        areas.first().map(|rules| (rules.speed_limit_mm_s, rules.avoidance_distance_mm))
    };
    w.until("the robot has them", |s| limits(s) == Some((Some(600), Some(500)))).await;
    let get = || v1::GetAreaPolicyRequest { area_id: "rooms".to_owned() };
    let rules = |w: &World| {
        let fleet = w.fleet.clone();
        async move { fleet.get_area_policy(local(get())).await.expect("rules").into_inner().policy.expect("rules") }
    };
    let shown = rules(&w).await;
    assert_eq!((shown.speed_limit_mm_s, shown.avoidance_distance_mm), (Some(600), Some(500)));
    let put = async |w: &World, policy: v1::AreaPolicy| {
        let put = v1::PutAreaPolicyRequest { policy: Some(policy), ..Default::default() };
        w.fleet.put_area_policy(local(put)).await.expect("put").into_inner().policy.expect("rules")
    };
    let greater = put(&w, v1::AreaPolicy { speed_limit_mm_s: Some(900), ..shown }).await;
    assert_eq!(greater.speed_limit_mm_s, Some(900));
    w.until("a greater one stays", |s| limits(s) == Some((Some(900), Some(500)))).await;
    let none = v1::AreaPolicy { speed_limit_mm_s: None, avoidance_distance_mm: None, ..greater };
    assert_eq!(put(&w, none).await.speed_limit_mm_s, Some(600));
    w.until("none of its own is the slow one", |s| limits(s) == Some((Some(600), Some(500)))).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn charging_thresholds_of_the_site_file_hold_until_a_person_puts_others() {
    let text: &'static str = Box::leak(
        CORRIDOR
            .replace("speed_limit_mm_s = 1500", "charge_mandatory_permille = 400, charge_preemptible_permille = 450")
            .into_boxed_str(),
    );
    let mut w = World::on(text).await;
    w.robot("r1", "park-b").await;
    w.r("r1").battery_permille = 350;
    w.r("r1").works = false;
    w.beat("r1");
    w.submit("T1", "A", "B").await;
    w.until("the site's threshold sends it to charge", |s| s.errand("r1").is_some()).await;
    w.pass_while(30, "and keeps it there", |s| s.phase("T1") == Phase::Queued).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_cordoned_robot_finishes_its_work_and_gets_no_more() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    w.submit("T1", "A01", "D01").await;
    w.until_phase("T1", Phase::Running).await;
    let cordon = v1::CordonRobotRequest { robot_id: "r1".to_owned(), reason: "wheel".to_owned(), ..Default::default() };
    w.fleet.cordon_robot(local(cordon)).await.expect("cordoned");
    w.submit("T2", "A01", "D01").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.pass_while(60, "it is out of dispatch", |s| s.phase("T2") == Phase::Queued).await;
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
    w.fleet.uncordon_robot(local(uncordon)).await.expect("uncordoned");
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_person_who_answers_ends_the_question() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let answers = [
        (Resolution::Succeeded, Phase::Succeeded),
        (Resolution::Failed, Phase::Failed),
        (Resolution::Canceled, Phase::Canceled),
        (Resolution::Requeue, Phase::Succeeded),
    ];
    for (n, (resolution, end)) in answers.into_iter().enumerate() {
        let id = format!("T{n}");
        w.r("r1").fails = Some((0, jam()));
        w.submit(&id, "A", "B").await;
        w.until_phase(&id, Phase::NeedsOperator).await;
        w.ask(Ask::Resolve { task_id: TaskId::parse(&id).expect("an id"), resolution }).await;
        let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
        w.fleet.uncordon_robot(local(uncordon)).await.expect("uncordoned");
        w.until_phase(&id, end).await;
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_item_handed_over_by_a_person_is_brought_on_by_another_robot_without_a_second_pick() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").fails = Some((2, jam()));
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::NeedsOperator).await;
    w.r("r1").load = None;
    w.r("r1").cut();
    w.robot("r2", "park-b").await;
    let task_id = TaskId::parse("T1").expect("an id");
    w.ask(Ask::Resolve { task_id, resolution: Resolution::RequeueHandedOver }).await;
    let seen = w.until("r2 has it", |s| s.task("T1").epoch == 2).await;
    assert_eq!(seen.robot_of("T1").as_deref(), Some("r2"));
    let work = seen.work("r2").assignment.expect("an assignment");
    assert_eq!(work.resume_step, 2, "after the pick");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_command_is_carried_out_once_whatever_is_lost_of_its_answer() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let cordon = |reason: &str| v1::CordonRobotRequest {
        robot_id: "r1".to_owned(),
        request_id: "cordon-1".to_owned(),
        reason: reason.to_owned(),
        ..Default::default()
    };
    w.fleet.cordon_robot(local(cordon("a wheel"))).await.expect("is done");
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
    w.fleet.uncordon_robot(local(uncordon)).await.expect("is done");
    let again = w.fleet.cordon_robot(local(cordon("a wheel"))).await.expect("was done").into_inner();
    assert_eq!(again.control.expect("a control").duty, v1::Duty::InWork as i32, "and not done again");
    w.stop_fleet().await;
    w.start_fleet();
    let again = w.fleet.cordon_robot(local(cordon("a wheel"))).await.expect("was done").into_inner();
    assert_eq!(again.control.expect("a control").duty, v1::Duty::InWork as i32, "nor after a restart");
    let other = w.fleet.cordon_robot(local(cordon("an arm"))).await.expect_err("says something else");
    assert_eq!(other.code(), tonic::Code::AlreadyExists);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn of_two_that_ask_the_same_at_once_neither_is_told_that_it_is_done_before_it_is() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let cordon = || {
        let request_id = "cordon-1".to_owned();
        w.fleet.cordon_robot(local(v1::CordonRobotRequest {
            robot_id: "r1".to_owned(),
            request_id,
            reason: "a wheel".to_owned(),
            ..Default::default()
        }))
    };
    w.shaky.fail(true);
    let (first, second) = tokio::join!(cordon(), cordon());
    for answer in [first, second] {
        assert_eq!(answer.expect_err("nothing was stored").code(), tonic::Code::Unavailable);
    }
    w.shaky.fail(false);
    cordon().await.expect("is done");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_incident_is_listed_until_a_person_has_looked_into_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.clone_seen("r1").await;
    w.until("a person is told", |s| !s.incidents().is_empty()).await;
    let list = |include_closed: bool| {
        let fleet = w.fleet.clone();
        async move {
            let request = v1::ListIncidentsRequest { include_closed, ..Default::default() };
            fleet.list_incidents(local(request)).await.expect("a list").into_inner().incidents
        }
    };
    let open = list(false).await;
    let [incident] = open.as_slice() else { panic!("{open:?}") };
    assert_eq!((incident.robot_id.as_str(), incident.closed.as_ref()), ("r1", None));
    let incident_id = incident.incident_id.clone();
    let close = |reason: &str| v1::CloseIncidentRequest {
        incident_id: incident_id.clone(),
        reason: reason.to_owned(),
        etag: incident.etag.clone(),
        ..Default::default()
    };
    let refused = w.fleet.close_incident(local(close(""))).await.expect_err("without a reason");
    assert_eq!(refused.code(), tonic::Code::InvalidArgument);
    w.fleet.close_incident(local(close("a spare part"))).await.expect("is closed");
    assert_eq!(list(false).await, []);
    let all = list(true).await;
    assert_eq!(all[0].closed.as_ref().map(|c| c.reason.as_str()), Some("a spare part"));
    let again = w.fleet.close_incident(local(close("twice"))).await.expect_err("is closed already");
    assert_eq!(again.code(), tonic::Code::NotFound);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_incident_is_found_by_the_beginning_of_its_id_open_or_closed() {
    let mut w = World::on(CORRIDOR).await;
    for (robot, place) in [("r1", "park-a"), ("r2", "park-b")] {
        w.robot(robot, place).await;
        w.clone_seen(robot).await;
    }
    w.until("a person is told of both", |s| s.incidents().len() == 2).await;
    let begin = |prefix: &str, include_closed: bool| {
        let request = v1::ListIncidentsRequest {
            incident_id_prefix: prefix.to_owned(),
            include_closed,
            ..v1::ListIncidentsRequest::default()
        };
        let fleet = w.fleet.clone();
        async move {
            let page = fleet.list_incidents(local(request)).await.expect("a list").into_inner();
            page.incidents.into_iter().map(|incident| incident.incident_id).collect::<Vec<_>>()
        }
    };
    let all = begin("", false).await;
    let [first, second] = all.as_slice() else { panic!("{all:?}") };
    let common = first.bytes().zip(second.bytes()).take_while(|(a, b)| a == b).count();
    assert_eq!(begin(&first[..common], false).await, all);
    for id in [first, second] {
        assert_eq!(begin(&id[..=common], false).await, std::slice::from_ref(id));
    }
    assert_eq!(begin("~", false).await, Vec::<String>::new());
    let close = v1::CloseIncidentRequest {
        incident_id: first.clone(),
        reason: "a spare part".to_owned(),
        ..v1::CloseIncidentRequest::default()
    };
    w.fleet.close_incident(local(close)).await.expect("is closed");
    assert_eq!(begin(first, false).await, Vec::<String>::new());
    assert_eq!(begin(&first[..=common], true).await, std::slice::from_ref(first));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn the_hours_of_a_robot_without_work_are_counted_and_not_forgotten_by_a_restart() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(1_300).await;
    w.stop_fleet().await;
    w.start_fleet();
    w.pass(1).await;
    let request = v1::ListCountersRequest::default();
    let counters = w.fleet.list_counters(local(request)).await.expect("a list").into_inner().counters;
    let heard_s = counters[0].attached_ms / 1_000;
    assert!((1_190..=1_310).contains(&heard_s), "{heard_s} s");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_person_lets_the_server_ignore_an_attempt_that_nobody_knows_once_its_robot_stands() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let attempt = midshift_core::ids::AttemptId {
        subject: midshift_core::ids::Subject::parse("T-elsewhere").expect("a subject"),
        epoch: 3,
    };
    w.r("r1").lists = vec![midshift_core::robot::ReportedAttempt {
        attempt: attempt.clone(),
        state: midshift_core::robot::WorkState::Executing,
        step_index: 1,
        progress: 1,
        route_index: 0,
        opened: false,
    }];
    w.until("a person is told", |s| !s.open_incidents("ATTEMPT_UNKNOWN").is_empty()).await;
    w.submit("T1", "A", "B").await;
    w.pass_while(10, "it gets no work", |s| s.phase("T1") == Phase::Queued).await;
    let ask = |epoch| v1::DisownAttemptRequest {
        robot_id: "r1".to_owned(),
        subject: "T-elsewhere".to_owned(),
        epoch,
        reason: "a leftover of the old site".to_owned(),
        ..Default::default()
    };
    w.fleet.disown_attempt(local(ask(4))).await.expect_err("it lists no such attempt");
    w.r("r1").speed_mm_s = 300;
    w.pass(2).await;
    w.fleet.disown_attempt(local(ask(3))).await.expect_err("it moves");
    w.r("r1").speed_mm_s = 0;
    w.pass(2).await;
    w.fleet.disown_attempt(local(ask(3))).await.expect("it is ignored");
    let seen = w.seen().await;
    assert!(seen.open_incidents("ATTEMPT_UNKNOWN").is_empty(), "the incident is over");
    assert!(seen.has("r1", "park-a"), "no place is freed");
    assert_eq!(seen.control("r1").disowned, [attempt]);
    w.until_phase("T1", Phase::Succeeded).await;
    w.r("r1").lists.clear();
    w.until("it is forgotten", |s| s.control("r1").disowned.is_empty()).await;
    w.lawful().await;
}
