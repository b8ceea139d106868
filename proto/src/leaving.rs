//! That a connection is about to be asked to go: said by the port, heard by whoever holds a stream on it.
//!
//! Invariant: no more than a hint. Who does not hear it loses the connection a little later, as any connection may be lost.

use tokio_util::sync::CancellationToken;

/// Of one connection, in the extensions of each of its requests. Clones are the same.
#[derive(Clone, Debug, Default)]
pub struct Leaving(CancellationToken);

impl Leaving {
    /// Of the connection that a request came on. One that came through no port is never asked to go.
    pub fn from_request<T>(request: &tonic::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_default()
    }
    /// Resolves when it is about to be asked to go. Whoever holds a stream on it uses the time to send its peer elsewhere.
    pub async fn begun(&self) {
        self.0.cancelled().await;
    }
    /// From now on it is.
    pub fn begin(&self) {
        self.0.cancel();
    }
}
