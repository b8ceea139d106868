//! What holds for the server as a whole: its end, and that it does not grow while nobody looks.

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
    // The thread that plans is gone, and fleet with it.
    drop(world.planning);
    assert_eq!(next(&mut health).await?, Told::NotServing);
    assert!(world.shutdown.is_cancelled(), "everything else in the process ends too");
    drop(health);
    let error = world.serving.await?.expect_err("it did not end as it was asked to");
    assert_eq!(error.to_string(), "fleet");
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
