//! Drains: a robot leaves work without a task being lost or a grasp cut, stands parked, and comes back.

use crate::harness::{Seen, World, jam};
use midshift_core::fleet::rows::{Drain, DrainState, HolderState, RobotAuthority, RobotControl, RobotHolder};
use midshift_core::reason::Code;
use midshift_core::robot::Load;
use midshift_core::site::CORRIDOR;
use midshift_core::task::state::Errand;
use midshift_core::task::{Attempt, AttemptPhase, Phase};
use midshift_proto::access::local;
use midshift_proto::convert::duration;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

async fn drain(w: &World, robot: &str, within_s: u64) -> Result<v1::RobotControl, tonic::Status> {
    let request = v1::DrainRobotRequest {
        robot_id: robot.to_owned(),
        reason: "new wheels".to_owned(),
        within: Some(duration(within_s * 1_000)),
        ..Default::default()
    };
    Ok(w.fleet.drain_robot(local(request)).await?.into_inner().control.expect("a control"))
}

async fn undrain(w: &World, robot: &str) {
    let request = v1::UndrainRobotRequest { robot_id: robot.to_owned(), ..Default::default() };
    w.fleet.undrain_robot(local(request)).await.expect("is released");
}

fn state(s: &Seen) -> Option<DrainState> {
    s.all::<Drain>().first().map(|d| d.state)
}

fn is_held(s: &Seen, robot: &str) -> bool {
    let holder = s.get::<RobotAuthority>(robot).map(|a| a.holder);
    let drain = s.all::<Drain>().first().map(|d| RobotHolder::Maintenance(d.drain_id.clone()));
    state(s) == Some(DrainState::Held) && holder == drain
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_parked_is_held_at_once_and_gets_work_again_after_the_release() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    drain(&w, "r1", 600).await.expect("is asked");
    let seen = w.until("it is held", |s| is_held(s, "r1")).await;
    assert_eq!(
        seen.work("r1").maintenance.map(|d| d.to_string()),
        seen.all::<Drain>().first().map(|d| d.drain_id.to_string())
    );
    w.submit("T1", "A", "B").await;
    w.pass_while(60, "it gets no work", |s| s.phase("T1") == Phase::Queued).await;
    let again = drain(&w, "r1", 600).await.expect_err("one at a time");
    assert_eq!(again.code(), tonic::Code::FailedPrecondition);
    undrain(&w, "r1").await;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!((state(&seen), seen.work("r1").maintenance), (None, None));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_at_work_ends_its_task_parks_and_is_held() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    drain(&w, "r1", 3_600).await.expect("is asked");
    w.submit("T2", "A", "B").await;
    let seen = w.until("it is held", |s| is_held(s, "r1")).await;
    assert_eq!((seen.phase("T1"), seen.phase("T2")), (Phase::Succeeded, Phase::Queued));
    let at = w.r("r1").here.to_string();
    assert!(["park-b", "park-a"].contains(&at.as_str()), "it stands in {at}");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_would_take_too_long_is_handed_on_and_done_once() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-b").await;
    w.submit_with("T1", "A", "B", |raw| raw.preemptible = true).await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").drives = false;
    drain(&w, "r1", 60).await.expect("is asked");
    w.robot("r2", "park-a").await;
    w.r("r1").drives = true;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(seen.robot_of("T1").as_deref(), Some("r2"));
    w.until("it is held or was refused", |s| is_held(s, "r1") || state(s) == Some(DrainState::Refused)).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_cannot_be_had_in_time_works_on_and_says_why() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    drain(&w, "r1", 30).await.expect("is asked");
    let seen = w.until("it is given up", |s| state(s) == Some(DrainState::Refused)).await;
    assert_eq!(seen.all::<Drain>()[0].why.as_ref().map(|r| r.code), Some(Code::SkippedBusy));
    assert_eq!(seen.phase("T1"), Phase::Running, "nothing was cut");
    w.r("r1").works = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.submit("T2", "A", "B").await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_with_a_load_keeps_its_task_to_the_end() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.preemptible = true).await;
    w.until("it has picked", |s| s.task("T1").opened_robot_id.is_some()).await;
    w.r("r1").load = Some(Load { task_id: None, item: "box".to_owned() });
    drain(&w, "r1", 20).await.expect("is asked");
    w.robot("r2", "park-b").await;
    let seen = w.until("T1 ends", |s| s.phase("T1").is_terminal()).await;
    assert_eq!((seen.phase("T1"), seen.robot_of("T1").as_deref()), (Phase::Succeeded, Some("r1")));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_with_a_standing_fault_is_not_sent_to_park_until_somebody_has_seen_to_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until("it stands at A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    let r1 = w.r("r1");
    (r1.works, r1.fails, r1.fault) = (true, Some((1, jam())), Some(jam()));
    w.until("it has failed", |s| s.phase("T1") != Phase::Running).await;
    drain(&w, "r1", 600).await.expect("is asked");
    let idle = |s: &Seen| s.get::<RobotControl>("r1").is_none_or(|c| c.errands == 0);
    w.pass_while(60, "it would only fail", |s| state(s) == Some(DrainState::Draining) && idle(s)).await;
    w.r("r1").fault = None;
    w.until("it is held", |s| is_held(s, "r1")).await;
    assert_eq!(w.r("r1").here.to_string(), "park-a");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_drain_goes_on_after_fleet_was_killed_and_an_earlier_one_never_frees_a_later() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    drain(&w, "r1", 3_600).await.expect("is asked");
    w.stop_fleet().await;
    w.start_fleet();
    let first = w.until("it is held", |s| is_held(s, "r1")).await.all::<Drain>()[0].drain_id.clone();
    undrain(&w, "r1").await;
    drain(&w, "r1", 3_600).await.expect("is asked again");
    let second = w.until("it is held again", |s| is_held(s, "r1")).await.all::<Drain>()[0].drain_id.clone();
    assert_ne!(first, second);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_drain_that_asks_for_nonsense_is_refused_whole() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let bad = v1::DrainRobotRequest { robot_id: "R 1".to_owned(), within: Some(duration(5)), ..Default::default() };
    let refused = w.fleet.drain_robot(local(bad)).await.expect_err("is refused");
    let told = midshift_proto::refusal_of(&refused).violations.len();
    assert_eq!((refused.code(), told), (tonic::Code::InvalidArgument, 3));
    // If its nanos were counted it would be two minutes.
    let mut within = duration(118_000);
    within.nanos = 2_000_000_000;
    let bad = v1::DrainRobotRequest {
        robot_id: "r1".to_owned(),
        reason: "new wheels".to_owned(),
        within: Some(within),
        ..Default::default()
    };
    let refused = w.fleet.drain_robot(local(bad)).await.expect_err("is refused");
    let told = midshift_proto::refusal_of(&refused).violations;
    assert_eq!(told.iter().map(|v| v.field.as_str()).collect::<Vec<_>>(), ["within"]);
    assert_eq!(drain(&w, "r9", 60).await.expect_err("nobody").code(), tonic::Code::NotFound);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_on_its_way_to_a_charger_goes_on_and_is_held_there_docked() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    (w.r("r1").drives, w.r("r1").works) = (false, false);
    w.r("r1").battery_permille = 150;
    w.beat("r1");
    let charges = |s: &Seen| s.errand("r1").is_some_and(|(errand, _)| errand == Errand::Charge);
    let errand = |s: &Seen| s.all::<Attempt>().into_iter().find(|a| a.errand.is_some()).expect("an errand");
    w.until("it is on its way", |s| charges(s) && errand(s).accepted.is_some()).await;
    drain(&w, "r1", 600).await.expect("is asked");
    w.pass_while(10, "it goes on", |s| charges(s) && errand(s).phase != AttemptPhase::Stopping).await;
    w.r("r1").drives = true;
    w.until("it is held", |s| is_held(s, "r1")).await;
    let ended = |e: &midshift_core::rows::Entry| {
        &*e.kind == "errand.changed" && e.body.as_deref().is_some_and(|b| b.contains("docked"))
    };
    assert!(w.written().await.iter().any(ended), "its errand ends as docked");
    assert_eq!(w.seen().await.holders("charge"), [("r1".to_owned(), HolderState::Inside)]);
    undrain(&w, "r1").await;
    w.r("r1").works = true;
    w.until("it charges again", charges).await;
    w.lawful().await;
}

/// The corridor with a seat for one robot in each of its bays, all taken but `left` seats.
async fn crowded(left: usize) -> World {
    let mut w = World::on(CORRIDOR.replace(", capacity = 2", "").leak()).await;
    w.robot("r1", "A").await;
    w.r("r1").answer = crate::harness::Answer::Refuse(Code::UnsupportedAction);
    for (n, at) in ["wait-a", "wait-b", "park-b", "charge", "park-a"].iter().enumerate().skip(left) {
        w.robot(&format!("r{}", n + 2), at).await;
    }
    w.pass(5).await;
    w
}

#[tokio::test(start_paused = true)]
async fn a_drain_that_waits_for_a_place_to_stand_ends_by_its_deadline() {
    let mut w = crowded(0).await;
    drain(&w, "r1", 60).await.expect("is asked");
    w.pass_while(50, "a station is no place to rest", |s| state(s) == Some(DrainState::Draining)).await;
    let seen = w.until("it is given up", |s| state(s) == Some(DrainState::Refused)).await;
    assert_eq!(seen.all::<Drain>()[0].why.as_ref().map(|r| r.code), Some(Code::SkippedBusy));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_stands_in_a_lane_is_not_at_rest_and_drives_to_a_place_of_its_own_first() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "a-far").await;
    w.r("r1").drives = false;
    w.pass(2).await;
    drain(&w, "r1", 600).await.expect("is asked");
    w.pass_while(10, "a lane is no place to rest", |s| state(s) == Some(DrainState::Draining)).await;
    w.r("r1").drives = true;
    let seen = w.until("it is held", |s| is_held(s, "r1")).await;
    assert_eq!(seen.holders("park-a"), [("r1".to_owned(), HolderState::Inside)]);
    w.lawful().await;
}
