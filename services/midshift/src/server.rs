//! One server out of the services: gRPC, gRPC-Web, reflection, health and metrics on one port, over whatever connections it is given.
//!
//! Invariant: every stream ends at shutdown; what does not end by itself is cut after a hard drain. A service that ends by itself takes the
//! whole server with it: none is served without the others.

use anyhow::{Context, bail};
use axum::routing::get;
use metrics_exporter_prometheus::{PrometheusBuilder, PrometheusHandle};
use midshift_core::fleet::rows::FleetMark;
use midshift_core::limits;
use midshift_core::rollout::rows::OtaMark;
use midshift_core::site::Site;
use midshift_core::time::Clock;
use midshift_core::work::Live;
use midshift_fleet::{FleetService, Reconciler};
use midshift_ota::OtaService;
use midshift_ota::rollouts::{Planner, RolloutService};
use midshift_proto::sim::v1::sim_service_server::SimServiceServer;
use midshift_sim::service::SimFace;
use midshift_store::{FrameLog, LiveBoard, Retention, Store};
use midshift_task::TaskService;
use midshift_telemetry::TelemetryService;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::UdpSocket;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::service::Routes;
use tonic::transport::Server as Transport;
use tonic::transport::server::Connected;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

/// Pings of the server on a quiet connection, and how long it waits for their answer.
const KEEPALIVE: (Duration, Duration) = (Duration::from_secs(20), Duration::from_secs(10));
/// Names under which the health service knows the server; the empty one is the whole.
const HEALTH: [&str; 8] = [
    "",
    "midshift.task.v1.TaskService",
    "midshift.fleet.v1.FleetService",
    "midshift.telemetry.v1.TelemetryService",
    "midshift.link.v1.LinkService",
    "midshift.ota.v1.BundleService",
    "midshift.ota.v1.ChunkService",
    "midshift.ota.v1.RolloutService",
];
/// How often old log entries are taken away.
const PRUNE_EVERY: Duration = Duration::from_secs(60);
/// How often samples of histograms are folded: without a scrape they would gather for ever.
const FOLD_EVERY: Duration = Duration::from_secs(5);
/// Log entries kept at most, beside the days of [`limits::REMEMBER_DAYS`].
const ENTRIES_MAX: u64 = 20_000_000;

/// Naive rules of the services, for twins of tests. None by default.
#[derive(Clone, Copy, Debug, Default)]
pub struct Naive {
    /// Of the link.
    pub telemetry: midshift_telemetry::Bugs,
    /// Of fleet.
    pub fleet: midshift_core::fleet::bugs::Bugs,
    /// Of roll-outs.
    pub rollouts: midshift_core::rollout::bugs::Bugs,
}

/// What a server is built from.
pub struct Parts {
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// Where STATUS is kept.
    pub frames: Arc<dyn FrameLog>,
    /// The site.
    pub site: Arc<Site>,
    /// Its text.
    pub site_text: String,
    /// Clocks.
    pub clock: Arc<dyn Clock>,
    /// Software of robots.
    pub ota: OtaService,
    /// The simulator's face, if bodies live in this process.
    pub sim: Option<SimFace>,
    /// Naive rules for twins of tests; none outside them.
    pub naive: Naive,
    /// Where fleet plans; see [`crate::planning`].
    pub planning: tokio::runtime::Handle,
}

/// All services of one process, ready to be served.
pub struct Server {
    parts: Parts,
    task: TaskService,
    fleet: FleetService,
    reconciler: Reconciler,
    telemetry: TelemetryService,
    rollouts: RolloutService,
    planner: Planner,
    board: Arc<LiveBoard<Live>>,
    beacons: Option<UdpSocket>,
    shutdown: CancellationToken,
}

/// The one recorder of metrics of this process.
pub fn metrics_handle() -> Option<PrometheusHandle> {
    static HANDLE: OnceLock<Option<PrometheusHandle>> = OnceLock::new();
    HANDLE.get_or_init(|| PrometheusBuilder::new().install_recorder().ok()).clone()
}

impl Server {
    /// Builds the services; nothing runs yet.
    pub async fn new(parts: Parts, shutdown: CancellationToken) -> anyhow::Result<Self> {
        let board: Arc<LiveBoard<Live>> = LiveBoard::new();
        let task =
            midshift_task::Parts { store: parts.store.clone(), site: parts.site.clone(), clock: parts.clock.clone() };
        let task = TaskService::open(task, shutdown.clone()).await.context("opening task intake")?;
        let (fleet, reconciler) = FleetService::new(midshift_fleet::Parts {
            store: parts.store.clone(),
            board: board.clone(),
            site: parts.site.clone(),
            site_text: parts.site_text.clone(),
            clock: parts.clock.clone(),
            bugs: parts.naive.fleet,
        });
        let telemetry = TelemetryService::new(
            midshift_telemetry::Parts {
                store: parts.store.clone(),
                frames: parts.frames.clone(),
                board: board.clone(),
                clock: parts.clock.clone(),
                bugs: parts.naive.telemetry,
            },
            shutdown.clone(),
        );
        let rollouts = midshift_ota::rollouts::Parts {
            store: parts.store.clone(),
            board: board.clone(),
            site: parts.site.clone(),
            clock: parts.clock.clone(),
            ota: parts.ota.clone(),
            bugs: parts.naive.rollouts,
        };
        let (rollouts, planner) = RolloutService::new(rollouts, shutdown.clone());
        let beacons = None;
        Ok(Self { parts, task, fleet, reconciler, telemetry, rollouts, planner, board, beacons, shutdown })
    }

    /// Listens for the beacons of launchers on this socket too.
    pub fn hearing(self, beacons: Option<UdpSocket>) -> Self {
        Self { beacons, ..self }
    }

    /// Roll-outs that name no probation have this one, milliseconds of site time.
    pub fn with_probation(self, probation_ms: u64) -> Self {
        Self { rollouts: self.rollouts.with_probation(probation_ms), ..self }
    }

    /// Fleet, for whoever reports in this process.
    pub fn fleet(&self) -> FleetService {
        self.fleet.clone()
    }
    /// Newest heartbeats, for whoever reports in this process.
    pub fn board(&self) -> Arc<LiveBoard<Live>> {
        self.board.clone()
    }

    async fn routes(&self) -> anyhow::Result<(Routes, HealthReporter)> {
        let control = limits::CONTROL_MESSAGE_BYTES;
        let reflection = || {
            tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(midshift_proto::FILE_DESCRIPTOR_SET)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
                // Without these a generic client cannot read the details of a refusal.
                .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET)
        };
        let (health, health_service) = tonic_health::server::health_reporter();
        tell(&health, ServingStatus::Serving).await;
        let mut routes = Routes::builder();
        routes
            .add_service(self.task.grpc().max_decoding_message_size(control))
            .add_service(self.fleet.grpc().max_decoding_message_size(control))
            .add_service(self.telemetry.grpc().max_decoding_message_size(control))
            .add_service(self.telemetry.link())
            .add_service(self.telemetry.replay())
            .add_service(self.parts.ota.bundles())
            .add_service(self.parts.ota.chunks())
            .add_service(self.rollouts.grpc().max_decoding_message_size(control))
            .add_service(health_service)
            .add_service(reflection().build_v1()?)
            .add_service(reflection().build_v1alpha()?);
        if let Some(sim) = self.parts.sim.clone() {
            let face: SimServiceServer<SimFace> = sim.server();
            routes.add_service(face);
        }
        let handle = metrics_handle();
        let metrics = move || {
            let handle = handle.clone();
            async move { handle.map(|h| h.render()).unwrap_or_default() }
        };
        // Browsers speak gRPC-Web to the services; Prometheus and clients of TUF speak plain HTTP/1.1 to the pages beside them.
        let services = routes.routes().into_axum_router().layer(tonic_web::GrpcWebLayer::new());
        let pages = services.route("/metrics", get(metrics)).merge(self.parts.ota.pages());
        Ok((Routes::from(pages), health))
    }

    /// Serves connections until shutdown, then drains and cuts.
    ///
    /// # Errors
    /// If a service ends before shutdown; everything else has been shut down then.
    pub async fn serve<I, IO, E>(self, incoming: I) -> anyhow::Result<()>
    where
        I: Stream<Item = Result<IO, E>> + Send + 'static,
        IO: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
        E: Into<Box<dyn std::error::Error + Send + Sync>>,
    {
        let (routes, health) = self.routes().await?;
        let shutdown = self.shutdown.clone();
        // However this ends, also in a panic: nobody goes on without it.
        let _end = shutdown.clone().drop_guard();
        let stopped = shutdown.clone();
        let transport = Transport::builder()
            .accept_http1(true)
            .http2_keepalive_interval(Some(KEEPALIVE.0))
            .http2_keepalive_timeout(Some(KEEPALIVE.1))
            .max_concurrent_streams(limits::STREAMS_PER_CONNECTION)
            .timeout(Duration::from_millis(limits::UNARY_DEADLINE.as_ms()))
            .add_routes(routes)
            .serve_with_incoming_shutdown(incoming, async move { stopped.cancelled().await });
        let keeper =
            prune(self.task.clone(), self.parts.store.clone(), self.parts.frames.clone(), self.parts.clock.clone());
        let fleet = AbortOnDropHandle::new(self.parts.planning.spawn(self.reconciler.run(shutdown.clone())));
        let telemetry = self.telemetry.clone().run();
        let ota = self.parts.ota.clone().run(shutdown.clone());
        let planner = AbortOnDropHandle::new(self.parts.planning.spawn(self.planner.run(shutdown.clone())));
        let (telemetry_of_ear, beacons) = (self.telemetry.clone(), self.beacons);
        let ear = async {
            if let Some(socket) = beacons {
                telemetry_of_ear.hear(socket).await;
            }
        };
        let failure = OnceLock::new();
        let services = async {
            let fleet = until(&shutdown, "fleet", async { Ok(fleet.await??) });
            let telemetry = until(&shutdown, "telemetry", async { Ok(telemetry.await?) });
            let ota = until(&shutdown, "ota", async {
                ota.await;
                Ok(())
            });
            let rollouts = until(&shutdown, "rollouts", async { Ok(planner.await??) });
            let ear = async {
                ear.await;
                Ok(())
            };
            if let Err(error) = tokio::try_join!(fleet, telemetry, ota, rollouts, ear) {
                tracing::error!(%error, "a service ended, and with it the server");
                shutdown.cancel();
                // Nothing else sets it.
                let _ = failure.set(error);
            }
        };
        let hard = async {
            shutdown.cancelled().await;
            tell(&health, ServingStatus::NotServing).await;
            tokio::time::sleep(Duration::from_millis(limits::HARD_DRAIN.as_ms())).await;
        };
        let transport = async {
            let served = transport.await;
            // Without a door there is nothing to serve.
            shutdown.cancel();
            served
        };
        tokio::select! {
            (served, ()) = async { tokio::join!(transport, services) } => served.context("serving")?,
            () = keeper => {}
            () = fold(metrics_handle()) => {}
            () = hard => tracing::info!("open streams were cut"),
        }
        failure.into_inner().map_or(Ok(()), Err)
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

async fn tell(health: &HealthReporter, status: ServingStatus) {
    for name in HEALTH {
        health.set_service_status(name, status).await;
    }
}

/// Folds samples of histograms, whether or not anybody scrapes.
async fn fold(metrics: Option<PrometheusHandle>) {
    loop {
        tokio::time::sleep(FOLD_EVERY).await;
        if let Some(metrics) = &metrics {
            metrics.run_upkeep();
        }
    }
}

/// Takes old rows, entries and frames away, entries never past what fleet has not consumed.
async fn prune(task: TaskService, store: Arc<dyn Store>, frames: Arc<dyn FrameLog>, clock: Arc<dyn Clock>) {
    loop {
        tokio::time::sleep(PRUNE_EVERY).await;
        if let Err(error) = task.prune().await {
            tracing::warn!(%error, "old requests could not be taken away");
        }
        if let Err(error) = midshift_fleet::prune(store.as_ref(), clock.as_ref()).await {
            tracing::warn!(%error, "tasks that ended long ago could not be taken away");
        }
        if let Err(error) = prune_entries(store.as_ref(), clock.as_ref()).await {
            tracing::warn!(%error, "old log entries could not be taken away");
        }
        if let Err(error) = frames.prune().await {
            tracing::warn!(%error, "old status could not be taken away");
        }
    }
}

async fn prune_entries(store: &dyn Store, clock: &dyn Clock) -> Result<(), midshift_store::Error> {
    // Until fleet has consumed something nothing may go.
    let Some((mark, _)) = midshift_store::load::<FleetMark>(store, "fleet").await? else { return Ok(()) };
    let days_ms = (limits::REMEMBER_DAYS * 86_400_000) as i64;
    let ota = midshift_store::load::<OtaMark>(store, "ota").await?.map_or(mark.seq, |(mark, _)| mark.seq);
    let floor = mark.seq.min(ota);
    let keep = Retention { before_unix_ms: clock.now().wall.0 - days_ms, entries_max: ENTRIES_MAX, floor };
    store.prune(keep).await.map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::Planning;
    use crate::serve::nodelay;
    use crate::{clock, site_file};
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

    async fn world() -> anyhow::Result<World> {
        let loaded = site_file::load(None, None, None)?;
        let clock = clock::clock(1000);
        let store_id = StoreId(Arc::from("store-1"));
        let planning = Planning::start()?;
        let parts = Parts {
            store: Arc::new(MemoryStore::new(loaded.site.site_id().clone(), store_id, clock.clone())),
            frames: Arc::new(MemoryFrames::new(clock.clone(), 1 << 20)),
            site: loaded.site,
            site_text: loaded.text,
            clock,
            ota: OtaService::without_keys(),
            sim: None,
            naive: Naive::default(),
            planning: planning.handle(),
        };
        let shutdown = CancellationToken::new();
        let server = Server::new(parts, shutdown.clone()).await?;
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let channel = Endpoint::from_shared(format!("http://{}", listener.local_addr()?))?.connect_lazy();
        let serving = tokio::spawn(server.serve(nodelay(listener)));
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

    /// Whether the samples of a histogram were folded; only the text of the recorder tells without folding them itself.
    fn folded(metrics: &PrometheusHandle, name: &str) -> bool {
        format!("{metrics:?}").split_once("distributions:").is_some_and(|(_, folded)| folded.contains(name))
    }

    #[tokio::test(start_paused = true)]
    async fn histograms_do_not_grow_while_nobody_scrapes() {
        let recorder = PrometheusBuilder::new().build_recorder();
        let metrics = recorder.handle();
        metrics::with_local_recorder(&recorder, || metrics::histogram!("midshift_test_seconds").record(1.0));
        assert!(!folded(&metrics, "midshift_test_seconds"));
        let _ = tokio::time::timeout(FOLD_EVERY * 2, fold(Some(metrics.clone()))).await;
        assert!(folded(&metrics, "midshift_test_seconds"));
    }
}
