//! Connections of bare loops, taken as every port of the binary takes its own.

use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;

/// Connections without Nagle's delay: a grant must not wait for an acknowledgement.
pub fn nodelay(
    listener: TcpListener,
) -> impl tokio_stream::Stream<Item = std::io::Result<tokio::net::TcpStream>> + Send + 'static {
    use tokio_stream::StreamExt;
    TcpListenerStream::new(listener).map(|stream| stream.and_then(|s| s.set_nodelay(true).map(|()| s)))
}
