//! A cut network for five enrolled robots: they are missed, their work goes on, and events arrive in order, none twice, none missing.

use crate::harness::{Server, channel, folder, until};
use crate::kill::{all_over, at_work, judge, submit};
use crate::proxy::Proxy;
use crate::robots::{Robots, with_robots};
use crate::split::events_have_no_hole;
use anyhow::ensure;
use midshift_core::site::DEMO;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{Event, ListEventsRequest, ListRobotsRequest, Presence, RobotFilter, event::Item};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

const TASKS: usize = 16;
const CUT_MS: i64 = 20_000;
/// Two readings of one wall clock agree within this.
const SLEW_MS: i64 = 500;
const CUT: [&str; 5] = ["rbt-01", "rbt-02", "rbt-03", "rbt-04", "rbt-05"];

async fn events(client: &mut TelemetryServiceClient<midshift_cli::endpoint::Line>) -> anyhow::Result<Vec<Event>> {
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
async fn are_missed(client: &mut TelemetryServiceClient<midshift_cli::endpoint::Line>) -> anyhow::Result<bool> {
    let filter = RobotFilter { robot_ids: CUT.map(str::to_owned).to_vec(), ..RobotFilter::default() };
    let request = ListRobotsRequest { filter: Some(filter), page_size: 100, page_token: String::new() };
    let robots = client.list_robots(request).await?.into_inner().robots;
    let missed = |p: Presence| matches!(p, Presence::Suspect | Presence::Offline);
    Ok(robots.len() == CUT.len() && robots.iter().all(|r| missed(r.presence())))
}

/// The robots that said something of what happened to them while they were cut off. Whatever was stamped then cannot have arrived before the cut was over.
fn at_work_inside(events: &[Event], from_ms: i64, to_ms: i64) -> BTreeSet<String> {
    let mut inside = BTreeSet::new();
    for event in events {
        let Some(Item::Sample(sample)) = &event.item else { continue };
        if !(from_ms + SLEW_MS..to_ms - SLEW_MS).contains(&sample.robot_unix_ms) {
            continue;
        }
        let received = event.receive_time.as_ref().map_or(0, |t| t.seconds * 1_000 + i64::from(t.nanos) / 1_000_000);
        assert!(received >= to_ms - SLEW_MS, "it came through the cut: {event:?}");
        inside.insert(event.robot_id.clone());
    }
    inside
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_cut_of_twenty_seconds_every_event_is_there_in_order_and_once() -> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, CUT.len())?;
    let server = Server::start_for(dir.path(), &site).await?;
    let (address, proxy) = (server.address, Proxy::before(server.address).await?);
    let robots = Robots::start(dir.path(), proxy.address, address, &site).await?;
    ensure!(robots.ids() == CUT, "{:?}", robots.ids());
    submit(address, &site, 5, TASKS).await?;
    at_work(address, 2, &BTreeSet::new()).await?;
    let telemetry = TelemetryServiceClient::new(channel(address)?);
    until("work on each robot", Duration::from_secs(60), || {
        let mut robots = telemetry.clone();
        async move {
            let seen = events(&mut robots).await.unwrap_or_default();
            Ok((newest(&seen).len() == CUT.len()).then_some(()))
        }
    })
    .await?;
    let before = newest(&events(&mut telemetry.clone()).await?);
    let clock = midshift_process::clock::clock(1000);
    proxy.sever();
    let from_ms = clock.now().wall.0;
    until("the server to miss all five at once", Duration::from_secs(15), || {
        let mut robots = telemetry.clone();
        async move { Ok(are_missed(&mut robots).await?.then_some(())) }
    })
    .await?;
    let lasts = || async { Ok((clock.now().wall.0 >= from_ms + CUT_MS).then_some(())) };
    until("the end of the cut", Duration::from_secs(60), lasts).await?;
    let to_ms = clock.now().wall.0;
    proxy.mend();
    // Each of them says more than it had said, once its network is back.
    let after = until("news of each robot after the cut", Duration::from_secs(90), || {
        let (mut robots, before) = (telemetry.clone(), before.clone());
        async move {
            let seen = events(&mut robots).await?;
            let now = newest(&seen);
            Ok(before.iter().all(|(robot, seq)| now.get(robot).is_some_and(|n| *n > seq + 3)).then_some(seen))
        }
    })
    .await?;
    let inside = at_work_inside(&after, from_ms, to_ms);
    say!("at work inside the cut: {inside:?}");
    ensure!(!inside.is_empty(), "nobody worked inside the cut");
    let ended = all_over(address, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    events_have_no_hole(address, CUT.len()).await
}
