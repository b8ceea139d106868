//! The people's and programs' face: decode, call, encode.

use crate::changes::{self, Wanted};
use crate::service::StopService;
use crate::{confirm, status};
use midshift_core::identity::Caller;
use midshift_core::ids::{RequestId, StopId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::robot::StopLevel;
use midshift_core::stop::Scope;
use midshift_proto::access::caller;
use midshift_proto::convert::{At, WireEnum};
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::stop_service_server::StopService as Face;
use midshift_proto::{Parse, status as to_status};
use prost::Message;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

/// Messages on their way to one watcher.
const WATCH_MAX: usize = 4;

fn wanted(r: v1::EngageRequest, by: &Caller) -> Result<Wanted, Refusal> {
    let mut bad = Violations::default();
    let level = match r.level {
        // Whoever says none means the one that stops.
        0 => Some(StopLevel::Halt),
        number => StopLevel::from_wire(number).filter(|level| *level != StopLevel::None),
    };
    if level.is_none() {
        bad.add("level", format!("{} is not the level of a stop", r.level));
    }
    if r.reason.len() > limits::REASON_BYTES_MAX {
        bad.add("reason", format!("must be at most {} bytes", limits::REASON_BYTES_MAX));
    }
    let request_id = match r.request_id.as_str() {
        "" => None,
        text => bad.accept("request_id", RequestId::parse(text)),
    };
    let scope: Option<Scope> = match &r.scope {
        Some(scope) => scope.clone().parse_at(At::top("scope"), &mut bad),
        None => {
            bad.add("scope", "is required: a robot, a zone, an area or the fleet");
            None
        }
    };
    bad.finish()?;
    let scope = scope.ok_or_else(|| Refusal::field("scope", "cannot be read"))?;
    let level = level.ok_or_else(|| Refusal::field("level", "cannot be read"))?;
    let asked =
        v1::EngageRequest { level: level.to_wire(), request_id: String::new(), site_id: String::new(), ..r.clone() };
    let hash: String = Sha256::digest(asked.encode_to_vec()).iter().map(|byte| format!("{byte:02x}")).collect();
    let request = request_id.map(|id| (id, hash));
    Ok(Wanted { scope, level, reason: r.reason, request, actor: by.into() })
}

impl StopService {
    /// Whoever names a site means its robots and no others.
    fn is_meant(&self, site_id: &str) -> Result<(), Refusal> {
        match &self.inner.site_id {
            Some(own) if !site_id.is_empty() && own.as_str() != site_id => {
                let text =
                    format!("this is the stop service of site {own}, not of {site_id}; nothing was stopped or reset");
                let reason = Reason::new(Code::OtherSite, text).with("site_id", own);
                Err(Refusal::new(Kind::Precondition, reason))
            }
            _ => Ok(()),
        }
    }

    async fn engage_now(
        &self,
        r: v1::EngageRequest,
        by: &Caller,
    ) -> Result<ReceiverStream<Result<v1::EngageResponse, Status>>, Refusal> {
        let inner = self.inner.clone();
        self.is_meant(&r.site_id)?;
        let engaged = changes::engage(&inner, wanted(r, by)?)?;
        let durable = inner.disk.turn(engaged.version).await;
        let (sender, stream) = mpsc::channel(WATCH_MAX);
        let room = inner.watchers.clone().try_acquire_owned().ok();
        tokio::spawn(async move {
            let (ends, reader) = (inner.ended.clone(), sender.clone());
            tokio::select! {
                // What was engaged is said, whatever follows.
                biased;
                () = confirm::tell_of_stop(&inner, engaged.stop, durable, engaged.version, room.is_some(), sender) => {}
                () = ends.cancelled() => goes_on_elsewhere(&reader).await,
            }
            drop(room);
        });
        Ok(ReceiverStream::new(stream))
    }

    async fn take_back(&self, r: v1::ResetRequest, by: &Caller) -> Result<v1::ResetResponse, Refusal> {
        self.is_meant(&r.site_id)?;
        let mut bad = Violations::default();
        let stop_id = bad.accept("stop_id", StopId::parse(&r.stop_id));
        if r.reason.trim().is_empty() || r.reason.len() > limits::REASON_BYTES_MAX {
            bad.add(
                "reason",
                format!("is required, 1-{} bytes: what you saw that makes it safe", limits::REASON_BYTES_MAX),
            );
        }
        bad.finish()?;
        let stop_id = stop_id.ok_or_else(|| Refusal::field("stop_id", "cannot be read"))?;
        let resetting = changes::reset(&self.inner, stop_id, r.reason, by)?;
        // Before robots hear of it.
        let is_unknown = !resetting.is_known && !self.inner.robots.knows(&resetting.reset.stop_id);
        let durable = self.inner.disk.turn(resetting.version).await;
        // A disk that does not answer holds up nobody who has looked and says that it is over.
        changes::settle(&self.inner, resetting.version);
        let reset = Some((&resetting.reset).into());
        Ok(v1::ResetResponse { reset, durable, was_engaged: resetting.was_engaged, is_unknown })
    }

    fn watch(&self) -> Result<ReceiverStream<Result<v1::WatchStatusResponse, Status>>, Refusal> {
        let inner = self.inner.clone();
        let room = inner.watchers.clone().try_acquire_owned().map_err(|_| {
            let text = format!("{} streams tell of robots already", limits::STOP_WATCHERS_MAX);
            Refusal::new(Kind::Exhausted, Reason::new(Code::Overloaded, text))
        })?;
        let (sender, stream) = mpsc::channel(WATCH_MAX);
        tokio::spawn(async move {
            let (ends, reader) = (inner.ended.clone(), sender.clone());
            tokio::select! {
                () = ends.cancelled() => goes_on_elsewhere(&reader).await,
                () = status::tell_status(&inner, sender) => {}
            }
            drop(room);
        });
        Ok(ReceiverStream::new(stream))
    }
}

/// A reader asks whoever follows. One that reads nothing hears of it when its connection ends, which is soon.
async fn goes_on_elsewhere<T>(reader: &mpsc::Sender<Result<T, Status>>) {
    let _ = reader.send(Err(to_status(&changes::ends(), None))).await;
}

fn answer<T>(result: Result<T, Refusal>) -> Result<Response<T>, Status> {
    result.map(Response::new).map_err(|refusal| {
        metrics::counter!("midshift_stop_refused_total", "code" => refusal.reason.code.as_str()).increment(1);
        to_status(&refusal, None)
    })
}

#[tonic::async_trait]
impl Face for StopService {
    type EngageStream = ReceiverStream<Result<v1::EngageResponse, Status>>;
    type WatchStatusStream = ReceiverStream<Result<v1::WatchStatusResponse, Status>>;

    async fn engage(&self, r: Request<v1::EngageRequest>) -> Result<Response<Self::EngageStream>, Status> {
        let by = caller(&r);
        answer(self.engage_now(r.into_inner(), &by).await)
    }
    async fn reset(&self, r: Request<v1::ResetRequest>) -> Result<Response<v1::ResetResponse>, Status> {
        let by = caller(&r);
        answer(self.take_back(r.into_inner(), &by).await)
    }
    async fn get_status(&self, _: Request<v1::GetStatusRequest>) -> Result<Response<v1::GetStatusResponse>, Status> {
        answer(Ok(v1::GetStatusResponse { status: Some(status::status(&self.inner)) }))
    }
    async fn watch_status(
        &self,
        _: Request<v1::WatchStatusRequest>,
    ) -> Result<Response<Self::WatchStatusStream>, Status> {
        answer(self.watch())
    }
}
