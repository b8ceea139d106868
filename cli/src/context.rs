//! `midshift login`, `midshift context …`: which sites this person knows, and who one is there.
//!
//! Invariant: a token is never printed, and remembered only after it was shown to the site that its owner named.

use super::client::{Call, Exit, site_of, unary};
use super::contexts::{Context, Contexts, Unknown};
use super::door::Found;
use super::out::Out;
use crate::endpoint::Endpoint;
use anyhow::Context as _;
use clap::{Args, Subcommand};
use console::Term;
use midshift_agent::tls;
use midshift_core::identity::Digest;
use midshift_proto::identity::v1::WhoAmIRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use std::io::{IsTerminal, Read};
use std::path::PathBuf;

/// `midshift login`.
#[derive(Debug, Args)]
pub struct Login {
    /// The server, host:port.
    server: String,
    /// Digest of the site's root, as the server printed it at its first start. The root itself is fetched and remembered.
    #[arg(long, value_name = "DIGEST", required_unless_present = "ca")]
    pin: Option<Digest>,
    /// The site's root certificate instead, PEM.
    #[arg(long, value_name = "FILE", conflicts_with = "pin")]
    ca: Option<PathBuf>,
    /// What the site is remembered as.
    #[arg(long, default_value = "default")]
    name: String,
    /// The stop service, host:port, if it is not on port 7421 of the same host.
    #[arg(long, value_name = "HOST:PORT")]
    stop_server: Option<String>,
    /// Where the token is. Without it MIDSHIFT_TOKEN, or standard input.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

/// Verbs of contexts.
#[derive(Subcommand)]
pub enum Verb {
    /// Which sites are known, and which one is used.
    Ls,
    /// Use this one from now on.
    Use {
        /// Its name.
        name: String,
    },
    /// Forget this one. Its token stays good: revoke it if nobody needs it.
    Rm {
        /// Its name.
        name: String,
    },
    /// Who you are there, and what you may do.
    Show {
        #[command(flatten)]
        call: Call,
    },
}

fn token(file: Option<&PathBuf>, out: &Out) -> Result<String, Exit> {
    if let Some(file) = file {
        return Ok(std::fs::read_to_string(file)
            .with_context(|| format!("reading {}", file.display()))?
            .trim()
            .to_owned());
    }
    if let Ok(token) = std::env::var("MIDSHIFT_TOKEN") {
        return Ok(token.trim().to_owned());
    }
    if std::io::stdin().is_terminal() {
        out.inform("The token, then Enter (it is not shown):");
        let line = Term::stderr().read_secure_line().context("reading the token")?;
        if line.trim().is_empty() {
            return Err(Exit::usage("no token was typed; --token-file and MIDSHIFT_TOKEN need no terminal"));
        }
        return Ok(line.trim().to_owned());
    }
    let mut text = String::new();
    std::io::stdin().read_to_string(&mut text).context("reading the token")?;
    Ok(text.trim().to_owned())
}

/// Proves the server by its root and the token by asking who it is, and remembers both.
pub async fn login(args: Login, out: &Out) -> Result<(), Exit> {
    let authority_pem = match (&args.ca, args.pin) {
        (Some(file), _) => std::fs::read_to_string(file).with_context(|| format!("reading {}", file.display()))?,
        (None, Some(pin)) => {
            tls::authority_of(&args.server, pin).await.map_err(|error| Exit::new(5, error.to_string()))?
        }
        (None, None) => return Err(Exit::usage("--pin or --ca says which site this is")),
    };
    let token = token(args.token_file.as_ref(), out)?;
    let endpoint = Endpoint::secure(&args.server, &authority_pem, Some(&token))?;
    let line = endpoint.connect().await.map_err(|error| no_server(&args.server, &error))?;
    let me = IdentityServiceClient::new(line.clone()).who_am_i(unary(WhoAmIRequest {})).await?.into_inner();
    let mut contexts = Contexts::read()?;
    let stop_server = match args.stop_server {
        None => site_of(line).await.and_then(|said| said.unusual_stop_server(&args.server)),
        named => named,
    };
    let site_id = Some(me.site_id.clone());
    let context = Context { server: args.server, stop_server, site_id, authority_pem, token };
    contexts.context.insert(args.name.clone(), context);
    contexts.current = Some(args.name.clone());
    contexts.write()?;
    out.inform(&format!(
        "signed in to {} as {} ({}), remembered as {}",
        me.site_id,
        me.actor,
        me.grants.join(", "),
        args.name
    ));
    Ok(())
}

/// What was found where the server should be.
fn no_server(server: &str, error: &midshift_agent::dial::Error) -> Exit {
    let found = Found::by(&*error.0);
    let why = match (found, found.help()) {
        (_, Some(help)) => help.to_owned(),
        (Found::Nothing, None) => {
            "nothing listens there\n  try: look at the address and at whether the server runs".to_owned()
        }
        (Found::OtherSite, None) => {
            "it has another root\n  try: the digest that this server printed, with --pin".to_owned()
        }
        (_, None) => error.to_string(),
    };
    Exit::new(found.exit_code(), format!("no server of this site at {server}: {why}"))
}

/// Runs a verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    let mut contexts = Contexts::read()?;
    match verb {
        Verb::Ls => {
            for (name, context) in &contexts.context {
                let mark = if contexts.current.as_ref() == Some(name) { "*" } else { " " };
                out.line(&format!("{mark} {name}  {}", context.server));
            }
            Ok(())
        }
        Verb::Use { name } => {
            if !contexts.context.contains_key(&name) {
                return Err(Unknown(name).into());
            }
            contexts.current = Some(name);
            Ok(contexts.write()?)
        }
        Verb::Rm { name } => {
            contexts.context.remove(&name).ok_or_else(|| Unknown(name.clone()))?;
            contexts.current = contexts.current.filter(|current| *current != name);
            Ok(contexts.write()?)
        }
        Verb::Show { call } => {
            let me = call.identity().await?.who_am_i(unary(WhoAmIRequest {})).await?.into_inner();
            out.one(&me, &me.actor, || {
                let grants =
                    if me.grants.is_empty() { "everything: no login".to_owned() } else { me.grants.join(", ") };
                format!("site   {}\nactor  {}\nrights {grants}", me.site_id, me.actor)
            })?;
            Ok(())
        }
    }
}
