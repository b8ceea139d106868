//! Floods of frames that ask for nothing are cut, and clients that ask much, read much and ping are not.

use crate::frames::{ACK, PING, PRIORITY, RST_STREAM, Raw, SETTINGS, WINDOW_UPDATE, dial, frame};
use crate::world::{Client, HERE, World, within};
use midshift_core::limits;
use midshift_edge::{Config, Rate};
use std::num::NonZeroU32;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

/// A kind that no HTTP/2 has.
const UNKNOWN: u8 = 0xbe;

/// A port where nobody asks too often.
async fn open() -> World {
    let all = NonZeroU32::new(1_000_000).expect("not zero");
    World::open(Config { rate: Rate { per_second: all, burst: all }, ..Config::default() }).await
}

/// Writes one frame over and over until the other side closes, reading what it says meanwhile.
async fn flood(raw: Raw<tokio::net::TcpStream>, frame: Vec<u8>) {
    let (mut from, mut to) = raw.0.into_split();
    let many = frame.repeat(500);
    let writing = async { while to.write_all(&many).await.is_ok() {} };
    let reading = async {
        let mut said = [0; 4_096];
        while from.read(&mut said).await.is_ok_and(|n| n > 0) {}
    };
    within(async { tokio::join!(writing, reading) }).await;
}

#[tokio::test]
async fn a_flood_of_frames_that_ask_for_nothing_ends_its_connection_and_no_other() {
    let world = open().await;
    let mut good = world.client().await;
    assert_eq!(good.asked("/who").await.status.code(), tonic::Code::Ok);
    let floods = [
        frame(SETTINGS, 0, 0, &[]),
        frame(SETTINGS, 0, 0, &[0, 4, 0, 1, 0, 0]),
        frame(PRIORITY, 0, 1, &[0, 0, 0, 0, 16]),
        frame(PING, 0, 0, b"flooding"),
        frame(PING, ACK, 0, b"flooding"),
        frame(WINDOW_UPDATE, 0, 1, &[0, 0, 0, 1]),
        frame(UNKNOWN, 0, 0, &[]),
    ];
    for (n, frame) in floods.into_iter().enumerate() {
        let mut raw = Raw::dial(world.address, HERE).await;
        raw.call(1, "/hang").await;
        flood(raw, frame).await;
        world.closed_times("frame_flood", n as u64 + 1).await;
    }
    assert_eq!(good.asked("/who").await.status.code(), tonic::Code::Ok);
}

#[tokio::test]
async fn a_client_that_asks_much_and_takes_back_much_is_not_cut() {
    let world = open().await;
    let mut client = world.client().await;
    // Many times the burst: each request with the updates of windows and the resets that belong to it.
    for _ in 0..limits::CONTROL_FRAMES_BURST {
        assert_eq!(client.asked("/who").await.status.code(), tonic::Code::Ok);
    }
    let mut raw = Raw::dial(world.address, HERE).await;
    raw.write(SETTINGS, ACK, 0, &[]).await;
    for stream in 0..limits::CONTROL_FRAMES_BURST as u32 {
        let stream = 2 * stream + 1;
        raw.call(stream, "/who").await;
        raw.write(WINDOW_UPDATE, 0, stream, &[0, 0, 0, 1]).await;
        raw.write(WINDOW_UPDATE, 0, 0, &[0, 0, 0, 1]).await;
        // Its answer, whole or not.
        within(raw.next(crate::frames::HEADERS)).await.expect("an answer");
        raw.write(RST_STREAM, 0, stream, &8_u32.to_be_bytes()).await;
    }
    raw.write(PING, 0, 0, b"still on").await;
    assert!(within(raw.next(PING)).await.is_some());
    assert_eq!(world.counter("midshift_edge_closed_total", ("reason", "frame_flood")), 0);
}

#[tokio::test]
async fn a_client_that_pings_at_each_answer_and_reads_a_long_stream_is_not_cut() {
    let world = open().await;
    let stream = dial(world.address, HERE).await;
    let (sender, mut connection) = h2::client::handshake(stream).await.expect("HTTP/2");
    let mut pings = connection.ping_pong().expect("the first to ask");
    let mut client = Client::of(sender, tokio::spawn(connection));
    let pulse = client.begin("/pulse", None).await.expect("sent");
    let mut poker = world.client().await;
    assert_eq!(poker.asked("/poke").await.status.code(), tonic::Code::Ok);
    let mut body = within(pulse).await.expect("an answer").into_body();
    for _ in 0..2 * limits::CONTROL_FRAMES_BURST {
        let beat = within(body.data()).await.expect("goes on").expect("a beat");
        body.flow_control().release_capacity(beat.len()).expect("given back");
        within(pings.ping(h2::Ping::opaque())).await.expect("answered");
        assert_eq!(poker.asked("/poke").await.status.code(), tonic::Code::Ok);
    }
    assert_eq!(world.counter("midshift_edge_closed_total", ("reason", "frame_flood")), 0);
}
