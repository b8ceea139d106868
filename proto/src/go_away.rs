//! Notifies the streams of a connection that the port is about to send GOAWAY on it.
//!
//! Invariant: it is no more than a hint. A stream that ignores it loses the connection a little later, as any connection may be lost.

use tokio_util::sync::CancellationToken;

/// The notice of one connection, in the extensions of each of its requests. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct GoAwayNotice(CancellationToken);

impl GoAwayNotice {
    /// The notice of the connection that a request came on. Without a port it is never given.
    pub fn from_request<T>(request: &tonic::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_default()
    }
    /// Resolves when the notice is given. A stream uses the time until GOAWAY to send its peer elsewhere.
    pub async fn begun(&self) {
        self.0.cancelled().await;
    }
    /// Gives the notice.
    pub fn begin(&self) {
        self.0.cancel();
    }
}
