//! What robots and servers of each release said to each other, read by this build; and the shift in which this build says it.
//!
//! `tests/fixtures/VERSION/wire.txt` has one frame a line: who said it, its message, its bytes in hexadecimal.

use crate::directed::{Scene, config};
use crate::frame::Frame;
use crate::net::LineState;
use crate::newer::Newer;
use crate::orders::Order;
use crate::room::{Naive, RoomConfig};
use crate::run::steer;
use crate::software::GOOD;
use midshift_core::rollout::rows::Phase;
use midshift_proto::stop::v1 as stop;
use std::collections::BTreeSet;
use std::path::Path;

/// Where this build's frames are to be written down, if they are to be.
const RECORD: &str = "MIDSHIFT_RECORD";
const FILE: &str = "wire.txt";
/// What a shift must say, as [`Frame::parts`] names it.
const SAID: [&str; 23] = [
    ".hello",
    ".hello.previous",
    ".hello.reported.attempts",
    ".hello.installed",
    ".uplink.heartbeat",
    ".uplink.batches",
    ".welcome",
    ".downlink.echo",
    ".downlink.acks",
    ".downlink.work.assignment",
    ".downlink.policy",
    ".downlink.update.directive",
    ".downlink.update.grant",
    "midshift.link.v1.ReplayStatusRequest",
    "midshift.link.v1.ReplayStatusResponse",
    "midshift.ota.v1.FetchChunksRequest",
    "midshift.ota.v1.FetchChunksResponse",
    "midshift.ota.v1.GetMetadataRequest",
    "midshift.ota.v1.GetMetadataResponse",
    "midshift.stop.v1.AttendRequest",
    "midshift.stop.v1.AttendResponse",
    ".attend",
    ".checkIn",
];

/// The first frame of each kind that a shift says: work, a roll-out and its way back, a stop and its reset, a server
/// that is killed and a robot that is away.
fn said() -> Vec<Frame> {
    let newer = Newer::default();
    newer.keep_frames();
    let room = RoomConfig { stops: true, newer: Some(newer.clone()), ..config(1, 2, Naive::default()) };
    let mut scene = Scene::with(room);
    scene.work(4);
    scene.begin("on", GOOD[0], |spec| spec.drain_within = Some(prost_types::Duration { seconds: 600, nanos: 0 }));
    scene.comes_to("on", Phase::Applying);
    scene.room.crash_server();
    scene.pass(2_000);
    scene.room.restart_server();
    assert_eq!(scene.ends("on").phase, Phase::Completed);
    let scope = Some(stop::Scope { scope: Some(stop::scope::Scope::Fleet(stop::Fleet {})) });
    let (reason, request_id) = ("somebody fell".to_owned(), "stop-1".to_owned());
    let engage = stop::EngageRequest { scope, reason, request_id, ..stop::EngageRequest::default() };
    scene.order(Order::Engage(Box::new(engage)));
    scene.pass(5_000);
    let stop_id = crate::stops::effective(&scene.room.stop.as_ref().expect("a stop service").latch()).pop_first();
    scene.order(Order::Reset(stop_id.expect("one is engaged").to_string()));
    scene.pass(5_000);
    steer(&mut scene.room, 0, LineState::Cut);
    scene.pass(120_000);
    steer(&mut scene.room, 0, LineState::Open);
    scene.pass(60_000);
    assert_eq!(scene.findings(), [] as [String; 0]);
    newer.frames()
}

#[test]
fn a_shift_says_a_frame_of_every_kind_and_each_is_read_whole() {
    let frames = said();
    if let Some(to) = std::env::var_os(RECORD) {
        let lines: String = frames.iter().map(|frame| frame.line() + "\n").collect();
        std::fs::write(Path::new(&to).join(FILE), lines).expect("it is written down");
    }
    let parts: BTreeSet<String> = frames.iter().flat_map(Frame::parts).collect();
    let missing: Vec<_> = SAID.iter().filter(|part| !parts.contains(**part)).collect();
    assert!(missing.is_empty(), "no frame has {missing:?}");
    for frame in frames {
        assert_eq!(frame.again(), frame.bytes, "{} has lost something: {:?}", frame.message, frame.parts());
        assert_eq!(Frame::parse(&frame.line()), frame);
    }
}

#[test]
fn every_frame_of_a_release_is_read_and_loses_nothing() {
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures");
    let releases = std::fs::read_dir(&fixtures).expect("releases").map(|entry| entry.expect("an entry").path());
    let files: Vec<_> = releases.map(|release| release.join(FILE)).filter(|file| file.is_file()).collect();
    assert!(!files.is_empty(), "no release has left {FILE} in {}", fixtures.display());
    for file in files {
        for (line, number) in std::fs::read_to_string(&file).expect("frames").lines().zip(1..) {
            let frame = Frame::parse(line);
            assert_eq!(
                frame.again(),
                frame.bytes,
                "{}:{number} has lost something: {:?}",
                file.display(),
                frame.parts()
            );
        }
    }
}

#[test]
#[should_panic(expected = "GetMetadataRequest has lost")]
fn a_field_that_this_build_does_not_know_is_found_to_be_lost() {
    // Field 100, the number 1.
    let bytes = vec![0xa0, 0x06, 0x01];
    Frame { message: "midshift.ota.v1.GetMetadataRequest".to_owned(), bytes }.again();
}
