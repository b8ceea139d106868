//! How sessions and bulk reach the server: one connection each, small buffers, and a network that a simulation can cut.
//!
//! Invariant: keep-alive of HTTP/2 is not liveness and is off on a robot's lines, where the agent itself gives a silent
//! session up; whoever has settings of its own says so in [`TcpDial::over`]. Called by the shell.

use super::tls::Tls;
use async_trait::async_trait;
use hyper_util::rt::TokioIo;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio_rustls::client::TlsStream;
use tokio_util::either::Either;
use tonic::transport::{Channel, Endpoint};

/// Stream window of one robot, bytes: enough for the largest control message.
const STREAM_WINDOW: u32 = 128 * 1024;
/// Stream window of a download, bytes: what of it may stand before a message of the session on a shared way.
const BULK_WINDOW: u32 = 64 * 1024;
/// A connection that is not there by then is tried again, real time.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Bytes the kernel takes before it has sent what it holds; the rest waits in the lanes, where CRITICAL overtakes
/// STATUS.
#[cfg(any(target_os = "linux", target_os = "android"))]
const UNSENT_BYTES: u32 = 16 * 1024;

/// A connection that could not be made.
#[derive(Debug, thiserror::Error)]
#[error("dialing the server: {0}")]
pub struct Error(pub Box<dyn std::error::Error + Send + Sync>);

impl Error {
    /// Every cause, the outermost first.
    pub fn causes(&self) -> String {
        let first: &(dyn std::error::Error + 'static) = &*self.0;
        let all = std::iter::successors(Some(first), |error| (*error).source());
        all.map(ToString::to_string).collect::<Vec<_>>().join(": ")
    }
}

/// The address with this scheme, if it has none.
pub fn with_scheme(scheme: &str, server: &str) -> String {
    if server.contains("://") { server.to_owned() } else { format!("{scheme}://{server}") }
}

/// Makes connections to the server. Implemented here over TCP, and by simulations over their own network.
#[async_trait]
pub trait Dial: Send + Sync {
    /// A new connection.
    async fn dial(&self) -> Result<Channel, Error>;
    /// Whether each connection is one on which the server has proven by its certificate that it is of the site.
    fn proves_server(&self) -> bool {
        false
    }
}

/// The settings every robot's connection has, whatever carries it.
pub fn endpoint(uri: &str) -> Result<Endpoint, Error> {
    let endpoint = Endpoint::from_shared(uri.to_owned()).map_err(|e| Error(e.into()))?;
    Ok(endpoint
        .connect_timeout(CONNECT_TIMEOUT)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(STREAM_WINDOW)
        .buffer_size(Some(8))
        .tcp_nodelay(true))
}

/// The settings of a connection for downloads: as [`endpoint`], with smaller windows.
pub fn bulk_endpoint(uri: &str) -> Result<Endpoint, Error> {
    Ok(endpoint(uri)?.initial_stream_window_size(BULK_WINDOW).initial_connection_window_size(BULK_WINDOW))
}

/// TCP, with a network that may be cut.
#[derive(Clone, Debug)]
pub struct TcpDial {
    endpoint: Endpoint,
    address: String,
    network: Option<watch::Receiver<bool>>,
    tls: Option<Tls>,
}

impl TcpDial {
    /// To `uri`, `http://host:port` or `https://`. While `network` says false nothing passes and nothing is dialed.
    pub fn new(uri: &str, network: Option<watch::Receiver<bool>>) -> Result<Self, Error> {
        Self::over(endpoint(uri)?, network)
    }

    /// As [`TcpDial::new`], for downloads: a connection beside the session's.
    pub fn bulk(uri: &str, network: Option<watch::Receiver<bool>>) -> Result<Self, Error> {
        Self::over(bulk_endpoint(uri)?, network)
    }

    /// With settings of one's own.
    pub fn over(endpoint: Endpoint, network: Option<watch::Receiver<bool>>) -> Result<Self, Error> {
        let authority = endpoint.uri().authority().map(ToString::to_string);
        let address = authority.ok_or_else(|| Error("the address needs a host and a port".into()))?;
        Ok(Self { endpoint, address, network, tls: None })
    }

    /// Over TLS.
    #[must_use]
    pub fn with_tls(self, tls: impl Into<Option<Tls>>) -> Self {
        Self { tls: tls.into(), ..self }
    }
}

impl TcpDial {
    /// A connection that is made when it is used.
    pub fn lazy(&self) -> Channel {
        self.endpoint.connect_with_connector_lazy(self.connector())
    }

    fn connector(
        &self,
    ) -> impl tower::Service<tonic::transport::Uri, Response = TokioIo<Wire>, Error = io::Error, Future: Send> + Send + use<>
    {
        let dial = self.clone();
        tower::service_fn(move |_: tonic::transport::Uri| {
            let dial = dial.clone();
            async move { dial.wire().await.map(TokioIo::new) }
        })
    }

    /// A connection without HTTP.
    ///
    /// # Errors
    /// Nobody is there, or it is none of the site.
    pub async fn wire(&self) -> io::Result<Wire> {
        if let Some(network) = &self.network {
            let mut network = network.clone();
            network.wait_for(|up| *up).await.map_err(io::Error::other)?;
        }
        let stream = TcpStream::connect(&self.address).await?;
        tune(&stream)?;
        let stream = Cut::new(stream, self.network.clone());
        Ok(match &self.tls {
            Some(tls) => Either::Right(Box::new(tls.over(stream).await?)),
            None => Either::Left(stream),
        })
    }
}

/// Plain or TLS.
pub type Wire = Either<Cut<TcpStream>, Box<TlsStream<Cut<TcpStream>>>>;

#[async_trait]
impl Dial for TcpDial {
    async fn dial(&self) -> Result<Channel, Error> {
        self.endpoint.connect_with_connector(self.connector()).await.map_err(|e| Error(e.into()))
    }
    fn proves_server(&self) -> bool {
        self.tls.is_some()
    }
}

/// Settings of the socket of a session: nothing waits to be sent with something else, and little waits in the kernel.
fn tune(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    #[cfg(any(target_os = "linux", target_os = "android"))]
    socket2::SockRef::from(stream).set_tcp_notsent_lowat(UNSENT_BYTES)?;
    Ok(())
}

/// A stream whose bytes vanish once its network was cut: writes go nowhere, nothing arrives, nobody is told. When the
/// network is back the stream is dead, since bytes are missing in it.
#[derive(Debug)]
pub struct Cut<S: Send + 'static> {
    stream: Option<S>,
    network: Option<watch::Receiver<bool>>,
    back: Option<Pin<Box<tokio::time::Sleep>>>,
    was_cut: bool,
}

/// How often a cut stream looks whether the network is back, real time.
const LOOK: Duration = Duration::from_millis(200);

impl<S: Send + 'static> Cut<S> {
    /// Over `stream`. Without a network it is only the stream.
    pub fn new(stream: S, network: Option<watch::Receiver<bool>>) -> Self {
        Self { stream: Some(stream), network, back: None, was_cut: false }
    }

    fn is_up(&self) -> bool {
        self.network.as_ref().is_none_or(|n| *n.borrow())
    }

    /// The stream if it is whole; an error if it was cut and the network is back; none while bytes vanish.
    fn whole(&mut self) -> io::Result<Option<&mut S>> {
        self.was_cut |= !self.is_up();
        match (self.was_cut, self.is_up()) {
            (false, _) => Ok(self.stream.as_mut()),
            (true, true) => Err(io::ErrorKind::ConnectionReset.into()),
            (true, false) => Ok(None),
        }
    }

    fn look_again(&mut self, cx: &mut Context<'_>) {
        loop {
            let back = self.back.get_or_insert_with(|| Box::pin(tokio::time::sleep(LOOK)));
            if back.as_mut().poll(cx).is_pending() {
                return;
            }
            self.back = None;
            if self.is_up() {
                cx.waker().wake_by_ref();
                return;
            }
        }
    }
}

impl<S: AsyncRead + Unpin + Send + 'static> AsyncRead for Cut<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        let watched = self.network.is_some();
        if let Some(stream) = self.whole()? {
            let read = Pin::new(stream).poll_read(cx, buf);
            if !watched || self.is_up() {
                return read;
            }
            buf.set_filled(before);
        }
        self.look_again(cx);
        Poll::Pending
    }
}

impl<S: AsyncWrite + Unpin + Send + 'static> AsyncWrite for Cut<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        match self.whole()? {
            Some(stream) => Pin::new(stream).poll_write(cx, buf),
            None => Poll::Ready(Ok(buf.len())),
        }
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.whole()? {
            Some(stream) => Pin::new(stream).poll_flush(cx),
            None => Poll::Ready(Ok(())),
        }
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.whole() {
            Ok(Some(stream)) => Pin::new(stream).poll_shutdown(cx),
            _ => Poll::Ready(Ok(())),
        }
    }
}

impl<S: Send + 'static> Drop for Cut<S> {
    /// A socket that is closed says goodbye; over a cut network nobody may hear it, so it is kept until the network is
    /// back.
    fn drop(&mut self) {
        let cut = !self.is_up();
        if let (true, Some(stream), Some(mut network)) = (cut, self.stream.take(), self.network.take())
            && let Ok(runtime) = tokio::runtime::Handle::try_current()
        {
            runtime.spawn(async move {
                let _ = network.wait_for(|up| *up).await;
                drop(stream);
            });
        }
    }
}

#[cfg(test)]
mod tests {
    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn the_kernel_holds_little_of_a_session_back() -> std::io::Result<()> {
        use super::{TcpStream, UNSENT_BYTES, tune};
        let server = tokio::net::TcpListener::bind("127.0.0.1:0").await?;
        let stream = TcpStream::connect(server.local_addr()?).await?;
        tune(&stream)?;
        assert!(stream.nodelay()?);
        assert_eq!(socket2::SockRef::from(&stream).tcp_notsent_lowat()?, UNSENT_BYTES);
        Ok(())
    }
}
