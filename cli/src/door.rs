//! Says what was found at an address where no server of the site answers, by what the connection has said.

use crate::endpoint::Endpoint;
use std::error::Error;
use std::io::ErrorKind;
use std::iter::successors;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

/// Whatever breaks a gRPC call off is asked in HTTP/1.1 what it is, and answers within this or is not told.
const PROBED_WITHIN: Duration = Duration::from_secs(1);

/// What was found instead of a server of the site.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Found {
    /// Nothing listens there.
    Nothing,
    /// The connection was taken, and nothing was said on it in time.
    Silence,
    /// It speaks plain text, and TLS was spoken to it.
    PlainText,
    /// It speaks TLS, and plain text was spoken to it.
    Tls,
    /// It speaks HTTP/1.1 alone: a page, or metrics of another program.
    Page,
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

    /// What a server in plain text is that broke a call of gRPC off, by its first words to a request of HTTP/1.1.
    pub async fn by_probe(endpoint: &Endpoint) -> Self {
        let probe = async {
            let mut wire = endpoint.wire().await?;
            wire.write_all(b"GET / HTTP/1.1\r\nhost: midshift\r\nconnection: close\r\n\r\n").await?;
            let mut said = [0; 5];
            wire.read_exact(&mut said).await?;
            Ok::<_, std::io::Error>(said)
        };
        match tokio::time::timeout(PROBED_WITHIN, probe).await {
            Ok(Ok(said)) => Self::by_first_words(said),
            _ => Self::Unknown,
        }
    }

    const fn by_first_words(said: [u8; 5]) -> Self {
        match &said {
            b"HTTP/" => Self::Page,
            // An alert of TLS, of whichever version.
            [0x15, 3, _, 0, 2] => Self::Tls,
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
            Self::Tls => Some(
                "it speaks TLS, and plain text was spoken to it\n  try: sign in: midshift login SERVER --pin DIGEST, with the digest that it printed at its first start",
            ),
            Self::Page => Some(
                "it speaks HTTP/1.1 and no gRPC: a page, or metrics of another program\n  try: look at the port: midshift serves everything, its /metrics too, at 7420, and stops at 7421",
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
    use tokio::net::{TcpListener, TcpSocket};

    async fn found_over_tls(address: std::net::SocketAddr) -> Found {
        let root = rcgen::generate_simple_self_signed(["midshift".to_owned()]).expect("a root").cert.pem();
        let endpoint = Endpoint::secure(&address.to_string(), &root, None).expect("an endpoint");
        Found::by(&*endpoint.connect().await.expect_err("no server of the site").0)
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

    #[test]
    fn what_breaks_a_call_off_is_told_by_its_first_words() {
        let found = [*b"HTTP/", [0x15, 3, 3, 0, 2], [0x15, 3, 1, 0, 2], *b"220 m"].map(Found::by_first_words);
        assert_eq!(found, [Found::Page, Found::Tls, Found::Tls, Found::Unknown]);
    }

    #[tokio::test]
    async fn a_port_that_takes_the_connection_and_says_nothing_is_silent() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let found = found_over_tls(listener.local_addr().expect("its address")).await;
        assert_eq!((found, found.exit_code()), (Found::Silence, 10));
    }
}
