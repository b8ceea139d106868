//! Who is at the other end of a connection, and the one question that the edge asks about it.
//!
//! Invariant: the edge decides nothing about anybody. It asks [`Principals`] once the handshake has proven a certificate and before a byte
//! of HTTP is read, and again each time that the answer may have changed. Identity implements it over a cache.

use http::HeaderMap;
use midshift_core::identity::{Caller, TokenId};
use midshift_core::reason::Refusal;
use midshift_proto::GoAwayNotice;
use rustls::pki_types::CertificateDer;
use std::collections::BTreeMap;
use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
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
    pub(crate) go_away: GoAwayNotice,
    /// Its streams end now.
    pub(crate) over: CancellationToken,
    /// Whose requests it carried, open streams among them, and whether their time was over then, so that they may only stop.
    tokens: Arc<Mutex<BTreeMap<TokenId, bool>>>,
}

impl Peer {
    pub(crate) fn new(
        address: SocketAddr,
        certificate: Option<CertificateDer<'static>>,
        connection: ConnectionId,
    ) -> Self {
        let (go_away, over) = (GoAwayNotice::default(), CancellationToken::new());
        Self { address, certificate: certificate.map(Arc::new), connection, go_away, over, tokens: Arc::default() }
    }

    /// Remembers that it showed this token, and whether that only stops any more; whether it is the first time.
    pub(crate) fn shows(&self, token: &TokenId, is_expired: bool) -> bool {
        let mut tokens = self.tokens.lock().unwrap_or_else(PoisonError::into_inner);
        let is_new = !tokens.contains_key(token);
        if is_new {
            tokens.insert(token.clone(), is_expired);
        }
        is_new
    }

    /// Whether each token that it showed is so, of which it is said whether it only stopped any more when it was shown first.
    pub(crate) fn showed_all(&self, mut is_so: impl FnMut(&TokenId, bool) -> bool) -> bool {
        let tokens = self.tokens.lock().unwrap_or_else(PoisonError::into_inner);
        tokens.iter().all(|(token, was_expired)| is_so(token, *was_expired))
    }

    /// Resolves when the connection is about to be asked to go, for its age or because the port closes. Whoever holds a stream on it uses the
    /// time to send its peer elsewhere. Never resolves for a connection that is cut.
    pub async fn go_away(&self) {
        self.go_away.begun().await;
    }
}

/// Why a connection is refused or cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// Its certificate is genuine and names nobody we know.
    #[error("a certificate of nobody known")]
    Unknown,
    /// Its certificate was taken out.
    #[error("a revoked certificate")]
    Revoked,
    /// A token that it showed was taken back, or its time is over. Its streams end now; an answer that is under way still leaves, such as that of whoever took
    /// its own token back.
    #[error("a token that was revoked or is over")]
    Token,
}

/// Who may be connected.
pub trait Principals: Send + Sync + 'static {
    /// Whether this connection may be. Asked for each one, on the runtime's threads: answers from memory. Asked again each time that [`Principals::changed`]
    /// says so, and where no certificate was shown each [`crate::Config::asked_again`], since time alone ends a token.
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
