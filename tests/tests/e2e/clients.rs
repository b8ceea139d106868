//! Foreign clients as users have them: grpcurl by reflection, and Python with stubs from stock tools. What each does is a function of the
//! address: a split stack is asked for the same in `languages.rs`.

use crate::factory::Factory;
use crate::harness::{authority, sign_in, token, tool, way};
use crate::secrets::heard;
use anyhow::Context;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

/// Runs grpcurl with `flags` on `what` of the server at `address`, signed in if that has a login.
pub fn grpcurl(address: SocketAddr, flags: &[&str], what: &str) -> anyhow::Result<Output> {
    let mut command = Command::new(tool("MIDSHIFT_TEST_GRPCURL")?);
    match token(address) {
        Some(token) => {
            command.arg("-cacert").arg(authority(address)?).args(["-H", &format!("authorization: Bearer {token}")])
        }
        None => command.arg("-plaintext"),
    };
    heard(command.args(["-max-time", "60"]).args(flags).args([&address.to_string(), what]))
}

/// What a program said.
pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// One request over HTTP/1.1, whose first line and own headers are given, signed in.
async fn http1(address: SocketAddr, request: &str, body: &[u8]) -> anyhow::Result<String> {
    let mut stream = way(address)?.wire().await?;
    let token = token(address).context("a login")?;
    let all = "Host: midshift\r\nConnection: close\r\nAuthorization: Bearer";
    stream.write_all(format!("{request}\r\n{all} {token}\r\n\r\n").as_bytes()).await?;
    stream.write_all(body).await?;
    let mut answer = Vec::new();
    tokio::time::timeout(Duration::from_secs(30), stream.read_to_end(&mut answer)).await??;
    Ok(text(&answer))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn prometheus_and_browsers_reach_the_same_port_over_http_1() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let factory = Factory::one_box(dir.path()).await?;
    let address = factory.address;
    let page = http1(address, "GET /metrics HTTP/1.1", b"").await?;
    assert!(page.starts_with("HTTP/1.1 200") && page.contains("midshift_telemetry_heartbeats_total"), "{page}");
    assert!(!page.contains("rbt-"), "a metric has a label per robot");
    let web = "POST /midshift.telemetry.v1.TelemetryService/ListRobots HTTP/1.1\r\n\
               Content-Type: application/grpc-web+proto\r\nContent-Length: 5";
    let answer = http1(address, web, &[0; 5]).await?;
    assert!(
        answer.starts_with("HTTP/1.1 200") && answer.contains("rbt-01") && answer.contains("grpc-status:0"),
        "{answer}"
    );
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn grpcurl_lists_submits_watches_and_hears_every_violation() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let factory = Factory::one_box(dir.path()).await?;
    grpcurl_passes(factory.address)
}

/// The whole of what grpcurl is asked to do.
pub fn grpcurl_passes(address: SocketAddr) -> anyhow::Result<()> {
    let services = text(&grpcurl(address, &[], "list")?.stdout);
    for service in [
        "midshift.task.v1.TaskService",
        "midshift.fleet.v1.FleetService",
        "midshift.identity.v1.IdentityService",
        "grpc.health.v1.Health",
    ] {
        assert!(services.contains(service), "{services}");
    }
    // They answer on a port of their own.
    assert!(!services.contains("midshift.stop.v1"), "{services}");
    let good = r#"{"request_id":"g1","task_id":"TASK-GRPCURL","flat":{"task_type":"transport","priority":0,"from_waypoint":"A01","to_waypoint":"B03","item_sku":"SKU-1","timeout_seconds":600}}"#;
    let submitted = grpcurl(address, &["-d", good], "midshift.task.v1.TaskService/SubmitTask")?;
    assert!(submitted.status.success(), "{}", text(&submitted.stderr));
    assert!(text(&submitted.stdout).contains("TASK-GRPCURL"));
    let bad = r#"{"flat":{"task_type":"Bad Type","priority":12,"to_waypoint":"nowhere"}}"#;
    let refused = grpcurl(address, &["-d", bad], "midshift.task.v1.TaskService/SubmitTask")?;
    let said = text(&refused.stderr);
    assert!(!refused.status.success());
    for field in ["InvalidArgument", "flat.task_type", "flat.priority", "flat.to_waypoint", "flat.timeout_seconds"] {
        assert!(said.contains(field), "{field} is not in: {said}");
    }
    assert!(said.contains(r#""fieldViolations""#), "its details cannot be read: {said}");
    let watch = r#"{"filter":{"task_ids":["TASK-GRPCURL"]}}"#;
    let watched = grpcurl(address, &["-d", watch], "midshift.task.v1.TaskService/WatchTasks")?;
    let seen = text(&watched.stdout);
    assert!(seen.contains("TASK-GRPCURL") && seen.contains("TASK_STATE_SUCCEEDED"), "{seen} {}", text(&watched.stderr));
    Ok(())
}

const CLIENT: &str = r#"
import os, sys, grpc
from google.protobuf.duration_pb2 import Duration
from midshift.task.v1 import task_pb2, task_service_pb2, task_service_pb2_grpc
if "MIDSHIFT_CA" in os.environ:
    tls = grpc.ssl_channel_credentials(open(os.environ["MIDSHIFT_CA"], "rb").read())
    signed_in = grpc.access_token_call_credentials(os.environ["MIDSHIFT_TOKEN"])
    channel = grpc.secure_channel(sys.argv[1], grpc.composite_channel_credentials(tls, signed_in))
else:
    channel = grpc.insecure_channel(sys.argv[1])
client = task_service_pb2_grpc.TaskServiceStub(channel)
flat = task_pb2.FlatTask(task_type="transport", priority=0, from_waypoint="A02", to_waypoint="B01", item_sku="SKU-2", timeout_seconds=600)
task = client.SubmitTask(task_service_pb2.SubmitTaskRequest(request_id="py-1", flat=flat), timeout=10).task
again = client.SubmitTask(task_service_pb2.SubmitTaskRequest(request_id="py-1", flat=flat), timeout=10).task
assert task.task_id == again.task_id, (task.task_id, again.task_id)
steps = [task_pb2.Step(goto=task_pb2.Goto(waypoint="A02"))] * 20
spec = task_pb2.TaskSpec(type="patrol", steps=steps, timeout=Duration(seconds=600))
checked = task_service_pb2.SubmitTaskRequest(request_id="py-2", spec=spec, validate_only=True)
client.SubmitTask(checked, timeout=10, compression=grpc.Compression.Gzip)
watch = task_service_pb2.WatchTasksRequest(filter=task_service_pb2.TaskFilter(task_ids=[task.task_id]))
seen = []
for message in client.WatchTasks(watch, timeout=60):
    shown = message.existing if message.HasField("existing") else message.change.task if message.HasField("change") else None
    if shown is None:
        continue
    seen.append(task_pb2.TaskState.Name(shown.state))
    if shown.state == task_pb2.TASK_STATE_SUCCEEDED:
        print(task.task_id, " > ".join(seen))
        sys.exit(0)
sys.exit("the watch ended: " + " > ".join(seen))
"#;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_python_client_from_stock_tools_submits_and_watches() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let factory = Factory::one_box(dir.path()).await?;
    stock_python_passes(dir.path(), factory.address)
}

/// The same for a Python program whose stubs are generated into `dir`.
pub fn stock_python_passes(dir: &Path, address: SocketAddr) -> anyhow::Result<()> {
    let python = tool("MIDSHIFT_TEST_PYTHON")?;
    let proto = Path::new(env!("CARGO_MANIFEST_DIR")).join("../proto");
    let out = dir.to_string_lossy().into_owned();
    let mut generate = Command::new(&python);
    generate
        .args(["-m", "grpc_tools.protoc", "-I"])
        .arg(&proto)
        .args([format!("--python_out={out}"), format!("--grpc_python_out={out}")]);
    for file in [
        "common/v1/access.proto",
        "common/v1/common.proto",
        "common/v1/privacy.proto",
        "task/v1/task.proto",
        "task/v1/task_service.proto",
        "task/v1/task_type.proto",
    ] {
        generate.arg(proto.join("midshift").join(file));
    }
    let generated = generate.output()?;
    assert!(generated.status.success(), "{}", text(&generated.stderr));
    let script = dir.join("client.py");
    std::fs::write(&script, CLIENT)?;
    let mut command = Command::new(&python);
    sign_in(&mut command, address);
    let ran = command.arg(&script).arg(address.to_string()).env("PYTHONPATH", dir).output()?;
    assert!(ran.status.success(), "{} {}", text(&ran.stdout), text(&ran.stderr));
    assert!(text(&ran.stdout).contains("TASK_STATE_SUCCEEDED"));
    Ok(())
}
