//! Rows of bundles and of roll-outs: what people did, phases, pauses, verdicts, and how it ended.

use crate::gates::{Effort, Efforts, FailureEvidence, OutcomeEvidence, Suspicion, TaskTally};
use crate::ids::{BundleId, RobotId, RolloutId};
use crate::reason::Reason;
use crate::rollout::projection::spec::RolloutSpec;
use crate::rollout::projection::timestamp::Stamp;
use crate::rows::{Index, Record, Table, body_is_json};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What somebody did, when and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Act {
    /// The actor that did it, by name.
    pub actor: String,
    /// The person whose token it was; none: none was named, and the actor stands for itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub person: Option<String>,
    /// Why; may be empty.
    pub reason: String,
    /// UTC, site clock.
    pub at: Utc,
}

impl Act {
    /// Who stands behind it.
    pub fn person(&self) -> &str {
        self.person.as_deref().unwrap_or(&self.actor)
    }
}

/// A bundle of a published release.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Bundle {
    /// Digest of its manifest.
    pub bundle: BundleId,
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Bytes of the manifest.
    pub manifest_length: u64,
    /// Bytes of all components.
    pub length: u64,
    /// Bytes that a robot needs free beside the two sets that it keeps: all components, the file of the longest as it
    /// comes over the wire, which is at most as long, and a new base once more, in its slot. 0: it was published before
    /// that was kept.
    #[serde(default)]
    pub room: u64,
    /// Models that every component runs on.
    pub hardware: BTreeSet<String>,
    /// What a robot must do to change to it: `none`, `restart`, `park`, `reboot`.
    pub needs: String,
    /// Fault codes that end a roll-out at once.
    pub hard_stop_codes: BTreeSet<u32>,
    /// It cannot be gone back from once it is committed.
    pub is_irreversible: bool,
    /// It replaces the base system: staging it destroys what was kept.
    pub has_base: bool,
    /// Components that its own need beside them, and their lowest versions.
    #[serde(default)]
    pub requires: BTreeMap<String, String>,
    /// The lowest `rollback_index` of its components. None: it was published before that was kept.
    #[serde(default)]
    pub rollback_index: Option<u64>,
    /// The newest release lists it.
    pub listed: bool,
    /// A person took it back.
    pub revoked: Option<Act>,
    /// UTC of the wall when it was first published here.
    pub published: Utc,
    /// UTC, site clock, when a roll-out of it ended last. None: none has.
    #[serde(default)]
    pub ended: Option<Utc>,
}

impl Bundle {
    /// As people call it.
    pub fn label(&self) -> String {
        format!("{}-{}", self.name, self.version)
    }
}

impl Record for Bundle {
    const TABLE: Table = Table::Bundle;
    body_is_json!();
    fn id(&self) -> String {
        self.bundle.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.published.0), ..Index::default() }
    }
}

/// Where a roll-out is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Written down.
    Draft,
    /// Its dry run found nothing that speaks against it.
    Validated,
    /// A person stands for it.
    Approved,
    /// Robots fetch it while they work.
    Prefetching,
    /// Robots of its wave change to it.
    Applying,
    /// Its wave works on trial and is watched.
    Soaking,
    /// Its wave is judged, as soon as it has worked enough.
    Gate,
    /// A person must judge it.
    Review,
    /// It ends: nobody activates it any more, and permissions that may be alive are waited out.
    Aborting,
    /// Robots that it touched go back.
    RollingBack,
    /// End: every robot is decided.
    Completed,
    /// End: every robot that it touched is back, or will be before it works again.
    Aborted,
    /// End: another took its place.
    Superseded,
}

impl Phase {
    /// All of them.
    pub const ALL: [Self; 13] = [
        Self::Draft,
        Self::Validated,
        Self::Approved,
        Self::Prefetching,
        Self::Applying,
        Self::Soaking,
        Self::Gate,
        Self::Review,
        Self::Aborting,
        Self::RollingBack,
        Self::Completed,
        Self::Aborted,
        Self::Superseded,
    ];
    /// Nothing follows.
    pub const fn is_over(self) -> bool {
        matches!(self, Self::Completed | Self::Aborted | Self::Superseded)
    }
    /// Robots may be given it.
    pub const fn runs(self) -> bool {
        matches!(self, Self::Prefetching | Self::Applying | Self::Soaking | Self::Gate | Self::Review)
    }
    /// It goes back.
    pub const fn goes_back(self) -> bool {
        matches!(self, Self::Aborting | Self::RollingBack | Self::Aborted | Self::Superseded)
    }
    /// Number in the index of its row.
    pub fn number(self) -> i64 {
        Self::ALL.iter().position(|p| *p == self).unwrap_or_default() as i64
    }
}

/// Why a roll-out stands still.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pause {
    /// A person said so.
    Operator,
    /// Robots are not heard, and neither are those that it did not touch.
    Infrastructure,
    /// Robots are not heard, and too few others are there to compare them with.
    InfrastructureUnknown,
    /// Its bundle was taken back.
    Revoked,
    /// The server has no key whose orders robots take: none could be told anything, nor be ordered back anew.
    Keyless,
    /// Robots refused its bytes or its documents. A person resumes it.
    Content,
}

/// How a roll-out ended that nothing ended early.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// As many robots as its spec asks have its bundle, or went back if it takes one back.
    Complete,
    /// Fewer do.
    Incomplete,
}

/// A stretch of serving time on the site clock that can stand still.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Countdown {
    /// Serving time at which it is over, milliseconds. None: it stands still.
    pub ends_at_ms: Option<u64>,
    /// Left while it stands still, milliseconds.
    pub left_ms: u64,
}

impl Countdown {
    /// Begins at this serving time.
    pub const fn new(now_ms: u64, length_ms: u64) -> Self {
        Self { ends_at_ms: Some(now_ms + length_ms), left_ms: length_ms }
    }
    /// Left at this serving time.
    pub const fn left(&self, now_ms: u64) -> u64 {
        match self.ends_at_ms {
            Some(end) => end.saturating_sub(now_ms),
            None => self.left_ms,
        }
    }
    /// Stands still, or goes on.
    #[must_use]
    pub const fn set_running(&self, now_ms: u64, runs: bool) -> Self {
        let left_ms = self.left(now_ms);
        if runs { Self::new(now_ms, left_ms) } else { Self { ends_at_ms: None, left_ms } }
    }
}

/// What a gate said.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Enough robots did well.
    Promoted,
    /// Nothing speaks against it, and too few were seen to prove it.
    PromotedUnproven,
    /// A person let it go on.
    PromotedByPerson,
    /// A person must judge it.
    Review,
    /// It ends.
    Aborted,
}

/// A verdict with the numbers behind it. Never changed afterwards.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Verdict {
    /// After which wave, from 0.
    pub wave: u32,
    /// What follows for the roll-out.
    pub outcome: Outcome,
    /// What was seen that led to it.
    pub reason: Reason,
    /// Robots that were given permission, over the whole roll-out.
    pub attempted: u32,
    /// What robots that were decided say.
    pub robots: OutcomeEvidence,
    /// What their tasks say, beside those of the others.
    pub tasks: FailureEvidence,
    /// What follows from the tasks; it ends a roll-out only if its spec or the rules of an area say so.
    pub suspicion: Suspicion,
    /// What work cost them, beside that of the others.
    #[serde(default)]
    pub efforts: Efforts,
    /// UTC, site clock.
    pub at: Utc,
    /// Who, if it was a person.
    pub actor: Option<String>,
}

/// Why a roll-out ends early. Latched.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Abort {
    /// What was seen or asked that ends it.
    pub reason: Reason,
    /// On one event: robots on its bundle get no work from now on, whatever the budget.
    pub hard: bool,
    /// Robots behind it, at most 16.
    pub robots: Vec<RobotId>,
    /// Robots that had been given permission to activate by then.
    pub touched: u32,
    /// UTC, site clock.
    pub at: Utc,
    /// The same moment on the link clock. None: it was latched before that was kept.
    #[serde(default)]
    pub link: Option<Stamp>,
    /// Who, if it was a person.
    pub actor: Option<String>,
}

/// The tasks that were counted up to the last count, from which newer ones are counted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskBaseline {
    /// Serving time of the last count, milliseconds of the site clock.
    pub at_ms: u64,
    /// All that had ended on trial by then, by robot.
    pub trial: BTreeMap<RobotId, TaskTally>,
    /// All that had ended with any other version by then, since ever.
    pub control: TaskTally,
    /// What work had cost robots with any other version when the roll-out began, since ever.
    #[serde(default)]
    pub effort: Effort,
}

/// One roll-out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rollout {
    /// Its id, as its author chose it.
    pub rollout_id: RolloutId,
    /// What was asked for.
    pub spec: Arc<RolloutSpec>,
    /// Where it is.
    pub phase: Phase,
    /// Its wave, from 0.
    pub wave: u32,
    /// Why it stands still.
    pub pauses: BTreeSet<Pause>,
    /// Rises with each change of phase, wave or pauses: what people must have seen to judge it. Robots that come and go
    /// do not change it.
    #[serde(default)]
    pub version: u64,
    /// Rises with each pause, resume and abort: permissions of an older one are not given any more.
    pub generation: u64,
    /// Robots that are out of work for it: drains that were not released, but for those of robots that were written
    /// off.
    pub in_flight: u32,
    /// The wave is only watched until then.
    pub soak: Option<Countdown>,
    /// Work of the wave is waited for until then.
    pub exposure: Option<Countdown>,
    /// Robots that each wave was to have when it began.
    pub wave_sizes: Vec<u32>,
    /// Waves that are kept, from the first.
    pub promoted: u32,
    /// Verdicts so far.
    pub verdicts: Vec<Verdict>,
    /// Why it ends early.
    pub abort: Option<Abort>,
    /// Robots that were skipped are being tried once more.
    pub second_pass: bool,
    /// It takes this one back instead of bringing something.
    pub revert_of: Option<RolloutId>,
    /// It takes the place of these as soon as they have ended.
    pub supersedes: BTreeSet<RolloutId>,
    /// Another takes its place.
    pub superseded_by: Option<RolloutId>,
    /// What tasks say of the bundle so far.
    pub tasks: FailureEvidence,
    /// Up to where tasks were counted for that.
    pub counted: Arc<TaskBaseline>,
    /// What work cost its robots and the others when tasks were counted last.
    #[serde(default)]
    pub efforts: Efforts,
    /// Who wrote it down.
    pub created: Act,
    /// Who stands for it.
    pub approved: Option<Act>,
    /// UTC, site clock, when it began.
    pub started: Option<Utc>,
    /// UTC, site clock, when it went on after it stood still. None: it never stood still.
    #[serde(default)]
    pub resumed: Option<Utc>,
    /// UTC, site clock, when it came to its phase.
    pub since: Utc,
    /// How it ended. None: it is not completed, or was before that was kept.
    #[serde(default)]
    pub outcome: Option<Ending>,
    /// Robots that had refused its content when a person resumed it: they hold it no more.
    #[serde(default)]
    pub refusals_seen: BTreeSet<RobotId>,
}

impl Rollout {
    /// Robots may be taken out of work for it.
    pub fn may_go_on(&self) -> bool {
        self.phase == Phase::Applying && self.pauses.is_empty()
    }
    /// Why it stands still, as words.
    pub fn pauses_text(&self) -> String {
        let word = |pause: &Pause| format!("{pause:?}").to_uppercase();
        self.pauses.iter().map(word).collect::<Vec<_>>().join(",")
    }
}

impl Record for Rollout {
    const TABLE: Table = Table::Rollout;
    body_is_json!();
    fn id(&self) -> String {
        self.rollout_id.to_string()
    }
    fn index(&self) -> Index {
        Index { state: Some(self.phase.number()), order: Some(self.created.at.0), ..Index::default() }
    }
}
