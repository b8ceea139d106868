//! `midshift token …`: rights of people and programs.

use super::client::{Call, Exit, unary};
use super::out::Out;
use crate::duration::duration;
use clap::Subcommand;
use midshift_core::identity::Grant;
use midshift_proto::convert::time_of;
use midshift_proto::identity::v1;
use std::time::Duration;

/// Verbs of tokens.
#[derive(Subcommand)]
pub enum Verb {
    /// Make one. It is printed once and kept nowhere.
    Create {
        #[command(flatten)]
        call: Call,
        /// Who it stands for: decisions are recorded under this name.
        name: String,
        /// What it may do, ROLE or ROLE@AREA, more than one apart by commas: viewer, dispatcher, operator, ota-author, ota-approver, stop-only, stop-resetter,
        /// admin, auditor.
        #[arg(long, value_delimiter = ',', required = true)]
        role: Vec<Grant>,
        /// How long it is good, at most 366d.
        #[arg(long, value_parser = duration, default_value = "90d")]
        valid: Duration,
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
        /// Which.
        token_id: String,
    },
}

fn at(time: Option<&prost_types::Timestamp>) -> String {
    time.map_or_else(|| "-".to_owned(), |time| time_of(time).rfc3339())
}

fn row(token: &v1::Token) -> Vec<String> {
    let state = match &token.revoke_time {
        Some(_) => format!("revoked by {}", token.revoked_by),
        None => "good".to_owned(),
    };
    vec![token.token_id.clone(), token.name.clone(), token.grants.join(","), at(token.expire_time.as_ref()), state]
}

/// Runs a verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Create { call, name, role, valid } => {
            let grants = role.iter().map(ToString::to_string).collect();
            let asked = v1::CreateTokenRequest { name, grants, valid_seconds: valid.as_secs() };
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
        Verb::Ls { call } => {
            let mut client = call.identity().await?;
            let mut asked = v1::ListTokensRequest { page_size: 1_000, ..v1::ListTokensRequest::default() };
            let mut all = v1::ListTokensResponse::default();
            loop {
                let page = client.list_tokens(unary(asked.clone())).await?.into_inner();
                all.tokens.extend(page.tokens);
                if page.next_page_token.is_empty() {
                    break;
                }
                asked.page_token = page.next_page_token;
            }
            let header = ["TOKEN", "NAME", "RIGHTS", "UNTIL", "STATE"];
            Ok(out.many(&all, &all.tokens, |token| token.token_id.clone(), &header, row)?)
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
