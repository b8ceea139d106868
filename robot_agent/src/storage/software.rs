//! What the ledger remembers of software: the newest update, floors, keys that were handed over, and migrations that
//! are due.
//!
//! Invariant: its JSON lies on the disks of robots. A field may be added with a default, never renamed.

use midshift_bundle::digest::Digest;
use midshift_bundle::directive::Directive;
use midshift_bundle::keys::{KeyId, PublicKey};
use midshift_bundle::set::SetManifest;
use midshift_core::ids::{BundleId, DrainId, SetId};
use midshift_core::reason::Reason;
use midshift_core::time::Utc;
use midshift_core::update::{DesiredUpdate, UpdateReport, UpdateState};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What the ledger remembers of software.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SoftwareRow {
    /// Generation of the newest directive that was taken.
    pub directive_generation: u64,
    /// Digest of its envelope; none: it was taken before that was written down.
    #[serde(default)]
    pub envelope: Option<Digest>,
    /// Keys that were handed over; none: those of the trust file count.
    #[serde(default)]
    pub keys: Option<HeldKeys>,
    /// Highest grant that was used.
    pub grant_id: u64,
    /// Lowest `rollback_index` of each component that may be taken.
    pub floors: BTreeMap<String, u64>,
    /// When the set that runs was committed; none: the robot came with it, or nobody wrote it down.
    #[serde(default)]
    pub committed_at: Option<Utc>,
    /// Migrations of the committed set that are not done yet.
    #[serde(default)]
    pub due: Vec<DueMigration>,
    /// The newest update.
    pub update: Option<Update>,
}

impl SoftwareRow {
    /// As it is once this directive was taken.
    pub(crate) fn with(&self, directive: &Directive, desired: &DesiredUpdate) -> Self {
        let envelope = Some(Digest::of_content(desired.directive.as_bytes()));
        Self { directive_generation: directive.generation, envelope, update: None, ..self.clone() }
    }
    /// The newest update as it is reported.
    pub fn report(&self, progress_permille: u16) -> Option<UpdateReport> {
        let update = self.update.as_ref()?;
        Some(UpdateReport {
            state: update.state,
            bundle: BundleId::parse(&update.bundle.to_string()).ok()?,
            directive_generation: self.directive_generation,
            set: update.set_name().and_then(|name| SetId::parse(&name).ok()),
            drain_id: update.drain_id.clone(),
            grant_id: self.grant_id,
            tries: update.tries,
            progress_permille,
            reason: update.reason.clone(),
        })
    }
}

/// Keys of directives that were handed over by those before them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeldKeys {
    /// Number of their set.
    pub number: u64,
    /// The keys, as 64 hexadecimal digits each.
    #[serde(with = "hex_keys")]
    pub keys: Vec<PublicKey>,
    /// Keys that the trust file named when they were taken: another file counts instead of them, but never an older
    /// set.
    pub from: Vec<KeyId>,
}

mod hex_keys {
    use midshift_bundle::keys::PublicKey;
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(keys: &[PublicKey], to: S) -> Result<S::Ok, S::Error> {
        keys.iter().map(PublicKey::hex).collect::<Vec<_>>().serialize(to)
    }
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<PublicKey>, D::Error> {
        let keys = Vec::<String>::deserialize(from)?;
        keys.iter().map(|key| PublicKey::from_hex(key).ok_or_else(|| D::Error::custom("no key"))).collect()
    }
}

/// One update.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// Where it stands.
    pub state: UpdateState,
    /// Its manifest.
    pub bundle: Digest,
    /// Bytes of the manifest.
    pub manifest_length: u64,
    /// No component may have a lower `rollback_index`.
    pub rollback_floor: u64,
    /// What comes of it; none before it was planned.
    pub set: Option<SetManifest>,
    /// Floors rise when it is committed.
    pub raises_floor: bool,
    /// It cannot be gone back from once it is committed.
    pub is_irreversible: bool,
    /// The drain in which it was activated, or gone back from.
    pub drain_id: Option<DrainId>,
    /// Starts that the set was given before it was put away.
    pub tries: u32,
    /// Milliseconds of site time on probation.
    pub probation_ms: u64,
    /// Why it was refused or went back.
    pub reason: Option<Reason>,
}

impl Update {
    /// Name of its set in the switch record.
    pub fn set_name(&self) -> Option<String> {
        self.set.as_ref().map(|set| set.id().to_string())
    }
}

/// A migration that is to be done.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DueMigration {
    /// Whose data.
    pub component: String,
    /// Version before; none: the component is new.
    pub from: Option<String>,
    /// Version now.
    pub to: String,
}
