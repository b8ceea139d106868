//! A cut network for five robots: work goes on, events arrive in order, none twice, none missing.

use crate::harness::{Running, channel, free_port, midshift, until};
use midshift_proto::link::v1::Lane;
use midshift_proto::sim::v1::sim_service_client::SimServiceClient;
use midshift_proto::sim::v1::{DropNetworkFault, InjectFaultRequest, inject_fault_request::Fault};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{Event, ListEventsRequest, event::Item};
use std::collections::BTreeMap;
use std::process::Command;
use std::time::Duration;

const CUT: [&str; 5] = ["rbt-01", "rbt-02", "rbt-03", "rbt-04", "rbt-05"];

async fn events(client: &mut TelemetryServiceClient<tonic::transport::Channel>) -> anyhow::Result<Vec<Event>> {
    let robot_ids = CUT.map(str::to_owned).to_vec();
    let (mut all, mut cursor) = (Vec::new(), String::new());
    loop {
        let request =
            ListEventsRequest { robot_ids: robot_ids.clone(), subject: String::new(), page_size: 1_000, cursor };
        let page = client.list_events(request).await?.into_inner();
        all.extend(page.events);
        if page.caught_up {
            return Ok(all);
        }
        cursor = page.cursor;
    }
}

fn newest(events: &[Event]) -> BTreeMap<String, u64> {
    let mut newest = BTreeMap::new();
    for event in events {
        if let Some(Item::Sample(sample)) = &event.item {
            newest.insert(event.robot_id.clone(), sample.seq);
        }
    }
    newest
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_cut_of_twenty_seconds_every_event_is_there_in_order_and_once() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let address = free_port()?;
    let mut command = Command::new(midshift()?);
    command.args(["dev", "--robots", "8", "--seed", "5", "--keep-open", "16", "--listen", &address.to_string()]);
    let mut dev = Running::start(&mut command, &dir.path().join("dev.log"))?;
    let mut robots = TelemetryServiceClient::new(channel(address)?);
    until("work on each robot", Duration::from_secs(60), || {
        let mut robots = robots.clone();
        async move {
            let seen = events(&mut robots).await.unwrap_or_default();
            Ok((newest(&seen).len() == CUT.len()).then_some(()))
        }
    })
    .await?;
    let mut sim = SimServiceClient::new(channel(address)?);
    let before = newest(&events(&mut robots).await?);
    for robot in CUT {
        let fault =
            Fault::DropNetwork(DropNetworkFault { duration: Some(prost_types::Duration { seconds: 20, nanos: 0 }) });
        sim.inject_fault(InjectFaultRequest { robot_id: robot.to_owned(), fault: Some(fault) }).await?;
    }
    // Each of them says more than it had said, once its network is back.
    let after = until("news of each robot after the cut", Duration::from_secs(90), || {
        let (mut robots, before) = (robots.clone(), before.clone());
        async move {
            let seen = events(&mut robots).await?;
            let now = newest(&seen);
            Ok(before.iter().all(|(robot, seq)| now.get(robot).is_some_and(|n| *n > seq + 3)).then_some(seen))
        }
    })
    .await?;
    let mut next: BTreeMap<(String, String, i32), u64> = BTreeMap::new();
    for event in &after {
        assert!(event.lane() == Lane::Event || event.lane() == Lane::Critical);
        let key = (event.robot_id.clone(), event.ring.clone(), event.lane);
        let expected = next.entry(key.clone()).or_insert(1);
        match &event.item {
            Some(Item::Sample(sample)) => assert_eq!(sample.seq, *expected, "{key:?}"),
            other => panic!("a gap or a poison sample in {key:?}: {other:?}"),
        }
        *expected += 1;
    }
    assert!(!dev.has_ended()?);
    Ok(())
}
