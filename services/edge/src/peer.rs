//! Who is at the other end of a connection, and the one question that the edge asks about it.
//!
//! Invariant: the edge decides nothing about anybody. It asks [`Principals`] once the handshake has proven a certificate and before a byte
//! of HTTP is read, and again each time that the answer may have changed. Identity implements it over a cache.

use http::HeaderMap;
use midshift_core::identity::Caller;
use midshift_core::reason::Refusal;
use midshift_proto::Leaving;
use rustls::pki_types::CertificateDer;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// Number of a connection of this port since its start; for logs, and to tell two connections of one peer apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ConnectionId(pub u64);

impl fmt::Display for ConnectionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The other end of a connection: in the extensions of each of its requests, those of tonic included.
#[derive(Clone, Debug)]
pub struct Peer {
    /// Where it connects from; of a proxy, the proxy's.
    pub address: SocketAddr,
    /// The leaf that it proved to have in the handshake, verified against the roots for clients; none: it showed none, or there is no TLS.
    pub certificate: Option<Arc<CertificateDer<'static>>>,
    /// Which connection.
    pub connection: ConnectionId,
    pub(crate) leaving: Leaving,
    /// Its streams end now.
    pub(crate) over: CancellationToken,
}

impl Peer {
    pub(crate) fn new(
        address: SocketAddr,
        certificate: Option<CertificateDer<'static>>,
        connection: ConnectionId,
    ) -> Self {
        let (leaving, over) = (Leaving::default(), CancellationToken::new());
        Self { address, certificate: certificate.map(Arc::new), connection, leaving, over }
    }

    /// Resolves when the connection is about to be asked to go, for its age or because the port closes. Whoever holds a stream on it uses the
    /// time to send its peer elsewhere. Never resolves for a connection that is cut.
    pub async fn leaving(&self) {
        self.leaving.begun().await;
    }
}

/// Why a connection is refused or cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// A certificate is needed here.
    #[error("no client certificate")]
    NoCertificate,
    /// Its certificate is genuine and names nobody we know.
    #[error("a certificate of nobody known")]
    Unknown,
    /// It was taken out.
    #[error("a revoked certificate")]
    Revoked,
    /// Its time is over.
    #[error("an expired certificate")]
    Expired,
}

/// Who may be connected.
pub trait Principals: Send + Sync + 'static {
    /// Whether this connection may be. Asked for each one, on the runtime's threads: answers from memory.
    ///
    /// # Errors
    /// It may not be, or no longer.
    fn admit(&self, peer: &Peer) -> Result<(), Denied>;

    /// Changes whenever an answer of [`Principals::admit`] may have: every live connection is asked about again, and who is denied is cut.
    fn changed(&self) -> watch::Receiver<u64>;

    /// Who asks, by what the connection has proven and by the head of one request. Answers from memory.
    ///
    /// # Errors
    /// It shows something that is worth nothing.
    fn caller(&self, peer: &Peer, headers: &HeaderMap) -> Result<Caller, Refusal>;
}

/// Lets everybody in and do everything: for `dev`, where there is no login. Limits count addresses.
#[derive(Debug)]
pub struct Anybody(watch::Sender<u64>);

impl Default for Anybody {
    fn default() -> Self {
        Self(watch::Sender::new(0))
    }
}

impl Principals for Anybody {
    fn admit(&self, _: &Peer) -> Result<(), Denied> {
        Ok(())
    }
    fn changed(&self) -> watch::Receiver<u64> {
        self.0.subscribe()
    }
    fn caller(&self, _: &Peer, _: &HeaderMap) -> Result<Caller, Refusal> {
        Ok(Caller::local())
    }
}
