//! Permission that is delivered late, or that stood while the robot was away: it moves nobody. With the naive rules it does.
//!
//! The server is a real process with a real disk; the agents run in this process, so that a naive rule can be switched on in them.

use crate::harness::until;
use crate::proxy::Proxy;
use crate::room::{LIMIT, Room};
use midshift_agent::bugs::SeededBug;
use midshift_core::time::SiteDuration;
use midshift_proto::link::v1::robot_event::Event as Said;
use midshift_proto::link::v1::{PlaceNews, WorkState};
use midshift_proto::task::v1::TaskState;
use midshift_sim::faults::Injected;
use std::time::Duration;

/// How long the proxy holds bytes back. An offer is valid for 5 s, the entry of a place for 10 s.
const HELD: Duration = Duration::from_secs(12);

fn stale(said: &[Said], what: &str) -> usize {
    said.iter().filter(|s| matches!(s, Said::StaleAuthority(r) if r.what == what)).count()
}

/// Epochs a robot took of its tasks.
fn taken(said: &[Said]) -> Vec<u64> {
    let epoch = |s: &Said| match s {
        Said::Attempt(a) if a.state() == WorkState::Accepted => a.attempt.as_ref().map(|id| id.epoch),
        _ => None,
    };
    said.iter().filter_map(epoch).collect()
}

/// What became of an offer whose bytes were held back.
struct LateOffer {
    taken: Vec<u64>,
    stale: usize,
    moved_mm: u64,
}

async fn late_offer(bugs: &[SeededBug]) -> anyhow::Result<LateOffer> {
    let room = Room::open().await?;
    let proxy = Proxy::before(room.server.address).await?;
    let robot = room.robot("r1", "park-a", proxy.address, bugs).await?;
    room.until_held("park-a", "r1", true).await?;
    proxy.hold(true);
    room.submit("T1", "r1").await?;
    room.until_state("T1", TaskState::Assigned).await?;
    // The fault itself: this is how long the bytes lie in the proxy.
    tokio::time::sleep(HELD).await;
    let moved_mm = robot.body.lock().odometers_mm().0;
    proxy.hold(false);
    let taken = until("the robot takes the task", LIMIT, || async {
        let taken = taken(&room.said("r1").await?);
        Ok((!taken.is_empty()).then_some(taken))
    })
    .await?;
    if taken[0] > 1 {
        room.until_state("T1", TaskState::Succeeded).await?;
    }
    Ok(LateOffer { taken, stale: stale(&room.said("r1").await?, "offer"), moved_mm })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_offer_whose_bytes_were_held_back_past_its_validity_moves_nobody() -> anyhow::Result<()> {
    use SeededBug::{AuthorityFromReceipt, PatientSession};
    let (right, patient, naive) = tokio::try_join!(
        late_offer(&[]),
        // It hears the late bytes in the same session, and refuses them.
        late_offer(&[PatientSession]),
        late_offer(&[PatientSession, AuthorityFromReceipt]),
    )?;
    for outcome in [&right, &patient] {
        assert_eq!(outcome.moved_mm, 0);
        assert!(outcome.taken.iter().all(|epoch| *epoch > 1), "it took {:?}", outcome.taken);
    }
    assert!(patient.stale > 0, "the late offer arrived and was refused");
    assert_eq!(naive.taken.first(), Some(&1), "the naive rule takes what is 12 s old");
    Ok(())
}

/// Lets a permission to enter stand while its robot reconnects; how often the robot refused it before it entered.
async fn grant_over_a_reconnect(bugs: &[SeededBug]) -> anyhow::Result<usize> {
    let room = Room::open().await?;
    let proxy = Proxy::before(room.server.address).await?;
    // A robot in somebody's hands stands in the goal, so the other waits before the corridor.
    let blocker = room.robot("r1", "B", room.server.address, &[]).await?;
    blocker.body.inject(room.clock.now().site, Injected::Manual(SiteDuration::from_secs(3_600)));
    room.until_held("B", "r1", true).await?;
    let robot = room.robot("r2", "park-a", proxy.address, bugs).await?;
    room.submit("T1", "r2").await?;
    until("r2 stands before the corridor", LIMIT, || async {
        let inside = robot.body.lock().inside().iter().any(|p| p.as_str() == "wait-a");
        Ok((inside && room.place("corridor").await?.holders.is_empty()).then_some(()))
    })
    .await?;
    proxy.hold(true);
    blocker.body.lock().hand_back(room.clock.now().site);
    room.until_held("corridor", "r2", true).await?;
    // The grant stands; the session it is anchored in ends, and another begins whose bytes lie in the proxy too.
    proxy.cut();
    tokio::time::sleep(HELD).await;
    assert!(!robot.body.lock().inside().iter().any(|p| p.as_str() == "corridor"));
    proxy.hold(false);
    let before = until("r2 enters the corridor", LIMIT, || async {
        let said = room.said("r2").await?;
        let at = said
            .iter()
            .position(|s| matches!(s, Said::Place(p) if p.place_id == "corridor" && p.news() == PlaceNews::Entered));
        Ok(at.map(|at| said[..at].to_vec()))
    })
    .await?;
    room.until_state("T1", TaskState::Succeeded).await?;
    Ok(stale(&before, "grant"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_grant_that_stood_while_its_robot_reconnected_moves_nobody() -> anyhow::Result<()> {
    let (right, naive) =
        tokio::try_join!(grant_over_a_reconnect(&[]), grant_over_a_reconnect(&[SeededBug::GrantFromReceipt]))?;
    assert!(right > 0, "the old grant was shown and refused");
    assert_eq!(naive, 0, "the naive rule enters on it");
    Ok(())
}
