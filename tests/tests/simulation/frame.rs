//! One message between a robot and a server as it was on the wire, with what it is made of.

use midshift_proto::convert::stop::{FromStop, ToStop};
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

/// One message of a call, as it was on the wire.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The full name of its message.
    pub message: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

impl Frame {
    /// As a line of text.
    pub fn line(&self) -> String {
        let mut line = format!("{} ", self.message);
        for byte in &self.bytes {
            write!(line, "{byte:02x}").expect("a text takes it");
        }
        line
    }

    /// From [`Frame::line`].
    pub fn parse(line: &str) -> Self {
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
    pub fn again(&self) -> Vec<u8> {
        let bytes = self.bytes.as_slice();
        match self.message.as_str() {
            "midshift.link.v1.SessionRequest" => through::<link::SessionRequest, FromRobot>(bytes),
            "midshift.link.v1.SessionResponse" => through::<link::SessionResponse, ToRobot>(bytes),
            "midshift.link.v1.ReplayStatusRequest" => through::<link::ReplayStatusRequest, StatusReplay>(bytes),
            "midshift.link.v1.ReplayStatusResponse" => through::<link::ReplayStatusResponse, LaneAck>(bytes),
            "midshift.stop.v1.AttendRequest" => through::<stop::AttendRequest, ToStop>(bytes),
            "midshift.stop.v1.AttendResponse" => {
                let read = stop::AttendResponse::decode(bytes).expect("a frame can be read");
                parse::<FromStop, _>(read.clone()).unwrap_or_else(|refusal| panic!("{refusal}"));
                read.encode_to_vec()
            }
            // Files and their pieces: services and agents work with these as they are.
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
