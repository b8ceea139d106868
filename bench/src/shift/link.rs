//! A session between a robot and telemetry in one process: messages go from hand to hand as the values that they are on
//! the wire, without a socket and without being encoded.
//!
//! What arrives at the service is a stream of gRPC as over any other transport. Each of its frames is empty, and its
//! decoder takes the message from a queue beside it. Invariant: messages keep their order in each direction, and each
//! arrives the delay of the link after it was sent, however many are on the way.

use http_body::{Body, Frame};
use midshift_proto::access::local;
use midshift_proto::link::v1::link_service_server::LinkService;
use midshift_proto::link::v1::{SessionRequest, SessionResponse};
use midshift_proto::session::{FromRobot, Hello, Uplink};
use midshift_telemetry::TelemetryService;
use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::codec::{DecodeBuf, Decoder};
use tonic::{Status, Streaming};

/// Messages of a robot that may wait for the link, as at a real agent.
const OUTBOUND: usize = 64;
/// A frame of gRPC that is not compressed and holds no bytes.
const EMPTY_FRAME: &[u8] = &[0; 5];

/// A message, and when it was sent.
type Sent<T> = (Instant, T);
type Boxed<T> = Pin<Box<dyn Stream<Item = T> + Send>>;

/// A robot's end of an open session.
pub struct RobotLink {
    up: mpsc::Sender<Sent<SessionRequest>>,
    /// What the service says, until the session is over.
    pub down: Boxed<Result<SessionResponse, Status>>,
}

impl RobotLink {
    /// Opens a stream and says hello; each message takes `delay` either way.
    ///
    /// # Errors
    /// The status by which the service refuses the stream.
    pub async fn open(telemetry: &TelemetryService, hello: Hello, delay: Duration) -> Result<Self, Status> {
        let (up, queue) = mpsc::channel(OUTBOUND);
        let first = SessionRequest::from(&FromRobot::Hello(Box::new(hello)));
        up.try_send((Instant::now(), first)).map_err(|_| Status::unavailable("the way up is closed"))?;
        let handed = Handed::default();
        let body = MessageBody { messages: delayed(ReceiverStream::new(queue), delay), handed: handed.clone() };
        let stream = Streaming::new_request(MessageDecoder(handed), body, None, None);
        let down = telemetry.session(local(stream)).await?.into_inner();
        let down = if delay.is_zero() { Box::pin(down) } else { delayed(ReceiverStream::new(stamp(down)), delay) };
        Ok(Self { up, down })
    }

    /// Sends a message; false: the way up is stuck or closed.
    pub fn send(&self, uplink: Uplink) -> bool {
        self.up.try_send((Instant::now(), SessionRequest::from(&FromRobot::Uplink(uplink)))).is_ok()
    }
}

fn delayed<T: Send + 'static>(sent: impl Stream<Item = Sent<T>> + Send + 'static, delay: Duration) -> Boxed<T> {
    Box::pin(sent.then(move |(at, message)| async move {
        tokio::time::sleep_until(at + delay).await;
        message
    }))
}

/// Notes of each message when the service sent it, until the service or the robot closes the session.
fn stamp<T: Send + 'static>(mut messages: impl Stream<Item = T> + Send + Unpin + 'static) -> mpsc::Receiver<Sent<T>> {
    let (sender, sent) = mpsc::channel(OUTBOUND);
    tokio::spawn(async move {
        loop {
            tokio::select! {
                biased;
                () = sender.closed() => return,
                message = messages.next() => match message {
                    Some(message) => if sender.send((Instant::now(), message)).await.is_err() { return },
                    None => return,
                },
            }
        }
    });
    sent
}

/// Messages between the body of a stream and its decoder.
#[derive(Clone, Default)]
struct Handed(Arc<Mutex<VecDeque<SessionRequest>>>);

impl Handed {
    fn lock(&self) -> std::sync::MutexGuard<'_, VecDeque<SessionRequest>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The body of the stream up.
struct MessageBody {
    messages: Boxed<SessionRequest>,
    handed: Handed,
}

impl Body for MessageBody {
    type Data = &'static [u8];
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        self.messages.as_mut().poll_next(cx).map(|message| {
            self.handed.lock().push_back(message?);
            Some(Ok(Frame::data(EMPTY_FRAME)))
        })
    }
}

/// Takes one message for each frame.
struct MessageDecoder(Handed);

impl Decoder for MessageDecoder {
    type Item = SessionRequest;
    type Error = Status;

    fn decode(&mut self, _: &mut DecodeBuf<'_>) -> Result<Option<SessionRequest>, Status> {
        Ok(self.0.lock().pop_front())
    }
}
