//! What is served behind the edge in these tests: answers that come, that never come, and that go on.

use bytes::Bytes;
use http::{HeaderMap, HeaderValue, Request, Response};
use http_body::{Body as HttpBody, Frame};
use http_body_util::StreamBody;
use midshift_core::identity::Caller;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_edge::Peer;
use midshift_proto::DenialReporter;
use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tokio::sync::{Notify, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::body::Body;
use tower::Service;

/// Answers by path: `/who` tells who asked, `/hang` never answers, `/panic` has a fault, `/stream` answers and goes on without a word, `/pulse` says a word for each
/// `/poke`, `/go_away` ends when its connection is about to be asked to go. Any path with a header `hold` is as `/stream`; with `deny`
/// it says that it denies what the port let in.
#[derive(Clone, Default)]
pub struct Services {
    poked: Arc<Notify>,
}

type Answer = Pin<Box<dyn Future<Output = Result<Response<Body>, Infallible>> + Send>>;

impl Service<Request<Body>> for Services {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = Answer;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<Body>) -> Answer {
        let poked = self.poked.clone();
        Box::pin(async move { Ok(answer(request, poked).await) })
    }
}

async fn answer(request: Request<Body>, poked: Arc<Notify>) -> Response<Body> {
    let peer = request.extensions().get::<Peer>().expect("each request says who asks").clone();
    let path = request.uri().path().to_owned();
    if request.headers().contains_key("deny") {
        let reason = Reason::from(Code::NotThisRobot).with("robot_id", "r8");
        DenialReporter::from_request(&tonic::Request::from_http(request)).report(&Refusal::new(Kind::Denied, reason));
        return ok(Vec::new());
    }
    if request.headers().contains_key("hold") {
        return grpc(Body::new(Silent { _request: request.into_body() }));
    }
    match path.as_str() {
        "/hang" => std::future::pending().await,
        "/panic" => panic!("a fault of a service"),
        "/stream" | "/midshift.telemetry.v1.TelemetryService/WatchRobots" => {
            grpc(Body::new(Silent { _request: request.into_body() }))
        }
        "/pulse" => {
            let (sender, said) = mpsc::channel(1);
            tokio::spawn(async move {
                loop {
                    poked.notified().await;
                    if sender.send(Ok::<_, Infallible>(Frame::data(Bytes::from_static(b"beat")))).await.is_err() {
                        return;
                    }
                }
            });
            grpc(Body::new(StreamBody::new(ReceiverStream::new(said))))
        }
        "/poke" => {
            poked.notify_one();
            ok(Vec::new())
        }
        "/leaving" => {
            let (sender, said) = mpsc::channel(1);
            tokio::spawn(async move {
                peer.go_away().await;
                let _ = sender.send(Ok::<_, Infallible>(Frame::trailers(status_ok()))).await;
            });
            grpc(Body::new(StreamBody::new(ReceiverStream::new(said))))
        }
        _ => {
            let principal = request.extensions().get::<Caller>().map(ToString::to_string).unwrap_or_default();
            let leaf = peer.certificate.as_ref().map(|leaf| leaf.to_vec()).unwrap_or_default();
            let mut response = ok(leaf);
            let put = |text: String| HeaderValue::from_str(&text).expect("plain text");
            response.headers_mut().insert("principal", put(principal));
            response.headers_mut().insert("address", put(peer.address.ip().to_string()));
            response.headers_mut().insert("connection-id", put(peer.connection.to_string()));
            response
        }
    }
}

fn status_ok() -> HeaderMap {
    [(tonic::Status::GRPC_STATUS, HeaderValue::from_static("0"))].into_iter().collect()
}

fn grpc(body: Body) -> Response<Body> {
    let mut response = Response::new(body);
    response.headers_mut().insert("content-type", HeaderValue::from_static("application/grpc"));
    response
}

fn ok(body: Vec<u8>) -> Response<Body> {
    let mut response = grpc(Body::new(http_body_util::Full::new(Bytes::from(body))));
    response.headers_mut().extend(status_ok());
    response
}

/// A stream that is open and says nothing, as most watches most of the time. Keeps its request open as well.
struct Silent {
    _request: Body,
}

impl HttpBody for Silent {
    type Data = Bytes;
    type Error = Infallible;
    fn poll_frame(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        Poll::Pending
    }
}
