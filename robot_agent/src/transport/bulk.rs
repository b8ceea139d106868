//! The bulk connection: software comes over it and old STATUS goes over it, so that neither stands before a heartbeat.
//!
//! Invariant: it is there only while it is used and [`IDLE`] longer, one for all who use it; what it is used for fails,
//! never waits, when it cannot be had. Called by [`crate::update::remote`] and, for old STATUS, by the shell.

use super::dial::Dial;
use super::replay::Replayed;
use midshift_core::limits;
use midshift_proto::link::v1::ReplayStatusRequest;
use midshift_proto::link::v1::replay_service_client::ReplayServiceClient;
use midshift_proto::parse;
use midshift_proto::session::StatusReplay;
use std::fmt;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;
use tokio::time::Instant;
use tonic::transport::Channel;
use tonic::{Code, Status};

/// A connection that nobody used for so long is closed.
pub const IDLE: Duration = Duration::from_secs(10);
/// A server that says nothing for so long is given up: one piece of 256 KiB over 40 kbit/s.
pub const SILENCE: Duration = Duration::from_secs(60);

/// The bulk connection of one robot. Cheap to clone: all clones are the same connection.
#[derive(Clone)]
pub struct Bulk {
    dial: Arc<dyn Dial>,
    line: Arc<Mutex<Line>>,
}

/// The connection.
#[derive(Default)]
struct Line {
    channel: Option<Channel>,
    users: usize,
    /// When the last of them left.
    idle_since: Option<Instant>,
    /// A task waits to close it.
    is_watched: bool,
}

fn lock(line: &Mutex<Line>) -> MutexGuard<'_, Line> {
    line.lock().unwrap_or_else(PoisonError::into_inner)
}

impl fmt::Debug for Bulk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Bulk").field("is_connected", &lock(&self.line).channel.is_some()).finish_non_exhaustive()
    }
}

impl Bulk {
    /// Over connections made by `dial`; none is made before the first use.
    pub fn new(dial: Arc<dyn Dial>) -> Self {
        Self { dial, line: Arc::default() }
    }

    /// One use of the connection, which is made if it is not there.
    ///
    /// # Errors
    /// A server that cannot be dialed within [`SILENCE`].
    pub(crate) async fn lease(&self) -> io::Result<Lease> {
        let open = lock(&self.line).channel.clone();
        let channel = match open {
            Some(channel) => channel,
            None => {
                let dialed = tokio::time::timeout(SILENCE, self.dial.dial()).await.map_err(|_| silent())?;
                dialed.map_err(|error| io::Error::new(io::ErrorKind::NotConnected, error.to_string()))?
            }
        };
        let mut line = lock(&self.line);
        line.channel = Some(channel.clone());
        line.users += 1;
        if !line.is_watched {
            line.is_watched = true;
            tokio::spawn(close_when_idle(Arc::downgrade(&self.line)));
        }
        Ok(Lease { line: self.line.clone(), channel })
    }

    /// Sends one batch of old STATUS and waits for its answer, as long as the server itself would.
    pub(crate) async fn replay(&self, replay: &StatusReplay) -> Replayed {
        let limit = Duration::from_millis(limits::UNARY_DEADLINE.as_ms());
        let answer = tokio::time::timeout(limit, self.ask_to_keep(replay)).await;
        answer.unwrap_or_else(|_| {
            lock(&self.line).channel = None;
            Replayed::Failed(silent().to_string())
        })
    }

    async fn ask_to_keep(&self, replay: &StatusReplay) -> Replayed {
        let lease = match self.lease().await {
            Ok(lease) => lease,
            Err(error) => return Replayed::Failed(error.to_string()),
        };
        let request = ReplayStatusRequest::from(replay);
        match ReplayServiceClient::new(lease.channel.clone()).replay_status(request).await {
            Ok(answer) => match parse(answer.into_inner()) {
                Ok(ack) => Replayed::Stored(ack),
                Err(refusal) => Replayed::Failed(format!("the answer cannot be read: {refusal}")),
            },
            Err(status) if status.code() == Code::Unimplemented => Replayed::NotServed,
            Err(status) => Replayed::Failed(lease.refused(&status).to_string()),
        }
    }
}

/// Lets the connection go once nobody used it for [`IDLE`].
async fn close_when_idle(line: Weak<Mutex<Line>>) {
    loop {
        let until = {
            let Some(line) = line.upgrade() else { return };
            let (mut line, now) = (lock(&line), Instant::now());
            match line.idle_since.filter(|_| line.users == 0).map(|since| since + IDLE) {
                Some(until) if until <= now => {
                    line.channel = None;
                    line.is_watched = false;
                    return;
                }
                until => until.unwrap_or(now + IDLE),
            }
        };
        tokio::time::sleep_until(until).await;
    }
}

/// One use of the connection.
pub(crate) struct Lease {
    line: Arc<Mutex<Line>>,
    /// The connection that is used.
    pub(crate) channel: Channel,
}

impl Lease {
    /// Whoever comes next dials anew.
    pub(crate) fn spoil(&self) {
        lock(&self.line).channel = None;
    }
    /// The error of an answer that did not come as it should.
    pub(crate) fn refused(&self, status: &Status) -> io::Error {
        if status.code() == Code::NotFound {
            return io::Error::new(io::ErrorKind::NotFound, status.message());
        }
        self.spoil();
        io::Error::other(format!("{}: {}", status.code(), status.message()))
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        let mut line = lock(&self.line);
        line.users -= 1;
        line.idle_since = Some(Instant::now());
    }
}

/// The error of a server that says nothing.
pub(crate) fn silent() -> io::Error {
    io::Error::new(io::ErrorKind::TimedOut, "the server is silent")
}
