//! Connections over the simulated network, for tonic at both ends.

use hyper_util::rt::TokioIo;
use midshift_agent::dial::{self, Dial};
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
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

/// The way of a robot.
pub struct SimDial;

#[async_trait::async_trait]
impl Dial for SimDial {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let connected = dial::endpoint(&uri())?.connect_with_connector(tower::service_fn(connect)).await;
        connected.map_err(|error| dial::Error(error.into()))
    }
}
