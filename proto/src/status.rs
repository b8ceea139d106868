//! The one door from a refusal to a gRPC status, and back for callers.
//!
//! Invariant: no handler makes a status by hand. The text of an internal fault stays here; its request_id is shown instead.
//! Details travel in a header, so violations are cut at a size that every HTTP/2 peer takes; what is cut is counted.

use midshift_core::reason::{Code, Kind, Reason, Refusal, Violation};
use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::time::Duration;
use tonic::Status;
use tonic_types::{ErrorDetails, StatusExt};

/// `ErrorInfo.domain` of every error.
pub const DOMAIN: &str = "midshift";
/// When to try again after RESOURCE_EXHAUSTED and UNAVAILABLE: one heartbeat later.
pub const RETRY_AFTER: Duration = Duration::from_secs(1);
/// Bytes of violations in one status: base64 and all, well below the 16 KiB of headers that peers take by default.
const VIOLATION_BYTES_MAX: usize = 4 * 1024;
/// Bytes of the message, which is percent-encoded.
const MESSAGE_BYTES_MAX: usize = 1024;
/// What a caller hears of our own faults.
const INTERNAL_TEXT: &str = Code::Internal.help();

const fn grpc_code(kind: Kind, code: Code) -> tonic::Code {
    match (kind, code) {
        (_, Code::CursorExpired) => tonic::Code::OutOfRange,
        (Kind::Invalid, _) => tonic::Code::InvalidArgument,
        (Kind::NotFound, _) => tonic::Code::NotFound,
        (Kind::AlreadyExists, _) => tonic::Code::AlreadyExists,
        (Kind::Precondition, _) => tonic::Code::FailedPrecondition,
        (Kind::Conflict, _) => tonic::Code::Aborted,
        (Kind::Exhausted, _) => tonic::Code::ResourceExhausted,
        (Kind::Unavailable, _) => tonic::Code::Unavailable,
        (Kind::Unauthenticated, _) => tonic::Code::Unauthenticated,
        (Kind::Denied, _) => tonic::Code::PermissionDenied,
        (Kind::Deadline, _) => tonic::Code::DeadlineExceeded,
        (Kind::Internal, _) => tonic::Code::Internal,
    }
}

/// A refusal as a status with details. `request_id` is the caller's, or one the server drew; none: not shown.
pub fn status(refusal: &Refusal, request_id: Option<&str>) -> Status {
    let kind = refusal.kind();
    let reason = &refusal.reason;
    let hidden = kind == Kind::Internal;
    let metadata: HashMap<String, String> =
        if hidden { HashMap::new() } else { reason.metadata.iter().map(|(k, v)| (k.clone(), v.clone())).collect() };
    let mut details = ErrorDetails::with_error_info(reason.name(), DOMAIN, metadata);
    let text = if hidden { INTERNAL_TEXT } else { reason.text() };
    match kind {
        Kind::Invalid => {
            for violation in shortened(&refusal.violations) {
                details.add_bad_request_violation(violation.field, violation.description);
            }
        }
        Kind::Precondition => {
            details.add_precondition_failure_violation(reason.name(), subject(&reason.metadata), cut(text));
        }
        Kind::Exhausted | Kind::Unavailable => {
            let own = refusal.again_after.map(|after| Duration::from_millis(after.as_ms()));
            // The same message is as large the next time.
            if reason.code != Code::MessageTooLarge {
                details.set_retry_info(Some(own.unwrap_or(RETRY_AFTER)));
            }
        }
        _ => {}
    }
    if let Some(request_id) = request_id.filter(|id| !id.is_empty()) {
        details.set_request_info(request_id, "");
    }
    Status::with_error_details(grpc_code(kind, reason.code), cut(text), details)
}

/// What a precondition is about: the most telling id among the facts.
fn subject(metadata: &BTreeMap<String, String>) -> String {
    let keys = ["task_id", "robot_id", "place_id", "area_id"];
    keys.iter().find_map(|key| metadata.get(*key)).cloned().unwrap_or_default()
}

/// The refusal of a message with more bytes than a port takes, as it is or decompressed; none: the status is about something else.
pub fn too_large(status: &Status) -> Option<Refusal> {
    let told = status.message();
    let mut numbers = told.split(|c: char| !c.is_ascii_digit()).filter(|word| !word.is_empty());
    let mut next = || numbers.next().unwrap_or("some");
    let text = match status.code() {
        tonic::Code::OutOfRange if told.contains("message length too large") => {
            format!("the message has {} bytes; at most {} are taken", next(), next())
        }
        tonic::Code::ResourceExhausted if told.contains("exceeded while decompressing") => {
            format!("the message has more than {} bytes once it is decompressed; no more are taken", next())
        }
        _ => return None,
    };
    Some(Refusal::new(Kind::Exhausted, Reason::new(Code::MessageTooLarge, text)))
}

/// The refusal of a message of a stream that cannot be read: it is too large, or its bytes are no message. None: the stream itself broke.
pub fn unreadable(status: &Status) -> Option<Refusal> {
    too_large(status).or_else(|| {
        // What a connection says of its end has a source; what a decoder says has none.
        let is_decoders = status.code() == tonic::Code::Internal && status.source().is_none();
        let text = || format!("a message cannot be read: {}", status.message());
        is_decoders.then(|| Refusal::new(Kind::Invalid, Reason::new(Code::ProtocolError, text())))
    })
}

/// The first bytes of a text, at most [`MESSAGE_BYTES_MAX`].
fn cut(text: &str) -> String {
    if text.len() <= MESSAGE_BYTES_MAX {
        return text.to_owned();
    }
    format!("{} …", &text[..text.floor_char_boundary(MESSAGE_BYTES_MAX)])
}

/// As many violations as fit, and the count of the others.
fn shortened(violations: &[Violation]) -> Vec<Violation> {
    let mut bytes = 0;
    let fits = violations.iter().take_while(|v| {
        bytes += v.field.len() + v.description.len() + 8;
        bytes <= VIOLATION_BYTES_MAX
    });
    let mut shown: Vec<Violation> = fits.cloned().collect();
    if shown.len() < violations.len() {
        let more = violations.len() - shown.len();
        shown.push(Violation { field: String::new(), description: format!("and {more} more") });
    }
    shown
}

/// What a status said, for a person or a program at the other end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Answer {
    /// gRPC's own code.
    pub grpc: tonic::Code,
    /// The reason, if the server is ours and this build knows it.
    pub code: Option<Code>,
    /// The reason as it was sent; empty: not ours.
    pub reason: String,
    /// The sentence.
    pub message: String,
    /// Facts behind it.
    pub metadata: BTreeMap<String, String>,
    /// Broken rules.
    pub violations: Vec<Violation>,
    /// To find it in the server's log; empty: not said.
    pub request_id: String,
    /// Do not try again sooner.
    pub retry_after: Option<Duration>,
}

/// Reads a status. Never fails: what is not there is empty.
pub fn refusal_of(status: &Status) -> Answer {
    let details = status.get_error_details();
    let info = details.error_info().filter(|info| info.domain == DOMAIN);
    let reason = info.map(|info| info.reason.clone()).unwrap_or_default();
    let violations = details.bad_request().map(|bad| bad.field_violations.as_slice()).unwrap_or_default();
    Answer {
        grpc: status.code(),
        code: reason.parse().ok(),
        reason,
        message: status.message().to_owned(),
        metadata: info.map(|info| info.metadata.clone().into_iter().collect()).unwrap_or_default(),
        violations: violations
            .iter()
            .map(|v| Violation { field: v.field.clone(), description: v.description.clone() })
            .collect(),
        request_id: details.request_info().map(|r| r.request_id.clone()).unwrap_or_default(),
        retry_after: details.retry_info().and_then(|r| r.retry_delay),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::reason::Reason;
    use midshift_core::time::LinkDuration;

    #[test]
    fn a_caller_reads_what_the_server_refused() {
        let reason = Reason::new(Code::RobotCordoned, "rbt-01 is cordoned").with("robot_id", "rbt-01");
        let status = status(&Refusal::new(Kind::Precondition, reason), Some("r1"));
        let answer = refusal_of(&status);
        assert_eq!(answer.grpc, tonic::Code::FailedPrecondition);
        assert_eq!((answer.code, answer.request_id.as_str()), (Some(Code::RobotCordoned), "r1"));
        assert_eq!(answer.metadata.get("robot_id").map(String::as_str), Some("rbt-01"));
        let details = status.get_error_details();
        let failure = details.precondition_failure().expect("a precondition failure");
        assert_eq!(
            (failure.violations[0].r#type.as_str(), failure.violations[0].subject.as_str()),
            ("ROBOT_CORDONED", "rbt-01")
        );
    }

    #[test]
    fn bytes_that_are_no_message_are_refused_and_a_stream_that_broke_is_none_of_them() {
        let refusal = unreadable(&Status::internal("invalid wire type")).expect("a decoder says so");
        assert_eq!((refusal.kind(), refusal.reason.code), (Kind::Invalid, Code::ProtocolError));
        assert_eq!(refusal.reason.text(), "a message cannot be read: invalid wire type");
        let broken: Box<dyn Error + Send + Sync> = std::io::Error::other("reset").into();
        assert!(unreadable(&Status::from_error(broken)).is_none());
        assert!(unreadable(&Status::cancelled("gone")).is_none());
    }

    #[test]
    fn every_violation_reaches_the_caller() {
        let violations = vec![
            Violation { field: "spec.type".into(), description: "is required".into() },
            Violation { field: "spec.timeout".into(), description: "is required".into() },
        ];
        let answer = refusal_of(&status(&Refusal::invalid(violations.clone()), None));
        assert_eq!((answer.grpc, answer.violations), (tonic::Code::InvalidArgument, violations));
    }

    #[test]
    fn a_flood_of_violations_still_fits_into_a_header_and_says_how_many_are_left_out() {
        let rule = "must be 1-64 of [A-Za-z0-9-_.]";
        let violations: Vec<_> = (0..1000)
            .map(|i| Violation { field: format!("spec.steps[{i}].goto.waypoint"), description: rule.into() })
            .collect();
        let status = status(&Refusal::invalid(violations), Some("r1"));
        assert!(status.details().len() < 6 * 1024 && status.message().len() < 2 * 1024);
        let answer = refusal_of(&status);
        let last = answer.violations.last().expect("violations");
        assert_eq!(last.description, format!("and {} more", 1000 - (answer.violations.len() - 1)));
    }

    #[test]
    fn an_internal_fault_hides_its_text_and_shows_the_request_id() {
        let reason = Reason::new(Code::Internal, "disk /dev/sda1 is gone").with("path", "/srv/control.db");
        let answer = refusal_of(&status(&Refusal::new(Kind::Internal, reason), Some("r-77")));
        assert!(!answer.message.contains("sda1") && answer.metadata.is_empty());
        assert_eq!((answer.grpc, answer.request_id.as_str()), (tonic::Code::Internal, "r-77"));
    }

    #[test]
    fn a_limit_says_when_to_try_again_and_an_old_cursor_is_out_of_range() {
        let answer = refusal_of(&status(&Refusal::new(Kind::Exhausted, Code::Overloaded), None));
        assert_eq!((answer.grpc, answer.retry_after), (tonic::Code::ResourceExhausted, Some(RETRY_AFTER)));
        let answer = refusal_of(&status(&Refusal::new(Kind::Precondition, Code::CursorExpired), None));
        assert_eq!((answer.grpc, answer.code), (tonic::Code::OutOfRange, Some(Code::CursorExpired)));
    }

    #[test]
    fn a_refusal_that_names_a_time_of_its_own_is_told_with_it() {
        let later = Refusal::new(Kind::Exhausted, Code::Overloaded).again_after(LinkDuration(1_700));
        assert_eq!(refusal_of(&status(&later, None)).retry_after, Some(Duration::from_millis(1_700)));
    }

    #[test]
    fn a_status_of_another_program_reads_as_its_code_and_text() {
        let answer = refusal_of(&Status::unavailable("connection refused"));
        assert_eq!(
            (answer.grpc, answer.code, answer.message.as_str()),
            (tonic::Code::Unavailable, None, "connection refused")
        );
    }
}
