//! What a caller hears of errors of files and documents.
//!
//! Invariant: every error has one reason code; what is our own fault is logged here and not told.

use crate::content;
use crate::repository;
use midshift_bundle::manifest::COMPONENT_BYTES_MAX;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use std::io::ErrorKind;
use tonic::{Response, Status};

/// Missing files that are named in a refusal; the rest are counted.
const NAMED_MAX: usize = 16;

fn ours(error: &dyn std::fmt::Display) -> Refusal {
    tracing::error!(%error, "a call failed by our own fault");
    Refusal::new(Kind::Internal, Reason::new(Code::Internal, error.to_string()))
}

impl From<content::Error> for Refusal {
    fn from(error: content::Error) -> Self {
        use content::Error;
        let text = error.to_string();
        match error {
            Error::Io { ref source, .. } if source.kind() == ErrorKind::StorageFull => {
                tracing::error!(%error, "the disk is full");
                Self::new(Kind::Exhausted, Code::SoftwareFull)
            }
            Error::Io { .. } | Error::ReadOnly { .. } => ours(&error),
            Error::Busy { .. } => Self::new(Kind::Unavailable, Reason::new(Code::Overloaded, text)),
            Error::Moved { at, .. } => {
                Self::new(Kind::Conflict, Reason::new(Code::UploadMoved, text).with("durable_bytes", at))
            }
            Error::TooLong { .. } => Self::field("data", text),
            Error::Size => Self::field("length", text),
            Error::Full { missing, used, free, quota } => {
                let reason = Reason::new(Code::SoftwareFull, text).with("used", used);
                let reason = reason.with("missing", missing).with("free", free).with("quota", quota);
                Self::new(Kind::Exhausted, reason)
            }
            Error::DiskFull { missing, free, spare } => {
                let reason = Reason::new(Code::SoftwareFull, text);
                let reason = reason.with("missing", missing).with("free", free).with("spare", spare);
                Self::new(Kind::Exhausted, reason)
            }
            Error::WrongBytes { found } => {
                Self::new(Kind::Conflict, Reason::new(Code::UploadCorrupt, text).with("found", found))
            }
        }
    }
}

impl From<repository::Error> for Refusal {
    fn from(error: repository::Error) -> Self {
        use repository::Error;
        let text = error.to_string();
        match error {
            Error::Disk(error) => error.into(),
            Error::Refused(refusal) => refusal,
            Error::NotNamed { root_version, role } => {
                let reason =
                    Reason::new(Code::NoOnlineKeys, text).with("root_version", root_version).with("role", role);
                Self::new(Kind::Precondition, reason)
            }
            Error::Clock(_) => Self::new(Kind::Unavailable, Reason::new(Code::ClockDoubted, text)),
            Error::Moved { newest, expected } => {
                let reason = Reason::new(Code::ReleaseMoved, text).with("newest", newest).with("expected", expected);
                Self::new(Kind::Conflict, reason)
            }
            Error::Missing(files) => {
                let names: Vec<&str> = files.iter().take(NAMED_MAX).map(|file| file.name.as_str()).collect();
                let more = files.len() - names.len();
                let more = if more == 0 { String::new() } else { format!(" and {more} more") };
                let text = format!("not here yet: {}{more}", names.join(", "));
                Self::new(Kind::Precondition, Reason::new(Code::FilesMissing, text).with("files", files.len()))
            }
            Error::Key(_) | Error::Document(_) | Error::NoKeyFile { .. } | Error::Folder(_) | Error::Damaged { .. } => {
                ours(&text)
            }
        }
    }
}

/// A file that is longer than any may be.
pub fn too_large(length: u64) -> Refusal {
    let text = format!("{length} bytes are more than {COMPONENT_BYTES_MAX}");
    Refusal::new(Kind::Exhausted, Reason::new(Code::UploadTooLarge, text))
}

/// A refusal as gRPC tells it; it is counted.
pub fn status(refusal: &Refusal) -> Status {
    metrics::counter!("midshift_ota_refused_total", "code" => refusal.reason.code.as_str()).increment(1);
    midshift_proto::status(refusal, None)
}

/// An answer over gRPC, or why there is none.
pub fn answer<T>(result: Result<T, Refusal>) -> Result<Response<T>, Status> {
    result.map(Response::new).map_err(|refusal| status(&refusal))
}
