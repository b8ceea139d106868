//! Stops, their levels and their scopes in words.

use midshift_core::time::Utc;
use midshift_proto::common::v1::StopLevel;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope;

/// How many robots said what.
pub fn summary(counts: &v1::Counts) -> String {
    format!(
        "{} stand, {} acknowledged, {} are elsewhere, {} requested, {} unreachable",
        counts.standstill_confirmed, counts.acked, counts.outside, counts.requested, counts.unreachable
    )
}

/// Where, if the stop service says so.
pub fn in_site(site_id: &str) -> String {
    if site_id.is_empty() { String::new() } else { format!(" at site {site_id}") }
}

/// The word of a level.
pub fn level(number: i32) -> &'static str {
    StopLevel::try_from(number).map_or("?", |level| level.as_str_name().trim_start_matches("STOP_LEVEL_"))
}

/// A level that somebody obeys; no stop, and nothing known, is said as `-`.
pub fn obeys(number: i32) -> String {
    match StopLevel::try_from(number) {
        Ok(StopLevel::Unspecified | StopLevel::None) => "-".to_owned(),
        _ => level(number).to_owned(),
    }
}

/// Whom a stop is for.
pub fn whom(stop: &v1::Stop) -> String {
    match stop.scope.as_ref().and_then(|scope| scope.scope.as_ref()) {
        Some(Scope::RobotId(id)) => format!("robot {id}"),
        Some(Scope::Zone(id)) => format!("zone {id}"),
        Some(Scope::AreaId(id)) => format!("area {id}"),
        Some(Scope::Fleet(_)) => "fleet".to_owned(),
        None => "?".to_owned(),
    }
}

/// A moment; 0 is never.
pub fn at(unix_ms: i64) -> String {
    if unix_ms == 0 { "never".to_owned() } else { Utc(unix_ms).rfc3339() }
}

/// What one robot has confirmed of a stop.
pub fn confirmed(robot: &v1::RobotStop) -> String {
    let word = robot.confirmation().as_str_name().trim_start_matches("CONFIRMATION_");
    if robot.confirmation() != v1::Confirmation::Unreachable {
        return format!("{}  {word}", robot.robot_id);
    }
    let by = match robot.self_stop_by_unix_ms {
        0 => "nobody can tell when it stands".to_owned(),
        by => format!("stands by itself by {}", at(by)),
    };
    let since = match robot.unreachable_since_unix_ms {
        0 => "not heard yet".to_owned(),
        since => format!("since {}", at(since)),
    };
    format!("{}  {word} {since}, {by}", robot.robot_id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_that_all_have_confirmed_ends_with_how_many_stand() {
        let counts = v1::Counts { standstill_confirmed: 12, ..v1::Counts::default() };
        assert_eq!(summary(&counts), "12 stand, 0 acknowledged, 0 are elsewhere, 0 requested, 0 unreachable");
    }
}
