//! Charging and parking: what fleet asks of robots without a task.

use crate::harness::{Answer, World};
use midshift_core::fleet::rows::RobotCounter;
use midshift_core::reason::Code;
use midshift_core::robot::WorkState;
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::Phase;
use midshift_core::task::state::Errand;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use midshift_store::load;

#[tokio::test(start_paused = true)]
async fn a_robot_with_little_charge_is_sent_to_a_charger_before_any_task() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-b").await;
    w.r("r1").battery_permille = 150;
    w.beat("r1");
    w.submit("T1", "A", "B").await;
    let seen = w.until("it charges", |s| s.errand("r1").is_some()).await;
    assert_eq!(seen.errand("r1"), Some((Errand::Charge, "charge".to_owned())));
    assert_eq!(seen.task("T1").epoch, 0);
    w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(w.r("r1").battery_permille, 900, "it was charged up to the area's threshold");
    let (counter, _) = load::<RobotCounter>(&*w.store, "r1@1.0.0").await.expect("a store").expect("it worked");
    assert!(counter.errands.path_mm > 0, "what an errand cost is known by itself");
    assert_eq!((counter.succeeded, counter.stats.path_mm), (1, counter.errands.path_mm + 1_000));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_preemptible_task_is_suspended_when_its_robot_must_charge_and_done_afterwards() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-b").await;
    w.submit_with("T1", "A", "B", |raw| raw.preemptible = true).await;
    w.until("it is on its way", |s| s.phase("T1") == Phase::Running && s.has("r1", "corridor")).await;
    w.r("r1").battery_permille = 150;
    let seen = w.until("it is suspended", |s| s.phase("T1") != Phase::Running).await;
    assert_eq!(seen.reason("T1"), Some(Code::BatterySuspend));
    w.until("it charges", |s| s.errand("r1").is_some_and(|(e, _)| e == Errand::Charge)).await;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!((seen.task("T1").failures, seen.task("T1").epoch), (0, 2), "no failure, and a second grant");
    assert!(w.r("r1").battery_permille >= 350, "it was charged first");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_is_not_preemptible_or_is_opened_goes_on_with_little_charge() {
    for (preemptible, stands) in [(false, "park-b"), (true, "A")] {
        let mut w = World::on(CORRIDOR).await;
        w.robot("r1", stands).await;
        w.submit_with("T1", "A", "B", |raw| raw.preemptible = preemptible).await;
        let on_its_way = |s: &crate::harness::Seen| s.phase("T1") == Phase::Running && s.has("r1", "corridor");
        w.until("it is on its way, in the second case with its item", on_its_way).await;
        (w.r("r1").battery_permille, w.r("r1").drives) = (150, false);
        w.pass_while(10, "it goes on", |s| s.phase("T1") == Phase::Running).await;
        w.r("r1").drives = true;
        let seen = w.until_phase("T1", Phase::Succeeded).await;
        assert_eq!(seen.task("T1").epoch, 1);
        w.lawful().await;
    }
}

#[tokio::test(start_paused = true)]
async fn an_urgent_task_is_done_first_by_the_robot_of_one_that_may_be_interrupted() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-b").await;
    w.submit_with("T1", "A", "B", |raw| raw.preemptible = true).await;
    w.until("it is on its way", |s| s.phase("T1") == Phase::Running && s.has("r1", "corridor")).await;
    w.submit_with("T2", "A", "B", |raw| raw.priority = Some(0)).await;
    let seen = w.until("it is suspended", |s| s.phase("T1") != Phase::Running).await;
    assert_eq!(seen.reason("T1"), Some(Code::UrgentSuspend));
    let seen = w.until_phase("T2", Phase::Succeeded).await;
    assert_eq!((seen.phase("T1"), seen.task("T2").epoch), (Phase::Queued, 1));
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!((seen.task("T1").failures, seen.task("T1").epoch), (0, 2), "no failure, and a second grant");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_left_idle_in_a_station_is_sent_to_park() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    let seen = w.until("it is sent away", |s| s.errand("r1").is_some()).await;
    assert_eq!(seen.errand("r1"), Some((Errand::Park, "park-b".to_owned())));
    let seen = w.until("it stands there and is free", |s| s.has("r1", "park-b") && s.is_free("r1")).await;
    assert!(!seen.has("r1", "B"));
    w.pass_while(30, "it stays", |s| s.is_free("r1")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_errand_that_may_wait_is_called_back_for_a_task_that_waits() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "A01").await;
    w.r("r1").drives = false;
    w.until("it is sent to park", |s| s.errand("r1").is_some_and(|(e, _)| e == Errand::Park)).await;
    w.pass(3).await;
    w.submit("T1", "B02", "D01").await;
    w.until("the task has the robot", |s| s.phase("T1") == Phase::Running).await;
    w.r("r1").drives = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_must_charge_is_not_called_back_before_it_may() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-b").await;
    w.r("r1").battery_permille = 150;
    w.r("r1").works = false;
    w.beat("r1");
    w.until("it charges", |s| s.errand("r1").is_some_and(|(e, _)| e == Errand::Charge)).await;
    w.submit("T1", "A", "B").await;
    w.pass_while(60, "below the threshold", |s| s.phase("T1") == Phase::Queued).await;
    w.r("r1").battery_permille = 500;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").works = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_cordoned_robot_that_charges_is_not_called_back_for_work_it_may_not_have() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-b").await;
    w.r("r1").battery_permille = 150;
    w.r("r1").works = false;
    w.beat("r1");
    let charges = |s: &crate::harness::Seen| s.errand("r1").is_some_and(|(e, _)| e == Errand::Charge);
    w.until("it charges", charges).await;
    let request = v1::CordonRobotRequest { robot_id: "r1".into(), reason: "a look".into(), ..Default::default() };
    w.fleet.cordon_robot(local(request)).await.expect("is cordoned");
    w.r("r1").battery_permille = 800;
    w.submit("T1", "A", "B").await;
    w.pass_while(60, "it goes on charging", charges).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_errand_of_a_robot_that_was_silent_goes_on_or_is_forgotten_as_the_robot_says() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "B").await;
    w.r("r1").drives = false;
    w.until("it is sent to park", |s| s.errand("r1").is_some()).await;
    w.pass(2).await;
    w.r("r1").cut();
    w.pass(60).await;
    assert!(!w.seen().await.is_free("r1"), "kept until it reports");
    w.r("r1").mend();
    w.r("r1").drives = true;
    w.connect("r1").await;
    w.until("it has parked", |s| s.has("r1", "park-b") && s.is_free("r1") && !s.has("r1", "B")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_refuses_its_errands_is_not_asked_again_at_once() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "B").await;
    w.r("r1").answer = Answer::Refuse(Code::AnotherHolder);
    w.pass(60).await;
    let asked = w.seen().await.control("r1").errands;
    assert!((2..=13).contains(&asked), "asked {asked} times in a minute");
    w.r("r1").answer = Answer::Accept;
    w.until("it has parked", |s| s.has("r1", "park-b") && s.is_free("r1")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_errands_are_over_at_once_is_not_given_one_after_the_other() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "B").await;
    w.r("r1").answer = Answer::LetGo(WorkState::Succeeded);
    w.pass(60).await;
    let asked = w.seen().await.control("r1").errands;
    assert!((2..=13).contains(&asked), "asked {asked} times in a minute");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_errand_nobody_answers_is_taken_back() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "B").await;
    w.r("r1").hears = false;
    w.until("it is sent to park", |s| s.errand("r1").is_some()).await;
    w.pass(30).await;
    assert!(!w.seen().await.is_free("r1"), "kept until it has applied that it is taken back");
    w.r("r1").hears = true;
    w.until("it has parked", |s| s.has("r1", "park-b") && s.is_free("r1")).await;
    w.lawful().await;
}
