//! `midshift doctor`: looks for what may be wrong, and says what to try.

use super::client::{Call, Exit, unary};
use super::out::{Format, Out, columns};
use midshift_proto::task::v1::{ListTasksRequest, TaskFilter, TaskState};
use midshift_proto::telemetry::v1;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// Robot clocks further off than this are worth a look, milliseconds.
const SKEW_MAX_MS: i64 = 2_000;
/// Descriptors a server for a thousand robots should have.
const DESCRIPTORS_WANTED: u64 = 4_096;

/// Every service of a server.
const SERVICES: [&str; 4] = [
    "midshift.task.v1.TaskService",
    "midshift.fleet.v1.FleetService",
    "midshift.telemetry.v1.TelemetryService",
    "midshift.link.v1.LinkService",
];

struct Finding {
    what: &'static str,
    good: bool,
    text: String,
}

/// Runs every check; exit code 1 if one is not good.
pub async fn run(call: &Call, out: &Out) -> Result<(), Exit> {
    let mut found =
        vec![Finding { what: "version", good: true, text: env!("CARGO_PKG_VERSION").to_owned() }, descriptors()];
    match call.telemetry().await {
        Err(_) => found.push(Finding {
            what: "server",
            good: false,
            text: format!("nothing answers at {}; start `midshift dev` or `midshift serve`", call.server),
        }),
        Ok(_) => server(call, &mut found).await?,
    }
    match out.format {
        Format::Json | Format::Jsonl => {
            let list: Vec<_> =
                found.iter().map(|f| serde_json::json!({"check": f.what, "good": f.good, "text": f.text})).collect();
            out.value(&list.into())?;
        }
        Format::Name => found.iter().filter(|f| !f.good).for_each(|f| out.line(f.what)),
        Format::Table => {
            let rows: Vec<Vec<String>> = found
                .iter()
                .map(|f| vec![f.what.to_owned(), if f.good { "good" } else { "LOOK" }.to_owned(), f.text.clone()])
                .collect();
            out.line(&columns(&["CHECK", "", "FOUND"], &rows));
        }
    }
    let bad = found.iter().filter(|f| !f.good).count();
    if bad == 0 { Ok(()) } else { Err(Exit::new(1, format!("{bad} checks want a look"))) }
}

fn descriptors() -> Finding {
    let text = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let limit = text
        .lines()
        .find(|l| l.starts_with("Max open files"))
        .and_then(|l| l.split_whitespace().nth(3))
        .and_then(|n| n.parse::<u64>().ok());
    match limit {
        None => Finding { what: "descriptors", good: true, text: "limit unknown on this system".to_owned() },
        Some(n) => Finding {
            what: "descriptors",
            good: n >= DESCRIPTORS_WANTED,
            text: format!("{n} open files allowed here; a robot takes one"),
        },
    }
}

async fn server(call: &Call, found: &mut Vec<Finding>) -> Result<(), Exit> {
    let endpoint = tonic::transport::Endpoint::from_shared(crate::robots::uri(&call.server))
        .map_err(|e| Exit::usage(e.to_string()))?;
    let channel = endpoint.connect().await.map_err(|e| Exit::new(5, e.to_string()))?;
    for service in SERVICES {
        let request = tonic_health::pb::HealthCheckRequest { service: service.to_owned() };
        let status = HealthClient::new(channel.clone()).check(unary(request)).await.map(|r| r.into_inner().status());
        let good = matches!(status, Ok(ServingStatus::Serving));
        found.push(Finding {
            what: "service",
            good,
            text: format!("{service} {}", if good { "serves" } else { "does not serve" }),
        });
    }
    found.push(store(call).await);
    found.extend(robots(call).await?);
    found.push(operator(call).await?);
    Ok(())
}

/// Intake answers this from the store's rows, not from memory.
async fn store(call: &Call) -> Finding {
    let read = async {
        let request = ListTasksRequest { page_size: 1, ..ListTasksRequest::default() };
        Ok::<_, Exit>(call.task().await?.list_tasks(unary(request)).await?)
    };
    let (good, text) = match read.await {
        Ok(_) => (true, "rows can be read".to_owned()),
        Err(exit) => (false, format!("rows cannot be read: {exit}")),
    };
    Finding { what: "store", good, text }
}

async fn robots(call: &Call) -> Result<[Finding; 2], Exit> {
    let request = v1::ListRobotsRequest { page_size: 1_000, ..v1::ListRobotsRequest::default() };
    let robots = call.telemetry().await?.list_robots(unary(request)).await?.into_inner().robots;
    let online = robots.iter().filter(|r| r.presence() == v1::Presence::Online).count();
    let skewed = robots.iter().filter(|r| r.clock_offset_ms.is_some_and(|o| o.abs() > SKEW_MAX_MS)).count();
    Ok([
        Finding { what: "robots", good: online == robots.len(), text: format!("{online} of {} online", robots.len()) },
        Finding {
            what: "clocks",
            good: skewed == 0,
            text: format!("{skewed} robots off by more than {SKEW_MAX_MS} ms"),
        },
    ])
}

async fn operator(call: &Call) -> Result<Finding, Exit> {
    let waiting = TaskFilter { states: vec![TaskState::NeedsOperator as i32], ..TaskFilter::default() };
    let request = ListTasksRequest { filter: Some(waiting), page_size: 1_000, page_token: String::new() };
    let tasks = call.task().await?.list_tasks(unary(request)).await?.into_inner().tasks.len();
    Ok(Finding {
        what: "operator",
        good: tasks == 0,
        text: format!("{tasks} tasks need an operator: midshift task ls --state needs-operator"),
    })
}
