//! `midshift certificate …`: what programs that are none of ours prove themselves with: the proxy before several processes, and the database behind them.
//!
//! Invariant: a proxy's comes the way every process of a site gets its own: the key is drawn here and stays here, and the store carries the request and the answer.
//! So whoever reaches the store may ask, nobody else, and the audit has it. A database is older than the site's authority, so it has one of its own,
//! whose key signs twice and is thrown away.

use anyhow::Context;
use clap::Subcommand;
use midshift_cli::client::Exit;
use midshift_cli::out::Out;
use midshift_cli::site_file;
use midshift_core::limits;
use midshift_core::time::Clock;
use midshift_identity::{Duty, IdentityService, PUBLIC_FILE, Parts};
use midshift_process::clock;
use midshift_server::keep_limits::KeepLimits;
use midshift_server::storage::Database;
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

/// Certificates and key, as HAProxy reads them.
const FILE: &str = "server.pem";

/// Verbs of certificates.
#[derive(Subcommand)]
pub enum Verb {
    /// One of the site's authority for a proxy; renewed by asking again, once more than half of its life is over.
    Get(Get),
    /// Certificates by which a PostgreSQL server and midshift know each other, of an authority of their own that signs nothing else, ever. They do not end by
    /// themselves: make new ones when somebody may have had the keys. What is there already is left alone.
    Database(Pair),
}

/// For whom, and where it goes.
#[derive(clap::Args)]
pub struct Get {
    /// Host name or address under which others reach that program; more than one may be given. midshift, localhost and the loopback addresses are always in it.
    #[arg(long = "name", value_name = "NAME", required = true)]
    names: Vec<String>,
    /// The folder of its keys, for its owner alone; made with mode 0700. It gets server.pem (certificate, the site's root, key) and ca.pem (the root).
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The site file, as for `midshift serve`. Without it the built-in demo site.
    #[arg(long)]
    site: Option<PathBuf>,
    /// The store of the site, in which a process with role identity answers.
    #[command(flatten)]
    database: Database,
}

/// Between which two.
#[derive(clap::Args)]
pub struct Pair {
    /// Host name or address of the database, as addresses of it say; more than one may be given.
    #[arg(long = "host", value_name = "HOST", required = true)]
    hosts: Vec<String>,
    /// The database's user that midshift is.
    #[arg(long, value_name = "NAME", default_value = "midshift")]
    user: String,
    /// Where the server's go: server.crt, server.key (for its owner alone, as PostgreSQL wants it), root.crt, and pg_hba.conf, which lets nobody in over the network
    /// who shows no certificate.
    #[arg(long, value_name = "DIR")]
    server_out: PathBuf,
    /// Where midshift's go: client.crt, client.key (also for its group), root.crt.
    #[arg(long, value_name = "DIR")]
    client_out: PathBuf,
}

/// Runs a verb.
pub async fn run(verb: Verb, stop: CancellationToken, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Get(args) => get(args, stop, out).await,
        Verb::Database(args) => Ok(pair(&args, out)?),
    }
}

/// Who comes in to the database, and how. Its own container or machine is its own affair.
fn access(user: &str) -> String {
    format!("local all all trust\nhostssl all {user} all scram-sha-256 clientcert=verify-full\n")
}

fn pair(args: &Pair, out: &Out) -> anyhow::Result<()> {
    let done = args.client_out.join("root.crt");
    if done.exists() {
        out.inform(&format!("{} is there already: nothing is changed", done.display()));
        return Ok(());
    }
    let (issuer, root) = throwaway().context("making an authority")?;
    let mut server = CertificateParams::new(args.hosts.as_slice()).context("a host is none")?;
    server.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    let mut client = CertificateParams::default();
    client.distinguished_name = named(&args.user);
    client.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
    for folder in [&args.server_out, &args.client_out] {
        midshift_durable::make_folder(folder).with_context(|| format!("making {}", folder.display()))?;
    }
    let sign = |params: CertificateParams| -> Result<(String, String), rcgen::Error> {
        let key = KeyPair::generate()?;
        Ok((params.signed_by(&key, &issuer)?.pem(), key.serialize_pem()))
    };
    let (chain, key) = sign(server).context("signing for the server")?;
    write_file(&args.server_out.join("server.key"), &key, 0o600)?;
    write_file(&args.server_out.join("server.crt"), &chain, 0o644)?;
    write_file(&args.server_out.join("pg_hba.conf"), &access(&args.user), 0o644)?;
    write_file(&args.server_out.join("root.crt"), &root, 0o644)?;
    let (chain, key) = sign(client).context("signing for midshift")?;
    write_file(&args.client_out.join("client.key"), &key, 0o640)?;
    write_file(&args.client_out.join("client.crt"), &chain, 0o644)?;
    // The last one: whoever finds it finds all of them.
    write_file(&done, &root, 0o644)?;
    out.line(&args.server_out.display().to_string());
    out.line(&args.client_out.display().to_string());
    Ok(())
}

/// An authority that is forgotten with this process, and its certificate.
fn throwaway() -> Result<(Issuer<'static, KeyPair>, String), rcgen::Error> {
    let mut params = CertificateParams::default();
    params.distinguished_name = named("midshift database");
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    let key = KeyPair::generate()?;
    let root = params.self_signed(&key)?.pem();
    Ok((Issuer::new(params, key), root))
}

fn named(common: &str) -> DistinguishedName {
    let mut name = DistinguishedName::new();
    name.push(DnType::CommonName, common);
    name
}

/// Writes a file anew; what was left there by a call that did not come to its end goes.
fn write_file(path: &Path, text: &str, mode: u32) -> anyhow::Result<()> {
    let written = midshift_durable::replace_with(path, text.as_bytes(), mode);
    written.with_context(|| format!("writing {}", path.display()))
}

/// Asks, waits for the answer, and writes it; nothing changes while more than half of the life of the last one is left.
async fn get(args: Get, stop: CancellationToken, out: &Out) -> Result<(), Exit> {
    if args.database.store.is_none() {
        return Err(Exit::usage(
            "the way to the site's authority is its store: add --store, or set MIDSHIFT_STORE; a server on SQLite has its port alone and needs no proxy",
        ));
    }
    let site_id = site_file::load(args.site.as_deref(), None, None)?.site.site_id().clone();
    let clock: Arc<dyn Clock> = clock::clock(1000);
    let storage = args.database.open(&args.out, site_id, clock.clone(), KeepLimits::default().status_log_bytes).await?;
    let parts = Parts {
        folder: args.out.clone(),
        store: storage.store(),
        clock,
        duty: Duty::Member,
        names: args.names,
        trust_json: String::new(),
    };
    let identity = IdentityService::open(parts, &stop).await.context("asking for a certificate")?;
    let is_new = midshift_identity::write_proof(&identity.proof().borrow(), &args.out, FILE)
        .context("writing the certificate")?;
    storage.close().await;
    let file = args.out.join(FILE);
    if is_new {
        let days = limits::SERVER_CERTIFICATE_VALID.as_ms() / 86_400_000;
        out.line(&file.display().to_string());
        out.inform(&format!(
            "good for {days} days, renewed by the same command once half of them are over; what reads it must be told then. The site's root is in {PUBLIC_FILE} beside it"
        ));
    }
    Ok(())
}
