//! A peer that writes and reads HTTP/2 frame by frame, and can therefore break any rule.

use std::net::SocketAddr;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};

pub const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
pub const DATA: u8 = 0;
pub const HEADERS: u8 = 1;
pub const PRIORITY: u8 = 2;
pub const RST_STREAM: u8 = 3;
pub const SETTINGS: u8 = 4;
pub const PING: u8 = 6;
pub const GOAWAY: u8 = 7;
pub const WINDOW_UPDATE: u8 = 8;
pub const END_STREAM: u8 = 1;
pub const ACK: u8 = 1;
const END_HEADERS: u8 = 4;

#[derive(Debug)]
pub struct Frame {
    pub kind: u8,
    pub flags: u8,
    pub stream: u32,
    pub payload: Vec<u8>,
}

/// A connection from `from`, an address of this machine.
pub async fn dial(to: SocketAddr, from: [u8; 4]) -> TcpStream {
    let socket = TcpSocket::new_v4().expect("a socket");
    socket.bind(SocketAddr::from((from, 0))).expect("an address of this machine");
    socket.connect(to).await.expect("a connection")
}

/// Waits until the other side has closed; what it said before.
pub async fn until_closed(io: &mut (impl AsyncRead + Unpin)) -> Vec<u8> {
    let mut said = Vec::new();
    // Closed with bytes unread it is a reset: closed all the same.
    let _ = io.read_to_end(&mut said).await;
    said
}

pub fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let mut frame = (payload.len() as u32).to_be_bytes()[1..].to_vec();
    frame.extend([kind, flags]);
    frame.extend(stream.to_be_bytes());
    frame.extend(payload);
    frame
}

pub struct Raw<Io>(pub Io);

impl Raw<TcpStream> {
    /// Connected, with preface and settings said.
    pub async fn dial(to: SocketAddr, from: [u8; 4]) -> Self {
        let mut raw = Self(dial(to, from).await);
        raw.0.write_all(PREFACE).await.expect("written");
        raw.write(SETTINGS, 0, 0, &[]).await;
        raw
    }
}

impl<Io: AsyncRead + AsyncWrite + Unpin> Raw<Io> {
    pub async fn write(&mut self, kind: u8, flags: u8, stream: u32, payload: &[u8]) {
        self.0.write_all(&frame(kind, flags, stream, payload)).await.expect("written");
    }

    /// Begins a gRPC call whose body goes on.
    pub async fn call(&mut self, stream: u32, path: &str) {
        // :method POST, :scheme http, then literals without indexing: :path, :authority, content-type.
        let mut block = vec![0x83, 0x86];
        for (name, value) in [(0x04, path), (0x01, "edge")] {
            block.extend([name, value.len() as u8]);
            block.extend(value.as_bytes());
        }
        block.extend([0x0f, 0x10, 16]);
        block.extend(b"application/grpc");
        self.write(HEADERS, END_HEADERS, stream, &block).await;
    }

    /// The next frame; none: closed.
    pub async fn read(&mut self) -> Option<Frame> {
        let mut head = [0; 9];
        self.0.read_exact(&mut head).await.ok()?;
        let mut payload = vec![0; u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize];
        self.0.read_exact(&mut payload).await.ok()?;
        let stream = u32::from_be_bytes([head[5], head[6], head[7], head[8]]);
        Some(Frame { kind: head[3], flags: head[4], stream, payload })
    }

    /// The next frame of this kind; those before it are read and left. None: closed before.
    pub async fn next(&mut self, kind: u8) -> Option<Frame> {
        loop {
            let frame = self.read().await?;
            if frame.kind == kind {
                return Some(frame);
            }
        }
    }

    /// Every frame until the other side closes.
    pub async fn rest(&mut self) -> Vec<Frame> {
        let mut frames = Vec::new();
        while let Some(frame) = self.read().await {
            frames.push(frame);
        }
        frames
    }
}
