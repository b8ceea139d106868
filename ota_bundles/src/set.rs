//! What a robot has installed: the components of the bundle it took last, over those that it had before.
//!
//! A robot changes from one whole set to another; components that a bundle does not name stay. Called by robots before they stage, and by
//! the rollout service for its dry run, so that both refuse for the same reasons.
//! Invariant: a set that [`SetManifest::with`] gave has everything its components require and nothing they exclude.

use crate::bugs::Bugs;
use crate::digest::Digest;
use crate::manifest::{Component, ComponentKind, Manifest, SafetyClass, WorkLevels};
use midshift_core::task::raw::parse_version;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Level of the work protocol that this build of midshift speaks.
pub const WORK_LEVEL: u32 = 1;

/// One whole set. A newer version's fields are not looked at where it stands on a ledger; on a disk its digest is its name.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetManifest {
    /// Manifest of the bundle taken last; none: what the robot came with.
    pub bundle: Option<Digest>,
    /// Name and version of that bundle, for people.
    pub version: String,
    /// By name.
    pub components: BTreeMap<String, Component>,
}

/// What a robot is, as far as a bundle must fit it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Fit {
    /// Its maker's model name.
    pub model: String,
    /// Lowest `rollback_index` of each component that it may take.
    pub floors: BTreeMap<String, u64>,
    /// Lowest `rollback_index` of any component, as the directive says.
    pub floor: u64,
    /// The site lets components that bear on a safety function in. To validate them is the integrator's duty, not midshift's.
    pub allows_safety_related: bool,
    /// Naive rules, for twins of tests.
    pub bugs: Bugs,
}

/// Why a bundle does not fit a robot.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum Unfit {
    /// For other machines.
    #[error("{component} does not run on model {model:?}")]
    Hardware {
        /// Name of the component.
        component: String,
        /// The robot's.
        model: String,
    },
    /// Going back so far would be dangerous.
    #[error("{component} has rollback index {index}; this robot takes none below {floor}")]
    BelowFloor {
        /// Name of the component.
        component: String,
        /// Its own.
        index: u64,
        /// The robot's.
        floor: u64,
    },
    /// Something is not there, or too old.
    #[error("{component} needs {name} {version} or later")]
    Missing {
        /// Name of the component.
        component: String,
        /// What it needs.
        name: String,
        /// From this version on.
        version: String,
    },
    /// Something is there that must not be.
    #[error("{component} does not go with {name} {version} or earlier")]
    Conflict {
        /// Name of the component.
        component: String,
        /// What it excludes.
        name: String,
        /// Up to this version.
        version: String,
    },
    /// It bears on a safety function.
    #[error(
        "{component} bears on a safety function, which this site does not allow: validating it is the integrator's duty"
    )]
    SafetyRelated {
        /// Name of the component.
        component: String,
    },
    /// It cannot read the work of this midshift.
    #[error("{component} understands levels {lowest} to {highest} of the work protocol, not {WORK_LEVEL}")]
    WorkLevel {
        /// Name of the component.
        component: String,
        /// Its first.
        lowest: u32,
        /// Its last.
        highest: u32,
    },
    /// A robot has one program and one operating system.
    #[error("{first} and {second} are both of kind {}", kind.as_str())]
    Twice {
        /// Name of one component.
        first: String,
        /// And which.
        second: String,
        /// What both are.
        kind: ComponentKind,
    },
}

impl Unfit {
    /// Its code, as counted by a dry run.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::Hardware { .. } => "WRONG_HARDWARE",
            Self::BelowFloor { .. } => "BELOW_FLOOR",
            Self::Missing { .. } => "MISSING_COMPONENT",
            Self::Conflict { .. } => "CONFLICTING_COMPONENT",
            Self::SafetyRelated { .. } => "SAFETY_RELATED",
            Self::WorkLevel { .. } => "WORK_LEVEL",
            Self::Twice { .. } => "TWO_OF_A_KIND",
        }
    }
}

impl SetManifest {
    /// Its bytes: they name it.
    pub fn to_bytes(&self) -> Vec<u8> {
        serde_json::to_vec(self).unwrap_or_else(|e| unreachable!("plain fields: {e}"))
    }
    /// Its name: digest of its bytes.
    pub fn id(&self) -> Digest {
        Digest::of_content(&self.to_bytes())
    }
    /// Its program.
    pub fn program(&self) -> Option<&Component> {
        self.components.values().find(|c| c.kind == ComponentKind::Process)
    }
    /// Its operating system; none: the one that the robot came with.
    pub fn base(&self) -> Option<&Component> {
        self.components.values().find(|c| c.kind == ComponentKind::Base)
    }
    /// Whether it runs on another operating system than `other`: it then takes the slot of the one that `other` does not run on.
    pub fn changes_base(&self, other: &Self) -> bool {
        self.base().map(|base| base.digest) != other.base().map(|base| base.digest)
    }
    /// This set with a bundle over it.
    ///
    /// # Errors
    /// Everything that keeps the bundle from this robot.
    pub fn with(&self, bundle: Digest, manifest: &Manifest, robot: &Fit) -> Result<Self, Vec<Unfit>> {
        let mut set = self.clone();
        set.bundle = Some(bundle);
        set.version = format!("{} {}", manifest.name, manifest.version);
        set.components.extend(manifest.components.iter().map(|c| (c.name.clone(), c.clone())));
        let mut unfit: Vec<Unfit> = manifest.components.iter().flat_map(|c| admissible(c, robot)).collect();
        unfit.extend(set.components.values().flat_map(|c| set.company(c)));
        unfit.extend([ComponentKind::Process, ComponentKind::Base].into_iter().filter_map(|kind| set.twice(kind)));
        if unfit.is_empty() { Ok(set) } else { Err(unfit) }
    }

    /// What `component` finds missing or in its way.
    fn company(&self, component: &Component) -> Vec<Unfit> {
        let name_of = |name: &String, version: &String| (component.name.clone(), name.clone(), version.clone());
        let older = |name: &String, version: &String, or_equal: bool| {
            let there = self.components.get(name)?;
            let (there, asked) = (parse_version(&there.version), parse_version(version));
            Some(if or_equal { there <= asked } else { there < asked })
        };
        let missing = component.requires.iter().filter(|(name, version)| older(name, version, false) != Some(false));
        let conflicts = component.conflicts.iter().filter(|(name, version)| older(name, version, true) == Some(true));
        let missing = missing.map(|(name, version)| {
            let (component, name, version) = name_of(name, version);
            Unfit::Missing { component, name, version }
        });
        missing
            .chain(conflicts.map(|(name, version)| {
                let (component, name, version) = name_of(name, version);
                Unfit::Conflict { component, name, version }
            }))
            .collect()
    }

    fn twice(&self, kind: ComponentKind) -> Option<Unfit> {
        let mut all = self.components.values().filter(|c| c.kind == kind);
        let (first, second) = (all.next()?, all.next()?);
        Some(Unfit::Twice { first: first.name.clone(), second: second.name.clone(), kind })
    }
}

/// What keeps a new component off a robot, whatever else it has.
fn admissible(component: &Component, robot: &Fit) -> Vec<Unfit> {
    let mut unfit = Vec::new();
    let name = || component.name.clone();
    if !component.hardware.contains(&robot.model) {
        unfit.push(Unfit::Hardware { component: name(), model: robot.model.clone() });
    }
    let floor = robot.floors.get(&component.name).copied().unwrap_or(0).max(robot.floor);
    if component.rollback_index < floor && !robot.bugs.floor_is_forgotten() {
        unfit.push(Unfit::BelowFloor { component: name(), index: component.rollback_index, floor });
    }
    if component.safety_class != SafetyClass::None && !robot.allows_safety_related {
        unfit.push(Unfit::SafetyRelated { component: name() });
    }
    let WorkLevels { lowest, highest } = component.work_level;
    if !(lowest..=highest).contains(&WORK_LEVEL) {
        unfit.push(Unfit::WorkLevel { component: name(), lowest, highest });
    }
    unfit
}

/// The floors after `committed` became good while `kept` is what is gone back to: they rise to what was committed, and never above what
/// is kept, or the way back would be closed.
pub fn raised(floors: &BTreeMap<String, u64>, committed: &SetManifest, kept: &SetManifest) -> BTreeMap<String, u64> {
    let mut raised = floors.clone();
    for component in committed.components.values() {
        let most = kept.components.get(&component.name).map_or(u64::MAX, |kept| kept.rollback_index);
        let floor = component.rollback_index.min(most);
        if floor > floors.get(&component.name).copied().unwrap_or(0) {
            raised.insert(component.name.clone(), floor);
        }
    }
    raised
}
