//! Durations as people write them on a command line, and as they read them.

use midshift_proto::convert::ms_of;
use std::time::Duration;

/// Reads `10m`, `90s`, `500ms`, `2h`, `90d`.
pub fn duration(text: &str) -> Result<Duration, String> {
    let bad = || "must be a number with ms, s, m, h or d, e.g. 90s".to_owned();
    let at = text.find(|c: char| !c.is_ascii_digit() && c != '.').ok_or_else(bad)?;
    let number: f64 = text[..at].parse().map_err(|_| bad())?;
    let seconds = match &text[at..] {
        "ms" => 0.001,
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        "d" => 86_400.0,
        _ => return Err(bad()),
    };
    Duration::try_from_secs_f64(number * seconds).map_err(|_| bad())
}

/// A stretch of time: `8.0 s`, `12 min 5 s`, `3 h 20 min`.
pub fn span(duration: &prost_types::Duration) -> String {
    let ms = ms_of(duration).max(0);
    let seconds = ms / 1000;
    match seconds {
        0..60 => format!("{}.{} s", seconds, ms % 1000 / 100),
        60..3_600 => format!("{} min {} s", seconds / 60, seconds % 60),
        _ => format!("{} h {} min", seconds / 3_600, seconds % 3_600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_read_as_people_write_them() {
        assert_eq!(duration("10m"), Ok(Duration::from_secs(600)));
        assert_eq!(duration("1.5s"), Ok(Duration::from_millis(1500)));
        assert_eq!(duration("90d"), Ok(Duration::from_secs(90 * 24 * 3_600)));
        assert!(duration("10").is_err() && duration("x").is_err());
    }
}
