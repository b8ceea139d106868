//! What robots carry, by their own word and by a person's.

use crate::harness::{World, jam};
use midshift_core::ids::TaskId;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{Ask, Phase, Resolution};
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use midshift_proto::refusal_of;

/// A person says that r1 carries nothing; why that was refused, or the robot after it.
async fn settle(w: &World) -> Result<v1::RobotControl, String> {
    let reason = "I put it back on the shelf".to_owned();
    let request = v1::SettleRobotLoadRequest { robot_id: "r1".to_owned(), reason, ..Default::default() };
    match w.fleet.settle_robot_load(local(request)).await {
        Ok(answer) => Ok(answer.into_inner().control.expect("a robot")),
        Err(status) => Err(refusal_of(&status).reason),
    }
}

/// What r1 waits for, and whether a person's word about its load stands.
async fn explained(w: &World) -> (String, bool) {
    let ask = v1::ExplainRobotRequest { robot_id: "r1".to_owned() };
    let told = w.fleet.explain_robot(local(ask)).await.expect("an explanation").into_inner();
    let told = told.explanation.expect("an explanation");
    let is_settled = told.control.is_some_and(|control| control.load_settled.is_some());
    (told.verdict.map(|verdict| verdict.code).unwrap_or_default(), is_settled)
}

#[tokio::test(start_paused = true)]
async fn a_person_settles_what_a_robot_carries_unless_the_robot_or_a_task_says_otherwise() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").fails = Some((2, jam()));
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(
        settle(&w).await,
        Err("ROBOT_LOADED".to_owned()),
        "it is heard and says itself that it carries something"
    );
    w.r("r1").cut();
    w.pass(40).await;
    assert_eq!(settle(&w).await, Err("NOT_ALLOWED_NOW".to_owned()), "its task asks a person first");
    let task_id = TaskId::parse("T1").expect("an id");
    w.ask(Ask::Resolve { task_id, resolution: Resolution::RequeuePutBack }).await;
    w.until("it waits for another robot", |s| s.phase("T1") == Phase::Queued && s.task("T1").opened_robot_id.is_none())
        .await;
    let control = settle(&w).await.expect("nobody says otherwise");
    assert_eq!(control.load_settled.expect("a word").reason, "I put it back on the shelf");
    let (waits_for, is_settled) = explained(&w).await;
    assert!(is_settled && waits_for != "ROBOT_LOADED", "{waits_for}");
    // What it says itself adds to that again.
    w.r("r1").mend();
    w.connect("r1").await;
    w.pass(3).await;
    assert!(!explained(&w).await.1, "it is heard and still says that it carries something");
    w.lawful().await;
}

/// r1 has broken down with the item of T1 and is heard; a person has put the item back and lets it work again.
async fn put_back(load_by_memory: bool) -> World {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").inventory.load_by_memory = load_by_memory;
    w.connect("r1").await;
    w.r("r1").fails = Some((2, jam()));
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::NeedsOperator).await;
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
    w.fleet.uncordon_robot(local(uncordon)).await.expect("uncordoned");
    let task_id = TaskId::parse("T1").expect("an id");
    w.ask(Ask::Resolve { task_id, resolution: Resolution::RequeuePutBack }).await;
    w.until("the item is on the shelf", |s| s.phase("T1") == Phase::Queued && s.task("T1").opened_robot_id.is_none())
        .await;
    w
}

/// What T1 waits for.
async fn task_waits_for(w: &World) -> String {
    let ask = v1::ExplainTaskRequest { task_id: "T1".to_owned() };
    let told = w.fleet.explain_task(local(ask)).await.expect("an explanation").into_inner();
    let verdict = told.explanation.expect("an explanation").verdict.expect("a verdict");
    verdict.metadata.get("waits_for").cloned().unwrap_or_default()
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_says_that_it_carries_an_item_that_was_put_back_is_not_given_its_task() {
    let mut w = put_back(false).await;
    w.pass_while(60, "its hand is full", |s| s.phase("T1") == Phase::Queued && s.task("T1").opened_robot_id.is_none())
        .await;
    assert_eq!(explained(&w).await, ("ROBOT_LOADED".to_owned(), false));
    assert_eq!(task_waits_for(&w).await, "robot r1: ROBOT_LOADED", "both say so");
    assert_eq!(settle(&w).await, Err("ROBOT_LOADED".to_owned()), "it feels it");
    w.r("r1").load = None;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_load_that_a_robot_only_remembers_is_settled_by_a_persons_word_while_it_is_heard() {
    let mut w = put_back(true).await;
    w.pass_while(10, "its hand is full, it thinks", |s| s.phase("T1") == Phase::Queued).await;
    w.r("r1").hears = false;
    let told = settle(&w).await.expect("it is told").load_settled.expect("a word");
    assert!(told.is_forget_pending);
    w.pass_while(10, "it has not heard of it", |s| {
        s.phase("T1") == Phase::Queued && s.task("T1").opened_robot_id.is_none()
    })
    .await;
    let seen = w.seen().await;
    let word = seen.work("r1").load_word.expect("a word for the robot");
    assert_eq!(word.session_epoch, w.r("r1").session_epoch());
    w.r("r1").hears = true;
    w.until_phase("T1", Phase::Succeeded).await;
    let seen = w.seen().await;
    assert!(seen.control("r1").load_settled.is_none() && seen.work("r1").load_word.is_none(), "it is over");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_word_that_a_robot_was_told_does_not_reach_into_its_next_session() {
    let mut w = put_back(true).await;
    w.r("r1").hears = false;
    settle(&w).await.expect("it is told");
    w.pass(2).await;
    w.connect("r1").await;
    w.r("r1").hears = true;
    w.pass_while(60, "its hand is full, it thinks", |s| s.phase("T1") == Phase::Queued).await;
    assert_eq!(explained(&w).await, ("ROBOT_LOADED".to_owned(), false));
    settle(&w).await.expect("it is told again");
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_word_about_a_load_holds_for_the_process_that_plans_next() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").fails = Some((2, jam()));
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::NeedsOperator).await;
    w.r("r1").cut();
    w.pass(40).await;
    let task_id = TaskId::parse("T1").expect("an id");
    w.ask(Ask::Resolve { task_id, resolution: Resolution::RequeuePutBack }).await;
    w.until_phase("T1", Phase::Queued).await;
    settle(&w).await.expect("nobody says otherwise");
    w.stop_fleet().await;
    w.start_fleet();
    w.pass_while(40, "nobody thinks that r1 has begun it", |s| s.task("T1").opened_robot_id.is_none()).await;
    let (waits_for, is_settled) = explained(&w).await;
    assert!(is_settled && waits_for != "ROBOT_LOADED", "{waits_for}");
    w.lawful().await;
}
