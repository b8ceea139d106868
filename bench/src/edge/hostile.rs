//! Peers that mean no good, as many as told, from an address of their own. Each dials again when it is turned away, as such peers do.
//!
//! Invariant: a child; what it counts is what peers see: how many of them were turned away, how many requests were answered and refused.

use super::load::Load;
use anyhow::Context;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinSet;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;
use tonic::transport::{Channel, Endpoint};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Where they come from; who is served comes from 127.0.0.1.
const FROM: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);
/// Questions: peers that are connected or wait for it, peers that were turned away, requests that were answered, requests that were refused.
pub const THERE: &str = "there";
pub const TURNED_AWAY: &str = "turned-away";
pub const ANSWERED: &str = "answered";
pub const REFUSED: &str = "refused";
/// One byte of a slow peer takes so long.
const BYTE_EVERY: Duration = Duration::from_millis(500);
/// A peer that was turned away dials again after this.
const AGAIN_AFTER: Duration = Duration::from_millis(20);
/// Requests under way on one connection of a flood.
const IN_FLIGHT: usize = 16;
/// Peers of a flood that share a connection.
const PEERS_PER_CONNECTION: usize = 50;

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
const SETTINGS: [u8; 9] = [0, 0, 0, 4, 0, 0, 0, 0, 0];

/// What to do to whom.
#[derive(Clone, Debug, clap::Args)]
pub struct HostileArgs {
    #[arg(long)]
    server: SocketAddr,
    #[arg(long, value_enum)]
    load: Load,
    #[arg(long)]
    peers: usize,
}

/// What came of it.
#[derive(Default)]
pub struct Seen {
    there: AtomicU64,
    turned_away: AtomicU64,
    answered: AtomicU64,
    refused: AtomicU64,
}

impl Seen {
    /// For the parent.
    pub fn answer(&self, question: &str) -> u64 {
        let counter = match question {
            THERE => &self.there,
            TURNED_AWAY => &self.turned_away,
            ANSWERED => &self.answered,
            REFUSED => &self.refused,
            _ => return 0,
        };
        counter.load(Relaxed)
    }
}

/// Until `stop`.
pub async fn run(args: HostileArgs, seen: Arc<Seen>, stop: CancellationToken) -> anyhow::Result<()> {
    let HostileArgs { server, load, peers } = args;
    let mut all = JoinSet::new();
    let connections = if load == Load::Flood { peers.div_ceil(PEERS_PER_CONNECTION) } else { peers };
    for n in 0..connections {
        let seen = seen.clone();
        all.spawn(async move {
            for turn in n.. {
                seen.there.fetch_add(u64::from(turn == n), Relaxed);
                // What comes of one is counted; none of them gives up.
                let _ = once(server, load, turn, &seen).await;
                sleep(AGAIN_AFTER).await;
            }
        });
    }
    stop.cancelled().await;
    Ok(())
}

async fn once(server: SocketAddr, load: Load, turn: usize, seen: &Seen) -> anyhow::Result<()> {
    if load == Load::Flood {
        return flood(server, seen).await;
    }
    let socket = TcpSocket::new_v4()?;
    socket.bind((FROM, 0).into())?;
    let mut io = socket.connect(server).await?;
    let said = match load {
        Load::Slow => slowly(&mut io).await,
        Load::HalfOpen | Load::Descriptors => match turn % 2 {
            0 => Ok(()),
            _ => io.write_all(PREFACE.get(..9).unwrap_or_default()).await,
        },
        Load::Frames | Load::Flood => io.write_all(&broken(turn)).await,
    };
    // A peer that could not say everything was turned away too.
    if said.is_ok() {
        until_closed(&mut io).await;
    }
    seen.turned_away.fetch_add(1, Relaxed);
    Ok(())
}

/// A preface byte by byte, for as long as it is listened to.
async fn slowly(io: &mut TcpStream) -> std::io::Result<()> {
    for byte in PREFACE {
        io.write_all(std::slice::from_ref(byte)).await?;
        sleep(BYTE_EVERY).await;
    }
    Ok(())
}

async fn until_closed(io: &mut TcpStream) {
    let mut read = [0; 1024];
    while io.read(&mut read).await.is_ok_and(|n| n > 0) {}
}

/// Something that HTTP/2 forbids, another one each turn.
fn broken(turn: usize) -> Vec<u8> {
    let frame = |length: usize, kind: u8, flags: u8, stream: u8, bytes: &[u8]| {
        let length = length.to_be_bytes();
        let head = [length[5], length[6], length[7], kind, flags, 0, 0, 0, stream];
        [PREFACE, &SETTINGS, &head, bytes].concat()
    };
    match turn % 7 {
        // A frame of 16 MiB, of which the first 64 KiB come.
        0 => frame(0xff_ffff, 0, 0, 1, &[0; 65_536]),
        // Headers that are none.
        1 => frame(1024, 1, 4, 1, &[0xff; 1024]),
        // Settings of a length that they cannot have.
        2 => frame(5, 4, 0, 0, &[0; 5]),
        // A window that grows by nothing.
        3 => frame(4, 8, 0, 0, &[0; 4]),
        // The rest of headers that never began.
        4 => frame(8, 9, 4, 1, &[0; 8]),
        // Data of a stream that nobody opened.
        5 => frame(8, 0, 0, 1, &[0; 8]),
        // No preface at all.
        _ => vec![b'x'; 4096],
    }
}

/// Requests as fast as they are answered, over one connection.
async fn flood(server: SocketAddr, seen: &Seen) -> anyhow::Result<()> {
    let endpoint = Endpoint::from_shared(format!("http://{server}"))?.local_address(Some(FROM.into()));
    let channel = endpoint.connect().await.context("a connection of a flood")?;
    let mut asking = JoinSet::new();
    let ask = |channel: Channel| async move { HealthClient::new(channel).check(HealthCheckRequest::default()).await };
    for _ in 0..IN_FLIGHT {
        asking.spawn(ask(channel.clone()));
    }
    while let Some(answer) = asking.join_next().await {
        match answer? {
            Ok(_) => seen.answered.fetch_add(1, Relaxed),
            Err(status) if status.code() == tonic::Code::ResourceExhausted => seen.refused.fetch_add(1, Relaxed),
            Err(status) => return Err(status).context("a flood that was cut"),
        };
        asking.spawn(ask(channel.clone()));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_broken_message_begins_as_it_should_and_names_the_length_that_it_says() {
        let of = |turn: usize| broken(turn);
        assert!((0..6).all(|turn| of(turn).starts_with(PREFACE)) && !of(6).starts_with(b"PRI"));
        let head = PREFACE.len() + SETTINGS.len();
        assert_eq!(of(0)[head..head + 9], [0xff, 0xff, 0xff, 0, 0, 0, 0, 0, 1]);
        assert_eq!(of(4)[head..head + 9], [0, 0, 8, 9, 4, 0, 0, 0, 1]);
    }
}
