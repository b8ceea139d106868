//! The gRPC face of roll-outs: decode, call, encode.

use super::service::RolloutService;
use super::watch::Countdowns;
use super::{decode, encode, watch};
use crate::repository::Release;
use midshift_core::identity::{Caller, Permission};
use midshift_core::ids::{BundleId, RequestId, RobotId, RolloutId};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal, Violations};
use midshift_core::rollout::dry_run::dry_run;
use midshift_core::rollout::objects;
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::requests::{CheckOnly, Command, CommandOutcome, Verb};
use midshift_core::rollout::rows::{Quarantine, Rollout};
use midshift_proto::access::caller;
use midshift_proto::convert::task::revision_of;
use midshift_proto::convert::timestamp;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_service_server::RolloutService as Face;
use midshift_proto::pages;
use midshift_proto::watches::{self, Reader};
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;
use tonic::{Request, Response, Status};

/// So long a caller waits for the row of a bundle that is published: the process that plans writes it within a second,
/// and another takes over within 5.
const ROWS_COME: Duration = Duration::from_secs(8);
const ROWS_LOOK: Duration = Duration::from_millis(50);

fn answer<T>(result: Result<T, Refusal>) -> Result<Response<T>, Status> {
    result.map(Response::new).map_err(|refusal| {
        metrics::counter!("midshift_ota_refused_total", "code" => refusal.reason.code.as_str()).increment(1);
        midshift_proto::status(&refusal, None)
    })
}

fn internal() -> Refusal {
    Refusal::new(Kind::Internal, Code::Internal)
}

fn required_reason(text: &str, bad: &mut Violations) {
    if text.is_empty() || text.len() > limits::REASON_BYTES_MAX {
        bad.add("reason", "is required, 1-256 bytes");
    }
}

/// The client's request_id; none: no protection.
fn request_id(text: &str, bad: &mut Violations) -> Option<String> {
    if !text.is_empty() {
        bad.accept("request_id", RequestId::parse(text));
    }
    (!text.is_empty()).then(|| text.to_owned())
}

fn check_only(validate_only: bool) -> CheckOnly {
    if validate_only { CheckOnly::Yes } else { CheckOnly::No }
}

/// When a call with the same request_id did it, for an answer; none: no such call.
fn done_before(taken: CommandOutcome) -> Option<prost_types::Timestamp> {
    match taken {
        CommandOutcome::Now => None,
        CommandOutcome::Before(at) => Some(timestamp(at)),
    }
}

/// What all verbs about one roll-out say.
struct About<'a> {
    by: &'a Caller,
    rollout_id: &'a str,
    etag: &'a str,
    reason: &'a str,
}

/// What all calls about the software of one robot say, and every rule that the call breaks.
struct RobotCall {
    robot_id: Option<RobotId>,
    request_id: Option<String>,
    check_only: CheckOnly,
    bad: Violations,
}

impl RobotCall {
    fn read(robot_id: &str, client_request_id: &str, validate_only: bool) -> Self {
        let mut bad = Violations::default();
        let robot_id = bad.accept("robot_id", RobotId::parse(robot_id));
        let request_id = request_id(client_request_id, &mut bad);
        Self { robot_id, request_id, check_only: check_only(validate_only), bad }
    }
}

impl RolloutService {
    async fn shown(&self, rollout_id: RolloutId, by: &Caller) -> Result<v1::Rollout, Refusal> {
        let by = by.clone();
        self.ask_about(vec![rollout_id.clone()], move |view, _, now| {
            Ok(encode::rollout(view, now, objects::find_seen(view, &by, &rollout_id)?))
        })
        .await?
    }

    async fn verb(&self, about: About<'_>, verb: Verb, needs_etag: bool) -> Result<Option<v1::Rollout>, Refusal> {
        self.verb_once(about, verb, needs_etag, CheckOnly::No, None).await.map(|(rollout, _)| Some(rollout))
    }

    async fn verb_once(
        &self,
        about: About<'_>,
        verb: Verb,
        needs_etag: bool,
        check_only: CheckOnly,
        request_id: Option<String>,
    ) -> Result<(v1::Rollout, CommandOutcome), Refusal> {
        let mut bad = Violations::default();
        let rollout_id = bad.accept("rollout_id", RolloutId::parse(about.rollout_id));
        if about.reason.len() > limits::REASON_BYTES_MAX {
            bad.add("reason", "must be at most 256 bytes");
        }
        let seen = revision_of(about.etag);
        if needs_etag && seen.is_none() {
            bad.add("etag", "is required: send back the one of the roll-out as you saw it");
        }
        bad.finish()?;
        let rollout_id = rollout_id.ok_or_else(internal)?;
        let command = Command::Do { rollout_id: rollout_id.clone(), verb, reason: about.reason.to_owned() };
        let taken = self.act_once(command, about.by, seen, check_only, request_id).await?;
        Ok((self.shown(rollout_id, about.by).await?, taken))
    }

    /// The bundle that a caller names. One that is published and has no row yet is waited for: whoever has just pushed
    /// it asks another process.
    async fn bundle(&self, text: &str) -> Result<BundleId, Refusal> {
        let until = Instant::now() + ROWS_COME;
        loop {
            let named = text.to_owned();
            let found = self.ask_projection(move |view, _, _| decode::bundle(view, &named)).await?;
            let is_late = found.is_err() && Instant::now() < until && self.is_published(text).await?;
            if !is_late {
                return found;
            }
            tokio::time::sleep(ROWS_LOOK).await;
        }
    }

    async fn is_published(&self, bundle: &str) -> Result<bool, Refusal> {
        let opened = self.ota.opened()?;
        opened.repository.documents().look_if_possible().await;
        let newest = opened.repository.newest();
        let is_named = |release: &Release| {
            let manifest = &release.manifest;
            release.digest.to_string() == bundle || format!("{}-{}", manifest.name, manifest.version) == bundle
        };
        Ok(newest.is_some_and(|newest| newest.releases.iter().any(is_named)))
    }

    async fn create(&self, r: v1::CreateRolloutRequest, by: &Caller) -> Result<v1::CreateRolloutResponse, Refusal> {
        let mut bad = Violations::default();
        let rollout_id = bad.accept("rollout_id", RolloutId::parse(&r.rollout_id));
        let spec = r.spec.unwrap_or_default();
        if spec.bundle.is_empty() {
            bad.add("spec.bundle", "is required");
        }
        bad.finish()?;
        let bundle = self.bundle(&spec.bundle).await?;
        let mut bad = Violations::default();
        let spec = decode::spec(&spec, bundle, self.probation_ms, &mut bad);
        spec.check(&mut bad);
        bad.finish()?;
        let rollout_id = rollout_id.ok_or_else(internal)?;
        self.act(Command::Create { rollout_id: rollout_id.clone(), spec: Arc::new(spec) }, by, None).await?;
        Ok(v1::CreateRolloutResponse { rollout: Some(self.shown(rollout_id, by).await?) })
    }

    async fn plan(&self, r: v1::PlanRolloutRequest, by: &Caller) -> Result<v1::PlanRolloutResponse, Refusal> {
        let mut bad = Violations::default();
        let rollout_id = bad.accept("rollout_id", RolloutId::parse(&r.rollout_id));
        bad.finish()?;
        let rollout_id = rollout_id.ok_or_else(internal)?;
        if let Some(spec) = &r.spec {
            self.bundle(&spec.bundle).await?;
        }
        let (probation_ms, by, about) = (self.probation_ms, by.clone(), vec![rollout_id.clone()]);
        self.ask_about(about, move |view, board, _| {
            let spec = match r.spec {
                Some(wire) => {
                    let bundle = decode::bundle(view, &wire.bundle)?;
                    let mut bad = Violations::default();
                    let spec = decode::spec(&wire, bundle, probation_ms, &mut bad);
                    bad.finish()?;
                    Arc::new(spec)
                }
                None => objects::find_seen(view, &by, &rollout_id)?.spec.clone(),
            };
            by.authorize(Permission::Author, &spec.selector.areas)?;
            let run = dry_run(view, board, &rollout_id, &spec)?;
            Ok(encode::plan(&run, spec.waves.len()))
        })
        .await?
    }

    async fn exclude(&self, r: v1::ExcludeRobotRequest, by: &Caller) -> Result<v1::ExcludeRobotResponse, Refusal> {
        let mut bad = Violations::default();
        bad.accept("rollout_id", RolloutId::parse(&r.rollout_id));
        let robot_id = bad.accept("robot_id", RobotId::parse(&r.robot_id));
        let request_id = request_id(&r.request_id, &mut bad);
        bad.finish()?;
        let about = About { by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let verb = Verb::Exclude(robot_id.ok_or_else(internal)?);
        let (rollout, taken) = self.verb_once(about, verb, false, check_only(r.validate_only), request_id).await?;
        Ok(v1::ExcludeRobotResponse { rollout: Some(rollout), done_before: done_before(taken) })
    }

    async fn write_off(&self, r: v1::WriteOffRobotRequest, by: &Caller) -> Result<v1::WriteOffRobotResponse, Refusal> {
        let mut bad = Violations::default();
        bad.accept("rollout_id", RolloutId::parse(&r.rollout_id));
        let robot_id = bad.accept("robot_id", RobotId::parse(&r.robot_id));
        required_reason(&r.reason, &mut bad);
        let request_id = request_id(&r.request_id, &mut bad);
        bad.finish()?;
        let about = About { by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let verb = Verb::WriteOff(robot_id.ok_or_else(internal)?);
        let (rollout, taken) = self.verb_once(about, verb, false, check_only(r.validate_only), request_id).await?;
        Ok(v1::WriteOffRobotResponse { rollout: Some(rollout), done_before: done_before(taken) })
    }

    async fn roll_back(
        &self,
        r: v1::RollBackRolloutRequest,
        by: &Caller,
    ) -> Result<v1::RollBackRolloutResponse, Refusal> {
        let mut bad = Violations::default();
        let of = bad.accept("rollout_id", RolloutId::parse(&r.rollout_id));
        let rollout_id = bad.accept("new_rollout_id", RolloutId::parse(&r.new_rollout_id));
        bad.finish()?;
        let (of, rollout_id) = of.zip(rollout_id).ok_or_else(internal)?;
        self.act(Command::Rollback { of, rollout_id: rollout_id.clone() }, by, None).await?;
        Ok(v1::RollBackRolloutResponse { rollout: Some(self.shown(rollout_id, by).await?) })
    }

    async fn robots(
        &self,
        r: v1::ListRolloutRobotsRequest,
        by: &Caller,
    ) -> Result<v1::ListRolloutRobotsResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        let rollout_id = bad.accept("rollout_id", RolloutId::parse(&r.rollout_id));
        bad.finish()?;
        let (rollout_id, by) = (rollout_id.ok_or_else(internal)?, by.clone());
        self.ask_about(vec![rollout_id.clone()], move |view, board, now| {
            let row = objects::find_seen(view, &by, &rollout_id)?;
            let asked = |id: &RobotId| r.robot_id.is_empty() || id.as_str() == r.robot_id;
            let rows = view.robots_of(&rollout_id).filter(|r| asked(&r.robot_id));
            let (rows, next_page_token) = pages::page(rows.map(|r| (r.robot_id.to_string(), r)), &r.page_token, size);
            let robots = rows.into_iter().map(|r| encode::robot(view, board, now, row, r)).collect();
            Ok(v1::ListRolloutRobotsResponse { robots, next_page_token })
        })
        .await?
    }

    async fn revoke(&self, r: v1::RevokeBundleRequest, by: &Caller) -> Result<v1::RevokeBundleResponse, Refusal> {
        let mut bad = Violations::default();
        let request_id = request_id(&r.request_id, &mut bad);
        required_reason(&r.reason, &mut bad);
        bad.finish()?;
        let bundle = self.bundle(&r.bundle).await?;
        let command = Command::Revoke { bundle: bundle.clone(), reason: r.reason };
        let taken = self.act_once(command, by, None, check_only(r.validate_only), request_id).await?;
        self.ask_projection(move |view, _, _| {
            let of = view.rollouts.values().map(|r| &r.row).filter(|r| r.spec.bundle == bundle && !r.phase.is_over());
            let (back, still): (Vec<&Rollout>, Vec<_>) = of.partition(|r| r.phase.goes_back() || r.revert_of.is_some());
            let ids = |of: Vec<&Rollout>| of.into_iter().map(|r| r.rollout_id.to_string()).collect();
            let (rollout_ids, reverting_rollout_ids) = (ids(still), ids(back));
            let (bundle, done_before) = (bundle.to_string(), done_before(taken));
            v1::RevokeBundleResponse { bundle, rollout_ids, reverting_rollout_ids, done_before }
        })
        .await
    }

    /// Carries out a command about the software of one robot. Answers with what the robot runs after it, and when it
    /// was done before.
    async fn act_on_robot(
        &self,
        call: RobotCall,
        by: &Caller,
        command: impl FnOnce(RobotId) -> Command,
    ) -> Result<(Option<v1::RobotSoftware>, Option<prost_types::Timestamp>), Refusal> {
        call.bad.finish()?;
        let robot_id = call.robot_id.ok_or_else(internal)?;
        let command = command(robot_id.clone());
        let taken = self.act_once(command, by, None, call.check_only, call.request_id).await?;
        let software = self
            .ask_projection(move |view: &RolloutProjection, _, _| encode::software(&view.software_of(&robot_id)))
            .await?;
        Ok((Some(software), done_before(taken)))
    }

    async fn pin(&self, r: v1::PinRobotRequest, by: &Caller) -> Result<v1::PinRobotResponse, Refusal> {
        let mut call = RobotCall::read(&r.robot_id, &r.request_id, r.validate_only);
        required_reason(&r.reason, &mut call.bad);
        let command = |robot_id| Command::Pin { robot_id, reason: r.reason };
        let (software, done_before) = self.act_on_robot(call, by, command).await?;
        Ok(v1::PinRobotResponse { software, done_before })
    }

    async fn unpin(&self, r: v1::UnpinRobotRequest, by: &Caller) -> Result<v1::UnpinRobotResponse, Refusal> {
        let call = RobotCall::read(&r.robot_id, &r.request_id, r.validate_only);
        let (software, done_before) = self.act_on_robot(call, by, |robot_id| Command::Unpin { robot_id }).await?;
        Ok(v1::UnpinRobotResponse { software, done_before })
    }

    async fn unstick(&self, r: v1::UnstickRobotRequest, by: &Caller) -> Result<v1::UnstickRobotResponse, Refusal> {
        let mut call = RobotCall::read(&r.robot_id, &r.request_id, r.validate_only);
        required_reason(&r.reason, &mut call.bad);
        let command = |robot_id| Command::Unstick { robot_id, reason: r.reason };
        let (software, done_before) = self.act_on_robot(call, by, command).await?;
        Ok(v1::UnstickRobotResponse { software, done_before })
    }

    async fn accept_key(
        &self,
        r: v1::AcceptDeviceKeyRequest,
        by: &Caller,
    ) -> Result<v1::AcceptDeviceKeyResponse, Refusal> {
        let mut call = RobotCall::read(&r.robot_id, &r.request_id, r.validate_only);
        if r.device_key.len() != 64 || !r.device_key.chars().all(|c| matches!(c, '0'..='9' | 'a'..='f')) {
            call.bad.add("device_key", "must be 64 lower-case hexadecimal digits");
        }
        let command = |robot_id| Command::AcceptKey { robot_id, device_key: r.device_key };
        let (software, done_before) = self.act_on_robot(call, by, command).await?;
        Ok(v1::AcceptDeviceKeyResponse { software, done_before })
    }

    async fn software(
        &self,
        r: v1::ListRobotSoftwareRequest,
        by: &Caller,
    ) -> Result<v1::ListRobotSoftwareResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let by = by.clone();
        self.ask_projection(move |view, board, _| {
            let rows = view.software.iter().filter(|(id, _)| r.robot_id.is_empty() || **id == r.robot_id);
            let rows = rows.filter(|(_, s)| objects::sees_robot(view, board, &by, &s.row.robot_id));
            let (rows, next_page_token) = pages::page(rows, &r.page_token, size);
            let software = rows.into_iter().map(|s| encode::software(&s.row)).collect();
            v1::ListRobotSoftwareResponse { software, next_page_token }
        })
        .await
    }

    async fn quarantines(
        &self,
        r: v1::ListQuarantinesRequest,
        by: &Caller,
    ) -> Result<v1::ListQuarantinesResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let by = by.clone();
        self.ask_projection(move |view, board, _| {
            let seen = |q: &&Quarantine| objects::sees_robot(view, board, &by, &q.robot_id);
            let rows = view.quarantines.iter().filter(|(_, q)| seen(&&q.row));
            let (rows, next_page_token) = pages::page(rows, &r.page_token, size);
            let quarantines = rows.into_iter().map(|q| encode::quarantine(view, &q.row)).collect();
            v1::ListQuarantinesResponse { quarantines, next_page_token }
        })
        .await
    }

    async fn lift(&self, r: v1::LiftQuarantineRequest, by: &Caller) -> Result<v1::LiftQuarantineResponse, Refusal> {
        let mut bad = Violations::default();
        let robot_id = bad.accept("robot_id", RobotId::parse(&r.robot_id));
        let request_id = request_id(&r.request_id, &mut bad);
        bad.finish()?;
        let robot_id = robot_id.ok_or_else(internal)?;
        let bundle = self.bundle(&r.bundle).await?;
        let command = Command::LiftQuarantine { robot_id: robot_id.clone(), bundle: bundle.clone() };
        let taken = self.act_once(command, by, None, check_only(r.validate_only), request_id).await?;
        self.ask_projection(move |view, _, _| {
            let quarantine = view.quarantines.get(Quarantine::id_of(&robot_id, &bundle).as_str());
            let quarantine = quarantine.map(|q| encode::quarantine(view, &q.row));
            v1::LiftQuarantineResponse { done_before: done_before(taken), quarantine }
        })
        .await
    }
}

#[tonic::async_trait]
impl Face for RolloutService {
    type WatchRolloutStream = Reader<v1::WatchRolloutResponse>;

    async fn create_rollout(
        &self,
        r: Request<v1::CreateRolloutRequest>,
    ) -> Result<Response<v1::CreateRolloutResponse>, Status> {
        let by = caller(&r);
        answer(self.create(r.into_inner(), &by).await)
    }
    async fn plan_rollout(
        &self,
        r: Request<v1::PlanRolloutRequest>,
    ) -> Result<Response<v1::PlanRolloutResponse>, Status> {
        let by = caller(&r);
        answer(self.plan(r.into_inner(), &by).await)
    }
    async fn submit_rollout(
        &self,
        r: Request<v1::SubmitRolloutRequest>,
    ) -> Result<Response<v1::SubmitRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Submit, false).await;
        answer(rollout.map(|rollout| v1::SubmitRolloutResponse { rollout }))
    }
    async fn approve_rollout(
        &self,
        r: Request<v1::ApproveRolloutRequest>,
    ) -> Result<Response<v1::ApproveRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Approve, false).await;
        answer(rollout.map(|rollout| v1::ApproveRolloutResponse { rollout }))
    }
    async fn start_rollout(
        &self,
        r: Request<v1::StartRolloutRequest>,
    ) -> Result<Response<v1::StartRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Start { supersede: r.supersede }, false).await;
        answer(rollout.map(|rollout| v1::StartRolloutResponse { rollout }))
    }
    async fn pause_rollout(
        &self,
        r: Request<v1::PauseRolloutRequest>,
    ) -> Result<Response<v1::PauseRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Pause, false).await;
        answer(rollout.map(|rollout| v1::PauseRolloutResponse { rollout }))
    }
    async fn resume_rollout(
        &self,
        r: Request<v1::ResumeRolloutRequest>,
    ) -> Result<Response<v1::ResumeRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Resume, true).await;
        answer(rollout.map(|rollout| v1::ResumeRolloutResponse { rollout }))
    }
    async fn promote_rollout(
        &self,
        r: Request<v1::PromoteRolloutRequest>,
    ) -> Result<Response<v1::PromoteRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Promote, true).await;
        answer(rollout.map(|rollout| v1::PromoteRolloutResponse { rollout }))
    }
    async fn abort_rollout(
        &self,
        r: Request<v1::AbortRolloutRequest>,
    ) -> Result<Response<v1::AbortRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::Abort, true).await;
        answer(rollout.map(|rollout| v1::AbortRolloutResponse { rollout }))
    }
    async fn retry_rollout(
        &self,
        r: Request<v1::RetryRolloutRequest>,
    ) -> Result<Response<v1::RetryRolloutResponse>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let about = About { by: &by, rollout_id: &r.rollout_id, etag: &r.etag, reason: &r.reason };
        let rollout = self.verb(about, Verb::RetryFailed, false).await;
        answer(rollout.map(|rollout| v1::RetryRolloutResponse { rollout }))
    }
    async fn exclude_robot(
        &self,
        r: Request<v1::ExcludeRobotRequest>,
    ) -> Result<Response<v1::ExcludeRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.exclude(r.into_inner(), &by).await)
    }
    async fn write_off_robot(
        &self,
        r: Request<v1::WriteOffRobotRequest>,
    ) -> Result<Response<v1::WriteOffRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.write_off(r.into_inner(), &by).await)
    }
    async fn roll_back_rollout(
        &self,
        r: Request<v1::RollBackRolloutRequest>,
    ) -> Result<Response<v1::RollBackRolloutResponse>, Status> {
        let by = caller(&r);
        answer(self.roll_back(r.into_inner(), &by).await)
    }
    async fn list_rollouts(
        &self,
        r: Request<v1::ListRolloutsRequest>,
    ) -> Result<Response<v1::ListRolloutsResponse>, Status> {
        let by = caller(&r);
        answer(self.list(r.into_inner(), &by).await)
    }
    async fn list_rollout_robots(
        &self,
        r: Request<v1::ListRolloutRobotsRequest>,
    ) -> Result<Response<v1::ListRolloutRobotsResponse>, Status> {
        let by = caller(&r);
        answer(self.robots(r.into_inner(), &by).await)
    }
    async fn revoke_bundle(
        &self,
        r: Request<v1::RevokeBundleRequest>,
    ) -> Result<Response<v1::RevokeBundleResponse>, Status> {
        let by = caller(&r);
        answer(self.revoke(r.into_inner(), &by).await)
    }
    async fn pin_robot(&self, r: Request<v1::PinRobotRequest>) -> Result<Response<v1::PinRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.pin(r.into_inner(), &by).await)
    }
    async fn unpin_robot(&self, r: Request<v1::UnpinRobotRequest>) -> Result<Response<v1::UnpinRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.unpin(r.into_inner(), &by).await)
    }
    async fn unstick_robot(
        &self,
        r: Request<v1::UnstickRobotRequest>,
    ) -> Result<Response<v1::UnstickRobotResponse>, Status> {
        let by = caller(&r);
        answer(self.unstick(r.into_inner(), &by).await)
    }
    async fn accept_device_key(
        &self,
        r: Request<v1::AcceptDeviceKeyRequest>,
    ) -> Result<Response<v1::AcceptDeviceKeyResponse>, Status> {
        let by = caller(&r);
        answer(self.accept_key(r.into_inner(), &by).await)
    }
    async fn list_robot_software(
        &self,
        r: Request<v1::ListRobotSoftwareRequest>,
    ) -> Result<Response<v1::ListRobotSoftwareResponse>, Status> {
        let by = caller(&r);
        answer(self.software(r.into_inner(), &by).await)
    }
    async fn list_quarantines(
        &self,
        r: Request<v1::ListQuarantinesRequest>,
    ) -> Result<Response<v1::ListQuarantinesResponse>, Status> {
        let by = caller(&r);
        answer(self.quarantines(r.into_inner(), &by).await)
    }
    async fn lift_quarantine(
        &self,
        r: Request<v1::LiftQuarantineRequest>,
    ) -> Result<Response<v1::LiftQuarantineResponse>, Status> {
        let by = caller(&r);
        answer(self.lift(r.into_inner(), &by).await)
    }
    async fn get_rollout(&self, r: Request<v1::GetRolloutRequest>) -> Result<Response<v1::GetRolloutResponse>, Status> {
        let by = caller(&r);
        let rollout = match named(&r.into_inner().rollout_id) {
            Ok(rollout_id) => self.shown(rollout_id, &by).await,
            Err(refusal) => Err(refusal),
        };
        answer(rollout.map(|rollout| v1::GetRolloutResponse { rollout: Some(rollout) }))
    }
    async fn watch_rollout(
        &self,
        r: Request<v1::WatchRolloutRequest>,
    ) -> Result<Response<Self::WatchRolloutStream>, Status> {
        let (by, r) = (caller(&r), r.into_inner());
        let countdowns = if r.counts_down { Countdowns::Followed } else { Countdowns::WithChanges };
        let rollout_id = named(&r.rollout_id).map_err(|refusal| midshift_proto::status(&refusal, None))?;
        let (teller, reader) = watches::watch();
        let service = self.clone();
        tokio::spawn(async move {
            let shutdown = service.shutdown.clone();
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = watch::watch(service, rollout_id, countdowns, by, &teller) => {}
            }
        });
        Ok(Response::new(reader))
    }
}

fn named(rollout_id: &str) -> Result<RolloutId, Refusal> {
    let mut bad = Violations::default();
    let rollout_id = bad.accept("rollout_id", RolloutId::parse(rollout_id));
    bad.finish()?;
    rollout_id.ok_or_else(internal)
}
