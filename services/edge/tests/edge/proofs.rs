//! TLS: what a port proves itself with, what it asks of its peers, and what services hear of it.

use crate::frames::{PREFACE, dial, until_closed};
use crate::world::{Client, HERE, SOON, World, within};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_edge::tls::{Clients, server_config};
use midshift_edge::{Anybody, Config, ConnectionId, Edge, Incoming, Peer};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair, SanType};
use rustls::crypto::aws_lc_rs;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::version::TLS13;
use rustls::{ClientConfig, HandshakeKind, RootCertStore, ServerConfig};
use std::sync::Arc;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;

/// Who signs certificates of servers and of robots alike.
pub struct CertificateAuthority(CertifiedIssuer<'static, KeyPair>);

pub struct Identity {
    pub leaf: CertificateDer<'static>,
    key: PrivateKeyDer<'static>,
}

impl CertificateAuthority {
    pub fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("parameters");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        Self(CertifiedIssuer::self_signed(params, KeyPair::generate().expect("a key")).expect("a root"))
    }

    pub fn root(&self) -> CertificateDer<'static> {
        self.0.der().clone()
    }

    pub fn issue(&self, name: &str) -> Identity {
        self.sign(CertificateParams::new(vec![name.to_owned()]).expect("parameters"))
    }

    /// For who is named by this and nothing else.
    pub fn issue_uri(&self, uri: &str) -> Identity {
        let mut params = CertificateParams::default();
        params.subject_alt_names = vec![SanType::URI(uri.try_into().expect("plain text"))];
        self.sign(params)
    }

    /// The same, good until that day.
    pub fn issue_uri_until(&self, uri: &str, (year, month, day): (i32, u8, u8)) -> Identity {
        let mut params = CertificateParams::default();
        params.subject_alt_names = vec![SanType::URI(uri.try_into().expect("plain text"))];
        params.not_after = rcgen::date_time_ymd(year, month, day);
        self.sign(params)
    }

    fn sign(&self, params: CertificateParams) -> Identity {
        let key = KeyPair::generate().expect("a key");
        let leaf = params.signed_by(&key, &self.0).expect("a certificate").der().clone();
        Identity { leaf, key: PrivateKeyDer::try_from(key.serialize_der()).expect("a key") }
    }

    pub fn server(&self, clients: Clients) -> Arc<ServerConfig> {
        self.server_by(clients, &(Arc::new(ScaledClock::new(|| 0, Utc(0), 1000)) as Arc<dyn Clock>))
    }

    pub fn server_by(&self, clients: Clients, clock: &Arc<dyn Clock>) -> Arc<ServerConfig> {
        let Identity { leaf, key } = self.issue("edge");
        server_config(vec![leaf], key, clients, clock).expect("a server's TLS")
    }

    /// A client that believes this authority and shows `identity`.
    fn client(&self, identity: Option<&Identity>) -> Arc<ClientConfig> {
        let mut roots = RootCertStore::empty();
        roots.add(self.root()).expect("a root");
        let builder = ClientConfig::builder_with_provider(Arc::new(aws_lc_rs::default_provider()))
            .with_protocol_versions(&[&TLS13])
            .expect("TLS 1.3")
            .with_root_certificates(roots);
        let mut config = match identity {
            Some(shown) => {
                builder.with_client_auth_cert(vec![shown.leaf.clone()], shown.key.clone_key()).expect("a key")
            }
            None => builder.with_no_client_auth(),
        };
        config.alpn_protocols = vec![b"h2".to_vec()];
        Arc::new(config)
    }

    pub async fn connect(&self, world: &World, identity: Option<&Identity>) -> std::io::Result<TlsStream<TcpStream>> {
        shake_hands(world, self.client(identity)).await
    }
}

async fn shake_hands(world: &World, client: Arc<ClientConfig>) -> std::io::Result<TlsStream<TcpStream>> {
    let name = ServerName::try_from("edge").expect("a name");
    within(TlsConnector::from(client).connect(name, dial(world.address, HERE).await)).await
}

async fn proven(config: Config, tls: watch::Receiver<Arc<ServerConfig>>) -> World {
    World::with(config, Arc::new(Anybody::default()), Some(tls)).await
}

fn leaf(stream: &TlsStream<TcpStream>) -> Vec<u8> {
    stream.get_ref().1.peer_certificates().expect("a certificate")[0].to_vec()
}

#[tokio::test]
async fn a_peer_that_never_shakes_hands_is_closed() {
    let (_newest, tls) = watch::channel(CertificateAuthority::new().server(Clients::NotAsked));
    let world = proven(Config { tls_handshake: SOON, ..Config::default() }, tls).await;
    let mut silent = dial(world.address, HERE).await;
    within(until_closed(&mut silent)).await;
    world.closed_for("handshake_slow").await;
}

#[tokio::test]
async fn a_peer_that_speaks_plain_text_is_closed() {
    let (_newest, tls) = watch::channel(CertificateAuthority::new().server(Clients::NotAsked));
    let world = proven(Config::default(), tls).await;
    let mut plain = dial(world.address, HERE).await;
    plain.write_all(PREFACE).await.expect("written");
    within(until_closed(&mut plain)).await;
    world.closed_for("handshake_failed").await;
}

#[tokio::test]
async fn the_next_connection_sees_a_new_certificate_and_the_old_one_goes_on() {
    let authority = CertificateAuthority::new();
    let (newest, tls) = watch::channel(authority.server(Clients::NotAsked));
    let world = proven(Config::default(), tls).await;
    let before = authority.connect(&world, None).await.expect("a handshake");
    let first = leaf(&before);
    let mut before = Client::over(before).await;
    assert_eq!(before.asked("/who").await.header("connection-id"), "1");
    newest.send_replace(authority.server(Clients::NotAsked));
    let after = authority.connect(&world, None).await.expect("a handshake");
    assert_ne!(leaf(&after), first);
    let mut after = Client::over(after).await;
    assert_eq!(after.asked("/who").await.header("connection-id"), "2");
    assert_eq!(before.asked("/who").await.header("connection-id"), "1");
}

#[tokio::test]
async fn a_service_hears_which_certificate_was_proven() {
    let authority = CertificateAuthority::new();
    let (_newest, tls) = watch::channel(authority.server(Clients::Asked(vec![authority.root()])));
    let world = proven(Config::default(), tls).await;
    let robot = authority.issue("r7");
    let mut known = Client::over(authority.connect(&world, Some(&robot)).await.expect("a handshake")).await;
    assert_eq!(known.asked("/who").await.body, robot.leaf.as_ref());
    let mut unknown = Client::over(authority.connect(&world, None).await.expect("a handshake")).await;
    assert_eq!(unknown.asked("/who").await.body, b"", "asked for one, and let in without");
}

#[tokio::test]
async fn where_a_certificate_is_required_nobody_comes_in_without_one_of_ours() {
    let (ours, another) = (CertificateAuthority::new(), CertificateAuthority::new());
    let (_newest, tls) = watch::channel(ours.server(Clients::Required(vec![ours.root()])));
    let world = proven(Config::default(), tls).await;
    for shown in [None, Some(another.issue("r7"))] {
        // In TLS 1.3 a client hears of it only after its own part is done.
        if let Ok(stream) = ours.connect(&world, shown.as_ref()).await {
            assert!(Client::over(stream).await.ask("/who", None).await.is_none());
        }
    }
    world.closed_times("handshake_failed", 2).await;
    let robot = ours.issue("r7");
    let mut known = Client::over(ours.connect(&world, Some(&robot)).await.expect("a handshake")).await;
    assert_eq!(known.asked("/who").await.body, robot.leaf.as_ref());
}

#[tokio::test]
async fn who_comes_again_proves_its_certificate_again() {
    let authority = CertificateAuthority::new();
    let (_newest, tls) = watch::channel(authority.server(Clients::Asked(vec![authority.root()])));
    let world = proven(Config::default(), tls).await;
    // One memory of sessions for both.
    let robot = authority.client(Some(&authority.issue("r7")));
    for _ in 0..2 {
        let stream = shake_hands(&world, robot.clone()).await.expect("a handshake");
        let mut client = Client::over(stream).await;
        assert_ne!(client.asked("/who").await.body, b"");
    }
    let stream = shake_hands(&world, robot).await.expect("a handshake");
    assert_eq!(stream.get_ref().1.handshake_kind(), Some(HandshakeKind::Full));
}

#[tokio::test]
async fn services_of_tonic_find_the_peer_among_their_requests_extensions() {
    use tonic::service::{Routes, interceptor::InterceptedService};
    use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient, health_server::HealthServer};
    let (stop, (ours, theirs)) = (CancellationToken::new(), tokio::io::duplex(1 << 16));
    let address = "[2001:db8::7]:4242".parse().expect("an address");
    let one = tokio_stream::once(Ok(theirs)).chain(tokio_stream::pending());
    let incoming = Incoming::new(one, move |_: &_| address);
    let health = tonic_health::server::HealthService::from_health_reporter(tonic_health::server::HealthReporter::new());
    let asked = move |request: tonic::Request<()>| {
        let peer: &Peer = request.extensions().get().ok_or_else(|| tonic::Status::internal("nobody asks"))?;
        assert_eq!((peer.address, peer.connection), (address, ConnectionId(1)));
        Ok(request)
    };
    let routes = Routes::new(InterceptedService::new(HealthServer::new(health), asked));
    let edge = Edge::new(Config::default(), Arc::new(Anybody::default()), routes);
    let serving = tokio::spawn(edge.serve(incoming, stop.clone()));
    let mut io = Some(hyper_util::rt::TokioIo::new(ours));
    let connect = tower::service_fn(move |_: http::Uri| {
        std::future::ready(io.take().ok_or(std::io::Error::other("one connection only")))
    });
    let channel = tonic::transport::Endpoint::from_static("http://edge").connect_with_connector_lazy(connect);
    let request = HealthCheckRequest { service: String::new() };
    let checked = within(HealthClient::new(channel).check(request)).await;
    assert_eq!(checked.map(drop).map_err(|status| status.code()), Ok(()));
    stop.cancel();
    assert_eq!(within(serving).await.expect("serving did not panic").cut, 0);
}
