//! One server out of the services of its roles: gRPC, gRPC-Web, reflection, health and metrics on one port, over whatever connections it is
//! given.
//!
//! Invariant: every stream ends at shutdown; what does not end by itself is cut after a hard drain. A service that ends by itself takes the
//! whole server with it: none is served without the others. A gateway among several first says that it is not ready and lets its robots
//! move over.

use crate::components::Components;
use crate::denials;
use crate::housekeeping;
use crate::stop_follower::StopFollower;
use anyhow::{Context, bail};
use axum::routing::get;
use http::StatusCode;
use midshift_cli::roles::Role;
use midshift_cli::site_answer::SiteAnswer;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::{Boxed, limits};
use midshift_edge::{Denials, Listen, Listener};
use midshift_fleet::{FleetService, Reconciler};
use midshift_identity::audit::AuditService;
use midshift_ota::rollouts::{Planner, RolloutService};
use midshift_process::door::{self, Login};
use midshift_process::recorder;
use midshift_proto::sim::v1::sim_service_server;
use midshift_store::LiveBoard;
use midshift_task::TaskService;
use midshift_telemetry::TelemetryService;
use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::net::UdpSocket;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::service::{LayerExt, Routes};
use tonic_health::ServingStatus;
use tonic_health::pb::health_server;
use tonic_health::server::HealthReporter;

/// The services of one process, ready to be served.
pub struct Server {
    parts: Components,
    task: Option<TaskService>,
    fleet: Option<(FleetService, Reconciler)>,
    telemetry: Option<TelemetryService>,
    rollouts: Option<(RolloutService, Planner)>,
    board: Arc<LiveBoard<NewestHeartbeat>>,
    beacons: Option<UdpSocket>,
    /// It was asked to end.
    stop: CancellationToken,
    /// Services end.
    shutdown: CancellationToken,
    /// Whether more work may be sent here.
    ready: Arc<watch::Sender<bool>>,
}

impl Server {
    /// Builds the services; nothing runs yet. They end some time after `stop`.
    pub fn new(parts: Components, stop: CancellationToken) -> Boxed<'static, anyhow::Result<Self>> {
        Box::pin(Self::build(parts, stop))
    }

    async fn build(mut parts: Components, stop: CancellationToken) -> anyhow::Result<Self> {
        parts.ota = parts.ota.with_rows(parts.store.clone());
        parts.reader = parts.reader.map(|reader| reader.with_rows(parts.store.clone()));
        let board: Arc<LiveBoard<NewestHeartbeat>> = LiveBoard::new();
        let shutdown = CancellationToken::new();
        let task = match parts.roles.has(Role::Task) {
            true => Some(open_task(&parts, &shutdown).await?),
            false => None,
        };
        let fleet = parts.roles.has(Role::Fleet).then(|| {
            FleetService::new(midshift_fleet::Parts {
                store: parts.store.clone(),
                board: board.clone(),
                site: parts.site.clone(),
                site_text: parts.site_text.clone(),
                map: parts.map.clone(),
                clock: parts.clock.clone(),
                bugs: parts.naive.fleet,
            })
        });
        let telemetry = parts.roles.has(Role::Telemetry).then(|| {
            let parts = midshift_telemetry::Parts {
                store: parts.store.clone(),
                frames: parts.frames.clone(),
                board: board.clone(),
                heard: parts.heard.clone(),
                clock: parts.clock.clone(),
                bugs: parts.naive.telemetry,
            };
            TelemetryService::new(parts, shutdown.clone())
        });
        let rollouts = parts.roles.has(Role::Ota).then(|| {
            let parts = midshift_ota::rollouts::Parts {
                store: parts.store.clone(),
                board: board.clone(),
                site: parts.site.clone(),
                clock: parts.clock.clone(),
                ota: parts.ota.clone(),
                bugs: parts.naive.rollouts,
            };
            RolloutService::new(parts, shutdown.clone())
        });
        let (beacons, ready) = (None, Arc::new(watch::Sender::new(true)));
        Ok(Self { parts, task, fleet, telemetry, rollouts, board, beacons, stop, shutdown, ready })
    }

    /// Listens for the beacons of launchers on this socket too.
    pub fn hearing(self, beacons: Option<UdpSocket>) -> Self {
        Self { beacons, ..self }
    }

    /// Roll-outs that name no probation have this one, milliseconds of site time.
    pub fn with_probation(self, probation_ms: u64) -> Self {
        let rollouts = self.rollouts.map(|(face, planner)| (face.with_probation(probation_ms), planner));
        Self { rollouts, ..self }
    }

    /// Fleet, for whoever reports in this process, if it has it.
    pub fn fleet(&self) -> Option<FleetService> {
        self.fleet.as_ref().map(|(face, _)| face.clone())
    }
    /// Newest heartbeats, for whoever reports in this process.
    pub fn board(&self) -> Arc<LiveBoard<NewestHeartbeat>> {
        self.board.clone()
    }

    async fn routes(&self) -> anyhow::Result<(Routes, HealthReporter)> {
        let control = limits::CONTROL_MESSAGE_BYTES;
        // Of all services of a server, whichever are here: a proxy asks any process. Those of the stop service answer on a port of its own.
        let names = Role::ALL.into_iter().flat_map(Role::services).copied();
        let names: BTreeSet<&str> = names
            .chain(self.parts.sim.as_ref().map(|_| sim_service_server::SERVICE_NAME))
            .chain([health_server::SERVICE_NAME])
            .collect();
        let reflection = || {
            let builder = tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(midshift_proto::FILE_DESCRIPTOR_SET)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
                // Without these a generic client cannot read the details of a refusal.
                .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET);
            names.iter().fold(builder, |builder, name| builder.with_service_name(*name))
        };
        let (health, health_service) = tonic_health::server::health_reporter();
        let health_service = health_service.max_decoding_message_size(limits::HEALTH_MESSAGE_BYTES);
        let said = SiteAnswer { site_id: self.parts.site.site_id().to_string(), stop_port: self.parts.stop_port };
        let said = said.layer(self.parts.clock.clone(), self.parts.jumped_before);
        let mut routes = Routes::new(said.named_layer(health_service))
            .add_service(reflection().build_v1()?.max_decoding_message_size(control))
            .add_service(reflection().build_v1alpha()?.max_decoding_message_size(control));
        if let Some(task) = &self.task {
            let audit = AuditService::new(self.parts.store.clone(), self.parts.clock.clone(), self.shutdown.clone());
            routes = audit.add_to(task.add_to(routes));
        }
        if let Some((fleet, _)) = &self.fleet {
            routes = fleet.add_to(routes);
        }
        if let Some(telemetry) = &self.telemetry {
            routes = telemetry.add_to(routes);
        }
        if let Some((rollouts, _)) = &self.rollouts {
            routes = rollouts.add_to(self.parts.ota.add_bundles_to(routes));
        }
        if let Some(identity) = self.parts.identity.as_ref().filter(|_| self.parts.roles.has(Role::Identity)) {
            routes = identity.add_to(routes);
        }
        let has_bytes = self.telemetry.is_some() || self.rollouts.is_some();
        match &self.parts.reader {
            Some(reader) => routes = reader.add_to(routes),
            None if has_bytes => routes = self.parts.ota.add_chunks_to(routes),
            None => {}
        }
        if let Some(sim) = self.parts.sim.clone() {
            routes = sim.add_to(routes);
        }
        let handle = recorder::handle();
        let metrics = move || {
            let handle = handle.clone();
            async move { handle.map(|h| h.render()).unwrap_or_default() }
        };
        // Browsers speak gRPC-Web to the services; Prometheus and clients of TUF speak plain HTTP/1.1 to the pages beside them.
        let services = routes.into_axum_router().layer(tonic_web::GrpcWebLayer::new());
        let ready = self.ready.clone();
        let readiness = move || {
            let ready = *ready.borrow();
            async move { if ready { (StatusCode::OK, "ready\n") } else { (StatusCode::SERVICE_UNAVAILABLE, "not ready\n") } }
        };
        let mut pages = services.route("/metrics", get(metrics)).route("/ready", get(readiness));
        match &self.parts.reader {
            Some(reader) => pages = pages.merge(reader.pages()),
            None if has_bytes => pages = pages.merge(self.parts.ota.pages()),
            None => {}
        }
        Ok((Routes::from(pages), health))
    }

    /// Serves connections until shutdown, then drains and cuts.
    ///
    /// # Errors
    /// If a service ends before shutdown; everything else has been shut down then.
    pub fn serve(self, listener: impl Listen) -> Boxed<'static, anyhow::Result<()>> {
        Box::pin(self.serve_all(Listener::new(listener)))
    }

    async fn serve_all(self, listener: Listener) -> anyhow::Result<()> {
        let (routes, health) = self.routes().await?;
        let (stop, shutdown) = (self.stop.clone(), self.shutdown.clone());
        // However this ends, also in a panic: nobody goes on without it.
        let _end = (stop.clone().drop_guard(), shutdown.clone().drop_guard());
        let (sink, denials) = Denials::new(self.parts.port.port);
        let login = self.parts.identity.as_ref().map(|identity| Login {
            site_id: self.parts.site.site_id().clone(),
            clock: self.parts.clock.clone(),
            directory: identity.directory(),
            proof: identity.proof(),
            denials: sink,
        });
        let writing = denials::write(&*self.parts.store, denials);
        let transport = door::serve(self.parts.port.clone(), login, routes, listener, shutdown.clone());
        let mut names = self.parts.roles.services();
        if self.parts.identity.is_none() {
            names.retain(|name| !Role::Identity.services().contains(name));
        }
        let readiness = publish_health(&health, names, self.ready.subscribe());
        let ending = end(stop.clone(), shutdown.clone(), self.parts.drain, self.telemetry.clone(), self.ready.clone());
        let following = follow(&self.parts, self.board.clone());
        let keeper = housekeeping::run(&self.parts, self.task.clone());
        let failure = OnceLock::new();
        let services = async {
            let services = Running {
                fleet: self.fleet.map(|(_, reconciler)| reconciler),
                planner: self.rollouts.map(|(_, planner)| planner),
                telemetry: self.telemetry,
                beacons: self.beacons,
                parts: &self.parts,
            };
            if let Err(error) = services.run(&shutdown).await {
                tracing::error!(%error, "a service ended, and with it the server");
                // Nothing else sets it.
                let _ = failure.set(error);
                stop.cancel();
                shutdown.cancel();
            }
        };
        let hard = async {
            shutdown.cancelled().await;
            tokio::time::sleep(Duration::from_millis(limits::HARD_DRAIN.as_ms())).await;
        };
        let transport = async {
            let served = transport.await;
            // Without a door there is nothing to serve.
            stop.cancel();
            shutdown.cancel();
            served
        };
        tokio::select! {
            (served, (), ()) = async { tokio::join!(transport, services, ending) } => served.context("serving")?,
            () = readiness => {}
            () = keeper => {}
            () = writing => {}
            () = following => {}
            () = hard => tracing::info!("open streams were cut"),
        }
        failure.into_inner().map_or(Ok(()), Err)
    }
}

async fn open_task(parts: &Components, shutdown: &CancellationToken) -> anyhow::Result<TaskService> {
    let task = midshift_task::Parts {
        store: parts.store.clone(),
        site: parts.site.clone(),
        clock: parts.clock.clone(),
        bugs: parts.naive.task,
    };
    TaskService::open(task, shutdown.clone()).await.context("opening task intake")
}

/// What of a server runs by itself.
struct Running<'p> {
    fleet: Option<Reconciler>,
    planner: Option<Planner>,
    telemetry: Option<TelemetryService>,
    beacons: Option<UdpSocket>,
    parts: &'p Components,
}

impl Running<'_> {
    /// Until shutdown, or until one of them ends by itself.
    async fn run(self, shutdown: &CancellationToken) -> anyhow::Result<()> {
        let planning = &self.parts.planning;
        let fleet = self.fleet.map(|r| AbortOnDropHandle::new(planning.spawn(r.run(shutdown.clone()))));
        let planner = self.planner.map(|p| AbortOnDropHandle::new(planning.spawn(p.run(shutdown.clone()))));
        let telemetry = async {
            match self.telemetry.clone() {
                Some(telemetry) => until(shutdown, "telemetry", async { Ok(telemetry.run().await?) }).await,
                None => Ok(()),
            }
        };
        let ear = async {
            if let (Some(telemetry), Some(socket)) = (self.telemetry.clone(), self.beacons) {
                telemetry.hear_beacons(socket).await;
            }
            Ok(())
        };
        let ota = async {
            if self.parts.roles.has(Role::Ota) {
                self.parts.ota.clone().run(shutdown.clone()).await;
            }
            Ok(())
        };
        let ota = async {
            match self.parts.roles.has(Role::Ota) {
                true => until(shutdown, "ota", ota).await,
                false => Ok(()),
            }
        };
        let reader = async {
            if let Some(reader) = self.parts.reader.clone() {
                reader.run(shutdown.clone()).await;
            }
            Ok(())
        };
        let identity = async {
            if let Some(identity) = &self.parts.identity {
                identity.run(shutdown.clone()).await;
            }
            Ok(())
        };
        let stops = self.parts.stops.clone().map(|folder| {
            let parts = &self.parts;
            StopFollower::new(folder, parts.store.clone(), parts.identity.clone(), parts.clock.clone())
        });
        let stops = async {
            if let Some(follower) = stops {
                // It ends with the others.
                shutdown.run_until_cancelled(follower.run()).await;
            }
            Ok(())
        };
        let planners =
            async { tokio::try_join!(spawned(shutdown, "fleet", fleet), spawned(shutdown, "rollouts", planner)) };
        tokio::try_join!(planners, telemetry, ear, ota, reader, stops, identity).map(drop)
    }
}

/// Waits for `stop`, lets robots move to another gateway for as long as they have, and ends the services.
async fn end(
    stop: CancellationToken,
    shutdown: CancellationToken,
    drain: Duration,
    telemetry: Option<TelemetryService>,
    ready: Arc<watch::Sender<bool>>,
) {
    let mut cut_off = telemetry.as_ref().and_then(TelemetryService::cut_off);
    loop {
        tokio::select! {
            () = stop.cancelled() => break,
            lost = changed(&mut cut_off) => { ready.send_replace(!lost); }
        }
    }
    ready.send_replace(false);
    if let Some(telemetry) = telemetry.filter(|_| !drain.is_zero())
        && tokio::time::timeout(drain, telemetry.move_over()).await.is_err()
    {
        tracing::info!("not every robot moved to another gateway in time");
    }
    shutdown.cancel();
}

async fn changed(watched: &mut Option<watch::Receiver<bool>>) -> bool {
    if let Some(watched) = watched
        && watched.changed().await.is_ok()
    {
        return *watched.borrow_and_update();
    }
    std::future::pending().await
}

/// Reads what other gateways hear, if there may be any.
async fn follow(parts: &Components, board: Arc<LiveBoard<NewestHeartbeat>>) {
    match parts.heard.clone() {
        Some(heard) => midshift_store::follow_heartbeats(heard, board, parts.clock.clone()).await,
        None => std::future::pending().await,
    }
}

/// A service that ends before `shutdown` is a failure, whatever it says.
async fn until(
    shutdown: &CancellationToken,
    name: &'static str,
    service: impl Future<Output = anyhow::Result<()>>,
) -> anyhow::Result<()> {
    service.await.context(name)?;
    if !shutdown.is_cancelled() {
        bail!("{name} ended while it was needed");
    }
    Ok(())
}

/// As [`until`], of what runs elsewhere, if it does.
async fn spawned<E: std::error::Error + Send + Sync + 'static>(
    shutdown: &CancellationToken,
    name: &'static str,
    service: Option<AbortOnDropHandle<Result<(), E>>>,
) -> anyhow::Result<()> {
    match service {
        Some(service) => until(shutdown, name, async { Ok(service.await??) }).await,
        None => Ok(()),
    }
}

/// Keeps health as the process is ready or not, for each of its services.
async fn publish_health(health: &HealthReporter, names: BTreeSet<&'static str>, mut ready: watch::Receiver<bool>) {
    loop {
        let status = if *ready.borrow_and_update() { ServingStatus::Serving } else { ServingStatus::NotServing };
        for name in &names {
            health.set_service_status(*name, status).await;
        }
        if ready.changed().await.is_err() {
            return std::future::pending().await;
        }
    }
}

#[cfg(test)]
mod tests {
    mod frames;
    mod old_connections;

    use super::*;
    use crate::NaiveRules;
    use crate::planning::Planning;
    use midshift_cli::roles::Roles;
    use midshift_cli::site_file;
    use midshift_ota::OtaService;
    use midshift_process::clock;
    use midshift_store::{MemoryFrames, MemoryStore, StoreId};
    use tokio::net::TcpListener;
    use tokio::task::JoinHandle;
    use tonic::Streaming;
    use tonic::transport::{Channel, Endpoint};
    use tonic_health::pb::health_check_response::ServingStatus as Told;
    use tonic_health::pb::health_client::HealthClient;
    use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

    struct World {
        planning: Planning,
        shutdown: CancellationToken,
        serving: JoinHandle<anyhow::Result<()>>,
        channel: Channel,
    }

    /// A server of every role in memory, without login.
    pub fn parts(planning: &Planning) -> anyhow::Result<Components> {
        let loaded = site_file::load(None, None, None)?;
        let clock = clock::clock(1000);
        let store_id = StoreId(Arc::from("store-1"));
        Ok(Components {
            roles: Roles::default(),
            drain: Duration::ZERO,
            heard: None,
            store: Arc::new(MemoryStore::new(loaded.site.site_id().clone(), store_id, clock.clone())),
            frames: Arc::new(MemoryFrames::new(clock.clone(), 1 << 20)),
            site: loaded.site,
            site_text: loaded.text,
            map: Default::default(),
            clock,
            ota: OtaService::without_keys(),
            identity: None,
            port: door::alone("business"),
            reader: None,
            sim: None,
            naive: NaiveRules::default(),
            stops: None,
            stop_port: None,
            keep: Default::default(),
            jumped_before: None,
            planning: planning.handle(),
        })
    }

    async fn world() -> anyhow::Result<World> {
        let planning = Planning::start()?;
        let shutdown = CancellationToken::new();
        let server = Server::new(parts(&planning)?, shutdown.clone()).await?;
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let channel = Endpoint::from_shared(format!("http://{}", listener.local_addr()?))?.connect_lazy();
        let serving = tokio::spawn(server.serve(listener));
        Ok(World { planning, shutdown, serving, channel })
    }

    impl World {
        /// What the health service says of fleet, first and from now on.
        async fn health(&self) -> anyhow::Result<Streaming<HealthCheckResponse>> {
            let request = HealthCheckRequest { service: "midshift.fleet.v1.FleetService".to_owned() };
            Ok(HealthClient::new(self.channel.clone()).watch(request).await?.into_inner())
        }
    }

    async fn next(health: &mut Streaming<HealthCheckResponse>) -> anyhow::Result<Told> {
        Ok(health.message().await?.context("the health service says no more")?.status())
    }

    #[tokio::test]
    async fn a_service_that_ends_by_itself_ends_the_server_with_an_error() -> anyhow::Result<()> {
        let world = world().await?;
        let mut health = world.health().await?;
        assert_eq!(next(&mut health).await?, Told::Serving);
        // The thread that plans is gone, and with it fleet and roll-outs, in either order.
        drop(world.planning);
        assert_eq!(next(&mut health).await?, Told::NotServing);
        assert!(world.shutdown.is_cancelled(), "everything else in the process ends too");
        drop(health);
        let error = world.serving.await?.expect_err("it did not end as it was asked to");
        let named = error.to_string();
        assert!(["fleet", "rollouts"].contains(&&*named), "{named}");
        Ok(())
    }

    #[tokio::test]
    async fn a_service_that_ends_at_shutdown_is_no_failure() -> anyhow::Result<()> {
        let world = world().await?;
        let mut health = world.health().await?;
        assert_eq!(next(&mut health).await?, Told::Serving);
        world.shutdown.cancel();
        assert_eq!(next(&mut health).await?, Told::NotServing);
        drop(health);
        world.serving.await?
    }
}
