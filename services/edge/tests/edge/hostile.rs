//! Peers that say nothing, say it slowly, or break the protocol: each is closed, and nobody else with it.

use crate::frames::{ACK, GOAWAY, HEADERS, PING, PREFACE, RST_STREAM, Raw, SETTINGS, dial, until_closed};
use crate::world::{HERE, SOON, World, within};
use http::{Request, StatusCode};
use midshift_core::time::LinkDuration;
use midshift_edge::Config;
use tokio::io::AsyncWriteExt;

/// Codes of HTTP/2.
const PROTOCOL_ERROR: u32 = 1;
const REFUSED_STREAM: u32 = 7;

fn quick() -> Config {
    Config { first_request: SOON, ..Config::default() }
}

#[tokio::test]
async fn a_silent_peer_is_closed() {
    let world = World::open(quick()).await;
    let mut silent = dial(world.address, HERE).await;
    assert_eq!(within(until_closed(&mut silent)).await, b"");
    world.closed_for("no_request").await;
}

#[tokio::test]
async fn half_a_preface_is_closed() {
    let world = World::open(quick()).await;
    let mut half = dial(world.address, HERE).await;
    half.write_all(&PREFACE[..12]).await.expect("written");
    within(until_closed(&mut half)).await;
    world.closed_for("no_request").await;
}

#[tokio::test]
async fn a_preface_without_settings_is_closed() {
    let world = World::open(quick()).await;
    let mut whole = dial(world.address, HERE).await;
    whole.write_all(PREFACE).await.expect("written");
    within(until_closed(&mut whole)).await;
    world.closed_for("no_request").await;
}

#[tokio::test]
async fn a_peer_that_greets_and_asks_nothing_is_told_to_go() {
    let world = World::open(quick()).await;
    let mut greeter = Raw::dial(world.address, HERE).await;
    let frames = within(greeter.rest()).await;
    assert!(frames.iter().any(|f| f.kind == GOAWAY), "{frames:?}");
    world.closed_for("no_request").await;
}

#[tokio::test]
async fn a_first_head_that_drips_in_is_closed() {
    let world = World::open(quick()).await;
    let mut slow = dial(world.address, HERE).await;
    let drip = async {
        slow.write_all(b"GET /who HTTP/1.1\r\nhost: edge\r\nx-more: ").await?;
        loop {
            slow.write_all(b"x").await?;
            tokio::task::yield_now().await;
        }
    };
    let closed: std::io::Result<()> = within(drip).await;
    assert!(closed.is_err());
    world.closed_for("no_request").await;
}

#[tokio::test]
async fn a_later_head_of_http_1_that_never_ends_is_closed() {
    let world = World::open(Config { http1_head: SOON, ..Config::default() }).await;
    let mut slow = dial(world.address, HERE).await;
    slow.write_all(b"GET /who HTTP/1.1\r\nhost: edge\r\n\r\nGET /who HTTP/1.1\r\nhost: ed").await.expect("written");
    let said = within(until_closed(&mut slow)).await;
    let answers = String::from_utf8_lossy(&said).matches("HTTP/1.1 200").count();
    assert_eq!(answers, 1, "the first was whole");
}

#[tokio::test]
async fn a_connection_that_nobody_uses_any_more_is_told_to_go() {
    let world = World::open(Config { idle: SOON, ..Config::default() }).await;
    let mut client = world.client().await;
    assert_eq!(client.asked("/who").await.status.code(), tonic::Code::Ok);
    let _ = within(client.connection).await;
    world.closed_for("idle").await;
}

#[tokio::test]
async fn a_peer_that_answers_no_ping_is_closed_with_all_its_streams() {
    let world = World::open(Config { keepalive_every: SOON, keepalive_within: SOON, ..Config::default() }).await;
    let mut dead = Raw::dial(world.address, HERE).await;
    dead.call(1, "/stream").await;
    let frames = within(dead.rest()).await;
    assert!(frames.iter().any(|f| f.kind == PING), "{frames:?}");
}

#[tokio::test]
async fn a_peer_that_breaks_the_protocol_takes_only_its_own_connection_with_it() {
    let world = World::open(Config::default()).await;
    let mut good = world.client().await;
    assert_eq!(good.asked("/who").await.status.code(), tonic::Code::Ok);
    let mut bad = Raw::dial(world.address, HERE).await;
    // A head on the stream that no request may have.
    bad.call(0, "/who").await;
    let goodbye = within(bad.next(GOAWAY)).await.expect("told why");
    assert_eq!(goodbye.payload[4..8], PROTOCOL_ERROR.to_be_bytes());
    within(until_closed(&mut bad.0)).await;
    let mut worse = dial(world.address, HERE).await;
    worse.write_all(&[PREFACE, &[0xff; 64][..]].concat()).await.expect("written");
    within(until_closed(&mut worse)).await;
    assert_eq!(good.asked("/who").await.status.code(), tonic::Code::Ok);
    world.closed_for("broken").await;
}

#[tokio::test]
async fn a_peer_is_told_how_many_streams_it_may_have_and_one_more_is_refused() {
    let world = World::open(Config { streams_per_connection: 2, ..Config::default() }).await;
    let mut greedy = Raw::dial(world.address, HERE).await;
    let settings = within(greedy.next(SETTINGS)).await.expect("settings").payload;
    assert!(settings.chunks(6).any(|s| s == [0, 3, 0, 0, 0, 2]), "SETTINGS_MAX_CONCURRENT_STREAMS is 2: {settings:?}");
    greedy.write(SETTINGS, ACK, 0, &[]).await;
    for stream in [1, 3, 5] {
        greedy.call(stream, "/hang").await;
    }
    let refused = within(greedy.next(RST_STREAM)).await.expect("a refusal");
    assert_eq!((refused.stream, refused.payload.as_slice()), (5, REFUSED_STREAM.to_be_bytes().as_slice()));
    // The connection goes on: with one stream fewer there is room for another.
    greedy.write(RST_STREAM, 0, 1, &8_u32.to_be_bytes()).await;
    greedy.call(7, "/who").await;
    assert_eq!(within(greedy.next(HEADERS)).await.expect("an answer").stream, 7);
}

#[tokio::test]
async fn a_peer_that_keeps_to_its_streams_waits_for_one() {
    let world = World::open(Config { streams_per_connection: 1, ..Config::default() }).await;
    let mut client = world.client().await;
    assert_eq!(client.asked("/who").await.status.code(), tonic::Code::Ok);
    assert_eq!(client.streams_allowed(), 1, "it heard the limit and keeps to it");
    let first = client.begin("/hang", None).await.expect("a stream");
    let another = client.begin("/who", None).await.expect("sent when it may be");
    drop(first);
    assert_eq!(within(another).await.expect("an answer").status(), StatusCode::OK);
}

#[tokio::test]
async fn a_header_list_that_is_too_large_is_refused_and_the_connection_goes_on() {
    let world = World::open(Config { header_list_bytes: 1_024, ..Config::default() }).await;
    let mut client = world.client().await;
    let of = |bytes| Request::post("http://edge/who").header("x-large", "x".repeat(bytes)).body(()).expect("a request");
    let refused = within(client.send(of(1_500)).await.expect("sent")).await.expect("an answer");
    assert_eq!(refused.status(), StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE);
    assert_eq!(client.asked("/who").await.status.code(), tonic::Code::Ok);
    // Several times too large is no mistake.
    let mut hostile = world.client().await;
    assert!(within(hostile.send(of(16_000)).await.expect("sent")).await.is_err_and(|error| error.is_go_away()));
    assert_eq!(client.asked("/who").await.status.code(), tonic::Code::Ok);
}

#[tokio::test]
async fn a_head_of_http_1_that_is_too_large_is_refused() {
    let world = World::open(Config { first_request: LinkDuration::from_secs(60), ..Config::default() }).await;
    let mut large = dial(world.address, HERE).await;
    large.write_all(b"GET /who HTTP/1.1\r\nhost: edge\r\nx-large: ").await.expect("written");
    let flood = async { while large.write_all(&[b'x'; 4_096]).await.is_ok() {} };
    within(flood).await;
}
