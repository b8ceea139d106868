//! Why something is refused, waits or ended: the closed list of reasons, the closed set of error kinds, and violations.
//!
//! Invariant: every error a caller can see is one [`Kind`] and one [`Code`]; the only door to a gRPC status is in `midshift-proto`.

mod codes;

pub use codes::Code;

use crate::time::LinkDuration;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// Closed set of error kinds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Bad input; carries violations.
    Invalid,
    /// No such thing.
    NotFound,
    /// Same id, other body.
    AlreadyExists,
    /// The state of the world forbids it now.
    Precondition,
    /// A generation or etag moved.
    Conflict,
    /// A limit was reached; try later.
    Exhausted,
    /// Not now, nobody's fault; try later.
    Unavailable,
    /// Nobody knows who asks.
    Unauthenticated,
    /// Who asks may not.
    Denied,
    /// Too late.
    Deadline,
    /// Ours; the text is hidden.
    Internal,
}

/// A code, a sentence and the facts behind it. A code that this build does not know keeps its name in rows and on the wire.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "StoredReason", into = "StoredReason")]
pub struct Reason {
    /// The code; [`Code::Unknown`] for one of a newer version.
    pub code: Code,
    /// One plain sentence; empty means the code's help text.
    pub message: String,
    /// Ids, measured values, limits; at most 16.
    pub metadata: BTreeMap<String, String>,
    /// None: `code` names it.
    unknown: Option<Box<UnknownCode>>,
}

/// Name of a code that this build does not know. Boxed: nearly every reason is without one, and each refusal carries a reason.
#[derive(Clone, Debug, PartialEq, Eq)]
struct UnknownCode(String);

/// A reason as rows hold it.
#[derive(Serialize, Deserialize)]
struct StoredReason {
    code: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    message: String,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    metadata: BTreeMap<String, String>,
}

impl From<StoredReason> for Reason {
    fn from(stored: StoredReason) -> Self {
        Self { message: stored.message, metadata: stored.metadata, ..Self::named(&stored.code) }
    }
}

impl From<Reason> for StoredReason {
    fn from(reason: Reason) -> Self {
        Self { code: reason.name().to_owned(), message: reason.message, metadata: reason.metadata }
    }
}

impl From<Code> for Reason {
    fn from(code: Code) -> Self {
        Self { code, message: String::new(), metadata: BTreeMap::new(), unknown: None }
    }
}

impl Reason {
    /// With a sentence of its own.
    pub fn new(code: Code, message: impl Into<String>) -> Self {
        Self { message: message.into(), ..Self::from(code) }
    }
    /// With the code of this name; a name that this build does not know is kept.
    pub fn named(name: &str) -> Self {
        match name.parse::<Code>() {
            Ok(code) => code.into(),
            Err(()) => Self { unknown: Some(Box::new(UnknownCode(name.to_owned()))), ..Code::Unknown.into() },
        }
    }
    /// Name of the code as it was given: what is shown, stored and passed on.
    pub fn name(&self) -> &str {
        self.unknown.as_ref().map_or(self.code.as_str(), |unknown| &unknown.0)
    }
    /// Adds one fact.
    #[must_use]
    pub fn with(mut self, key: &str, value: impl fmt::Display) -> Self {
        self.metadata.insert(key.to_owned(), value.to_string());
        self
    }
    /// The sentence to show.
    pub fn text(&self) -> &str {
        if self.message.is_empty() { self.code.help() } else { &self.message }
    }
}

/// One broken rule of a request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Violation {
    /// Path into the request, e.g. `spec.steps[2].goto.waypoint`.
    pub field: String,
    /// The rule, as a person reads it.
    pub description: String,
}

/// Collects every violation of one request, so that a caller hears them all at once.
#[derive(Clone, Debug, Default)]
pub struct Violations(pub Vec<Violation>);

impl Violations {
    /// Notes one violation.
    pub fn add(&mut self, field: impl Into<String>, description: impl Into<String>) {
        self.0.push(Violation { field: field.into(), description: description.into() });
    }
    /// Takes the value of `result`, or notes the error under `field`.
    pub fn accept<T, E: fmt::Display>(&mut self, field: &str, result: Result<T, E>) -> Option<T> {
        result.map_err(|e| self.add(field, e.to_string())).ok()
    }
    /// `Ok` if nothing was noted.
    pub fn finish(self) -> Result<(), Refusal> {
        if self.0.is_empty() { Ok(()) } else { Err(Refusal::invalid(self.0)) }
    }
}

/// The answer to a caller that did not get what it asked for.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}: {}", reason.name(), reason.text())]
pub struct Refusal {
    /// Why not, with a code and its facts.
    pub reason: Reason,
    /// For [`Kind::Invalid`]: each broken rule.
    pub violations: Vec<Violation>,
    /// Not to be tried again sooner; none: as long as is usual for its kind.
    pub again_after: Option<LinkDuration>,
    kind: Kind,
}

impl Refusal {
    /// A refusal of `kind` for `reason`.
    pub fn new(kind: Kind, reason: impl Into<Reason>) -> Self {
        Self { reason: reason.into(), violations: Vec::new(), again_after: None, kind }
    }
    /// Not to be tried again sooner than this.
    #[must_use]
    pub fn again_after(self, again_after: LinkDuration) -> Self {
        Self { again_after: Some(again_after), ..self }
    }
    /// Bad input with all its violations.
    pub fn invalid(violations: Vec<Violation>) -> Self {
        let text = violations.iter().map(|v| format!("{}: {}", v.field, v.description)).collect::<Vec<_>>().join("; ");
        Self { violations, ..Self::new(Kind::Invalid, Reason::new(Code::InvalidRequest, text)) }
    }
    /// One violation.
    pub fn field(field: &str, description: impl Into<String>) -> Self {
        Self::invalid(vec![Violation { field: field.to_owned(), description: description.into() }])
    }
    /// The kind.
    pub fn kind(&self) -> Kind {
        self.kind
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_is_upper_snake_unique_and_helps() {
        let mut seen = std::collections::BTreeSet::new();
        for code in Code::ALL {
            assert!(code.as_str().chars().all(|c| c.is_ascii_uppercase() || c == '_'), "{code}");
            assert!(seen.insert(code.as_str()), "{code} twice");
            assert!(code.help().ends_with('.'), "{code}");
            assert_eq!(code.as_str().parse(), Ok(*code));
        }
    }

    #[test]
    fn every_answer_to_a_caller_says_what_to_try_next() {
        let reasons = [
            Code::RobotDraining,
            Code::RobotLoaded,
            Code::StopEngaged,
            Code::MessageTooLarge,
            Code::RowUnknown,
            Code::DecisionPutAside,
            Code::ShuttingDown,
            Code::WatchUnread,
        ];
        // The reasons why a robot does not get a task begin behind the answers.
        let answers = Code::ALL.iter().copied().take_while(|code| *code != Code::RobotPinnedElsewhere);
        for code in answers.chain(reasons) {
            assert!(!code.next_step().is_empty() && code.help().ends_with(code.next_step()), "{code}");
        }
    }

    #[test]
    fn every_reason_behind_a_closed_place_names_what_opens_it() {
        for code in [Code::PlaceOccupied, Code::PlaceQuarantined, Code::UncertainTooLong, Code::RobotDroppedIt] {
            assert!(code.next_step().contains("midshift zone clear PLACE"), "{code}");
        }
    }

    #[test]
    fn a_row_with_a_reason_of_a_newer_version_is_read_shown_and_written_back_whole() {
        let row = r#"{"code":"GRAVITY_LOST","message":"it floats","metadata":{"robot_id":"rbt-01"}}"#;
        let reason: Reason = serde_json::from_str(row).expect("a reason");
        assert_eq!((reason.code, reason.name(), reason.text()), (Code::Unknown, "GRAVITY_LOST", "it floats"));
        assert_eq!(serde_json::to_string(&reason).expect("a row"), row);
        assert_eq!(Refusal::new(Kind::Precondition, reason).to_string(), "GRAVITY_LOST: it floats");
    }
}
