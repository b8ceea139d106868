//! Robots at the knee: each sends a heartbeat with one STATUS sample as soon as its credit lets it. And one that asks how fast an
//! EVENT is acknowledged meanwhile.

use crate::durable_baseline::DurableBaseline;
use crate::robot::{self, RobotReceiver, RobotSender};
use anyhow::Context;
use midshift_core::ids::WaypointId;
use midshift_core::limits;
use midshift_core::robot::{Lane, Pose};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::Instant;

/// Time between two events of the one that asks.
const ASK_EVERY: Duration = Duration::from_millis(20);

/// Floods until it is dropped; `acked` counts samples that the server said are durable.
pub async fn run(server: &str, robots: usize, credit: bool, acked: Arc<AtomicU64>) -> anyhow::Result<()> {
    let mut all = JoinSet::new();
    for number in 0..robots {
        let (server, acked) = (server.to_owned(), acked.clone());
        all.spawn(async move { one(&server, number, credit, &acked).await });
    }
    all.join_next().await.context("no robots")??
}

async fn one(server: &str, number: usize, credit: bool, acked: &AtomicU64) -> anyhow::Result<()> {
    let here = WaypointId::parse(&format!("c{number}"))?;
    let (mut sender, receiver, welcome) = robot::attach(server, &format!("flood-{number:04}"), Some(here)).await?;
    let vitals = &mut sender.reported.vitals;
    vitals.pose = Some(Pose { x_mm: 12_345, y_mm: 23_456, ..Pose::default() });
    (vitals.hottest_joint_decidegrees, vitals.odometer_mm, vitals.energy_mwh) = (312, 1_234_567, 123_456);
    let window = if credit { u64::from(welcome.status_credit_bytes) / sender.status_bytes() as u64 } else { u64::MAX };
    let (durable, heard) = watch::channel(0);
    tokio::try_join!(send(sender, window, heard), count_acked(receiver, durable, acked))?;
    Ok(())
}

async fn send(mut sender: RobotSender, window: u64, mut durable: watch::Receiver<u64>) -> anyhow::Result<()> {
    loop {
        let written = sender.produced(Lane::Status);
        durable.wait_for(|acked| written.saturating_sub(*acked) < window).await?;
        sender.beat(true).await?;
    }
}

async fn count_acked(
    mut receiver: RobotReceiver,
    durable: watch::Sender<u64>,
    acked: &AtomicU64,
) -> anyhow::Result<()> {
    loop {
        let seq = receiver.acked(Lane::Status).await?;
        let before = durable.send_replace(seq);
        acked.fetch_add(seq.saturating_sub(before), Relaxed);
    }
}

/// Milliseconds from each EVENT to its acknowledgement, and of the raw limit after each, one at a time, for so long.
pub async fn measure_acks(
    server: &str,
    baseline: &mut DurableBaseline,
    long: Duration,
) -> anyhow::Result<(Vec<f64>, Vec<f64>)> {
    let (mut sender, mut receiver, _) = robot::attach(server, "asks-1", None).await?;
    let (started, mut beaten) = (Instant::now(), Instant::now());
    let (mut acks_ms, mut raws_ms) = (Vec::new(), Vec::new());
    while started.elapsed() < long {
        let begun = Instant::now();
        sender.send_mode().await?;
        let seq = sender.produced(Lane::Event);
        while receiver.acked(Lane::Event).await? < seq {}
        acks_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        raws_ms.push(baseline.measure_ms().await?);
        if beaten.elapsed().as_millis() >= u128::from(limits::HEARTBEAT.as_ms()) {
            beaten = Instant::now();
            sender.beat(false).await?;
        }
        tokio::time::sleep(ASK_EVERY).await;
    }
    Ok((acks_ms, raws_ms))
}
