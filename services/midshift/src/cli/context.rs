//! `midshift login`, `midshift context …`: which sites this person knows, and the token for each.
//!
//! Invariant: the file is its owner's alone (0600), written whole or not at all; a token is never printed.

use super::client::{Call, Exit, unary};
use super::out::Out;
use crate::way::Way;
use anyhow::Context as _;
use clap::{Args, Subcommand};
use midshift_agent::tls;
use midshift_core::identity::Digest;
use midshift_proto::identity::v1::WhoAmIRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{IsTerminal, Read, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::PathBuf;

/// Where the file is, if not in the usual place.
const FILE_VARIABLE: &str = "MIDSHIFT_CONTEXTS";

/// What is known of one site.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Context {
    /// The server, host:port.
    pub server: String,
    /// The stop service, host:port, if it is not on port 7421 of the same host.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop_server: Option<String>,
    /// The site's root, PEM.
    pub authority_pem: String,
    /// What is shown there.
    pub token: String,
}

/// All of them.
#[derive(Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Contexts {
    /// Which one is used if none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub current: Option<String>,
    /// By name.
    #[serde(default)]
    pub context: BTreeMap<String, Context>,
}

fn path() -> anyhow::Result<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    if let Some(file) = set(FILE_VARIABLE) {
        return Ok(file);
    }
    let folder = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|home| home.join(".config")));
    let folder =
        folder.with_context(|| format!("neither HOME nor {FILE_VARIABLE} is set: where would sites be remembered?"))?;
    Ok(folder.join("midshift/contexts.toml"))
}

impl Contexts {
    /// As they were written; empty if there is no file.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read() -> anyhow::Result<Self> {
        let Ok(path) = path() else { return Ok(Self::default()) };
        let doing = || format!("reading {}", path.display());
        match std::fs::read_to_string(&path) {
            Ok(text) => {
                let found = std::fs::metadata(&path).with_context(doing)?;
                // Said, and no more: somebody may have to stop a fleet by it.
                if found.is_file() && found.permissions().mode() & 0o077 != 0 {
                    tracing::warn!(path = %path.display(), "it has tokens and is open to others: chmod 600 it");
                }
                toml::from_str(&text).with_context(doing)
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error).with_context(doing),
        }
    }

    fn write(&self) -> anyhow::Result<()> {
        let path = path()?;
        let folder = path.parent().context("the file is in no folder")?;
        std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
        let new = path.with_extension("new");
        let _ = std::fs::remove_file(&new);
        let written = || -> std::io::Result<()> {
            let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(&new)?;
            file.write_all(toml::to_string(self).map_err(std::io::Error::other)?.as_bytes())?;
            file.sync_all()?;
            std::fs::rename(&new, &path)
        };
        written().with_context(|| format!("writing {}", path.display()))
    }

    /// The one with this name, or the current one; none: nobody has signed in.
    ///
    /// # Errors
    /// The name is not known.
    pub fn pick(&self, name: Option<&str>) -> Result<Option<&Context>, Exit> {
        match name.or(self.current.as_deref()) {
            None => Ok(None),
            Some(name) => self.context.get(name).map(Some).ok_or_else(|| unknown(name)),
        }
    }
}

fn unknown(name: &str) -> Exit {
    Exit::new(4, format!("no context {name}\n  try: midshift context ls, or midshift login"))
}

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
        out.say("The token, then Enter:");
        let mut line = String::new();
        std::io::stdin().read_line(&mut line).context("reading the token")?;
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
    let way = Way::secure(&args.server, &authority_pem, Some(&token))?;
    let line = way
        .connect()
        .await
        .map_err(|error| Exit::new(5, format!("no server of this site at {}: {error}", args.server)))?;
    let me = IdentityServiceClient::new(line).who_am_i(unary(WhoAmIRequest {})).await?.into_inner();
    let mut contexts = Contexts::read()?;
    let context = Context { server: args.server, stop_server: args.stop_server, authority_pem, token };
    contexts.context.insert(args.name.clone(), context);
    contexts.current = Some(args.name.clone());
    contexts.write()?;
    out.say(&format!(
        "signed in to {} as {} ({}), remembered as {}",
        me.site_id,
        me.actor,
        me.grants.join(", "),
        args.name
    ));
    Ok(())
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
                return Err(unknown(&name));
            }
            contexts.current = Some(name);
            Ok(contexts.write()?)
        }
        Verb::Rm { name } => {
            contexts.context.remove(&name).ok_or_else(|| unknown(&name))?;
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
