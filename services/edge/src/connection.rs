//! One connection from the handshake to its end: proven, admitted, served, asked to go, cut.
//!
//! Invariant: at each moment something ends it that the peer has no say in: the handshake's time, the first request's, the idle one, its age, a denial, or
//! the stop of the port; a dead peer is found by HTTP/2's pings, and by the probes of the system ([`crate::Listen`] of a socket) where HTTP/1.1 has none. A
//! live one that keeps a stream of HTTP/1.1 open has it until its age. Nothing here waits for a service.

use crate::activity::{Activity, Unused};
use crate::config::{Config, std};
use crate::denials::Denials;
use crate::frame_heads::{CountedConnection, FloodFlag};
use crate::listen::Io;
use crate::peer::{ConnectionId, Denied, Peer, Principals};
use crate::quota::network;
use crate::requests::{Door, Rules, Services};
use crate::unauthenticated::Unauthenticated;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use midshift_core::limits;
use rustls::ServerConfig;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Semaphore, watch};
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// How a connection ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// The peer closed it, or both had nothing more to say.
    Closed,
    /// It broke, or the peer broke the protocol.
    Broken,
    /// The TLS handshake failed.
    HandshakeFailed,
    /// The TLS handshake took too long.
    HandshakeSlow,
    /// No request came.
    NoRequest,
    /// No stream was open for a long time.
    Idle,
    /// It was old.
    Old,
    /// Its peer may not be connected, or no longer.
    Denied,
    /// It sent more control frames than a peer has a use for.
    FrameFlood,
    /// The port closed.
    Stopped,
}

impl End {
    /// For metrics.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Closed => "closed",
            Self::Broken => "broken",
            Self::HandshakeFailed => "handshake_failed",
            Self::HandshakeSlow => "handshake_slow",
            Self::NoRequest => "no_request",
            Self::Idle => "idle",
            Self::Old => "old",
            Self::Denied => "denied",
            Self::FrameFlood => "frame_flood",
            Self::Stopped => "stopped",
        }
    }
}

/// What all connections of a port share.
pub(crate) struct Port {
    pub config: Config,
    pub services: Services,
    pub principals: Arc<dyn Principals>,
    pub denials: Option<Arc<Denials>>,
    pub tls: Option<watch::Receiver<Arc<ServerConfig>>>,
    pub rules: Arc<Rules>,
    pub http: auto::Builder<TokioExecutor>,
}

/// Bytes of one stream that may wait unread. HTTP/2 ends a connection on which unread frames of less than 256 bytes lack more than half
/// of its window in sum: with these two, frames of 28 bytes and more never do on one stream, however fast they come.
const STREAM_WINDOW_BYTES: u32 = 64 * 1024;
/// Bytes of all streams of one connection that may wait unread: half of it is room for [`limits::BATCHES_PER_CONNECTION_MAX`] streams of
/// the smallest frames.
const CONNECTION_WINDOW_BYTES: u32 = 8 * 1024 * 1024;

/// HTTP/2 and HTTP/1.1 within the limits of `config`.
pub(crate) fn http(config: &Config) -> auto::Builder<TokioExecutor> {
    let mut builder = auto::Builder::new(TokioExecutor::new());
    builder
        .http2()
        .timer(TokioTimer::new())
        .max_concurrent_streams(config.streams_per_connection)
        .max_header_list_size(config.header_list_bytes)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_send_buf_size(limits::STREAM_SEND_BYTES)
        .keep_alive_interval(std(config.keepalive_every))
        .keep_alive_timeout(std(config.keepalive_within));
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(std(config.http1_head))
        .max_buf_size(limits::HTTP1_HEAD_BYTES);
    builder
}

/// Why a connection that is served ends before its peer closes it.
enum Reason {
    Stop,
    Denied(Denied),
    Unused(Unused),
    Old,
}

impl Port {
    /// From the first byte to the end. Dropping it cuts the connection.
    pub async fn run(
        self: Arc<Self>,
        io: Box<dyn Io>,
        address: SocketAddr,
        (id, unauthenticated): (ConnectionId, Unauthenticated),
        stop: CancellationToken,
    ) -> End {
        let Some(tls) = &self.tls else {
            return self.serve(io, Peer::new(address, None, id), unauthenticated, stop).await;
        };
        // What is newest now; a connection keeps it.
        let acceptor = TlsAcceptor::from(tls.borrow().clone());
        let handshake = timeout(std(self.config.tls_handshake), acceptor.accept(io));
        let io = tokio::select! {
            () = stop.cancelled() => return End::Stopped,
            done = handshake => match done {
                Ok(Ok(io)) => io,
                Ok(Err(error)) => {
                    failed_handshake(self.config.port, address, id, &error);
                    return End::HandshakeFailed;
                }
                Err(_) => {
                    let (port, from) = (self.config.port, network(address.ip()));
                    tracing::info!(port, peer = %from, connection = id.0, %address, "a TLS handshake took too long");
                    return End::HandshakeSlow;
                }
            },
        };
        let shown = io.get_ref().1.peer_certificates().and_then(<[_]>::first);
        let leaf = shown.map(|leaf| leaf.clone().into_owned());
        self.serve(Box::new(io), Peer::new(address, leaf, id), unauthenticated, stop).await
    }

    async fn serve(
        &self,
        io: Box<dyn Io>,
        peer: Peer,
        unauthenticated: Unauthenticated,
        stop: CancellationToken,
    ) -> End {
        // Before asking, so that no change falls in between.
        let mut changed = self.principals.changed();
        let activity = Activity::new();
        let door = Door {
            services: self.services.clone(),
            rules: self.rules.clone(),
            activity: activity.clone(),
            peer: peer.clone(),
            unauthenticated: unauthenticated.clone(),
            principals: self.principals.clone(),
            denials: self.denials.clone(),
            batches: Arc::new(Semaphore::new(limits::BATCHES_PER_CONNECTION_MAX)),
        };
        if let Err(denied) = self.principals.admit(&peer) {
            return self.turn_away(io, door, denied).await;
        }
        if peer.certificate.is_some() {
            unauthenticated.set_authenticated();
        }
        let flooded = FloodFlag::default();
        let io = TokioIo::new(CountedConnection::new(io, flooded.clone()));
        let mut served = pin!(self.http.serve_connection(io, door));
        let reason = tokio::select! {
            // First, so that no request is taken before its time is counted.
            biased;
            unused = activity.unused(std(self.config.first_request), std(self.config.idle)) => Reason::Unused(unused),
            denied = self.asked_again(&peer, &mut changed) => Reason::Denied(denied),
            () = stop.cancelled() => Reason::Stop,
            () = self.grows_old(&peer) => Reason::Old,
            done = served.as_mut() => return self.ended(&peer, done, &flooded),
        };
        let (end, time) = match reason {
            Reason::Denied(Denied::Token) => {
                let end = self.denied(&peer, Denied::Token);
                peer.over.cancel();
                (end, Some(Duration::ZERO))
            }
            Reason::Denied(denied) => return self.denied(&peer, denied),
            // A request that it sent before it reads this has a moment; nobody has proven anything here.
            Reason::Unused(Unused::NoRequest) => (End::NoRequest, Some(std(limits::CONNECTION_LAST))),
            // A client that calls as often as this port loses patience sends its next request before it reads this, each time: it is answered.
            Reason::Unused(Unused::Idle) => (End::Idle, Some(std(limits::CONNECTION_GRACE))),
            Reason::Old => (End::Old, self.config.age.map(|age| std(age.grace))),
            // Whoever stopped the port counts the time for all.
            Reason::Stop => (End::Stopped, None),
        };
        peer.go_away.begin();
        served.as_mut().graceful_shutdown();
        let time_over = async {
            match time {
                Some(time) => sleep(time).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            _ = served.as_mut() => end,
            denied = self.asked_again(&peer, &mut changed) => self.denied(&peer, denied),
            () = time_over => {
                // Whoever still has a stream hears why it ends.
                peer.over.cancel();
                let _ = timeout(std(limits::CONNECTION_LAST), served).await;
                end
            }
        }
    }

    /// Answers whatever is asked for a moment with why the certificate is denied, so that a robot can say so; then cuts.
    /// Its requests are judged as any others are: its certificate gives it no caller, so that no service hears of them.
    async fn turn_away(&self, io: Box<dyn Io>, mut door: Door, denied: Denied) -> End {
        let end = self.denied(&door.peer, denied);
        if door.peer.certificate.is_some() {
            // That a connection was denied is told already.
            door.denials = None;
            let io = TokioIo::new(CountedConnection::new(io, FloodFlag::default()));
            let served = self.http.serve_connection(io, door);
            let _ = timeout(std(limits::DENIED_LAST), served).await;
        }
        end
    }

    /// Resolves when the peer may not be connected any longer.
    async fn asked_again(&self, peer: &Peer, changed: &mut watch::Receiver<u64>) -> Denied {
        loop {
            let is_changed = tokio::select! {
                changed = changed.changed() => changed.is_ok(),
                // A certificate's time is looked at in its handshake, a token's with each request: what is left are streams.
                () = sleep(std(self.config.asked_again)), if peer.certificate.is_none() => true,
            };
            if !is_changed {
                // Nothing changes any more.
                return std::future::pending().await;
            }
            if let Err(denied) = self.principals.admit(peer) {
                return denied;
            }
        }
    }

    /// Resolves when the connection is old and its streams have had notice.
    async fn grows_old(&self, peer: &Peer) {
        let Some(age) = self.config.age else { return std::future::pending().await };
        sleep(age.drawn(rand::random())).await;
        peer.go_away.begin();
        sleep(std(age.notice)).await;
    }

    fn denied(&self, peer: &Peer, denied: Denied) -> End {
        let (port, connection, from) = (self.config.port, peer.connection.0, network(peer.address.ip()));
        tracing::info!(port, peer = %from, connection, address = %peer.address, %denied, "a connection was denied");
        End::Denied
    }

    fn ended(
        &self,
        peer: &Peer,
        done: Result<(), Box<dyn std::error::Error + Send + Sync>>,
        flooded: &FloodFlag,
    ) -> End {
        let (port, from) = (self.config.port, network(peer.address.ip()));
        if flooded.is_set() {
            let (connection, address) = (peer.connection.0, peer.address);
            tracing::info!(port, peer = %from, connection, %address, "a connection was cut for a flood of control frames");
            return End::FrameFlood;
        }
        let Err(error) = done else { return End::Closed };
        tracing::debug!(port, peer = %from, connection = peer.connection.0, %error, "a connection broke");
        End::Broken
    }
}

/// One that closed before it said anything looked whether the port is there, as proxies do.
fn failed_handshake(port: &'static str, address: SocketAddr, id: ConnectionId, error: &std::io::Error) {
    let (peer, connection) = (network(address.ip()), id.0);
    if error.kind() == std::io::ErrorKind::UnexpectedEof {
        tracing::debug!(port, %peer, connection, %error, "a TLS handshake failed");
    } else {
        tracing::info!(port, %peer, connection, %address, %error, "a TLS handshake failed");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytes::Bytes;
    use http::{Request, Response};
    use http_body::Frame;
    use http_body_util::StreamBody;
    use hyper::body::Incoming;
    use hyper::service::service_fn;
    use std::convert::Infallible;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use tokio::io::AsyncWriteExt;
    use tokio_stream::StreamExt;

    const CHUNK: &[u8] = &[0; 1024];

    #[tokio::test]
    async fn little_is_composed_for_a_peer_with_a_large_window_that_reads_nothing() {
        let composed = Arc::new(AtomicUsize::new(0));
        let counted = composed.clone();
        let service = service_fn(move |_: Request<Incoming>| {
            let counted = counted.clone();
            let chunks = tokio_stream::iter(0..4096).map(move |_| {
                counted.fetch_add(CHUNK.len(), Ordering::Relaxed);
                Ok::<_, Infallible>(Frame::data(Bytes::from_static(CHUNK)))
            });
            async move { Ok::<_, Infallible>(Response::new(StreamBody::new(chunks))) }
        });
        let (mut peer, served) = tokio::io::duplex(CHUNK.len());
        tokio::spawn(async move { http(&Config::default()).serve_connection(TokioIo::new(served), service).await });
        let mut said = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
        // Windows of nearly 2 GiB: of each stream by SETTINGS, of the connection by WINDOW_UPDATE. Then GET /.
        said.extend([0, 0, 6, 4, 0, 0, 0, 0, 0, 0, 4, 0x7f, 0xff, 0xff, 0xff]);
        said.extend([0, 0, 4, 8, 0, 0, 0, 0, 0, 0x7f, 0, 0, 0]);
        said.extend([0, 0, 6, 1, 5, 0, 0, 0, 1, 0x82, 0x86, 0x84, 0x41, 1, b'e']);
        peer.write_all(&said).await.expect("written");
        // Until the server has gone on for nothing for long: nothing here waits for anything but the peer.
        let (mut seen, mut quiet) = (0, 0);
        while quiet < 100 {
            tokio::task::yield_now().await;
            let now = composed.load(Ordering::Relaxed);
            quiet = if now > 0 && now == seen { quiet + 1 } else { 0 };
            seen = now;
        }
        assert!(seen < 8 * limits::STREAM_SEND_BYTES, "{seen} bytes of {}", 4096 * CHUNK.len());
    }
}
