//! The robots' face: reads the Hello, sends the Welcome, runs the session.

use crate::session::{self, Down};
use crate::{TelemetryService, welcome};
use midshift_core::identity::Caller;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::time::Utc;
use midshift_proto::access::caller;
use midshift_proto::link::v1::{self, link_service_server::LinkService};
use midshift_proto::session::{FromRobot, Hello, ToRobot};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

/// A stream without a Hello ends after this.
const HELLO_WITHIN: Duration = Duration::from_secs(5);
/// Messages on their way down to one robot.
const DOWN_MAX: usize = 16;

#[tonic::async_trait]
impl LinkService for TelemetryService {
    type SessionStream = ReceiverStream<Result<v1::SessionResponse, Status>>;

    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (down, stream) = mpsc::channel(DOWN_MAX);
        let service = self.clone();
        let by = caller(&request);
        let up = request.into_inner();
        tokio::spawn(async move {
            let shutdown = service.inner.shutdown.clone();
            tokio::select! {
                () = down.closed() => {}
                result = service.hold(&by, up, down.clone()) => {
                    if let Err(refusal) = result
                        && !shutdown.is_cancelled()
                    {
                        let _ = down.send(Err(midshift_proto::status(&refusal, None))).await;
                    }
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }
}

impl TelemetryService {
    async fn hold(&self, by: &Caller, mut up: Streaming<v1::SessionRequest>, down: Down) -> Result<(), Refusal> {
        let hello = hello(&mut up).await?;
        // Before anything is asked about that robot, or done to a session of it.
        by.is_robot(&hello.robot_id)?;
        welcome::check(&self.inner, &hello)?;
        if self.inner.moving.is_cancelled() {
            return Err(Refusal::new(Kind::Unavailable, Code::ShuttingDown));
        }
        self.inner.picture.ready().await;
        let begun = welcome::begin(&self.inner, &hello, by).await?;
        tracing::info!(robot_id = %hello.robot_id, session_epoch = begun.welcome.session_epoch, observed = begun.welcome.observed, "session begun");
        let (robot_id, epoch) = (hello.robot_id.clone(), begun.welcome.session_epoch);
        // Also if this future is dropped in the middle: the robot is no longer attached here.
        let observed = begun.part.is_err().then(|| self.inner.parts.clock.now().wall);
        let _leave = Leave { service: self, robot_id: &robot_id, epoch, observed };
        if let Some(since) = observed {
            self.inner.registry.observe(&robot_id, since);
            self.inner.picture.touch(&robot_id);
        }
        let message = ToRobot::Welcome(begun.welcome.clone());
        if down.send(Ok((&message).into())).await.is_err() {
            return Ok(());
        }
        session::run(self.inner.clone(), &hello, begun, up, down).await;
        tracing::info!(%robot_id, session_epoch = epoch, "session ended");
        Ok(())
    }
}

struct Leave<'a> {
    service: &'a TelemetryService,
    robot_id: &'a midshift_core::ids::RobotId,
    epoch: u64,
    /// Since when; none: in charge.
    observed: Option<Utc>,
}

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        let inner = &self.service.inner;
        match self.observed {
            Some(since) => {
                inner.registry.lose_sight(self.robot_id, since);
                inner.picture.touch(self.robot_id);
            }
            None => inner.registry.leave(self.robot_id, self.epoch),
        }
    }
}

async fn hello(up: &mut Streaming<v1::SessionRequest>) -> Result<Hello, Refusal> {
    let first = tokio::time::timeout(HELLO_WITHIN, up.message()).await;
    let Ok(Ok(Some(message))) = first else {
        return Err(Refusal::new(Kind::Deadline, Reason::new(Code::ProtocolError, "no hello came")));
    };
    match midshift_proto::parse(message)? {
        FromRobot::Hello(hello) => Ok(*hello),
        FromRobot::Uplink(_) => Err(Refusal::field("message", "the first message must be a hello")),
    }
}
