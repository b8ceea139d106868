//! What a server shows of itself before anybody asks it for anything: its certificates, and its clock.

use super::finding::{DAY_MS, Finding};
use crate::client::{Exit, Resolved};
use midshift_core::reason::Code;
use midshift_core::time::Utc;
use tokio_util::either::Either;
use tonic::metadata::MetadataMap;

/// The certificate of a server lives 90 days and is renewed at half of them; with less than this left it was not, days.
const SERVER_LEFT_DAYS: u64 = 30;
/// The root lives 20 years. It takes a while to bring another one to every robot, days.
const ROOT_LEFT_DAYS: u64 = 365;
/// Clocks of this machine and of the server may differ by so much, milliseconds: the server says whole seconds.
const AGREES_MS: u64 = 3_000;

/// When the certificates end that the server shows, the leaf first.
pub async fn certificates(resolved: &Resolved, now: Utc) -> Vec<Finding> {
    if !resolved.is_secure() {
        return vec![Finding::good("certificates", "none: this server is asked in plain text")];
    }
    match ends(resolved, &resolved.server).await {
        Ok(ends) if !ends.is_empty() => {
            let what = [
                (
                    "the server's",
                    SERVER_LEFT_DAYS,
                    "it was not renewed at half of its life: look at the log of `midshift serve`",
                ),
                ("the site's root", ROOT_LEFT_DAYS, "plan a new site root: every robot is enrolled anew with it"),
            ];
            ends.into_iter().zip(what).map(|(end, (whose, days, then))| left(whose, end, now, days, then)).collect()
        }
        Ok(_) => vec![Finding::wants_look("certificates", "the server showed none that can be read")],
        Err(error) => vec![Finding::wants_look(
            "certificates",
            format!("{error:#}; midshift login anew, if the site is another one now"),
        )],
    }
}

/// When the certificate of the stop service ends, which it has of whoever tells it who is known; nothing in plain text.
pub async fn of_stop(resolved: &Resolved, address: &str, now: Utc) -> Option<Finding> {
    let then =
        "it shows what was written down for it: look at the log of `midshift serve`, or of its role stop-follower";
    match ends(resolved, address).await {
        Ok(ends) => Some(left("the stop service's", *ends.first()?, now, SERVER_LEFT_DAYS, then)),
        Err(error) => Some(Finding::wants_look("certificates", format!("of the stop service: {error:#}"))),
    }
}

/// What is said of something that ends.
pub fn left(whose: &str, end: Utc, now: Utc, least_days: u64, then: &str) -> Finding {
    let days = end.ms_since(now) / DAY_MS;
    let at = end.rfc3339();
    if end <= now {
        return Finding::wants_look("certificates", format!("{whose} ENDED {at}; {then}"));
    }
    let text = format!("{whose} ends {at}, in {days} days");
    if days < least_days {
        return Finding::wants_look("certificates", format!("{text}; {then}"));
    }
    Finding::good("certificates", text)
}

async fn ends(resolved: &Resolved, address: &str) -> Result<Vec<Utc>, Exit> {
    let wire = resolved.endpoint(address)?.wire().await.map_err(anyhow::Error::from)?;
    let Either::Right(stream) = wire else { return Ok(Vec::new()) };
    let shown = stream.get_ref().1.peer_certificates().unwrap_or_default();
    Ok(shown.iter().filter_map(|certificate| not_after(certificate)).collect())
}

/// The moment until which a certificate (DER) is good. None: it is none.
fn not_after(certificate: &[u8]) -> Option<Utc> {
    let (_, certificate, _) = element(certificate)?;
    let (_, mut rest, _) = element(certificate)?;
    // version [0], absent in the oldest form; serial, algorithm, issuer.
    if rest.first() == Some(&0xa0) {
        rest = element(rest)?.2;
    }
    for _ in 0..3 {
        rest = element(rest)?.2;
    }
    let (_, validity, _) = element(rest)?;
    let (_, _, after) = element(validity)?;
    let (tag, text, _) = element(after)?;
    let text = std::str::from_utf8(text).ok()?;
    // UTCTime has two digits of the year, up to 2049.
    let text = match tag {
        0x17 if text.get(..2)? < "50" => format!("20{text}"),
        0x17 => format!("19{text}"),
        0x18 => text.to_owned(),
        _ => return None,
    };
    let part = |range: std::ops::Range<usize>| text.get(range);
    let (day, time) = ((part(0..4)?, part(4..6)?, part(6..8)?), (part(8..10)?, part(10..12)?, part(12..14)?));
    Utc::parse_rfc3339(&format!("{}-{}-{}T{}:{}:{}Z", day.0, day.1, day.2, time.0, time.1, time.2))
}

/// Tag and content of the first element of DER, and what follows it.
fn element(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (&tag, rest) = bytes.split_first()?;
    let (&first, rest) = rest.split_first()?;
    let (length, rest) = match first {
        0..=0x7f => (usize::from(first), rest),
        0x81..=0x84 => {
            let (digits, rest) = rest.split_at_checked(usize::from(first & 0x7f))?;
            (digits.iter().fold(0, |length, digit| length << 8 | usize::from(*digit)), rest)
        }
        _ => return None,
    };
    let (content, rest) = rest.split_at_checked(length)?;
    Some((tag, content, rest))
}

/// The time of a server, in whole seconds, from the head of its answer; none: it does not say it.
pub fn server_time(answer: &MetadataMap) -> Option<Utc> {
    answer.get("date").and_then(|date| date.to_str().ok()).and_then(date)
}

/// What its clock says beside this one.
pub fn clock(whose: &str, answer: &MetadataMap, now: Utc) -> Finding {
    let Some(said) = server_time(answer) else {
        return Finding::good("clocks", format!("{whose} does not say its time"));
    };
    let (ahead, behind) = (said.ms_since(now), now.ms_since(said));
    if ahead.max(behind) <= AGREES_MS {
        return Finding::good("clocks", format!("{whose} and this machine agree"));
    }
    let (seconds, way) = if ahead > behind { (ahead / 1_000, "ahead of") } else { (behind / 1_000, "behind") };
    let then = "certificates and signatures are judged by it: set both from the network (NTP)";
    Finding::wants_look("clocks", format!("{whose} is {seconds} s {way} this machine; {then}"))
}

/// What its wall clock jumped while it ran: a person looks for a day, and sees it for as long as it runs.
pub fn jump(whose: &str, step_ms: i64, at: Utc, now: Utc) -> Finding {
    let way = if step_ms < 0 { "back" } else { "ahead" };
    let text = format!("{whose} jumped {} s {way} at {}", step_ms.unsigned_abs() / 1_000, at.rfc3339());
    if now.ms_since(at) > DAY_MS {
        return Finding::good("clocks", text);
    }
    let then =
        "tokens and times of tasks follow it; if it is wrong now, set it right (NTP): see docs/runbooks/clock.md";
    Finding::wants_look("clocks", format!("{text}; {then}"))
}

/// It signs nothing by its clock.
pub fn doubt(step_ms: i64, at: Utc) -> Finding {
    let way = if step_ms < 0 { "behind" } else { "ahead of" };
    let (off_s, at) = (step_ms.unsigned_abs() / 1_000, at.rfc3339());
    let then = Code::ClockDoubted.next_step();
    Finding::wants_look(
        "clocks",
        format!("the server signs nothing since {at}: its clock is {off_s} s {way} what it was; {then}"),
    )
}

/// `Sun, 06 Nov 1994 08:49:37 GMT`.
fn date(text: &str) -> Option<Utc> {
    const MONTHS: [&str; 12] = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
    let mut words = text.split_once(", ")?.1.split(' ');
    let (day, month, year, time) = (words.next()?, words.next()?, words.next()?, words.next()?);
    let month = 1 + MONTHS.iter().position(|name| *name == month)?;
    Utc::parse_rfc3339(&format!("{year}-{month:02}-{day}T{time}Z"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `openssl req -x509 -newkey ed25519 -nodes -keyout /dev/null -subj /CN=a -days N`, one that ends before 2050 and one after.
    const UNTIL_2027: &str = "MIIBLDCB36ADAgECAhRtUEdcIuDLuBeoC/y3xkgNJDyqNjAFBgMrZXAwDDEKMAgGA1UEAwwBYTAeFw0yNjExMjIxNDQ5MjZaFw0yNzA3MjAxNDQ5MjZaMAwxCjAIBgNVBAMMAWEwKjAFBgMrZXADIQCsXhgUzSO7JVBPkb3R9fgTAxTuUNtPKpu+kBDy7eY8J6NTMFEwHQYDVR0OBBYEFEEl8TMMlRLUsZYyzOYG1ZOSRVqPMB8GA1UdIwQYMBaAFEEl8TMMlRLUsZYyzOYG1ZOSRVqPMA8GA1UdEwEB/wQFMAMBAf8wBQYDK2VwA0EAP6IO0zKAiJWYQkPVXFsLiIeycolzGVhj0fxCpb0yfISaPXJM91IiTnByQ0+ajEAQB9lGvLilhGddGJfm/UA6Bg==";
    const UNTIL_2067: &str = "MIIBLjCB4aADAgECAhRjJwjP3GkvxkIdCbunSmDd3JFwyjAFBgMrZXAwDDEKMAgGA1UEAwwBYTAgFw0yNjExMjIxNDQ5MjZaGA8yMDY3MTIxNzE0NDkyNlowDDEKMAgGA1UEAwwBYTAqMAUGAytlcAMhAHnIsdUpsGb+bFUXKVlZQQyMFCkVLReTW2X1j8yBeEBpo1MwUTAdBgNVHQ4EFgQU4HbfnCCmYZ85Lm6w4QdDIx2SAcgwHwYDVR0jBBgwFoAU4HbfnCCmYZ85Lm6w4QdDIx2SAcgwDwYDVR0TAQH/BAUwAwEB/zAFBgMrZXADQQATBA5dY6YPVUEtVPnYerfALuKrFuB32V/Rs1hYeNv8JirQD6ZBd1e0lq5Berc6AYfob5xvxRvaaIoALqngcLsC";

    fn der(pem: &str) -> Vec<u8> {
        use rustls::pki_types::pem::PemObject;
        let pem = format!("-----BEGIN CERTIFICATE-----\n{pem}\n-----END CERTIFICATE-----\n");
        rustls::pki_types::CertificateDer::from_pem_slice(pem.as_bytes()).expect("PEM").to_vec()
    }

    #[test]
    fn the_end_of_a_certificate_is_read_in_both_forms_and_of_what_is_none_nothing_is() {
        let end = |pem: &str| not_after(&der(pem)).map(Utc::rfc3339);
        assert_eq!(end(UNTIL_2027).as_deref(), Some("2027-07-20T14:49:26.000Z"));
        assert_eq!(end(UNTIL_2067).as_deref(), Some("2067-12-17T14:49:26.000Z"));
        let whole = der(UNTIL_2027);
        for length in 0..whole.len() {
            not_after(&whole[..length]);
        }
        assert_eq!(not_after(&[0x30, 0x84, 0xff, 0xff, 0xff, 0xff]), None);
        assert_eq!(not_after(b"certificate"), None);
    }

    #[test]
    fn what_ends_soon_is_told_with_what_to_do() {
        let found = |days: u64| left("the server's", Utc(0).plus_ms(days * DAY_MS), Utc(0), 30, "look at the log");
        assert_eq!([found(30).good, found(29).good, found(0).good], [true, false, false]);
        assert_eq!(found(29).text, "the server's ends 1970-01-30T00:00:00.000Z, in 29 days; look at the log");
        assert_eq!(found(0).text, "the server's ENDED 1970-01-01T00:00:00.000Z; look at the log");
    }

    #[test]
    fn a_jump_of_the_servers_clock_wants_a_look_for_a_day() {
        let at = Utc(1_800_000_000_000);
        let found = jump("the server's", 7_200_500, at, at.plus_ms(DAY_MS));
        assert!(!found.good, "{}", found.text);
        assert!(
            found.text.starts_with("the server's jumped 7200 s ahead at 2027-01-15T08:00:00.000Z;"),
            "{}",
            found.text
        );
        let later = jump("the server's", -6_000, at, at.plus_ms(DAY_MS + 1));
        assert_eq!(
            (later.good, later.text.as_str()),
            (true, "the server's jumped 6 s back at 2027-01-15T08:00:00.000Z")
        );
    }

    #[test]
    fn a_server_that_signs_nothing_is_told_with_the_way_out() {
        let found = doubt(2_592_000_000, Utc(1_800_000_000_000));
        assert!(!found.good);
        assert!(
            found
                .text
                .starts_with("the server signs nothing since 2027-01-15T08:00:00.000Z: its clock is 2592000 s ahead"),
            "{}",
            found.text
        );
        assert!(found.text.contains("midshift doctor --accept-clock"), "{}", found.text);
    }

    #[test]
    fn a_server_whose_clock_is_off_is_told_of_by_how_much() {
        let mut answer = MetadataMap::new();
        assert!(clock("the server", &answer, Utc(0)).good, "it does not say its time");
        answer.insert("date", "Sun, 06 Nov 1994 08:49:37 GMT".parse().expect("text"));
        let at = |text: &str| clock("the server", &answer, Utc::parse_rfc3339(text).expect("a time"));
        assert!(at("1994-11-06T08:49:38Z").good && at("1994-11-06T08:49:34Z").good);
        let (ahead, behind) = (at("1994-11-06T08:48:37Z"), at("1994-11-06T09:49:37Z"));
        assert!(!ahead.good && ahead.text.starts_with("the server is 60 s ahead of this machine"), "{}", ahead.text);
        assert!(!behind.good && behind.text.starts_with("the server is 3600 s behind this machine"), "{}", behind.text);
    }
}
