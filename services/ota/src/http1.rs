//! Plain HTTP for clients of TUF that are not ours: `/metadata/<name>` and `/targets/<sha256>.<name>`, with ranges.
//!
//! Invariant: the same documents and files as over gRPC, and no other; nothing is changed over HTTP.

use crate::downloads::Downloads;
use axum::Router;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use http::header::{ACCEPT_RANGES, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_RANGE, RANGE};
use http::{Extensions, HeaderMap, StatusCode};
use midshift_bundle::digest::Digest;
use midshift_core::identity::Caller;
use midshift_core::limits;
use midshift_core::reason::{Kind, Refusal};
use std::ops::Range;
use tokio_util::io::ReaderStream;

/// What a name stands for never changes.
const FOR_EVER: &str = "public, max-age=31536000, immutable";

/// The two kinds of pages.
pub fn router(downloads: Downloads) -> Router {
    Router::new().route("/metadata/{name}", get(metadata)).route("/targets/{name}", get(target)).with_state(downloads)
}

fn refused(refusal: &Refusal) -> Response {
    let code = match refusal.kind() {
        Kind::NotFound => StatusCode::NOT_FOUND,
        Kind::Invalid => StatusCode::BAD_REQUEST,
        Kind::Denied => StatusCode::FORBIDDEN,
        Kind::Internal => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        _ => StatusCode::SERVICE_UNAVAILABLE,
    };
    (code, format!("{refusal}\n")).into_response()
}

async fn metadata(State(downloads): State<Downloads>, Path(name): Path<String>) -> Response {
    let found = match downloads.shown() {
        Ok(shown) => shown.documents.document(&name).await.map_err(Refusal::from),
        Err(refusal) => Err(refusal),
    };
    match found {
        Ok(Some(document)) => {
            let life = if name == "timestamp.json" { "no-cache" } else { FOR_EVER };
            ([(CONTENT_TYPE, "application/json"), (CACHE_CONTROL, life)], document).into_response()
        }
        Ok(None) => (StatusCode::NOT_FOUND, "no such document\n").into_response(),
        Err(refusal) => refused(&refusal),
    }
}

async fn target(
    State(downloads): State<Downloads>,
    Path(name): Path<String>,
    extensions: Extensions,
    headers: HeaderMap,
) -> Response {
    let by = extensions.get::<Caller>().cloned().unwrap_or_else(Caller::nobody);
    if let Err(refusal) = downloads.must_be_enrolled(&by).await {
        return refused(&refusal);
    }
    match send(&downloads, &name, &headers).await {
        Ok(Some(response)) => response,
        Ok(None) => (StatusCode::NOT_FOUND, "no such file\n").into_response(),
        Err(refusal) => refused(&refusal),
    }
}

/// A signed file, or a range of it; none: no release lists it under this digest and name.
async fn send(downloads: &Downloads, name: &str, headers: &HeaderMap) -> Result<Option<Response>, Refusal> {
    let shown = downloads.shown()?;
    let Some((digest, name)) = name.split_once('.') else { return Ok(None) };
    let Ok(digest) = digest.parse::<Digest>() else { return Ok(None) };
    if let Err(refusal) = downloads.listed(digest).await {
        return if refusal.kind() == Kind::NotFound { Ok(None) } else { Err(refusal) };
    }
    let newest = shown.documents.newest();
    let Some(file) = newest.as_ref().and_then(|n| n.files.get(name)).filter(|file| file.digest == digest) else {
        return Ok(None);
    };
    let etag = format!("\"{digest}\"");
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    // A client that has the beginning of another file gets this one whole.
    let same = text(IF_RANGE).is_none_or(|seen| seen == etag);
    let requested = text(RANGE).filter(|_| same).map_or(RequestedRange::Whole, |range| parse_range(range, file.length));
    let (code, range) = match requested {
        RequestedRange::Whole => (StatusCode::OK, 0..file.length),
        RequestedRange::Part(range) => (StatusCode::PARTIAL_CONTENT, range),
        RequestedRange::Beyond => {
            let length = [(CONTENT_RANGE, format!("bytes */{}", file.length))];
            return Ok(Some((StatusCode::RANGE_NOT_SATISFIABLE, length).into_response()));
        }
    };
    let Some(reader) = shown.content.read(digest, range.clone()).await? else { return Ok(None) };
    let mut response = Response::builder()
        .status(code)
        .header(CONTENT_TYPE, "application/octet-stream")
        .header(CONTENT_LENGTH, range.end - range.start)
        .header(ACCEPT_RANGES, "bytes")
        .header(CACHE_CONTROL, FOR_EVER)
        .header(ETAG, etag);
    if code == StatusCode::PARTIAL_CONTENT {
        response = response.header(CONTENT_RANGE, format!("bytes {}-{}/{}", range.start, range.end - 1, file.length));
    }
    let body = Body::from_stream(ReaderStream::with_capacity(reader, limits::CHUNK_BYTES));
    Ok(response.body(body).ok())
}

/// The range of a file that a client requests.
#[derive(Clone, Debug, PartialEq, Eq)]
enum RequestedRange {
    Whole,
    Part(Range<u64>),
    /// Nothing of it is there.
    Beyond,
}

/// Parses a `Range` header. What is not understood, and more than one range, is answered with the whole, as RFC 9110 allows.
fn parse_range(header: &str, length: u64) -> RequestedRange {
    let bounds = header.strip_prefix("bytes=").and_then(|set| set.trim().split_once('-'));
    let Some((first, last)) = bounds else { return RequestedRange::Whole };
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    if !digits(first) || !digits(last) || (first.is_empty() && last.is_empty()) {
        return RequestedRange::Whole;
    }
    // More digits than any file has bytes: beyond it.
    let number = |text: &str| text.parse::<u64>().unwrap_or(u64::MAX);
    let range = match (first, last) {
        ("", suffix) => length.saturating_sub(number(suffix))..length,
        (first, "") => number(first)..length,
        (first, last) if number(last) < number(first) => return RequestedRange::Whole,
        (first, last) => number(first)..number(last).saturating_add(1).min(length),
    };
    if range.start >= range.end { RequestedRange::Beyond } else { RequestedRange::Part(range) }
}

#[cfg(test)]
mod tests;
