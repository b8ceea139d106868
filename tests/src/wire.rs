//! Frames of the link as text, one a line: who said it, the method, its bytes in hexadecimal.
//!
//! Invariant: nothing of a frame is understood here but which message it is and what it is made of.

use anyhow::{Context, bail, ensure};
use midshift_proto::json::pool;
use prost_reflect::{DynamicMessage, MessageDescriptor};
use serde_json::Value;
use std::collections::BTreeSet;
use std::fmt::Write;

/// One message of a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Path of the method, `/package.Service/Method`.
    pub path: String,
    /// A robot said it.
    pub is_up: bool,
    /// As it was on the wire.
    pub bytes: Vec<u8>,
}

impl Frame {
    /// The message that it is, in this build.
    ///
    /// # Errors
    /// If this build has no such method.
    pub fn message(&self) -> anyhow::Result<MessageDescriptor> {
        let (service, method) = self.path.trim_start_matches('/').split_once('/').context("a path has two parts")?;
        let service = pool().get_service_by_name(service).with_context(|| format!("no service {service}"))?;
        let method = service.methods().find(|m| m.name() == method).with_context(|| format!("no {}", self.path))?;
        Ok(if self.is_up { method.input() } else { method.output() })
    }
    /// What it is made of: each field that is there, and each word of an enum.
    ///
    /// # Errors
    /// If this build cannot read it.
    pub fn parts(&self) -> anyhow::Result<BTreeSet<String>> {
        let message = DynamicMessage::decode(self.message()?, self.bytes.as_slice())?;
        let mut parts = BTreeSet::new();
        collect(&serde_json::to_value(&message)?, "", &mut parts);
        Ok(parts)
    }
    /// A line.
    pub fn line(&self) -> String {
        let mut line = format!("{} {} ", if self.is_up { "up" } else { "down" }, self.path);
        for byte in &self.bytes {
            // Writing into a text cannot fail.
            let _ = write!(line, "{byte:02x}");
        }
        line
    }
    /// From [`Frame::line`].
    ///
    /// # Errors
    /// If it is none.
    pub fn parse(line: &str) -> anyhow::Result<Self> {
        let [way, path, hex] = line.split(' ').collect::<Vec<_>>()[..] else { bail!("{line} has not three words") };
        let is_up = match way {
            "up" => true,
            "down" => false,
            _ => bail!("{way} is no direction"),
        };
        ensure!(hex.len().is_multiple_of(2) && hex.is_ascii(), "half a byte in {line}");
        let bytes = (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16));
        Ok(Self { path: path.to_owned(), is_up, bytes: bytes.collect::<Result<_, _>>()? })
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

/// The first frame of each kind: what is made of nothing else than an earlier one of its message is left out.
///
/// # Errors
/// If this build cannot read one.
pub fn kinds(frames: &[Frame]) -> anyhow::Result<Vec<Frame>> {
    let mut seen = BTreeSet::new();
    let mut kept = Vec::new();
    for frame in frames {
        let key = (frame.path.clone(), frame.is_up, frame.parts()?);
        if seen.insert(key) {
            kept.push(frame.clone());
        }
    }
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::{Frame, kinds};

    fn metadata(bytes: &[u8]) -> Frame {
        let path = "/midshift.ota.v1.BundleService/GetMetadata".to_owned();
        Frame { path, is_up: true, bytes: bytes.to_vec() }
    }

    #[test]
    fn a_line_is_the_frame_again_and_half_a_byte_is_none() {
        let frame = metadata(&[0x0a, 0x01, b'x']);
        assert_eq!(frame.line(), "up /midshift.ota.v1.BundleService/GetMetadata 0a0178");
        assert_eq!(Frame::parse(&frame.line()).expect("a frame"), frame);
        for wrong in ["up /a/b 0a1", "aside /a/b 0a", "up /a/b", "up /a/b xy"] {
            assert!(Frame::parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn of_frames_that_are_made_of_the_same_the_first_is_kept() {
        let frames = [metadata(&[0x0a, 0x01, b'x']), metadata(&[]), metadata(&[0x0a, 0x01, b'y'])];
        assert_eq!(kinds(&frames).expect("they can be read"), frames[..2]);
        assert!(kinds(&[metadata(&[0xff])]).is_err());
    }
}
