//! Which keys sign directives from now on: a numbered set that is handed over by a key of the set before it.
//!
//! Invariant: a robot takes a set only if a release lists it *and* a key that the robot takes directives of has signed it; numbers never go
//! back. So release people alone can bring in no key, and neither can a thief of the server's.

use crate::dsse::{self, Unreadable};
use crate::keys::{KeyId, PublicKey, SecretKey};
use midshift_core::reason::{Refusal, Violations};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What the payload is.
pub const PAYLOAD_TYPE: &str = "application/vnd.midshift.directive-keys.v1+json";
/// Bytes of an envelope.
pub const ENVELOPE_BYTES_MAX: usize = 16 * 1024;
/// Keys of one set: the one in use, and those that end or follow.
pub const KEYS_MAX: usize = 8;
/// Sets that a repository lists. A key that is changed each month lasts for twenty years.
pub const SETS_MAX: usize = 256;
/// How the name of a target ends that is such a set.
const SUFFIX: &str = ".directive-keys";

/// Keys that sign directives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeySet {
    /// From 1, one more with each set.
    pub number: u64,
    /// The server signs with the first of them that it has. A key of the set before that is not among them has ended.
    pub keys: Vec<PublicKey>,
}

/// The payload as it stands there.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Page {
    number: u64,
    /// Keys as TUF writes them.
    keys: Vec<serde_json::Value>,
}

/// Why a set is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Rejection {
    /// It is longer than any set.
    #[error("the envelope is too long")]
    TooLong,
    /// It is no envelope, or no set of keys.
    #[error("the envelope cannot be read")]
    Malformed,
    /// It is something else that was signed.
    #[error("the payload is of another type")]
    OtherType,
    /// No key that signs directives until now has signed it.
    #[error("no key that is current has signed it")]
    NotSigned,
    /// It is listed under another number than it has.
    #[error("it is listed under another number than it has")]
    OtherNumber,
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

impl KeySet {
    /// Name of its target, `N.directive-keys`.
    pub fn target(&self) -> String {
        format!("{}{SUFFIX}", self.number)
    }
    /// Whether a target of this name says that it is a set of keys.
    pub fn is_named(name: &str) -> bool {
        name.ends_with(SUFFIX)
    }
    /// Number of the set that is listed under this name; none: it is no name of a set.
    pub fn number_of(name: &str) -> Option<u64> {
        let number = name.strip_suffix(SUFFIX)?.parse().ok()?;
        let named = Self { number, keys: Vec::new() };
        (number > 0 && named.target() == name).then_some(number)
    }

    /// The envelope, signed by a key of the set before.
    ///
    /// # Errors
    /// Everything that is wrong with the set.
    pub fn sign(&self, by: &SecretKey) -> Result<Vec<u8>, Refusal> {
        let mut bad = Violations::default();
        if self.number == 0 {
            bad.add("number", "begins with 1");
        }
        if !(1..=KEYS_MAX).contains(&self.keys.len()) {
            bad.add("keys", format!("must be 1 to {KEYS_MAX}"));
        }
        for (at, key) in self.keys.iter().enumerate() {
            if self.keys[..at].contains(key) {
                bad.add(format!("keys[{at}]"), "stands there twice");
            }
        }
        bad.finish()?;
        let page = Page { number: self.number, keys: self.keys.iter().map(PublicKey::tuf).collect() };
        let payload = serde_json::to_vec(&page).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        Ok(dsse::seal(PAYLOAD_TYPE, &payload, by))
    }

    /// Reads an envelope that is believed for another reason: nobody's signature is checked.
    ///
    /// # Errors
    /// If it is none.
    pub fn read(envelope: &[u8]) -> Result<Self, Rejection> {
        Self::from_payload(&dsse::open(envelope, ENVELOPE_BYTES_MAX, PAYLOAD_TYPE)?.payload)
    }

    /// Reads an envelope that is listed under `number`, and that one of `current` must have signed.
    ///
    /// # Errors
    /// The first reason not to take it.
    pub fn open<'a>(
        envelope: &[u8],
        number: u64,
        current: impl IntoIterator<Item = &'a PublicKey>,
    ) -> Result<Self, Rejection> {
        let opened = dsse::open(envelope, ENVELOPE_BYTES_MAX, PAYLOAD_TYPE)?;
        if !current.into_iter().any(|key| opened.is_signed_by(key)) {
            return Err(Rejection::NotSigned);
        }
        let set = Self::from_payload(&opened.payload)?;
        if set.number == number { Ok(set) } else { Err(Rejection::OtherNumber) }
    }

    fn from_payload(payload: &[u8]) -> Result<Self, Rejection> {
        let page: Page = serde_json::from_slice(payload).map_err(|_| Rejection::Malformed)?;
        let mut keys = Vec::new();
        for key in &page.keys {
            let key = PublicKey::from_tuf(key).filter(|key| !keys.contains(key)).ok_or(Rejection::Malformed)?;
            keys.push(key);
        }
        if page.number == 0 || !(1..=KEYS_MAX).contains(&keys.len()) {
            return Err(Rejection::Malformed);
        }
        Ok(Self { number: page.number, keys })
    }
}

/// What a robot takes directives of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Current {
    /// Number of the newest set that was taken; 0: none was.
    pub number: u64,
    /// Its keys.
    pub keys: BTreeMap<KeyId, PublicKey>,
}

impl Current {
    /// Goes from set to set as far as each is signed by a key of the one that was taken before it. `listed` are envelopes of newer sets by the
    /// number under which a release lists them. Which were passed over, and why.
    pub fn follow(&mut self, listed: &BTreeMap<u64, Vec<u8>>) -> Vec<(u64, Rejection)> {
        let mut passed = Vec::new();
        for (number, envelope) in listed.range(self.number.saturating_add(1)..) {
            match KeySet::open(envelope, *number, self.keys.values()) {
                Ok(set) => {
                    let keys = set.keys.into_iter().map(|key| (key.id(), key)).collect();
                    *self = Self { number: *number, keys };
                }
                Err(rejection) => passed.push((*number, rejection)),
            }
        }
        passed
    }
}
