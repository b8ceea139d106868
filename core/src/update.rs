//! Software of a robot: what the server wants of it, and where the robot stands on its way there.
//!
//! Written by the rollout service, sent by telemetry, obeyed by the agent. Invariant: only [`UpdateState::Switching`] and
//! [`UpdateState::RollingBack`] change what runs, and both are on the ledger before the switch record is touched.

use crate::authority::Authority;
use crate::ids::{BundleId, DrainId, RobotId, SetId};
use crate::limits;
use crate::reason::{Reason, Refusal, Violations};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// What the server wants of a robot's software.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    /// Nothing: what is staged may be deleted, what is on trial stays on trial.
    #[default]
    None,
    /// Have it whole on the disk, and work on.
    Stage,
    /// Run it as soon as a grant says so.
    Activate,
    /// It is good: keep it.
    Commit,
    /// Go back to the kept set.
    Revert,
}

/// Permission to activate once.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActivationGrant {
    /// Never used again; rises.
    pub grant_id: u64,
    /// Only while this drain holds the robot.
    pub drain_id: DrainId,
    /// Only this long.
    pub authority: Authority,
}

/// Section `update` of a robot's desired state: whole, newest wins.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredUpdate {
    /// The robot that is to have it.
    pub robot_id: RobotId,
    /// max(previous + 1, unix ms).
    pub generation: u64,
    /// What for.
    pub goal: Goal,
    /// Signed envelope that names the bundle. Empty with [`Goal::None`].
    pub directive: String,
    /// The drain that the robot may activate or go back in.
    pub drain_id: Option<DrainId>,
    /// Permission to activate.
    pub grant: Option<ActivationGrant>,
    /// Bytes a second that it may download. 0: as fast as it goes.
    pub rate_bytes_s: u32,
    /// Milliseconds of site time on probation.
    pub probation_ms: u64,
}

/// Where a robot stands on its way to another set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateState {
    /// The directive was taken; nothing is on the disk.
    Directed,
    /// Bytes come.
    Downloading,
    /// The whole set is on the disk and was read back.
    Staged,
    /// The switch record is being written, or the program is starting.
    Switching,
    /// It runs and gets no work.
    Probation,
    /// It works, and can be gone back from.
    Trial,
    /// The switch record is being written for good.
    Committing,
    /// The kept set is being gone back to.
    RollingBack,
    /// End: it is kept.
    Committed,
    /// End: the kept set runs again.
    RolledBack,
    /// End: it was never run, since something spoke against it.
    Refused,
    /// End: the kept set could not be gone back to. A person must look.
    Stuck,
}

impl UpdateState {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::Directed,
        Self::Downloading,
        Self::Staged,
        Self::Switching,
        Self::Probation,
        Self::Trial,
        Self::Committing,
        Self::RollingBack,
        Self::Committed,
        Self::RolledBack,
        Self::Refused,
        Self::Stuck,
    ];

    /// States that may follow.
    pub const fn transitions(self) -> &'static [Self] {
        match self {
            Self::Directed => &[Self::Downloading, Self::Refused],
            Self::Downloading => &[Self::Staged, Self::Refused],
            // Back to it from SWITCHING: the power went before the record was written.
            Self::Staged => &[Self::Switching, Self::Downloading, Self::Refused],
            Self::Switching => &[Self::Probation, Self::Staged, Self::RollingBack, Self::RolledBack, Self::Refused],
            Self::Probation => &[Self::Trial, Self::RollingBack, Self::RolledBack],
            Self::Trial => &[Self::Committing, Self::RollingBack, Self::RolledBack],
            // Put away by the launcher, or found changed on the disk, before the switch record named it as committed.
            Self::Committing => &[Self::Committed, Self::RollingBack, Self::RolledBack],
            Self::RollingBack => &[Self::RolledBack, Self::Stuck],
            // A committed set may be reverted as long as the one before it is kept.
            Self::Committed => &[Self::RollingBack],
            // By a newer order, once a person mended what kept it.
            Self::Stuck => &[Self::RollingBack],
            Self::RolledBack | Self::Refused => &[],
        }
    }

    /// Nothing is left to do.
    pub const fn is_over(self) -> bool {
        matches!(self, Self::Committed | Self::RolledBack | Self::Refused | Self::Stuck)
    }

    /// The set that the update is about runs, or has just been told to.
    pub const fn is_active(self) -> bool {
        matches!(self, Self::Switching | Self::Probation | Self::Trial | Self::Committing | Self::RollingBack)
    }
}

/// An update as a robot reports it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UpdateReport {
    /// Where it stands.
    pub state: UpdateState,
    /// Which bundle.
    pub bundle: BundleId,
    /// Generation of the directive that asked for it. 0: not told.
    #[serde(default)]
    pub directive_generation: u64,
    /// The set that comes of it; none before it was planned.
    pub set: Option<SetId>,
    /// The drain in which it was activated or gone back from.
    pub drain_id: Option<DrainId>,
    /// Highest grant used. 0: none.
    pub grant_id: u64,
    /// Starts that the set was given.
    pub tries: u32,
    /// Downloaded, thousandths.
    pub progress_permille: u16,
    /// Why it was refused, went back, or waits.
    pub reason: Option<Reason>,
}

/// News of an update from the robot, lane EVENT.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateEvent {
    /// It moved on.
    Changed(UpdateReport),
    /// A directive was not taken.
    DirectiveRefused {
        /// Generation of the section it came in.
        generation: u64,
        /// Why the robot refused it.
        reason: Reason,
    },
    /// It stands, is free of work, and asks for a grant.
    Ready {
        /// In this drain.
        drain_id: DrainId,
        /// To run this set.
        set: SetId,
    },
}

/// Letters of a version of a set: name and version of its bundle, and a space.
const VERSION_LETTERS_MAX: usize = 129;
/// Letters of a name or a version.
const WORD_LETTERS_MAX: usize = 64;

/// What a robot says at Hello that it has installed, signed with the key of its machine.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Installed {
    /// The robot that says it.
    pub robot_id: RobotId,
    /// The start of the agent that says it.
    pub boot_id: String,
    /// Public key of the machine, ed25519, 64 hexadecimal digits. It signed this.
    pub device_key: String,
    /// Maker's model name, as bundles name it; empty: not reported.
    pub model: String,
    /// Bytes of room for software when it last looked. `u64::MAX`: no end is known.
    pub free_bytes: u64,
    /// The set that runs: `current`, or one on trial.
    pub running: SetId,
    /// The set committed last.
    pub current: SetId,
    /// The set committed before it.
    pub previous: Option<SetId>,
    /// Whole sets on its disk that are named or staged. What it came with, `factory`, is in none.
    pub sets: Vec<InstalledSet>,
}

/// One set on a robot's disk.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InstalledSet {
    /// Its digest.
    pub set: SetId,
    /// Digest of the manifest of the bundle taken last.
    pub bundle: Option<BundleId>,
    /// Name and version of that bundle, for people.
    pub version: String,
    /// Versions of its components by name, the first [`limits::INSTALLED_COMPONENTS_MAX`] of them.
    pub components: BTreeMap<String, String>,
    /// Components beyond those.
    pub components_left_out: u32,
}

impl Installed {
    /// Checks every rule: it comes from elsewhere.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn check(&self) -> Result<(), Refusal> {
        let mut bad = Violations::default();
        let mut letters = |field: String, text: &str, most: usize| {
            if text.len() > most {
                bad.add(field, format!("at most {most} bytes"));
            }
        };
        letters("boot_id".to_owned(), &self.boot_id, WORD_LETTERS_MAX);
        letters("model".to_owned(), &self.model, WORD_LETTERS_MAX);
        for (i, set) in self.sets.iter().take(limits::INSTALLED_SETS_MAX).enumerate() {
            letters(format!("sets[{i}].version"), &set.version, VERSION_LETTERS_MAX);
            for (name, version) in &set.components {
                letters(format!("sets[{i}].components"), name, WORD_LETTERS_MAX);
                letters(format!("sets[{i}].components"), version, WORD_LETTERS_MAX);
            }
        }
        let mut ids = BTreeSet::new();
        for (i, set) in self.sets.iter().enumerate() {
            if set.components.len() > limits::INSTALLED_COMPONENTS_MAX {
                bad.add(format!("sets[{i}].components"), format!("at most {}", limits::INSTALLED_COMPONENTS_MAX));
            }
            if !ids.insert(&set.set) {
                bad.add(format!("sets[{i}].set"), "stands twice");
            }
        }
        if self.sets.len() > limits::INSTALLED_SETS_MAX {
            bad.add("sets", format!("at most {}", limits::INSTALLED_SETS_MAX));
        }
        bad.finish()
    }

    /// The set that runs, if it is listed: what the robot came with is not.
    pub fn running_set(&self) -> Option<&InstalledSet> {
        self.sets.iter().find(|set| set.set == self.running)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_state_is_reached_from_the_first_and_every_way_can_end() {
        let reach = |from: UpdateState| {
            let mut seen = vec![from];
            let mut at = 0;
            while let Some(state) = seen.get(at).copied() {
                seen.extend(
                    state.transitions().iter().filter(|next| !seen.contains(next)).copied().collect::<Vec<_>>(),
                );
                at += 1;
            }
            seen
        };
        assert_eq!(reach(UpdateState::Directed).len(), UpdateState::ALL.len());
        for state in UpdateState::ALL {
            assert!(reach(state).iter().any(|s| s.is_over()), "{state:?} never ends");
            assert!(state.is_active() || state.is_over() || reach(state).contains(&UpdateState::Refused), "{state:?}");
        }
    }

    #[test]
    fn nothing_is_committed_that_was_not_on_trial_and_no_probation_is_left_out() {
        for state in UpdateState::ALL {
            let next = state.transitions();
            assert_eq!(next.contains(&UpdateState::Committing), state == UpdateState::Trial, "{state:?}");
            assert_eq!(next.contains(&UpdateState::Trial), state == UpdateState::Probation, "{state:?}");
        }
    }
}
