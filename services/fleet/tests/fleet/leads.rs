//! Several processes of fleet over one store: one plans, the others stand by and carry out what people ask.

use crate::harness::{Shaky, World};
use midshift_core::desired_state::DesiredPolicy;
use midshift_core::fleet::rows::SiteRow;
use midshift_core::leadership::FleetLeader;
use midshift_core::reason::Code;
use midshift_core::rows::Table;
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::Phase;
use midshift_fleet::FleetService;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService as Face;
use std::sync::Arc;
use tonic::Request;

/// Who holds the lease.
async fn holder(w: &World) -> String {
    let row = midshift_store::load::<FleetLeader>(&*w.store, "fleet").await.expect("a store");
    row.map(|(row, _)| row.holder).unwrap_or_default()
}

/// A world with two processes, the first of which leads, and the second one's face and way to the store.
async fn two(site: &'static str) -> (World, FleetService, Arc<Shaky>) {
    let mut w = World::shared(site).await;
    let first = holder(&w).await;
    assert!(!first.is_empty(), "the first one leads at once");
    let (other, way) = w.other_process();
    w.pass(11).await;
    assert_eq!(holder(&w).await, first, "the second one lets it");
    (w, other, way)
}

fn cordon(id: &str, request_id: &str) -> Request<v1::CordonRobotRequest> {
    let (robot_id, reason, request_id) = (id.to_owned(), "wheel".to_owned(), request_id.to_owned());
    local(v1::CordonRobotRequest { robot_id, reason, request_id, ..Default::default() })
}

#[tokio::test(start_paused = true)]
async fn one_of_two_processes_plans_and_nothing_conflicts() {
    let (mut w, _other, way) = two(DEMO).await;
    for (n, at) in ["park-1", "park-2", "park-3", "park-4"].iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    for n in 0..8 {
        w.submit(&format!("T{n}"), "A01", "D01").await;
    }
    for n in 0..8 {
        let seen = w.until_phase(&format!("T{n}"), Phase::Succeeded).await;
        assert_eq!(seen.task(&format!("T{n}")).epoch, 1, "assigned once");
    }
    assert_eq!((w.shaky.conflicts(), way.conflicts()), (0, 0));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_leader_that_is_killed_is_followed_by_the_other_process_and_a_task_at_work_goes_on() {
    let (mut w, other, _way) = two(CORRIDOR).await;
    let first = holder(&w).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.kill_first().await;
    w.submit("T2", "A", "B").await;
    w.pass(2).await;
    assert_eq!(holder(&w).await, first, "nobody knows yet that it is dead");
    w.pass(3).await;
    let second = holder(&w).await;
    assert!(second != first && !second.is_empty(), "{second}");
    w.r("r1").works = true;
    for task in ["T1", "T2"] {
        let seen = w.until_phase(task, Phase::Succeeded).await;
        assert_eq!(seen.task(task).epoch, 1);
    }
    drop(other);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_leader_that_ends_as_asked_hands_over_at_once() {
    let (mut w, _other, _way) = two(CORRIDOR).await;
    let first = holder(&w).await;
    w.robot("r1", "park-a").await;
    w.end_first().await;
    // A quarter of a second: the wake of what it wrote, or the sweep.
    w.step().await;
    let second = holder(&w).await;
    assert!(second != first && !second.is_empty(), "{second}");
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_process_of_a_store_that_opens_once_leads_at_once_whoever_held_it_before() {
    let mut w = World::on(CORRIDOR).await;
    let first = holder(&w).await;
    assert!(!first.is_empty());
    w.kill_first().await;
    w.start_fleet();
    w.step().await;
    let second = holder(&w).await;
    assert!(second != first && !second.is_empty(), "{second}");
    let lease = |w: &World| {
        let store = w.store.clone();
        async move { midshift_store::load::<FleetLeader>(&*store, "fleet").await.expect("a store").expect("a row").1 }
    };
    let before = lease(&w).await;
    w.pass(30).await;
    assert_eq!(lease(&w).await, before, "nobody watches, so nothing is renewed");
}

#[tokio::test(start_paused = true)]
async fn a_command_sent_to_the_standby_is_done_once_and_the_leader_obeys_it() {
    let (mut w, other, way) = two(DEMO).await;
    w.robot("r1", "park-1").await;
    w.pass(2).await;
    other.cordon_robot(cordon("r1", "ask-1")).await.expect("cordoned");
    let before = w.seen().await.revision("robot_control", "r1");
    // The answer was lost, and the proxy asks the other process.
    w.fleet.cordon_robot(cordon("r1", "ask-1")).await.expect("done already");
    other.cordon_robot(cordon("r1", "ask-1")).await.expect("done already");
    assert_eq!(w.seen().await.revision("robot_control", "r1"), before, "written once");
    let refused = other.uncordon_robot(local(v1::UncordonRobotRequest {
        robot_id: "r1".to_owned(),
        request_id: "ask-1".to_owned(),
        ..Default::default()
    }));
    assert_eq!(refused.await.expect_err("it was something else").code(), tonic::Code::AlreadyExists);
    w.submit("T1", "A01", "D01").await;
    w.pass_while(20, "the leader obeys", |s| s.phase("T1") == Phase::Queued).await;
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
    other.uncordon_robot(local(uncordon)).await.expect("uncordoned");
    w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!((w.shaky.conflicts(), way.conflicts()), (0, 0));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_command_sent_to_both_processes_at_once_is_done_once_and_both_say_so() {
    let (mut w, other, _way) = two(DEMO).await;
    w.robot("r1", "park-1").await;
    w.pass(2).await;
    w.shaky.freeze_next_commit();
    let leader = w.fleet.clone();
    let asked = tokio::spawn(async move { leader.cordon_robot(cordon("r1", "ask-1")).await });
    while !w.shaky.is_frozen() {
        tokio::task::yield_now().await;
    }
    other.cordon_robot(cordon("r1", "ask-1")).await.expect("cordoned");
    let written = w.seen().await.revision("robot_control", "r1");
    w.shaky.freeze(false);
    let control = asked.await.expect("it ends").expect("it is decided anew").into_inner().control.expect("a robot");
    assert!(control.cordon.is_some() && w.shaky.conflicts() > 0, "both decided it");
    assert_eq!(w.seen().await.revision("robot_control", "r1"), written, "written once");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn rules_that_the_standby_put_reach_every_robot() {
    let (mut w, other, _way) = two(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.until("it has the site's rules", |s| s.get::<DesiredPolicy>("r1").is_some()).await;
    let get = v1::GetAreaPolicyRequest { area_id: "rooms".to_owned() };
    let mut policy = other.get_area_policy(local(get)).await.expect("rules").into_inner().policy.expect("rules");
    policy.speed_limit_mm_s = Some(600);
    let put = v1::PutAreaPolicyRequest { policy: Some(policy), ..Default::default() };
    other.put_area_policy(local(put)).await.expect("put");
    w.until("it has the new ones", |s| s.policy("r1").areas[0].speed_limit_mm_s == Some(600)).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_standby_answers_what_the_leader_answers() {
    let (mut w, other, _way) = two(DEMO).await;
    w.robot("r1", "park-1").await;
    w.r("r1").works = false;
    for n in 0..4 {
        w.submit(&format!("T{n}"), "A01", "D01").await;
    }
    w.until_phase("T0", Phase::Running).await;
    w.pass(2).await;
    let slots = |view: &midshift_core::fleet::projection::FleetProjection| {
        let ready: Vec<_> = view.queue.ready().collect();
        format!("{:?} {:?} {:?} {:?} {ready:?}", view.tasks, view.attempts, view.places, view.authority)
    };
    let led = w.fleet.query_projection(move |view, _, _| slots(view)).await.expect("it runs");
    let stood_by = other.query_projection(move |view, _, _| slots(view)).await.expect("it runs");
    assert_eq!(led, stood_by);
}

#[tokio::test(start_paused = true)]
async fn a_command_whose_rows_always_move_is_refused_and_can_be_asked_again() {
    let (mut w, other, way) = two(DEMO).await;
    w.robot("r1", "park-1").await;
    w.pass(2).await;
    way.outrun(Some(Table::RobotControl));
    let refused = other.cordon_robot(cordon("r1", "ask-1")).await.expect_err("somebody is always faster");
    assert_eq!(refused.code(), tonic::Code::Unavailable);
    assert_eq!(refused.message(), midshift_core::reason::Reason::from(Code::MovedMeanwhile).text());
    assert!(way.conflicts() > 1, "it was decided anew");
    assert!(w.seen().await.control("r1").cordon.is_none());
    way.outrun(None);
    other.cordon_robot(cordon("r1", "ask-1")).await.expect("nobody is faster now");
    assert!(w.seen().await.control("r1").cordon.is_some());
}

#[tokio::test(start_paused = true)]
async fn a_leader_that_was_frozen_steps_down_and_nothing_of_what_it_wanted_is_done_twice() {
    let (mut w, _other, _way) = two(DEMO).await;
    let first = holder(&w).await;
    for (n, at) in ["park-1", "park-2"].iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    w.pass(2).await;
    w.submit("T1", "A01", "D01").await;
    w.submit("T2", "B03", "D01").await;
    // It has read the tasks, decided, and stands still before its items are on their way.
    w.shaky.freeze_next_commit();
    w.pass(8).await;
    assert!(w.shaky.is_frozen(), "it was about to write");
    let second = holder(&w).await;
    assert!(second != first && !second.is_empty(), "{second}");
    w.pass(50).await;
    w.shaky.freeze(false);
    w.pass(5).await;
    assert_eq!(holder(&w).await, second, "it stands by");
    assert!(w.shaky.conflicts() > 0, "what it wanted came too late");
    for task in ["T1", "T2"] {
        let seen = w.until_phase(task, Phase::Succeeded).await;
        assert_eq!(seen.task(task).epoch, 1, "assigned once");
    }
    w.lawful().await;
}

/// Version of the map that is stored.
async fn stored_map(w: &World) -> String {
    let row = midshift_store::load::<SiteRow>(&*w.store, w.site.site_id().as_str()).await.expect("a store");
    row.expect("a map").0.map_version
}

#[tokio::test(start_paused = true)]
async fn a_standby_with_another_map_writes_it_when_it_leads_and_ends_instead_if_something_is_in_its_way_by_then() {
    let (before, after) = ("id = \"B\", at = [18000, 3000]", "id = \"B\", at = [18000, 4000]");
    let changed = CORRIDOR.replace(before, after).replace("map_version = \"1\"", "map_version = \"2\"");
    for is_busy in [false, true] {
        let mut w = World::shared(CORRIDOR).await;
        w.other_process_by(&changed);
        w.pass(2).await;
        if is_busy {
            w.robot("r1", "park-a").await;
            w.r("r1").works = false;
            w.submit("T1", "A", "B").await;
            w.until_phase("T1", Phase::Running).await;
        }
        w.kill_first().await;
        w.pass(10).await;
        if is_busy {
            let outdated = w.last_outdated().await;
            assert_eq!(outdated.0.code, Code::MapNotTaken);
            assert_eq!(outdated.0.metadata.get("tasks").map(String::as_str), Some("T1"));
            assert_eq!(holder(&w).await, "", "another process may lead at once");
        }
        assert_eq!(stored_map(&w).await, if is_busy { "1" } else { "2" });
        w.lawful().await;
    }
}
