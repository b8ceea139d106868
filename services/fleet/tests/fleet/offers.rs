//! An offer, its answers and its end.

use crate::harness::{Answer, Seen, World};
use midshift_core::fleet::rows::HolderState;
use midshift_core::reason::Code;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{AfterStopping, AttemptPhase, Phase};

#[tokio::test(start_paused = true)]
async fn an_offer_goes_to_the_nearest_eligible_robot_and_is_anchored_to_its_newest_heartbeat() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("far", "park-b").await;
    w.robot("near", "park-a").await;
    w.robot("unable", "A").await;
    w.r("unable").inventory.capabilities.clear();
    w.connect("unable").await;
    w.pass(2).await;
    for robot in ["far", "near", "unable"] {
        w.r(robot).answer = Answer::Ignore;
    }
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Assigned).await;
    assert_eq!(seen.robot_of("T1").as_deref(), Some("near"));
    let offer = seen.work("near").assignment.expect("an assignment").offer;
    let near = w.r("near").session_epoch();
    assert_eq!((offer.session_epoch, offer.valid_ms), (near, 5_000));
    assert!(offer.hb > 0);
    assert_eq!(seen.attempt("T1").offer, offer);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_accepted_task_runs_with_its_time_and_without_the_offers() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Running).await;
    assert!(seen.timer("start_to_close:T1/1").is_some_and(|t| t.fires_at_service_ms.is_some()));
    assert!(seen.timer("offer_ack:T1/1").is_none());
    assert!(seen.timer("schedule_to_start:T1/0").is_none());
    assert!(seen.task("T1").started.is_some());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_has_succeeded_is_free_and_may_forget_the_attempt() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    let seen = w.until("the attempt is closed", |s| s.work("r1").closed.len() == 1).await;
    assert_eq!(seen.attempt("T1").phase, AttemptPhase::Succeeded);
    assert!(seen.holder("r1") != seen.task("T1").attempt_id());
    w.until("the robot has forgotten it", |s| s.work("r1").closed.is_empty()).await;
    assert!(w.r("r1").load.is_none());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn five_refusals_in_a_row_ask_a_person() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::Refuse(Code::AnotherHolder);
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!((seen.reason("T1"), seen.task("T1").epoch), (Some(Code::NoRobotAccepts), 5));
    assert!(seen.is_free("r1"));
    assert_eq!(seen.task("T1").failures, 0, "a refusal is not an attempt");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_every_candidate_refuses_for_its_content_has_failed() {
    let mut w = World::on(CORRIDOR).await;
    for (robot, at) in [("r1", "park-a"), ("r2", "park-b")] {
        w.robot(robot, at).await;
        w.r(robot).answer = Answer::Refuse(Code::UnsupportedAction);
    }
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Failed).await;
    assert_eq!((seen.reason("T1"), seen.task("T1").epoch), (Some(Code::NoRobotCan), 2));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_offer_is_stopped_and_the_robot_freed_only_by_a_heartbeat_that_knows_of_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.r("r1").hears = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Stopping).await;
    assert_eq!(seen.task("T1").then, Some(AfterStopping::Requeue));
    assert!(seen.work("r1").assignment.is_none_or(|a| a.stop));
    w.pass_while(10, "the robot is kept while it has not applied the stop", |s| {
        s.phase("T1") == Phase::Stopping && !s.is_free("r1")
    })
    .await;
    w.r("r1").hears = true;
    w.r("r1").answer = Answer::Ignore;
    w.until("the offer has expired", |s| s.task("T1").epoch == 2 || s.phase("T1") == Phase::Queued).await;
    w.r("r1").answer = Answer::Accept;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_offer_to_a_silent_robot_asks_nobody_before_its_lease_is_over() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.r("r1").hears = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Assigned).await;
    w.r("r1").cut();
    w.pass_while(29, "nobody is asked", |s| matches!(s.phase("T1"), Phase::Assigned | Phase::Stopping)).await;
    let seen = w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    assert_eq!((seen.phase("T1"), seen.task("T1").then), (Phase::Stopping, Some(AfterStopping::Requeue)));
    assert!(!seen.is_free("r1"));
    w.pass_while(240, "nobody is asked yet", |s| s.phase("T1") == Phase::Stopping).await;
    w.r("r1").mend();
    w.connect("r1").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn steps_bring_places_up_to_the_next_standing_one_and_only_the_robots_word_frees_them() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    let seen = w.until("the robot may drive to A", |s| s.has("r1", "A")).await;
    assert!(!seen.has("r1", "corridor") && !seen.has("r1", "B"), "nothing beyond the step that is not done");
    let seen = w.until("it stands in A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    let route = seen.work("r1").assignment.expect("an assignment").route;
    let released = seen.released("r1").expect("a released stretch") as usize;
    assert!(route[released].standing.is_some(), "released to a standing place: {:?}", route[released]);
    w.until("the place it left is free", |s| !s.has("r1", "park-a")).await;
    w.pass_while(30, "nothing is granted before the step is done", |s| !s.has("r1", "corridor")).await;
    w.r("r1").works = true;
    let seen = w.until("the corridor is granted", |s| s.has("r1", "corridor")).await;
    assert!(seen.has("r1", "B") || seen.has("r1", "wait-b"), "with the standing place behind it");
    w.r("r1").tells = false;
    w.pass(20).await;
    let seen = w.seen().await;
    assert!(seen.has("r1", "corridor"), "what the robot has not told stays taken");
    w.r("r1").tells = true;
    w.until("told", |s| !s.has("r1", "corridor")).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_hears_and_does_not_answer_is_passed_over_at_once_and_broken_off_after_three() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("near", "park-a").await;
    w.robot("far", "park-b").await;
    w.pass(2).await;
    w.r("near").answer = Answer::Ignore;
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(
        (seen.robot_of("T1").as_deref(), seen.task("T1").epoch),
        (Some("far"), 2),
        "the second offer went to the other"
    );
    w.submit_with("T2", "A", "B", |raw| raw.robot_id = "near".to_owned()).await;
    let seen = w.until("it is broken off", |s| !s.open_incidents("ROBOT_DOES_NOT_ANSWER").is_empty()).await;
    let epoch = seen.task("T2").epoch;
    assert!(epoch <= 3, "{epoch} offers");
    w.pass_while(500, "it is left alone", |s| s.task("T2").epoch <= epoch).await;
    w.r("near").answer = Answer::Accept;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_calls_offers_over_is_passed_over_like_one_that_refuses_them() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::CallOver;
    w.submit("T1", "A", "B").await;
    let seen = w.until("it is broken off", |s| !s.open_incidents("ROBOT_DOES_NOT_ANSWER").is_empty()).await;
    assert_eq!(seen.task("T1").epoch, 5);
    w.r("r1").answer = Answer::Accept;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn offers_that_never_arrived_count_against_nobody() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.r("r1").hears = false;
    w.submit("T1", "A", "B").await;
    w.pass(10).await;
    w.r("r1").hears = true;
    w.until_phase("T1", Phase::Succeeded).await;
    assert!(w.seen().await.open_incidents("ROBOT_DOES_NOT_ANSWER").is_empty());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn many_that_do_not_answer_at_once_blame_the_network_and_no_robot() {
    let mut w = World::on(midshift_core::site::DEMO).await;
    let names: Vec<String> = (1..=6).map(|n| format!("r{n}")).collect();
    for (name, at) in names.iter().zip(["park-1", "park-1", "park-2", "park-2", "park-3", "park-3"]) {
        w.robot(name, at).await;
        w.r(name).answer = Answer::Ignore;
    }
    w.pass(2).await;
    for (n, name) in names.iter().enumerate() {
        w.submit_with(&format!("T{n}"), "D01", "D02", |raw| raw.robot_id.clone_from(name)).await;
    }
    let seen = w.until("one incident", |s| !s.open_incidents("OFFERS_NOT_ANSWERED").is_empty()).await;
    assert_eq!(seen.open_incidents("OFFERS_NOT_ANSWERED").len(), 1);
    assert!(seen.open_incidents("ROBOT_DOES_NOT_ANSWER").is_empty());
    for name in &names {
        w.r(name).answer = Answer::Accept;
    }
    w.until("each robot works", |s| (0..6).all(|n| s.phase(&format!("T{n}")) != Phase::Queued)).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_refuses_every_offer_keeps_no_task_from_the_others() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r1").answer = Answer::Refuse(Code::RobotFault);
    let tasks: Vec<String> = (0..8).map(|n| format!("T{n}")).collect();
    for id in &tasks {
        w.submit(id, "A", "B").await;
    }
    w.until("all are done", |s| tasks.iter().all(|id| s.phase(id) == Phase::Succeeded)).await;
    w.pass(60).await;
    let seen = w.seen().await;
    let offered: u64 = tasks.iter().map(|id| seen.task(id).epoch - 1).sum();
    assert!((1..=6).contains(&offered), "{offered} offers were refused");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_has_refused_five_offers_in_a_row_is_an_incident_until_it_takes_one() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").answer = Answer::Refuse(Code::AnotherHolder);
    for id in ["T1", "T2", "T3"] {
        w.submit(id, "A", "B").await;
    }
    w.until("a person is told", |s| !s.open_incidents("ROBOT_DOES_NOT_ANSWER").is_empty()).await;
    let asked = |s: &Seen| ["T1", "T2", "T3"].iter().filter(|id| s.phase(id) == Phase::NeedsOperator).count();
    w.pass_while(300, "the others wait", |s| asked(s) <= 1).await;
    w.r("r1").answer = Answer::Accept;
    let taken = |s: &Seen| s.phase("T3") == Phase::Succeeded && s.open_incidents("ROBOT_DOES_NOT_ANSWER").is_empty();
    w.until("it takes its probe", taken).await;
    w.lawful().await;
}
