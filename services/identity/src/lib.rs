//! Identity of a site: its certificate authority, enrolment of robots, tokens of people and programs, and the audit.
//!
//! Invariants:
//! 1. A secret leaves this crate once, in the answer to the caller that it was made for. Only its digest is stored.
//! 2. One process of a site holds the authority's key and signs with it.
//! 3. Every process has a projection of the known principals, and a key of its own.

pub mod audit;
mod certificate_authority;
mod encode;
mod error;
mod files;
mod grpc;
mod machines;
mod proof;
mod register;
pub mod restored;
mod retention;
mod revocation_list;
mod tokens;

pub use certificate_authority::PUBLIC_FILE;
pub use error::Error;
pub use files::{FOLDER, make_folder};
pub use midshift_core::identity::ServerProof;
pub use proof::write_proof;
pub use retention::prune;
pub use revocation_list::RevocationList;

use certificate_authority::{CertificateAuthority, read_signing_request};
use error::ANSWERED_WITHIN;
use midshift_core::Boxed;
use midshift_core::audit::Note;
use midshift_core::identity::{Directory, RootCertificate, Secret, ServerCertificate, revocations};
use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::time::{Clock, Utc};
use midshift_proto::identity::v1::enrolment_service_server::EnrolmentServiceServer;
use midshift_proto::identity::v1::identity_service_server::IdentityServiceServer;
use midshift_store::Store;
use proof::OwnKey;
use register::{Register, decided, written};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// Rows are looked at so often although nobody woke us, link clock: time alone changes who is known.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// What identity is made of.
pub struct Parts {
    /// Where its keys are, for its owner alone; made if it is not there.
    pub folder: PathBuf,
    /// The rows.
    pub store: Arc<dyn Store>,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// Whether this process has the site's authority.
    pub duty: Duty,
    /// Host names and addresses of this process, beside those every server has.
    pub names: Vec<String>,
    /// What enrolled robots are told to trust for software, JSON; empty: nothing.
    pub trust_json: String,
}

/// What a process does for others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Duty {
    /// It has the authority's key, signs, and serves identity.
    CertificateAuthority,
    /// It asks.
    Member,
}

/// Names that every server of a site answers to: clients that pin the root ask for the first.
pub const NAMES: [&str; 4] = ["midshift", "localhost", "127.0.0.1", "::1"];

struct Inner {
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    store: Arc<dyn Store>,
    register: Register,
    authority: Option<CertificateAuthority>,
    own: OwnKey,
    proof: watch::Sender<ServerProof>,
    trust_json: String,
    /// What was taken back, of a process with the authority: beside its key, and in no backup.
    revoked: Option<RevocationList>,
    /// Held while a robot is enrolled.
    enrolling: tokio::sync::Mutex<()>,
}

/// Identity of one process. Clones are the same.
#[derive(Clone)]
pub struct IdentityService(Arc<Inner>);

impl IdentityService {
    /// Opens it; when this answers, the process has a certificate.
    ///
    /// # Errors
    /// Files, the store, or nobody who signs.
    pub fn open(parts: Parts, shutdown: &CancellationToken) -> Boxed<'_, Result<Self, Error>> {
        Box::pin(Self::opening(parts, shutdown))
    }

    async fn opening(parts: Parts, shutdown: &CancellationToken) -> Result<Self, Error> {
        let Parts { folder, store, clock, duty, names, trust_json } = parts;
        files::make_folder(&folder)?;
        let site_id = store.site_id().clone();
        let register = Register::new(store.clone(), clock.clone());
        let authority = match duty {
            Duty::CertificateAuthority => Some(own_authority(&folder, &site_id, &register, clock.now().wall).await?),
            Duty::Member => None,
        };
        let mut all: Vec<String> = NAMES.map(str::to_owned).into();
        all.extend(names.into_iter().filter(|name| !NAMES.contains(&name.as_str())));
        all.truncate(limits::SERVER_NAMES_MAX);
        let own = OwnKey::open(&folder, all)?;
        // By a wall in doubt an old certificate is better than a new one; without any there is nothing to serve with.
        if clock.doubt().is_none() || own.proof(&register).await?.is_none() {
            own.ask(&register, clock.now().wall).await?;
            if let Some(authority) = &authority {
                answer(authority, &register, clock.now().wall).await?;
            }
        }
        let proof = waited_for(&own, &register, &*store, shutdown).await?;
        files::write(&folder, PUBLIC_FILE, &proof.authority_pem, files::PUBLIC)?;
        let proof = watch::Sender::new(proof);
        let revoked = authority.is_some().then(|| RevocationList::new(&folder));
        Ok(Self(Arc::new(Inner {
            site_id,
            clock,
            store,
            register,
            authority,
            own,
            proof,
            trust_json,
            revoked,
            enrolling: tokio::sync::Mutex::default(),
        })))
    }

    /// Keeps up with the rows, signs what servers ask for, and renews its own certificate, until `shutdown`.
    pub fn run(&self, shutdown: CancellationToken) -> Boxed<'_, ()> {
        Box::pin(self.running(shutdown))
    }

    async fn running(&self, shutdown: CancellationToken) {
        let (mut wake, mut tick) = (self.0.store.wake(), tokio::time::interval(LOOK_EVERY));
        let mut failing = false;
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return,
                _ = tick.tick() => {}
                changed = wake.changed() => if changed.is_err() { return },
            }
            let kept = self.keep_up().await;
            if let (Err(error), false) = (&kept, failing) {
                tracing::warn!(%error, "identity does not keep up with its rows");
            }
            failing = kept.is_err();
            metrics::gauge!("midshift_identity_failing").set(f64::from(u8::from(failing)));
        }
    }

    async fn keep_up(&self) -> Result<(), Error> {
        let inner = &*self.0;
        inner.register.refresh().await.map_err(Error::Store)?;
        // A certificate that begins and ends by a wrong wall is none once the wall is right.
        if let Ok(now) = inner.clock.undoubted() {
            inner.own.ask(&inner.register, now.wall).await?;
            if let Some(authority) = &inner.authority {
                answer(authority, &inner.register, now.wall).await?;
            }
        }
        if let Some(proof) = inner.own.proof(&inner.register).await? {
            inner.proof.send_if_modified(|known| {
                let differs = *known != proof;
                *known = proof;
                differs
            });
        }
        match &inner.revoked {
            Some(list) => self.append_revocations(list).await,
            None => Ok(()),
        }
    }

    /// Appends to a list what the rows say as taken back and it has not, durably. Called for the list beside the authority before whoever takes something
    /// back is answered, and by whoever keeps a copy of it elsewhere.
    ///
    /// # Errors
    /// The store, or the disk.
    pub fn append_revocations<'a>(&'a self, list: &'a RevocationList) -> Boxed<'a, Result<(), Error>> {
        Box::pin(async {
            let revoked = self.0.register.ask(|view| {
                revocations(view.tokens.values().map(|(token, _)| token), view.robots.values().map(|(robot, _)| robot))
            });
            list.append(&revoked.await.map_err(Error::Store)?).await
        })
    }

    /// What ports may know of people, programs and robots.
    pub fn directory(&self) -> watch::Receiver<Arc<Directory>> {
        self.0.register.directory()
    }
    /// What this process proves itself with.
    pub fn proof(&self) -> watch::Receiver<ServerProof> {
        self.0.proof.subscribe()
    }
    /// With rights and robots, and with enrolment, of a process with the authority.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let identity = IdentityServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        let enrolment = EnrolmentServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes
            .add_service(identity.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
            .add_service(enrolment.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
    }

    /// The first token of a site that has none: may do everything. None if there is one.
    ///
    /// # Errors
    /// The store does not answer.
    pub fn first_token(&self) -> Boxed<'_, Result<Option<String>, Error>> {
        Box::pin(async {
            let first = tokens::first(&self.0.register, self.0.clock.now().wall).await?;
            Ok(first.map(|secret| secret.reveal(Secret::TOKEN)))
        })
    }

    /// Another such token, for whoever has lost the first one and has the machine.
    ///
    /// # Errors
    /// The store does not answer.
    pub fn spare_token(&self) -> Boxed<'_, Result<String, Error>> {
        Box::pin(async { Ok(tokens::spare(&self.0.register, self.0.clock.now().wall).await?.reveal(Secret::TOKEN)) })
    }
}

/// The authority in the folder: the one the rows know, or a first one.
async fn own_authority(
    folder: &Path,
    site_id: &SiteId,
    register: &Register,
    now: Utc,
) -> Result<CertificateAuthority, Error> {
    let known = register.ask(|view| view.authority.as_ref().map(|(row, _)| row.certificate_pem.clone()));
    let (known, found) = (known.await.map_err(Error::Store)?, CertificateAuthority::load(folder, site_id)?);
    let other = || Error::OtherCertificateAuthority { path: folder.to_owned() };
    let authority = match (known, found) {
        (Some(known), Some(found)) if found.certificate_pem() == known => return Ok(found),
        (Some(_), _) => return Err(other()),
        (None, Some(found)) => found,
        (None, None) => CertificateAuthority::make(folder, site_id, now)?,
    };
    let row = RootCertificate { site_id: site_id.clone(), certificate_pem: authority.certificate_pem().to_owned() };
    let told = register.decide(|view| match &view.authority {
        None => Ok((Some(written(&row, None, "midshift", "authority.made")), true)),
        Some((known, _)) => Ok((None, known.certificate_pem == row.certificate_pem)),
    });
    if told.await? { Ok(authority) } else { Err(other()) }
}

/// Signs what servers asked for.
async fn answer(authority: &CertificateAuthority, register: &Register, now: Utc) -> Result<(), Error> {
    let open = |row: &&ServerCertificate| row.chain_pem.is_none();
    let waiting =
        register.ask(|view| view.servers.values().map(|(row, _)| row).filter(open).cloned().collect::<Vec<_>>());
    for row in waiting.await.map_err(Error::Store)? {
        let signed = match read_signing_request(&row.request_pem) {
            Ok(request) => authority.sign_server(request, &row.names, now),
            Err(refusal) => Err(refusal.into()),
        };
        let signed = match signed {
            Ok(signed) => signed,
            Err(error) => {
                tracing::warn!(%error, key = %row.key, "a server asked for a certificate that cannot be signed");
                continue;
            }
        };
        let answered =
            ServerCertificate { chain_pem: Some(signed.chain_pem), expires_unix_ms: signed.expires.0, ..row.clone() };
        register
            .decide(|view| match view.servers.get(&row.key.to_string()) {
                Some((known, at)) if *known == row => {
                    let names = answered.names.join(" ");
                    let note = Note::new("server.certify").about("server", answered.key).with("names", names);
                    Ok((Some(decided(&answered, Some(*at), "midshift", "server.certified", note)), ()))
                }
                _ => Ok((None, ())),
            })
            .await?;
    }
    Ok(())
}

async fn waited_for(
    own: &OwnKey,
    register: &Register,
    store: &dyn Store,
    shutdown: &CancellationToken,
) -> Result<ServerProof, Error> {
    let mut wake = store.wake();
    let answered = async {
        loop {
            if let Some(proof) = own.proof(register).await? {
                return Ok(proof);
            }
            let woken = tokio::time::timeout(LOOK_EVERY, wake.changed()).await;
            if matches!(woken, Ok(Err(_))) {
                return Err(Error::NotAnswered);
            }
        }
    };
    tokio::select! {
        () = shutdown.cancelled() => Err(Error::NotAnswered),
        answered = tokio::time::timeout(ANSWERED_WITHIN, answered) => answered.unwrap_or(Err(Error::NotAnswered)),
    }
}
