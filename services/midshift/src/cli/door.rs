//! Says what was found at an address where no server of the site answers, by what the connection has said.

use std::error::Error;
use std::io::ErrorKind;
use std::iter::successors;

/// What was found instead of a server of the site.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Found {
    /// Nothing listens there.
    Nothing,
    /// The connection was taken, and nothing was said on it in time.
    Silence,
    /// It speaks plain text, and TLS was spoken to it.
    PlainText,
    /// It has proven itself as a server of another site.
    OtherSite,
    /// The connection ended, and nobody knows why.
    Unknown,
}

impl Found {
    /// By the causes of a connection that was not made.
    pub fn by(error: &(dyn Error + 'static)) -> Self {
        successors(Some(error), |error| (*error).source())
            .map(Self::by_one)
            .find(|f| *f != Self::Unknown)
            .unwrap_or(Self::Unknown)
    }

    fn by_one(error: &(dyn Error + 'static)) -> Self {
        let kind = error.downcast_ref::<std::io::Error>().map(std::io::Error::kind);
        match (kind, error.to_string()) {
            (Some(ErrorKind::ConnectionRefused), _) => Self::Nothing,
            (_, text) if text.contains("certificate") => Self::OtherSite,
            // What TLS makes of letters.
            (_, text) if text.contains("InvalidContentType") => Self::PlainText,
            (Some(ErrorKind::TimedOut), _) => Self::Silence,
            (_, text) if text.contains("deadline has elapsed") => Self::Silence,
            _ => Self::Unknown,
        }
    }

    /// The exit code of a command that has found this.
    pub const fn exit_code(self) -> u8 {
        match self {
            Self::Silence => 10,
            _ => 5,
        }
    }

    /// What it is and what to try; none: the caller knows better.
    pub const fn help(self) -> Option<&'static str> {
        match self {
            Self::Nothing | Self::Unknown | Self::OtherSite => None,
            Self::Silence => Some(
                "whatever is there takes no connection, or takes it and says nothing\n  try: look at that process: it may hang, or be no midshift at all",
            ),
            Self::PlainText => Some(
                "it speaks plain text, and TLS was spoken to it\n  try: leave out --ca and the context if it is a server without login (`midshift dev`, --insecure); else look at the port",
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::way::Way;
    use tokio::io::AsyncWriteExt;
    use tokio::net::{TcpListener, TcpSocket};

    async fn found_over_tls(address: std::net::SocketAddr) -> Found {
        let root = rcgen::generate_simple_self_signed(["midshift".to_owned()]).expect("a root").cert.pem();
        let way = Way::secure(&address.to_string(), &root, None).expect("a way");
        Found::by(&*way.connect().await.expect_err("no server of the site").0)
    }

    #[tokio::test]
    async fn a_dead_port_is_told_from_one_that_speaks_plain_text() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("its address");
        let answering = async {
            let (mut stream, _) = listener.accept().await.expect("a connection");
            stream.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n").await.expect("an answer");
            stream
        };
        let (found, _stream) = tokio::join!(found_over_tls(address), answering);
        assert_eq!((found, found.exit_code()), (Found::PlainText, 5));

        // Bound, so that nobody else gets the port; nothing listens on it.
        let socket = TcpSocket::new_v4().expect("a socket");
        socket.bind("127.0.0.1:0".parse().expect("an address")).expect("a port");
        let dead = socket.local_addr().expect("its address");
        assert_eq!(found_over_tls(dead).await, Found::Nothing);
    }

    #[tokio::test]
    async fn a_port_that_takes_the_connection_and_says_nothing_is_silent() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let found = found_over_tls(listener.local_addr().expect("its address")).await;
        assert_eq!((found, found.exit_code()), (Found::Silence, 10));
    }
}
