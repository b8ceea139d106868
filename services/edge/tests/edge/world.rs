//! A port that is served, and clients of it.

use crate::frames::dial;
use crate::readings::Readings;
use crate::services::Services;
use bytes::Bytes;
use h2::client::SendRequest;
use http::{Request, Response};
use midshift_core::time::LinkDuration;
use midshift_edge::{Anybody, Config, Denials, Edge, Principals, Served};
use midshift_proto::status::{Answer, refusal_of};
use rustls::ServerConfig;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// The address that most clients come from, and another.
pub const HERE: [u8; 4] = [127, 0, 0, 1];
pub const THERE: [u8; 4] = [127, 0, 0, 2];

/// A limit that a test waits for.
pub const SOON: LinkDuration = LinkDuration(50);

/// No test waits for longer: one that would hang fails. Less than any default of the libraries beneath, so that none of them passes for ours.
pub async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(20), work).await.expect("what the test waits for happens")
}

pub struct World {
    pub address: SocketAddr,
    pub stop: CancellationToken,
    serving: JoinHandle<Served>,
    readings: &'static Readings,
    _recorder: metrics::LocalRecorderGuard<'static>,
}

impl World {
    /// Serves [`Services`] to anybody in plain text.
    pub async fn open(config: Config) -> Self {
        Self::with(config, Arc::new(Anybody::default()), None).await
    }

    pub async fn with(
        config: Config,
        principals: Arc<dyn Principals>,
        tls: Option<watch::Receiver<Arc<ServerConfig>>>,
    ) -> Self {
        Self::telling(config, principals, tls, None).await
    }

    /// With somebody who is told of denials.
    pub async fn telling(
        config: Config,
        principals: Arc<dyn Principals>,
        tls: Option<watch::Receiver<Arc<ServerConfig>>>,
        denials: Option<Denials>,
    ) -> Self {
        // Of this thread: each test has its own, and its runtime has no other thread.
        let readings: &'static Readings = Box::leak(Box::default());
        let _recorder = metrics::set_default_local_recorder(readings);
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.expect("a port");
        let address = listener.local_addr().expect("its address");
        let stop = CancellationToken::new();
        let edge = Edge::new(config, principals, Services::default());
        let edge = match tls {
            Some(newest) => edge.with_tls(newest),
            None => edge,
        };
        let edge = match denials {
            Some(denials) => edge.with_denials(denials),
            None => edge,
        };
        let serving = tokio::spawn(edge.serve(listener, stop.clone()));
        Self { address, stop, serving, readings, _recorder }
    }

    pub async fn client(&self) -> Client {
        self.client_from(HERE).await
    }
    pub async fn client_from(&self, from: [u8; 4]) -> Client {
        Client::over(dial(self.address, from).await).await
    }

    /// Asks until a connection from there is answered: one that was just closed may still be counted.
    pub async fn admitted_from(&self, from: [u8; 4]) -> Client {
        loop {
            let mut client = self.client_from(from).await;
            if client.ask("/who", None).await.is_some() {
                return client;
            }
        }
    }

    pub async fn stopped(self) -> Served {
        self.stop.cancel();
        within(self.serving).await.expect("serving did not panic")
    }

    /// A counter of the edge, by one of its labels.
    pub fn counter(&self, name: &str, label: (&str, &str)) -> u64 {
        self.readings.counter(name, label)
    }

    /// Connections that are open, as the gauge says.
    pub fn open_connections(&self) -> f64 {
        self.readings.gauge("midshift_edge_connections")
    }

    /// Requests under way, as the gauge says.
    pub fn requests_open(&self) -> usize {
        self.readings.gauge("midshift_edge_requests") as usize
    }

    /// Waits until a connection that ended for this reason is counted.
    pub async fn closed_for(&self, reason: &str) {
        self.closed_times(reason, 1).await;
    }
    pub async fn closed_times(&self, reason: &str, times: u64) {
        let counted = async {
            while self.counter("midshift_edge_closed_total", ("reason", reason)) < times {
                tokio::task::yield_now().await;
            }
        };
        within(counted).await;
    }
}

/// An HTTP/2 client that knows its protocol.
pub struct Client {
    sender: Option<SendRequest<Bytes>>,
    pub connection: JoinHandle<Result<(), h2::Error>>,
}

/// What came back whole.
#[derive(Debug)]
pub struct Whole {
    pub head: Response<()>,
    pub body: Vec<u8>,
    pub status: Status,
}

impl Whole {
    pub fn header(&self, name: &str) -> &str {
        self.head.headers().get(name).and_then(|v| v.to_str().ok()).unwrap_or_default()
    }
    pub fn answer(&self) -> Answer {
        refusal_of(&self.status)
    }
}

impl Client {
    pub async fn over(io: impl AsyncRead + AsyncWrite + Unpin + Send + 'static) -> Self {
        let Ok((sender, connection)) = h2::client::handshake(io).await else {
            return Self { sender: None, connection: tokio::spawn(async { Ok(()) }) };
        };
        Self { sender: Some(sender), connection: tokio::spawn(connection) }
    }

    pub fn of(sender: SendRequest<Bytes>, connection: JoinHandle<Result<(), h2::Error>>) -> Self {
        Self { sender: Some(sender), connection }
    }

    /// Sends the head of a call, `grpc-timeout` included; the body is whole and empty.
    pub async fn begin(&mut self, path: &str, timeout: Option<&str>) -> Option<h2::client::ResponseFuture> {
        let mut request = Request::post(format!("http://edge{path}")).header("content-type", "application/grpc");
        if let Some(timeout) = timeout {
            request = request.header("grpc-timeout", timeout);
        }
        self.send(request.body(()).expect("a request")).await
    }

    /// A call of that path that stays open; none: it was refused.
    pub async fn held(&mut self, path: &str) -> Option<Response<h2::RecvStream>> {
        let request = Request::post(format!("http://edge{path}")).header("content-type", "application/grpc");
        let request = request.header("hold", "yes").body(()).expect("a request");
        let response = within(within(self.send(request)).await?).await.ok()?;
        (!response.headers().contains_key("grpc-status")).then_some(response)
    }

    pub async fn send(&mut self, request: Request<()>) -> Option<h2::client::ResponseFuture> {
        let mut sender = self.sender.clone()?.ready().await.ok()?;
        Some(sender.send_request(request, true).ok()?.0)
    }

    /// Streams that the port allows at a time, as far as it has said so.
    pub fn streams_allowed(&self) -> usize {
        self.sender.as_ref().map_or(0, SendRequest::current_max_send_streams)
    }

    /// The whole answer; none: the connection ended before.
    pub async fn ask(&mut self, path: &str, timeout: Option<&str>) -> Option<Whole> {
        let response = within(self.begin(path, timeout)).await?;
        whole(within(response).await.ok()?).await
    }

    /// One that must come.
    pub async fn asked(&mut self, path: &str) -> Whole {
        self.ask(path, None).await.expect("an answer")
    }
}

/// The rest of an answer.
pub async fn whole(response: Response<h2::RecvStream>) -> Option<Whole> {
    let (parts, mut stream) = response.into_parts();
    let mut body = Vec::new();
    while let Some(bytes) = within(stream.data()).await {
        let bytes = bytes.ok()?;
        let _ = stream.flow_control().release_capacity(bytes.len());
        body.extend(bytes);
    }
    let trailers = within(stream.trailers()).await.ok()?;
    let told = trailers.as_ref().and_then(Status::from_header_map);
    let status = told.or_else(|| Status::from_header_map(&parts.headers));
    let status = status.unwrap_or_else(|| Status::unknown("no status"));
    Some(Whole { head: Response::from_parts(parts, ()), body, status })
}
