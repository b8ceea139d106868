//! The robots' face: reads the Hello, sends the Welcome, runs the session.

use crate::facts::count_misread;
use crate::session::{self, Down, Word, word};
use crate::{TelemetryService, welcome};
use midshift_core::identity::Caller;
use midshift_core::ids::RobotId;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::time::Utc;
use midshift_proto::access::caller;
use midshift_proto::link::v1::{self, link_service_server::LinkService};
use midshift_proto::session::{FromRobot, Hello, ToRobot};
use midshift_proto::status::unreadable;
use midshift_proto::{DenialReporter, GoAwayNotice};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_stream::StreamExt;
use tokio_stream::adapters::Map;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};
use tracing::field::Empty;

/// A stream without a Hello ends after this.
const HELLO_WITHIN: Duration = Duration::from_secs(5);
/// Messages on their way down to one robot.
const DOWN_MAX: usize = 16;

#[tonic::async_trait]
impl LinkService for TelemetryService {
    type SessionStream = Map<ReceiverStream<Word>, fn(Word) -> Result<v1::SessionResponse, Status>>;

    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (down, stream) = mpsc::channel(DOWN_MAX);
        let service = self.clone();
        let (by, go_away, reporter) =
            (caller(&request), GoAwayNotice::from_request(&request), DenialReporter::from_request(&request));
        let up = request.into_inner();
        tokio::spawn(async move {
            let shutdown = service.inner.shutdown.clone();
            tokio::select! {
                () = down.closed() => {}
                result = service.hold(&by, go_away, up, down.clone()) => {
                    if let Err(refusal) = &result {
                        reporter.report(refusal);
                    }
                    if let Err(refusal) = result
                        && !shutdown.is_cancelled()
                    {
                        let _ = down.send(Box::new(Err(midshift_proto::status(&refusal, None)))).await;
                    }
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(stream).map(|word| *word)))
    }
}

impl TelemetryService {
    async fn hold(
        &self,
        by: &Caller,
        go_away: GoAwayNotice,
        mut up: Streaming<v1::SessionRequest>,
        down: Down,
    ) -> Result<(), Refusal> {
        let first = first(&mut up).await?;
        let claimed = claimed(&first);
        let hello = match read(first) {
            Ok(hello) => hello,
            Err(refusal) => {
                if let Some(robot_id) = claimed.filter(|robot_id| by.is_robot(robot_id).is_ok()) {
                    let why = refusal.reason.text();
                    tracing::warn!(peer = Empty, %robot_id, why, "a hello was refused");
                    count_misread(&self.inner, &robot_id, why);
                }
                return Err(refusal);
            }
        };
        // Before anything is asked about that robot, or done to a session of it.
        by.is_robot(&hello.robot_id)?;
        welcome::check(&self.inner, &hello)?;
        let room = tokio::select! {
            // First, so that nobody waits here who had better go elsewhere at once.
            biased;
            refusal = self.takes_nobody() => return Err(refusal),
            room = self.inner.hellos.enter(self.inner.projection.ready()) => room?,
        };
        // Elsewhere: its state is no session's once it is over.
        let begun = Box::pin(welcome::begin(&self.inner, &hello, by)).await?;
        drop(room);
        tracing::info!(peer = Empty, robot_id = %hello.robot_id, session_epoch = begun.welcome.session_epoch, observed = begun.welcome.observed, "session begun");
        let (robot_id, epoch) = (hello.robot_id.clone(), begun.welcome.session_epoch);
        // Also if this future is dropped in the middle: the robot is no longer attached here.
        let observed = begun.part.is_none().then(|| self.inner.parts.clock.now().wall);
        let _leave = Leave { service: self, robot_id: &robot_id, epoch, observed };
        if let Some(since) = observed {
            self.inner.registry.observe(&robot_id, since);
            self.inner.projection.touch(&robot_id);
        }
        if down.send(word(&ToRobot::Welcome(begun.welcome.clone()))).await.is_err() {
            return Ok(());
        }
        session::run(self.inner.clone(), &hello, begun, go_away, up, down).await;
        tracing::info!(peer = Empty, %robot_id, session_epoch = epoch, "session ended");
        Ok(())
    }
}

impl TelemetryService {
    /// Resolves when no session is begun here, with why.
    async fn takes_nobody(&self) -> Refusal {
        let cut_off = async {
            let Some(mut cut_off) = self.cut_off() else { return std::future::pending().await };
            if cut_off.wait_for(|is_cut_off| *is_cut_off).await.is_err() {
                std::future::pending().await
            }
        };
        tokio::select! {
            () = self.inner.moving.cancelled() => Refusal::new(Kind::Unavailable, Code::ShuttingDown),
            () = self.inner.shutdown.cancelled() => Refusal::new(Kind::Unavailable, Code::ShuttingDown),
            () = cut_off => welcome::cut_off(),
        }
    }
}

struct Leave<'a> {
    service: &'a TelemetryService,
    robot_id: &'a RobotId,
    epoch: u64,
    /// Since when; none: in charge.
    observed: Option<Utc>,
}

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        let inner = &self.service.inner;
        inner.event_rates.leave(self.robot_id, Instant::now());
        // Its next session looks how far this one has kept.
        inner.status_writer.hurry();
        match self.observed {
            Some(since) => {
                inner.registry.lose_sight(self.robot_id, since);
                inner.projection.touch(self.robot_id);
            }
            None => inner.registry.leave(self.robot_id, self.epoch),
        }
    }
}

async fn first(up: &mut Streaming<v1::SessionRequest>) -> Result<v1::SessionRequest, Refusal> {
    let first = tokio::time::timeout(HELLO_WITHIN, up.message()).await;
    if let Ok(Err(status)) = &first
        && let Some(refusal) = unreadable(status)
    {
        return Err(refusal);
    }
    match first {
        Ok(Ok(Some(message))) => Ok(message),
        _ => Err(Refusal::new(Kind::Deadline, Reason::new(Code::ProtocolError, "no hello came"))),
    }
}

/// Who it says that it is, whatever else in it is wrong.
fn claimed(first: &v1::SessionRequest) -> Option<RobotId> {
    let Some(v1::session_request::Message::Hello(hello)) = &first.message else { return None };
    RobotId::parse(&hello.robot_id).ok()
}

fn read(first: v1::SessionRequest) -> Result<Hello, Refusal> {
    match midshift_proto::parse(first)? {
        FromRobot::Hello(hello) => Ok(*hello),
        FromRobot::Uplink(_) => Err(Refusal::field("message", "the first message must be a hello")),
    }
}
