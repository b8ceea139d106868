//! Fleet stops: who is held, by whose word, until when, and what is kept from them.

use crate::explain::why;
use crate::harness::{BEGIN, Seen, World};
use midshift_core::ids::{PlaceId, RobotId, StopId};
use midshift_core::reason::Code;
use midshift_core::robot::{Pose, StopLevel};
use midshift_core::site::CORRIDOR;
use midshift_core::stop::record::StopRecord;
use midshift_core::stop::{Region, Reset, Scope, Stop};
use midshift_core::task::{Ask, Phase};

fn s1() -> StopId {
    StopId::parse("STOP-1").expect("an id")
}

fn engaged(scope: Scope, level: StopLevel, region: Option<Region>) -> StopRecord {
    StopRecord { stop: Stop { region, ..Stop::new(s1(), scope, level, BEGIN) }, reset: None }
}

fn fleet_wide() -> StopRecord {
    engaged(Scope::Fleet, StopLevel::Halt, None)
}

fn reset(record: StopRecord) -> StopRecord {
    StopRecord { reset: Some(Reset::new(s1(), BEGIN)), ..record }
}

#[tokio::test(start_paused = true)]
async fn a_stop_service_that_began_without_its_memory_is_one_incident() {
    let mut w = at_work().await;
    let lost = StopRecord {
        stop: Stop { stop_id: StopId::parse("STOP-LOST-1").expect("an id"), ..fleet_wide().stop },
        reset: None,
    };
    w.stop(&lost).await;
    w.until("a person is told", |s| s.incidents() == [Code::StopMemoryLost]).await;
    w.stop(&fleet_wide()).await;
    let seen = w.until("the other stop holds it too", |s| s.tokens("r1").len() == 2).await;
    assert_eq!(seen.incidents(), [Code::StopMemoryLost], "once");
}

async fn resume_all(w: &mut World) {
    let stop_id = Some(s1().to_string());
    w.ask(Ask::ResumeHeld { stop_id, area_id: None, task_ids: Vec::new(), robot_ids: Vec::new() }).await;
}

/// A robot at work.
async fn at_work() -> World {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w
}

#[tokio::test(start_paused = true)]
async fn a_stop_that_was_copied_holds_a_robot_that_has_not_said_a_word_of_it() {
    let mut w = at_work().await;
    w.stop(&fleet_wide()).await;
    let seen = w.until_phase("T1", Phase::Held).await;
    assert_eq!(seen.tokens("r1"), ["stop:STOP-1"]);
    assert!(seen.work("r1").held && seen.work("r1").resume.is_none());
    w.stop(&reset(fleet_wide())).await;
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:STOP-1"]).await;
    w.r("r1").works = true;
    w.pass_while(120, "a reset moves nobody", |s| s.phase("T1") == Phase::Held && s.work("r1").held).await;
    resume_all(&mut w).await;
    w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(w.r("r1").resumed.len(), 1, "by a permission of its own");
    let is_over = |s: &Seen| s.control("r1").resumed.is_empty() && s.work("r1").resumed.is_empty();
    w.until("it never waited for it", is_over).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_stop_that_only_the_robot_knows_holds_it_and_it_hears_who_resumed_it() {
    let mut w = at_work().await;
    w.r("r1").stands_for(&s1());
    w.until_phase("T1", Phase::Held).await;
    w.pass_while(30, "nobody resumes what stands", |s| s.tokens("r1") == ["stop:STOP-1"]).await;
    w.r("r1").hears_of_the_reset(&s1());
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:STOP-1"]).await;
    w.r("r1").works = true;
    resume_all(&mut w).await;
    w.until("it is told", |s| s.work("r1").resumed == [s1()]).await;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert!(seen.tokens("r1").is_empty());
    assert!(w.r("r1").awaiting.is_empty());
    w.until("nobody needs to know it longer", |s| s.control("r1").resumed.is_empty()).await;
    w.until("nor is it said", |s| s.work("r1").resumed.is_empty()).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn while_either_says_stopped_it_is_stopped() {
    let mut w = at_work().await;
    w.stop(&fleet_wide()).await;
    w.r("r1").stands_for(&s1());
    w.pass(2).await;
    assert_eq!(w.seen().await.tokens("r1"), ["stop:STOP-1"]);
    w.stop(&reset(fleet_wide())).await;
    w.pass_while(30, "the robot has not heard of the reset", |s| s.tokens("r1") == ["stop:STOP-1"]).await;
    resume_all(&mut w).await;
    w.pass_while(30, "and cannot be resumed before", |s| s.tokens("r1") == ["stop:STOP-1"]).await;
    w.r("r1").hears_of_the_reset(&s1());
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:STOP-1"]).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_heartbeat_of_before_the_resume_was_heard_asks_for_no_other() {
    let mut w = at_work().await;
    w.r("r1").stands_for(&s1());
    w.until("it is held", |s| s.tokens("r1") == ["stop:STOP-1"]).await;
    w.r("r1").hears_of_the_reset(&s1());
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:STOP-1"]).await;
    // It goes on beating, and takes nothing in.
    w.r("r1").hears = false;
    resume_all(&mut w).await;
    w.until("it is free", |s| s.tokens("r1").is_empty()).await;
    w.pass_while(60, "it is resumed once", |s| s.tokens("r1").is_empty() && s.work("r1").resumed == [s1()]).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn nobody_gets_work_while_the_fleet_is_stopped_and_explain_says_so() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.stop(&fleet_wide()).await;
    w.submit("T1", "A", "B").await;
    w.pass_while(60, "the fleet is stopped", |s| s.phase("T1") == Phase::Queued).await;
    assert_eq!(why(&w, "T1").await.1, Code::StopEngaged.as_str());
    w.stop(&reset(fleet_wide())).await;
    w.pass_while(60, "and not resumed", |s| s.phase("T1") == Phase::Queued).await;
    resume_all(&mut w).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

/// The corridor is stopped, and nobody is near it.
fn stopped_corridor(w: &mut World) -> StopRecord {
    let corridor = PlaceId::parse("corridor").expect("a place");
    let region = Region::of_zone(&w.site, &corridor).expect("its boxes");
    w.r("r1").pose = Some(Pose { x_mm: 0, y_mm: 3_000, theta_mrad: 0 });
    engaged(Scope::Zone(corridor), StopLevel::Halt, Some(region))
}

#[tokio::test(start_paused = true)]
async fn a_stopped_zone_lets_nobody_in_and_holds_nobody_elsewhere() {
    let mut w = at_work().await;
    let zone = stopped_corridor(&mut w);
    w.pass(2).await;
    w.stop(&zone).await;
    w.r("r1").works = true;
    w.pass_while(120, "the corridor is stopped", |s| s.tokens("r1").is_empty() && !s.has("r1", "corridor")).await;
    assert_eq!(w.seen().await.phase("T1"), Phase::Running);
    w.stop(&reset(zone)).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn work_beyond_a_stopped_zone_waits_for_its_reset() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let zone = stopped_corridor(&mut w);
    w.pass(2).await;
    w.stop(&zone).await;
    w.submit("T1", "A", "B").await;
    w.pass_while(60, "no way leads to B", |s| s.phase("T1") == Phase::Queued).await;
    assert_eq!(why(&w, "T1").await.1, Code::PlaceOccupied.as_str());
    w.stop(&reset(zone)).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn slow_holds_nobody_and_a_stop_of_another_robot_is_not_ones_own() {
    for record in [
        engaged(Scope::Fleet, StopLevel::Slow, None),
        engaged(Scope::Robot(RobotId::parse("r2").expect("an id")), StopLevel::Halt, None),
    ] {
        let mut w = World::on(CORRIDOR).await;
        w.robot("r1", "park-a").await;
        w.stop(&record).await;
        w.submit("T1", "A", "B").await;
        let seen = w.until_phase("T1", Phase::Succeeded).await;
        assert!(seen.tokens("r1").is_empty());
        w.lawful().await;
    }
}
