//! What release people and operators ask for while a room runs, each asked again until it is answered.
//!
//! Invariant: asked twice it does the same once; "not now" is an answer like any other.

use crate::net;
use midshift_proto::convert::duration;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{
    BlockPlaceRequest, ClearPlaceRequest, DrainRobotRequest, ListPlacesRequest, RetireRobotRequest,
    UncordonRobotRequest,
};
use midshift_proto::ota::v1 as ota;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::stop::v1::{EngageRequest, ResetRequest};
use midshift_proto::task::v1::ResumeHeldRequest;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use tonic::transport::Channel;
use tonic::{Code, Status};

/// One wish about software.
#[derive(Clone, Debug)]
pub enum Order {
    /// Write a roll-out down, check it, stand for it and begin.
    Begin {
        /// Its id.
        id: String,
        /// What it is asked to be.
        spec: Box<ota::RolloutSpec>,
        /// Others of the same robots end first.
        supersede: bool,
    },
    /// Take a completed one back.
    Rollback {
        /// Id of the completed roll-out.
        of: String,
        /// Id of the other.
        id: String,
    },
    /// Stand still.
    Pause(String),
    /// Go on.
    Resume(String),
    /// Go on though the gate did not say so.
    Promote(String),
    /// End it.
    Abort(String),
    /// Leave a robot out.
    Exclude(String, String),
    /// Keep a robot at what it runs.
    Pin(String),
    /// Let it take part again.
    Unpin(String),
    /// A person takes a robot out of work.
    Drain(String),
    /// A person lets a robot go on that its own safety system had stopped.
    LetGo {
        /// The robot that may go on.
        robot_id: String,
        /// Never used again.
        request_id: String,
    },
    /// A person lets a robot work again that was broken off after it had failed too often.
    Uncordon(String),
    /// A person stops robots. Asked again by the same request_id it is one stop.
    Engage(Box<EngageRequest>),
    /// A person resets a stop by its name.
    Reset(String),
    /// A person takes a robot out of the fleet.
    Retire(String),
    /// A person has looked: nobody is in this place.
    Clear(String),
    /// A person lets nobody into this place for a while.
    Block {
        /// The place.
        place_id: String,
        /// Milliseconds until that ends by itself.
        lasts_ms: u64,
    },
    /// What a person does about a roll-out that waits for one: goes on with one that stands still, ends one that must be judged.
    Settle(String),
}

/// What nobody has to be told is no error: it cannot be done now, or not by this name.
fn is_answer(status: &Status) -> bool {
    matches!(status.code(), Code::FailedPrecondition | Code::NotFound | Code::AlreadyExists)
}

/// Carries one wish out as far as it is allowed. True: all of it.
///
/// # Errors
/// No answer came, or somebody else was faster.
pub async fn carry_out(order: &Order) -> anyhow::Result<bool> {
    match ask(order).await {
        Ok(()) => Ok(true),
        Err(status) if is_answer(&status) => Ok(false),
        Err(status) => Err(status.into()),
    }
}

type Client = RolloutServiceClient<Channel>;

async fn seen(client: &mut Client, rollout_id: &str) -> Result<ota::Rollout, Status> {
    let request = ota::GetRolloutRequest { rollout_id: rollout_id.to_owned() };
    let shown = client.get_rollout(request).await?.into_inner().rollout;
    shown.ok_or_else(|| Status::internal("an answer without a roll-out"))
}

/// A request about a roll-out as it was just seen.
macro_rules! verb {
    ($client:ident, $method:ident, $request:ident, $id:expr) => {{
        let rollout_id: String = $id;
        let etag = seen(&mut $client, &rollout_id).await?.etag;
        let request = ota::$request { rollout_id, etag, reason: "drawn".to_owned() };
        $client.$method(request).await.map(drop)
    }};
}

async fn ask(order: &Order) -> Result<(), Status> {
    let channel = net::channel().map_err(|e| Status::unavailable(e.to_string()))?;
    let mut client = Client::new(channel.clone());
    match order.clone() {
        Order::Begin { id, spec, supersede } => {
            let spec = Some(*spec);
            client.create_rollout(ota::CreateRolloutRequest { rollout_id: id.clone(), spec }).await?;
            verb!(client, submit_rollout, SubmitRolloutRequest, id.clone())?;
            verb!(client, approve_rollout, ApproveRolloutRequest, id.clone())?;
            start(&mut client, id, supersede).await
        }
        Order::Rollback { of, id } => {
            let request = ota::RollBackRolloutRequest { rollout_id: of, new_rollout_id: id.clone() };
            client.roll_back_rollout(request).await?;
            verb!(client, submit_rollout, SubmitRolloutRequest, id.clone())?;
            verb!(client, approve_rollout, ApproveRolloutRequest, id.clone())?;
            start(&mut client, id, false).await
        }
        Order::Pause(id) => verb!(client, pause_rollout, PauseRolloutRequest, id),
        Order::Resume(id) => verb!(client, resume_rollout, ResumeRolloutRequest, id),
        Order::Promote(id) => verb!(client, promote_rollout, PromoteRolloutRequest, id),
        Order::Abort(id) => verb!(client, abort_rollout, AbortRolloutRequest, id),
        Order::Exclude(rollout_id, robot_id) => {
            let etag = seen(&mut client, &rollout_id).await?.etag;
            let request = ota::ExcludeRobotRequest {
                rollout_id,
                robot_id,
                etag,
                reason: "drawn".to_owned(),
                ..Default::default()
            };
            client.exclude_robot(request).await.map(drop)
        }
        Order::Pin(robot_id) => client
            .pin_robot(ota::PinRobotRequest { robot_id, reason: "drawn".to_owned(), ..Default::default() })
            .await
            .map(drop),
        Order::Unpin(robot_id) => {
            client.unpin_robot(ota::UnpinRobotRequest { robot_id, ..Default::default() }).await.map(drop)
        }
        Order::Drain(robot_id) => {
            let request = DrainRobotRequest { robot_id, reason: "to look at it".to_owned(), ..Default::default() };
            FleetServiceClient::new(channel).drain_robot(request).await.map(drop)
        }
        Order::LetGo { robot_id, request_id } => {
            let request = ResumeHeldRequest {
                robot_ids: vec![robot_id],
                request_id,
                reason: "looked after".to_owned(),
                ..ResumeHeldRequest::default()
            };
            TaskServiceClient::new(channel).resume_held(request).await.map(drop)
        }
        Order::Uncordon(robot_id) => {
            let request = UncordonRobotRequest { robot_id, ..Default::default() };
            FleetServiceClient::new(channel).uncordon_robot(request).await.map(drop)
        }
        Order::Engage(request) => {
            let mut told = stops()?.engage(*request).await?.into_inner();
            told.message().await.map(drop)
        }
        Order::Reset(stop_id) => stops()?
            .reset(ResetRequest { stop_id, reason: "looked, is clear".to_owned(), ..ResetRequest::default() })
            .await
            .map(drop),
        Order::Retire(robot_id) => {
            let reason = "it behaves badly".to_owned();
            let request = RetireRobotRequest { robot_id, reason, ..RetireRobotRequest::default() };
            FleetServiceClient::new(channel).retire_robot(request).await.map(drop)
        }
        Order::Block { place_id, lasts_ms } => {
            let (reason, lasts) = ("a spill".to_owned(), Some(duration(lasts_ms)));
            let request = BlockPlaceRequest { place_id, reason, lasts, ..BlockPlaceRequest::default() };
            FleetServiceClient::new(channel).block_place(request).await.map(drop)
        }
        Order::Clear(place_id) => clear(FleetServiceClient::new(channel), place_id).await,
        Order::Settle(id) => settle(&mut client, id).await,
    }
}

fn stops() -> Result<StopServiceClient<Channel>, Status> {
    let channel = net::channel_to(net::STOPS).map_err(|e| Status::unavailable(e.to_string()))?;
    Ok(StopServiceClient::new(channel))
}

async fn start(client: &mut Client, rollout_id: String, supersede: bool) -> Result<(), Status> {
    let etag = seen(client, &rollout_id).await?.etag;
    let request = ota::StartRolloutRequest { rollout_id, etag, reason: "drawn".to_owned(), supersede };
    client.start_rollout(request).await.map(drop)
}

async fn clear(mut client: FleetServiceClient<Channel>, place_id: String) -> Result<(), Status> {
    let request = ListPlacesRequest { in_use: true, page_size: 1_000, ..ListPlacesRequest::default() };
    let places = client.list_places(request).await?.into_inner().places;
    let Some(etag) = places.into_iter().find(|p| p.place_id == place_id).map(|p| p.etag) else { return Ok(()) };
    let reason = "looked, nobody is there".to_owned();
    let request = ClearPlaceRequest { place_id, etag, reason, ..ClearPlaceRequest::default() };
    client.clear_place(request).await.map(drop)
}

async fn settle(client: &mut Client, id: String) -> Result<(), Status> {
    use ota::{RolloutPause, RolloutPhase};
    let shown = seen(client, &id).await?;
    let mut client = client.clone();
    if shown.pauses().any(|pause| matches!(pause, RolloutPause::Operator | RolloutPause::Content)) {
        return verb!(client, resume_rollout, ResumeRolloutRequest, id);
    }
    match shown.phase() {
        RolloutPhase::Draft | RolloutPhase::Validated | RolloutPhase::Approved | RolloutPhase::Review => {
            verb!(client, abort_rollout, AbortRolloutRequest, id)
        }
        _ => Ok(()),
    }
}
