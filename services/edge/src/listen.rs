//! Where connections come from: a socket, or a stream of whatever else can be read and written, so that a simulation brings its own network.
//!
//! Invariant: says what the system says. No retry, no pause and no error is swallowed here.

use crate::config::std;
use midshift_core::{Boxed, limits};
use rustix::net::sockopt;
use std::io;
use std::net::SocketAddr;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio_stream::{Stream, StreamExt};

/// A source of connections.
pub trait Listen: Send + 'static {
    /// One connection.
    type Io: AsyncRead + AsyncWrite + Unpin + Send + 'static;

    /// The next connection and where it is from; none: there will be no more. Cancel safe: a call that is dropped loses no connection.
    ///
    /// # Errors
    /// As the system says; the caller decides by its kind whether to go on at once.
    fn accept(&mut self) -> impl Future<Output = io::Result<Option<(Self::Io, SocketAddr)>>> + Send;
}

/// One connection of whatever kind: what serves it is compiled once, in this crate.
pub trait Io: AsyncRead + AsyncWrite + Unpin + Send + 'static {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send + 'static> Io for T {}

/// A source of connections of whatever kind.
pub struct Listener(Box<dyn Accepts>);

impl Listener {
    /// Of `source`.
    pub fn new(source: impl Listen) -> Self {
        Self(Box::new(source))
    }
}

type Accepted = io::Result<Option<(Box<dyn Io>, SocketAddr)>>;

trait Accepts: Send {
    fn accept_boxed(&mut self) -> Boxed<'_, Accepted>;
}

impl<L: Listen> Accepts for L {
    fn accept_boxed(&mut self) -> Boxed<'_, Accepted> {
        Box::pin(async {
            let accepted = self.accept().await?;
            Ok(accepted.map(|(io, address)| (Box::new(io) as Box<dyn Io>, address)))
        })
    }
}

impl Listen for Listener {
    type Io = Box<dyn Io>;

    fn accept(&mut self) -> impl Future<Output = Accepted> + Send {
        self.0.accept_boxed()
    }
}

impl Listen for TcpListener {
    type Io = TcpStream;

    async fn accept(&mut self) -> io::Result<Option<(TcpStream, SocketAddr)>> {
        let (stream, address) = TcpListener::accept(self).await?;
        // A robot's heartbeat is one small segment; it does not wait for another. A peer that is gone already is found at its first read.
        let _ = stream.set_nodelay(true);
        find_dead(&stream);
        Ok(Some((stream, address)))
    }
}

/// A peer that is gone without a word is found by the system, also where the protocol has no pings. What a system does not have is left out.
fn find_dead(stream: &TcpStream) {
    let gone = std(limits::PEER_GONE);
    let _ = sockopt::set_socket_keepalive(stream, true);
    let _ = sockopt::set_tcp_keepidle(stream, gone / 2);
    let _ = sockopt::set_tcp_keepintvl(stream, gone / 6);
    let _ = sockopt::set_tcp_keepcnt(stream, 3);
    #[cfg(target_os = "linux")]
    let _ = sockopt::set_tcp_user_timeout(stream, u32::try_from(gone.as_millis()).unwrap_or(u32::MAX));
}

/// Connections of a stream; where each is from, its function says.
#[derive(Debug)]
pub struct Incoming<S, F> {
    stream: S,
    address: F,
}

impl<S, F> Incoming<S, F> {
    /// Connections of `stream`, each from what `address` says of it.
    pub const fn new(stream: S, address: F) -> Self {
        Self { stream, address }
    }
}

impl<S, F, Io> Listen for Incoming<S, F>
where
    S: Stream<Item = io::Result<Io>> + Unpin + Send + 'static,
    F: Fn(&Io) -> SocketAddr + Send + Sync + 'static,
    Io: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    type Io = Io;

    async fn accept(&mut self) -> io::Result<Option<(Io, SocketAddr)>> {
        let next = self.stream.next().await.transpose()?;
        Ok(next.map(|io| {
            let address = (self.address)(&io);
            (io, address)
        }))
    }
}
