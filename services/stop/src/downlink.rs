//! What a robot's connection reads: its outbox, as a stream.
//!
//! Invariant: the connection itself reads it: no task stands between a stop and the socket. One that is gone says so to its line.

use crate::inner::Inner;
use crate::outbox::Outbox;
use bytes::Bytes;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tokio_stream::Stream;
use tonic::Status;

/// What the connection reads.
pub struct Down {
    inner: Arc<Inner>,
    outbox: Arc<Outbox>,
}

impl Down {
    /// Of an outbox.
    pub fn new(inner: Arc<Inner>, outbox: Arc<Outbox>) -> Self {
        Self { inner, outbox }
    }
}

impl Drop for Down {
    fn drop(&mut self) {
        self.outbox.gone.cancel();
    }
}

impl Stream for Down {
    type Item = Result<Bytes, Status>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.outbox.poll_next(&self.inner.engaged_stops, &self.inner.key, cx)
    }
}
