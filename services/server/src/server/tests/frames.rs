//! Whoever announces a message that is too large is refused before a byte of it is taken: at each service of both ports, and by nobody known much earlier.

use super::super::*;
use super::parts;
use crate::planning::Planning;
use axum::body::HttpBody;
use http::Request;
use midshift_core::identity::Caller;
use midshift_identity::{Duty, IdentityService};
use midshift_proto::access;
use prost_reflect::DescriptorPool;
use std::future::poll_fn;
use std::pin::pin;
use tokio_stream::StreamExt;
use tonic::body::Body;
use tonic::{Code, Status};
use tower::ServiceExt;

/// What tonic takes of anybody if it is told nothing is one byte more.
const LARGE: usize = 4 * 1024 * 1024 - 1;

/// Every path that has a method, health and reflection among them.
fn paths() -> Vec<String> {
    let pool = DescriptorPool::decode(midshift_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
    let ours = pool.services().flat_map(|service| {
        service.methods().map(|method| format!("/{}/{}", service.full_name(), method.name())).collect::<Vec<_>>()
    });
    let foreign = [
        "/grpc.health.v1.Health/Check",
        "/grpc.health.v1.Health/Watch",
        "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
    ];
    ours.chain(foreign.map(str::to_owned)).collect()
}

/// What a call of that path ends with whose first message was announced with so many bytes, of which none come.
async fn announced(routes: &Routes, path: &str, bytes: usize) -> Status {
    let head = [&[0][..], &u32::try_from(bytes).expect("a size of the wire").to_be_bytes()].concat();
    let body = tokio_stream::once(Ok::<_, std::convert::Infallible>(head)).chain(tokio_stream::pending());
    // gRPC of another version of HTTP is turned away before any service.
    let request = Request::post(path).version(http::Version::HTTP_2).header("content-type", "application/grpc");
    let request = request.body(Body::new(axum::body::Body::from_stream(body))).expect("a request");
    let answered = async {
        let (head, body) = routes.clone().oneshot(request).await.expect("never fails").into_parts();
        if let Some(status) = Status::from_header_map(&head.headers) {
            return status;
        }
        let mut body = pin!(body);
        while let Some(frame) = poll_fn(|cx| body.as_mut().poll_frame(cx)).await {
            let Ok(frame) = frame else { break };
            if let Some(status) = frame.trailers_ref().and_then(Status::from_header_map) {
                return status;
            }
        }
        panic!("{path} ends without a status: {}", head.status)
    };
    let within = tokio::time::timeout(Duration::from_secs(20), answered).await;
    within.unwrap_or_else(|_| panic!("{path} waits for {bytes} bytes"))
}

#[tokio::test]
async fn a_message_that_is_too_large_is_refused_when_it_is_announced_at_each_service_of_both_ports()
-> anyhow::Result<()> {
    let (folder, planning, stop) = (tempfile::tempdir()?, Planning::start()?, CancellationToken::new());
    let mut parts = parts(&planning)?;
    let identity = midshift_identity::Parts {
        folder: folder.path().join("identity"),
        store: parts.store.clone(),
        clock: parts.clock.clone(),
        duty: Duty::CertificateAuthority,
        names: Vec::new(),
        trust_json: String::new(),
    };
    parts.identity = Some(IdentityService::open(identity, &stop).await?);
    let stops = midshift_stop::Parts { folder: folder.path().join("stop"), site: None, clock: parts.clock.clone() };
    let stops = midshift_stop::StopService::open(stops, stop.clone())?.routes().await?;
    let (business, _health) = Server::new(parts, stop.clone()).await?.routes().await?;
    let (mut of_anybody, mut others) = (0, 0);
    for path in paths() {
        if path.starts_with("/midshift.sim.") {
            continue;
        }
        for (name, routes) in [("business", &business), ("stop", &stops)] {
            let is_of_stop = path.starts_with("/midshift.stop.");
            if path.starts_with("/midshift.") && is_of_stop != (name == "stop") {
                continue;
            }
            // Signed documents are larger, and are taken of whoever may publish.
            let is_signed = path.starts_with("/midshift.ota.v1.BundleService/");
            let status = announced(routes, &path, if is_signed { 4 * LARGE } else { LARGE }).await;
            // Reflection ends its stream without a word; what counts is that it waits for nothing.
            assert!(status.code() != Code::Ok || path.starts_with("/grpc.reflection."), "{name} {path}");
            assert_ne!(status.code(), Code::Unimplemented, "{name} {path} is not there, and nothing was tried");
            // What comes further than the head without a certificate or a token.
            if access::check(&Caller::nobody(), &path).is_ok() {
                let least = if path.starts_with("/grpc.health.") { 1_025 } else { limits::CONTROL_MESSAGE_BYTES + 1 };
                let status = announced(routes, &path, least).await;
                assert_eq!(status.code(), Code::OutOfRange, "{name} {path}: {status}");
                of_anybody += 1;
            } else {
                others += 1;
            }
        }
    }
    assert!(of_anybody >= 3 && others > 70, "{of_anybody} {others}");
    stop.cancel();
    Ok(())
}
