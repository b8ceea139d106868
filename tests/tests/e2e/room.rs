//! A real server on the corridor site, with robots whose agents run in the test's own process.

use crate::harness::{Server, until};
use crate::robots::enrolled;
use anyhow::Context;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_agent::bulk::Bulk;
use midshift_agent::dial::TcpDial;
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{self, AgentConfig, Lines};
use midshift_core::ids::{RobotId, WaypointId};
use midshift_core::site::{CORRIDOR, text};
use midshift_core::time::Clock;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{ListPlacesRequest, Place};
use midshift_proto::link::v1::robot_event::Event as Said;
use midshift_proto::link::v1::sample;
use midshift_proto::task::v1::submit_task_request::Body;
use midshift_proto::task::v1::{FlatTask, SubmitTaskRequest, TaskState};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, ListRobotsRequest, Presence, event::Item};
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::FaultRates;
use midshift_sim::handle::SimHandle;
use midshift_sim::world::{SharedWorld, World, WorldConfig};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Longest wait for anything that must happen.
pub const LIMIT: Duration = Duration::from_secs(90);

/// The server, its clock and the world of items.
pub struct Room {
    pub server: Server,
    pub clock: Arc<dyn Clock>,
    world: SharedWorld,
    /// A folder that goes with the room.
    pub dir: tempfile::TempDir,
}

/// A body and its agent, which ends with it.
pub struct Robot {
    pub body: SimHandle,
    _agent: AbortOnDropHandle<()>,
}

impl Room {
    pub async fn open() -> anyhow::Result<Self> {
        Self::open_on(CORRIDOR).await
    }

    /// With other rules than the corridor site has.
    pub async fn open_on(site: &str) -> anyhow::Result<Self> {
        let dir = tempfile::tempdir()?;
        let server = Server::start_on(dir.path(), site).await?;
        let world = WorldConfig { auto_stock: true, ..WorldConfig::default() };
        let world = World::new(world, &text::parse(CORRIDOR)?).shared();
        Ok(Self { server, clock: midshift_process::clock::clock(1000), world, dir })
    }

    /// A robot whose body stands at `start` and whose agent dials `address`.
    pub async fn robot(
        &self,
        name: &str,
        start: &str,
        address: SocketAddr,
        bugs: &[SeededBug],
    ) -> anyhow::Result<Robot> {
        let robot_id = RobotId::parse(name)?;
        let tls = enrolled(address, &robot_id).await?;
        let mut config = BodyConfig::new(robot_id.clone(), 1, WaypointId::parse(start)?);
        (config.faults, config.battery_permille, config.drains) = (FaultRates::none(), Some(1_000), false);
        config.pace_permille = 5_000;
        let site = Arc::new(text::parse(CORRIDOR)?);
        let body = SimHandle::new(SimBody::new(config, site, self.world.clone(), self.clock.now().site)?);
        let agent = AgentConfig {
            stop: None,
            update: None,
            robot_id,
            boot_id: format!("boot-{name}"),
            new_ring_id: format!("ring-{name}"),
            seed: 1,
            bugs: Bugs::seeded(bugs),
            pulse: None,
        };
        let uri = format!("https://{address}");
        let bulk = Bulk::new(Arc::new(TcpDial::bulk(&uri, None)?.with_tls(tls.clone())));
        let lines = Lines { link: Arc::new(TcpDial::new(&uri, None)?.with_tls(tls)), bulk };
        let (store, clock, witness) = (Box::new(MemoryStore::new()), self.clock.clone(), Box::new(body.clone()));
        let running = async move {
            // Ends with the test.
            let _ = session::run(agent, witness, store, clock, lines, CancellationToken::new()).await;
        };
        Ok(Robot { body, _agent: AbortOnDropHandle::new(tokio::spawn(running)) })
    }

    pub async fn submit(&self, task: &str, robot: &str) -> anyhow::Result<()> {
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

    pub async fn until_state(&self, task: &str, state: TaskState) -> anyhow::Result<()> {
        until(&format!("{task} {state:?}"), LIMIT, || async {
            let there = self.server.in_states(&[state]).await?.unwrap_or_default();
            Ok(there.iter().any(|t| t.task_id == task).then_some(()))
        })
        .await
    }

    /// What a robot said in its events, oldest first.
    pub async fn said(&self, robot: &str) -> anyhow::Result<Vec<Said>> {
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

    pub async fn place(&self, id: &str) -> anyhow::Result<Place> {
        let mut client = FleetServiceClient::new(self.server.channel()?);
        let places = client.list_places(ListPlacesRequest::default()).await?.into_inner().places;
        places.into_iter().find(|p| p.place_id == id).with_context(|| format!("no place {id}"))
    }

    pub async fn until_held(&self, place: &str, robot: &str, held: bool) -> anyhow::Result<()> {
        until(&format!("{place} held by {robot}: {held}"), LIMIT, || async {
            let found = self.place(place).await?.holders.iter().any(|h| h.robot_id == robot);
            Ok((found == held).then_some(()))
        })
        .await
    }

    /// Waits until a robot is online and has said that it took what it was given.
    pub async fn until_it_obeys(&self, robot: &str) -> anyhow::Result<()> {
        until(&format!("{robot} to obey"), LIMIT, || async {
            let mut client = TelemetryServiceClient::new(self.server.channel()?);
            let robots = client.list_robots(ListRobotsRequest::default()).await?.into_inner().robots;
            let obeys = |r: &midshift_proto::telemetry::v1::Robot| {
                let said = r.reported.clone().unwrap_or_default();
                let works = said.vitals.is_some_and(|vitals| vitals.energy_mwh > 0);
                r.presence() == Presence::Online && said.applied_work > 0 && said.applied_policy > 0 && works
            };
            Ok(robots.iter().any(|r| r.robot_id == robot && obeys(r)).then_some(()))
        })
        .await
    }
}
