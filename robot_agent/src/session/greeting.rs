//! The greeting of a session: hello goes up, and the answer is a welcome, a close or a refusal.
//!
//! Invariant: a session is open only after a welcome. The server's own advice when to ask again is handed on.

use midshift_core::reason::Code;
use midshift_core::time::{Clock, LinkDuration, LinkTime};
use midshift_proto::codec::SmallCodec;
use midshift_proto::convert::parse;
use midshift_proto::link::v1;
use midshift_proto::refusal_of;
use midshift_proto::session::{Close, ToRobot, Welcome};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Status, Streaming};

/// No word from the server for this long: the session is given up. A heartbeat is answered each second.
pub(super) const SILENCE: LinkDuration = LinkDuration::from_secs(10);
/// Messages that may wait for the wire; a robot whose network is stuck this long gives the session up.
const OUTBOUND: usize = 64;
/// The way the session takes.
const PATH: &str = "/midshift.link.v1.LinkService/Session";

/// An open session.
pub(super) struct Open {
    pub(super) up: mpsc::Sender<v1::SessionRequest>,
    pub(super) down: Streaming<v1::SessionResponse>,
    pub(super) heard: LinkTime,
    /// How long it may be silent.
    pub(super) patience: LinkDuration,
}

/// What came of saying hello.
pub(super) enum Greeted {
    Welcome(Box<(Open, Welcome)>),
    Closed(Close),
    Failed(String),
    /// The server said no, and perhaps when to ask again.
    Refused(String, Option<Duration>),
    /// The key of this machine lets nobody in any more.
    Revoked(String),
}

/// Opens the stream, says hello, and waits for the first answer.
pub(super) async fn greet(channel: Channel, hello: v1::SessionRequest, clock: Arc<dyn Clock>) -> Greeted {
    let (up, queue) = mpsc::channel(OUTBOUND);
    let failed = |what: &str, detail: &dyn std::fmt::Display| Greeted::Failed(format!("{what}: {detail}"));
    let refused = |what: &str, status: &Status| {
        let answer = refusal_of(status);
        match answer.code {
            Some(Code::KeyDenied) => Greeted::Revoked(status.message().to_owned()),
            _ => Greeted::Refused(format!("{what}: {status}"), answer.retry_after),
        }
    };
    if up.try_send(hello).is_err() {
        return Greeted::Failed("the way up is closed".to_owned());
    }
    let mut client = tonic::client::Grpc::new(channel);
    if let Err(error) = client.ready().await {
        return failed("connection", &error);
    }
    let path = tonic::codegen::http::uri::PathAndQuery::from_static(PATH);
    let request = tonic::Request::new(ReceiverStream::new(queue));
    let mut down = match client.streaming(request, path, SmallCodec::default()).await {
        Ok(response) => response.into_inner(),
        Err(status) => return refused("session", &status),
    };
    match down.message().await {
        Ok(Some(first)) => match parse(first) {
            Ok(ToRobot::Welcome(welcome)) => {
                let heard = clock.now().link;
                Greeted::Welcome(Box::new((Open { up, down, heard, patience: SILENCE }, welcome)))
            }
            Ok(ToRobot::Close(close)) => Greeted::Closed(close),
            Ok(_) => Greeted::Failed("the first message was no welcome".to_owned()),
            Err(refusal) => failed("welcome", &refusal),
        },
        Ok(None) => Greeted::Failed("the stream ended before a welcome".to_owned()),
        Err(status) => refused("welcome", &status),
    }
}
