//! One public address: a stock proxy with the configuration that is shipped, before a server, for people, programs and robots.

use crate::clients::{grpcurl, http1, text};
use crate::harness::{Running, channel, free_port, midshift, tool, until};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListRobotsRequest, Presence, RobotFilter};
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// The proxy before one process that has every service: where people go, and where robots go.
fn proxy(server: SocketAddr, log: &Path) -> anyhow::Result<(SocketAddr, SocketAddr, Running)> {
    let (public, robots) = (free_port()?, free_port()?);
    let configuration = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/proxy/haproxy.cfg");
    let mut command = Command::new(tool("MIDSHIFT_TEST_HAPROXY")?);
    command.args(["-db", "-f", configuration]);
    for service in ["TASK", "FLEET", "TELEMETRY", "OTA", "GATEWAY"] {
        command.env(format!("MIDSHIFT_{service}"), server.to_string());
    }
    command.env("MIDSHIFT_PUBLIC", public.to_string()).env("MIDSHIFT_ROBOTS", robots.to_string());
    Ok((public, robots, Running::start(&mut command, log)?))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn people_programs_and_robots_come_through_the_shipped_proxy() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let server = free_port()?;
    // In real time, as the robot that comes later has it.
    let mut command = Command::new(midshift()?);
    command.args(["dev", "--robots", "4", "--seed", "3", "--listen", &server.to_string()]);
    let _dev = Running::start(&mut command, &dir.path().join("dev.log"))?;
    let (public, robots, _proxy) = proxy(server, &dir.path().join("proxy.log"))?;
    until("the proxy's first answer", Duration::from_secs(30), || async {
        let answer = TelemetryServiceClient::new(channel(public)?).list_robots(ListRobotsRequest::default()).await;
        Ok(answer.ok().filter(|page| page.get_ref().robots.len() == 4).map(|_| ()))
    })
    .await?;
    let public = public.to_string();
    // Every service is shown, and each path reaches its own.
    let services = text(&grpcurl(&[&public, "list"])?.stdout);
    for service in
        ["task.v1.TaskService", "fleet.v1.FleetService", "telemetry.v1.TelemetryService", "ota.v1.RolloutService"]
    {
        assert!(services.contains(&format!("midshift.{service}")), "{services}");
    }
    let paths = [
        "midshift.fleet.v1.FleetService/ListIncidents",
        "midshift.telemetry.v1.TelemetryService/ListRobots",
        "midshift.ota.v1.RolloutService/ListRollouts",
    ];
    for path in paths {
        let answer = grpcurl(&["-d", "{}", &public, path])?;
        assert!(answer.status.success(), "{path}: {}", text(&answer.stderr));
    }
    // A task, and the stream that waits for its end; errors come whole.
    let run = |arguments: &[&str]| {
        Command::new(midshift()?).args(arguments).args(["--server", &public]).output().map_err(anyhow::Error::from)
    };
    let done = run(&["task", "submit", "--from", "A01", "--to", "B03", "--sku", "SKU-1", "--wait"])?;
    assert!(done.status.success(), "{}", text(&done.stderr));
    let refused = run(&["task", "submit", "--from", "nowhere", "--to", "elsewhere", "--sku", "SKU-1"])?;
    let said = text(&refused.stderr);
    assert!(said.contains("nowhere") && said.contains("elsewhere"), "{said}");
    // HTTP/1.1 on the same address.
    let address: SocketAddr = public.parse()?;
    let page = http1(address, "GET /metrics HTTP/1.1\r\nHost: midshift\r\nConnection: close\r\n\r\n")?;
    assert!(page.starts_with("HTTP/1.1 200") && page.contains("midshift_telemetry_heartbeats_total"), "{page}");
    // Robots have an address of their own, and none here.
    let link = grpcurl(&["-d", "{}", &public, "midshift.link.v1.LinkService/Session"])?;
    assert!(!link.status.success() && text(&link.stderr).contains("404"), "{}", text(&link.stderr));
    let mut agent = Command::new(midshift()?);
    agent.args(["agent", "run", "--robot-id", "rbt-77", "--start", "hold-pack", "--server", &robots.to_string()]);
    let _agent = Running::start(agent.arg("--data").arg(dir.path().join("rbt-77")), &dir.path().join("agent.log"))?;
    until("the robot behind the proxy", Duration::from_secs(30), || async {
        let filter = RobotFilter { robot_ids: vec!["rbt-77".to_owned()], ..RobotFilter::default() };
        let request = ListRobotsRequest { filter: Some(filter), ..ListRobotsRequest::default() };
        let found = TelemetryServiceClient::new(channel(address)?).list_robots(request).await?.into_inner().robots;
        Ok(found.first().filter(|robot| robot.presence() == Presence::Online).map(|_| ()))
    })
    .await
}
