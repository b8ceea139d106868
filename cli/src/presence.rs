//! Shows whether a robot is heard, and since when.

use midshift_core::time::Utc;
use midshift_proto::convert::{ms_of, time_of};
use midshift_proto::telemetry::v1;
use prost_types::Timestamp;

/// A stretch of time in its largest unit: `1.2 s`, `3 min`, `2 h`, `5 d`.
pub fn age(ms: i64) -> String {
    let ms = ms.max(0);
    match ms / 1_000 {
        0..60 => format!("{}.{} s", ms / 1_000, ms % 1_000 / 100),
        seconds @ 60..3_600 => format!("{} min", seconds / 60),
        seconds @ 3_600..86_400 => format!("{} h", seconds / 3_600),
        seconds => format!("{} d", seconds / 86_400),
    }
}

/// Since when, as an age at `now` of the same clock, else as a moment.
pub fn since(at: Option<&Timestamp>, now: Option<Utc>) -> String {
    match (at.map(time_of), now) {
        (Some(at), Some(now)) => format!(" ({})", age(now.0 - at.0)),
        (Some(at), None) => format!(" (since {})", at.rfc3339()),
        (None, _) => String::new(),
    }
}

/// The moment of the server's wall clock at which a robot was shown; none: it was never heard.
pub fn wall(robot: &v1::Robot) -> Option<Utc> {
    let last = robot.last_heard.as_ref();
    let heard = robot.receive_time.as_ref().zip(robot.age.as_ref());
    let (at, age) = heard.or_else(|| last.and_then(|last| last.receive_time.as_ref().zip(last.age.as_ref())))?;
    Some(Utc(time_of(at).0 + ms_of(age)))
}

/// Whether it is heard, and if not since when; with a star if only its launcher is, which nobody proves.
pub fn presence(robot: &v1::Robot) -> String {
    if robot.beacon.is_some() {
        return "UPDATING*".to_owned();
    }
    let word = robot.presence().as_str_name().trim_start_matches("PRESENCE_");
    let silent = robot.presence() != v1::Presence::Online;
    let since = if silent { since(robot.presence_since.as_ref(), wall(robot)) } else { String::new() };
    format!("{word}{since}")
}
