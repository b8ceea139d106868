//! The raw limit of the link: a bare tonic session that reads every message off the wire and keeps none.
//!
//! Invariant: it says only what keeps a real agent on the line. Called by a child.

use midshift_core::limits;
use midshift_proto::link::v1;
use midshift_proto::link::v1::link_service_server::{LinkService, LinkServiceServer};
use midshift_proto::session::{ClockSample, Downlink, Echo, ToRobot, Welcome};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::time::Interval;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

/// An agent gives a server up that says nothing for ten seconds.
const WORD_EVERY: Duration = Duration::from_secs(8);

/// What has come in.
#[derive(Debug, Default)]
pub struct Seen {
    /// Open sessions.
    pub sessions: AtomicU64,
    /// Messages after the first of each.
    pub messages: AtomicU64,
}

/// The service.
struct Sink {
    seen: Arc<Seen>,
    answers: bool,
}

/// Serves sessions until `stop`.
pub async fn serve(seen: Arc<Seen>, answers: bool, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    let listener = TcpListener::bind(address).await?;
    tonic::transport::Server::builder()
        .add_service(LinkServiceServer::new(Sink { seen, answers }))
        .serve_with_incoming_shutdown(crate::listen::nodelay(listener), stop.cancelled_owned())
        .await?;
    Ok(())
}

#[tonic::async_trait]
impl LinkService for Sink {
    type SessionStream = Drain;

    async fn session(&self, request: Request<Streaming<v1::SessionRequest>>) -> Result<Response<Drain>, Status> {
        let mut word = tokio::time::interval(WORD_EVERY);
        word.reset();
        self.seen.sessions.fetch_add(1, Relaxed);
        let clock = ClockSample { t1_us: 1_800_000_000_000_000, ..ClockSample::default() };
        let clock = ClockSample { t2_us: clock.t1_us, t3_us: clock.t1_us, ..clock };
        let echo = Downlink { echo: Some(Echo { hb: 1_000, clock, is_clock_doubted: false }), ..Downlink::default() };
        let answer = self.answers.then(|| v1::SessionResponse::from(&ToRobot::Downlink(Box::new(echo))));
        Ok(Response::new(Drain { up: request.into_inner(), word, welcomed: false, answer, seen: self.seen.clone() }))
    }
}

/// One session: what comes up is read whenever the way down is looked at.
struct Drain {
    up: Streaming<v1::SessionRequest>,
    word: Interval,
    welcomed: bool,
    answer: Option<v1::SessionResponse>,
    seen: Arc<Seen>,
}

impl Stream for Drain {
    type Item = Result<v1::SessionResponse, Status>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        while let Poll::Ready(message) = Pin::new(&mut self.up).poll_next(cx) {
            let Some(Ok(_)) = message else { return Poll::Ready(None) };
            if !self.welcomed {
                self.welcomed = true;
                return Poll::Ready(Some(Ok((&ToRobot::Welcome(welcome())).into())));
            }
            self.seen.messages.fetch_add(1, Relaxed);
            if let Some(answer) = &self.answer {
                return Poll::Ready(Some(Ok(answer.clone())));
            }
        }
        ready!(self.word.poll_tick(cx));
        Poll::Ready(Some(Ok((&ToRobot::Downlink(Box::default())).into())))
    }
}

impl Drop for Drain {
    fn drop(&mut self) {
        self.seen.sessions.fetch_sub(1, Relaxed);
    }
}

fn welcome() -> Welcome {
    Welcome {
        session_epoch: 1_800_000_000_000,
        session_secret: "no secret".into(),
        store_id: "no store".to_owned(),
        acks: Vec::new(),
        heartbeat_period_ms: limits::HEARTBEAT.as_ms() as u32,
        status_period_ms: 2_000,
        authority_ms: limits::AUTHORITY.as_ms() as u32,
        status_credit_bytes: limits::STATUS_IN_FLIGHT_BYTES as u32,
        protocol_version: midshift_proto::session::PROTOCOL_VERSION,
        clock_rate_permille: 1000,
        observed: false,
    }
}
