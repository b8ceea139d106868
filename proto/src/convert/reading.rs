//! Reads parts of messages: what must be there, what may be absent, lists, identifiers, words and numbers, each violation by where it stands.

use super::enums::WireEnum;
use midshift_core::limits;
use midshift_core::reason::{Refusal, Violations};
use std::fmt;

/// Where in a message a reader stands. Costs nothing until a violation is written.
#[derive(Clone, Copy)]
pub struct At<'a> {
    above: Option<&'a At<'a>>,
    step: Step<'a>,
}

#[derive(Clone, Copy)]
enum Step<'a> {
    Name(&'a str),
    Index(usize),
}

impl<'a> At<'a> {
    /// The top: the message as a whole, or the field its caller calls it.
    pub const fn top(name: &'a str) -> Self {
        Self { above: None, step: Step::Name(name) }
    }
    /// A field of this.
    pub const fn field(&'a self, name: &'a str) -> At<'a> {
        At { above: Some(self), step: Step::Name(name) }
    }
    /// An item of this.
    pub const fn index(&'a self, index: usize) -> At<'a> {
        At { above: Some(self), step: Step::Index(index) }
    }
}

impl fmt::Display for At<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let above = self.above.map(ToString::to_string).unwrap_or_default();
        match self.step {
            Step::Name(name) if above.is_empty() => f.write_str(name),
            Step::Name(name) => write!(f, "{above}.{name}"),
            Step::Index(index) => write!(f, "{above}[{index}]"),
        }
    }
}

/// Reads a wire message as a core type. None if and only if something was added to `bad`.
pub trait Parse<T> {
    /// Reads it; `at` is where it stands in what the caller sent.
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<T>;
}

/// Reads a whole message, or says everything that is wrong with it.
pub fn parse<T, W: Parse<T>>(wire: W) -> Result<T, Refusal> {
    let mut bad = Violations::default();
    let value = wire.parse_at(At::top(""), &mut bad);
    bad.finish()?;
    value.ok_or_else(|| Refusal::field("", "cannot be read"))
}

/// Reads one field of a request that must be there, or says everything that is wrong with it.
pub fn parse_field<T, W: Parse<T>>(wire: Option<W>, name: &'static str) -> Result<T, Refusal> {
    let mut bad = Violations::default();
    let value = need(wire, At::top(name), &mut bad);
    bad.finish()?;
    value.ok_or_else(|| Refusal::field(name, "cannot be read"))
}

/// Reads one enum field of a request that must be there.
pub fn parse_word<T: WireEnum>(number: i32, name: &'static str) -> Result<T, Refusal> {
    let mut bad = Violations::default();
    let value = word(number, At::top(name), &mut bad);
    bad.finish()?;
    value.ok_or_else(|| Refusal::field(name, "cannot be read"))
}

/// Reads a sub-message that must be there.
pub(crate) fn need<T, W: Parse<T>>(wire: Option<W>, at: At<'_>, bad: &mut Violations) -> Option<T> {
    match wire {
        Some(wire) => wire.parse_at(at, bad),
        None => {
            bad.add(at.to_string(), "is required");
            None
        }
    }
}

/// Reads a sub-message that may be absent: the outer None means a violation.
pub(crate) fn maybe<T, W: Parse<T>>(wire: Option<W>, at: At<'_>, bad: &mut Violations) -> Option<Option<T>> {
    match wire {
        Some(wire) => wire.parse_at(at, bad).map(Some),
        None => Some(None),
    }
}

/// Reads a list; every bad item is named.
pub(crate) fn list<T, W: Parse<T>>(wire: Vec<W>, at: At<'_>, bad: &mut Violations) -> Option<Vec<T>> {
    let length = wire.len();
    let items: Vec<T> = wire.into_iter().enumerate().filter_map(|(i, w)| w.parse_at(at.index(i), bad)).collect();
    (items.len() == length).then_some(items)
}

/// Reads an identifier that must be there.
pub(crate) fn id<T, E: fmt::Display>(
    text: &str,
    parse: fn(&str) -> Result<T, E>,
    at: At<'_>,
    bad: &mut Violations,
) -> Option<T> {
    parse(text).map_err(|e| bad.add(at.to_string(), e.to_string())).ok()
}

/// Reads an identifier; empty means none. The outer None means a violation.
pub(crate) fn maybe_id<T, E: fmt::Display>(
    text: &str,
    parse: fn(&str) -> Result<T, E>,
    at: At<'_>,
    bad: &mut Violations,
) -> Option<Option<T>> {
    if text.is_empty() { Some(None) } else { id(text, parse, at, bad).map(Some) }
}

/// Reads an enum.
pub(crate) fn word<T: WireEnum>(number: i32, at: At<'_>, bad: &mut Violations) -> Option<T> {
    let value = T::from_wire(number);
    if value.is_none() {
        let text = if number == 0 {
            "UNSPECIFIED is not a value".to_owned()
        } else {
            format!("{number} is not a known value")
        };
        bad.add(at.to_string(), text);
    }
    value
}

/// Reads a number that starts at 1.
pub(crate) fn from_one(number: u64, at: At<'_>, bad: &mut Violations) -> Option<u64> {
    if number == 0 {
        bad.add(at.to_string(), "is required, from 1");
        return None;
    }
    counted(number, at, bad)
}

/// Reads a number that only ever counts up: one that leaves no room to count on is a defect or a lie.
pub(crate) fn counted(number: u64, at: At<'_>, bad: &mut Violations) -> Option<u64> {
    if number > limits::COUNTED_MAX {
        bad.add(at.to_string(), format!("must be at most {}", limits::COUNTED_MAX));
        return None;
    }
    Some(number)
}

/// Reads text that must be there and short.
pub(crate) fn text(value: String, max: usize, at: At<'_>, bad: &mut Violations) -> Option<String> {
    if value.is_empty() || value.len() > max {
        bad.add(at.to_string(), format!("is required, 1-{max} bytes"));
        return None;
    }
    if value.contains('\0') {
        bad.add(at.to_string(), "must not contain a zero byte");
        return None;
    }
    Some(value)
}

/// Reads permille.
pub(crate) fn permille(value: u32, at: At<'_>, bad: &mut Violations) -> Option<u16> {
    if value > 1000 {
        bad.add(at.to_string(), "must be 0..1000 permille");
        return None;
    }
    Some(value as u16)
}
