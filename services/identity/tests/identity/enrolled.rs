//! Machines that become robots, and robots that are taken out.

use crate::world::{Heard, Machine, World, asked_by, code, enrol, secret};
use midshift_core::identity::{Caller, Digest};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_identity::IdentityService;
use midshift_proto::DenialReporter;
use midshift_proto::access::local;
use midshift_proto::identity::v1::enrolment_service_server::EnrolmentService as _;
use midshift_proto::identity::v1::identity_service_server::IdentityService as _;
use midshift_proto::identity::v1::{
    ListRobotIdentitiesRequest, RenewCertificateRequest, RevokeRobotRequest, RobotIdentity,
};
use std::sync::Arc;

async fn robot(identity: &IdentityService, robot_id: &str) -> RobotIdentity {
    let request = local(ListRobotIdentitiesRequest::default());
    let all = identity.list_robot_identities(request).await.expect("a list").into_inner().robots;
    all.into_iter().find(|robot| robot.robot_id == robot_id).expect("a robot")
}

#[tokio::test]
async fn robots_are_listed_by_the_beginning_of_their_id_whether_or_not_they_were_ever_heard() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    for id in ["r7", "r70", "r8"] {
        secret(&identity, id, false).await.expect("a secret");
    }
    let begin = async |prefix: &str| {
        let request = ListRobotIdentitiesRequest { robot_id_prefix: prefix.to_owned(), ..Default::default() };
        let page = identity.list_robot_identities(local(request)).await.expect("a list").into_inner();
        page.robots.into_iter().map(|robot| robot.robot_id).collect::<Vec<_>>()
    };
    assert_eq!(begin("r7").await, ["r7", "r70"]);
    assert_eq!(begin("").await, ["r7", "r70", "r8"]);
    assert_eq!(begin("r9").await, Vec::<String>::new());
}

fn denies(identity: &IdentityService, key: &str) -> bool {
    let key: Digest = key.parse().expect("a digest");
    identity.directory().borrow().denies(&key)
}

#[tokio::test]
async fn a_machine_gets_a_certificate_that_says_which_robot_it_is_whatever_it_asked_for() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let line = secret(&identity, "r7", false).await.expect("a secret");
    let answer = enrol(&identity, "r7", &line, &Machine::new()).await.expect("enrolled");
    assert_eq!(answer.authority_pem, identity.proof().borrow().authority_pem);
    let leaf = pem(&answer.certificate_pem);
    let leaf = rustls::pki_types::CertificateDer::from(leaf);
    let certificate = webpki::EndEntityCert::try_from(&leaf).expect("a certificate");
    assert_eq!(certificate.valid_uri_names().collect::<Vec<_>>(), ["spiffe://factory/robot/r7"]);
    assert_eq!(certificate.valid_dns_names().count(), 0);
    assert_eq!(answer.trust_json, "{}");
}

fn pem(text: &str) -> Vec<u8> {
    use rustls::pki_types::pem::PemObject;
    rustls::pki_types::CertificateDer::from_pem_slice(text.as_bytes()).expect("PEM").to_vec()
}

#[tokio::test]
async fn a_secret_that_was_used_lets_no_second_machine_in() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (line, first) = (secret(&identity, "r7", false).await.expect("a secret"), Machine::new());
    enrol(&identity, "r7", &line, &first).await.expect("enrolled");
    enrol(&identity, "r7", &line, &first).await.expect("the answer was lost on its way");
    let second = enrol(&identity, "r7", &line, &Machine::new()).await.expect_err("another machine");
    assert_eq!(code(&second), Some(Code::EnrolmentUsed));
    let other = enrol(&identity, "r8", &line, &Machine::new()).await.expect_err("another robot");
    assert_eq!(code(&other), Some(Code::EnrolmentUnknown));
}

#[tokio::test]
async fn a_machine_is_one_robot_and_its_key_lets_no_other_one_in_also_after_it_was_revoked() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (line, machine) = (secret(&identity, "r7", false).await.expect("a secret"), Machine::new());
    enrol(&identity, "r7", &line, &machine).await.expect("enrolled");
    let other = secret(&identity, "r8", false).await.expect("a secret");
    let refused = enrol(&identity, "r8", &other, &machine).await.expect_err("it is r7");
    assert_eq!(code(&refused), Some(Code::KeyDenied));
    let revoke = RevokeRobotRequest { robot_id: "r7".to_owned(), ..Default::default() };
    identity.revoke_robot(local(revoke)).await.expect("revoked");
    let refused = enrol(&identity, "r8", &other, &machine).await.expect_err("it was r7");
    assert_eq!(code(&refused), Some(Code::KeyDenied));
    enrol(&identity, "r8", &other, &Machine::new()).await.expect("the secret is as good as before");
}

#[tokio::test]
async fn whoever_may_not_enrol_or_renew_is_told_of_with_the_robot_that_it_named() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (line, machine, told) =
        (secret(&identity, "r7", false).await.expect("a secret"), Machine::new(), Heard::default());
    let told = Arc::new(told);
    let enrol = async |robot_id: &str, machine: &Machine| {
        let (robot_id, secret) = (robot_id.to_owned(), crate::world::shown(&line));
        let request = midshift_proto::identity::v1::EnrolRequest { robot_id, secret, request_pem: machine.request() };
        let mut request = asked_by(Caller::nobody(), request);
        request.extensions_mut().insert(DenialReporter::new(told.clone()));
        identity.enrol(request).await.is_ok()
    };
    assert!(!enrol("r8", &machine).await && enrol("r7", &machine).await && !enrol("r7", &Machine::new()).await);
    let own = Caller::robot(RobotId::parse("r7").expect("an id"));
    let request = RenewCertificateRequest { robot_id: "r7".to_owned(), request_pem: Machine::new().request() };
    let mut request = asked_by(own, request);
    request.extensions_mut().insert(DenialReporter::new(told.clone()));
    assert!(identity.renew_certificate(request).await.is_err());
    let robot = |id: &str| Some(id.to_owned());
    let expected =
        [(Code::EnrolmentUnknown, robot("r8")), (Code::EnrolmentUsed, robot("r7")), (Code::KeyDenied, robot("r7"))];
    assert_eq!(*told.0.lock().expect("not poisoned"), expected);
}

#[tokio::test]
async fn a_secret_is_worth_nothing_after_its_hour_or_after_a_newer_one() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let old = secret(&identity, "r7", false).await.expect("a secret");
    let new = secret(&identity, "r7", false).await.expect("a secret");
    let refused = enrol(&identity, "r7", &old, &Machine::new()).await.expect_err("an older one");
    assert_eq!(code(&refused), Some(Code::EnrolmentUnknown));
    world.pass_ms(limits::ENROLMENT_VALID.as_ms());
    let refused = enrol(&identity, "r7", &new, &Machine::new()).await.expect_err("too late");
    assert_eq!(code(&refused), Some(Code::EnrolmentExpired));
}

#[tokio::test]
async fn a_robot_that_is_replaced_goes_on_until_the_new_machine_is_there_and_then_its_key_is_denied() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let line = secret(&identity, "r7", false).await.expect("a secret");
    enrol(&identity, "r7", &line, &Machine::new()).await.expect("enrolled");
    let old = robot(&identity, "r7").await.key_sha256;
    let refused = secret(&identity, "r7", false).await.expect_err("it is enrolled");
    assert_eq!(code(&refused), Some(Code::RobotEnrolled));
    let last = world.audited().await.pop().expect("a row");
    assert_eq!((last.action.as_str(), last.outcome.as_str()), ("robot.enroll", "ROBOT_ENROLLED"));
    let line = secret(&identity, "r7", true).await.expect("a secret for another machine");
    assert!(!denies(&identity, &old));
    enrol(&identity, "r7", &line, &Machine::new()).await.expect("enrolled");
    assert!(denies(&identity, &old));
    assert!(!denies(&identity, &robot(&identity, "r7").await.key_sha256));
}

#[tokio::test]
async fn a_revoked_robot_is_denied_at_once_and_gets_no_new_certificate() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (line, machine) = (secret(&identity, "r7", false).await.expect("a secret"), Machine::new());
    enrol(&identity, "r7", &line, &machine).await.expect("enrolled");
    let key = robot(&identity, "r7").await.key_sha256;
    let because = |reason: String| local(RevokeRobotRequest { robot_id: "r7".to_owned(), reason });
    let revoke = || because("stolen".to_owned());
    let refused = identity.revoke_robot(because("x".repeat(257))).await.expect_err("too long");
    assert_eq!(code(&refused), Some(Code::InvalidRequest));
    identity.revoke_robot(revoke()).await.expect("revoked");
    assert!(denies(&identity, &key), "before the answer left");
    let row = world.audited().await.pop().expect("a row");
    assert_eq!((row.action.as_str(), row.reason.as_str()), ("robot.revoke", "stolen"));
    identity.revoke_robot(revoke()).await.expect("again: the same answer");
    let own = Caller::robot(RobotId::parse("r7").expect("an id"));
    let request = RenewCertificateRequest { robot_id: "r7".to_owned(), request_pem: machine.request() };
    let refused = identity.renew_certificate(asked_by(own, request)).await.expect_err("revoked");
    assert_eq!(code(&refused), Some(Code::KeyDenied));
}

#[tokio::test]
async fn a_robot_renews_its_own_certificate_for_its_own_key_and_no_other() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let machines = [Machine::new(), Machine::new()];
    for (robot_id, machine) in ["r7", "r8"].into_iter().zip(&machines) {
        let line = secret(&identity, robot_id, false).await.expect("a secret");
        enrol(&identity, robot_id, &line, machine).await.expect("enrolled");
    }
    let own = || Caller::robot(RobotId::parse("r7").expect("an id"));
    let renew = |robot_id: &str, machine: &Machine| {
        asked_by(own(), RenewCertificateRequest { robot_id: robot_id.to_owned(), request_pem: machine.request() })
    };
    identity.renew_certificate(renew("r7", &machines[0])).await.expect("renewed");
    let row = world.audited().await.pop().expect("a row");
    assert_eq!((row.actor.as_str(), row.action.as_str()), ("robot:r7", "robot.renew"));
    assert!(row.is_about("robot:r7") && row.with.contains_key("key"));
    let another = identity.renew_certificate(renew("r8", &machines[1])).await.expect_err("another robot");
    assert_eq!(code(&another), Some(Code::NotThisRobot));
    let key = identity.renew_certificate(renew("r7", &machines[1])).await.expect_err("another key");
    assert_eq!(code(&key), Some(Code::KeyDenied));
}

#[tokio::test]
async fn no_certificate_is_signed_by_a_wall_in_doubt_and_the_old_one_counts_on() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (machine, month_ms) = (Machine::new(), 30 * 24 * 3_600_000);
    let line = secret(&identity, "r7", false).await.expect("a secret");
    world.set_ms(month_ms);
    let refused = enrol(&identity, "r7", &line, &machine).await.expect_err("it would begin in a month");
    assert_eq!(code(&refused), Some(Code::ClockDoubted));
    world.set_ms(-month_ms);
    enrol(&identity, "r7", &line, &machine).await.expect("the secret was not used up");
    let own = Caller::robot(RobotId::parse("r7").expect("an id"));
    let request = || RenewCertificateRequest { robot_id: "r7".to_owned(), request_pem: machine.request() };
    world.set_ms(month_ms);
    let refused = identity.renew_certificate(asked_by(own.clone(), request())).await.expect_err("likewise");
    assert_eq!(code(&refused), Some(Code::ClockDoubted));
    world.clock.accept_wall();
    identity.renew_certificate(asked_by(own, request())).await.expect("a person says that it is right");
}

#[tokio::test]
async fn what_is_no_signing_request_is_refused_and_uses_no_secret_up() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let line = secret(&identity, "r7", false).await.expect("a secret");
    let mut broken = Machine::new().request();
    broken.replace_range(60..64, "AAAA");
    for request_pem in ["", "-----BEGIN CERTIFICATE REQUEST-----", &broken] {
        let request = midshift_proto::identity::v1::EnrolRequest {
            robot_id: "r7".to_owned(),
            secret: crate::world::shown(&line),
            request_pem: request_pem.to_owned(),
        };
        let refused = identity.enrol(local(request)).await.expect_err("no request");
        assert_eq!(code(&refused), Some(Code::InvalidRequest));
    }
    enrol(&identity, "r7", &line, &Machine::new()).await.expect("the secret is as good as before");
}
