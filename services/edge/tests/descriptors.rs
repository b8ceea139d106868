//! A process that has no descriptor left: the edge pauses, and serves who waited as soon as there is one.
//!
//! In a program of its own, since the limit is of the whole process.

use midshift_edge::{Anybody, Config, Edge, Listen};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::convert::Infallible;
use std::fs::File;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio_util::sync::CancellationToken;
use tonic::body::Body;

/// A socket whose refusals are counted.
struct Counted {
    listener: TcpListener,
    refused: Arc<AtomicUsize>,
}

impl Listen for Counted {
    type Io = TcpStream;
    async fn accept(&mut self) -> io::Result<Option<(TcpStream, SocketAddr)>> {
        let accepted = Listen::accept(&mut self.listener).await;
        self.refused.fetch_add(usize::from(accepted.is_err()), Ordering::SeqCst);
        accepted
    }
}

#[tokio::test]
async fn a_peer_that_came_while_there_was_no_descriptor_is_served_when_there_is_one() {
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.expect("a port");
    let address = listener.local_addr().expect("its address");
    let refused = Arc::new(AtomicUsize::new(0));
    let services =
        tower::service_fn(async |_: http::Request<Body>| Ok::<_, Infallible>(http::Response::new(Body::empty())));
    let edge = Edge::new(Config::default(), Arc::new(Anybody::default()), services);
    let stop = CancellationToken::new();
    let serving = tokio::spawn(edge.serve(Counted { listener, refused: refused.clone() }, stop.clone()));
    // The peer's own descriptor is taken first, then every other.
    let peer = TcpSocket::new_v4().expect("a socket");
    let limit = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: Some(64), ..limit }).expect("a lower limit");
    let mut taken: Vec<File> = Vec::new();
    while let Ok(file) = File::open("/dev/null") {
        taken.push(file);
    }
    let mut peer = peer.connect(address).await.expect("in the queue");
    peer.write_all(b"GET / HTTP/1.1\r\nhost: edge\r\nconnection: close\r\n\r\n").await.expect("written");
    let met = async {
        while refused.load(Ordering::SeqCst) < 3 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), met).await.expect("accept meets the limit");
    taken.clear();
    let mut said = String::new();
    let answered = tokio::time::timeout(Duration::from_secs(60), peer.read_to_string(&mut said)).await;
    answered.expect("an answer").expect("read");
    assert!(said.starts_with("HTTP/1.1 200"), "{said}");
    stop.cancel();
    assert_eq!(serving.await.expect("serving did not panic").cut, 0);
}
