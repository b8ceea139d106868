//! A line to the socket of a PostgreSQL server that a test owns, and can cut so that neither end notices, or break so that both do.
//!
//! Invariant: what was said before a cut has arrived or never will, also after the line is whole again: as behind a firewall that has
//! forgotten its connections. Uses nothing but the standard library and tokio, so that any crate's tests can include this file.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UnixStream};
use tokio::sync::watch;

/// When a line cuts itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trap {
    /// Before it passes COMMIT on.
    BeforeCommit,
    /// After that, before the answer.
    AfterCommit,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Whole,
    Silent,
    Broken,
}

/// The line. It ends with the runtime that it was made in.
#[derive(Clone)]
pub struct Line {
    /// Its near end.
    address: SocketAddr,
    socket: PathBuf,
    state: watch::Sender<State>,
    trap: Arc<Mutex<Option<Trap>>>,
}

impl Line {
    /// A line to `socket`.
    ///
    /// # Errors
    /// If there is no free port.
    pub async fn to(socket: PathBuf) -> std::io::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let address = listener.local_addr()?;
        let line = Self { address, socket, state: watch::Sender::new(State::Whole), trap: Arc::default() };
        tokio::spawn(line.clone().accept(listener));
        Ok(line)
    }

    /// The same database as `url` of a [`PostgresServer`](super::postgres::PostgresServer) has, at this end.
    pub fn url(&self, url: &str) -> String {
        let database = url.split(['/', '?']).nth(3).unwrap_or_default();
        format!("postgres://postgres@{}/{database}", self.address)
    }

    /// Cuts itself at the next COMMIT.
    pub fn set(&self, trap: Trap) {
        *self.trap.lock().unwrap_or_else(PoisonError::into_inner) = Some(trap);
    }

    /// Nothing arrives any more at either end, nothing is closed, and nobody is let in.
    pub fn cut(&self) {
        self.state.send_replace(State::Silent);
    }

    /// Every connection is reset, and so is each new one.
    pub fn break_off(&self) {
        self.state.send_replace(State::Broken);
    }

    /// New connections pass; those of before stay what they are.
    pub fn heal(&self) {
        self.state.send_replace(State::Whole);
    }

    /// Until somebody or a trap has cut it.
    pub async fn until_cut(&self) {
        // The sender is this line's own.
        let _ = self.state.subscribe().wait_for(|state| *state == State::Silent).await;
    }

    async fn accept(self, listener: TcpListener) {
        let mut state = self.state.subscribe();
        loop {
            let is_silent = *state.borrow_and_update() == State::Silent;
            let near = tokio::select! {
                biased;
                changed = state.changed() => match changed {
                    Ok(()) => continue,
                    Err(_) => return,
                },
                Ok((near, _)) = listener.accept(), if !is_silent => near,
            };
            tokio::spawn(self.clone().carry(near));
        }
    }

    async fn carry(self, mut near: TcpStream) {
        let mut state = self.state.subscribe();
        if let Ok(mut far) = UnixStream::connect(&self.socket).await {
            let (near_read, near_write) = near.split();
            let (far_read, far_write) = far.split();
            tokio::select! {
                biased;
                _ = state.wait_for(|state| *state != State::Whole) => {}
                () = self.pass(near_read, far_write) => return,
                () = self.pass(far_read, near_write) => return,
            }
            // Both ends stay open behind a cut, whatever becomes of the line, unless it is broken off.
            let _ = state.wait_for(|state| *state == State::Broken).await;
        }
        let _ = near.set_zero_linger();
    }

    /// Until one end closes it.
    async fn pass(&self, mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin) {
        let mut buffer = vec![0; 64 * 1024];
        while let Ok(length @ 1..) = from.read(&mut buffer).await {
            let Some(bytes) = buffer.get(..length).filter(|_| *self.state.borrow() == State::Whole) else {
                return std::future::pending().await;
            };
            let is_commit = bytes.windows(6).any(|word| word == b"COMMIT");
            let trap = self.trap.lock().unwrap_or_else(PoisonError::into_inner).take_if(|_| is_commit);
            if trap != Some(Trap::BeforeCommit) && to.write_all(bytes).await.is_err() {
                return;
            }
            if trap.is_some() {
                self.cut();
            }
        }
    }
}
