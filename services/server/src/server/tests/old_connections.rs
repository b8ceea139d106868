//! Old connections from the door to the robot: the port tells the service, the service tells the robot, and the robot's next session is a succession.

use midshift_core::ids::{RobotId, SiteId};
use midshift_core::time::Clock;
use midshift_core::time::{LinkDuration, ScaledClock, Utc};
use midshift_edge::{Age, Config};
use midshift_process::door::{alone, serve};
use midshift_proto::convert::stop::{FromStop, ToStop};
use midshift_proto::link::v1::SessionRequest;
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::session::{FromRobot, Hello, Previous, ToRobot, Welcome};
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use midshift_store::{LiveBoard, MemoryFrames, MemoryStore, StoreId};
use midshift_telemetry::TelemetryService;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::Streaming;
use tonic::service::Routes;
use tonic::transport::Channel;

async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(20), work).await.expect("what the test waits for happens")
}

fn clock() -> Arc<dyn Clock> {
    let started = tokio::time::Instant::now();
    Arc::new(ScaledClock::new(move || started.elapsed().as_micros() as u64, Utc(1_800_000_000_000), 1000))
}

/// A port whose connections are old at once.
async fn port(routes: Routes, stop: CancellationToken) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("its address");
    let age = Age { notice: LinkDuration::from_secs(60), ..Age::after(LinkDuration(50)) };
    let config = Config { age: Some(age), ..alone("test") };
    tokio::spawn(serve(config, None, routes, listener, stop));
    address
}

async fn dial(address: SocketAddr) -> Channel {
    Channel::from_shared(format!("http://{address}")).expect("an address").connect().await.expect("a connection")
}

async fn session(
    address: SocketAddr,
    previous: Option<Previous>,
) -> (Welcome, Streaming<midshift_proto::link::v1::SessionResponse>, mpsc::Sender<SessionRequest>) {
    let hello = Hello { previous, ..Hello::new(RobotId::parse("r1").expect("an id"), "boot", "ring") };
    let (up, said) = mpsc::channel(4);
    up.send((&FromRobot::Hello(Box::new(hello))).into()).await.expect("there is room");
    let mut client = LinkServiceClient::new(dial(address).await);
    let mut down = within(client.session(ReceiverStream::new(said))).await.expect("a session").into_inner();
    let first = within(down.message()).await.expect("a message").expect("a welcome");
    match midshift_proto::parse(first).expect("it can be read") {
        ToRobot::Welcome(welcome) => (welcome, down, up),
        other => panic!("no welcome: {other:?}"),
    }
}

#[tokio::test]
async fn a_session_on_an_old_connection_moves_over_and_the_next_one_is_in_charge() {
    let site = SiteId::parse("s").expect("a site");
    let store = Arc::new(MemoryStore::new(site, StoreId("store-1".into()), clock()));
    let frames = Arc::new(MemoryFrames::new(clock(), 1 << 20));
    let (board, bugs, stop) = (LiveBoard::new(), midshift_telemetry::Bugs::default(), CancellationToken::new());
    let parts = midshift_telemetry::Parts { store, frames, board, heard: None, clock: clock(), bugs };
    let telemetry = TelemetryService::new(parts, stop.clone());
    tokio::spawn(telemetry.clone().run());
    let address = port(telemetry.add_to(Routes::default()), stop.clone()).await;
    let mut previous = None;
    for _ in 0..5 {
        let (welcome, mut down, _up) = session(address, previous).await;
        assert!(!welcome.observed, "a succession, not a clone");
        previous = Some(Previous { session_epoch: welcome.session_epoch, secret: welcome.session_secret });
        loop {
            let message = within(down.message()).await.expect("a message").expect("the session goes on");
            if let ToRobot::MoveOver { .. } = midshift_proto::parse(message).expect("it can be read") {
                break;
            }
        }
    }
    stop.cancel();
}

#[tokio::test]
async fn a_stop_line_on_an_old_connection_is_asked_to_move_over() {
    let folder = tempfile::tempdir().expect("a folder");
    let stop = CancellationToken::new();
    let parts = midshift_stop::Parts { folder: folder.path().join("stop"), site: None, clock: clock() };
    let service = midshift_stop::StopService::open(parts, stop.clone()).expect("it opens");
    let address = port(service.routes().await.expect("its faces"), stop.clone()).await;
    let robot_id = RobotId::parse("r1").expect("an id");
    let attend = ToStop::Attend { robot_id, boot_id: "boot".to_owned(), stops: Vec::new(), more: Vec::new() };
    let (up, said) = mpsc::channel(4);
    up.send((&attend).into()).await.expect("there is room");
    let mut client = StopLinkServiceClient::new(dial(address).await);
    let mut down = within(client.attend(ReceiverStream::new(said))).await.expect("a line").into_inner();
    loop {
        let message = within(down.message()).await.expect("a message").expect("the line goes on");
        if let FromStop::MoveOver = midshift_proto::parse(message).expect("it can be read") {
            break;
        }
    }
    stop.cancel();
}
