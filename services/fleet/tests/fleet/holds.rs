//! Hold tokens: the maker's stop holds, its release does not resume, a person does.

use crate::harness::World;
use midshift_core::fleet::rows::HoldToken;
use midshift_core::fleet::{NOT_ENROLLED_SEEN, NOT_UNDERSTOOD_SEEN};
use midshift_core::ids::RobotId;
use midshift_core::reason::Code;
use midshift_core::robot::HardwareStop;
use midshift_core::rows::Table;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{Ask, Phase};

async fn held_world() -> World {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").set_hardware_stop(HardwareStop::Manual);
    let seen = w.until_phase("T1", Phase::Held).await;
    assert_eq!(seen.tokens("r1"), ["stop:body:r1"]);
    assert!(seen.work("r1").held && seen.work("r1").resume.is_none());
    w
}

#[tokio::test(start_paused = true)]
async fn a_released_stop_waits_for_a_person_and_the_resume_carries_an_authority() {
    let mut w = held_world().await;
    let before = w.seen().await.timer("start_to_close:T1/1").expect("a timer");
    assert!(before.fires_at_service_ms.is_none(), "start_to_close stands still while held");
    w.r("r1").set_hardware_stop(HardwareStop::None);
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:body:r1"]).await;
    w.r("r1").works = true;
    w.pass_while(120, "nobody has resumed it", |s| s.phase("T1") == Phase::Held && s.work("r1").held).await;
    w.resume("r1").await;
    let seen = w.until("it goes on", |s| s.phase("T1") == Phase::Running).await;
    let session = w.r("r1").session_epoch();
    assert_eq!(seen.work("r1").resume.map(|r| (r.session_epoch, r.valid_ms)), Some((session, 10_000)));
    assert!(seen.timer("start_to_close:T1/1").is_some_and(|t| t.fires_at_service_ms.is_some()));
    w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(w.r("r1").resumed.len(), 1);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_resumed_while_it_is_not_heard_moves_once_it_is() {
    let mut w = held_world().await;
    w.r("r1").set_hardware_stop(HardwareStop::None);
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:body:r1"]).await;
    w.r("r1").cut();
    w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    w.r("r1").works = true;
    w.board.remove(&midshift_core::ids::RobotId::parse("r1").expect("an id"));
    w.resume("r1").await;
    w.until("the token is gone", |s| s.tokens("r1").is_empty()).await;
    w.pass(30).await;
    assert!(w.r("r1").resumed.is_empty());
    w.r("r1").mend();
    w.connect("r1").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_second_stop_before_the_resume_holds_again() {
    let mut w = held_world().await;
    w.r("r1").set_hardware_stop(HardwareStop::None);
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:body:r1"]).await;
    w.r("r1").set_hardware_stop(HardwareStop::Remote);
    w.until("it is stopped again", |s| s.tokens("r1") == ["stop:body:r1"]).await;
    w.resume("r1").await;
    w.pass_while(30, "a person cannot resume a stop that stands", |s| s.phase("T1") == Phase::Held).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_held_task_can_be_canceled_and_an_idle_robot_that_is_held_gets_no_work() {
    let mut w = held_world().await;
    w.cancel("T1", false).await;
    w.until_phase("T1", Phase::Canceled).await;
    w.submit("T2", "A", "B").await;
    w.pass_while(30, "its token stands", |s| s.phase("T2") == Phase::Queued).await;
    w.r("r1").set_hardware_stop(HardwareStop::None);
    w.r("r1").works = true;
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:body:r1"]).await;
    w.pass_while(30, "and for the person", |s| s.phase("T2") == Phase::Queued).await;
    w.resume("r1").await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_accepted_by_a_robot_that_is_held_meanwhile_is_held() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.r("r1").tells = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Assigned).await;
    w.r("r1").set_hardware_stop(HardwareStop::AutoAck);
    w.pass(2).await;
    w.r("r1").tells = true;
    let seen = w.until_phase("T1", Phase::Held).await;
    assert_eq!(seen.reason("T1").unwrap_or(Code::HoldByBody), Code::HoldByBody);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_thousand_robots_are_let_go_by_one_request() {
    let mut w = World::on(CORRIDOR).await;
    w.stop_fleet().await;
    let robots: Vec<RobotId> = (0..1_000).map(|n| RobotId::parse(&format!("x{n:04}")).expect("an id")).collect();
    let token = |robot_id: &RobotId| HoldToken {
        robot_id: robot_id.clone(),
        token: format!("resume:body:{robot_id}"),
        since: w.clock.now().utc,
    };
    let tokens: Vec<HoldToken> = robots.iter().map(token).collect();
    w.left_behind(&tokens).await;
    w.start_fleet();
    w.ask(Ask::ResumeHeld { stop_id: None, area_id: None, task_ids: Vec::new(), robot_ids: robots }).await;
    w.until("all are free", |s| s.tokens("x0000").is_empty() && s.tokens("x0999").is_empty()).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_said_and_the_store_never_takes_is_passed_over_and_a_person_is_told() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.shaky.refuse(Some(Table::HoldToken));
    w.r("r1").set_hardware_stop(HardwareStop::Remote);
    w.until("a person is told", |s| s.incidents().contains(&Code::EntryPassedOver)).await;
    w.shaky.refuse(None);
    w.r("r1").set_hardware_stop(HardwareStop::None);
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_second_machine_with_a_robots_name_is_an_incident() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.clone_seen("r1").await;
    w.until("a person is told", |s| s.incidents() == [Code::CloneSeen]).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_machine_that_is_not_enrolled_is_one_incident_that_names_its_key() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    for _ in 0..2 {
        w.told_by_telemetry("r2", NOT_ENROLLED_SEEN, r#"{"key": "abcd", "certificate": "0a"}"#).await;
    }
    w.clone_seen("r1").await;
    let seen = w.until("both are told of", |s| s.incidents().contains(&Code::CloneSeen)).await;
    let told = seen.open_incidents(Code::RobotNotEnrolled.as_str());
    let [of] = &told[..] else { panic!("{told:?}") };
    assert_eq!(of.robot_id.as_ref().map(|id| id.as_str()), Some("r2"));
    let metadata = ["key", "certificate"].map(|name| of.reason.metadata.get(name).map(String::as_str));
    assert_eq!(metadata, [Some("abcd"), Some("0a")]);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_not_understood_is_one_incident_that_says_why() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    for body in [r#"{"why": "reported.mode: 77"}"#, r#"{"why": "reported.hb: 0"}"#] {
        w.told_by_telemetry("r2", NOT_UNDERSTOOD_SEEN, body).await;
    }
    w.clone_seen("r1").await;
    let seen = w.until("all are told of", |s| s.incidents().contains(&Code::CloneSeen)).await;
    let told = seen.open_incidents(Code::RobotNotUnderstood.as_str());
    let [of] = &told[..] else { panic!("{told:?}") };
    assert_eq!(of.robot_id.as_ref().map(|id| id.as_str()), Some("r2"));
    assert_eq!(of.reason.message, "It dials and is refused: reported.mode: 77.");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_second_machine_that_attaches_again_is_told_of_once_while_the_incident_is_open() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.clone_seen("r1").await;
    w.until("a person is told", |s| s.incidents() == [Code::CloneSeen]).await;
    w.clone_seen("r1").await;
    w.clone_seen("r2").await;
    let seen = w.until("the next one is told of", |s| s.incidents().len() > 1).await;
    assert_eq!(seen.incidents(), [Code::CloneSeen; 2], "one of each robot");
    w.lawful().await;
}
