//! Silence, manual mode and late reports: nobody knows, and then somebody does.

use crate::harness::World;
use midshift_core::reason::Code;
use midshift_core::robot::Mode;
use midshift_core::robot::WorkState;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{AttemptPhase, Phase};

#[tokio::test(start_paused = true)]
async fn a_completion_from_an_attempt_nobody_knew_about_is_accepted() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("all is granted", |s| s.has("r1", "B")).await;
    w.r("r1").cut();
    w.pass_while(29, "the lease stands", |s| !s.is_uncertain("T1")).await;
    let seen = w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    assert_eq!(seen.attempt("T1").uncertain.map(|u| u.cause.code), Some(Code::LeaseOver));
    assert!(seen.has("r1", "B") && !seen.is_free("r1"), "authority is over, load and floor are not");
    w.r("r1").mend();
    w.connect("r1").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_completion_that_arrives_after_its_heartbeat_is_accepted_and_not_redone() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("all is granted", |s| s.has("r1", "B")).await;
    w.r("r1").tells = false;
    w.pass_while(20, "the heartbeat does not overtake the event", |s| s.phase("T1") == Phase::Running).await;
    assert!(w.r("r1").is_idle() && w.r("r1").load.is_none(), "it is done, and nobody has been told");
    w.r("r1").forgets_its_work();
    w.pass_while(20, "not even if it lists nothing", |s| s.phase("T1") == Phase::Running).await;
    w.r("r1").tells = true;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(seen.task("T1").epoch, 1);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_completion_of_an_old_epoch_is_fenced() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until_phase("T1", Phase::Running).await;
    let old = seen.task("T1").attempt_id().expect("an attempt");
    w.r("r1").forgets_its_work();
    w.r("r2").works = false;
    w.until("another has it", |s| s.phase("T1") == Phase::Running && s.task("T1").epoch == 2).await;
    w.r("r1").reports(old.clone(), WorkState::Succeeded);
    w.pass_while(5, "the old epoch has passed", |s| s.phase("T1") == Phase::Running).await;
    assert!(w.seen().await.all::<midshift_core::task::Attempt>().iter().any(|a| a.attempt == old));
    w.r("r2").works = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_person_who_takes_the_robot_over_makes_its_work_uncertain_and_gives_it_back() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").set_mode(Mode::Manual);
    let seen = w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    assert_eq!(seen.attempt("T1").uncertain.map(|u| u.cause.code), Some(Code::RobotManual));
    w.submit("T2", "A", "B").await;
    w.pass_while(60, "a person drives", |s| s.is_uncertain("T1") && s.phase("T2") == Phase::Queued).await;
    w.r("r1").set_mode(Mode::Automatic);
    w.r("r1").works = true;
    w.until("known again", |s| s.phase("T1") == Phase::Succeeded || !s.is_uncertain("T1")).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn five_minutes_without_an_answer_ask_a_person_and_the_late_truth_still_counts() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("all is granted", |s| s.has("r1", "B")).await;
    w.r("r1").cut();
    w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    w.pass_while(298, "five minutes", |s| s.phase("T1") == Phase::Running).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!((seen.reason("T1"), seen.attempt("T1").phase), (Some(Code::UncertainTooLong), AttemptPhase::Lost));
    w.r("r1").mend();
    w.connect("r1").await;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(seen.attempt("T1").phase, AttemptPhase::Succeeded);
    w.until("its places are open again", |s| s.place("B").quarantine.is_none()).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_does_not_know_whether_it_picked_asks_a_person_at_once() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.has("r1", "A") && !s.has("r1", "park-a")).await;
    w.r("r1").forgets_how_far_it_is();
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert_eq!(seen.reason("T1"), Some(Code::StepUnknown));
    assert!(seen.task("T1").changed.ms_since(seen.attempt("T1").accepted.expect("accepted")) < 60_000);
    // Free of the task: it stands in a lane, so fleet sends it to park.
    let is_let_go = |s: &crate::harness::Seen| s.holder("r1").is_none_or(|id| id.subject.task_id().is_none());
    w.until("the robot may forget it and is free", is_let_go).await;
    w.lawful().await;
}
