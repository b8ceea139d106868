//! Poses, reasons, faults, authority, sums, times and JSON objects.

use super::{At, Parse, WireEnum, from_one, need, word};
use crate::common::v1;
use midshift_core::authority::Authority;
use midshift_core::limits;
use midshift_core::reason::{Reason, Violation, Violations};
use midshift_core::robot::{Fault, Pose};
use midshift_core::robot_events::WorkStats;
use midshift_core::time::Utc;
use prost_types::value::Kind;
use prost_types::{Duration, ListValue, Struct, Timestamp};
use serde_json::{Map, Value};
use std::ops::RangeInclusive;

/// Longest text of a fault, bytes.
const FAULT_MESSAGE_BYTES: usize = 200;
/// Facts behind one reason.
const METADATA_MAX: usize = 16;
/// Bytes of an object's key in the path of a violation.
const KEY_SHOWN_BYTES: usize = 64;
/// Seconds that a timestamp may have: those of the years 1 to 9999.
const TIME_SECONDS: RangeInclusive<i64> = -62_135_596_800..=253_402_300_799;
/// Seconds that a duration may have: those of 10,000 years.
const DURATION_SECONDS: RangeInclusive<i64> = -315_576_000_000..=315_576_000_000;
/// A second has one more.
const NANOS_MAX: i32 = 999_999_999;
/// Integers beyond this lose digits in a double.
const EXACT: f64 = 9_007_199_254_740_992.0;

impl From<&Pose> for v1::Pose {
    fn from(pose: &Pose) -> Self {
        Self { x_mm: pose.x_mm, y_mm: pose.y_mm, theta_mrad: pose.theta_mrad }
    }
}

impl Parse<Pose> for v1::Pose {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Pose> {
        if !(-3142..=3142).contains(&self.theta_mrad) {
            bad.add(at.field("theta_mrad").to_string(), "must be -3142..3142");
            return None;
        }
        Some(Pose { x_mm: self.x_mm, y_mm: self.y_mm, theta_mrad: self.theta_mrad })
    }
}

impl From<&Reason> for v1::Reason {
    fn from(reason: &Reason) -> Self {
        Self { code: reason.name().to_owned(), message: reason.message.clone(), metadata: reason.metadata.clone() }
    }
}

/// A reason for people: the code's own sentence where it has no other.
pub fn shown(reason: &Reason) -> v1::Reason {
    v1::Reason { message: reason.text().to_owned(), ..v1::Reason::from(reason) }
}

impl Parse<Reason> for v1::Reason {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Reason> {
        if self.metadata.len() > METADATA_MAX {
            bad.add(at.field("metadata").to_string(), "must be at most 16 entries");
            return None;
        }
        let is_name = |c: u8| c.is_ascii_uppercase() || c.is_ascii_digit() || c == b'_';
        if !(1..=limits::CODE_BYTES_MAX).contains(&self.code.len()) || !self.code.bytes().all(is_name) {
            bad.add(at.field("code").to_string(), format!("must be 1-{} of [A-Z0-9_]", limits::CODE_BYTES_MAX));
            return None;
        }
        let mut reason = Reason::named(&self.code);
        (reason.message, reason.metadata) = (self.message, self.metadata);
        Some(reason)
    }
}

impl From<&Fault> for v1::Fault {
    fn from(fault: &Fault) -> Self {
        Self { code: fault.code, fault_class: fault.class.to_wire(), message: fault.message.clone() }
    }
}

impl Parse<Fault> for v1::Fault {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Fault> {
        let code = from_one(u64::from(self.code), at.field("code"), bad);
        let class = word(self.fault_class, at.field("fault_class"), bad);
        if self.message.len() > FAULT_MESSAGE_BYTES {
            bad.add(at.field("message").to_string(), "must be at most 200 bytes");
            return None;
        }
        Some(Fault { code: code? as u32, class: class?, message: self.message })
    }
}

impl From<&Authority> for v1::Authority {
    fn from(authority: &Authority) -> Self {
        Self { session_epoch: authority.session_epoch, hb: authority.hb, valid_ms: authority.valid_ms }
    }
}

impl Parse<Authority> for v1::Authority {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<Authority> {
        let session_epoch = from_one(self.session_epoch, at.field("session_epoch"), bad);
        let valid_ms = from_one(self.valid_ms, at.field("valid_ms"), bad);
        // 0 is no heartbeat that anybody sent: it is refused by the authority rule, not by the shape of the message.
        Some(Authority { session_epoch: session_epoch?, hb: self.hb, valid_ms: valid_ms? })
    }
}

impl From<&WorkStats> for v1::WorkStats {
    fn from(stats: &WorkStats) -> Self {
        Self {
            path_mm: stats.path_mm,
            loaded_path_mm: stats.loaded_path_mm,
            duration_ms: stats.duration_ms,
            energy_mwh: stats.energy_mwh,
            hottest_joint_decidegrees: stats.hottest_joint_decidegrees,
        }
    }
}

impl From<v1::WorkStats> for WorkStats {
    fn from(stats: v1::WorkStats) -> Self {
        Self {
            path_mm: stats.path_mm,
            loaded_path_mm: stats.loaded_path_mm,
            duration_ms: stats.duration_ms,
            energy_mwh: stats.energy_mwh,
            hottest_joint_decidegrees: stats.hottest_joint_decidegrees,
        }
    }
}

impl From<&Violation> for v1::FieldViolation {
    fn from(violation: &Violation) -> Self {
        Self { field: violation.field.clone(), description: violation.description.clone() }
    }
}

/// Reads UTC; absent: none. What is below a millisecond is cut off.
pub fn parse_time(wire: Option<&Timestamp>, at: At<'_>, bad: &mut Violations) -> Option<Utc> {
    let wire = wire?;
    if !TIME_SECONDS.contains(&wire.seconds) || !(0..=NANOS_MAX).contains(&wire.nanos) {
        bad.add(at.to_string(), format!("must be of the years 1 .. 9999, with nanos of 0 .. {NANOS_MAX}"));
        return None;
    }
    Some(time_of(wire))
}

/// Reads the milliseconds of a duration; absent: none. What is below one is cut off.
pub fn parse_ms(wire: Option<&Duration>, at: At<'_>, bad: &mut Violations) -> Option<i64> {
    let wire = wire?;
    let are_in_range = DURATION_SECONDS.contains(&wire.seconds) && (-NANOS_MAX..=NANOS_MAX).contains(&wire.nanos);
    if !are_in_range || wire.seconds.signum() * i64::from(wire.nanos.signum()) < 0 {
        bad.add(at.to_string(), format!("must be within 10000 years, with nanos of its sign up to {NANOS_MAX}"));
        return None;
    }
    Some(ms_of(wire))
}

/// UTC as the well-known type.
pub fn timestamp(utc: Utc) -> Timestamp {
    Timestamp { seconds: utc.0.div_euclid(1000), nanos: (utc.0.rem_euclid(1000) * 1_000_000) as i32 }
}

/// UTC from the well-known type, as it was answered; [`parse_time`] reads what was asked.
pub fn time_of(timestamp: &Timestamp) -> Utc {
    Utc(timestamp.seconds.saturating_mul(1000).saturating_add(i64::from(timestamp.nanos.div_euclid(1_000_000))))
}

/// Milliseconds of a duration, as it was answered; [`parse_ms`] reads what was asked.
pub fn ms_of(duration: &Duration) -> i64 {
    duration.seconds.saturating_mul(1000).saturating_add(i64::from(duration.nanos / 1_000_000))
}

/// A duration of milliseconds.
pub fn duration(ms: u64) -> Duration {
    Duration { seconds: (ms / 1000) as i64, nanos: ((ms % 1000) * 1_000_000) as i32 }
}

/// A JSON object as the well-known type. Numbers become doubles, as JSON readers elsewhere have them.
pub fn to_struct(map: &Map<String, Value>) -> Struct {
    Struct { fields: map.iter().map(|(k, v)| (k.clone(), to_value(v))).collect() }
}

fn to_value(value: &Value) -> prost_types::Value {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(b) => Kind::BoolValue(*b),
        Value::Number(n) => Kind::NumberValue(n.as_f64().unwrap_or(f64::NAN)),
        Value::String(s) => Kind::StringValue(s.clone()),
        Value::Array(items) => Kind::ListValue(ListValue { values: items.iter().map(to_value).collect() }),
        Value::Object(map) => Kind::StructValue(to_struct(map)),
    };
    prost_types::Value { kind: Some(kind) }
}

/// Reads a JSON object; absent: an empty one. A double without a fraction becomes an integer. The first value without a kind, and the first number
/// that JSON cannot say, is a violation.
pub(crate) fn from_struct(wire: Option<Struct>, at: At<'_>, bad: &mut Violations) -> Option<Map<String, Value>> {
    let fields = wire.unwrap_or_default().fields.into_iter();
    fields
        .map(|(key, value)| {
            let shown = &key[..key.floor_char_boundary(KEY_SHOWN_BYTES)];
            let value = from_value(value, at.field(shown), bad)?;
            Some((key, value))
        })
        .collect()
}

/// A value as JSON. None: it cannot be, which is noted.
pub(crate) fn from_value(wire: prost_types::Value, at: At<'_>, bad: &mut Violations) -> Option<Value> {
    Some(match wire.kind {
        None => {
            bad.add(at.to_string(), "is a value without a kind; null has one too");
            return None;
        }
        Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(b)) => Value::Bool(b),
        Some(Kind::NumberValue(n)) if !n.is_finite() => {
            bad.add(at.to_string(), format!("{n} is not a number of JSON"));
            return None;
        }
        Some(Kind::NumberValue(n)) if n.fract() == 0.0 && n.abs() < EXACT => Value::from(n as i64),
        Some(Kind::NumberValue(n)) => Value::from(n),
        Some(Kind::StringValue(s)) => Value::String(s),
        Some(Kind::ListValue(list)) => {
            let items = list.values.into_iter().enumerate();
            Value::Array(items.map(|(i, item)| from_value(item, at.index(i), bad)).collect::<Option<_>>()?)
        }
        Some(Kind::StructValue(map)) => Value::Object(from_struct(Some(map), at, bad)?),
    })
}

/// Reads an authority that must be there.
pub(crate) fn authority(wire: Option<v1::Authority>, at: At<'_>, bad: &mut Violations) -> Option<Authority> {
    need(wire, at, bad)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_time_reads_back(ms in -62_000_000_000_000i64..250_000_000_000_000) {
            prop_assert_eq!(time_of(&timestamp(Utc(ms))), Utc(ms));
        }

        #[test]
        fn a_duration_reads_back(ms in 0u64..1_000_000_000_000) {
            prop_assert_eq!(ms_of(&duration(ms)), ms as i64);
        }
    }

    #[test]
    fn a_time_that_is_none_is_refused() {
        let time = |seconds, nanos| Timestamp { seconds, nanos };
        for wire in [time(-62_135_596_800, 0), time(253_402_300_799, 999_999_999)] {
            let mut bad = Violations::default();
            assert_eq!(parse_time(Some(&wire), At::top("deadline"), &mut bad), Some(time_of(&wire)));
            assert_eq!(bad.finish(), Ok(()));
        }
        let years = [time(-62_135_596_801, 0), time(253_402_300_800, 0), time(i64::MAX, 0), time(i64::MIN, 0)];
        let nanos = [time(0, 1_000_000_000), time(0, -1), time(0, i32::MIN)];
        for wire in years.into_iter().chain(nanos) {
            let mut bad = Violations::default();
            assert_eq!(parse_time(Some(&wire), At::top("deadline"), &mut bad), None, "{wire:?}");
            assert_eq!(bad.0[0].field, "deadline");
        }
    }

    #[test]
    fn a_duration_that_is_none_is_refused() {
        let span = |seconds, nanos| Duration { seconds, nanos };
        let good = [
            (span(-1, -999_999_999), -1_999),
            (span(0, -1_000_000), -1),
            (span(315_576_000_000, 0), 315_576_000_000_000),
        ];
        for (wire, ms) in good {
            let mut bad = Violations::default();
            assert_eq!(parse_ms(Some(&wire), At::top("timeout"), &mut bad), Some(ms));
            assert_eq!(bad.finish(), Ok(()));
        }
        let seconds = [span(315_576_000_001, 0), span(i64::MAX, 0), span(i64::MIN, 0)];
        let nanos = [span(0, 1_000_000_000), span(0, i32::MIN), span(1, -1), span(-1, 1)];
        for wire in seconds.into_iter().chain(nanos) {
            let mut bad = Violations::default();
            assert_eq!(parse_ms(Some(&wire), At::top("timeout"), &mut bad), None, "{wire:?}");
            assert_eq!(bad.0[0].field, "timeout");
        }
    }

    #[test]
    fn a_json_object_reads_back() {
        let text = r#"{"a":[1,-2.5,null,true,{"b":"c"}],"item":"SKU-1","n":9007199254740991}"#;
        let Value::Object(map) = serde_json::from_str(text).expect("json") else { panic!("not an object") };
        let mut bad = Violations::default();
        assert_eq!(from_struct(Some(to_struct(&map)), At::top("params"), &mut bad), Some(map));
        assert_eq!(from_struct(None, At::top("params"), &mut bad), Some(Map::new()));
        assert_eq!(bad.finish(), Ok(()));
    }

    #[test]
    fn a_number_that_json_cannot_say_is_refused_by_its_path() {
        let value = |kind| prost_types::Value { kind: Some(kind) };
        let object = |key: &str, inner| Struct { fields: [(key.to_owned(), inner)].into() };
        for (number, shown) in [(f64::NAN, "NaN"), (f64::INFINITY, "inf"), (f64::NEG_INFINITY, "-inf")] {
            let values = vec![value(Kind::BoolValue(true)), value(Kind::NumberValue(number))];
            let list = object("weights", value(Kind::ListValue(ListValue { values })));
            let mut bad = Violations::default();
            let wire = object("é".repeat(40).as_str(), value(Kind::StructValue(list)));
            assert_eq!(from_struct(Some(wire), At::top("params"), &mut bad), None);
            let field = format!("params.{}.weights[1]", "é".repeat(32));
            let description = format!("{shown} is not a number of JSON");
            assert_eq!(bad.0, [Violation { field, description }]);
        }
    }

    #[test]
    fn a_value_without_a_kind_is_refused_by_its_path_and_null_is_read() {
        let null = prost_types::Value { kind: Some(Kind::NullValue(0)) };
        let read = |value: prost_types::Value| {
            let values = vec![null.clone(), value];
            let list = prost_types::Value { kind: Some(Kind::ListValue(ListValue { values })) };
            let mut bad = Violations::default();
            let object = Struct { fields: [("weights".to_owned(), list)].into() };
            let read = from_struct(Some(object), At::top("params"), &mut bad);
            (read.and_then(|mut map| map.remove("weights")), bad.0)
        };
        assert_eq!(read(null.clone()), (Some(Value::Array(vec![Value::Null, Value::Null])), Vec::new()));
        let (nothing, bad) = read(prost_types::Value { kind: None });
        assert_eq!(nothing, None);
        assert_eq!(bad.iter().map(|one| one.field.as_str()).collect::<Vec<_>>(), ["params.weights[1]"]);
    }
}
