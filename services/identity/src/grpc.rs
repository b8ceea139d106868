//! The two faces: decode, decide, encode.

use crate::certificate_authority::{CertificateAuthority, SignedCertificate, read_signing_request};
use crate::register::decided;
use crate::tokens::rotate::{self, Turn};
use crate::tokens::{self, NewToken};
use crate::{Error, IdentityService, encode};
use midshift_core::audit::Note;
use midshift_core::identity::{Caller, Principal, Replace, RobotIdentity, Secret, TokenId};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::time::Utc;
use midshift_proto::DenialReporter;
use midshift_proto::access::caller;
use midshift_proto::convert::common::timestamp;
use midshift_proto::identity::v1;
use midshift_proto::identity::v1::enrolment_service_server::EnrolmentService as EnrolmentFace;
use midshift_proto::identity::v1::identity_service_server::IdentityService as IdentityFace;
use midshift_proto::{pages, status};
use tonic::{Request, Response, Status};

fn answered<T>(answer: Result<T, Refusal>) -> Result<Response<T>, Status> {
    answer.map(Response::new).map_err(|refusal| status(&refusal, None))
}

fn robot_of(text: &str) -> Result<RobotId, Refusal> {
    RobotId::parse(text).map_err(|error| Refusal::field("robot_id", error.to_string()))
}

fn hidden(error: &Error) -> Refusal {
    tracing::error!(peer = "any", %error, "a certificate was not signed");
    Refusal::new(Kind::Internal, Code::Internal)
}

impl IdentityService {
    pub(crate) fn now(&self) -> Utc {
        self.0.clock.now().wall
    }

    fn authority(&self) -> Result<&CertificateAuthority, Refusal> {
        let elsewhere = || {
            Reason::new(
                Code::ServedElsewhere,
                "identity is served by the process with role identity: ask at the public address",
            )
        };
        self.0.authority.as_ref().ok_or_else(|| Refusal::new(Kind::Precondition, elsewhere()))
    }

    /// The authority and the time to sign by, if that of this machine is not in doubt: what it signs has its beginning and its end by it.
    fn signing(&self) -> Result<(&CertificateAuthority, Utc), Refusal> {
        match self.0.clock.undoubted() {
            Err(_) => Err(Refusal::new(Kind::Unavailable, Code::ClockDoubted)),
            Ok(now) => Ok((self.authority()?, now.wall)),
        }
    }

    /// What was taken back is on the list, durably, before whoever did it hears so: a restore goes by that list.
    pub(crate) async fn recorded(&self) -> Result<(), Refusal> {
        let Some(list) = &self.0.revoked else { return Ok(()) };
        self.append_revocations(list).await.map_err(|error| {
            tracing::error!(peer = "any", %error, "what was taken back is not on the list of revocations yet");
            let text = "it is taken back at every port, and not yet on the list that a restore goes by: ask again";
            Refusal::new(Kind::Unavailable, Reason::new(Code::StoreUnavailable, text))
        })
    }

    async fn make_token(&self, r: v1::CreateTokenRequest, actor: &Caller) -> Result<v1::CreateTokenResponse, Refusal> {
        let wanted = NewToken::check(&r)?;
        let (record, secret) = tokens::create(&self.0.register, &wanted, &actor.into(), self.now()).await?;
        Ok(v1::CreateTokenResponse { token: Some(encode::token(&record)), secret: secret.reveal(Secret::TOKEN) })
    }

    async fn turn_token(&self, r: v1::RotateTokenRequest, actor: &Caller) -> Result<v1::RotateTokenResponse, Refusal> {
        let turn = Turn::check(&r)?;
        let (record, secret) = rotate::rotate(&self.0.register, &turn, &actor.into(), self.now()).await?;
        self.recorded().await?;
        let secret = secret.map(|secret| secret.reveal(Secret::TOKEN)).unwrap_or_default();
        Ok(v1::RotateTokenResponse { token: Some(encode::token(&record)), secret })
    }

    async fn tokens(&self, r: v1::ListTokensRequest) -> Result<v1::ListTokensResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let all = self.0.register.ask(tokens::newest_first).await.map_err(|_| unavailable())?;
        let (page, next_page_token) = pages::page(all.into_iter(), &r.page_token, size);
        Ok(v1::ListTokensResponse { tokens: page.iter().map(encode::token).collect(), next_page_token })
    }

    async fn take_token_back(
        &self,
        r: v1::RevokeTokenRequest,
        actor: &Caller,
    ) -> Result<v1::RevokeTokenResponse, Refusal> {
        let token_id =
            TokenId::new(&r.token_id).ok_or_else(|| Refusal::field("token_id", "must be 1-32 of [a-z0-9]"))?;
        let record = tokens::revoke(&self.0.register, &token_id, &actor.into(), self.now()).await?;
        self.recorded().await?;
        Ok(v1::RevokeTokenResponse { token: Some(encode::token(&record)) })
    }

    async fn offer(
        &self,
        r: v1::CreateEnrolmentRequest,
        actor: &Caller,
    ) -> Result<v1::CreateEnrolmentResponse, Refusal> {
        let robot_id = robot_of(&r.robot_id)?;
        let pin = self.authority()?.pin();
        let (secret, now) = (tokens::draw(), self.now());
        let (replace, offer) = if r.replace { (Replace::Yes, "robot.replace") } else { (Replace::No, "robot.enroll") };
        let note = Note::new(offer).about("robot", &robot_id);
        let offered = self.0.register.decide_for(actor, note.clone(), |view| {
            let (mut robot, at) = known(view.robots.get(&robot_id), &robot_id);
            robot.offer(secret.id().clone(), tokens::digest(&secret), replace, now)?;
            Ok((Some(decided(&robot, at, actor, "robot.enrolment_offered", note.clone())), robot))
        });
        let robot = offered.await?;
        let expires = robot.enrolment.map_or(now, |open| Utc(open.expires_unix_ms));
        let secret = format!("{}.{pin}", secret.reveal(Secret::ENROLMENT));
        Ok(v1::CreateEnrolmentResponse { secret, expire_time: Some(timestamp(expires)) })
    }

    async fn revoke(&self, r: v1::RevokeRobotRequest, actor: &Caller) -> Result<v1::RevokeRobotResponse, Refusal> {
        let robot_id = robot_of(&r.robot_id)?;
        if r.reason.len() > limits::REASON_BYTES_MAX {
            return Err(Refusal::field("reason", format!("must be at most {} bytes", limits::REASON_BYTES_MAX)));
        }
        let now = self.now();
        let not_found = || Refusal::new(Kind::NotFound, Reason::from(Code::RobotNotFound).with("robot_id", &robot_id));
        let revoked = self.0.register.decide(|view| {
            let (robot, at) = view.robots.get(&robot_id).ok_or_else(not_found)?;
            if robot.key.is_none() && robot.enrolment.is_none() {
                return Ok((None, robot.clone()));
            }
            let mut robot = robot.clone();
            robot.revoke(&actor.to_string(), now);
            Ok((
                Some(decided(
                    &robot,
                    Some(*at),
                    actor,
                    "robot.revoked",
                    Note::new("robot.revoke").about("robot", &robot_id).because(&r.reason),
                )),
                robot,
            ))
        });
        let robot = revoked.await?;
        self.recorded().await?;
        Ok(v1::RevokeRobotResponse { robot: Some(encode::robot(&robot)) })
    }

    async fn robots(&self, r: v1::ListRobotIdentitiesRequest) -> Result<v1::ListRobotIdentitiesResponse, Refusal> {
        let mut bad = Violations::default();
        let size = pages::size(r.page_size, &mut bad);
        bad.finish()?;
        let page = self.0.register.ask(|view| {
            let robots = view.robots.values().map(|(robot, _)| robot);
            let begin = robots.filter(|robot| robot.robot_id.as_str().starts_with(&r.robot_id_prefix));
            pages::page(begin.map(|robot| (robot.robot_id.to_string(), encode::robot(robot))), &r.page_token, size)
        });
        let (robots, next_page_token) = page.await.map_err(|_| unavailable())?;
        Ok(v1::ListRobotIdentitiesResponse { robots, next_page_token })
    }

    async fn enrolled(&self, r: v1::EnrolRequest) -> Result<v1::EnrolResponse, Refusal> {
        let mut bad = Violations::default();
        let robot_id = bad.accept("robot_id", RobotId::parse(&r.robot_id));
        let secret = Secret::read(Secret::ENROLMENT, &r.secret);
        if secret.is_none() {
            bad.add("secret", "must be the secret of `midshift robot enroll`, mse.ID.DIGITS");
        }
        bad.finish()?;
        let (Some(robot_id), Some(secret)) = (robot_id, secret) else {
            return Err(Refusal::field("secret", "is required"));
        };
        let ((authority, now), request) = (self.signing()?, read_signing_request(&r.request_pem)?);
        let (key, digest) = (request.key, tokens::digest(&secret));
        let expires = Utc(now.0.saturating_add_unsigned(limits::ROBOT_CERTIFICATE_VALID.as_ms()));
        // One at a time: whether a key is another robot's is decided over all of them.
        let _alone = self.0.enrolling.lock().await;
        self.0
            .register
            .decide(|view| {
                let (mut robot, at) = known(view.robots.get(&robot_id), &robot_id);
                robot.enrol(secret.id(), &digest, key, now)?;
                robot.renew(&key, expires)?;
                if view.robots.values().any(|(other, _)| other.robot_id != robot_id && other.knows(&key)) {
                    let text = "the key of this machine is, or was, that of another robot";
                    return Err(Refusal::new(Kind::Unauthenticated, Reason::new(Code::KeyDenied, text)));
                }
                Ok((
                    Some(decided(
                        &robot,
                        at,
                        format!("robot:{robot_id}").as_str(),
                        "robot.enrolled",
                        Note::new("robot.enrolled").about("robot", &robot_id).with("key", key),
                    )),
                    (),
                ))
            })
            .await
            .map_err(|refusal| about(refusal, &robot_id))?;
        // The key of the machine whose place it took.
        self.recorded().await?;
        let SignedCertificate { chain_pem, expires } =
            authority.sign_robot(request, &robot_id, now).map_err(|e| hidden(&e))?;
        tracing::info!(%robot_id, %key, "a robot was enrolled");
        Ok(v1::EnrolResponse {
            certificate_pem: chain_pem,
            authority_pem: authority.certificate_pem().to_owned(),
            expire_time: Some(timestamp(expires)),
            trust_json: self.0.trust_json.clone(),
        })
    }

    async fn renewed(
        &self,
        r: v1::RenewCertificateRequest,
        caller: &Caller,
    ) -> Result<v1::RenewCertificateResponse, Refusal> {
        let robot_id = robot_of(&r.robot_id)?;
        caller.is_robot(&robot_id)?;
        let ((authority, now), request) = (self.signing()?, read_signing_request(&r.request_pem)?);
        let key = request.key;
        let expires = Utc(now.0.saturating_add_unsigned(limits::ROBOT_CERTIFICATE_VALID.as_ms()));
        self.0
            .register
            .decide(|view| {
                let (mut robot, at) = known(view.robots.get(&robot_id), &robot_id);
                robot.renew(&key, expires)?;
                let note = Note::new("robot.renew").about("robot", &robot_id).with("key", key);
                Ok((Some(decided(&robot, at, caller, "robot.certificate_renewed", note)), ()))
            })
            .await
            .map_err(|refusal| about(refusal, &robot_id))?;
        let SignedCertificate { chain_pem, expires } =
            authority.sign_robot(request, &robot_id, now).map_err(|e| hidden(&e))?;
        Ok(v1::RenewCertificateResponse {
            certificate_pem: chain_pem,
            authority_pem: authority.certificate_pem().to_owned(),
            expire_time: Some(timestamp(expires)),
        })
    }
}

/// The same refusal with whom it is about, for the row of the audit that it leaves.
fn about(mut refusal: Refusal, robot_id: &RobotId) -> Refusal {
    refusal.reason = refusal.reason.clone().with("robot_id", robot_id);
    refusal
}

/// A robot's row, if it has one.
pub type Row<'a> = Option<&'a (RobotIdentity, midshift_core::rows::Revision)>;

/// The robot of a row, or one that nothing is known of.
pub fn known(row: Row<'_>, robot_id: &RobotId) -> (RobotIdentity, Option<midshift_core::rows::Revision>) {
    row.map_or_else(|| (RobotIdentity::new(robot_id.clone()), None), |(robot, at)| (robot.clone(), Some(*at)))
}

fn unavailable() -> Refusal {
    Refusal::new(Kind::Unavailable, Code::StoreUnavailable)
}

#[tonic::async_trait]
impl IdentityFace for IdentityService {
    async fn who_am_i(&self, request: Request<v1::WhoAmIRequest>) -> Result<Response<v1::WhoAmIResponse>, Status> {
        let caller = caller(&request);
        let token_id = match caller.principal() {
            Principal::Holder { token, .. } => token.to_string(),
            _ => String::new(),
        };
        Ok(Response::new(v1::WhoAmIResponse {
            actor: caller.to_string(),
            token_id,
            grants: caller.grants().iter().map(ToString::to_string).collect(),
            site_id: self.0.site_id.to_string(),
            person: caller.named_person().map(ToString::to_string).unwrap_or_default(),
        }))
    }
    async fn create_token(
        &self,
        request: Request<v1::CreateTokenRequest>,
    ) -> Result<Response<v1::CreateTokenResponse>, Status> {
        let actor = caller(&request);
        answered(self.make_token(request.into_inner(), &actor).await)
    }
    async fn rotate_token(
        &self,
        request: Request<v1::RotateTokenRequest>,
    ) -> Result<Response<v1::RotateTokenResponse>, Status> {
        let actor = caller(&request);
        answered(self.turn_token(request.into_inner(), &actor).await)
    }
    async fn list_tokens(
        &self,
        request: Request<v1::ListTokensRequest>,
    ) -> Result<Response<v1::ListTokensResponse>, Status> {
        answered(self.tokens(request.into_inner()).await)
    }
    async fn revoke_token(
        &self,
        request: Request<v1::RevokeTokenRequest>,
    ) -> Result<Response<v1::RevokeTokenResponse>, Status> {
        let actor = caller(&request);
        answered(self.take_token_back(request.into_inner(), &actor).await)
    }
    async fn create_enrolment(
        &self,
        request: Request<v1::CreateEnrolmentRequest>,
    ) -> Result<Response<v1::CreateEnrolmentResponse>, Status> {
        let actor = caller(&request);
        answered(self.offer(request.into_inner(), &actor).await)
    }
    async fn revoke_robot(
        &self,
        request: Request<v1::RevokeRobotRequest>,
    ) -> Result<Response<v1::RevokeRobotResponse>, Status> {
        let actor = caller(&request);
        answered(self.revoke(request.into_inner(), &actor).await)
    }
    async fn adopt_robot(
        &self,
        request: Request<v1::AdoptRobotRequest>,
    ) -> Result<Response<v1::AdoptRobotResponse>, Status> {
        let actor = caller(&request);
        answered(self.adopt(request.into_inner(), &actor).await)
    }
    async fn list_robot_identities(
        &self,
        request: Request<v1::ListRobotIdentitiesRequest>,
    ) -> Result<Response<v1::ListRobotIdentitiesResponse>, Status> {
        answered(self.robots(request.into_inner()).await)
    }
}

#[tonic::async_trait]
impl EnrolmentFace for IdentityService {
    async fn enrol(&self, request: Request<v1::EnrolRequest>) -> Result<Response<v1::EnrolResponse>, Status> {
        let reporter = DenialReporter::from_request(&request);
        answered(self.enrolled(request.into_inner()).await.inspect_err(|refusal| reporter.report(refusal)))
    }
    async fn renew_certificate(
        &self,
        request: Request<v1::RenewCertificateRequest>,
    ) -> Result<Response<v1::RenewCertificateResponse>, Status> {
        let (caller, reporter) = (caller(&request), DenialReporter::from_request(&request));
        answered(self.renewed(request.into_inner(), &caller).await.inspect_err(|refusal| reporter.report(refusal)))
    }
}
