//! What one bundle holds: components with what they need, refuse and promise. The manifest is itself a target; a robot gets a bundle
//! by its manifest's digest.
//!
//! Invariant: a [`Manifest`] has passed every rule here; what is written by people is a [`Draft`] until then.

use crate::digest::Digest;
use midshift_core::reason::{Refusal, Violations};
use midshift_core::task::raw::parse_version;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Format of this page.
pub const FORMAT: u32 = 1;
/// Components of one bundle.
pub const COMPONENTS_MAX: usize = 32;
/// Bytes of one component.
pub const COMPONENT_BYTES_MAX: u64 = 8 * 1024 * 1024 * 1024;
/// Bytes of one manifest.
pub const MANIFEST_BYTES_MAX: usize = 256 * 1024;
/// Entries of one list of a component.
const LIST_MAX: usize = 64;
/// Letters of one word.
const WORD_MAX: usize = 64;
/// Letters of the description.
const TEXT_MAX: usize = 2_000;

/// What a component is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ComponentKind {
    /// A program that the launcher starts.
    Process,
    /// Weights of a policy.
    Weights,
    /// Settings of its programs.
    Config,
    /// The operating system beneath; it has two slots of its own.
    Base,
}

impl ComponentKind {
    /// The word in drafts and manifests.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Process => "process",
            Self::Weights => "weights",
            Self::Config => "config",
            Self::Base => "base",
        }
    }
}

/// What a robot must do to change to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Needs {
    /// Nothing has to be started again.
    None,
    /// Start its programs again.
    Restart,
    /// Be parked.
    Park,
    /// Start the machine again.
    Reboot,
}

impl Needs {
    /// The word in drafts and manifests.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Restart => "restart",
            Self::Park => "park",
            Self::Reboot => "reboot",
        }
    }
}

/// What is done to the robot's data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Migration {
    /// The data stays as it is.
    #[default]
    None,
    /// Something that the version before can undo or ignore. Done on commit, never before.
    Reversible,
    /// Something that the version before cannot read. Done on commit, never before; there is no way back after it.
    Irreversible,
}

/// Whether a component has a part in a safety function. midshift validates none: that is the integrator's duty.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SafetyClass {
    /// It bears on no safety function.
    #[default]
    None,
    /// It bears on one; refused unless the site allows it.
    Related,
}

/// One component as people write it. `file` is where its bytes are, beside the draft.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DraftComponent {
    /// `[a-z0-9-]`, 1-64.
    pub name: String,
    /// `major.minor.patch`, with `-…` or `+…` if you like.
    pub version: String,
    /// What it is.
    pub kind: ComponentKind,
    /// The file, relative to the draft.
    pub file: String,
    /// Hardware models it runs on. At least one.
    pub hardware: Vec<String>,
    /// Capabilities that a robot has with it.
    #[serde(default)]
    pub capabilities: Vec<String>,
    /// Components that must be there, with their lowest version.
    #[serde(default)]
    pub requires: BTreeMap<String, String>,
    /// Components that must not be there, up to this version.
    #[serde(default)]
    pub conflicts: BTreeMap<String, String>,
    /// Levels of the work protocol that it understands. Absent: the first alone.
    #[serde(default)]
    pub work_level: WorkLevels,
    /// Rises when going back behind it would be dangerous. A robot with a higher floor refuses it.
    #[serde(default)]
    pub rollback_index: u64,
    /// Whether it bears on a safety function.
    #[serde(default)]
    pub safety_class: SafetyClass,
    /// What a robot must do to change to it.
    pub needs: Needs,
    /// What happens to data on commit.
    #[serde(default)]
    pub data_migration: Migration,
}

/// Levels of the work protocol, from 1 on: what assignments say, and what a robot answers to them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkLevels {
    /// The lowest of them.
    pub lowest: u32,
    /// The highest of them.
    pub highest: u32,
}

impl Default for WorkLevels {
    /// The first alone.
    fn default() -> Self {
        Self { lowest: 1, highest: 1 }
    }
}

/// A bundle as people write it, `bundle.toml`.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Draft {
    /// `[a-z0-9-]`, 1-64.
    pub name: String,
    /// Its version, as `major.minor.patch`.
    pub version: String,
    /// For people.
    #[serde(default)]
    pub description: String,
    /// Fault codes that end a roll-out at once when a robot on trial reports one.
    #[serde(default)]
    pub hard_stop_codes: Vec<u32>,
    /// Whether a commit raises the robot's floors to this bundle's `rollback_index`es.
    #[serde(default)]
    pub raises_floor: bool,
    /// What it holds.
    #[serde(rename = "component")]
    pub components: Vec<DraftComponent>,
}

/// One component of a checked bundle. [`Manifest::from_bytes`] refuses fields that it does not know; on a ledger they are not looked at.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Component {
    /// Unique in its bundle.
    pub name: String,
    /// Its version, as `major.minor.patch`.
    pub version: String,
    /// What it is.
    pub kind: ComponentKind,
    /// Hardware models it runs on, ascending.
    pub hardware: BTreeSet<String>,
    /// Capabilities that a robot has with it, ascending.
    pub capabilities: BTreeSet<String>,
    /// Components that must be there, with their lowest version.
    pub requires: BTreeMap<String, String>,
    /// Components that must not be there, up to this version.
    pub conflicts: BTreeMap<String, String>,
    /// Levels of the work protocol that it understands.
    pub work_level: WorkLevels,
    /// A robot with a higher floor refuses it.
    pub rollback_index: u64,
    /// Whether it bears on a safety function.
    pub safety_class: SafetyClass,
    /// What a robot must do to change to it.
    pub needs: Needs,
    /// What happens to data on commit.
    pub data_migration: Migration,
    /// SHA-256 of its bytes.
    pub digest: Digest,
    /// How many bytes it has.
    pub length: u64,
}

impl Component {
    /// One with this content that says nothing more of itself: it asks for no other component, promises nothing, and a robot that
    /// changes to it starts its program again.
    pub fn new(name: &str, version: &str, kind: ComponentKind, content: &[u8]) -> Self {
        Self {
            name: name.to_owned(),
            version: version.to_owned(),
            kind,
            hardware: BTreeSet::new(),
            capabilities: BTreeSet::new(),
            requires: BTreeMap::new(),
            conflicts: BTreeMap::new(),
            work_level: WorkLevels::default(),
            rollback_index: 0,
            safety_class: SafetyClass::None,
            needs: Needs::Restart,
            data_migration: Migration::None,
            digest: Digest::of_content(content),
            length: content.len() as u64,
        }
    }
    /// Its name in the repository: flat, and unique by version.
    pub fn target(&self) -> String {
        format!("{}-{}.component", self.name, self.version)
    }
}

/// A field of `given`, at any depth, that `read` does not have.
fn unread_field(given: &serde_json::Value, read: &serde_json::Value) -> Option<String> {
    let (given, read) = (given.as_object()?, read.as_object()?);
    given.iter().find_map(|(name, value)| match read.get(name) {
        Some(read) => unread_field(value, read),
        None => Some(name.clone()),
    })
}

/// A checked bundle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// How it is laid out: [`FORMAT`].
    pub format: u32,
    /// The bundle.
    pub name: String,
    /// Its version, as `major.minor.patch`.
    pub version: String,
    /// For people.
    pub description: String,
    /// Fault codes that end a roll-out at once when a robot on trial reports one, ascending.
    pub hard_stop_codes: BTreeSet<u32>,
    /// Whether a commit raises the robot's floors.
    pub raises_floor: bool,
    /// In the order of the draft.
    pub components: Vec<Component>,
}

impl Manifest {
    /// Its name in the repository.
    pub fn target(&self) -> String {
        format!("{}-{}.manifest", self.name, self.version)
    }
    /// The bytes that are signed and whose digest names the bundle.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        bytes.push(b'\n');
        bytes
    }
    /// Reads a manifest and checks it again, since it comes from elsewhere.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Refusal> {
        if bytes.len() > MANIFEST_BYTES_MAX {
            return Err(Refusal::field("manifest", format!("has more than {MANIFEST_BYTES_MAX} bytes")));
        }
        let manifest: Self =
            serde_json::from_slice(bytes).map_err(|e| Refusal::field("manifest", format!("is not one: {e}")))?;
        if let Some(field) = manifest.left_unread(bytes) {
            return Err(Refusal::field("manifest", format!("is not one: unknown field `{field}`")));
        }
        manifest.check()?;
        Ok(manifest)
    }
    /// A field of a component in `bytes` that is not in what was read of them: it may ask for something that nobody here would see to.
    fn left_unread(&self, bytes: &[u8]) -> Option<String> {
        let given: serde_json::Value = serde_json::from_slice(bytes).ok()?;
        let mut components = given.get("components")?.as_array()?.iter().zip(&self.components);
        components.find_map(|(given, read)| unread_field(given, &serde_json::to_value(read).ok()?))
    }
    /// Models that every component runs on.
    pub fn hardware(&self) -> BTreeSet<&str> {
        let mut all = self.components.iter().map(|c| c.hardware.iter().map(String::as_str).collect::<BTreeSet<_>>());
        let first = all.next().unwrap_or_default();
        all.fold(first, |common, next| common.intersection(&next).copied().collect())
    }
    /// The most that a robot must do.
    pub fn needs(&self) -> Needs {
        self.components.iter().map(|c| c.needs).max().unwrap_or(Needs::None)
    }
    /// Bytes of all components.
    pub fn length(&self) -> u64 {
        self.components.iter().map(|c| c.length).sum()
    }

    /// Checks every rule.
    ///
    /// # Errors
    /// All violations at once.
    pub fn check(&self) -> Result<(), Refusal> {
        let mut bad = Violations::default();
        if self.format != FORMAT {
            bad.add("format", format!("must be {FORMAT}: this program knows no other"));
        }
        check_word(&mut bad, "name", &self.name);
        check_version(&mut bad, "version", &self.version);
        if self.description.len() > TEXT_MAX {
            bad.add("description", format!("at most {TEXT_MAX} bytes"));
        }
        if self.hard_stop_codes.len() > LIST_MAX {
            bad.add("hard_stop_codes", format!("at most {LIST_MAX}"));
        }
        if self.components.is_empty() || self.components.len() > COMPONENTS_MAX {
            bad.add("component", format!("there must be 1..{COMPONENTS_MAX} of them"));
        }
        let mut names = BTreeSet::new();
        for (i, component) in self.components.iter().enumerate() {
            let field = format!("component[{i}]");
            component.check(&mut bad, &field);
            if !names.insert(&component.name) {
                bad.add(format!("{field}.name"), "stands twice");
            }
        }
        if !self.components.is_empty() && self.hardware().is_empty() {
            bad.add("component", "no hardware model runs all of them");
        }
        if self.components.iter().filter(|c| c.kind == ComponentKind::Base).count() > 1 {
            bad.add("component", "at most one of kind base: a robot has one operating system");
        }
        bad.finish()
    }
}

impl Component {
    fn check(&self, bad: &mut Violations, field: &str) {
        check_word(bad, &format!("{field}.name"), &self.name);
        check_version(bad, &format!("{field}.version"), &self.version);
        if self.hardware.is_empty() {
            bad.add(format!("{field}.hardware"), "name at least one model");
        }
        for (list, words) in [("hardware", &self.hardware), ("capabilities", &self.capabilities)] {
            check_count(bad, &format!("{field}.{list}"), words.len());
            words.iter().for_each(|word| check_word(bad, &format!("{field}.{list}"), word));
        }
        for (list, others) in [("requires", &self.requires), ("conflicts", &self.conflicts)] {
            check_count(bad, &format!("{field}.{list}"), others.len());
            for (name, version) in others {
                check_word(bad, &format!("{field}.{list}"), name);
                check_version(bad, &format!("{field}.{list}.{name}"), version);
            }
        }
        if self.conflicts.contains_key(&self.name) {
            bad.add(format!("{field}.conflicts"), "a component cannot be without itself");
        }
        if self.work_level.lowest == 0 || self.work_level.lowest > self.work_level.highest {
            bad.add(format!("{field}.work_level"), "must have lowest from 1 on, and highest not below it");
        }
        if self.length == 0 || self.length > COMPONENT_BYTES_MAX {
            bad.add(format!("{field}.length"), format!("must be 1..{COMPONENT_BYTES_MAX} bytes"));
        }
        if self.kind == ComponentKind::Base && self.needs != Needs::Reboot {
            bad.add(format!("{field}.needs"), "an operating system needs a reboot");
        }
    }
}

fn check_word(bad: &mut Violations, field: &str, word: &str) {
    let letters = word.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-' || b == b'_');
    if word.is_empty() || word.len() > WORD_MAX || !letters {
        bad.add(field, format!("must be 1-{WORD_MAX} of [a-z0-9-_]"));
    }
}

fn check_version(bad: &mut Violations, field: &str, version: &str) {
    let letters = version.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'+'));
    if version.len() > WORD_MAX || !letters || parse_version(version).is_none() {
        bad.add(field, "must be major.minor.patch, with -… or +… of letters and digits if you like");
    }
}

fn check_count(bad: &mut Violations, field: &str, count: usize) {
    if count > LIST_MAX {
        bad.add(field, format!("at most {LIST_MAX}"));
    }
}
