//! The reconciler ends and begins again on the same rows.

use crate::explain::why;
use crate::harness::{Answer, World};
use midshift_core::ids::RobotId;
use midshift_core::item::Item;
use midshift_core::presence::Presence;
use midshift_core::presence::PresenceRow;
use midshift_core::reason::Code;
use midshift_core::robot::Mode;
use midshift_core::rows::Writer;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{AfterStopping, Attempt, Phase, TaskState};
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use std::time::Duration;

#[tokio::test(start_paused = true)]
async fn a_restart_loses_nothing_and_repeats_nothing() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    for n in 0..6 {
        w.submit(&format!("T{n}"), "A", "B").await;
    }
    for n in 0..6 {
        w.pass(1 + n).await;
        w.stop_fleet().await;
        w.pass(2).await;
        w.start_fleet();
    }
    for n in 0..6 {
        let seen = w.until_phase(&format!("T{n}"), Phase::Succeeded).await;
        assert_eq!(seen.task(&format!("T{n}")).epoch, 1, "nothing was redone");
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_a_backup_has_as_heard_gets_no_work_before_it_is_heard() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let row = PresenceRow::new(RobotId::parse("r1").expect("an id"), Presence::Online, 0);
    let mut item = Item::new(Writer::Telemetry, "tests");
    item.create(&row, "presence.changed");
    w.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    w.restore().await;
    w.submit("T1", "A", "B").await;
    w.pass_while(60, "there is nobody to do it", |s| s.phase("T1") == Phase::Queued).await;
    assert_eq!(why(&w, "T1").await, ("WAITING_FOR_ROBOT".to_owned(), "ROBOT_OFFLINE".to_owned()));
    w.r("r1").mend();
    w.connect("r1").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn no_timer_fires_in_the_first_ten_seconds_and_what_was_left_goes_on() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.r("r1").answer = Answer::Ignore;
    w.r("r1").hears = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Assigned).await;
    w.pass(4).await;
    w.stop_fleet().await;
    w.pass(300).await;
    w.start_fleet();
    w.pass_while(9, "robots say hello first", |s| s.phase("T1") == Phase::Assigned).await;
    w.pass(3).await;
    let seen = w.seen().await;
    assert_eq!((seen.phase("T1"), seen.task("T1").then), (Phase::Stopping, Some(AfterStopping::Requeue)));
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn every_lease_counts_as_renewed_at_the_start() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.r("r1").cut();
    w.pass(20).await;
    w.stop_fleet().await;
    w.pass(20).await;
    w.start_fleet();
    w.pass_while(30, "the lease began again", |s| !s.is_uncertain("T1")).await;
    w.until("and ends", |s| s.is_uncertain("T1")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn events_and_requests_that_came_while_fleet_was_down_have_their_effect_once() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("all is granted", |s| s.has("r1", "B")).await;
    w.stop_fleet().await;
    w.pass(30).await;
    w.submit("T2", "A", "B").await;
    w.cancel("T2", false).await;
    w.start_fleet();
    w.until_phase("T1", Phase::Succeeded).await;
    w.until_phase("T2", Phase::Canceled).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_restart_over_a_store_in_rest_does_not_repeat_what_was_consumed() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").set_hardware_stop(midshift_core::robot::HardwareStop::Manual);
    w.pass(2).await;
    w.r("r1").set_hardware_stop(midshift_core::robot::HardwareStop::None);
    w.until("it waits for a person", |s| s.tokens("r1") == ["resume:body:r1"]).await;
    w.resume("r1").await;
    w.until("resumed", |s| s.tokens("r1").is_empty()).await;
    for _ in 0..4 {
        w.pass(30).await;
        w.stop_fleet().await;
        w.start_fleet();
        w.pass_while(20, "the stop of long ago is over", |s| s.tokens("r1").is_empty()).await;
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_store_that_fails_for_a_while_loses_no_work_and_no_time() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit_with("T1", "A", "B", |raw| {
        raw.timeout_ms = Some(200_000);
        raw.stall_ms = Some(3_600_000);
    })
    .await;
    let seen = w.until("it stands in A", |s| s.has("r1", "A") && !s.has("r1", "park-a")).await;
    let accepted = seen.attempt("T1").accepted.expect("accepted");
    w.pass(150).await;
    w.shaky.fail(true);
    w.submit("T2", "A", "B").await;
    w.r("r1").works = true;
    w.pass(1).await;
    w.r("r1").drives = false;
    w.pass(5).await;
    assert!(w.shaky.failed() > 3, "the fault happened");
    w.shaky.fail(false);
    let seen = w.until_phase("T1", Phase::Stopping).await;
    let took_ms = seen.task("T1").changed.ms_since(accepted);
    assert!((200_000..202_000).contains(&took_ms), "its time went on: {took_ms} ms");
    w.r("r1").drives = true;
    w.until("both go on", |s| s.phase("T1") == Phase::NeedsOperator || s.phase("T1").is_terminal()).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_store_behind_the_robot_raises_its_generation_and_says_so() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let ahead = w.clock.now().wall.0 as u64 + 86_400_000;
    w.r("r1").applied = ahead;
    w.connect("r1").await;
    let seen = w.until("the generation is raised", |s| s.work("r1").generation > ahead).await;
    assert_eq!(seen.incidents(), [Code::StoreBehindRobot]);
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(w.seen().await.incidents().len(), 1);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn numbers_of_a_store_that_is_behind_go_on_above_what_a_robot_has_seen_but_never_beyond_the_clock() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(600).await;
    let seen = w.clock.now().wall.0 as u64 - 60_000;
    let head = |entries: Vec<midshift_core::rows::Entry>| entries.last().expect("entries").seq.0;
    assert!(head(w.written().await) < seen, "numbers do not follow the clock by themselves");
    w.r("r1").applied = seen;
    w.connect("r1").await;
    w.until("the generation is raised", |s| s.work("r1").generation > seen).await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    assert!(head(w.written().await) > seen);
    w.r("r1").applied = w.clock.now().wall.0 as u64 + 86_400_000_000;
    w.connect("r1").await;
    w.submit("T2", "A", "B").await;
    w.until_phase("T2", Phase::Succeeded).await;
    let now = w.clock.now().wall.0 as u64;
    let head = head(w.written().await);
    assert!(head < now + 10_000, "{} beyond the clock", head - now);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_generation_that_no_server_ever_gave_is_told_to_people_and_not_followed() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    let before = w.seen().await.work("r1").generation;
    w.r("r1").applied = midshift_core::limits::COUNTED_MAX;
    w.connect("r1").await;
    w.submit("T1", "A", "B").await;
    let seen = w.until("a person is told", |s| !s.open_incidents("STORE_BEHIND_ROBOT").is_empty()).await;
    assert!(seen.work("r1").generation < before + 86_400_000, "its next machine can say what it has applied");
    w.r("r1").applied = before;
    w.connect("r1").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_ended_a_month_ago_is_forgotten_with_its_attempts_and_one_that_has_not_ended_never() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.r("r1").works = false;
    w.submit("T2", "A", "B").await;
    w.until_phase("T2", Phase::Running).await;
    let day = std::time::Duration::from_secs(86_400);
    tokio::time::advance(29 * day).await;
    assert_eq!(midshift_fleet::prune(&*w.store, &*w.clock).await.expect("prunes"), 0);
    tokio::time::advance(2 * day).await;
    assert_eq!(
        midshift_fleet::prune(&*w.store, &*w.clock).await.expect("prunes"),
        3,
        "the task, its attempt, and the way to park"
    );
    w.step().await;
    let seen = w.seen().await;
    let tasks: Vec<_> = seen.all::<TaskState>().into_iter().map(|t| t.task_id.to_string()).collect();
    assert_eq!(tasks, ["T2"]);
    assert!(seen.all::<Attempt>().iter().all(|a| a.attempt.subject.to_string() != "T1"));
    w.stop_fleet().await;
    w.start_fleet();
    w.step().await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn questions_are_answered_though_the_store_takes_nothing() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.shaky.fail(true);
    w.submit("T1", "A", "B").await;
    w.pass(2).await;
    assert!(w.shaky.failed() > 0, "the fault happened");
    let asked = w.fleet.list_places(local(v1::ListPlacesRequest::default()));
    let listed = tokio::time::timeout(Duration::from_secs(30), asked).await.expect("in time").expect("places");
    assert!(!listed.into_inner().places.is_empty());
    w.shaky.fail(false);
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_lasts_is_told_though_the_projection_is_read_anew_again_and_again() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    for _ in 0..8 {
        let failed = w.shaky.failed();
        w.shaky.fail(true);
        // An event of it is to be taken over.
        w.r("r1").set_mode(Mode::Manual);
        w.pass(2).await;
        assert!(w.shaky.failed() > failed, "the fault happened");
        w.shaky.fail(false);
        w.pass(8).await;
    }
    assert_eq!(w.seen().await.open_incidents("ROBOT_MANUAL").len(), 1);
}
