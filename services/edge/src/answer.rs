//! The edge's own answers, in the language of whoever asked: gRPC, gRPC-Web or plain HTTP.
//!
//! Invariant: every refusal goes through `midshift-proto`'s one door to a status; a request that is refused here has reached no service and
//! its body was not read.

use http::header::{CONTENT_TYPE, RETRY_AFTER};
use http::{HeaderMap, HeaderValue, Response, StatusCode};
use midshift_core::reason::{Kind, Refusal};
use midshift_proto::status;
use tonic::Status;
use tonic::body::Body;

/// What a request speaks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Speech {
    /// A call of gRPC.
    Grpc,
    /// gRPC-Web, with its own content type.
    GrpcWeb(HeaderValue),
    /// Anything else: pages and metrics.
    Http,
}

impl Speech {
    pub fn from_headers(headers: &HeaderMap) -> Self {
        let kind = headers.get(CONTENT_TYPE);
        match kind.map(HeaderValue::as_bytes) {
            Some(bytes) if bytes.starts_with(b"application/grpc-web") => {
                kind.cloned().map_or(Self::Http, Self::GrpcWeb)
            }
            Some(bytes) if bytes.starts_with(b"application/grpc") => Self::Grpc,
            _ => Self::Http,
        }
    }

    /// An answer of a service; a message that tonic found too large is refused with its reason.
    pub fn reasoned(&self, response: Response<Body>) -> Response<Body> {
        match Status::from_header_map(response.headers()).and_then(|status| status::too_large(&status)) {
            Some(refusal) => self.refuse(&refusal),
            None => response,
        }
    }

    /// A refusal before anything of an answer is sent: for gRPC trailers alone.
    pub fn refuse(&self, refusal: &Refusal) -> Response<Body> {
        match self {
            Self::Grpc => status::status(refusal, None).into_http(),
            Self::GrpcWeb(kind) => {
                let mut response = status::status(refusal, None).into_http::<Body>();
                response.headers_mut().insert(CONTENT_TYPE, kind.clone());
                response
            }
            Self::Http => page(refusal),
        }
    }
}

fn page(refusal: &Refusal) -> Response<Body> {
    let mut response = Response::new(Body::new(format!("{refusal}\n")));
    *response.status_mut() = match refusal.kind() {
        Kind::Exhausted => StatusCode::TOO_MANY_REQUESTS,
        Kind::Deadline => StatusCode::GATEWAY_TIMEOUT,
        Kind::Invalid => StatusCode::BAD_REQUEST,
        Kind::Unauthenticated => StatusCode::UNAUTHORIZED,
        Kind::Denied => StatusCode::FORBIDDEN,
        _ => StatusCode::SERVICE_UNAVAILABLE,
    };
    if refusal.kind() == Kind::Exhausted {
        response.headers_mut().insert(RETRY_AFTER, status::RETRY_AFTER.as_secs().into());
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::reason::Code;

    fn refused(content_type: Option<&'static str>) -> Response<Body> {
        let headers = content_type.map(|kind| (CONTENT_TYPE, HeaderValue::from_static(kind)));
        let speech = Speech::from_headers(&headers.into_iter().collect());
        speech.refuse(&Refusal::new(Kind::Exhausted, Code::TooManyRequests))
    }

    #[test]
    fn each_is_refused_in_its_own_language() {
        let grpc = refused(Some("application/grpc"));
        assert_eq!((grpc.status(), &grpc.headers()["grpc-status"]), (StatusCode::OK, &HeaderValue::from_static("8")));
        assert!(grpc.headers().contains_key("grpc-status-details-bin"));
        let web = refused(Some("application/grpc-web-text"));
        assert_eq!(
            (&web.headers()["grpc-status"], &web.headers()[CONTENT_TYPE]),
            (&HeaderValue::from_static("8"), &HeaderValue::from_static("application/grpc-web-text"))
        );
        for other in [None, Some("text/plain")] {
            let page = refused(other);
            assert_eq!(
                (page.status(), &page.headers()[RETRY_AFTER]),
                (StatusCode::TOO_MANY_REQUESTS, &HeaderValue::from_static("1"))
            );
        }
    }
}
