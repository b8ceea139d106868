//! Words of the command line about roll-outs, as the wire has them. What a number may be is the server's rule, not this one's.

use midshift_proto::ota::v1::RolloutWave;
use midshift_proto::ota::v1::rollout_wave::Size;

/// Reads `1`, `25%`, `rest`, `label:site=north`, `version:1.4.0`.
///
/// # Errors
/// What a wave may be.
pub fn wave(text: &str) -> Result<RolloutWave, String> {
    let bad = || "must be a number, N%, rest, label:KEY=VALUE or version:VERSION, such as 1,25%,rest".to_owned();
    let text = text.trim();
    let size = match text.split_once(':') {
        Some(("label", label)) => Size::Label(pair(label).map(|(key, value)| format!("{key}={value}"))?),
        Some(("version", version)) if !version.is_empty() => Size::Version(version.to_owned()),
        Some(_) => return Err(bad()),
        None if text == "rest" => Size::Rest(true),
        None => match text.strip_suffix('%') {
            Some(percent) => Size::Percent(percent.parse().map_err(|_| bad())?),
            None => Size::Count(text.parse().map_err(|_| bad())?),
        },
    };
    Ok(RolloutWave { size: Some(size) })
}

/// Reads `key=value`.
///
/// # Errors
/// If there is no `=`, or nothing before it.
pub fn pair(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("must be KEY=VALUE")?;
    if key.is_empty() { Err("must be KEY=VALUE".to_owned()) } else { Ok((key.to_owned(), value.to_owned())) }
}

/// Reads bytes a second: `5MiB`, `500kB`, `1048576`, with or without `/s`.
///
/// # Errors
/// What a rate may be.
pub fn rate(text: &str) -> Result<u32, String> {
    let bad = || "must be a number with B, kB, MB, KiB or MiB, e.g. 5MiB, below 4 GiB a second".to_owned();
    let amount = text.strip_suffix("/s").unwrap_or(text);
    let at = amount.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(amount.len());
    let number: f64 = amount[..at].parse().map_err(|_| bad())?;
    let unit = match &amount[at..] {
        "" | "B" => 1.0,
        "kB" => 1e3,
        "MB" => 1e6,
        "KiB" => 1024.0,
        "MiB" => 1024.0 * 1024.0,
        _ => return Err(bad()),
    };
    let bytes = number * unit;
    // 0 on the wire means no limit: less than a byte a second is not that.
    if bytes > f64::from(u32::MAX) || (number > 0.0 && bytes < 1.0) { Err(bad()) } else { Ok(bytes as u32) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waves_read_as_people_write_them() {
        let sizes = ["1", "25%", "rest", "label:site=north=1", "version:1.4.0"].map(|t| wave(t).unwrap().size.unwrap());
        let label = Size::Label("site=north=1".to_owned());
        let version = Size::Version("1.4.0".to_owned());
        assert_eq!(sizes, [Size::Count(1), Size::Percent(25), Size::Rest(true), label, version]);
        for bad in
            ["", "all", "-1", "25 %%", "1.5", "label:", "label:north", "label:=x", "version:", "x:y", "%", "5000000000"]
        {
            assert!(wave(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn rates_are_bytes_a_second_and_never_by_accident_without_a_limit() {
        let read = ["5MiB", "5MiB/s", "500kB", "1.5KiB", "1024", "7B", "0"].map(|t| rate(t).unwrap());
        assert_eq!(read, [5 << 20, 5 << 20, 500_000, 1_536, 1_024, 7, 0]);
        for bad in ["", "fast", "5 MiB", "-1", "0.5", "5GiB", "4096MiB", "1.2.3", "MiB"] {
            assert!(rate(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn labels_have_a_key() {
        assert_eq!(pair("site=north"), Ok(("site".to_owned(), "north".to_owned())));
        assert_eq!(pair("site="), Ok(("site".to_owned(), String::new())));
        assert!(pair("site").is_err() && pair("=north").is_err());
    }
}
