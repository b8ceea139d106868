//! A cut network for five robots: they are missed, their work goes on, and events arrive in order, none twice, none missing.

use crate::harness::{Running, channel, free_port, midshift, until};
use midshift_proto::link::v1::Lane;
use midshift_proto::sim::v1::sim_service_client::SimServiceClient;
use midshift_proto::sim::v1::{DropNetworkFault, InjectFaultRequest, inject_fault_request::Fault};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{Event, ListEventsRequest, ListRobotsRequest, Presence, RobotFilter, event::Item};
use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;
use std::time::Duration;

const CUT_MS: i64 = 20_000;
/// Two readings of one wall clock agree within this.
const SLEW_MS: i64 = 500;
const CUT: [&str; 5] = ["rbt-01", "rbt-02", "rbt-03", "rbt-04", "rbt-05"];

async fn events(client: &mut TelemetryServiceClient<midshift::way::Line>) -> anyhow::Result<Vec<Event>> {
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

/// Whether the server misses each of them at this moment.
async fn are_missed(client: &mut TelemetryServiceClient<midshift::way::Line>) -> anyhow::Result<bool> {
    let filter = RobotFilter { robot_ids: CUT.map(str::to_owned).to_vec(), ..RobotFilter::default() };
    let request = ListRobotsRequest { filter: Some(filter), page_size: 100, page_token: String::new() };
    let robots = client.list_robots(request).await?.into_inner().robots;
    let missed = |p: Presence| matches!(p, Presence::Suspect | Presence::Offline);
    Ok(robots.len() == CUT.len() && robots.iter().all(|r| missed(r.presence())))
}

/// The robots that said something of what happened to them while they were cut off, each cut from its moment on. Whatever was stamped
/// then cannot have arrived before the cut was over.
fn at_work_inside(events: &[Event], cut_from_ms: &BTreeMap<&str, i64>) -> BTreeSet<String> {
    let mut inside = BTreeSet::new();
    for event in events {
        let (Some(Item::Sample(sample)), Some(from)) = (&event.item, cut_from_ms.get(event.robot_id.as_str())) else {
            continue;
        };
        if !(from + SLEW_MS..from + CUT_MS - SLEW_MS).contains(&sample.robot_unix_ms) {
            continue;
        }
        let received = event.receive_time.as_ref().map_or(0, |t| t.seconds * 1_000 + i64::from(t.nanos) / 1_000_000);
        assert!(received >= from + CUT_MS - SLEW_MS, "it came through the cut: {event:?}");
        inside.insert(event.robot_id.clone());
    }
    inside
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
    let clock = midshift::clock::clock(1000);
    let mut cut_from_ms = BTreeMap::new();
    for robot in CUT {
        let duration = prost_types::Duration { seconds: CUT_MS / 1_000, nanos: 0 };
        let fault = Fault::DropNetwork(DropNetworkFault { duration: Some(duration) });
        sim.inject_fault(InjectFaultRequest { robot_id: robot.to_owned(), fault: Some(fault) }).await?;
        cut_from_ms.insert(robot, clock.now().wall.0);
    }
    until("the server to miss all five at once", Duration::from_secs(15), || {
        let mut robots = robots.clone();
        async move { Ok(are_missed(&mut robots).await?.then_some(())) }
    })
    .await?;
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
    let inside = at_work_inside(&after, &cut_from_ms);
    assert!(!inside.is_empty(), "nobody worked inside the cut");
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
