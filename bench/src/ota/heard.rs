//! What a server knows of one robot and since when: its heartbeats as they are told to whoever watches, and the record of its samples.
//!
//! Called by [`super::line`].

use anyhow::ensure;
use midshift_core::site::{DEMO, text};
use midshift_proto::convert::common::time_of;
use midshift_proto::link::v1::{Lane, LaneBatch, UpdateState, robot_event, sample};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, Robot, RobotFilter, WatchRobotsRequest, event};
use midshift_store::{FRAME_BYTES_DEFAULT, FrameLog, SqliteFrames};
use prost::Message;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::time::{Instant, sleep};
use tokio_util::task::AbortOnDropHandle;
use tonic::transport::Channel;

/// Milliseconds between two messages to the watcher: the shortest there is.
const PERIOD_MS: u32 = 50;
/// How often the watcher's list is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Bytes of the record that are read at a time.
const READ_BYTES: usize = 4 * 1024 * 1024;

/// One heartbeat as the server has it. All of it is of one moment on the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Beat {
    /// When the server had it, UTC unix ms.
    pub at_ms: i64,
    /// Number of the newest STATUS sample on the robot, made with this heartbeat if it rose.
    status_seq: u64,
    /// State of charge, permille.
    battery: u32,
    /// Tenths of a degree Celsius.
    joint: i32,
    /// The standing error code.
    pub code: Option<u32>,
    /// Its software is staged.
    pub is_staged: bool,
}

/// One STATUS sample as the frame log has it.
#[derive(Clone, Copy, Debug)]
struct StoredSample {
    made_ms: i64,
    durable_ms: i64,
    battery: u32,
    joint: i32,
}

/// Milliseconds of what arrived in one stretch of time.
#[derive(Debug, Default)]
pub struct Ages {
    /// Battery, joint temperature and error code: from their reading on the robot until the server had them.
    pub known_ms: Vec<f64>,
    /// The same STATUS sample until it was durable; it travels with the next heartbeat.
    pub durable_ms: Vec<f64>,
    /// Between two heartbeats.
    pub between_ms: Vec<f64>,
}

/// Watches one robot.
pub struct Watcher {
    beats: Arc<Mutex<Vec<Beat>>>,
    watch: AbortOnDropHandle<anyhow::Result<()>>,
}

fn lock(beats: &Mutex<Vec<Beat>>) -> MutexGuard<'_, Vec<Beat>> {
    beats.lock().unwrap_or_else(PoisonError::into_inner)
}

fn beat(robot: &Robot) -> Option<Beat> {
    let (reported, at) = (robot.reported.as_ref()?, robot.receive_time.as_ref()?);
    let vitals = reported.vitals.as_ref()?;
    let status = reported.produced.iter().find(|mark| mark.lane() == Lane::Status);
    Some(Beat {
        at_ms: time_of(at).0,
        status_seq: status.map_or(0, |mark| mark.seq),
        battery: vitals.battery_permille,
        joint: vitals.hottest_joint_decidegrees,
        code: reported.fault.as_ref().map(|fault| fault.code),
        is_staged: reported.update.as_ref().is_some_and(|update| update.state() == UpdateState::Staged),
    })
}

async fn watch(channel: Channel, robot_id: String, beats: Arc<Mutex<Vec<Beat>>>) -> anyhow::Result<()> {
    let filter = Some(RobotFilter { robot_ids: vec![robot_id], ..RobotFilter::default() });
    let request = WatchRobotsRequest { filter, period_ms: PERIOD_MS };
    let mut told = TelemetryServiceClient::new(channel).watch_robots(request).await?.into_inner();
    while let Some(news) = told.message().await? {
        let mut beats = lock(&beats);
        for beat in news.robots.iter().filter_map(beat) {
            if beats.last().is_none_or(|last| last.at_ms != beat.at_ms) {
                beats.push(beat);
            }
        }
    }
    Ok(())
}

impl Watcher {
    /// Watches a robot from now on.
    pub fn begin(channel: Channel, robot_id: &str) -> Self {
        let beats: Arc<Mutex<Vec<Beat>>> = Arc::default();
        let watch = AbortOnDropHandle::new(tokio::spawn(watch(channel, robot_id.to_owned(), beats.clone())));
        Self { beats, watch }
    }
    /// The first heartbeat from a moment on that is as asked for; an error if none comes in time or nobody tells any more.
    pub async fn until(
        &self,
        from_ms: i64,
        within: Duration,
        what: &str,
        is: impl Fn(&Beat) -> bool,
    ) -> anyhow::Result<Beat> {
        let end = Instant::now() + within;
        loop {
            if let Some(found) = lock(&self.beats).iter().find(|beat| beat.at_ms >= from_ms && is(beat)) {
                return Ok(found.clone());
            }
            ensure!(
                !self.watch.is_finished(),
                "the server stopped telling of the robot while it was waited for {what}"
            );
            ensure!(Instant::now() < end, "waited {within:?} in vain for {what}");
            sleep(LOOK_EVERY).await;
        }
    }
    /// All heartbeats so far.
    pub fn beats(&self) -> Vec<Beat> {
        lock(&self.beats).clone()
    }
}

/// Finds when the server had this fault of a robot durable as an event, the first one from a moment on; UTC unix ms. None: not yet.
pub async fn fault_durable_ms(
    channel: Channel,
    robot_id: &str,
    code: u32,
    from_ms: i64,
) -> anyhow::Result<Option<i64>> {
    let mut client = TelemetryServiceClient::new(channel);
    let mut cursor = String::new();
    loop {
        let robot_ids = vec![robot_id.to_owned()];
        let request = ListEventsRequest { robot_ids, cursor, page_size: 1_000, ..ListEventsRequest::default() };
        let page = client.list_events(request).await?.into_inner();
        for event in page.events.iter().filter(|event| event.lane() == Lane::Critical) {
            let at_ms = event.receive_time.as_ref().map_or(0, |at| time_of(at).0);
            if let Some(event::Item::Sample(sample)) = &event.item
                && let Some(sample::Body::Event(said)) = &sample.body
                && let Some(robot_event::Event::Fault(change)) = &said.event
                && change.fault.as_ref().is_some_and(|fault| fault.code == code)
                && !change.cleared
                && at_ms >= from_ms
            {
                return Ok(Some(at_ms));
            }
        }
        if page.caught_up {
            return Ok(None);
        }
        cursor = page.cursor;
    }
}

/// Every STATUS sample of a robot in the record of a server that has ended, by number.
async fn record(data: &Path, robot_id: &str) -> anyhow::Result<BTreeMap<u64, StoredSample>> {
    let site = text::parse(DEMO)?.site_id().clone();
    let frames = SqliteFrames::open(data, site, midshift_process::clock::clock(1000), FRAME_BYTES_DEFAULT).await?;
    let (mut kept, mut position) = (BTreeMap::new(), 0);
    loop {
        let read = frames.read(position, READ_BYTES).await?;
        let Some(last) = read.last() else { break };
        position = last.position;
        for stored in read.iter().filter(|stored| stored.frame.robot_id.as_str() == robot_id) {
            for sample in LaneBatch::decode(&*stored.frame.bytes)?.samples {
                if let Some(sample::Body::Status(vitals)) = sample.body {
                    let (battery, joint) = (vitals.battery_permille, vitals.hottest_joint_decidegrees);
                    let (made_ms, durable_ms) = (sample.robot_unix_ms, stored.at_unix_ms);
                    kept.insert(sample.seq, StoredSample { made_ms, durable_ms, battery, joint });
                }
            }
        }
    }
    frames.close().await;
    Ok(kept)
}

/// The ages of what a robot's server had in each stretch of time, by the record of its samples.
pub async fn ages(
    data: &Path,
    robot_id: &str,
    beats: &[Beat],
    stretches: &[RangeInclusive<i64>],
) -> anyhow::Result<Vec<Ages>> {
    let kept = record(data, robot_id).await?;
    let mut all = Vec::new();
    for stretch in stretches {
        let mut ages = Ages::default();
        for pair in beats.windows(2).filter(|pair| stretch.contains(&pair[0].at_ms) && stretch.contains(&pair[1].at_ms))
        {
            let (before, beat) = (&pair[0], &pair[1]);
            ages.between_ms.push((beat.at_ms - before.at_ms) as f64);
            let Some(sample) = kept.get(&beat.status_seq).filter(|_| beat.status_seq > before.status_seq) else {
                continue;
            };
            // The heartbeat and the sample of one reading say the same, so the sample's stamp is the heartbeat's.
            ensure!(
                (sample.battery, sample.joint) == (beat.battery, beat.joint),
                "a sample of another moment: {beat:?}"
            );
            ages.known_ms.push((beat.at_ms - sample.made_ms) as f64);
            ages.durable_ms.push((sample.durable_ms - sample.made_ms) as f64);
        }
        ensure!(!ages.known_ms.is_empty(), "no STATUS sample came in {stretch:?}");
        all.push(ages);
    }
    Ok(all)
}
