//! A thousand times a robot goes from one session to the next, over TLS with its own certificate: it moves to another connection, its agent is started anew, or its
//! power is cut. None of it looks like a second machine; a copy of a key does.

use crate::harness::{Server, channel, folder};
use anyhow::{Context, ensure};
use midshift::enrol_simulated::{Machines, Replaced};
use midshift_agent::dial::{Dial, TcpDial};
use midshift_agent::tls::Tls;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot::ReportedState;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{Incident, ListIncidentsRequest};
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::link::v1::{SessionRequest, SessionResponse};
use midshift_proto::session::{CloseCode, FromRobot, Heartbeat, Hello, Previous, ToRobot, Uplink, Welcome};
use std::net::SocketAddr;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;

/// Each goes over [`PER_ROBOT`] times.
const ROBOTS: usize = 250;
const PER_ROBOT: usize = 4;
/// Heartbeats in which a copied key must have been told of.
const BEATS_MAX: u64 = 60;

/// One session of a robot.
struct Session {
    up: mpsc::Sender<SessionRequest>,
    down: Streaming<SessionResponse>,
    welcome: Welcome,
    hb: u64,
}

impl Session {
    /// Over a connection of its own, in which the machine shows its certificate.
    async fn open(
        dial: &TcpDial,
        robot_id: &RobotId,
        boot_id: &str,
        previous: Option<Previous>,
    ) -> anyhow::Result<Self> {
        let hello = Hello { previous, ..Hello::new(robot_id.clone(), boot_id, "ring") };
        let (up, outbound) = mpsc::channel(4);
        up.send((&FromRobot::Hello(Box::new(hello))).into()).await?;
        let mut client = LinkServiceClient::new(dial.dial().await?);
        let mut down = client.session(ReceiverStream::new(outbound)).await?.into_inner();
        let first = down.message().await?.context("no welcome")?;
        let ToRobot::Welcome(welcome) = midshift_proto::parse(first)? else { anyhow::bail!("no welcome first") };
        Ok(Self { up, down, welcome, hb: 0 })
    }
    /// One heartbeat, answered.
    async fn beat(&mut self) -> anyhow::Result<()> {
        self.hb += 1;
        let session_epoch = self.welcome.session_epoch;
        let reported = ReportedState { hb: self.hb, session_epoch, ..ReportedState::default() };
        let heartbeat = Some(Heartbeat { reported, sent_unix_us: 0, clock: None });
        self.up.send((&FromRobot::Uplink(Uplink { heartbeat, batches: Vec::new() })).into()).await?;
        while let Some(message) = self.down.message().await? {
            if let ToRobot::Downlink(down) = midshift_proto::parse(message)?
                && down.echo.is_some_and(|echo| echo.hb == self.hb)
            {
                return Ok(());
            }
        }
        anyhow::bail!("the session ended")
    }
    /// Waits until the server closes it.
    async fn closes(&mut self) -> anyhow::Result<CloseCode> {
        while let Some(message) = self.down.message().await? {
            if let ToRobot::Close(close) = midshift_proto::parse(message)? {
                return Ok(close.code);
            }
        }
        anyhow::bail!("the session ended without a word")
    }
    fn proof(&self) -> Previous {
        Previous { session_epoch: self.welcome.session_epoch, secret: self.welcome.session_secret.clone() }
    }
}

/// How an agent is started anew.
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    /// The program is killed: its machine closes the connection.
    Killed,
    /// Its power is cut: the connection looks open and nothing comes over it any more.
    PowerCut,
}

/// One machine.
struct Robot {
    id: RobotId,
    dial: TcpDial,
    boot: u32,
}

impl Robot {
    fn new(id: RobotId, tls: Tls, server: SocketAddr) -> anyhow::Result<Self> {
        let dial = TcpDial::new(&format!("https://{server}"), None)?.with_tls(tls);
        Ok(Self { id, dial, boot: 1 })
    }
    async fn open(&self, previous: Option<Previous>) -> anyhow::Result<Session> {
        Session::open(&self.dial, &self.id, &format!("boot-{}", self.boot), previous).await
    }
    /// Another connection of the same start: it proves itself, and the older session ends.
    async fn roams(&self, mut session: Session) -> anyhow::Result<Session> {
        let mut next = self.open(Some(session.proof())).await?;
        ensure!(!next.welcome.observed, "{}: it proved itself", self.id);
        ensure!(session.closes().await? == CloseCode::Fenced, "{}: the older session", self.id);
        next.beat().await?;
        Ok(next)
    }
    /// Another start of the agent, with what lies in its folder.
    async fn restarts(&mut self, session: Session, end: End) -> anyhow::Result<Session> {
        self.boot += 1;
        let proof = session.proof();
        let silent = (end == End::PowerCut).then_some(session);
        let mut next = self.open(Some(proof)).await?;
        ensure!(next.welcome.observed || end == End::Killed, "{}: nobody can know yet", self.id);
        while next.welcome.observed {
            ensure!(next.closes().await? == CloseCode::MoveOver, "{}: it is asked to come back", self.id);
            next = self.open(Some(next.proof())).await?;
        }
        drop(silent);
        next.beat().await?;
        Ok(next)
    }
    /// How often it went over.
    async fn goes_over(mut self) -> anyhow::Result<usize> {
        let mut session = self.open(None).await?;
        ensure!(!session.welcome.observed, "{}: the first session", self.id);
        session.beat().await?;
        session = self.roams(session).await?;
        session = self.restarts(session, End::Killed).await?;
        session = self.roams(session).await?;
        self.restarts(session, End::PowerCut).await?;
        Ok(PER_ROBOT)
    }
}

async fn incidents(server: SocketAddr) -> anyhow::Result<Vec<Incident>> {
    let request = ListIncidentsRequest { include_closed: true, page_size: 1_000, ..ListIncidentsRequest::default() };
    Ok(FleetServiceClient::new(channel(server)?).list_incidents(request).await?.into_inner().incidents)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_thousand_hand_overs_of_enrolled_robots_raise_no_alarm_and_one_copied_key_raises_one() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let address = server.address;
    let robots = (0..=ROBOTS).map(|n| RobotId::parse(&format!("r{n}"))).collect::<Result<Vec<_>, _>>()?;
    let machines = Machines::enrol(&server.way()?, &address.to_string(), robots, None, &Replaced::default()).await?;
    let mut tls = machines.tls();
    let (copied, copied_tls) = tls.pop_first().context("a robot more than those that go over")?;
    let mut joined = JoinSet::new();
    for (id, tls) in tls {
        joined.spawn(Robot::new(id, tls, address)?.goes_over());
    }
    let mut hand_overs = 0;
    while let Some(robot) = joined.join_next().await {
        hand_overs += robot??;
    }
    assert_eq!(hand_overs, 1_000);

    // The same key on another machine, which knows the secret of the session too, while the original is heard.
    let mut original = Robot::new(copied.clone(), copied_tls, address)?;
    let mut session = original.open(None).await?;
    session.beat().await?;
    original.boot = 2;
    let copy = original.open(Some(session.proof())).await?;
    ensure!(copy.welcome.observed, "it has the key, the secret and another start");
    let (mut told, mut each) = (Vec::new(), tokio::time::interval(Duration::from_millis(limits::HEARTBEAT.as_ms())));
    while told.is_empty() && session.hb < BEATS_MAX {
        each.tick().await;
        session.beat().await?;
        told = incidents(address).await?;
    }
    let [incident] = told.as_slice() else { anyhow::bail!("alarms of hand-overs: {told:?}") };
    let reason = incident.reason.clone().unwrap_or_default();
    assert_eq!((incident.robot_id.as_str(), reason.code.as_str()), (copied.as_str(), Code::CloneSeen.as_str()));
    assert_eq!(reason.metadata.get("boot_id").map(String::as_str), Some("boot-2"));
    ensure!(reason.metadata.get("certificate").is_some_and(|serial| serial.len() == 32), "{reason:?}");
    Ok(())
}
