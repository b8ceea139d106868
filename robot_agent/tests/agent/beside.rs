//! A robot at work beside its own download: what it says and hears does not wait behind chunks, since they come over a
//! connection of their own.
//!
//! On tokio's paused clock. The twin has both on one connection, where chunks that the robot does not take yet, to keep
//! to its rate, fill the window of everything else.

use crate::remote::Shop;
use crate::session::{Desk, Pipes, Seen, clock, config};
use crate::test_body::TestBody;
use async_trait::async_trait;
use midshift_agent::body::BodyNews;
use midshift_agent::bulk::Bulk;
use midshift_agent::dial::{self, Dial};
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{Lines, Updates, run};
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::update::io::UpdateWorker;
use midshift_agent::update::remote::GrpcRemote;
use midshift_core::robot::{Fault, FaultClass, Lane};
use midshift_core::robot_events::InboxItem;
use midshift_core::update::{DesiredUpdate, Goal, UpdateState};
use midshift_proto::link::v1::link_service_server::LinkServiceServer;
use midshift_proto::session::{ClockSample, Downlink, Echo, FromRobot, LaneAck, ToRobot};
use std::sync::Arc;
use tokio::sync::{OnceCell, mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

/// Heartbeats that are looked at: longer than a robot bears silence, and shorter than a remote does.
const BEATS: usize = 40;
/// Of these, when the body's fault comes.
const FAULT_AT: usize = 10;
/// More messages are not looked at.
const MESSAGES_MAX: usize = 10 * BEATS;
/// Bytes a second: after its first piece the download waits for longer than the test lasts.
const RATE: u32 = 100;

/// Every call gets the one connection.
struct Shared {
    dial: Arc<dyn Dial>,
    one: OnceCell<Channel>,
}

#[async_trait]
impl Dial for Shared {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        self.one.get_or_try_init(|| self.dial.dial()).await.cloned()
    }
}

/// What one session of a robot carried while its download waited for its rate.
#[derive(Debug, Default)]
struct Carried {
    /// Heartbeats while bytes came, each echoed.
    beats: usize,
    /// STATUS samples with them.
    statuses: usize,
    /// The fault was told as a fact.
    is_fault_told: bool,
    /// Heartbeats with the error code.
    with_code: usize,
}

/// Takes what the robot says until the session ends or has carried enough.
async fn carry(session: &mut Seen, body: &TestBody) -> Carried {
    let mut carried = Carried::default();
    for _ in 0..MESSAGES_MAX {
        let Some(FromRobot::Uplink(uplink)) = session.next().await else { break };
        let mut down = Downlink::default();
        for batch in &uplink.batches {
            let seq = |item: &InboxItem| if let InboxItem::Sample(sample) = item { Some(sample.seq) } else { None };
            let last = batch.items.iter().filter_map(seq).max();
            down.acks.extend(last.map(|seq| LaneAck { lane: batch.lane, seq, expect: None }));
            carried.statuses += usize::from(batch.lane == Lane::Status);
            carried.is_fault_told |= batch.lane == Lane::Critical;
        }
        if let Some(heartbeat) = uplink.heartbeat {
            down.echo =
                Some(Echo { hb: heartbeat.reported.hb, clock: ClockSample::default(), is_clock_doubted: false });
            let loads = heartbeat.reported.update.is_some_and(|u| u.state == UpdateState::Downloading);
            carried.beats += usize::from(loads);
            carried.with_code += usize::from(heartbeat.reported.fault.is_some());
        }
        if carried.beats == FAULT_AT && !carried.is_fault_told {
            let fault = Fault { code: 7, class: FaultClass::Mechanical, message: "arm".to_owned() };
            body.says(BodyNews::Fault(fault, true));
        }
        if carried.beats == BEATS {
            break;
        }
        session.send(ToRobot::Downlink(Box::new(down))).await;
    }
    carried
}

/// A real agent with a download that keeps to [`RATE`], over pipes to a server that the test plays.
async fn beside_a_download(is_shared: bool) -> Carried {
    let (shop, body) = (Shop::new(), TestBody::at("A"));
    let bundle = shop.releases.release("1.1.0");
    let ((ends, incoming), (seen, mut sessions)) = (mpsc::channel(4), mpsc::channel(4));
    let router = shop.router().add_service(LinkServiceServer::new(Desk(seen)));
    tokio::spawn(router.serve_with_incoming(ReceiverStream::new(incoming)));
    let (_network, network) = watch::channel(true);
    let mut dial: Arc<dyn Dial> = Arc::new(Pipes { ends, network });
    if is_shared {
        dial = Arc::new(Shared { dial, one: OnceCell::new() });
    }
    let lines = Lines { bulk: Bulk::new(dial.clone()), link: dial };
    let worker = UpdateWorker::new(Box::new(MemorySets::new()), Arc::new(GrpcRemote::new(lines.bulk.clone())));
    let config = config(Some(Updates { config: shop.releases.config(), worker: Box::new(worker) }));
    let (robot_id, clock) = (config.robot_id.clone(), clock(crate::release::SIGNED));
    let (store, stop) = (Box::new(MemoryStore::new()), CancellationToken::new());
    let agent = tokio::spawn(run(config, Box::new(body.clone()), store, clock, lines, stop.clone()));
    let mut session = sessions.recv().await.expect("the robot dials");
    session.hello().await;
    session.welcome(5).await;
    let directive = shop.releases.directive(&bundle, 101);
    let update = DesiredUpdate {
        robot_id,
        generation: 101,
        goal: Goal::Stage,
        directive,
        drain_id: None,
        grant: None,
        rate_bytes_s: RATE,
        probation_ms: 1_000,
    };
    session.send(ToRobot::Downlink(Box::new(Downlink { update: Some(update), ..Downlink::default() }))).await;
    let carried = carry(&mut session, &body).await;
    stop.cancel();
    agent.await.expect("no panic").expect("no error");
    carried
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_says_and_hears_does_not_wait_behind_its_download() {
    let carried = beside_a_download(false).await;
    assert_eq!(carried.beats, BEATS, "{carried:?}");
    assert!(carried.statuses >= BEATS / 4 && carried.is_fault_told, "{carried:?}");
    assert!(carried.with_code >= BEATS - FAULT_AT - 2, "{carried:?}");
}

#[tokio::test(start_paused = true)]
async fn with_both_on_one_connection_the_chunks_would_starve_the_session() {
    let carried = beside_a_download(true).await;
    // Ten seconds without a word from the server, and the robot gives the session up.
    assert!((8..16).contains(&carried.beats), "{carried:?}");
}
