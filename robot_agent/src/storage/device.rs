//! The key of the machine that a robot's agent runs on: made at its first start, kept on its ledger, and signing what
//! it says of itself.
//!
//! Invariant: the secret never leaves the machine: it is shown, logged and sent nowhere.

use midshift_bundle::installed;
use midshift_bundle::keys::SecretKey;
use midshift_core::update::Installed;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::sync::Arc;

/// The key; clones are the same. Shown only as the id of its public part.
#[derive(Clone, Debug)]
pub struct DeviceKey(Arc<SecretKey>);

impl DeviceKey {
    /// A new one from the system's randomness.
    pub fn draw() -> Self {
        Self(Arc::new(SecretKey::draw()))
    }
    /// One that is always the same, for tests.
    pub fn of_seed(seed: [u8; 32]) -> Self {
        Self(Arc::new(SecretKey::of_seed(seed)))
    }
    /// Its public part, 64 hexadecimal digits.
    pub fn public(&self) -> String {
        self.0.public().hex()
    }
    /// The secret as PKCS #8 in PEM, for the handshakes of this machine.
    pub(crate) fn tls_pem(&self) -> String {
        self.0.to_pem()
    }
    /// What a robot says of its software, signed.
    pub fn seal(&self, installed: Installed) -> String {
        installed::seal(installed, &self.0)
    }
}

impl PartialEq for DeviceKey {
    fn eq(&self, other: &Self) -> bool {
        self.0.public() == other.0.public()
    }
}

/// For the ledger alone.
impl Serialize for DeviceKey {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.0.to_pem())
    }
}

impl<'de> Deserialize<'de> for DeviceKey {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let key = SecretKey::from_pem(&text).ok_or_else(|| D::Error::custom("is no ed25519 key in PEM"))?;
        Ok(Self(Arc::new(key)))
    }
}
