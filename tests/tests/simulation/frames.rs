//! What robots and servers of each release said to each other, read by this build; and the shift in which this build says it.
//!
//! `tests/fixtures/VERSION/wire.txt` has one frame a line: who said it, its message, its bytes in hexadecimal.

use crate::directed::{Scene, config};
use crate::net::Way;
use crate::newer::Newer;
use crate::orders::Order;
use crate::room::{Naive, RoomConfig};
use crate::run::steer;
use crate::software::GOOD;
use midshift_core::rollout::rows::Phase;
use midshift_proto::json::pool;
use midshift_proto::link::v1 as link;
use midshift_proto::session::{FromRobot, LaneAck, StatusReplay, ToRobot};
use midshift_proto::stop::v1 as stop;
use midshift_proto::{Parse, parse};
use prost::Message;
use prost_reflect::DynamicMessage;
use serde_json::Value;
use std::collections::BTreeSet;
use std::fmt::Write;
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

/// One message of a call, as it was on the wire.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The full name of its message.
    pub message: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

impl Frame {
    fn line(&self) -> String {
        let mut line = format!("{} ", self.message);
        for byte in &self.bytes {
            write!(line, "{byte:02x}").expect("a text takes it");
        }
        line
    }

    fn parse(line: &str) -> Self {
        let (message, hex) = line.split_once(' ').expect("a message and its bytes");
        let bytes = (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16).expect("hexadecimal"));
        Self { message: message.to_owned(), bytes: bytes.collect() }
    }

    /// What it is made of: its message, each field that is there, and each word of an enum.
    pub fn parts(&self) -> BTreeSet<String> {
        let kind = pool().get_message_by_name(&self.message).unwrap_or_else(|| panic!("{} is gone", self.message));
        let message = DynamicMessage::decode(kind, self.bytes.as_slice()).expect("a frame can be read");
        let mut parts = BTreeSet::from([self.message.clone()]);
        collect(&serde_json::to_value(&message).expect("it is JSON"), "", &mut parts);
        parts
    }

    /// As its receiver reads it, said again.
    fn again(&self) -> Vec<u8> {
        let bytes = self.bytes.as_slice();
        match self.message.as_str() {
            "midshift.link.v1.SessionRequest" => through::<link::SessionRequest, FromRobot>(bytes),
            "midshift.link.v1.SessionResponse" => through::<link::SessionResponse, ToRobot>(bytes),
            "midshift.link.v1.ReplayStatusRequest" => through::<link::ReplayStatusRequest, StatusReplay>(bytes),
            "midshift.link.v1.ReplayStatusResponse" => through::<link::ReplayStatusResponse, LaneAck>(bytes),
            // Services and agents work with these as they are.
            name => {
                let kind = pool().get_message_by_name(name).unwrap_or_else(|| panic!("{name} is gone"));
                let message = DynamicMessage::decode(kind, bytes).expect("a frame can be read");
                let unknown: Vec<_> = message.unknown_fields().collect();
                assert!(unknown.is_empty(), "{name} has lost {unknown:?}");
                message.encode_to_vec()
            }
        }
    }
}

fn collect(value: &Value, at: &str, parts: &mut BTreeSet<String>) {
    match value {
        Value::Object(fields) => {
            for (name, value) in fields {
                let at = format!("{at}.{name}");
                collect(value, &at, parts);
                parts.insert(at);
            }
        }
        Value::Array(items) => items.iter().for_each(|item| collect(item, at, parts)),
        Value::String(word) if word.bytes().all(|b| b.is_ascii_uppercase() || b == b'_') => {
            parts.insert(format!("{at}={word}"));
        }
        _ => {}
    }
}

/// A message by way of what services and agents work with.
fn through<M: Message + Default + Parse<T> + for<'a> From<&'a T>, T>(bytes: &[u8]) -> Vec<u8> {
    let read =
        parse::<T, M>(M::decode(bytes).expect("a frame can be read")).unwrap_or_else(|refusal| panic!("{refusal}"));
    M::from(&read).encode_to_vec()
}

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
    steer(&mut scene.room, 0, Way::Cut);
    scene.pass(120_000);
    steer(&mut scene.room, 0, Way::Open);
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
fn a_field_that_this_build_does_not_know_is_found_to_be_lost() {
    let mut bytes = link::ReplayStatusResponse::default().encode_to_vec();
    // Field 100, the number 1.
    bytes.extend([0xa0, 0x06, 0x01]);
    let frame = Frame { message: "midshift.link.v1.ReplayStatusResponse".to_owned(), bytes };
    assert_ne!(frame.again(), frame.bytes);
}
