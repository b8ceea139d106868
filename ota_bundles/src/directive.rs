//! The rollout service's word to one robot: take this bundle. One DSSE envelope, signed with ed25519.
//!
//! Invariant: a directive chooses among what release people signed and can neither add to it nor go below a robot's floor; nothing
//! of an envelope is believed before its signature was checked over exactly the bytes that are read.

use crate::bugs::Bugs;
use crate::digest::Digest;
use crate::dsse::{self, Unreadable};
use crate::keys::{KeyId, PublicKey, SecretKey};
use midshift_core::ids::RobotId;
use midshift_core::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What the payload is.
pub const PAYLOAD_TYPE: &str = "application/vnd.midshift.directive.v1+json";
/// Bytes of an envelope.
pub const ENVELOPE_BYTES_MAX: usize = 16 * 1024;
/// How long a directive lives, unless it is signed again.
pub const LIFE_MS: u64 = 7 * 24 * 3_600_000;

/// Which bundle which robot shall have.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Directive {
    /// For this robot alone.
    pub robot_id: RobotId,
    /// The key it is signed with, once more inside the signature.
    pub key_id: KeyId,
    /// Rises with every directive of the robot.
    pub generation: u64,
    /// Digest of the manifest.
    pub manifest: Digest,
    /// Bytes of the manifest.
    pub manifest_length: u64,
    /// No component may have a lower `rollback_index`.
    pub rollback_floor: u64,
    /// When it was signed, UTC ms.
    pub issued_at: Utc,
    /// Until when it may be accepted, UTC ms. What was accepted stays.
    pub expires: Utc,
    /// The rollout behind it.
    pub rollout: String,
}

/// Why a robot does not take a directive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Rejection {
    /// It is longer than any directive.
    #[error("the envelope is too long")]
    TooLong,
    /// It is no envelope, or no directive.
    #[error("the envelope cannot be read")]
    Malformed,
    /// It is something else that was signed.
    #[error("the payload is of another type")]
    OtherType,
    /// No key that the robot trusts has signed it.
    #[error("no trusted key has signed it")]
    NotSigned,
    /// The key inside is another than the one that signed.
    #[error("it names another key than the one that signed it")]
    OtherKey,
    /// It is for another robot.
    #[error("it is for another robot")]
    OtherRobot,
    /// The robot has had this one or a newer one.
    #[error("its generation is not newer than what the robot has")]
    Replayed,
    /// It may no longer be accepted.
    #[error("it has expired")]
    Expired,
}

/// What a robot holds a directive against.
pub struct Expected<'a> {
    /// The robot that checks it.
    pub robot_id: &'a RobotId,
    /// Keys whose directives it takes.
    pub keys: &'a BTreeMap<KeyId, PublicKey>,
    /// Generation of the newest directive it has taken; 0: none.
    pub generation: u64,
    /// The latest moment it is sure of: its clock if that is synced, never before its time floor.
    pub now: Utc,
    /// Naive rules, for twins of tests.
    pub bugs: Bugs,
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

impl Directive {
    /// The signed envelope. `key_id` becomes that of `key`.
    pub fn sign(mut self, key: &SecretKey) -> Vec<u8> {
        self.key_id = key.public().id();
        let payload = serde_json::to_vec(&self).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        dsse::seal(PAYLOAD_TYPE, &payload, key)
    }

    /// Reads and checks an envelope.
    ///
    /// # Errors
    /// The first reason not to take it.
    pub fn verify(envelope: &[u8], expected: &Expected) -> Result<Self, Rejection> {
        let most = if expected.bugs.length_is_forgotten() { usize::MAX } else { ENVELOPE_BYTES_MAX };
        let opened = dsse::open(envelope, most, PAYLOAD_TYPE)?;
        let signer = opened
            .signers()
            .find(|id| expected.keys.get(id).is_some_and(|key| key.id() == *id && opened.is_signed_by(key)))
            .or_else(|| opened.signers().next().filter(|_| expected.bugs.strangers_sign()));
        let signer = signer.ok_or(Rejection::NotSigned)?;
        let directive: Self = serde_json::from_slice(&opened.payload).map_err(|_| Rejection::Malformed)?;
        directive.check(signer, expected).map(|()| directive)
    }

    fn check(&self, signer: KeyId, expected: &Expected) -> Result<(), Rejection> {
        if self.key_id != signer {
            return Err(Rejection::OtherKey);
        }
        if self.robot_id != *expected.robot_id && !expected.bugs.any_robot_will_do() {
            return Err(Rejection::OtherRobot);
        }
        if self.generation <= expected.generation {
            return Err(Rejection::Replayed);
        }
        if self.expires <= expected.now && !expected.bugs.directives_live_for_ever() {
            return Err(Rejection::Expired);
        }
        Ok(())
    }
}
