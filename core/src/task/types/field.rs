//! Fields of a task type: which values each takes, with unit and bounds.
//!
//! Invariant: a default and a value that was sent are read by the same rule, so that a default is a value somebody could send.

use super::super::raw::name_ok;
use crate::ids::WaypointId;
use crate::limits;
use crate::reason::Violations;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeSet;
use std::fmt;

/// One field of a task type.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TypeField {
    /// As a task names it: 1-64 of [a-z0-9-_].
    pub name: String,
    /// What it is for, as a sentence, 1-256 bytes.
    pub description: String,
    /// Which values it takes.
    pub kind: FieldKind,
    /// What holds where a task says nothing. None: a task must say it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default: Option<Value>,
}

/// Which values a field takes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FieldKind {
    /// The name of a waypoint of the site.
    Waypoint,
    /// A whole number.
    Integer {
        /// The least that is taken.
        least: i64,
        /// The most that is taken.
        most: i64,
        /// As people write it, such as `mm`. Empty: it counts.
        unit: String,
    },
    /// A number.
    Number {
        /// The least that is taken.
        least: f64,
        /// The most that is taken.
        most: f64,
        /// As people write it, such as `kg`. Empty: a plain number.
        unit: String,
    },
    /// Text of some length.
    Text {
        /// At most so many bytes.
        max_bytes: u32,
    },
    /// One of a few words.
    Choice {
        /// The words, each once.
        choices: Vec<String>,
    },
}

/// The rule of a value, as a person reads it after `must be`.
impl fmt::Display for FieldKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let space = |unit: &str| if unit.is_empty() { "" } else { " " };
        match self {
            Self::Waypoint => f.write_str("a waypoint of the site"),
            Self::Integer { least, most, unit } => {
                write!(f, "a whole number, {least}..{most}{}{unit}", space(unit))
            }
            Self::Number { least, most, unit } => write!(f, "a number, {least}..{most}{}{unit}", space(unit)),
            Self::Text { max_bytes } => write!(f, "text of at most {max_bytes} bytes"),
            Self::Choice { choices } => write!(f, "one of {}", choices.join(", ")),
        }
    }
}

impl FieldKind {
    /// Reads a value as this field takes it. A number may be written as text, as command lines and CSV do. `knows` answers
    /// whether the site has a waypoint.
    ///
    /// # Errors
    /// The rule that the value breaks, as a person reads it.
    pub fn read(&self, value: &Value, knows: &dyn Fn(&WaypointId) -> bool) -> Result<Value, String> {
        let broken = || format!("must be {self}");
        match self {
            Self::Waypoint => {
                let name = value.as_str().ok_or_else(broken)?;
                let waypoint = WaypointId::parse(name).map_err(|e| e.to_string())?;
                if !knows(&waypoint) {
                    return Err(format!("the site has no waypoint {waypoint}"));
                }
                Ok(Value::from(name))
            }
            Self::Integer { least, most, .. } => {
                let number = value.as_i64().or_else(|| value.as_str()?.parse().ok()).ok_or_else(broken)?;
                if (*least..=*most).contains(&number) { Ok(Value::from(number)) } else { Err(broken()) }
            }
            Self::Number { least, most, .. } => {
                let number = value.as_f64().or_else(|| value.as_str()?.parse().ok()).ok_or_else(broken)?;
                if (*least..=*most).contains(&number) { Ok(shortest(number)) } else { Err(broken()) }
            }
            Self::Text { max_bytes } => {
                let text = value.as_str().ok_or_else(broken)?;
                if text.contains('\0') {
                    return Err("must not contain a zero byte".to_owned());
                }
                if text.len() <= *max_bytes as usize { Ok(Value::from(text)) } else { Err(broken()) }
            }
            Self::Choice { choices } => {
                let word = value.as_str().filter(|word| choices.iter().any(|c| c == word));
                word.map(Value::from).ok_or_else(broken)
            }
        }
    }

    /// Milliseconds of a time that this field counts; none: it counts no time.
    pub fn unit_ms(&self) -> Option<i64> {
        match self {
            Self::Integer { unit, .. } if unit == "ms" => Some(1),
            Self::Integer { unit, .. } if unit == "s" => Some(1_000),
            _ => None,
        }
    }

    fn check(&self, at: &str, bad: &mut Violations) {
        match self {
            Self::Waypoint => {}
            Self::Integer { least, most, unit } => {
                let fits = |bound: &i64| (-limits::TYPE_INTEGER_MAX..=limits::TYPE_INTEGER_MAX).contains(bound);
                if !fits(least) || !fits(most) || least > most {
                    bad.add(format!("{at}.integer"), "must have least and most in order, within 2^53 of zero");
                }
                check_unit(unit, &format!("{at}.integer.unit"), bad);
            }
            Self::Number { least, most, unit } => {
                if !(least.is_finite() && most.is_finite() && least <= most) {
                    bad.add(format!("{at}.number"), "must have least and most in order, both finite");
                }
                check_unit(unit, &format!("{at}.number.unit"), bad);
            }
            Self::Text { max_bytes } => {
                if !(1..=limits::TYPE_TEXT_BYTES_MAX).contains(max_bytes) {
                    bad.add(format!("{at}.text.max_bytes"), "must be 1..1024");
                }
            }
            Self::Choice { choices } => {
                if !(1..=limits::TYPE_CHOICES_MAX).contains(&choices.len()) {
                    bad.add(format!("{at}.choice.choices"), "must be 1..32 words");
                }
                let mut seen = BTreeSet::new();
                for (i, choice) in choices.iter().enumerate() {
                    if !is_word(choice, 64) {
                        bad.add(format!("{at}.choice.choices[{i}]"), "must be 1-64 bytes without control characters");
                    } else if !seen.insert(choice) {
                        bad.add(format!("{at}.choice.choices[{i}]"), "stands there twice");
                    }
                }
            }
        }
    }
}

impl TypeField {
    /// Notes every rule that the field breaks, under `at`.
    pub fn check(&self, at: &str, knows: &dyn Fn(&WaypointId) -> bool, bad: &mut Violations) {
        let before = bad.0.len();
        if !name_ok(&self.name) {
            bad.add(format!("{at}.name"), "must be 1-64 of [a-z0-9-_]");
        }
        check_sentence(&self.description, &format!("{at}.description"), bad);
        self.kind.check(at, bad);
        if let Some(default) = self.default.as_ref().filter(|_| bad.0.len() == before) {
            bad.accept(&format!("{at}.default"), self.kind.read(default, knows));
        }
    }
}

/// Notes that a sentence for people is missing or too long.
pub(super) fn check_sentence(text: &str, at: &str, bad: &mut Violations) {
    if !is_word(text, limits::REASON_BYTES_MAX) {
        bad.add(at, "must be a sentence for people, 1-256 bytes without control characters");
    }
}

fn check_unit(unit: &str, at: &str, bad: &mut Violations) {
    if !unit.is_empty() && !is_word(unit, limits::TYPE_UNIT_BYTES_MAX) {
        bad.add(at, "must be at most 16 bytes without control characters");
    }
}

fn is_word(text: &str, max: usize) -> bool {
    (1..=max).contains(&text.len()) && !text.chars().any(char::is_control)
}

/// A number as JSON: a whole one without a fraction, as every number that comes over the wire.
fn shortest(number: f64) -> Value {
    let whole = number as i64;
    if whole as f64 == number && whole.abs() < limits::TYPE_INTEGER_MAX {
        Value::from(whole)
    } else {
        Value::from(number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn read(kind: &FieldKind, value: Value) -> Result<Value, String> {
        kind.read(&value, &|waypoint| waypoint.as_str() == "A01")
    }

    #[test]
    fn a_value_is_taken_within_its_bounds_and_refused_with_its_rule_and_unit() {
        let height = FieldKind::Integer { least: 0, most: 2_000, unit: "mm".into() };
        for (value, taken) in [(json!(0), 0), (json!(2_000), 2_000), (json!("1200"), 1_200)] {
            assert_eq!(read(&height, value), Ok(json!(taken)));
        }
        for value in [json!(-1), json!(2_001), json!(0.5), json!("tall"), json!(true), json!(null), json!([1])] {
            assert_eq!(read(&height, value), Err("must be a whole number, 0..2000 mm".to_owned()));
        }
        let load = FieldKind::Number { least: 0.5, most: 20.0, unit: "kg".into() };
        assert_eq!(read(&load, json!("1.5")), Ok(json!(1.5)));
        assert_eq!(read(&load, json!("2.0")), Ok(json!(2)));
        for value in [json!(0.4), json!(21), json!("NaN"), json!("inf"), json!({})] {
            assert_eq!(read(&load, value), Err("must be a number, 0.5..20 kg".to_owned()));
        }
        let count = FieldKind::Integer { least: 1, most: 9, unit: String::new() };
        assert_eq!(read(&count, json!(0)), Err("must be a whole number, 1..9".to_owned()));
    }

    #[test]
    fn text_words_and_waypoints_are_taken_as_text_alone() {
        let note = FieldKind::Text { max_bytes: 3 };
        assert_eq!(read(&note, json!("")), Ok(json!("")));
        assert_eq!(read(&note, json!(12)), Err("must be text of at most 3 bytes".to_owned()));
        assert_eq!(read(&note, json!("four")), Err("must be text of at most 3 bytes".to_owned()));
        assert_eq!(read(&note, json!("a\0")), Err("must not contain a zero byte".to_owned()));
        let side = FieldKind::Choice { choices: vec!["left".into(), "right".into()] };
        assert_eq!(read(&side, json!("left")), Ok(json!("left")));
        assert_eq!(read(&side, json!("up")), Err("must be one of left, right".to_owned()));
        assert_eq!(read(&FieldKind::Waypoint, json!("A01")), Ok(json!("A01")));
        assert_eq!(read(&FieldKind::Waypoint, json!("A99")), Err("the site has no waypoint A99".to_owned()));
        assert_eq!(read(&FieldKind::Waypoint, json!(1)), Err("must be a waypoint of the site".to_owned()));
    }

    #[test]
    fn every_broken_rule_of_a_field_is_told() {
        let field = |kind| TypeField { name: "f".into(), description: "A field.".into(), kind, default: None };
        let told = |field: &TypeField| {
            let mut bad = Violations::default();
            field.check("f", &|_| false, &mut bad);
            bad.0.into_iter().map(|v| v.field).collect::<Vec<_>>()
        };
        let long = "x".repeat(257);
        let integer = |least, most| field(FieldKind::Integer { least, most, unit: "seventeen letters".into() });
        assert_eq!(told(&integer(1, 0)), ["f.integer", "f.integer.unit"]);
        assert_eq!(told(&integer(0, i64::MAX)), ["f.integer", "f.integer.unit"]);
        let number = |least, most| field(FieldKind::Number { least, most, unit: "\n".into() });
        assert_eq!(told(&number(f64::NAN, 1.0)), ["f.number", "f.number.unit"]);
        for max_bytes in [0, 1_025] {
            assert_eq!(told(&field(FieldKind::Text { max_bytes })), ["f.text.max_bytes"]);
        }
        let choice =
            |choices: &[&str]| field(FieldKind::Choice { choices: choices.iter().map(ToString::to_string).collect() });
        assert_eq!(told(&choice(&[])), ["f.choice.choices"]);
        assert_eq!(told(&choice(&["a", "", "a"])), ["f.choice.choices[1]", "f.choice.choices[2]"]);
        assert_eq!(told(&choice(&["a"; 33])).len(), 33);
        let unnamed = TypeField { name: "No".into(), description: long, ..field(FieldKind::Waypoint) };
        assert_eq!(told(&unnamed), ["f.name", "f.description"]);
        let elsewhere = TypeField { default: Some(json!("A99")), ..field(FieldKind::Waypoint) };
        assert_eq!(told(&elsewhere), ["f.default"], "a default must be a value that somebody could send");
    }
}
