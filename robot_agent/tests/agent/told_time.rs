//! The time that a server tells: over TLS, where it has proven itself, it raises the robot's time floor; in plain text
//! it is a number.

use crate::release::{Releases, SIGNED};
use crate::rig::Rig;
use crate::session::{Desk, Seen, clock, config};
use crate::test_body::TestBody;
use crate::trust_anchors::Metadata;
use midshift_agent::bulk::Bulk;
use midshift_agent::dial::TcpDial;
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{Lines, run};
use midshift_agent::store::{Op, Store};
use midshift_agent::tls::{self, Tls};
use midshift_bundle::trust::{Reading, Trusted};
use midshift_core::time::Utc;
use midshift_proto::link::v1::link_service_server::LinkServiceServer;
use midshift_proto::session::{ClockSample, Downlink, Echo, ToRobot};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use rustls::ServerConfig;
use rustls::crypto::aws_lc_rs;
use rustls::pki_types::PrivateKeyDer;
use std::sync::Arc;
use tokio::io::{AsyncRead, AsyncWrite, DuplexStream};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_rustls::TlsAcceptor;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;

const HOUR_MS: u64 = 3_600_000;

/// What a robot believes that has heard of a repository.
async fn trusted() -> Arc<Trusted> {
    let releases = Releases::new();
    let (root, clock) = (releases.config().root, Reading { utc: SIGNED, is_synced: true });
    let heard = Trusted::new(&root).expect("a root").refresh(Arc::new(Metadata(releases)), clock).await;
    Arc::new(heard.expect("is believed").trusted)
}

/// Certificate and key of a server, and the root it has them of.
fn proof() -> (Arc<ServerConfig>, String) {
    let (root_key, key) = (KeyPair::generate().expect("a key"), KeyPair::generate().expect("a key"));
    let mut root = CertificateParams::default();
    root.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let root_pem = root.self_signed(&root_key).expect("a root").pem();
    let leaf = CertificateParams::new(vec!["midshift".to_owned()]).expect("a name");
    let leaf = leaf.signed_by(&key, &Issuer::new(root, root_key)).expect("a certificate");
    let mut config = ServerConfig::builder_with_provider(Arc::new(aws_lc_rs::default_provider()))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("a version")
        .with_no_client_auth()
        .with_single_cert(vec![leaf.der().clone()], PrivateKeyDer::Pkcs8(key.serialize_der().into()))
        .expect("they fit");
    config.alpn_protocols = vec![b"h2".to_vec()];
    (Arc::new(config), root_pem)
}

/// One connection, handed to the server as it comes out of TLS, or as it is.
async fn carry(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    to: mpsc::Sender<Result<DuplexStream, std::io::Error>>,
) {
    let (near, mut far) = tokio::io::duplex(64 * 1024);
    if to.send(Ok(near)).await.is_ok() {
        let _ = tokio::io::copy_bidirectional(&mut stream, &mut far).await;
    }
}

/// Serves the link on a port of its own, over TLS if it has a proof; sessions are the test's.
async fn serve(proof: Option<Arc<ServerConfig>>) -> (String, mpsc::Receiver<Seen>) {
    let (seen, sessions) = mpsc::channel(4);
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address").to_string();
    let (to, incoming) = mpsc::channel(4);
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            let (proof, to) = (proof.clone(), to.clone());
            tokio::spawn(async move {
                match proof {
                    None => carry(stream, to).await,
                    Some(config) => match TlsAcceptor::from(config).accept(stream).await {
                        Ok(stream) => carry(stream, to).await,
                        Err(error) => panic!("no handshake: {error}"),
                    },
                }
            });
        }
    });
    let server = Server::builder().add_service(LinkServiceServer::new(Desk(seen)));
    tokio::spawn(server.serve_with_incoming(ReceiverStream::new(incoming)));
    (address, sessions)
}

/// The floor of a robot whose server told it this time, once it has written that down.
async fn floor_after(link: TcpDial, mut sessions: mpsc::Receiver<Seen>, told: Utc) -> Utc {
    let mut store = MemoryStore::new();
    store.load("ring-1").await.expect("loads");
    store.commit(&[Op::Trusted(trusted().await)]).await.expect("commits");
    let (config, clock) = (config(None), clock(Utc(1_600_000_000_000)));
    let (link, shutdown) = (Arc::new(link), CancellationToken::new());
    let lines = Lines { bulk: Bulk::new(link.clone()), link };
    let agent =
        tokio::spawn(run(config, Box::new(TestBody::at("A")), Box::new(store.clone()), clock, lines, shutdown.clone()));
    let mut session = sessions.recv().await.expect("the robot dials");
    session.hello().await;
    session.welcome(5).await;
    session.next().await.expect("a heartbeat");
    let clock = ClockSample { t3_us: told.0 * 1000, ..ClockSample::default() };
    let echo = Some(Echo { hb: 1, clock, is_clock_doubted: false });
    session.send(ToRobot::Downlink(Box::new(Downlink { echo, ..Downlink::default() }))).await;
    // What it was told is decided on before its next heartbeat leaves.
    session.next().await.expect("a heartbeat");
    shutdown.cancel();
    agent.await.expect("no panic").expect("no error");
    store.memory().expect("loaded").ledger.trusted.expect("believes").time_floor()
}

#[tokio::test]
async fn the_time_floor_follows_a_server_that_has_proven_itself_by_its_certificate() {
    let told = SIGNED.plus_ms(30 * HOUR_MS);
    let (config, root_pem) = proof();
    let (address, sessions) = serve(Some(config)).await;
    let tls = Tls::fixed(tls::config(&root_pem, None).expect("a root"));
    let link = TcpDial::new(&format!("https://{address}"), None).expect("an address").with_tls(tls);
    assert_eq!(floor_after(link, sessions, told).await, told);
}

#[tokio::test]
async fn in_plain_text_anybody_could_tell_a_time_and_the_floor_stays() {
    let (address, sessions) = serve(None).await;
    let link = TcpDial::new(&format!("http://{address}"), None).expect("an address");
    assert_eq!(floor_after(link, sessions, SIGNED.plus_ms(30 * HOUR_MS)).await, SIGNED);
}

/// Heartbeats that were echoed at these times, hours after the newest signature, and where that leaves the floor.
#[test]
fn the_floor_rises_within_two_days_of_the_newest_signature_and_never_falls() {
    let (mut rig, releases): (Rig, Releases) = crate::updates::connected();
    let floor_after = |rig: &mut Rig, hours: u64, is_clock_doubted: bool| {
        let clock = ClockSample { t3_us: SIGNED.plus_ms(hours * HOUR_MS).0 * 1000, ..ClockSample::default() };
        rig.down(Downlink { echo: Some(Echo { hb: 1, clock, is_clock_doubted }), ..Downlink::default() });
        // It is written with what comes next.
        rig.pass(2_000);
        rig.store.memory().expect("loaded").ledger.trusted.map(|t| (t.time_floor().0 - SIGNED.0) / 3_600_000)
    };
    let floor_at = |rig: &mut Rig, hours: u64| floor_after(rig, hours, false);
    assert_eq!(floor_at(&mut rig, 9), None, "nothing signed has said any time yet");
    let bundle = releases.release("1.0.0");
    crate::updates::stage(&mut rig, &releases, &bundle, 1);
    assert_eq!(floor_at(&mut rig, 9), Some(9));
    assert_eq!(floor_at(&mut rig, 5), Some(9), "a server whose clock is behind");
    assert_eq!(floor_after(&mut rig, 24 * 30, true), Some(9), "a server that doubts its own clock");
    assert_eq!(floor_at(&mut rig, 24 * 365), Some(48), "a server whose clock is far ahead");
    assert_eq!(floor_at(&mut rig, 24 * 3650), Some(48));
    // It is on the ledger: a restart forgets nothing.
    let mut rig = rig.restart();
    rig.connect();
    assert_eq!(floor_at(&mut rig, 1), Some(48));
}
