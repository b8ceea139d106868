//! The key of the machine that a robot's agent runs on: made at its first start, kept on its ledger, and signing what it says of itself.
//!
//! Invariant: the secret never leaves the ledger: it is shown, logged and sent nowhere. Called by the shell.

use crate::core::AgentCore;
use crate::sets::Holdings;
use midshift_bundle::digest::Digest;
use midshift_bundle::installed;
use midshift_bundle::keys::SecretKey;
use midshift_core::ids::{BundleId, SetId};
use midshift_core::limits;
use midshift_core::update::{Installed, InstalledSet};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeSet;
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

impl AgentCore {
    /// What it has installed, signed for this start of the agent. None: its software is not changed, or its sets were never seen.
    pub fn installed(&self, boot_id: &str) -> Option<String> {
        let (holdings, key) = (self.holdings()?, self.kept().ledger.device.as_ref()?);
        let staged = self.kept().ledger.software.update.as_ref().and_then(|u| u.set.as_ref()).map(|set| set.id());
        let id = |name: &str| SetId::parse(name).ok();
        let switch = &holdings.switch;
        let installed = Installed {
            robot_id: self.robot_id().clone(),
            boot_id: boot_id.to_owned(),
            device_key: key.public(),
            model: self.inventory().model.clone(),
            free_bytes: holdings.free_bytes,
            running: id(switch.running())?,
            current: id(&switch.current)?,
            previous: switch.previous.as_deref().and_then(id),
            sets: sets(holdings, staged),
        };
        Some(installed::seal(installed, &key.0))
    }
}

/// Whole sets that the switch record names, and the one that is staged.
fn sets(holdings: &Holdings, staged: Option<Digest>) -> Vec<InstalledSet> {
    let switch = &holdings.switch;
    let names = [Some(switch.running()), Some(&switch.current), switch.previous.as_deref()];
    let named = names.into_iter().flatten().filter_map(|name| name.parse::<Digest>().ok());
    let listed: BTreeSet<Digest> = named.chain(staged).collect();
    let set = |id: Digest| {
        let set = holdings.sets.get(&id)?;
        let components = set.components.values().map(|c| (c.name.clone(), c.version.clone()));
        Some(InstalledSet {
            set: SetId::parse(&id.to_string()).ok()?,
            bundle: set.bundle.and_then(|bundle| BundleId::parse(&bundle.to_string()).ok()),
            version: set.version.clone(),
            components: components.take(limits::INSTALLED_COMPONENTS_MAX).collect(),
            components_left_out: set.components.len().saturating_sub(limits::INSTALLED_COMPONENTS_MAX) as u32,
        })
    };
    listed.into_iter().filter_map(set).take(limits::INSTALLED_SETS_MAX).collect()
}
