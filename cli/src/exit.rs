//! Ends that are not success: what an error means for a person, and its exit code.

use crate::contexts::Unknown;
use crate::out::Out;
use midshift_bundle::build;
use midshift_bundle::folder::Error;
use midshift_core::reason::{self, Kind, Refusal};
use std::io::ErrorKind;
use std::process::ExitCode;
use tonic::{Code, Status};

/// Exit code of a server that is not there.
pub const NO_SERVER: u8 = 5;
/// Exit code of what nobody reads any more, as of a program that SIGPIPE has ended.
const UNREAD: u8 = 141;

/// What a server says to a call that it does not know.
const NOT_THERE: &str = "this server does not know the call\n  try: look at the port: stops are at 7421, everything else is at 7420. Faults and worlds are with `midshift dev` or \
     `midshift sim run --listen`; for anything else look at the server's version";

/// What is said of a server that takes a call and does not answer.
const LATE: &str = "the server took the connection and has not answered in time\n  try: look at that process: it may hang, or be no midshift at all. What was asked may have been done: ask \
     again with the same --request-id";

/// What a connection says that ended before anything was answered.
const BROKE_OFF: &str = "the server broke the connection off before it answered\n  try: sign in, if it speaks TLS: midshift login SERVER --pin DIGEST, with the \
     digest that it printed at its first start";

/// An end that is not success.
#[derive(Debug)]
pub struct Exit {
    code: u8,
    text: String,
    remedy: Remedy,
}

/// What a program may do about an end that is not success.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Remedy {
    /// Nothing: a person must.
    None,
    /// The same again later.
    Later,
    /// The same from the beginning: the server does not know any more where it was.
    Anew,
}

impl Exit {
    /// With a code of the list in docs/cli.md.
    pub fn new(code: u8, text: impl Into<String>) -> Self {
        let remedy = if code == NO_SERVER { Remedy::Later } else { Remedy::None };
        Self { code, text: text.into(), remedy }
    }
    /// What was heard cannot be written. If nobody reads any more there is nobody to tell either, and the end is that
    /// of a program that wrote into a closed pipe.
    pub fn unwritten(why: ErrorKind) -> Self {
        match why {
            ErrorKind::BrokenPipe => Self::new(UNREAD, ""),
            other => Self::new(1, format!("writing what was heard: {other}")),
        }
    }
    /// The server does not know the place any more from which it was to go on.
    pub fn is_of_a_lost_place(&self) -> bool {
        self.remedy == Remedy::Anew
    }
    /// Whether the same may be done again later.
    pub fn may_pass(&self) -> bool {
        self.remedy == Remedy::Later
    }
    /// Bad arguments.
    pub fn usage(text: impl Into<String>) -> Self {
        Self::new(2, text)
    }
    /// The code.
    pub fn code(&self) -> u8 {
        self.code
    }
    /// The same end with the facts that the server sent beside its sentence: which roll-out, how many robots for which
    /// reason.
    pub fn with_facts(status: Status) -> Self {
        let facts = midshift_proto::refusal_of(&status).metadata;
        let mut exit = Self::from(status);
        let told: String = facts.iter().map(|(key, value)| format!("\n  {key}: {value}")).collect();
        let at = exit.text.find("\n  try: ").unwrap_or(exit.text.len());
        exit.text.insert_str(at, &told);
        exit
    }
    /// The same end with one more thing to try.
    pub fn or_try(mut self, what: &str) -> Self {
        self.text += &format!("\n  try: {what}");
        self
    }
    /// What was looked at does not hold: a finding, not a mistake of the caller.
    pub fn of_finding(error: Error) -> Self {
        match error {
            Error::Refused(refusal) | Error::Bundle(build::Error::Refused(refusal)) => {
                let lines = refusal.violations.iter().map(|v| format!("\n  {}: {}", v.field, v.description));
                Self::new(1, format!("it does not hold:{}", lines.collect::<String>()))
            }
            other => other.into(),
        }
    }
    /// Says why and gives the code.
    pub fn report(&self, out: &Out) -> ExitCode {
        if self.code != UNREAD {
            out.inform(&format!("error: {}", self.text));
        }
        ExitCode::from(self.code)
    }
}

/// What was asked breaks rules, or could not be done.
impl From<Error> for Exit {
    fn from(error: Error) -> Self {
        match error {
            Error::Refused(refusal) | Error::Bundle(build::Error::Refused(refusal)) => {
                anyhow::Error::from(refusal).into()
            }
            other => Self::new(1, other.to_string()),
        }
    }
}

impl From<Unknown> for Exit {
    fn from(Unknown(name): Unknown) -> Self {
        Self::new(4, format!("no context {name}\n  try: midshift context ls, or midshift login"))
    }
}

impl std::fmt::Display for Exit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.text)
    }
}

impl From<anyhow::Error> for Exit {
    fn from(error: anyhow::Error) -> Self {
        if let Some(refusal) = error.downcast_ref::<Refusal>().filter(|r| r.kind() == Kind::Invalid) {
            let violations = refusal.violations.iter().map(|v| (v.field.as_str(), v.description.as_str()));
            return Self::new(2, broken_rules(violations).unwrap_or_else(|| refusal.to_string()));
        }
        match error.downcast::<Status>() {
            Ok(status) => status.into(),
            Err(error) => Self::new(1, format!("{error:#}")),
        }
    }
}

/// Each rule that a request breaks, on a line of its own; none of none.
fn broken_rules<'a>(violations: impl ExactSizeIterator<Item = (&'a str, &'a str)>) -> Option<String> {
    let headline = match violations.len() {
        0 => return None,
        1 => "the request breaks a rule".to_owned(),
        rules => format!("the request breaks {rules} rules"),
    };
    Some(violations.fold(headline, |text, (field, description)| format!("{text}\n  {field}: {description}")))
}

impl From<Status> for Exit {
    fn from(status: Status) -> Self {
        let answer = midshift_proto::refusal_of(&status);
        let code = match status.code() {
            Code::InvalidArgument | Code::OutOfRange => 2,
            Code::NotFound => 4,
            Code::Unavailable | Code::Unimplemented => NO_SERVER,
            Code::PermissionDenied | Code::Unauthenticated => 6,
            Code::Aborted | Code::AlreadyExists | Code::FailedPrecondition => 9,
            Code::DeadlineExceeded => 10,
            _ if is_late(&status) => 10,
            _ if has_broken_off(&status) => NO_SERVER,
            _ => 1,
        };
        let violations = answer.violations.iter().map(|v| (v.field.as_str(), v.description.as_str()));
        let mut text = broken_rules(violations).unwrap_or_else(|| match status.message() {
            _ if status.code() == Code::Unimplemented => NOT_THERE.to_owned(),
            _ if is_late(&status) => LATE.to_owned(),
            _ if has_broken_off(&status) => BROKE_OFF.to_owned(),
            "" => status.code().to_string(),
            message => message.to_owned(),
        });
        // A broken rule says by itself what to mend.
        let next_step = answer.code.filter(|_| answer.violations.is_empty()).map_or("", reason::Code::next_step);
        // The help of a code ends with it.
        let told = text.strip_suffix(next_step).unwrap_or(&text).trim_end().len();
        text.truncate(told);
        if answer.code == Some(reason::Code::Internal) && !answer.request_id.is_empty() {
            text += &format!("\n  request_id: {}", answer.request_id);
        }
        if !next_step.is_empty() {
            text += &format!("\n  try: {next_step}");
        }
        let remedy = match answer.code {
            Some(reason::Code::CursorExpired | reason::Code::CursorOfOtherStore) => Remedy::Anew,
            _ if was_cut(&status) || status.code() == Code::ResourceExhausted => Remedy::Later,
            _ => Remedy::None,
        };
        Self { code, text, remedy }
    }
}

/// The server took the call and has not answered: the deadline was this program's own.
fn is_late(status: &Status) -> bool {
    status.code() == Code::Cancelled && status.message() == "Timeout expired"
}

/// What plain text hears of a port that speaks TLS.
pub fn has_broken_off(status: &Status) -> bool {
    let said = status.message();
    said.starts_with("h2 protocol error") || ["operation was canceled", "transport error"].contains(&said)
}

/// The connection is gone, and with it what the answer would have been.
pub fn was_cut(status: &Status) -> bool {
    matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled | Code::Internal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_may_pass_is_waited_for_and_a_lost_place_is_begun_anew() {
        for code in [Code::Unavailable, Code::Unknown, Code::Internal, Code::Cancelled, Code::ResourceExhausted] {
            assert_eq!(Exit::from(Status::new(code, "")).remedy, Remedy::Later, "{code:?}");
        }
        for code in [Code::PermissionDenied, Code::Unauthenticated, Code::InvalidArgument, Code::NotFound] {
            assert_eq!(Exit::from(Status::new(code, "")).remedy, Remedy::None, "{code:?}");
        }
        for code in [reason::Code::CursorExpired, reason::Code::CursorOfOtherStore] {
            let refusal = Refusal::new(Kind::Precondition, code);
            assert!(Exit::from(midshift_proto::status(&refusal, None)).is_of_a_lost_place(), "{code:?}");
        }
    }

    #[test]
    fn an_error_says_what_it_means_and_then_what_to_try() {
        let told = |kind, reason: reason::Reason| {
            Exit::from(midshift_proto::status(&Refusal::new(kind, reason), Some("r-77"))).to_string()
        };
        let nobody = told(Kind::NotFound, reason::Code::RobotNotFound.into());
        assert_eq!(nobody, format!("No robot has this id.\n  try: {}", reason::Code::RobotNotFound.next_step()));
        let own = told(Kind::Denied, reason::Reason::new(reason::Code::NotPermitted, "it takes the role viewer"));
        assert_eq!(own, format!("it takes the role viewer\n  try: {}", reason::Code::NotPermitted.next_step()));
        let fault = told(Kind::Internal, reason::Code::Internal.into());
        assert_eq!(
            fault,
            "A fault of midshift.\n  request_id: r-77\n  try: Look for the request_id in the server's log."
        );
    }

    #[test]
    fn a_server_that_does_not_answer_in_time_and_a_port_that_speaks_tls_have_their_own_words_and_exit_codes() {
        let late = Exit::from(Status::cancelled("Timeout expired"));
        assert_eq!((late.code(), late.to_string()), (10, LATE.to_owned()));
        for message in ["h2 protocol error: http2 error", "operation was canceled"] {
            let broken = Exit::from(Status::unknown(message));
            assert_eq!((broken.code(), broken.to_string()), (NO_SERVER, BROKE_OFF.to_owned()));
        }
        let canceled = Exit::from(Status::cancelled("by whoever asked"));
        assert_eq!((canceled.code(), canceled.to_string().as_str()), (1, "by whoever asked"));
    }
}
