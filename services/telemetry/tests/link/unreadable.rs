//! Bytes of a robot that are no message: it hears so before anything ends.

use crate::raw::Raw;
use crate::world::{Result, World, hello, world};
use midshift_core::fleet::NOT_UNDERSTOOD_SEEN;
use midshift_core::reason::Code;
use midshift_core::robot::ReportedState;
use midshift_core::rows::{Log, Seq};
use midshift_proto::link::v1::{SessionRequest, SessionResponse, session_request};
use midshift_proto::session::{Close, CloseCode, FromRobot, Heartbeat, Hello, ToRobot, Uplink};
use prost::Message;
use prost::bytes::Bytes;
use std::time::Duration;
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Request, Streaming};

fn bytes_of(message: &FromRobot) -> Vec<u8> {
    SessionRequest::from(message).encode_to_vec()
}

/// A session in which these bytes are said, one message each.
async fn says(world: &World, messages: Vec<Vec<u8>>) -> Result<Streaming<Bytes>> {
    let mut link = Grpc::new(world.channel.clone());
    link.ready().await?;
    let path = PathAndQuery::from_static("/midshift.link.v1.LinkService/Session");
    let messages = tokio_stream::iter(messages.into_iter().map(Bytes::from));
    Ok(link.streaming(Request::new(messages), path, Raw).await?.into_inner())
}

/// The last word of a session that has begun; behind it the stream ends without an error.
async fn last_word(mut down: Streaming<Bytes>) -> Result<Close> {
    let mut last = None;
    while let Some(message) = down.message().await? {
        last = Some(midshift_proto::parse::<ToRobot, _>(SessionResponse::decode(message)?)?);
    }
    match last {
        Some(ToRobot::Close(close)) => Ok(close),
        other => Err(format!("the last word was {other:?}").into()),
    }
}

/// A heartbeat with one byte that is no text.
fn heartbeat_of_no_text() -> Result<Vec<u8>> {
    let reported = ReportedState { hb: 1, map_version: "~~~~".to_owned(), ..ReportedState::default() };
    let heartbeat = Some(Heartbeat { reported, sent_unix_us: 0, clock: None });
    let mut bytes = bytes_of(&FromRobot::Uplink(Uplink { heartbeat, batches: Vec::new() }));
    let at = bytes.windows(4).position(|four| four == b"~~~~").ok_or("its map is in it")?;
    bytes[at] = 0xff;
    Ok(bytes)
}

#[tokio::test(start_paused = true)]
async fn a_ring_with_a_zero_byte_is_refused_as_no_log_would_take_its_samples() -> Result<()> {
    let world = world().await?;
    let hello = bytes_of(&FromRobot::Hello(Box::new(Hello { ring: "ri\0ng".to_owned(), ..hello(None)? })));
    let refused = last_word(says(&world, vec![hello]).await?).await.expect_err("no session");
    assert!(refused.to_string().contains("hello.ring: must not contain a zero byte"), "{refused}");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_message_cannot_be_read_hears_so_before_its_session_ends() -> Result<()> {
    let world = world().await?;
    for broken in [vec![0xff; 8], heartbeat_of_no_text()?] {
        let hello = bytes_of(&FromRobot::Hello(Box::new(hello(None)?)));
        let close = last_word(says(&world, vec![hello, broken]).await?).await?;
        assert_eq!((close.code, close.reason.code), (CloseCode::Protocol, Code::ProtocolError));
        assert!(close.reason.text().starts_with("a message cannot be read: "), "{}", close.reason.text());
    }
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_hello_that_cannot_be_read_is_an_argument_that_is_invalid() -> Result<()> {
    let world = world().await?;
    for broken in [vec![0xff; 8], heartbeat_of_no_text()?] {
        let status = says(&world, vec![broken]).await?.message().await.expect_err("nothing began");
        let answer = midshift_proto::refusal_of(&status);
        assert_eq!((answer.grpc, answer.code), (tonic::Code::InvalidArgument, Some(Code::ProtocolError)));
        assert!(answer.message.starts_with("a message cannot be read: "), "{}", answer.message);
    }
    Ok(())
}

/// The message, in a mode that nobody knows.
fn in_no_mode(message: &FromRobot) -> Result<Vec<u8>> {
    let mut request = SessionRequest::from(message);
    let reported = match &mut request.message {
        Some(session_request::Message::Hello(hello)) => hello.reported.as_mut(),
        Some(session_request::Message::Uplink(uplink)) => uplink.heartbeat.as_mut().and_then(|h| h.reported.as_mut()),
        None => None,
    };
    reported.ok_or("it reports nothing")?.mode = 77;
    Ok(request.encode_to_vec())
}

/// Waits until something was stated of robots that are not understood, and says what.
async fn stated(world: &World) -> Result<Vec<serde_json::Value>> {
    let mut wake = world.store.wake();
    let stated = async {
        loop {
            wake.mark_unchanged();
            let entries = world.store.feed(Seq(0), &[Log::Telemetry], 1_000).await?.entries;
            let stated = entries.iter().filter(|entry| &*entry.kind == NOT_UNDERSTOOD_SEEN);
            let bodies: Vec<&str> = stated.filter_map(|entry| entry.body.as_deref()).collect();
            if !bodies.is_empty() {
                let read = bodies.into_iter().map(serde_json::from_str::<serde_json::Value>);
                return Ok(read.collect::<std::result::Result<Vec<_>, _>>()?);
            }
            wake.changed().await?;
        }
    };
    tokio::time::timeout(Duration::from_secs(5), stated).await?
}

/// One robot was stated once, with the field that nobody could read.
fn is_about_the_mode(stated: &[serde_json::Value]) {
    let [body] = stated else { panic!("{stated:?}") };
    let why = body["why"].as_str().unwrap_or_default();
    assert!(body["robot_id"] == "r1" && why.ends_with("reported.mode: 77 is not a known value"), "{body}");
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_heartbeats_cannot_be_read_is_stated_once_with_the_field() -> Result<()> {
    let world = world().await?;
    let reported = ReportedState { hb: 1, session_epoch: 1, ..ReportedState::default() };
    let heartbeat = Some(Heartbeat { reported, sent_unix_us: 0, clock: None });
    let broken = in_no_mode(&FromRobot::Uplink(Uplink { heartbeat, batches: Vec::new() }))?;
    for _ in 0..6 {
        let hello = bytes_of(&FromRobot::Hello(Box::new(hello(None)?)));
        let close = last_word(says(&world, vec![hello, broken.clone()]).await?).await?;
        assert_eq!((close.code, close.reason.code), (CloseCode::Protocol, Code::ProtocolError));
    }
    is_about_the_mode(&stated(&world).await?);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_hello_cannot_be_read_is_stated_once_with_the_field() -> Result<()> {
    let world = world().await?;
    for _ in 0..6 {
        let broken = in_no_mode(&FromRobot::Hello(Box::new(hello(None)?)))?;
        let status = says(&world, vec![broken]).await?.message().await.expect_err("nothing began");
        assert_eq!(status.code(), tonic::Code::InvalidArgument);
    }
    is_about_the_mode(&stated(&world).await?);
    Ok(())
}
