//! Two areas with one thing of each kind, and how requests name them.

use crate::anybody::Words;
use crate::harness::{Server, channel, until};
use crate::robots::Robots;
use crate::rolled_out::done;
use anyhow::Context;
use midshift_proto::fleet::v1::ListIncidentsRequest;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{CreateRolloutRequest, RolloutSelector, RolloutSpec};
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::stop::v1::{EngageRequest, scope};
use serde_json::{Value, json};
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

const LIMIT: Duration = Duration::from_secs(60);
/// The area of the grants that are not the site's, and another one.
pub const AREAS: [&str; 2] = ["packing", "hall"];
/// Where the robots of the two areas stand, and where tasks go from and to.
pub const PLACES: [[&str; 3]; 2] = [["hold-pack", "P01", "P02"], ["park-1", "A01", "A02"]];
/// The robot in each of them.
pub const ROBOTS: [&str; 2] = ["rbt-01", "rbt-02"];
/// The release of the roll-outs.
const BUNDLE: &str = "walk-1.5.0";

/// What lies in one of the two areas, and how requests name it.
fn words(nth: usize, incident: &str, stop: &str) -> Words {
    let [_, from, to] = PLACES[nth];
    let ids = [
        ("robot_id", ROBOTS[nth]),
        ("area_id", AREAS[nth]),
        ("task_id", ["T-own", "T-other"][nth]),
        ("place_id", PLACES[nth][0]),
        ("rollout_id", ["r-own", "r-other"][nth]),
        ("incident_id", incident),
        ("stop_id", stop),
        ("from_waypoint", from),
        ("to_waypoint", to),
    ];
    let mut words: Words = ids.into_iter().map(|(name, id)| (name, json!(id))).collect();
    for (name, of) in [("robot_ids", "robot_id"), ("area_ids", "area_id"), ("task_ids", "task_id")] {
        words.insert(name, words[of].clone());
    }
    // What else must be there. Nobody has seen that etag, and nothing is done that can be looked at instead.
    let with = [
        ("etag", "999999"),
        ("update_mask", "priority"),
        ("reason", "a look"),
        ("bundle", BUNDLE),
        ("new_rollout_id", "r-new"),
    ];
    words.extend(with.map(|(name, word)| (name, json!(word))));
    words.extend([("task_type", json!("transport")), ("timeout_seconds", json!(60)), ("validate_only", json!(true))]);
    words.extend([("resolution", json!(1)), ("request_id", json!("q-1"))]);
    of_a_robot(&mut words);
    words
}

/// What robots say.
fn of_a_robot(words: &mut Words) {
    words.extend([("boot_id", json!("b1")), ("ring", json!("ring-1")), ("session_secret", json!("none"))]);
    let numbers = ["sent_unix_ms", "session_epoch", "seq", "mode", "protocol_versions", "first_seq", "next_seq"];
    words.extend(numbers.map(|name| (name, json!(1))));
    words.extend([("stop_level", json!("STOP_LEVEL_NONE")), ("hardware_stop", json!("HARDWARE_STOP_NONE"))]);
    words.extend([("payload_g", json!(1000)), ("battery_permille", json!(500)), ("clock_rate_permille", json!(1000))]);
    words.insert("lane", json!("LANE_STATUS"));
    // It has just been made.
    words.extend(["previous", "update", "stops"].map(|name| (name, Value::Null)));
}

/// Whether an answer shows something of these words.
pub fn shows(answer: &str, words: &Words) -> bool {
    let shown = ["robot_id", "task_id", "place_id", "rollout_id", "incident_id"];
    shown.iter().any(|name| answer.contains(&words[name].to_string()))
}

/// Stops one area; the stop's name.
pub async fn stop(port: SocketAddr, area: &str) -> anyhow::Result<String> {
    let whom = midshift_proto::stop::v1::Scope { scope: Some(scope::Scope::AreaId(area.to_owned())) };
    let request = EngageRequest { scope: Some(whom), ..EngageRequest::default() };
    let mut told = StopServiceClient::new(channel(port)?).engage(request).await?.into_inner();
    Ok(told.message().await?.and_then(|first| first.stop).context("a stop")?.stop_id)
}

/// A task and a roll-out in each area, and two machines of each robot, of which the second is an incident; how they are called.
pub async fn objects(dir: &Path, server: &Server, robots: &Robots, stops: [String; 2]) -> anyhow::Result<[Words; 2]> {
    let address = server.address.to_string();
    let mut copies = Vec::new();
    for (nth, area) in AREAS.iter().enumerate() {
        let [_, from, to] = PLACES[nth];
        let id = ["T-own", "T-other"][nth];
        done(&["task", "submit", "--server", &address, "--task-id", id, "--from", from, "--to", to])?;
        let selector = RolloutSelector { area_ids: vec![(*area).to_owned()], ..RolloutSelector::default() };
        let spec = RolloutSpec { bundle: BUNDLE.to_owned(), selector: Some(selector), ..RolloutSpec::default() };
        let request = CreateRolloutRequest { rollout_id: ["r-own", "r-other"][nth].to_owned(), spec: Some(spec) };
        RolloutServiceClient::new(server.channel()?).create_rollout(request).await?;
        copies.push(robots.copy(ROBOTS[nth], &dir.join(format!("copy-{nth}")))?);
    }
    let incidents = until("an incident of each robot", LIMIT, async || {
        let mut fleet = FleetServiceClient::new(server.channel()?);
        let told = fleet.list_incidents(ListIncidentsRequest::default()).await?.into_inner().incidents;
        let of = |robot: &str| told.iter().find(|incident| incident.robot_id == robot).map(|i| i.incident_id.clone());
        Ok(of(ROBOTS[0]).zip(of(ROBOTS[1])))
    })
    .await?;
    Ok([words(0, &incidents.0, &stops[0]), words(1, &incidents.1, &stops[1])])
}
