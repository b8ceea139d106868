//! Old STATUS of a robot on its bulk connection: handed to the task of the session in charge, so that one writer keeps the lane.
//!
//! Invariant: nothing of a batch is taken unless the session at hand proves itself by epoch and secret, and nothing is answered before it is
//! durable; a batch that cannot be handed over is refused, never kept waiting. Called by robots.

use crate::TelemetryService;
use crate::registry::Replay;
use midshift_core::identity::Caller;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_proto::access::caller;
use midshift_proto::link::v1::replay_service_server::ReplayService;
use midshift_proto::link::v1::{ReplayStatusRequest, ReplayStatusResponse};
use midshift_proto::session::{LaneAck, StatusReplay};
use midshift_proto::{DenialReporter, parse, status};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::oneshot;
use tonic::{Request, Response, Status};

fn not_in_charge() -> Refusal {
    Refusal::new(Kind::Precondition, Reason::new(Code::Fenced, "no session of this epoch and secret is in charge here"))
}

/// A batch of this robot is under way already, or its session has no room.
pub fn overloaded() -> Refusal {
    Refusal::new(Kind::Exhausted, Reason::new(Code::Overloaded, "status of this robot is being kept, send this again"))
}

#[tonic::async_trait]
impl ReplayService for TelemetryService {
    async fn replay_status(
        &self,
        request: Request<ReplayStatusRequest>,
    ) -> Result<Response<ReplayStatusResponse>, Status> {
        let (by, reporter) = (caller(&request), DenialReporter::from_request(&request));
        let ack = match parse(request.into_inner()) {
            Ok(replay) => self.hand_over(&by, replay).await,
            Err(refusal) => Err(refusal),
        };
        ack.inspect_err(|refusal| reporter.report(refusal))
            .map(|ack| Response::new((&ack).into()))
            .map_err(|refusal| status(&refusal, None))
    }
}

impl TelemetryService {
    async fn hand_over(&self, by: &Caller, replay: StatusReplay) -> Result<LaneAck, Refusal> {
        by.is_robot(&replay.robot_id)?;
        let in_charge = self.inner.registry.get(&replay.robot_id).ok_or_else(not_in_charge)?;
        if in_charge.session_epoch != replay.session_epoch || in_charge.secret != replay.session_secret {
            return Err(not_in_charge());
        }
        let samples = replay.batch.items.len() as u64;
        let (answer, answered) = oneshot::channel();
        in_charge.replays.try_send(Replay { batch: replay.batch, answer }).map_err(|error| match error {
            TrySendError::Full(_) => overloaded(),
            TrySendError::Closed(_) => not_in_charge(),
        })?;
        let ack = answered.await.map_err(|_| not_in_charge())??;
        if ack.expect.is_none() {
            metrics::counter!("midshift_telemetry_status_replayed_total").increment(samples);
        }
        Ok(ack)
    }
}
