//! How connections end: at the stop of the port and for their age, told before, and cut when they do not go.

use crate::frames::{DATA, END_STREAM, GOAWAY, HEADERS, Raw, dial, until_closed};
use crate::world::{HERE, SOON, World, within};
use midshift_core::reason::Code as Reason;
use midshift_core::time::LinkDuration;
use midshift_edge::{Age, Config, Served};
use tokio::net::TcpSocket;
use tonic::Code;

/// Longer than any test.
const NEVER: LinkDuration = LinkDuration::from_secs(3_600);

#[tokio::test]
async fn a_stop_ends_although_a_stream_is_open_and_says_how_many_it_cut() {
    let world = World::open(Config { drain: SOON, ..Config::default() }).await;
    let mut watching = Raw::dial(world.address, HERE).await;
    watching.call(1, "/stream").await;
    within(watching.next(HEADERS)).await.expect("the head of a stream");
    assert_eq!(world.stopped().await, Served { left: 0, cut: 1 });
    let frames = within(watching.rest()).await;
    assert!(frames.iter().any(|f| f.kind == GOAWAY), "asked to go before it was cut: {frames:?}");
}

#[tokio::test]
async fn a_stop_waits_for_calls_under_way_and_takes_no_connection_more() {
    let world = World::open(Config { drain: NEVER, ..Config::default() }).await;
    let address = world.address;
    let mut client = world.client().await;
    let watching = client.begin("/leaving", None).await.expect("a stream");
    let watching = within(watching).await.expect("its head");
    let served = world.stopped().await;
    let whole = within(crate::world::whole(watching)).await.expect("it ends by itself when it hears of the stop");
    assert_eq!((whole.status.code(), served), (Code::Ok, Served { left: 1, cut: 0 }));
    let late = TcpSocket::new_v4().expect("a socket").connect(address).await;
    assert!(late.is_err(), "nobody listens any more");
}

#[tokio::test]
async fn a_stop_waits_for_nobody_who_has_asked_nothing() {
    let world = World::open(Config { drain: NEVER, first_request: NEVER, ..Config::default() }).await;
    let mut silent = dial(world.address, HERE).await;
    let mut half = Raw(dial(world.address, HERE).await);
    tokio::io::AsyncWriteExt::write_all(&mut half.0, &crate::frames::PREFACE[..9]).await.expect("written");
    while world.open_connections() < 2.0 {
        tokio::task::yield_now().await;
    }
    assert_eq!(world.stopped().await, Served { left: 2, cut: 0 });
    within(until_closed(&mut silent)).await;
    within(until_closed(&mut half.0)).await;
}

fn old_soon(notice: LinkDuration, grace: LinkDuration) -> Config {
    Config { age: Some(Age { notice, grace, ..Age::after(SOON) }), ..Config::default() }
}

#[tokio::test]
async fn an_old_connections_streams_are_told_before_its_peer_is() {
    let world = World::open(old_soon(SOON, NEVER)).await;
    let mut robot = Raw::dial(world.address, HERE).await;
    robot.call(1, "/leaving").await;
    let mut order = Vec::new();
    while let Some(frame) = within(robot.read()).await {
        match frame.kind {
            HEADERS if frame.flags & END_STREAM != 0 => order.push("the stream ended"),
            GOAWAY => order.push("goaway"),
            _ => {}
        }
        if order.contains(&"goaway") {
            break;
        }
    }
    assert_eq!(order, ["the stream ended", "goaway"]);
}

#[tokio::test]
async fn who_still_watches_when_an_old_connection_ends_hears_that_it_may_go_on_over_a_new_one() {
    let world = World::open(old_soon(SOON, SOON)).await;
    let mut client = world.client().await;
    let watching = within(client.begin("/stream", None).await.expect("a stream")).await.expect("its head");
    let whole = within(crate::world::whole(watching)).await.expect("an end with a status");
    let answer = whole.answer();
    assert_eq!((answer.grpc, answer.code), (Code::Unavailable, Some(Reason::MoveOver)));
    assert!(answer.retry_after.is_some());
    world.closed_for("old").await;
}

#[tokio::test]
async fn an_old_connection_that_does_not_go_is_closed_after_its_grace() {
    let world = World::open(old_soon(SOON, SOON)).await;
    let mut deaf = Raw::dial(world.address, HERE).await;
    deaf.call(1, "/stream").await;
    let frames = within(deaf.rest()).await;
    assert!(frames.iter().any(|f| f.kind == GOAWAY), "{frames:?}");
    world.closed_for("old").await;
    assert_eq!(world.stopped().await, Served::default());
}

#[tokio::test]
async fn a_call_that_crosses_the_end_of_an_idle_connection_is_answered() {
    let world = World::open(Config { idle: SOON, ..Config::default() }).await;
    let mut pausing = Raw::dial(world.address, HERE).await;
    pausing.call(1, "/who").await;
    within(pausing.next(GOAWAY)).await.expect("asked to go");
    pausing.call(3, "/pulse").await;
    let head = within(pausing.next(HEADERS)).await.expect("the head of a stream");
    world.client().await.asked("/poke").await;
    let word = within(pausing.next(DATA)).await.expect("a word");
    assert_eq!((head.stream, word.stream, &*word.payload), (3, 3, &b"beat"[..]));
}
