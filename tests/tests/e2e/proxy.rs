//! A proxy in the way of robots, which can hold back what the server says, byte for byte, cut every connection, or let nothing through at all for a while.
//!
//! Invariant: bytes are delayed or lost with their connection, never changed and never reordered; what robots say passes unless nothing does.

use crate::harness::same_site;
use std::net::SocketAddr;
use std::pin::pin;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

/// Bytes taken from one side at a time.
const CHUNK: usize = 16 * 1024;

/// The proxy; its connections end with it.
pub struct Proxy {
    /// Where robots dial.
    pub address: SocketAddr,
    held: watch::Sender<bool>,
    cuts: watch::Sender<u64>,
    severed: watch::Sender<bool>,
    _accepting: JoinSet<()>,
}

impl Proxy {
    /// In front of `server`.
    pub async fn before(server: SocketAddr) -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let address = listener.local_addr()?;
        same_site(server, address)?;
        let (held, cuts, severed) = (watch::Sender::new(false), watch::Sender::new(0), watch::Sender::new(false));
        let (hold, cut, sever) = (held.subscribe(), cuts.subscribe(), severed.subscribe());
        let mut accepting = JoinSet::new();
        accepting.spawn(async move {
            let mut connections = JoinSet::new();
            while let Ok((robot, _)) = listener.accept().await {
                let (hold, mut cut, mut sever) = (hold.clone(), cut.clone(), sever.clone());
                cut.mark_unchanged();
                connections.spawn(async move {
                    // Both ends stay open until all is over.
                    let mut carried = pin!(carry(robot, server, hold));
                    let until_over = async {
                        tokio::select! {
                            biased;
                            _ = sever.wait_for(|severed| *severed) => {}
                            _ = &mut carried => return,
                        }
                        let _ = sever.wait_for(|severed| !severed).await;
                    };
                    tokio::select! {
                        () = until_over => {}
                        _ = cut.changed() => {}
                    }
                });
            }
        });
        Ok(Self { address, held, cuts, severed, _accepting: accepting })
    }
    /// From now on nothing the server says arrives; or all of it at once.
    pub fn hold(&self, held: bool) {
        self.held.send_replace(held);
    }
    /// From now on nothing arrives at either end, and nobody hears why.
    pub fn sever(&self) {
        self.severed.send_replace(true);
    }
    /// New connections pass again; those of before, and those that were tried meanwhile, are over.
    pub fn mend(&self) {
        self.severed.send_replace(false);
    }
    /// Ends every connection there is; what was held back on them is lost.
    pub fn cut(&self) {
        self.cuts.send_modify(|n| *n += 1);
    }
}

async fn carry(robot: TcpStream, server: SocketAddr, mut hold: watch::Receiver<bool>) -> std::io::Result<()> {
    let server = TcpStream::connect(server).await?;
    robot.set_nodelay(true)?;
    server.set_nodelay(true)?;
    let (mut from_robot, mut to_robot) = robot.into_split();
    let (mut from_server, mut to_server) = server.into_split();
    let down = async {
        let mut bytes = vec![0; CHUNK];
        loop {
            let read = from_server.read(&mut bytes).await?;
            if read == 0 {
                return Ok::<(), std::io::Error>(());
            }
            hold.wait_for(|held| !held).await.map_err(std::io::Error::other)?;
            to_robot.write_all(&bytes[..read]).await?;
        }
    };
    let up = async { tokio::io::copy(&mut from_robot, &mut to_server).await.map(|_| ()) };
    tokio::select! {
        end = down => end,
        end = up => end,
    }
}
