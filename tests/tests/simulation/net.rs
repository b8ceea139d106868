//! Connections over the simulated network, for tonic at both ends, and what was written on them while their way was broken.

use crate::newer::Voice;
use hyper_util::rt::TokioIo;
use midshift_agent::dial::{self, Dial};
use std::collections::BTreeMap;
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

/// Name of a robot's machine.
pub fn machine(robot: usize) -> String {
    format!("robot-{robot}")
}

/// Name of the server's machine.
pub const SERVER: &str = "server";
/// Name of the stop service's machine.
pub const STOPS: &str = "stops";
const PORT: u16 = 7420;

/// How the way between the server and one machine is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LineState {
    /// Everything passes.
    #[default]
    Open,
    /// Nothing passes.
    Cut,
    /// Nothing passes from the server.
    CutDown,
    /// Nothing passes to the server.
    CutUp,
    /// Everything waits.
    Held,
}

/// Ways as they are now, and how often somebody wrote on a broken one: a message that was lost or kept waiting, not one that might
/// have been. Machines by name; what the clients send is not counted.
#[derive(Clone, Default)]
pub struct Wire(Arc<Mutex<WireState>>);

#[derive(Default)]
struct WireState {
    ways: BTreeMap<String, LineState>,
    deaf: BTreeMap<String, bool>,
    hits: BTreeMap<&'static str, u64>,
}

impl Wire {
    fn state(&self) -> std::sync::MutexGuard<'_, WireState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// The way to a machine is this from now on; what it was.
    pub fn set_way(&self, machine: &str, way: LineState) -> LineState {
        self.state().ways.insert(machine.to_owned(), way).unwrap_or_default()
    }
    /// A machine hears nothing from now on, or hears again.
    pub fn set_deaf(&self, machine: &str, deaf: bool) {
        self.state().deaf.insert(machine.to_owned(), deaf);
    }
    /// Messages that were hit, by what became of them.
    pub fn hits(&self) -> BTreeMap<&'static str, u64> {
        self.state().hits.clone()
    }
    fn wrote(&self, machine: &str, up: bool) {
        let mut state = self.state();
        let way = state.ways.get(machine).copied().unwrap_or_default();
        let hit = match (way, up) {
            (LineState::Cut | LineState::CutUp, true) => "message of a robot lost",
            (LineState::Cut | LineState::CutDown, false) => "message to a robot lost",
            (LineState::Held, _) => "message held on its way",
            _ if !up && state.deaf.get(machine) == Some(&true) => "message kept from a robot's ear",
            _ => return,
        };
        *state.hits.entry(hit).or_insert(0) += 1;
    }
}

/// One accepted connection.
pub struct Connection {
    stream: TcpStream,
    machine: String,
    wire: Wire,
}

impl Connected for Connection {
    type ConnectInfo = ();
    fn connect_info(&self) {}
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, buf);
        if let Poll::Ready(Ok(1..)) = written {
            self.wire.wrote(&self.machine, false);
        }
        written
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// What the server accepts.
pub async fn incoming(wire: Wire) -> io::Result<ReceiverStream<io::Result<Connection>>> {
    let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
    let (sender, accepted) = mpsc::channel(16);
    tokio::spawn(async move {
        while let Ok((stream, from)) = listener.accept().await {
            let machine = turmoil::reverse_lookup(from.ip()).unwrap_or_default();
            if sender.send(Ok(Connection { stream, machine, wire: wire.clone() })).await.is_err() {
                return;
            }
        }
    });
    Ok(ReceiverStream::new(accepted))
}

fn uri(to: &str) -> String {
    format!("http://{to}:{PORT}")
}

/// A channel of a person or program, which connects when it is used.
pub fn channel() -> anyhow::Result<Channel> {
    channel_to(SERVER)
}

/// The same to another machine.
pub fn channel_to(to: &'static str) -> anyhow::Result<Channel> {
    let connect = move |_: Uri| async move { TcpStream::connect((to, PORT)).await.map(TokioIo::new) };
    Ok(Endpoint::from_shared(uri(to))?.connect_with_connector_lazy(tower::service_fn(connect)))
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
    machine: String,
    wire: Wire,
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
        let written = Pin::new(&mut self.stream).poll_write(cx, buf);
        if let Poll::Ready(Ok(1..)) = written {
            self.wire.wrote(&self.machine, true);
        }
        written
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// The way of a robot.
pub struct SimDial {
    /// Name of the machine that it leads to.
    pub to: &'static str,
    /// What it hears with.
    pub ear: Ear,
    /// Name of its machine.
    pub machine: String,
    /// Who counts what is lost.
    pub wire: Wire,
    /// What its program says and hears more than this version does; none: nothing stands between it and who it dials.
    pub voice: Option<Voice>,
}

#[async_trait::async_trait]
impl Dial for SimDial {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let (to, ear, machine, wire) = (self.to, self.ear.clone(), self.machine.clone(), self.wire.clone());
        let connect = move |_: Uri| {
            let (ear, machine, wire) = (ear.clone(), machine.clone(), wire.clone());
            async move {
                let stream = TcpStream::connect((to, PORT)).await?;
                Ok::<_, io::Error>(TokioIo::new(Heard { stream, ear, machine, wire }))
            }
        };
        let endpoint = dial::endpoint(&uri(to))?;
        let connected = endpoint.connect_with_connector(tower::service_fn(connect)).await;
        let connected = match (&self.voice, connected) {
            (Some(voice), Ok(server)) => voice.over(&endpoint, server).await,
            (_, connected) => connected,
        };
        connected.map_err(|error| dial::Error(error.into()))
    }
}
