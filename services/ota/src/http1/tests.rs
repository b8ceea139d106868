//! Pages as plain HTTP clients ask for them.

use super::{RequestedRange, parse_range};
use crate::OtaService;
use crate::fixture::{files, release, service};
use axum::body::{Body, to_bytes};
use http::{HeaderMap, Request, StatusCode};
use midshift_bundle::digest::Digest;
use tempfile::TempDir;
use tower::ServiceExt;

struct Page {
    code: StatusCode,
    headers: HeaderMap,
    body: Vec<u8>,
}

impl Page {
    fn header(&self, name: &str) -> &str {
        self.headers.get(name).and_then(|v| v.to_str().ok()).unwrap_or_default()
    }
}

async fn ask(service: &OtaService, method: &str, path: &str, headers: &[(&str, &str)]) -> Page {
    let mut request = Request::builder().method(method).uri(path);
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    let request = request.body(Body::empty()).expect("a request");
    let response = service.pages().oneshot(request).await.expect("an answer");
    let (parts, body) = response.into_parts();
    let body = to_bytes(body, usize::MAX).await.expect("its bytes").to_vec();
    Page { code: parts.status, headers: parts.headers, body }
}

/// A service that shows walk 1.0.0, its component's path and bytes.
async fn world() -> (TempDir, OtaService, String, Vec<u8>) {
    let dir = TempDir::new().expect("a folder");
    let service = service(&dir).await;
    let files = files("walk", "1.0.0");
    release(&service, &files).await;
    let (name, content) = files[1].clone();
    let path = format!("/targets/{}.{name}", Digest::of_content(&content));
    (dir, service, path, content)
}

#[tokio::test]
async fn a_signed_file_is_given_whole_and_in_ranges() {
    let (_dir, service, path, content) = world().await;
    let whole = ask(&service, "GET", &path, &[]).await;
    assert_eq!((whole.code, &whole.body), (StatusCode::OK, &content));
    assert_eq!((whole.header("accept-ranges"), whole.header("content-length")), ("bytes", "16"));
    let length = content.len();
    for (range, expected, told) in [
        ("bytes=0-3", &content[..4], "bytes 0-3/16"),
        ("bytes=4-", &content[4..], "bytes 4-15/16"),
        ("bytes=-5", &content[length - 5..], "bytes 11-15/16"),
        ("bytes=10-999", &content[10..], "bytes 10-15/16"),
        ("bytes=-999", &content[..], "bytes 0-15/16"),
    ] {
        let part = ask(&service, "GET", &path, &[("range", range)]).await;
        assert_eq!((part.code, part.body.as_slice()), (StatusCode::PARTIAL_CONTENT, expected), "{range}");
        assert_eq!(part.header("content-range"), told);
        assert_eq!(part.header("content-length"), expected.len().to_string());
    }
    let beyond = ask(&service, "GET", &path, &[("range", "bytes=16-")]).await;
    assert_eq!((beyond.code, beyond.header("content-range")), (StatusCode::RANGE_NOT_SATISFIABLE, "bytes */16"));
}

#[tokio::test]
async fn a_head_tells_the_length_and_gives_no_bytes() {
    let (_dir, service, path, _) = world().await;
    let head = ask(&service, "HEAD", &path, &[]).await;
    assert_eq!((head.code, head.body.len(), head.header("content-length")), (StatusCode::OK, 0, "16"));
    let part = ask(&service, "HEAD", &path, &[("range", "bytes=2-3")]).await;
    assert_eq!((part.code, part.body.len(), part.header("content-length")), (StatusCode::PARTIAL_CONTENT, 0, "2"));
}

#[tokio::test]
async fn a_client_with_the_beginning_of_another_file_gets_this_one_whole() {
    let (_dir, service, path, content) = world().await;
    let etag = ask(&service, "HEAD", &path, &[]).await.header("etag").to_owned();
    let goes_on = ask(&service, "GET", &path, &[("range", "bytes=4-"), ("if-range", &etag)]).await;
    assert_eq!(goes_on.code, StatusCode::PARTIAL_CONTENT);
    let other = ask(&service, "GET", &path, &[("range", "bytes=4-"), ("if-range", "\"other\"")]).await;
    assert_eq!((other.code, other.body), (StatusCode::OK, content));
}

#[tokio::test]
async fn only_what_a_release_lists_is_given_and_only_by_its_name() {
    let (_dir, service, path, content) = world().await;
    let digest = Digest::of_content(&content);
    let unlisted = format!("/targets/{}.other.component", Digest::of_content(b"other"));
    let renamed = format!("/targets/{digest}.other.component");
    for path in [&unlisted, &renamed, "/targets/walk", "/targets/..%2Fkeys%2Fsnapshot-1.pem", &path.to_uppercase()] {
        assert_eq!(ask(&service, "GET", path, &[]).await.code, StatusCode::NOT_FOUND, "{path}");
    }
    for name in ["timestamp.json", "1.root.json", "1.snapshot.json", "1.targets.json"] {
        let page = ask(&service, "GET", &format!("/metadata/{name}"), &[]).await;
        assert_eq!((page.code, page.header("content-type")), (StatusCode::OK, "application/json"), "{name}");
        serde_json::from_slice::<serde_json::Value>(&page.body).expect("a document");
    }
    for name in ["2.root.json", "seen.json", "..%2F..%2Fkeys%2Fsnapshot-1.pem"] {
        assert_eq!(ask(&service, "GET", &format!("/metadata/{name}"), &[]).await.code, StatusCode::NOT_FOUND, "{name}");
    }
    assert_eq!(ask(&service, "PUT", &path, &[]).await.code, StatusCode::METHOD_NOT_ALLOWED);
}

#[tokio::test]
async fn a_server_without_keys_says_so() {
    let page = ask(&OtaService::without_keys(), "GET", "/metadata/timestamp.json", &[]).await;
    assert_eq!(page.code, StatusCode::SERVICE_UNAVAILABLE);
    assert!(String::from_utf8(page.body).expect("text").contains("--ota-keys"));
}

#[test]
fn ranges_are_read_as_the_standard_says() {
    let large = 1 << 33;
    for (header, length, expected) in [
        ("bytes=0-0", 10, RequestedRange::Part(0..1)),
        ("bytes=9-9", 10, RequestedRange::Part(9..10)),
        ("bytes=10-", 10, RequestedRange::Beyond),
        ("bytes=-0", 10, RequestedRange::Beyond),
        ("bytes=0-", 0, RequestedRange::Beyond),
        ("bytes=4294967296-4294967297", large, RequestedRange::Part((1 << 32)..(1 << 32) + 2)),
        ("bytes=99999999999999999999999-", 10, RequestedRange::Beyond),
        ("bytes=0-99999999999999999999999", 10, RequestedRange::Part(0..10)),
        ("bytes=5-4", 10, RequestedRange::Whole),
        ("bytes=-", 10, RequestedRange::Whole),
        ("bytes=0-1,3-4", 10, RequestedRange::Whole),
        ("bytes=+1-2", 10, RequestedRange::Whole),
        ("bytes=1--2", 10, RequestedRange::Whole),
        ("lines=1-2", 10, RequestedRange::Whole),
        ("", 10, RequestedRange::Whole),
    ] {
        assert_eq!(parse_range(header, length), expected, "{header} of {length}");
    }
}
