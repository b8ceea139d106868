//! The stop service of a site: whether it answers, keeps what it is told, knows who is known, and hears the robots that the server hears.

use super::finding::Finding;
use super::shown;
use crate::client::{ANSWER_BYTES_MAX, Exit, Resolved, unary};
use midshift_core::limits;
use midshift_core::time::Utc;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::stop::v1::{GetStatusRequest, Status};
use std::collections::BTreeSet;
use tonic::metadata::MetadataMap;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// A robot whose newest check-in is older has no line, milliseconds: three of them were missed, and the time of an answer is in whole seconds.
const LINE_SILENT_MS: u64 = limits::CHECK_IN_MISSED.as_ms() + 2_000;
/// Whoever writes down who is known has missed several turns to say so, milliseconds.
const PRINCIPALS_OLD_MS: u64 = limits::PRINCIPALS_TOLD_EVERY.as_ms() * 6;
/// So many names are told.
const NAMES_MAX: usize = 5;

/// Everything about it. `online`: robots that the server hears.
pub async fn check_stop_service(resolved: &Resolved, address: &str, now: Utc, online: &[String]) -> Vec<Finding> {
    if !serves(resolved, address).await.is_ok_and(|serves| serves) {
        return vec![Finding::wants_look(
            "stop",
            format!(
                "no stop service of this site answers at {address}: `midshift stop` reaches nobody; `midshift-stop`, or --stop-server if it is elsewhere"
            ),
        )];
    }
    let mut found = vec![Finding::good("stop", "the stop service answers")];
    found.extend(shown::of_stop(resolved, address, now).await);
    match status(resolved, address).await {
        Ok((head, status)) => {
            found.push(shown::clock("the stop service", &head, now));
            found.extend(of_status(&status, shown::server_time(&head).unwrap_or(now), online));
        }
        Err(exit) => {
            found.push(Finding::wants_look("stop", format!("what it keeps and whom it hears cannot be read: {exit}")))
        }
    }
    found
}

async fn serves(resolved: &Resolved, address: &str) -> Result<bool, Exit> {
    let line = resolved.endpoint(address)?.connect().await.map_err(anyhow::Error::from)?;
    let request = tonic_health::pb::HealthCheckRequest { service: "midshift.stop.v1.StopService".to_owned() };
    Ok(HealthClient::new(line).check(unary(request)).await?.into_inner().status() == ServingStatus::Serving)
}

async fn status(resolved: &Resolved, address: &str) -> Result<(MetadataMap, Status), Exit> {
    let line = resolved.endpoint(address)?.connect().await.map_err(anyhow::Error::from)?;
    let mut client = StopServiceClient::new(line).max_decoding_message_size(ANSWER_BYTES_MAX);
    let (head, answer, _) = client.get_status(unary(GetStatusRequest {})).await?.into_parts();
    Ok((head, answer.status.unwrap_or_default()))
}

/// `now` is of the stop service's own clock.
fn of_status(status: &Status, now: Utc, online: &[String]) -> Vec<Finding> {
    let mut found = Vec::new();
    let disk = "make room on its disk, and look whether it can be written";
    if !status.durable {
        let text = "its disk refuses the latch: stops are obeyed, and forgotten if the stop service ends now";
        found.push(Finding::wants_look("stop", format!("{text}; {disk}")));
    }
    if status.audit_refused {
        let text = "its disk refuses the audit: who stopped and reset what waits in memory";
        found.push(Finding::wants_look("stop", format!("{text}; {disk}")));
    }
    let told = Utc(status.principals_told_unix_ms);
    if status.principals_told_unix_ms != 0 && now.ms_since(told) > PRINCIPALS_OLD_MS {
        let text = "it was last told who is known";
        let then = "somebody who was revoked since then is still let in there; start `midshift serve` or its role stop-follower on the same data folder";
        found.push(Finding::wants_look("stop", format!("{text} {}; {then}", told.rfc3339())));
    }
    if status.clock_jump_ms != 0 {
        let at = Utc(status.clock_jumped_unix_ms);
        found.push(shown::jump("the stop service's", status.clock_jump_ms, at, now));
    }
    let is_heard = |heard: i64| heard != 0 && now.ms_since(Utc(heard)) < LINE_SILENT_MS;
    let heard: BTreeSet<&str> =
        status.robots.iter().filter(|r| is_heard(r.heard_unix_ms)).map(|r| r.robot_id.as_str()).collect();
    let mut without = online.iter().map(String::as_str).filter(|robot_id| !heard.contains(robot_id));
    let named: Vec<&str> = without.by_ref().take(NAMES_MAX).collect();
    let more = without.count();
    if named.is_empty() {
        found.push(Finding::good("stop", format!("it hears all {} robots that are online", online.len())));
        return found;
    }
    let names = if more == 0 { named.join(", ") } else { format!("{} and {more} more", named.join(", ")) };
    let count = named.len() + more;
    let then = "no stop reaches them, and they slow down and stand by their own silence; look at --stop-server of their agents and at the way to that port";
    found.push(Finding::wants_look(
        "stop",
        format!("{count} robots are online and have no line to it: {names}; {then}"),
    ));
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::stop::v1::RobotStatus;

    const NOW: Utc = Utc(1_800_000_000_000);

    fn robot(robot_id: &str, ago_ms: i64) -> RobotStatus {
        RobotStatus { robot_id: robot_id.to_owned(), heard_unix_ms: NOW.0 - ago_ms, ..RobotStatus::default() }
    }

    fn well() -> Status {
        Status { durable: true, principals_told_unix_ms: NOW.0 - 10_000, ..Status::default() }
    }

    fn bad(status: &Status, online: &[&str]) -> Vec<String> {
        let online: Vec<String> = online.iter().map(|id| (*id).to_owned()).collect();
        of_status(status, NOW, &online).into_iter().filter(|found| !found.good).map(|found| found.text).collect()
    }

    #[test]
    fn a_disk_that_refuses_the_latch_or_the_audit_is_told_of() {
        assert_eq!(bad(&well(), &[]), Vec::<String>::new());
        let found = bad(&Status { durable: false, ..well() }, &[]);
        assert!(found.len() == 1 && found[0].starts_with("its disk refuses the latch"), "{found:?}");
        let found = bad(&Status { audit_refused: true, ..well() }, &[]);
        assert!(found.len() == 1 && found[0].starts_with("its disk refuses the audit"), "{found:?}");
    }

    #[test]
    fn a_stop_service_that_nobody_tells_who_is_known_is_told_of() {
        let old = Status { principals_told_unix_ms: NOW.0 - 61_000, ..well() };
        let found = bad(&old, &[]);
        assert!(found.len() == 1 && found[0].contains("revoked since then"), "{found:?}");
        assert_eq!(bad(&Status { principals_told_unix_ms: 0, ..well() }, &[]), Vec::<String>::new(), "no login");
    }

    #[test]
    fn a_jump_of_the_clock_of_the_stop_service_is_told_of() {
        let jumped = Status { clock_jump_ms: -6_000, clock_jumped_unix_ms: NOW.0 - 1_000, ..well() };
        let found = bad(&jumped, &[]);
        assert!(found.len() == 1 && found[0].starts_with("the stop service's jumped 6 s back at "), "{found:?}");
    }

    #[test]
    fn robots_that_are_online_and_have_no_line_to_it_are_named() {
        let robots =
            vec![robot("r1", 900), robot("r2", 60_000), RobotStatus { robot_id: "r3".into(), ..Default::default() }];
        let status = Status { robots, ..well() };
        assert_eq!(bad(&status, &["r1"]), Vec::<String>::new());
        let found = bad(&status, &["r1", "r2", "r3", "r4"]);
        assert!(
            found.len() == 1 && found[0].starts_with("3 robots are online and have no line to it: r2, r3, r4;"),
            "{found:?}"
        );
        let found = bad(&status, &["a", "b", "c", "d", "e", "f", "g"]);
        assert!(found[0].contains("a, b, c, d, e and 2 more;"), "{found:?}");
    }
}
