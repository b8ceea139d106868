//! To whom bytes are given.

use crate::fixture::{START, files, release, service};
use axum::body::Body;
use http::StatusCode;
use midshift_bundle::digest::Digest;
use midshift_core::identity::{Caller, Digest as Key, Replace, RobotIdentity};
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Item;
use midshift_core::reason::Code;
use midshift_core::rows::Writer;
use midshift_core::time::{ScaledClock, Utc};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::chunk_service_server::ChunkService;
use midshift_proto::refusal_of;
use midshift_store::{MemoryStore, Store, StoreId};
use std::sync::Arc;
use tempfile::TempDir;
use tonic::{Request, Status};
use tower::ServiceExt;

/// Whoever shows a genuine certificate of this robot, with a key of such bytes.
fn machine(robot_id: &str, byte: u8) -> Caller {
    Caller::robot(RobotId::parse(robot_id).expect("an id")).with_key(Key([byte; 32]))
}

/// Rows that know r1, by the key of bytes 7.
async fn rows() -> Arc<dyn Store> {
    let clock = Arc::new(ScaledClock::new(|| 0, START, 1000));
    let store = MemoryStore::new(SiteId::parse("s").expect("a site"), StoreId(Arc::from("store")), clock);
    let mut robot = RobotIdentity::new(RobotId::parse("r1").expect("an id"));
    robot.adopt(Key([7; 32]), Replace::No, START, Utc(i64::MAX)).expect("adopted");
    let mut item = Item::new(Writer::Identity, "tests");
    item.create(&robot, "robot.adopted");
    store.commit(vec![item]).await.remove(0).expect("applied");
    Arc::new(store)
}

fn asked<T>(by: &Caller, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.extensions_mut().insert(by.clone());
    request
}

fn code(status: &Status) -> Option<Code> {
    refusal_of(status).code
}

#[tokio::test]
async fn bytes_are_given_to_machines_that_are_enrolled_and_to_no_other_with_a_genuine_certificate() {
    let dir = TempDir::new().expect("a folder");
    let service = service(&dir).await;
    let files = files("walk", "1.0.0");
    release(&service, &files).await;
    let service = service.with_rows(rows().await);
    let (downloads, (name, content)) = (service.downloads(), &files[1]);
    let digest = Digest::of_content(content).to_string();
    let known = [machine("r1", 7), Caller::local()].map(|by| (by, None::<Code>, StatusCode::OK));
    let unknown = [machine("r1", 8), machine("r2", 7)];
    let unknown = unknown.map(|by| (by, Some(Code::RobotNotEnrolled), StatusCode::FORBIDDEN));
    for (by, refusal, status) in known.into_iter().chain(unknown) {
        let request = v1::GetEncodingRequest { digest: digest.clone(), ..Default::default() };
        let answer = downloads.get_encoding(asked(&by, request)).await;
        assert_eq!(answer.err().as_ref().and_then(code), refusal, "{by}");
        let request = v1::FetchChunksRequest { digest: digest.clone(), offset: 0, length: 16 };
        let answer = downloads.fetch_chunks(asked(&by, request)).await;
        assert_eq!(answer.err().as_ref().and_then(code), refusal, "{by}");
        let page = http::Request::builder().uri(format!("/targets/{digest}.{name}")).extension(by.clone());
        let page = service.pages().oneshot(page.body(Body::empty()).expect("a request")).await.expect("an answer");
        assert_eq!(page.status(), status, "{by}");
    }
}
