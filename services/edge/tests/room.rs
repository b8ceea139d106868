//! A process with few descriptors and a thousand peers that begin and say nothing: a robot that comes then is served, and files can be read.
//!
//! In a program of its own, since the limit is of the whole process; the peers are a second one.

use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::time::{Clock, LinkDuration, ScaledClock, Utc};
use midshift_edge::tls::{Clients, server_config};
use midshift_edge::{Config, Edge, SitePrincipals, connections_max};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair, SanType};
use rustix::process::{Resource, Rlimit, setrlimit};
use rustls::crypto::aws_lc_rs;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use std::convert::Infallible;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::net::SocketAddr;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket};
use tokio::sync::watch;
use tokio_rustls::TlsConnector;
use tokio_util::sync::CancellationToken;
use tonic::body::Body;

/// Tells the second program whom to dial; it is no test without.
const DIAL: &str = "MIDSHIFT_TEST_ROOM_DIAL";
const PEERS: usize = 1_000;
const DESCRIPTORS: u64 = 1_024;
/// What they may cost the process, bytes: 64 KiB for each that is let in, a quarter of what there is room for, and as much again for all.
const MEMORY: u64 = 2 * (DESCRIPTORS - limits::DESCRIPTORS_KEPT as u64) / 4 * 64 * 1024;
const ASKED: &[u8] = b"GET /ready HTTP/1.1\r\nhost: edge\r\nconnection: close\r\n\r\n";

#[tokio::test]
async fn the_peers_of_the_other_test() {
    let Ok(address) = std::env::var(DIAL) else { return };
    let address: SocketAddr = address.parse().expect("an address");
    let mut peers = Vec::new();
    for n in 0..PEERS {
        let socket = TcpSocket::new_v4().expect("a socket");
        socket.bind(SocketAddr::from(([127, 0, 0, 11 + (n % 4) as u8], 0))).expect("an address");
        // The first byte of a handshake; one that is closed at once stays closed.
        let mut peer = socket.connect(address).await.expect("a connection");
        let _ = peer.write_all(&[22]).await;
        peers.push(peer);
    }
    eprintln!("all are there");
    // Until whoever started this is gone or has enough.
    let waited = tokio::task::spawn_blocking(|| std::io::stdin().read_to_end(&mut Vec::new()));
    waited.await.expect("no panic").expect("an end");
}

fn signed(names: Vec<SanType>, by: &CertifiedIssuer<'_, KeyPair>) -> (CertificateDer<'static>, PrivateKeyDer<'static>) {
    let (mut params, key) = (CertificateParams::default(), KeyPair::generate().expect("a key"));
    params.subject_alt_names = names;
    let leaf = params.signed_by(&key, by).expect("a certificate").der().clone();
    (leaf, PrivateKeyDer::try_from(key.serialize_der()).expect("a key"))
}

/// Memory of this process that is there, bytes.
fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("what the system says of this process");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("its memory");
    line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number") * 1024
}

#[tokio::test]
async fn a_robot_is_served_while_a_thousand_silent_peers_want_every_descriptor() {
    if std::env::var(DIAL).is_ok() {
        return;
    }
    let limit = Rlimit { current: Some(256), maximum: Some(DESCRIPTORS) };
    setrlimit(Resource::Nofile, limit).expect("a lower limit");
    let room = connections_max().expect("enough for a port");
    assert_eq!(room, DESCRIPTORS as usize - limits::DESCRIPTORS_KEPT, "the soft limit was raised to the hard one");
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let authority = CertifiedIssuer::self_signed(params, KeyPair::generate().expect("a key")).expect("a root");
    let (leaf, key) = signed(vec![SanType::DnsName("edge".try_into().expect("a name"))], &authority);
    let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(|| 0, Utc(1_000_000), 1000));
    let server = server_config(vec![leaf], key, Clients::Asked(vec![authority.der().clone()]), &clock).expect("TLS");
    let config = Config {
        connections_max: room,
        connections_per_network_max: room / 4,
        // They stay for the whole test.
        tls_handshake: LinkDuration::from_secs(600),
        ..Config::default()
    };
    let known = Arc::new(SitePrincipals::new(SiteId::parse("factory").expect("a site"), clock));
    let services =
        tower::service_fn(async |_: http::Request<Body>| Ok::<_, Infallible>(http::Response::new(Body::empty())));
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.expect("a port");
    let (address, stop) = (listener.local_addr().expect("its address"), CancellationToken::new());
    let (_tls, newest) = watch::channel(server);
    let serving = tokio::spawn(Edge::new(config, known, services).with_tls(newest).serve(listener, stop.clone()));

    let before = resident();
    let mut peers = Command::new(std::env::current_exe().expect("this program"));
    peers.args(["--exact", "the_peers_of_the_other_test", "--nocapture"]).env(DIAL, address.to_string());
    // Their own descriptors are not what this is about.
    let mut peers = peers.stdin(Stdio::piped()).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().expect("peers");
    let said = BufReader::new(peers.stderr.take().expect("what they say"));
    let there = tokio::task::spawn_blocking(move || said.lines().any(|line| line.is_ok_and(|l| l == "all are there")));
    assert!(there.await.expect("no panic"), "the peers have come");
    let grown = resident().saturating_sub(before);
    assert!(grown < MEMORY, "{grown} bytes for {PEERS} peers that say nothing");

    let (leaf, key) = signed(vec![SanType::URI("spiffe://factory/robot/r7".try_into().expect("a name"))], &authority);
    let mut roots = RootCertStore::empty();
    roots.add(authority.der().clone()).expect("a root");
    let client = ClientConfig::builder_with_provider(Arc::new(aws_lc_rs::default_provider()))
        .with_safe_default_protocol_versions()
        .expect("TLS")
        .with_root_certificates(roots)
        .with_client_auth_cert(vec![leaf], key)
        .expect("a key");
    let asked = async {
        let socket = TcpSocket::new_v4()?;
        socket.bind(SocketAddr::from(([127, 0, 0, 99], 0)))?;
        let name = ServerName::try_from("edge").expect("a name");
        let mut robot = TlsConnector::from(Arc::new(client)).connect(name, socket.connect(address).await?).await?;
        robot.write_all(ASKED).await?;
        let mut said = String::new();
        // Closed without a word of TLS is closed all the same.
        let _ = robot.read_to_string(&mut said).await;
        Ok::<_, std::io::Error>(said)
    };
    let said = tokio::time::timeout(Duration::from_secs(60), asked).await.expect("an answer").expect("a connection");
    assert!(said.starts_with("HTTP/1.1 200"), "{said}");
    // Files that a service opens while the port is as full as it gets.
    let files: Vec<_> = (0..128).map(|_| File::open("/dev/null")).collect();
    assert!(files.iter().all(Result::is_ok), "files can be opened");
    drop((files, peers.stdin.take()));
    peers.wait().expect("they end");
    stop.cancel();
    serving.await.expect("serving did not panic");
}
