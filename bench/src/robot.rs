//! The smallest robot that keeps its session: says hello, beats, numbers its samples, and hears. It has no body and no memory.
//!
//! Invariant: its connection has the settings of a real agent's. Called by `offer`, and by `link` and `ota` where agents would be too slow or too many.

use anyhow::{Context, bail};
use midshift_agent::dial::{Dial, TcpDial};
use midshift_core::ids::{RobotId, WaypointId};
use midshift_core::robot::{Inventory, Lane, Mode, ReportedState, Vitals};
use midshift_core::robot_events::{InboxItem, RobotEvent, Sample, SampleBody};
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::link::v1::{self, SessionRequest, SessionResponse};
use midshift_proto::session::{Downlink, FromRobot, Heartbeat, Hello, LaneBatch, ToRobot, Uplink, Welcome};
use prost::Message;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;

/// Messages on their way to the wire.
const OUTBOUND: usize = 64;

/// The way up of one robot.
pub struct RobotSender {
    up: mpsc::Sender<SessionRequest>,
    /// What it says of itself; the numbers are kept here.
    pub reported: ReportedState,
}

/// The way down of one robot.
pub struct RobotReceiver(Streaming<SessionResponse>);

/// What a new robot at a waypoint says first.
pub fn hello(name: &str, waypoint: Option<WaypointId>) -> anyhow::Result<Hello> {
    let vitals = Vitals { waypoint, battery_permille: 1_000, ..Vitals::default() };
    let capabilities = ["pick", "place", "charge", "park"].map(str::to_owned).to_vec();
    Ok(Hello {
        inventory: Inventory { capabilities, payload_g: 10_000, ..Inventory::default() },
        reported: ReportedState { vitals, ..ReportedState::default() },
        sent_unix_ms: midshift_agent::clock::wall().0,
        ..Hello::new(RobotId::parse(name)?, format!("{name}-boot"), format!("{name}-ring"))
    })
}

/// Opens a session for a new robot at a waypoint.
pub async fn attach(
    server: &str,
    name: &str,
    waypoint: Option<WaypointId>,
) -> anyhow::Result<(RobotSender, RobotReceiver, Welcome)> {
    open(server, hello(name, waypoint)?).await
}

/// Opens a session.
pub async fn open(server: &str, hello: Hello) -> anyhow::Result<(RobotSender, RobotReceiver, Welcome)> {
    let channel = TcpDial::new(&midshift_cli::endpoint::uri(server), None)?.dial().await?;
    let (up, outbound) = mpsc::channel(OUTBOUND);
    let reported = hello.reported.clone();
    up.send((&FromRobot::Hello(Box::new(hello))).into()).await?;
    let mut down = LinkServiceClient::new(channel).session(ReceiverStream::new(outbound)).await?.into_inner();
    let first = down.message().await?.context("no welcome")?;
    let welcome = match midshift_proto::parse(first) {
        Ok(ToRobot::Welcome(welcome)) => welcome,
        Ok(other) => bail!("not a welcome: {other:?}"),
        Err(refusal) => bail!("not a welcome: {refusal}"),
    };
    let mut sender = RobotSender { up, reported };
    sender.reported.session_epoch = welcome.session_epoch;
    Ok((sender, RobotReceiver(down), welcome))
}

impl RobotSender {
    /// A heartbeat, alone or with the next STATUS sample.
    pub async fn beat(&mut self, with_status: bool) -> anyhow::Result<()> {
        let body = with_status.then(|| SampleBody::Status(self.reported.vitals.clone()));
        let batches = body.map(|body| self.batch(Lane::Status, vec![body])).into_iter().collect();
        self.reported.hb += 1;
        let sent_unix_us = midshift_agent::clock::wall().0 * 1000;
        let heartbeat = Some(Heartbeat { reported: self.reported.clone(), sent_unix_us, clock: None });
        self.send_uplink(Uplink { heartbeat, batches }).await
    }
    /// The next EVENT samples, in one message.
    pub async fn send_events(&mut self, events: Vec<RobotEvent>) -> anyhow::Result<()> {
        let batch = self.batch(Lane::Event, events.into_iter().map(SampleBody::Event).collect());
        self.send_uplink(Uplink { heartbeat: None, batches: vec![batch] }).await
    }
    /// A small event that changes nothing.
    pub async fn send_mode(&mut self) -> anyhow::Result<()> {
        self.send_events(vec![RobotEvent::Mode(Mode::Automatic)]).await
    }
    /// What one STATUS message takes of the credit, bytes.
    pub fn status_bytes(&self) -> usize {
        let body = SampleBody::Status(self.reported.vitals.clone());
        let sample = Sample { seq: u64::from(u32::MAX), robot_unix_ms: midshift_agent::clock::wall().0, body };
        v1::LaneBatch::from(&LaneBatch { lane: Lane::Status, items: vec![InboxItem::Sample(sample)] }).encoded_len()
    }
    /// Highest number written in a lane.
    pub fn produced(&self, lane: Lane) -> u64 {
        self.reported.produced.get(&lane).copied().unwrap_or(0)
    }
    fn batch(&mut self, lane: Lane, bodies: Vec<SampleBody>) -> LaneBatch {
        let robot_unix_ms = midshift_agent::clock::wall().0;
        let last = self.reported.produced.entry(lane).or_default();
        let number = |body| {
            *last += 1;
            InboxItem::Sample(Sample { seq: *last, robot_unix_ms, body })
        };
        LaneBatch { lane, items: bodies.into_iter().map(number).collect() }
    }
    async fn send_uplink(&self, uplink: Uplink) -> anyhow::Result<()> {
        self.up.send((&FromRobot::Uplink(uplink)).into()).await.context("the session has ended")
    }
}

impl RobotReceiver {
    /// The next word from the server; an error if the session is over.
    pub async fn receive(&mut self) -> anyhow::Result<Box<Downlink>> {
        let message = self.0.message().await?.context("the server ended the session")?;
        match midshift_proto::parse(message) {
            Ok(ToRobot::Downlink(down)) => Ok(down),
            Ok(other) => bail!("the session is over: {other:?}"),
            Err(refusal) => bail!("the server's word cannot be read: {refusal}"),
        }
    }
    /// Up to which number of a lane all is durable, as soon as the server says something of it.
    pub async fn acked(&mut self, lane: Lane) -> anyhow::Result<u64> {
        loop {
            let down = self.receive().await?;
            if let Some(ack) = down.acks.iter().rev().find(|ack| ack.lane == lane) {
                return match ack.expect {
                    None => Ok(ack.seq),
                    Some(expect) => bail!("the server asks again for {expect} of {}", lane.as_str()),
                };
            }
        }
    }
}
