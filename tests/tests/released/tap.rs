//! Between robots and their server: everything that is said passes unchanged and is written down.
//!
//! Invariant: it knows no message. What a robot or server of a later build says passes too.

use midshift_tests::raw::Raw;
use midshift_tests::wire::Frame;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::future::Future;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;
use tokio_stream::{Stream, StreamExt};
use tokio_util::task::AbortOnDropHandle;
use tonic::body::Body;
use tonic::client::Grpc as Client;
use tonic::codegen::http::{Request as HttpRequest, Response as HttpResponse, uri::PathAndQuery};
use tonic::codegen::{Bytes, Service};
use tonic::server::{Grpc, NamedService, StreamingService};
use tonic::transport::{Channel, Endpoint, Server};
use tonic::{Request, Response, Status, Streaming};

/// Most frames that are kept: far more than a run has.
const FRAMES_MAX: usize = 100_000;

type Frames = Arc<Mutex<VecDeque<Frame>>>;
type BoxFuture<T> = Pin<Box<dyn Future<Output = T> + Send>>;
type Messages = Pin<Box<dyn Stream<Item = Result<Bytes, Status>> + Send>>;

/// The tap; its connections end with it.
pub struct Tap {
    /// Where robots dial.
    pub address: SocketAddr,
    frames: Frames,
    _serving: AbortOnDropHandle<Result<(), tonic::transport::Error>>,
}

impl Tap {
    /// In front of `server`, which need not be there yet.
    pub async fn before(server: SocketAddr) -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let address = listener.local_addr()?;
        let frames = Frames::default();
        let line =
            Line { server: Endpoint::from_shared(format!("http://{server}"))?.connect_lazy(), frames: frames.clone() };
        let serving = Server::builder()
            .add_service(Sessions(line.clone()))
            .add_service(Replays(line.clone()))
            .add_service(Releases(line.clone()))
            .add_service(Chunks(line))
            .serve_with_incoming(TcpListenerStream::new(listener));
        Ok(Self { address, frames, _serving: AbortOnDropHandle::new(tokio::spawn(serving)) })
    }
    /// What was said so far, in the order in which it passed.
    pub fn frames(&self) -> Vec<Frame> {
        self.frames.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
    }
}

#[derive(Clone)]
struct Line {
    server: Channel,
    frames: Frames,
}

impl Line {
    fn note(&self, path: &str, is_up: bool, bytes: &Bytes) {
        let mut frames = self.frames.lock().unwrap_or_else(PoisonError::into_inner);
        if frames.len() < FRAMES_MAX {
            frames.push_back(Frame { path: path.to_owned(), is_up, bytes: bytes.to_vec() });
        }
    }
    fn answer(self, request: HttpRequest<Body>) -> BoxFuture<Result<HttpResponse<Body>, Infallible>> {
        let call = Call { path: request.uri().path().to_owned(), line: self };
        Box::pin(async move { Ok(Grpc::new(Raw).streaming(call, request).await) })
    }
}

/// One call of a robot.
struct Call {
    path: String,
    line: Line,
}

impl StreamingService<Bytes> for Call {
    type Response = Bytes;
    type ResponseStream = Messages;
    type Future = BoxFuture<Result<Response<Messages>, Status>>;
    fn call(&mut self, request: Request<Streaming<Bytes>>) -> Self::Future {
        let (path, line) = (self.path.clone(), self.line.clone());
        Box::pin(async move {
            let (metadata, _, up) = request.into_parts();
            let (above, below) = ((path.clone(), line.clone()), (path.clone(), line.clone()));
            // A robot that breaks off ends what is passed on.
            let up = up.map_while(Result::ok).map(move |bytes| {
                above.1.note(&above.0, true, &bytes);
                bytes
            });
            let mut request = Request::new(up);
            *request.metadata_mut() = metadata;
            let target = PathAndQuery::try_from(path).map_err(|e| Status::internal(e.to_string()))?;
            let mut client = Client::new(line.server);
            client.ready().await.map_err(|e| Status::unavailable(e.to_string()))?;
            let (metadata, down, _) = client.streaming(request, target, Raw).await?.into_parts();
            let down = down.map(move |message| {
                if let Ok(bytes) = &message {
                    below.1.note(&below.0, false, bytes);
                }
                message
            });
            let mut response = Response::new(Box::pin(down) as Messages);
            *response.metadata_mut() = metadata;
            Ok(response)
        })
    }
}

macro_rules! services {
    ($($kind:ident $name:literal;)*) => {$(
        #[derive(Clone)]
        struct $kind(Line);
        impl NamedService for $kind {
            const NAME: &'static str = $name;
        }
        impl Service<HttpRequest<Body>> for $kind {
            type Response = HttpResponse<Body>;
            type Error = Infallible;
            type Future = BoxFuture<Result<HttpResponse<Body>, Infallible>>;
            fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
                Poll::Ready(Ok(()))
            }
            fn call(&mut self, request: HttpRequest<Body>) -> Self::Future {
                self.0.clone().answer(request)
            }
        }
    )*};
}

services! {
    Sessions "midshift.link.v1.LinkService";
    Replays "midshift.link.v1.ReplayService";
    Releases "midshift.ota.v1.BundleService";
    Chunks "midshift.ota.v1.ChunkService";
}
