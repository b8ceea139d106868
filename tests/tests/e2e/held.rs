//! Permission that is delivered late, or that stood while the robot was away: it moves nobody. With the naive rules it does.
//!
//! The server is a real process with a real disk; the agents run in this process, so that a naive rule can be switched on in them.

use crate::harness::{Server, until};
use crate::proxy::Proxy;
use anyhow::Context;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_agent::dial::TcpDial;
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{self, AgentConfig};
use midshift_core::ids::{RobotId, WaypointId};
use midshift_core::site::{CORRIDOR, text};
use midshift_core::time::{Clock, SiteDuration};
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{ListPlacesRequest, Place};
use midshift_proto::link::v1::robot_event::Event as Said;
use midshift_proto::link::v1::{PlaceNews, WorkState, sample};
use midshift_proto::task::v1::submit_task_request::Body;
use midshift_proto::task::v1::{FlatTask, SubmitTaskRequest, TaskState};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, event::Item};
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::{FaultRates, Injected};
use midshift_sim::handle::SimHandle;
use midshift_sim::world::{SharedWorld, World, WorldConfig};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// How long the proxy holds bytes back. An offer is valid for 5 s, the entry of a place for 10 s.
const HELD: Duration = Duration::from_secs(12);
/// Longest wait for anything that must happen.
const LIMIT: Duration = Duration::from_secs(90);

struct Room {
    server: Server,
    clock: Arc<dyn Clock>,
    world: SharedWorld,
    _dir: tempfile::TempDir,
}

struct Robot {
    body: SimHandle,
    _agent: AbortOnDropHandle<()>,
}

impl Room {
    async fn open() -> anyhow::Result<Self> {
        let dir = tempfile::tempdir()?;
        let server = Server::start_on(dir.path(), CORRIDOR).await?;
        let world = WorldConfig { auto_stock: true, ..WorldConfig::default() };
        let world = World::new(world, &text::parse(CORRIDOR)?).shared();
        Ok(Self { server, clock: midshift::clock::clock(1000), world, _dir: dir })
    }

    /// A robot whose body stands at `start` and whose agent dials `address`.
    fn robot(&self, name: &str, start: &str, address: SocketAddr, bugs: &[SeededBug]) -> anyhow::Result<Robot> {
        let robot_id = RobotId::parse(name)?;
        let mut config = BodyConfig::new(robot_id.clone(), 1, WaypointId::parse(start)?);
        (config.faults, config.battery_permille, config.drains) = (FaultRates::none(), Some(1_000), false);
        config.pace_permille = 5_000;
        let site = Arc::new(text::parse(CORRIDOR)?);
        let body = SimHandle::new(SimBody::new(config, site, self.world.clone(), self.clock.now().site)?);
        let agent = AgentConfig {
            robot_id,
            boot_id: format!("boot-{name}"),
            new_ring_id: format!("ring-{name}"),
            seed: 1,
            bugs: Bugs::of(bugs),
            pulse: None,
        };
        let dial = Arc::new(TcpDial::new(&format!("http://{address}"), None)?);
        let (store, clock, witness) = (Box::new(MemoryStore::new()), self.clock.clone(), Box::new(body.clone()));
        let running = async move {
            // Ends with the test.
            let _ = session::run(agent, witness, store, clock, dial, CancellationToken::new()).await;
        };
        Ok(Robot { body, _agent: AbortOnDropHandle::new(tokio::spawn(running)) })
    }

    async fn submit(&self, task: &str, robot: &str) -> anyhow::Result<()> {
        let work = FlatTask {
            task_id: task.to_owned(),
            robot_id: robot.to_owned(),
            task_type: "transport".to_owned(),
            from_waypoint: "A".to_owned(),
            to_waypoint: "B".to_owned(),
            timeout_seconds: Some(600),
            ..FlatTask::default()
        };
        let request = SubmitTaskRequest { body: Some(Body::Flat(work)), ..SubmitTaskRequest::default() };
        self.server.tasks()?.submit_task(request).await?;
        Ok(())
    }

    async fn until_state(&self, task: &str, state: TaskState) -> anyhow::Result<()> {
        until(&format!("{task} {state:?}"), LIMIT, || async {
            let there = self.server.in_states(&[state]).await?.unwrap_or_default();
            Ok(there.iter().any(|t| t.task_id == task).then_some(()))
        })
        .await
    }

    /// What a robot said in its events, oldest first.
    async fn said(&self, robot: &str) -> anyhow::Result<Vec<Said>> {
        let mut client = TelemetryServiceClient::new(self.server.channel()?);
        let request =
            ListEventsRequest { robot_ids: vec![robot.to_owned()], page_size: 1_000, ..ListEventsRequest::default() };
        let page = client.list_events(request).await?.into_inner();
        let event = |item| match item {
            Some(Item::Sample(s)) => match s.body {
                Some(sample::Body::Event(e)) => e.event,
                _ => None,
            },
            _ => None,
        };
        Ok(page.events.into_iter().filter_map(|e| event(e.item)).collect())
    }

    async fn place(&self, id: &str) -> anyhow::Result<Place> {
        let mut client = FleetServiceClient::new(self.server.channel()?);
        let places = client.list_places(ListPlacesRequest::default()).await?.into_inner().places;
        places.into_iter().find(|p| p.place_id == id).with_context(|| format!("no place {id}"))
    }

    async fn until_held(&self, place: &str, robot: &str, held: bool) -> anyhow::Result<()> {
        until(&format!("{place} held by {robot}: {held}"), LIMIT, || async {
            let found = self.place(place).await?.holders.iter().any(|h| h.robot_id == robot);
            Ok((found == held).then_some(()))
        })
        .await
    }
}

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
    let robot = room.robot("r1", "park-a", proxy.address, bugs)?;
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
    let blocker = room.robot("r1", "B", room.server.address, &[])?;
    blocker.body.inject(room.clock.now().site, Injected::Manual(SiteDuration::from_secs(3_600)));
    room.until_held("B", "r1", true).await?;
    let robot = room.robot("r2", "park-a", proxy.address, bugs)?;
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
