//! Connections over the simulated network, for tonic at both ends.

use hyper_util::rt::TokioIo;
use midshift_agent::dial::{self, Dial};
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;
use tonic::transport::{Channel, Endpoint, Uri};
use turmoil::net::{TcpListener, TcpStream};

/// Name of the server's machine.
pub const SERVER: &str = "server";
const PORT: u16 = 7420;

/// One accepted connection.
pub struct Connection(TcpStream);

impl Connected for Connection {
    type ConnectInfo = ();
    fn connect_info(&self) {}
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.0).poll_write(cx, buf)
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_shutdown(cx)
    }
}

/// What the server accepts.
pub async fn incoming() -> io::Result<ReceiverStream<io::Result<Connection>>> {
    let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
    let (sender, accepted) = mpsc::channel(16);
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            if sender.send(Ok(Connection(stream))).await.is_err() {
                return;
            }
        }
    });
    Ok(ReceiverStream::new(accepted))
}

async fn connect(_: Uri) -> io::Result<TokioIo<TcpStream>> {
    Ok(TokioIo::new(TcpStream::connect((SERVER, PORT)).await?))
}

fn uri() -> String {
    format!("http://{SERVER}:{PORT}")
}

/// A channel of a person or program, which connects when it is used.
pub fn channel() -> anyhow::Result<Channel> {
    Ok(Endpoint::from_shared(uri())?.connect_with_connector_lazy(tower::service_fn(connect)))
}

/// What a machine reads from the network; while it is held, bytes wait and then come at once, and what the machine sends arrives.
#[derive(Clone, Default)]
pub struct Ear(Arc<Mutex<(bool, Option<Waker>)>>);

impl Ear {
    /// Holds bytes back or lets them through.
    pub fn hold(&self, held: bool) {
        let mut ear = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        ear.0 = held;
        if let Some(waker) = ear.1.take().filter(|_| !held) {
            waker.wake();
        }
    }
    fn is_held(&self, cx: &Context<'_>) -> bool {
        let mut ear = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if ear.0 {
            ear.1 = Some(cx.waker().clone());
        }
        ear.0
    }
}

/// A connection of a machine with an ear.
struct Heard {
    stream: TcpStream,
    ear: Ear,
}

impl AsyncRead for Heard {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if self.ear.is_held(cx) {
            return Poll::Pending;
        }
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for Heard {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, buf)
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// The way of a robot.
pub struct SimDial(pub Ear);

#[async_trait::async_trait]
impl Dial for SimDial {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let ear = self.0.clone();
        let connect = move |_: Uri| {
            let ear = ear.clone();
            async move {
                let stream = TcpStream::connect((SERVER, PORT)).await?;
                Ok::<_, io::Error>(TokioIo::new(Heard { stream, ear }))
            }
        };
        let connected = dial::endpoint(&uri())?.connect_with_connector(tower::service_fn(connect)).await;
        connected.map_err(|error| dial::Error(error.into()))
    }
}
