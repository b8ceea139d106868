//! `midshift doctor`: looks for what may be wrong, and says what to try.

mod finding;
mod machine;
mod shown;
mod site;
mod stop;

use super::client::{Call, Exit, unary};
use super::out::{Format, Out, columns};
use super::released;
use crate::endpoint::Line;
use crate::roles::Role;
use crate::{clock, site_answer};
use finding::{DAY_MS, Finding};
use midshift_bundle::freshness::{newest_targets, root_edition, stamp, targets_edition};
use midshift_bundle::repository::TIMESTAMP_LIFE_MS;
use midshift_core::time::Utc;
use midshift_proto::ota::v1::{GetMetadataRequest, ListBundlesRequest, ListBundlesResponse, SoftwareRoom};
use midshift_proto::task::v1::{ListTasksRequest, TaskFilter, TaskState};
use midshift_proto::telemetry::v1;
use std::collections::BTreeSet;
use std::path::PathBuf;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// Robot clocks further off than this are worth a look, milliseconds.
const SKEW_MAX_MS: i64 = 2_000;

/// People are told so long before a document that they sign ends, milliseconds: 60 days.
const PEOPLE_TOLD_MS: u64 = 60 * DAY_MS;
/// The server signs a timestamp anew at half its life; with less than a quarter left it does not.
const TIMESTAMP_LEFT_MS: u64 = TIMESTAMP_LIFE_MS / 4;
/// From here on the room for software wants a look, percent.
const FULL_PERCENT: u64 = 90;
/// Root documents that are followed, one after the other, as robots do.
const ROOTS_MAX: u64 = 1_024;
/// What to look at.
#[derive(Clone, Debug, clap::Args)]
pub struct Doctor {
    #[command(flatten)]
    call: Call,
    /// The stop service, host:port, if it is not on port 7421 of the server.
    #[arg(long, env = "MIDSHIFT_STOP_SERVER", value_name = "HOST:PORT")]
    stop_server: Option<String>,
    /// The server's data folder, if this is its machine.
    #[arg(long, default_value = "midshift-data")]
    data: PathBuf,
    /// Say to the server of --data that the clock of this machine is right though it jumped, so that it signs by it again. Nothing else is looked for.
    #[arg(long)]
    accept_clock: bool,
}

/// Runs every check; exit code 1 if one is not good.
pub async fn run(doctor: &Doctor, out: &Out) -> Result<(), Exit> {
    if doctor.accept_clock {
        clock::leave_word(&doctor.data)?;
        out.inform("the server of that folder takes the clock of this machine for right, within seconds");
        out.next("midshift doctor");
        return Ok(());
    }
    let mut found = vec![Finding::good("version", env!("CARGO_PKG_VERSION"))];
    found.extend(machine::data(&doctor.data));
    match doctor.call.telemetry().await {
        Err(_) => {
            found.extend(machine::descriptors(&doctor.data, None));
            let at = doctor.call.address()?;
            found.push(Finding::wants_look(
                "server",
                format!("nothing answers at {at}; start `midshift dev` or `midshift serve`"),
            ));
        }
        Ok(_) => server(doctor, &mut found).await?,
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

async fn server(doctor: &Doctor, found: &mut Vec<Finding>) -> Result<(), Exit> {
    let (call, now) = (&doctor.call, midshift_agent::clock::wall());
    let resolved = call.resolved()?;
    let channel = call.line().await?;
    // Without a login there is nobody to enrol and no token to make.
    let identity = Role::Identity.services().iter().filter(|_| resolved.is_secure());
    let others = Role::ALL.into_iter().filter(|role| *role != Role::Identity).flat_map(Role::services);
    let services: BTreeSet<&str> = others.chain(identity).copied().collect();
    for service in services {
        let request = HealthCheckRequest { service: service.to_owned() };
        let status = HealthClient::new(channel.clone()).check(unary(request)).await.map(|r| r.into_inner().status());
        let good = matches!(status, Ok(ServingStatus::Serving));
        let text = format!("{service} {}", if good { "serves" } else { "does not serve" });
        found.push(Finding { what: "service", good, text });
    }
    found.extend(wall(&channel, now).await);
    found.push(store(call).await);
    let (robots, online) = robots(doctor).await?;
    found.extend(robots);
    found.push(operator(call).await?);
    found.extend(releases(call).await);
    found.extend(shown::certificates(&resolved, now).await);
    found.extend(site::identities(call, &resolved, now).await);
    found.push(site::exposure(&resolved));
    let address = super::stop::address(doctor.stop_server.as_deref(), &resolved)?;
    found.extend(stop::check_stop_service(&resolved, &address, now, &online).await);
    Ok(())
}

/// What the server's wall clock jumped while it ran, and whether it signs by it, which it says in each answer to a health check.
async fn wall(channel: &Line, now: Utc) -> Vec<Finding> {
    let answer = HealthClient::new(channel.clone()).check(unary(HealthCheckRequest::default())).await;
    let Ok(answer) = answer else { return Vec::new() };
    let jump =
        site_answer::clock_jump(answer.metadata()).map(|(step_ms, at)| shown::jump("the server's", step_ms, at, now));
    let doubt = site_answer::clock_doubt(answer.metadata()).map(|(step_ms, at)| shown::doubt(step_ms, at));
    jump.into_iter().chain(doubt).collect()
}

/// When what was signed ends: root and targets, which people sign, and the timestamp, which the server signs.
async fn releases(call: &Call) -> Vec<Finding> {
    let mut found = match documents(call).await {
        Ok(ends) => ends.into_iter().map(|end| end.finding(midshift_agent::clock::wall())).collect(),
        Err(finding) => vec![finding],
    };
    found.extend(room(call).await);
    found
}

/// How full the server is with software, and whether it may sign orders; nothing: it keeps none, or cannot be asked, which others say.
async fn room(call: &Call) -> Vec<Finding> {
    let request = ListBundlesRequest { page_size: 1, ..ListBundlesRequest::default() };
    let Ok(mut client) = call.bundles().await else { return Vec::new() };
    let Ok(answer) = client.list_bundles(unary(request)).await else { return Vec::new() };
    of_software(&answer.into_inner())
}

fn of_software(answer: &ListBundlesResponse) -> Vec<Finding> {
    let keyless = answer.keyless.as_ref().map(|why| Finding {
        what: "keys",
        good: false,
        text: format!("{}: {}", why.code, why.message),
    });
    answer.room.as_ref().map(fullness).into_iter().chain(keyless).collect()
}

fn fullness(room: &SoftwareRoom) -> Finding {
    let good = room.used_bytes.saturating_mul(100) < room.quota_bytes.saturating_mul(FULL_PERCENT);
    let then = "; midshift bundle withdraw what nobody needs, or give the server more with --ota-quota-gib";
    let text = format!("{}{}", released::room(room), if good { "" } else { then });
    Finding { what: "software", good, text }
}

/// A document that ends.
struct End {
    role: &'static str,
    version: u64,
    expires: Utc,
    /// It wants a look with less than this left, milliseconds.
    told_ms: u64,
    /// What to do then.
    then: &'static str,
}

impl End {
    fn finding(&self, now: Utc) -> Finding {
        let left_ms = self.expires.ms_since(now);
        let good = left_ms > self.told_ms;
        let left = match left_ms {
            0 => "it has EXPIRED".to_owned(),
            ms if ms < 2 * DAY_MS => format!("{} h are left", ms / 3_600_000),
            ms => format!("{} days are left", ms / DAY_MS),
        };
        let then = if good { String::new() } else { format!("; {}", self.then) };
        let text = format!("{} {} ends {}: {left}{then}", self.role, self.version, self.expires.rfc3339());
        Finding { what: "keys", good, text }
    }
}

/// What the server shows, newest of each; an error is what there is to say instead.
async fn documents(call: &Call) -> Result<Vec<End>, Finding> {
    let bad = |text: String| Finding { what: "keys", good: false, text };
    let mut client = call.bundles().await.map_err(|e| bad(e.to_string()))?;
    let mut get = async |name: String| match client.get_metadata(unary(GetMetadataRequest { name: name.clone() })).await
    {
        Ok(answer) => Ok(Some(answer.into_inner().document)),
        Err(status) if status.code() == Code::NotFound => Ok(None),
        Err(status) if status.code() == Code::FailedPrecondition => Err(Finding {
            what: "keys",
            good: true,
            text: "this server keeps no software: it has no online keys".to_owned(),
        }),
        Err(status) => Err(bad(format!("{name} cannot be read: {}", status.message()))),
    };
    let Some(timestamp) = get("timestamp.json".to_owned()).await? else {
        return Err(Finding { what: "keys", good: true, text: "no release was published yet".to_owned() });
    };
    let unread = |e: midshift_bundle::repository::Error| bad(e.to_string());
    let lost = |name: &str| bad(format!("the server lost its {name}"));
    let mut root = None;
    for version in 1..=ROOTS_MAX {
        let Some(document) = get(format!("{version}.root.json")).await? else { break };
        root = Some(document);
    }
    let root = root_edition(&root.ok_or_else(|| lost("root"))?).map_err(unread)?;
    let stamp = stamp(&timestamp).map_err(unread)?;
    let snapshot = get(format!("{}.snapshot.json", stamp.snapshot_version)).await?.ok_or_else(|| lost("snapshot"))?;
    let version = newest_targets(&snapshot).map_err(unread)?;
    let targets = get(format!("{version}.targets.json")).await?.ok_or_else(|| lost("targets"))?;
    let targets = targets_edition(&targets).map_err(unread)?;
    let people = |role, version, expires, then| End { role, version, expires, told_ms: PEOPLE_TOLD_MS, then };
    Ok(vec![
        people("root", root.version, root.expires, "sign a new root, see docs/runbooks"),
        people("targets", targets.version, targets.expires, "sign a release: midshift bundle sign"),
        End {
            role: "timestamp",
            version: stamp.version,
            expires: stamp.expires,
            told_ms: TIMESTAMP_LEFT_MS,
            then: "the server does not sign it anew: look at its log and its clock",
        },
    ])
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

/// What is to be said of robots, and which of them are online.
async fn robots(doctor: &Doctor) -> Result<(Vec<Finding>, Vec<String>), Exit> {
    let call = &doctor.call;
    let request = v1::ListRobotsRequest { page_size: 1_000, ..v1::ListRobotsRequest::default() };
    let mut client = call.telemetry().await?;
    let answer = client.list_robots(unary(request.clone())).await?;
    let server = shown::clock("the server", answer.metadata(), midshift_agent::clock::wall());
    let mut page = answer.into_inner();
    let mut robots = std::mem::take(&mut page.robots);
    while !page.next_page_token.is_empty() {
        let next = v1::ListRobotsRequest { page_token: page.next_page_token, ..request.clone() };
        page = client.list_robots(unary(next)).await?.into_inner();
        robots.append(&mut page.robots);
    }
    let online = robots.iter().filter(|r| r.presence() == v1::Presence::Online).map(|r| r.robot_id.clone());
    let online: Vec<String> = online.collect();
    let good = online.len() == robots.len();
    let mut found = machine::descriptors(&doctor.data, Some(robots.len()));
    found.extend([
        Finding { what: "robots", good, text: format!("{} of {} online", online.len(), robots.len()) },
        server,
        clocks(&robots),
    ]);
    Ok((found, online))
}

/// Clocks of robots beside the server's, as their heartbeats measure them.
fn clocks(robots: &[v1::Robot]) -> Finding {
    let offset = |robot: &v1::Robot| robot.clock_offset_ms.unwrap_or_default();
    let skewed = robots.iter().filter(|robot| offset(robot).abs() > SKEW_MAX_MS);
    let count = skewed.clone().count();
    let text = format!("{count} robots off by more than {SKEW_MAX_MS} ms");
    match skewed.max_by_key(|robot| offset(robot).abs()) {
        None => Finding::good("clocks", text),
        Some(worst) => Finding::wants_look(
            "clocks",
            format!("{text}, most of all {} by {} ms: set them from the network (NTP)", worst.robot_id, offset(worst)),
        ),
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::reason::Reason;
    use midshift_proto::convert::shown;

    #[test]
    fn people_are_told_sixty_days_before_what_they_sign_ends() {
        let found = |days: u64| {
            let expires = Utc(0).plus_ms(100 * DAY_MS);
            let end = End { role: "root", version: 3, expires, told_ms: PEOPLE_TOLD_MS, then: "sign a new root" };
            end.finding(Utc(0).plus_ms((100 - days) * DAY_MS))
        };
        let (early, late, over) = (found(61), found(60), found(0));
        assert_eq!([early.good, late.good, over.good], [true, false, false]);
        assert_eq!(early.text, "root 3 ends 1970-04-11T00:00:00.000Z: 61 days are left");
        assert_eq!(late.text, "root 3 ends 1970-04-11T00:00:00.000Z: 60 days are left; sign a new root");
        assert!(over.text.contains("it has EXPIRED; sign a new root"), "{}", over.text);
    }

    #[test]
    fn a_server_that_signs_no_orders_is_told_beside_its_room() {
        let room = Some(SoftwareRoom { quota_bytes: 10, ..SoftwareRoom::default() });
        let well = ListBundlesResponse { room, ..ListBundlesResponse::default() };
        assert_eq!(of_software(&well).iter().map(|f| f.what).collect::<Vec<_>>(), ["software"]);
        let why = shown(&Reason::from(midshift_core::reason::Code::NoDirectiveKey));
        let found = of_software(&ListBundlesResponse { keyless: Some(why), ..well });
        assert_eq!((found[1].what, found[1].good), ("keys", false));
        assert!(found[1].text.starts_with("NO_DIRECTIVE_KEY: The server has no directive key"), "{}", found[1].text);
    }

    #[test]
    fn people_are_told_before_the_room_for_software_is_used_up() {
        let found = |used_bytes| fullness(&SoftwareRoom { used_bytes, quota_bytes: 1_000, ..SoftwareRoom::default() });
        assert_eq!([found(0).good, found(899).good, found(900).good], [true, true, false]);
        assert_eq!(found(899).text, "899 of 1000 bytes are used");
        assert!(found(900).text.contains("bundle withdraw"), "{}", found(900).text);
        let room = SoftwareRoom { encoded_bytes: 3, unnamed_bytes: 4, used_bytes: 9, quota_bytes: 10, look_time: None };
        let text =
            "9 of 10 bytes are used, 3 of them by shorter ways to files; nothing names 4 of them, and they will go";
        assert_eq!(released::room(&room), text);
    }
}
