//! Roll-outs that have ended: nobody reads them but for somebody who asks.

use super::*;
use crate::counted::Counted;
use crate::old_site::{DAY_MS, OldSite, ROLLOUTS, robot_id};
use midshift_core::reason::Code;
use midshift_core::rollout::rows::{Lost, RolloutRobot, Step};
use midshift_core::time::Utc;

/// Robots that each roll-out reached.
const ROBOTS: u64 = 50;
/// Rows that a start or a takeover may read: some of each robot, and none of the 612 of roll-outs.
const READ_BY_A_START: usize = 400;
/// Rows that ten seconds of turns may read: who leads.
const READ_BY_TURNS: usize = 100;

/// A world in which all roll-outs that ever were have ended.
async fn old_world() -> World {
    let world = World::new();
    let now = world.clock.now().utc;
    let old = OldSite { ended: 0, robots: ROBOTS, retired: 0, from: Utc(now.0 - 40 * DAY_MS), until: now };
    old.begin(&*world.store).await;
    old.finish(&*world.store).await;
    world
}

/// Roll-outs and robots of them in the projection.
async fn held(process: &Process) -> (usize, usize) {
    process.face.ask_projection(|view, _, _| (view.rollouts.len(), view.robots.len())).await.expect("it runs")
}

fn id(number: u64) -> String {
    format!("old-rollout-{number}")
}

#[tokio::test(start_paused = true)]
async fn a_start_a_takeover_and_turns_read_nothing_of_what_has_ended() {
    let world = old_world().await;
    let counted = [(); 2].map(|()| Counted::over(world.store.clone()));
    let leader = world.process_over(counted[0].clone()).await;
    let first = world.holder().await;
    let standby = world.process_over(counted[1].clone()).await;
    let started = counted.each_ref().map(|store| store.take_count());
    assert!(started.iter().all(|rows| *rows > ROBOTS as usize && *rows <= READ_BY_A_START), "{started:?}");
    secs(10).await;
    let turned = counted.each_ref().map(|store| store.take_count());
    assert!(turned.iter().all(|rows| *rows <= READ_BY_TURNS), "{turned:?}");
    leader.kill();
    secs(8).await;
    assert_ne!(world.holder().await, first);
    let taken_over = counted[1].take_count();
    assert!(taken_over > ROBOTS as usize && taken_over <= READ_BY_A_START, "{taken_over}");
    assert_eq!(held(&standby).await, (0, 0));
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn what_has_ended_is_shown_and_listed_to_whoever_asks_and_let_go_of_again() {
    let world = old_world().await;
    let (leader, standby) = (world.process().await, world.process().await);
    for process in [&leader, &standby] {
        let get = v1::GetRolloutRequest { rollout_id: id(3) };
        let shown = Face::get_rollout(&process.face, local(get)).await.expect("shown").into_inner().rollout;
        let shown = shown.expect("a roll-out");
        assert_eq!(shown.counts.as_ref().map(|counts| counts.committed), Some(ROBOTS as u32));
        let request = v1::ListRolloutRobotsRequest { rollout_id: id(3), ..Default::default() };
        let robots = Face::list_rollout_robots(&process.face, local(request)).await.expect("listed");
        assert_eq!(robots.into_inner().robots.len() as u64, ROBOTS);
        let (mut listed, mut page_token) = (Vec::new(), String::new());
        loop {
            let request = v1::ListRolloutsRequest { page_size: 5, page_token, ..Default::default() };
            let page = Face::list_rollouts(&process.face, local(request)).await.expect("a page").into_inner();
            listed.extend(page.rollouts);
            page_token = page.next_page_token;
            if page_token.is_empty() {
                break;
            }
        }
        let ids: Vec<String> = listed.iter().map(|rollout| rollout.rollout_id.clone()).collect();
        assert_eq!(ids, (1..=ROLLOUTS).rev().map(id).collect::<Vec<_>>(), "the newest first, each once");
        assert_eq!(
            listed.into_iter().find(|rollout| rollout.rollout_id == id(3)),
            Some(shown),
            "listed as it is shown"
        );
        let request = v1::ListRolloutsRequest { page_token: "7".to_owned(), ..Default::default() };
        let refused = Face::list_rollouts(&process.face, local(request)).await.expect_err("no such token");
        assert_eq!(refused.code(), tonic::Code::InvalidArgument);
        let taken = process.create(&id(3), &format!("{ROLLOUTS:064x}")).await.expect_err("the id is taken");
        assert_eq!(taken.code(), tonic::Code::AlreadyExists);
        secs(1).await;
        assert_eq!(held(process).await, (0, 0));
    }
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_tried_again_at_the_standby_long_after_the_end_is_decided_by_the_leader() {
    let world = old_world().await;
    let (leader, standby) = (world.process().await, world.process().await);
    let of = format!("{}/{}", id(5), robot_id(7));
    let (robot, at) = world.row::<RolloutRobot>(&of).await.expect("a row");
    let mut back = Item::new(Writer::Ota, "tests");
    back.update(&RolloutRobot { step: Step::RolledBack, ..robot }, at, "robot.rolled_back");
    world.store.commit(vec![back]).await.remove(0).expect("applied");
    let request = v1::RetryRolloutRequest { rollout_id: id(5), ..Default::default() };
    Face::retry_rollout(&standby.face, local(request)).await.expect("tried again");
    secs(3).await;
    let robot = world.row::<RolloutRobot>(&of).await.expect("a row").0;
    // No release lists the bundle any more: that is the leader's word.
    let why = robot.why.map(|why| why.code);
    assert_eq!((robot.again, robot.step, why), (true, Step::Skipped, Some(Code::BundleRevoked)));
    for process in [&leader, &standby] {
        assert_eq!(held(process).await, (0, 0));
    }
    leader.end().await;
    standby.end().await;
}

/// Asks that the robot of this number counts for nothing in roll-out 5, or what the test makes of it.
async fn write_off(
    process: &Process,
    number: u64,
    change: impl FnOnce(&mut v1::WriteOffRobotRequest),
) -> Result<v1::WriteOffRobotResponse, tonic::Status> {
    let mut request = v1::WriteOffRobotRequest {
        rollout_id: id(5),
        robot_id: robot_id(number).to_string(),
        reason: "it burnt".to_owned(),
        request_id: "w-1".to_owned(),
        ..Default::default()
    };
    change(&mut request);
    Ok(Face::write_off_robot(&process.face, local(request)).await?.into_inner())
}

#[tokio::test(start_paused = true)]
async fn a_lost_robot_is_written_off_once_for_a_request_id_whichever_process_is_asked_and_a_check_writes_nothing() {
    let world = old_world().await;
    let of = format!("{}/{}", id(5), robot_id(7));
    let (robot, at) = world.row::<RolloutRobot>(&of).await.expect("a row");
    let lost = Some(Lost { since: world.clock.now().utc, written_off: None });
    let mut item = Item::new(Writer::Ota, "tests");
    item.update(&RolloutRobot { lost, ..robot }, at, "robot.lost");
    world.store.commit(vec![item]).await.remove(0).expect("applied");
    let (leader, standby) = (world.process().await, world.process().await);
    let kept = async || {
        let (row, at) = world.row::<RolloutRobot>(&of).await.expect("a row");
        (row.lost.expect("it is lost").written_off, at)
    };
    let (_, before) = kept().await;
    for process in [&leader, &standby] {
        write_off(process, 7, |r| r.validate_only = true).await.expect("nothing is against it");
    }
    assert_eq!(kept().await, (None, before), "it was only asked whether it may be");
    let answer = write_off(&standby, 7, |_| {}).await.expect("written off");
    assert_eq!((answer.done_before, answer.rollout.map(|r| r.rollout_id)), (None, Some(id(5))));
    let (written_off, written) = kept().await;
    assert_eq!(written_off.map(|act| act.reason).as_deref(), Some("it burnt"));
    for process in [&leader, &standby] {
        let again = write_off(process, 7, |_| {}).await.expect("done already");
        assert!(again.done_before.is_some(), "{again:?}");
        let other = write_off(process, 7, |r| r.reason = "it drowned".to_owned()).await.expect_err("the id is taken");
        assert_eq!(other.code(), tonic::Code::AlreadyExists);
    }
    assert_eq!(kept().await.1, written, "written once");
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn who_is_asked_to_write_a_robot_off_names_all_that_is_wrong_with_it() {
    let world = old_world().await;
    let (leader, standby) = (world.process().await, world.process().await);
    let refused = async |process: &Process, number: u64, change: fn(&mut v1::WriteOffRobotRequest)| {
        midshift_proto::refusal_of(&write_off(process, number, change).await.expect_err("it is refused"))
    };
    for process in [&leader, &standby] {
        let wrong = refused(process, 7, |r| {
            *r = v1::WriteOffRobotRequest { request_id: "a b".to_owned(), ..Default::default() };
        });
        let wrong = wrong.await;
        let fields: Vec<&str> = wrong.violations.iter().map(|violation| violation.field.as_str()).collect();
        assert_eq!(wrong.grpc, tonic::Code::InvalidArgument);
        assert_eq!(fields, ["rollout_id", "robot_id", "reason", "request_id"]);
        let unknown = refused(process, 7, |r| r.rollout_id = id(ROLLOUTS + 1)).await;
        assert_eq!((unknown.grpc, unknown.code), (tonic::Code::NotFound, Some(Code::RolloutNotFound)));
        let nobody = refused(process, ROBOTS + 1, |_| {}).await;
        assert_eq!((nobody.grpc, nobody.code), (tonic::Code::NotFound, Some(Code::RobotNotFound)));
        let heard = refused(process, 7, |_| {}).await;
        assert_eq!((heard.grpc, heard.code), (tonic::Code::FailedPrecondition, Some(Code::RobotNotLost)));
    }
    leader.end().await;
    standby.end().await;
}
