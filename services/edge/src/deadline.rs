//! Deadlines: a caller's own to the end of its answer, and the port's to the head of it.
//!
//! Invariant: a stream that has begun to answer is ended by its caller's deadline only: sessions and watches live for hours. What a
//! caller cannot have meant is refused, not ignored.

use crate::answer::Speech;
use crate::faults::poll_body;
use crate::peer::Peer;
use bytes::Bytes;
use http::HeaderMap;
use http_body::{Body as HttpBody, Frame, SizeHint};
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_proto::status;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::{Instant, Sleep, sleep_until};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::Status;
use tonic::body::Body;

/// Name of the header of gRPC.
const GRPC_TIMEOUT: &str = "grpc-timeout";
/// Digits of its value at most, as gRPC's protocol says.
const DIGITS_MAX: usize = 8;

/// The time that a caller gives; none: it did not say.
///
/// # Errors
/// If it said something else than one to eight digits and a unit.
pub(crate) fn given(headers: &HeaderMap) -> Result<Option<Duration>, Refusal> {
    let Some(value) = headers.get(GRPC_TIMEOUT) else { return Ok(None) };
    let parsed = value.to_str().ok().and_then(parse);
    parsed.map(Some).ok_or_else(|| Refusal::field(GRPC_TIMEOUT, "must be 1-8 digits and one of H M S m u n"))
}

fn parse(text: &str) -> Option<Duration> {
    let digits = text.get(..text.len().checked_sub(1)?)?;
    let plain = (1..=DIGITS_MAX).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_digit());
    let count: u64 = digits.parse().ok().filter(|_| plain)?;
    match text.as_bytes().last()? {
        b'H' => Some(Duration::from_secs(count * 3600)),
        b'M' => Some(Duration::from_secs(count * 60)),
        b'S' => Some(Duration::from_secs(count)),
        b'm' => Some(Duration::from_millis(count)),
        b'u' => Some(Duration::from_micros(count)),
        b'n' => Some(Duration::from_nanos(count)),
        _ => None,
    }
}

/// What a caller hears when its time is over.
pub(crate) fn over() -> Refusal {
    Refusal::new(Kind::Deadline, Code::DeadlineExceeded)
}

/// That the connection under a stream ends: an old one that its peer did not leave.
pub(crate) struct Over {
    token: CancellationToken,
    heard: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
}

impl Over {
    pub fn new(peer: &Peer) -> Self {
        Self { token: peer.over.clone(), heard: None }
    }
    /// Whether it is; wakes the task when it will be.
    fn poll(&mut self, cx: &mut Context<'_>) -> bool {
        let heard = self.heard.get_or_insert_with(|| Box::pin(self.token.clone().cancelled_owned()));
        heard.as_mut().poll(cx).is_ready()
    }
}

/// What a caller hears whose connection is old.
fn old() -> Refusal {
    let text = "the connection is old and ends; go on over a new one";
    Refusal::new(Kind::Unavailable, Reason::new(Code::MoveOver, text))
}

/// An answer's body that ends at its caller's deadline or with its connection, and what is held as long as it lasts.
pub(crate) struct Bounded<H> {
    body: Body,
    ends: Option<Pin<Box<Sleep>>>,
    over: Over,
    speech: Speech,
    _held: H,
}

impl<H> Bounded<H> {
    /// `body` until `deadline`, in the language of its caller; `held` is dropped with it.
    pub fn new(body: Body, deadline: Option<Instant>, over: Over, speech: Speech, held: H) -> Self {
        Self { body, ends: deadline.map(|at| Box::pin(sleep_until(at))), over, speech, _held: held }
    }

    /// The last that is said.
    fn end(&mut self, why: &Refusal) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        // The service's side of the stream ends here, not when the peer has read everything.
        (self.body, self.ends) = (Body::empty(), None);
        self.over = Over { token: CancellationToken::new(), heard: None };
        Poll::Ready(Some(ended(&self.speech, why)))
    }
}

impl<H: Unpin> HttpBody for Bounded<H> {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        // The deadline first: a stream that always has more would never be asked otherwise.
        if this.ends.as_mut().is_some_and(|sleep| sleep.as_mut().poll(cx).is_ready()) {
            return this.end(&over());
        }
        if this.over.token.is_cancelled() {
            return this.end(&old());
        }
        let frame = match poll_body(|| Pin::new(&mut this.body).poll_frame(cx)) {
            Ok(frame) => frame,
            Err(fault) => return this.end(&fault),
        };
        if frame.is_pending() && this.over.poll(cx) {
            return this.end(&old());
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Trailers where the caller understands them. In gRPC-Web they would be bytes of its encoding, so there the answer breaks off: the caller
/// has counted the same time and expects no more.
fn ended(speech: &Speech, why: &Refusal) -> Result<Frame<Bytes>, Status> {
    let status = status::status(why, None);
    let mut trailers = HeaderMap::new();
    match speech {
        Speech::Grpc => status.add_header(&mut trailers).map(|()| Frame::trailers(trailers)),
        Speech::GrpcWeb(_) | Speech::Http => Err(status),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use http::HeaderValue;
    use http_body_util::BodyExt;
    use std::sync::Arc;

    #[test]
    fn every_unit_is_read_and_nothing_that_is_not_one() {
        let good = [("3H", 10_800_000), ("2M", 120_000), ("7S", 7_000), ("99999999m", 99_999_999), ("5000u", 5)];
        for (text, ms) in good {
            assert_eq!(parse(text), Some(Duration::from_millis(ms)), "{text}");
        }
        assert_eq!((parse("1n"), parse("0S")), (Some(Duration::from_nanos(1)), Some(Duration::ZERO)));
        for bad in ["", "S", "1", "1s", "123456789S", "+1S", "-1S", " 1S", "1.5S", "1SS", "1é"] {
            assert_eq!(parse(bad), None, "{bad}");
        }
        let headers = [(http::HeaderName::from_static(GRPC_TIMEOUT), HeaderValue::from_static("soon"))];
        let refused = given(&headers.into_iter().collect()).expect_err("not a time");
        assert_eq!((refused.kind(), refused.violations[0].field.as_str()), (Kind::Invalid, GRPC_TIMEOUT));
    }

    struct Faulty;

    impl HttpBody for Faulty {
        type Data = Bytes;
        type Error = Status;
        fn poll_frame(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            panic!("a fault of a service")
        }
    }

    #[tokio::test]
    async fn a_fault_in_the_middle_of_an_answer_is_its_end() {
        let over = Over { token: CancellationToken::new(), heard: None };
        let mut body = Bounded::new(Body::new(Faulty), None, over, Speech::Grpc, ());
        let trailers = body.frame().await.expect("an end").expect("trailers").into_trailers().expect("trailers");
        let status = Status::from_header_map(&trailers).expect("a status");
        assert_eq!(status.code(), tonic::Code::Internal);
        assert!(body.frame().await.is_none(), "and it is not asked again");
    }

    /// Always has another byte.
    struct Endless(#[expect(dead_code, reason = "held, so that a test sees when it is dropped")] Arc<()>);

    impl HttpBody for Endless {
        type Data = Bytes;
        type Error = Status;
        fn poll_frame(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(Some(Ok(Frame::data(Bytes::from_static(b"x")))))
        }
    }

    fn never() -> Over {
        Over { token: CancellationToken::new(), heard: None }
    }

    #[tokio::test(start_paused = true)]
    async fn a_silent_stream_of_a_connection_that_ends_says_that_it_may_go_on_elsewhere() {
        let (_sender, said) = tokio::sync::mpsc::channel::<Result<Frame<Bytes>, Status>>(1);
        let silent = Body::new(http_body_util::StreamBody::new(tokio_stream::wrappers::ReceiverStream::new(said)));
        let token = CancellationToken::new();
        let mut body = Bounded::new(silent, None, Over { token: token.clone(), heard: None }, Speech::Grpc, ());
        let ends = async {
            tokio::task::yield_now().await;
            token.cancel();
        };
        let (frame, ()) = tokio::join!(body.frame(), ends);
        let trailers = frame.expect("a frame").expect("no error").into_trailers().expect("trailers");
        let answer = status::refusal_of(&Status::from_header_map(&trailers).expect("a status"));
        assert_eq!((answer.grpc, answer.code), (tonic::Code::Unavailable, Some(Code::MoveOver)));
        assert!(answer.retry_after.is_some() && body.frame().await.is_none());
    }

    #[tokio::test(start_paused = true)]
    async fn a_stream_that_always_has_more_ends_with_a_status_all_the_same() {
        let (service, held) = (Arc::new(()), Arc::new(()));
        let deadline = Instant::now() + Duration::from_secs(1);
        let endless = Body::new(Endless(service.clone()));
        let mut body = Bounded::new(endless, Some(deadline), never(), Speech::Grpc, held.clone());
        assert!(body.frame().await.expect("a frame").expect("no error").is_data());
        tokio::time::advance(Duration::from_secs(2)).await;
        let end = body.frame().await.expect("a frame").expect("no error").into_trailers().expect("trailers");
        assert_eq!((&end["grpc-status"], Arc::strong_count(&service)), (&HeaderValue::from_static("4"), 1));
        assert!(body.frame().await.is_none() && Arc::strong_count(&held) == 2);
        drop(body);
        assert_eq!(Arc::strong_count(&held), 1);
    }
}
