//! Who may do what on a site, and from where it can be reached: certificates of robots, tokens, ports.

use super::finding::{DAY_MS, Finding};
use super::shown::left;
use crate::client::{Call, Exit, Resolved, unary};
use crate::pages::{self, PAGE_SIZE};
use midshift_core::limits;
use midshift_core::time::Utc;
use midshift_proto::convert::time_of;
use midshift_proto::identity::v1::{ListRobotIdentitiesRequest, ListTokensRequest, RobotIdentity, Token};
use std::net::IpAddr;

/// People are told so long before a token ends.
const TOKEN_LEFT_DAYS: u64 = 14;
/// A robot tries each minute to renew its certificate once half of its life is over; a day later it has not managed to.
const RENEWAL_LATE_MS: u64 = DAY_MS;
/// So many names are told.
const NAMES_MAX: usize = 5;

/// Certificates of robots and tokens; a word if they cannot be asked for.
pub async fn identities(call: &Call, resolved: &Resolved, now: Utc) -> Vec<Finding> {
    if !resolved.is_secure() {
        return Vec::new();
    }
    match listed(call).await {
        Ok((robots, tokens)) => [of_robots(&robots, now), of_tokens(&tokens, now)].into(),
        Err(exit) if exit.code() == 6 => {
            vec![Finding::good("tokens", "robots' certificates and tokens are shown to the role admin alone")]
        }
        Err(exit) => {
            vec![Finding::wants_look("tokens", format!("robots' certificates and tokens cannot be read: {exit}"))]
        }
    }
}

async fn listed(call: &Call) -> Result<(Vec<RobotIdentity>, Vec<Token>), Exit> {
    let client = call.identity().await?;
    let robots = async |page_token| {
        let request = ListRobotIdentitiesRequest { page_size: PAGE_SIZE, page_token, ..Default::default() };
        client.clone().list_robot_identities(unary(request)).await
    };
    let tokens = async |page_token| {
        let request = ListTokensRequest { page_size: PAGE_SIZE, page_token };
        client.clone().list_tokens(unary(request)).await
    };
    Ok((pages::all(robots).await?.robots, pages::all(tokens).await?.tokens))
}

/// The soonest end of a robot's certificate, and who should have renewed it.
fn of_robots(robots: &[RobotIdentity], now: Utc) -> Finding {
    let enrolled = robots.iter().filter(|robot| robot.revoke_time.is_none() && !robot.key_sha256.is_empty());
    let mut ends: Vec<(Utc, &str)> =
        enrolled.filter_map(|robot| Some((time_of(robot.expire_time.as_ref()?), robot.robot_id.as_str()))).collect();
    ends.sort_unstable();
    let Some((soonest, robot_id)) = ends.first() else { return Finding::good("certificates", "no robot is enrolled") };
    let half = limits::ROBOT_CERTIFICATE_VALID.as_ms() / 2;
    let late = ends.iter().filter(|(end, _)| end.ms_since(now) + RENEWAL_LATE_MS < half).map(|(_, id)| *id);
    let late: Vec<&str> = late.collect();
    let whose = format!("of {} robots the soonest, {robot_id}'s,", ends.len());
    let told = left(&whose, *soonest, now, 0, "it is let in nowhere");
    if late.is_empty() {
        return told;
    }
    let then = "look whether they reach the server; one whose certificate has ended needs `midshift robot enroll`";
    Finding::wants_look("certificates", format!("{}; not renewed in time: {}; {then}", told.text, names(&late)))
}

/// Tokens that are good, those that end soon, and what they may do everywhere.
fn of_tokens(tokens: &[Token], now: Utc) -> Finding {
    let end = |token: &Token| token.expire_time.as_ref().map_or(Utc(0), time_of);
    let good: Vec<&Token> = tokens.iter().filter(|t| t.revoke_time.is_none() && end(t) > now).collect();
    let is_wide = |token: &&&Token| token.grants.iter().any(|grant| !grant.contains('@'));
    let wide = good.iter().filter(is_wide).count();
    let soon: Vec<&str> =
        good.iter().filter(|t| end(t).ms_since(now) < TOKEN_LEFT_DAYS * DAY_MS).map(|t| t.name.as_str()).collect();
    let mut text = format!("{} tokens are good, {wide} of them with a role for the whole site (no @AREA)", good.len());
    let twins = twins(&good);
    if !soon.is_empty() {
        let soon = names(&soon);
        text +=
            &format!("; within {TOKEN_LEFT_DAYS} days end: {soon}; replace them in time: midshift token rotate NAME");
    }
    if !twins.is_empty() {
        let twins = names(&twins);
        text += &format!(
            "; more than one is good of the name: {twins}; revoke those that nobody uses: midshift token revoke TOKEN_ID"
        );
    }
    if soon.is_empty() && twins.is_empty() {
        Finding::good("tokens", text)
    } else {
        Finding::wants_look("tokens", text)
    }
}

/// Names that more than one good token has: an older release made them.
fn twins<'a>(good: &[&'a Token]) -> Vec<&'a str> {
    let mut all: Vec<&str> = good.iter().map(|token| token.name.as_str()).collect();
    all.sort_unstable();
    let mut twins: Vec<&str> = all.windows(2).filter(|two| two[0] == two[1]).map(|two| two[0]).collect();
    twins.dedup();
    twins
}

fn names(all: &[&str]) -> String {
    let more = all.len().saturating_sub(NAMES_MAX);
    let named = all.iter().take(NAMES_MAX).copied().collect::<Vec<_>>().join(", ");
    if more == 0 { named } else { format!("{named} and {more} more") }
}

/// Whether whoever reaches the port must prove who it is.
pub fn exposure(resolved: &Resolved) -> Finding {
    let host = resolved.server.rsplit_once("://").map_or(resolved.server.as_str(), |(_, rest)| rest);
    let host = host.rsplit_once(':').map_or(host, |(host, _)| host).trim_matches(['[', ']']);
    let is_loopback = host == "localhost" || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
    match (resolved.is_secure(), is_loopback) {
        (true, _) => Finding::good("exposure", "TLS and login"),
        (false, true) => {
            Finding::good("exposure", "plain text without login, on this machine alone: for trying things")
        }
        (false, false) => Finding::wants_look(
            "exposure",
            "plain text without login, and not on this machine alone: whoever reaches the port commands the fleet; leave --insecure away and sign in",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::convert::timestamp;

    const NOW: Utc = Utc(1_800_000_000_000);

    fn robot(robot_id: &str, left_ms: i64) -> RobotIdentity {
        RobotIdentity {
            robot_id: robot_id.to_owned(),
            key_sha256: "5e".to_owned(),
            expire_time: Some(timestamp(Utc(NOW.0 + left_ms))),
            ..RobotIdentity::default()
        }
    }

    fn token(name: &str, grants: &[&str], days: i64) -> Token {
        Token {
            name: name.to_owned(),
            grants: grants.iter().map(|grant| (*grant).to_owned()).collect(),
            expire_time: Some(timestamp(Utc(NOW.0 + days * DAY_MS.cast_signed()))),
            ..Token::default()
        }
    }

    #[test]
    fn the_soonest_certificate_of_a_robot_is_told_and_who_is_late_to_renew() {
        const HOUR: i64 = 3_600_000;
        let on_time = of_robots(&[robot("r1", 100 * HOUR), robot("r2", 61 * HOUR)], NOW);
        assert!(on_time.good && on_time.text.starts_with("of 2 robots the soonest, r2's, ends"), "{}", on_time.text);
        let late = of_robots(&[robot("r1", 100 * HOUR), robot("r2", 59 * HOUR), robot("r3", -HOUR)], NOW);
        assert!(
            !late.good && late.text.contains("r3's, ENDED") && late.text.contains("in time: r3, r2;"),
            "{}",
            late.text
        );
        let mut revoked = robot("r1", -HOUR);
        revoked.revoke_time = Some(timestamp(NOW));
        assert_eq!(of_robots(&[revoked], NOW).text, "no robot is enrolled");
    }

    #[test]
    fn tokens_that_end_soon_are_named_and_those_for_the_whole_site_counted() {
        let good =
            [token("anna", &["operator@packing"], 90), token("root", &["admin"], 90), token("old", &["viewer"], -1)];
        let found = of_tokens(&good, NOW);
        assert_eq!(
            (found.good, found.text.as_str()),
            (true, "2 tokens are good, 1 of them with a role for the whole site (no @AREA)")
        );
        let found = of_tokens(&[token("wall", &["stop-only"], 13)], NOW);
        assert!(!found.good && found.text.contains("within 14 days end: wall;"), "{}", found.text);
        let twins = [token("anna", &["viewer"], 90), token("bert", &["viewer"], 90), token("anna", &["viewer"], 90)];
        let found = of_tokens(&twins, NOW);
        assert!(!found.good && found.text.contains("more than one is good of the name: anna;"), "{}", found.text);
        assert_eq!(names(&["a", "b", "c", "d", "e", "f", "g"]), "a, b, c, d, e and 2 more");
    }

    #[test]
    fn plain_text_that_others_can_reach_wants_a_look() {
        let good = |server: &str| exposure(&Resolved::plain(server)).good;
        assert!(
            good("127.0.0.1:7420") && good("[::1]:7420") && good("localhost:7420") && good("http://127.0.0.1:7420")
        );
        assert!(!good("fleet.local:7420") && !good("10.0.0.7:7420"));
    }
}
