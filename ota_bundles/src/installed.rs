//! A robot's word on what it has installed, signed with the key of its machine.
//!
//! Invariant: it holds for one robot and one start of its agent; nothing of it is believed before its own key has signed the bytes that are
//! read. Whether that key is the robot's is for whoever remembers it. Called by the agent at Hello, and by telemetry.

use crate::dsse::{self, Unreadable};
use crate::keys::{PublicKey, SecretKey};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Refusal;
use midshift_core::update::Installed;

/// What the payload is.
pub const PAYLOAD_TYPE: &str = "application/vnd.midshift.installed.v1+json";

/// Why it is not believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Rejection {
    /// It is longer than any.
    #[error("the envelope is too long")]
    TooLong,
    /// It is no envelope, or something else.
    #[error("the envelope cannot be read")]
    Malformed,
    /// It is something else that was signed.
    #[error("the payload is of another type")]
    OtherType,
    /// The key that it names is none, or did not sign it.
    #[error("the key that it names has not signed it")]
    NotSigned,
    /// It is of another robot.
    #[error("it is of another robot")]
    OtherRobot,
    /// It was signed at another start of the agent.
    #[error("it is of another start of the agent")]
    OtherStart,
    /// What it says breaks rules.
    #[error("{0}")]
    Refused(Box<Refusal>),
}

impl From<Unreadable> for Rejection {
    fn from(unreadable: Unreadable) -> Self {
        match unreadable {
            Unreadable::TooLong => Self::TooLong,
            Unreadable::Malformed => Self::Malformed,
            Unreadable::OtherType => Self::OtherType,
        }
    }
}

/// The signed envelope. `device_key` becomes that of `key`.
pub fn seal(installed: Installed, key: &SecretKey) -> String {
    let installed = Installed { device_key: key.public().hex(), ..installed };
    let payload = serde_json::to_vec(&installed).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
    String::from_utf8(dsse::seal(PAYLOAD_TYPE, &payload, key)).unwrap_or_else(|e| unreachable!("JSON: {e}"))
}

/// Reads and checks what a robot said at this start of its agent.
///
/// # Errors
/// The first reason not to believe it.
pub fn open(envelope: &str, robot_id: &RobotId, boot_id: &str) -> Result<Installed, Rejection> {
    let opened = dsse::open(envelope.as_bytes(), limits::INSTALLED_BYTES_MAX, PAYLOAD_TYPE)?;
    let installed: Installed = serde_json::from_slice(&opened.payload).map_err(|_| Rejection::Malformed)?;
    let key = PublicKey::from_hex(&installed.device_key).ok_or(Rejection::NotSigned)?;
    if !opened.is_signed_by(&key) {
        return Err(Rejection::NotSigned);
    }
    if installed.robot_id != *robot_id {
        return Err(Rejection::OtherRobot);
    }
    if installed.boot_id != boot_id {
        return Err(Rejection::OtherStart);
    }
    installed.check().map_err(|refusal| Rejection::Refused(Box::new(refusal)))?;
    Ok(installed)
}
