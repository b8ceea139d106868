//! Ports with login: who a certificate or a token makes of a peer, and what that peer may ask for.

use crate::proofs::{CertificateAuthority, Identity};
use crate::world::{Client, Whole, World, whole, within};
use http::Request;
use midshift_core::identity::{Actor, Digest, Directory, DirectoryToken, Secret, TokenId};
use midshift_core::ids::SiteId;
use midshift_core::reason::Code;
use midshift_core::time::{Clock, LinkDuration, Utc};
use midshift_core::wall_clock::WallClock;
use midshift_edge::tls::Clients;
use midshift_edge::{Config, Denial, Denials, SitePrincipals, robot_of};
use sha2::Digest as _;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tokio::sync::{mpsc, watch};

const LIST: &str = "/midshift.task.v1.TaskService/ListTasks";
const SUBMIT: &str = "/midshift.task.v1.TaskService/SubmitTask";
const SESSION: &str = "/midshift.link.v1.LinkService/Session";
const ENGAGE: &str = "/midshift.stop.v1.StopService/Engage";
const HEALTH: &str = "/grpc.health.v1.Health/Check";

pub struct Port {
    us: Arc<AtomicU64>,
    /// How far the wall stepped ahead.
    stepped_ms: Arc<AtomicU64>,
    pub world: World,
    pub authority: CertificateAuthority,
    known: Arc<SitePrincipals>,
    denials: mpsc::Receiver<Denial>,
    _tls: watch::Sender<Arc<rustls::ServerConfig>>,
}

fn site() -> SiteId {
    SiteId::parse("factory").expect("a site")
}

/// What its ports know is the time, in unix ms, at the beginning of each test.
const BEGIN: i64 = 1_000_000;

impl Port {
    pub async fn open() -> Self {
        Self::with(Config::default()).await
    }
    pub async fn with(config: Config) -> Self {
        let (authority, us, stepped_ms) =
            (CertificateAuthority::new(), Arc::<AtomicU64>::default(), Arc::<AtomicU64>::default());
        let (source, beside, ahead) = (us.clone(), us.clone(), stepped_ms.clone());
        let wall =
            move || Utc(BEGIN).plus_ms(beside.load(Ordering::Relaxed) / 1000).plus_ms(ahead.load(Ordering::Relaxed));
        let clock: Arc<dyn Clock> = Arc::new(WallClock::new(move || source.load(Ordering::Relaxed), wall, |_| {}));
        let known = Arc::new(SitePrincipals::new(site(), clock.clone()));
        let (tls, newest) = watch::channel(authority.server_by(Clients::Asked(vec![authority.root()]), &clock));
        let (tell, denials) = Denials::new("business");
        let world = World::telling(config, known.clone(), Some(newest), Some(tell)).await;
        Self { us, stepped_ms, world, authority, known, denials, _tls: tls }
    }
    pub fn robot(&self, name: &str) -> Identity {
        self.authority.issue_uri(&format!("spiffe://factory/robot/{name}"))
    }
    pub async fn client(&self, shown: Option<&Identity>) -> Client {
        Client::over(self.authority.connect(&self.world, shown).await.expect("a handshake")).await
    }
    /// Makes `secret` a token with these rights, good until that moment.
    pub fn knows(&self, secret: &Secret, grants: &[&str], expires_unix_ms: i64) {
        let grants = grants.iter().map(|grant| (*grant).to_owned().into()).collect();
        let digest = Digest(sha2::Sha256::digest(secret.bytes()).into());
        let token = DirectoryToken { name: "anna".into(), person: None, digest, grants, expires_unix_ms };
        self.known.publish(Directory { tokens: [(secret.id().clone(), token)].into(), denied: BTreeMap::new() });
    }
}

pub fn secret() -> Secret {
    Secret::new(TokenId::new("t1").expect("an id"), [7; 32])
}

async fn asked(client: &mut Client, path: &str, authorization: Option<&str>) -> Option<Whole> {
    let mut request = Request::post(format!("http://edge{path}")).header("content-type", "application/grpc");
    if let Some(text) = authorization {
        request = request.header("authorization", text);
    }
    let response = within(client.send(request.body(()).expect("a request"))).await?;
    whole(within(response).await.ok()?).await
}

pub async fn code(client: &mut Client, path: &str, authorization: Option<&str>) -> Result<String, Code> {
    let answer = asked(client, path, authorization).await.expect("an answer");
    match answer.answer().code {
        None => Ok(answer.header("principal").to_owned()),
        Some(code) => Err(code),
    }
}

#[tokio::test]
async fn a_robot_is_who_its_certificate_says_and_may_call_what_is_for_robots_alone() {
    let port = Port::open().await;
    let mut robot = port.client(Some(&port.robot("r7"))).await;
    assert_eq!(code(&mut robot, SESSION, None).await, Ok("robot:r7".to_owned()));
    assert_eq!(code(&mut robot, LIST, None).await, Err(Code::NotPermitted));
    assert_eq!(code(&mut robot, "/midshift.task.v1.TaskService/NoSuch", None).await, Err(Code::NotPermitted));
}

#[tokio::test]
async fn a_certificate_that_names_no_robot_of_this_site_is_not_let_in() {
    let port = Port::open().await;
    let refused = [
        port.authority.issue_uri("spiffe://elsewhere/robot/r7"),
        port.authority.issue_uri("spiffe://factory/server/r7"),
        port.authority.issue_uri("spiffe://factory/robot/"),
        port.authority.issue("r7"),
    ];
    for leaf in &refused {
        if let Ok(stream) = port.authority.connect(&port.world, Some(leaf)).await {
            let refused = code(&mut Client::over(stream).await, HEALTH, None).await;
            assert_eq!(refused, Err(Code::KeyDenied), "it hears why");
        }
    }
    port.world.closed_times("denied", refused.len() as u64).await;
}

#[tokio::test]
async fn a_revoked_robot_is_cut_and_does_not_come_back_while_another_works_on() {
    let port = Port::open().await;
    let (revoked, other) = (port.robot("r7"), port.robot("r8"));
    let (mut goes, mut stays) = (port.client(Some(&revoked)).await, port.client(Some(&other)).await);
    assert!(code(&mut goes, SESSION, None).await.is_ok() && code(&mut stays, SESSION, None).await.is_ok());
    let (_, key) = robot_of(&revoked.leaf, &site()).expect("a robot");
    port.known.publish(Directory { tokens: BTreeMap::new(), denied: [(key, i64::MAX)].into() });
    port.world.closed_for("denied").await;
    assert!(asked(&mut goes, SESSION, None).await.is_none());
    let stream = port.authority.connect(&port.world, Some(&revoked)).await.expect("a handshake");
    let mut again = Client::over(stream).await;
    let answer = asked(&mut again, SESSION, None).await.expect("it hears why");
    assert_eq!(answer.answer().code, Some(Code::KeyDenied));
    assert!(answer.status.message().contains("r7 was revoked"), "{}", answer.status.message());
    port.world.closed_times("denied", 2).await;
    assert!(asked(&mut again, SESSION, None).await.is_none(), "and is cut a moment later");
    assert_eq!(code(&mut stays, SESSION, None).await, Ok("robot:r8".to_owned()));
}

#[tokio::test]
async fn the_holder_of_a_token_may_do_what_its_roles_permit_and_nothing_else() {
    let port = Port::open().await;
    let secret = secret();
    port.knows(&secret, &["viewer"], i64::MAX);
    let bearer = format!("Bearer {}", secret.reveal(Secret::TOKEN));
    let mut client = port.client(None).await;
    assert_eq!(code(&mut client, LIST, Some(&bearer)).await, Ok("anna".to_owned()));
    assert_eq!(code(&mut client, ENGAGE, Some(&bearer)).await, Ok("anna".to_owned()), "anyone signed in may stop");
    assert_eq!(code(&mut client, SUBMIT, Some(&bearer)).await, Err(Code::NotPermitted));
    assert_eq!(code(&mut client, SESSION, Some(&bearer)).await, Err(Code::NotPermitted));
    assert_eq!(code(&mut client, LIST, None).await, Err(Code::SignInNeeded), "each request shows it");
    assert!(code(&mut client, HEALTH, None).await.is_ok());
}

#[tokio::test]
async fn what_is_no_token_of_the_site_is_worth_nothing() {
    let port = Port::open().await;
    let secret = secret();
    let good = secret.reveal(Secret::TOKEN);
    port.knows(&secret, &["viewer"], i64::MAX);
    let mut client = port.client(None).await;
    let wrong = Secret::new(TokenId::new("t1").expect("an id"), [8; 32]).reveal(Secret::TOKEN);
    for shown in [format!("Bearer {wrong}"), good.clone(), format!("Basic {good}"), "Bearer".to_owned()] {
        assert_eq!(code(&mut client, LIST, Some(&shown)).await, Err(Code::TokenUnknown), "{shown}");
    }
    port.known.publish(Directory::default());
    assert_eq!(code(&mut client, LIST, Some(&format!("bearer {good}"))).await, Err(Code::TokenUnknown), "revoked");
}

#[tokio::test]
async fn an_expired_token_still_engages_a_stop_and_resets_none() {
    let port = Port::open().await;
    let secret = secret();
    port.knows(&secret, &["stop-resetter"], 999_999);
    let bearer = format!("Bearer {}", secret.reveal(Secret::TOKEN));
    let mut client = port.client(None).await;
    assert!(code(&mut client, ENGAGE, Some(&bearer)).await.is_ok());
    let reset = code(&mut client, "/midshift.stop.v1.StopService/Reset", Some(&bearer)).await;
    assert_eq!(reset, Err(Code::TokenExpired));
}

/// A stream of whoever shows this; its head was let in.
async fn held(client: &mut Client, path: &str, bearer: &str) {
    let request = Request::post(format!("http://edge{path}")).header("content-type", "application/grpc");
    let request = request.header("hold", "yes").header("authorization", bearer).body(()).expect("a request");
    let response = within(within(client.send(request)).await.expect("sent")).await.expect("a head");
    assert!(!response.headers().contains_key("grpc-status"), "{response:?}");
}

#[tokio::test]
async fn the_streams_of_a_token_that_was_taken_back_end_with_their_connection_and_those_of_another_go_on() {
    let port = Port::open().await;
    let [gone, kept] = ["t1", "t2"].map(|id| Secret::new(TokenId::new(id).expect("an id"), [7; 32]));
    let known = |secrets: &[&Secret]| {
        let token = |secret: &&Secret| {
            let digest = Digest(sha2::Sha256::digest(secret.bytes()).into());
            let grants = ["viewer".to_owned().into()].into();
            let token = DirectoryToken { name: "anna".into(), person: None, digest, grants, expires_unix_ms: i64::MAX };
            (secret.id().clone(), token)
        };
        port.known.publish(Directory { tokens: secrets.iter().map(token).collect(), denied: BTreeMap::new() });
    };
    known(&[&gone, &kept]);
    let [first, second] = [&gone, &kept].map(|secret| format!("Bearer {}", secret.reveal(Secret::TOKEN)));
    let (mut goes, mut stays) = (port.client(None).await, port.client(None).await);
    held(&mut goes, LIST, &first).await;
    held(&mut stays, LIST, &second).await;
    known(&[&kept]);
    port.world.closed_for("denied").await;
    assert!(asked(&mut goes, LIST, Some(&first)).await.is_none());
    assert!(code(&mut stays, LIST, Some(&second)).await.is_ok());
    assert_eq!(port.world.open_connections(), 1.0);
}

#[tokio::test]
async fn the_streams_of_a_token_end_when_its_time_is_over_and_it_still_stops() {
    let config = Config { asked_again: LinkDuration(20), ..Config::default() };
    let port = Port::with(config).await;
    let secret = secret();
    port.knows(&secret, &["viewer"], BEGIN + 1_000);
    let bearer = format!("Bearer {}", secret.reveal(Secret::TOKEN));
    let mut client = port.client(None).await;
    held(&mut client, LIST, &bearer).await;
    // Nothing is published: time alone ends it.
    port.us.store(1_000_000, Ordering::Relaxed);
    port.world.closed_for("denied").await;
    let mut again = port.client(None).await;
    assert!(code(&mut again, ENGAGE, Some(&bearer)).await.is_ok());
    assert_eq!(code(&mut again, LIST, Some(&bearer)).await, Err(Code::TokenExpired));
    assert!(code(&mut again, ENGAGE, Some(&bearer)).await.is_ok(), "its connection is left alone");
}

#[tokio::test]
async fn a_stream_that_was_begun_with_an_expired_token_ends_when_the_token_is_taken_back() {
    let port = Port::open().await;
    let secret = secret();
    port.knows(&secret, &["stop-only"], 999_999);
    let bearer = format!("Bearer {}", secret.reveal(Secret::TOKEN));
    let mut client = port.client(None).await;
    held(&mut client, ENGAGE, &bearer).await;
    port.known.publish(Directory::default());
    port.world.closed_for("denied").await;
    assert!(asked(&mut client, ENGAGE, Some(&bearer)).await.is_none());
}

#[tokio::test]
async fn a_certificate_whose_time_is_over_does_not_get_through_the_handshake() {
    let port = Port::open().await;
    let late = port.authority.issue_uri_until("spiffe://factory/robot/r7", (2020, 1, 1));
    if let Ok(stream) = port.authority.connect(&port.world, Some(&late)).await {
        assert!(asked(&mut Client::over(stream).await, SESSION, None).await.is_none());
    }
    port.world.closed_for("handshake_failed").await;
    let good = port.authority.issue_uri_until("spiffe://factory/robot/r7", (4000, 1, 1));
    let mut robot = port.client(Some(&good)).await;
    assert!(code(&mut robot, SESSION, None).await.is_ok());
}

#[tokio::test]
async fn a_wall_that_jumped_ends_no_certificate_of_a_robot_and_a_token_at_its_next_request() {
    const YEAR_MS: u64 = 365 * 24 * 3_600_000;
    let port = Port::open().await;
    let secret = secret();
    port.knows(&secret, &["viewer"], BEGIN + 1_000_000);
    let bearer = format!("Bearer {}", secret.reveal(Secret::TOKEN));
    // The handshake's own clock is the machine's: this certificate is over, and was not before a jump of fifty years.
    let late = port.authority.issue_uri_until("spiffe://factory/robot/r7", (2020, 1, 1));
    port.stepped_ms.store(50 * YEAR_MS, Ordering::Relaxed);
    let mut robot = port.client(Some(&late)).await;
    assert_eq!(code(&mut robot, SESSION, None).await, Ok("robot:r7".to_owned()));
    let mut client = port.client(None).await;
    assert_eq!(code(&mut client, LIST, Some(&bearer)).await, Err(Code::TokenExpired));
    // Whoever was taken out stays out.
    let (_, key) = robot_of(&late.leaf, &site()).expect("a robot");
    port.known.publish(Directory { tokens: BTreeMap::new(), denied: [(key, i64::MAX)].into() });
    port.world.closed_for("denied").await;
}

#[tokio::test]
async fn what_a_service_denies_behind_the_port_is_told_of_as_what_the_port_denies() {
    let mut port = Port::open().await;
    let mut robot = port.client(Some(&port.robot("r7"))).await;
    let request = Request::post(format!("http://edge{SESSION}")).header("content-type", "application/grpc");
    let request = request.header("deny", "yes").body(()).expect("a request");
    within(within(robot.send(request)).await.expect("sent")).await.expect("an answer");
    let told = within(port.denials.recv()).await.expect("told");
    let expected = Denial { robot_id: Some("r8".to_owned()), ..said("robot:r7", SESSION, Code::NotThisRobot) };
    assert_eq!(told, expected);
    let name = "midshift_edge_requests_denied_inside_total";
    assert_eq!(port.world.counter(name, ("reason", "NOT_THIS_ROBOT")), 1);
}

fn said(actor: &str, path: &str, code: Code) -> Denial {
    let network = std::net::Ipv4Addr::LOCALHOST.into();
    let actor = Actor::new(actor, (actor == "anna").then(|| TokenId::new("t1").expect("an id")));
    Denial { actor, network, path: path.to_owned(), robot_id: None, code, left_out: 0 }
}

#[tokio::test]
async fn whoever_may_not_or_shows_something_worthless_is_told_of_and_who_showed_nothing_is_not() {
    let mut port = Port::open().await;
    let secret = secret();
    port.knows(&secret, &["viewer"], i64::MAX);
    let token = format!("Bearer {}", secret.reveal(Secret::TOKEN));
    let mut client = port.client(None).await;
    assert_eq!(code(&mut client, LIST, Some(&token)).await, Ok("anna".to_owned()));
    assert_eq!(code(&mut client, SUBMIT, None).await, Err(Code::SignInNeeded));
    assert_eq!(code(&mut client, SUBMIT, Some(&token)).await, Err(Code::NotPermitted));
    let other = Secret::new(TokenId::new("t2").expect("an id"), [7; 32]).reveal(Secret::TOKEN);
    assert_eq!(code(&mut client, LIST, Some(&format!("Bearer {other}"))).await, Err(Code::TokenUnknown));
    port.knows(&secret, &["viewer"], 1);
    assert_eq!(code(&mut client, LIST, Some(&token)).await, Err(Code::TokenExpired));
    let mut robot = port.client(Some(&port.robot("r7"))).await;
    assert_eq!(code(&mut robot, LIST, None).await, Err(Code::NotPermitted));
    let mut told = Vec::new();
    while let Ok(denial) = port.denials.try_recv() {
        told.push(denial);
    }
    let expected = [
        said("anna", SUBMIT, Code::NotPermitted),
        said("nobody", LIST, Code::TokenUnknown),
        said("anna", LIST, Code::TokenExpired),
        said("robot:r7", LIST, Code::NotPermitted),
    ];
    assert_eq!(told, expected);
}

#[tokio::test]
async fn a_flood_of_guesses_is_told_of_a_few_times_and_counted() {
    let mut port = Port::open().await;
    let guess = Secret::new(TokenId::new("t9").expect("an id"), [9; 32]).reveal(Secret::TOKEN);
    let guess = format!("Bearer {guess}");
    let mut client = port.client(None).await;
    for _ in 0..200 {
        assert_eq!(code(&mut client, LIST, Some(&guess)).await, Err(Code::TokenUnknown));
    }
    let mut told = 0;
    while port.denials.try_recv().is_ok() {
        told += 1;
    }
    // A token comes back in a minute, which a slow machine may take.
    assert!((16..100).contains(&told), "{told}");
    let left_out = port.world.counter("midshift_edge_denials_left_out_total", ("port", "business"));
    assert_eq!(told + left_out, 200);
    // Somebody else is told of all the same, and what was left out with it.
    let mut robot = port.client(Some(&port.robot("r7"))).await;
    assert_eq!(code(&mut robot, LIST, None).await, Err(Code::NotPermitted));
    let next = port.denials.try_recv().expect("told");
    assert_eq!((&**next.actor.name(), next.left_out), ("robot:r7", left_out));
}
