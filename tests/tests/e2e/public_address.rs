//! One public address: a stock proxy with the configuration that is shipped, before the services of a site, for people, programs and robots, over TLS.

use crate::clients::{grpcurl, text};
use crate::harness::{channel, folder, midshift, sign_in, tool, until};
use crate::robots::{Robots, with_robots};
use crate::secrets::heard;
use crate::stack::Stack;
use midshift_core::site::{DEMO, text as site_text};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListRobotsRequest, Presence};
use std::process::Command;
use std::time::Duration;

/// Prints a page that is read over HTTP/1.1.
const PAGE: &str = r#"
import ssl, sys, urllib.request
asked = urllib.request.Request(sys.argv[1], headers={"Authorization": "Bearer " + open(sys.argv[3]).read().strip()})
print(urllib.request.urlopen(asked, context=ssl.create_default_context(cafile=sys.argv[2]), timeout=10).read().decode())
"#;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn people_programs_and_robots_come_through_the_shipped_proxy() -> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, 4)?;
    let stack = Stack::start(dir.path(), &site_text::render(&site), &["--no-software"], &[]).await?;
    let _robots = Robots::start(dir.path(), stack.robots, stack.public, &site).await?;
    let address = stack.public;
    let public = address.to_string();
    // Every service is shown, and each path reaches its own.
    let services = text(&grpcurl(address, &[], "list")?.stdout);
    for service in
        ["task.v1.TaskService", "fleet.v1.FleetService", "telemetry.v1.TelemetryService", "ota.v1.RolloutService"]
    {
        assert!(services.contains(&format!("midshift.{service}")), "{services}");
    }
    let paths = [
        "midshift.fleet.v1.FleetService/ListIncidents",
        "midshift.telemetry.v1.TelemetryService/ListRobots",
        "midshift.identity.v1.IdentityService/WhoAmI",
        "midshift.identity.v1.AuditService/ListAudit",
    ];
    for path in paths {
        let answer = grpcurl(address, &["-d", "{}"], path)?;
        assert!(answer.status.success(), "{path}: {}", text(&answer.stderr));
    }
    // Roll-outs have a process too, which says what it lacks.
    let answer = grpcurl(address, &["-d", "{}"], "midshift.ota.v1.RolloutService/ListRollouts")?;
    assert!(text(&answer.stderr).contains("NO_ONLINE_KEYS"), "{}", text(&answer.stderr));
    // A task, and the stream that waits for its end; errors come whole.
    let run = |arguments: &[&str]| {
        let mut command = Command::new(midshift()?);
        sign_in(&mut command, address);
        heard(command.args(arguments).args(["--server", &public]))
    };
    let done = run(&["task", "submit", "--from", "A01", "--to", "B03", "--sku", "SKU-1", "--wait"])?;
    assert!(done.status.success(), "{}", text(&done.stderr));
    let refused = run(&["task", "submit", "--from", "nowhere", "--to", "elsewhere", "--sku", "SKU-1"])?;
    let said = text(&refused.stderr);
    assert!(said.contains("nowhere") && said.contains("elsewhere"), "{said}");
    // HTTP/1.1 on the same address.
    let mut python = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
    python.args(["-c", PAGE, &format!("https://{public}/metrics")]).arg(dir.path().join("ca.pem"));
    let page = python.arg(dir.path().join("token")).output()?;
    assert!(text(&page.stdout).contains("midshift_"), "{} {}", text(&page.stdout), text(&page.stderr));
    // Robots have an address of their own, and none here.
    let link = grpcurl(address, &["-d", "{}"], "midshift.link.v1.LinkService/Session")?;
    assert!(!link.status.success() && text(&link.stderr).contains("404"), "{}", text(&link.stderr));
    until("the robots behind the proxy", Duration::from_secs(30), || async {
        let page = TelemetryServiceClient::new(channel(address)?).list_robots(ListRobotsRequest::default()).await?;
        let online = page.get_ref().robots.iter().filter(|robot| robot.presence() == Presence::Online).count();
        Ok((online == 4).then_some(()))
    })
    .await
}
