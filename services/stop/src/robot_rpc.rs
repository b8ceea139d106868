//! The robots' face, by hand: what generated code does, with messages that are bytes already.
//!
//! A stop goes to all robots as it was encoded once. Invariant: the wire is that of `stop_link_service.proto`; a generated client cannot tell.

use crate::downlink::Down;
use crate::inner::Inner;
use crate::line;
use bytes::{BufMut, Bytes};
use midshift_core::limits;
use midshift_proto::access::caller;
use midshift_proto::codec::small_buffers;
use midshift_proto::stop::v1;
use midshift_proto::{DenialReporter, GoAwayNotice};
use std::convert::Infallible;
use std::sync::Arc;
use std::task::{Context, Poll};
use tonic::body::Body;
use tonic::codec::{BufferSettings, Codec, EncodeBuf, Encoder};
use tonic::codegen::{Body as HttpBody, BoxFuture, Service, StdError, http};
use tonic::server::{Grpc, NamedService, StreamingService};
use tonic::{Request, Response, Status, Streaming};
use tonic_prost::ProstDecoder;

/// `midshift.stop.v1.StopLinkService`. Cheap to clone.
#[derive(Clone)]
pub(crate) struct LinkFace(pub Arc<Inner>);

struct Ready;
struct AsIs;

impl Codec for Ready {
    type Encode = Bytes;
    type Decode = v1::AttendRequest;
    type Encoder = AsIs;
    type Decoder = ProstDecoder<v1::AttendRequest>;

    fn encoder(&mut self) -> AsIs {
        AsIs
    }
    fn decoder(&mut self) -> Self::Decoder {
        ProstDecoder::new(small_buffers())
    }
}

impl Encoder for AsIs {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(item);
        Ok(())
    }
    fn buffer_settings(&self) -> BufferSettings {
        small_buffers()
    }
}

struct Attend(Arc<Inner>);

impl StreamingService<v1::AttendRequest> for Attend {
    type Response = Bytes;
    type ResponseStream = Down;
    type Future = BoxFuture<Response<Down>, Status>;

    fn call(&mut self, request: Request<Streaming<v1::AttendRequest>>) -> Self::Future {
        let (inner, by, go_away) = (self.0.clone(), caller(&request), GoAwayNotice::from_request(&request));
        let reporter = DenialReporter::from_request(&request);
        Box::pin(async move { line::accept_line(inner, &by, go_away, &reporter, request.into_inner()).await })
    }
}

impl<B> Service<http::Request<B>> for LinkFace
where
    B: HttpBody + Send + 'static,
    B::Error: Into<StdError> + Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        let inner = self.0.clone();
        Box::pin(async move {
            if request.uri().path() != "/midshift.stop.v1.StopLinkService/Attend" {
                return Ok(Status::unimplemented("").into_http());
            }
            // A robot brings up to 256 stops with 128 boxes each.
            let mut grpc = Grpc::new(Ready).apply_max_message_size_config(Some(limits::TELEMETRY_BATCH_BYTES), None);
            Ok(grpc.streaming(Attend(inner), request).await)
        })
    }
}

impl NamedService for LinkFace {
    const NAME: &'static str = "midshift.stop.v1.StopLinkService";
}
