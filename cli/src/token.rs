//! `midshift token …`: rights of people and programs.

use super::client::{Call, Exit, unary};
use super::out::Out;
use super::pages::{self, PAGE_SIZE};
use crate::duration;
use clap::Subcommand;
use midshift_agent::clock;
use midshift_core::identity::Grant;
use midshift_core::time::Utc;
use midshift_proto::convert::time_of;
use midshift_proto::identity::v1;
use std::collections::BTreeMap;
use std::time::Duration;

/// Verbs of tokens.
#[derive(Subcommand)]
pub enum Verb {
    /// Make one. It is printed once and kept nowhere.
    Create {
        #[command(flatten)]
        call: Call,
        /// Who it stands for: decisions are recorded under this name, which no other token that stands may have.
        name: String,
        /// The person who has it: with several tokens a person still approves nothing that it wrote. Without it the name stands for itself.
        #[arg(long, value_name = "NAME")]
        person: Option<String>,
        /// What it may do, ROLE or ROLE@AREA, more than one apart by commas: viewer, dispatcher, operator, ota-author, ota-approver, ota-full-push, stop-only, stop-resetter,
        /// admin, auditor.
        #[arg(long, value_delimiter = ',', required = true)]
        role: Vec<Grant>,
        /// How long it is good, at most 366d.
        #[arg(long, value_parser = duration, default_value = "90d")]
        valid: Duration,
    },
    /// Replace one: a new secret with the same name, rights and person, printed once. The old one ends at once, or after --overlap.
    Rotate {
        #[command(flatten)]
        call: Call,
        /// The name.
        name: String,
        /// The old one is good for so long more, at most 7d: for programs that get the new one meanwhile.
        #[arg(long, value_parser = duration, default_value = "0s")]
        overlap: Duration,
        /// How long the new one is good, at most 366d. Without it as long as the old one was made for.
        #[arg(long, value_parser = duration)]
        valid: Option<Duration>,
        /// Protects against a double call: the same id and content are one request, whose secret is shown the first time alone.
        #[arg(long, default_value = "")]
        request_id: String,
    },
    /// List them, newest first.
    Ls {
        #[command(flatten)]
        call: Call,
    },
    /// Take one back, at once on every port.
    Revoke {
        #[command(flatten)]
        call: Call,
        /// Its id, as `token ls` shows it.
        token_id: String,
    },
}

fn at(time: Option<&prost_types::Timestamp>) -> String {
    time.map_or_else(|| "-".to_owned(), |time| time_of(time).rfc3339())
}

/// Says how it stands with a token, as of `now`; `twins`: so many of its name stand that were not replaced.
fn state(token: &v1::Token, twins: usize, now: Utc) -> String {
    match &token.revoke_time {
        Some(ends) if time_of(ends) > now => format!("good until {}, replaced by {}", at(Some(ends)), token.revoked_by),
        Some(_) => format!("revoked by {}", token.revoked_by),
        None if token.expire_time.as_ref().is_some_and(|end| time_of(end) <= now) => "over".to_owned(),
        None if twins > 1 => format!("good, one of {twins} of this name: revoke those that nobody uses"),
        None => "good".to_owned(),
    }
}

/// How many tokens of each name stand and were not replaced.
fn names(tokens: &[v1::Token], now: Utc) -> BTreeMap<&str, usize> {
    let stands = |token: &&v1::Token| {
        token.revoke_time.is_none() && token.expire_time.as_ref().is_some_and(|end| time_of(end) > now)
    };
    let mut names = BTreeMap::new();
    tokens.iter().filter(stands).for_each(|token| *names.entry(token.name.as_str()).or_default() += 1);
    names
}

fn row(token: &v1::Token, names: &BTreeMap<&str, usize>, now: Utc) -> Vec<String> {
    let state = state(token, names.get(token.name.as_str()).copied().unwrap_or_default(), now);
    let person = if token.person.is_empty() { "-".to_owned() } else { token.person.clone() };
    let ends = at(token.expire_time.as_ref());
    vec![token.token_id.clone(), token.name.clone(), person, token.grants.join(","), ends, state]
}

/// Runs a verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Create { call, name, person, role, valid } => {
            let grants = role.iter().map(ToString::to_string).collect();
            let (person, valid_seconds) = (person.unwrap_or_default(), valid.as_secs());
            let asked = v1::CreateTokenRequest { name, grants, valid_seconds, person };
            let made = call.identity().await?.create_token(unary(asked)).await?.into_inner();
            let token = made.token.clone().unwrap_or_default();
            out.one(&made, &made.secret, || made.secret.clone())?;
            out.next(&format!(
                "it is shown once; {} until {}",
                token.grants.join(", "),
                at(token.expire_time.as_ref())
            ));
            Ok(())
        }
        Verb::Rotate { call, name, overlap, valid, request_id } => {
            let (valid_seconds, overlap_seconds) = (valid.map_or(0, |valid| valid.as_secs()), overlap.as_secs());
            let asked = v1::RotateTokenRequest { name, valid_seconds, overlap_seconds, request_id };
            let made = call.identity().await?.rotate_token(unary(asked)).await?.into_inner();
            let token = made.token.clone().unwrap_or_default();
            if made.secret.is_empty() {
                out.one(&made, &token.token_id, || format!("{} is there", token.token_id))?;
                out.next("this request made it before and its secret was in that answer; lost it: rotate again");
                return Ok(());
            }
            out.one(&made, &made.secret, || made.secret.clone())?;
            let old = match overlap_seconds {
                0 => format!("{} is worth nothing any more", token.rotated_from),
                seconds => format!("{} is good for {seconds} s more", token.rotated_from),
            };
            out.next(&format!("it is shown once, and good until {}; {old}", at(token.expire_time.as_ref())));
            Ok(())
        }
        Verb::Ls { call } => {
            let mut client = call.identity().await?;
            let read = async |page_token| {
                let request = v1::ListTokensRequest { page_size: PAGE_SIZE, page_token };
                client.list_tokens(unary(request)).await
            };
            let all = pages::all(read).await?;
            let now = clock::wall();
            let names = names(&all.tokens, now);
            let header = ["TOKEN", "NAME", "PERSON", "RIGHTS", "UNTIL", "STATE"];
            Ok(out.many(&all, &all.tokens, |token| token.token_id.clone(), &header, |token| row(token, &names, now))?)
        }
        Verb::Revoke { call, token_id } => {
            let asked = v1::RevokeTokenRequest { token_id };
            let revoked = call.identity().await?.revoke_token(unary(asked)).await?.into_inner();
            let token = revoked.token.clone().unwrap_or_default();
            Ok(out.one(&revoked, &token.token_id, || {
                format!("{} of {} is worth nothing any more", token.token_id, token.name)
            })?)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::convert::timestamp;

    const NOW: Utc = Utc(1_800_000_000_000);

    fn token(name: &str, left_ms: i64, revoked_ms: Option<i64>) -> v1::Token {
        let at = |ms: i64| Some(timestamp(Utc(NOW.0 + ms)));
        let (expire_time, revoke_time) = (at(left_ms), revoked_ms.and_then(at));
        v1::Token {
            name: name.to_owned(),
            expire_time,
            revoke_time,
            revoked_by: "bert".to_owned(),
            ..Default::default()
        }
    }

    #[test]
    fn a_list_says_of_each_token_whether_it_is_good_and_whose_name_another_one_has_too() {
        let all = [
            token("anna", 1, None),
            token("anna", 1, None),
            token("wall", 1, None),
            token("wall", 1, Some(5)),
            token("wall", 1, Some(-5)),
            token("old", -1, None),
        ];
        let names = names(&all, NOW);
        let said: Vec<String> = all.iter().map(|token| row(token, &names, NOW).remove(5)).collect();
        let twin = "good, one of 2 of this name: revoke those that nobody uses";
        let rotated = format!("good until {}, replaced by bert", Utc(NOW.0 + 5).rfc3339());
        assert_eq!(said, [twin, twin, "good", &rotated, "revoked by bert", "over"]);
    }
}
