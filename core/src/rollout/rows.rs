//! Rows that the rollout service alone writes, apart from drains ([`crate::maintenance`]) and from what each robot should run: releases,
//! roll-outs, robots in them, what robots run, and what they must not run.

use super::spec::RolloutSpec;
use super::stamp::Stamp;
use crate::authority::Authority;
use crate::gates::{Effort, Efforts, FailureEvidence, OutcomeEvidence, Suspicion, TaskTally};
use crate::ids::{AreaId, BundleId, DrainId, RobotId, RolloutId};
use crate::reason::Reason;
use crate::rows::{Index, Record, Seq, Table, body_is_json};
use crate::time::Utc;
use crate::update::{DesiredUpdate, UpdateReport};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

impl Record for DesiredUpdate {
    const TABLE: Table = Table::DesiredUpdate;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.generation as i64), ..Index::default() }
    }
}

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
    /// Bytes that a robot needs free beside the two sets that it keeps: all components, the file of the longest as it comes over the wire, which
    /// is at most as long, and a new base once more, in its slot. 0: it was published before that was kept.
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

/// Up to where tasks were counted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counted {
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
    /// Rises with each change of phase, wave or pauses: what people must have seen to judge it. Robots that come and go do not change it.
    #[serde(default)]
    pub version: u64,
    /// Rises with each pause, resume and abort: permissions of an older one are not given any more.
    pub generation: u64,
    /// Robots that are out of work for it: drains that were not released, but for those of robots that were written off.
    pub in_flight: u32,
    /// The wave is only watched until then.
    pub soak: Option<Countdown>,
    /// Work of the wave is waited for until then.
    pub exposure: Option<Countdown>,
    /// Robots that each wave was to have when it began.
    pub sizes: Vec<u32>,
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
    pub counted: Arc<Counted>,
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

/// How far a robot is in a roll-out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Step {
    /// Nothing was asked of it yet.
    Waiting,
    /// It fetches the bundle while it works.
    Staging,
    /// It has the bundle.
    Staged,
    /// It is being taken out of work.
    Draining,
    /// It may activate, or does.
    Activating,
    /// It works with the bundle and can be gone back from.
    Trial,
    /// It was told to keep the bundle.
    Committing,
    /// It is to go back.
    Reverting,
    /// End: it keeps the bundle.
    Committed,
    /// End: it went back.
    RolledBack,
    /// End: it was never touched.
    Skipped,
    /// It could not go back: a person must look.
    Stuck,
}

impl Step {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::Waiting,
        Self::Staging,
        Self::Staged,
        Self::Draining,
        Self::Activating,
        Self::Trial,
        Self::Committing,
        Self::Reverting,
        Self::Committed,
        Self::RolledBack,
        Self::Skipped,
        Self::Stuck,
    ];
    /// Nothing is asked of it any more.
    pub const fn is_over(self) -> bool {
        matches!(self, Self::Committed | Self::RolledBack | Self::Skipped)
    }
    /// The bundle runs on it, or may any moment.
    pub const fn is_active(self) -> bool {
        matches!(self, Self::Activating | Self::Trial | Self::Committing | Self::Reverting | Self::Stuck)
    }
    /// Number in the index of its row.
    pub const fn number(self) -> i64 {
        self as i64
    }
}

/// Permission that was given.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Given {
    /// Its number.
    pub grant_id: u64,
    /// What it is anchored to.
    pub authority: Authority,
    /// Generation of the roll-out in which it was given.
    pub generation: u64,
}

/// Moments of a robot's change, as the server saw them. Each on its own clock; never summed across clocks.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Moments {
    /// The drain was asked for, UTC of the site clock.
    pub asked: Option<Utc>,
    /// The robot got no new work from here on, UTC of the site clock.
    pub draining: Option<Utc>,
    /// The drain held it, UTC of the site clock.
    pub held: Option<Utc>,
    /// The drain held it, link clock.
    pub held_link: Option<Stamp>,
    /// It was given permission, link clock.
    pub granted_link: Option<Stamp>,
    /// It was heard with the bundle, link clock.
    pub switched_link: Option<Stamp>,
    /// It was heard with the bundle, UTC of the site clock.
    pub switched: Option<Utc>,
    /// Its probation was over, UTC of the site clock.
    pub on_trial: Option<Utc>,
}

/// The order to go back that a robot was given.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WayBack {
    /// Generation of the section it came in first. 0: none was given.
    pub generation: u64,
    /// When a directive of its own was signed for it, UTC of the wall. None: it goes by the one that the robot took.
    pub signed: Option<Utc>,
    /// Why the robot did not take it.
    pub refused: Option<Reason>,
    /// The robot did not take the one before it either, though that one was not too old to be taken.
    pub again: bool,
    /// A person mended what kept the robot from going back: only an answer to an order of its own counts from then on.
    #[serde(default)]
    pub unstuck: bool,
}

impl WayBack {
    /// Whether what a robot says of its update comes after the order that it was given.
    pub const fn is_answered_by(&self, report: &UpdateReport) -> bool {
        !self.unstuck || (self.generation > 0 && report.directive >= self.generation)
    }
}

/// A robot that is out of work for a roll-out and was not heard for longer than the roll-out bears.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lost {
    /// UTC, site clock, when a person was told.
    pub since: Utc,
    /// Who said that it counts in no budget until it is heard. None: nobody did.
    pub written_off: Option<Act>,
}

/// One robot in one roll-out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RolloutRobot {
    /// The roll-out.
    pub rollout_id: RolloutId,
    /// The robot.
    pub robot_id: RobotId,
    /// Its wave, from 0. The number of waves: it came after the roll-out was completed.
    pub wave: u32,
    /// Its place within the wave.
    pub place: u64,
    /// How far it is.
    pub step: Step,
    /// Since when, UTC, site clock.
    pub since: Utc,
    /// What it ran before.
    pub from_version: String,
    /// Generation of the directive that was signed for it first. 0: none was.
    pub directive: u64,
    /// When the newest was signed, UTC of the wall.
    pub signed: Utc,
    /// The order to go back that it was given last.
    #[serde(default)]
    pub way_back: WayBack,
    /// The drain that was not released yet.
    pub drain_id: Option<DrainId>,
    /// The robot asked for permission in its drain.
    pub ready: bool,
    /// Newest permission that was not seen unused.
    pub grant: Option<Given>,
    /// The last permission of its drain was seen unused.
    #[serde(default)]
    pub not_used: bool,
    /// It was given permission at least once.
    pub attempted: bool,
    /// It counts against the bundle.
    pub failure: Option<Reason>,
    /// Why it was skipped, or went back though it did not fail.
    pub why: Option<Reason>,
    /// It was tried a second time.
    pub again: bool,
    /// Tasks it had ended with this version when its trial began.
    pub before: TaskTally,
    /// What work had cost it with this version by then.
    #[serde(default)]
    pub effort_before: Effort,
    /// When what happened.
    pub moments: Moments,
    /// It is lost. None: it is heard, or has not been silent for long.
    #[serde(default)]
    pub lost: Option<Lost>,
}

impl RolloutRobot {
    /// Its drain counts among the robots that are out of work.
    pub fn counts(&self) -> bool {
        self.lost.as_ref().is_none_or(|lost| lost.written_off.is_none())
    }
    /// It was given no permission, or was seen to have left the last one unused.
    pub const fn never_ran(&self) -> bool {
        !self.attempted || (self.not_used && self.moments.switched.is_none())
    }
    /// Its row id.
    pub fn id_of(rollout_id: &RolloutId, robot_id: &RobotId) -> String {
        format!("{rollout_id}/{robot_id}")
    }
}

impl Record for RolloutRobot {
    const TABLE: Table = Table::RolloutRobot;
    body_is_json!();
    fn id(&self) -> String {
        Self::id_of(&self.rollout_id, &self.robot_id)
    }
    fn index(&self) -> Index {
        let parent = Some(self.rollout_id.as_str().into());
        Index { state: Some(self.step.number()), parent, order: Some(i64::from(self.wave)) }
    }
}

/// What a robot runs, as far as it said.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RobotSoftware {
    /// The robot that said it.
    pub robot_id: RobotId,
    /// The bundle it has committed; none: what it came with.
    pub committed: Option<BundleId>,
    /// The bundle it had committed before that one, and goes back to.
    pub previous: Option<BundleId>,
    /// The bundle that runs, if it is not the committed one.
    pub on_trial: Option<BundleId>,
    /// Version it reports.
    pub version: String,
    /// What it said of its update last.
    pub report: Option<UpdateReport>,
    /// A person keeps it at what it runs.
    pub pin: Option<Act>,
    /// Area it was last seen in.
    pub area: Option<AreaId>,
    /// UTC, site clock, of the last change.
    pub since: Utc,
    /// The device key of its machine that a person took though another one was known, 64 lower-case hexadecimal digits; none: nobody did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device_key: Option<String>,
}

impl RobotSoftware {
    /// A robot that has said nothing.
    pub fn new(robot_id: RobotId) -> Self {
        Self {
            robot_id,
            committed: None,
            previous: None,
            on_trial: None,
            version: String::new(),
            report: None,
            pin: None,
            area: None,
            since: Utc(0),
            device_key: None,
        }
    }
    /// The bundle that runs; none: what it came with.
    pub fn runs(&self) -> Option<&BundleId> {
        self.on_trial.as_ref().or(self.committed.as_ref())
    }
}

impl Record for RobotSoftware {
    const TABLE: Table = Table::RobotSoftware;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// A bundle that a robot went back from: it does not get it again until a person says so.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Quarantine {
    /// Which robot.
    pub robot_id: RobotId,
    /// Which bundle.
    pub bundle: BundleId,
    /// In which roll-out.
    pub rollout_id: RolloutId,
    /// What the robot failed by.
    pub reason: Reason,
    /// UTC, site clock.
    pub since: Utc,
}

impl Quarantine {
    /// Its row id.
    pub fn id_of(robot_id: &RobotId, bundle: &BundleId) -> String {
        format!("{robot_id}/{bundle}")
    }
}

impl Record for Quarantine {
    const TABLE: Table = Table::Quarantine;
    body_is_json!();
    fn id(&self) -> String {
        Self::id_of(&self.robot_id, &self.bundle)
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), order: Some(self.since.0), ..Index::default() }
    }
}

/// What robots get that come to an area later.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaBundle {
    /// Which area.
    pub area_id: AreaId,
    /// The newest completed roll-out, by hardware model.
    pub rollouts: BTreeMap<String, RolloutId>,
}

impl Record for AreaBundle {
    const TABLE: Table = Table::AreaBundle;
    body_is_json!();
    fn id(&self) -> String {
        self.area_id.to_string()
    }
}

/// How far the rollout service has consumed the feed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OtaMark {
    /// Every entry up to here has had its effect.
    pub seq: Seq,
}

impl Record for OtaMark {
    const TABLE: Table = Table::OtaMark;
    body_is_json!();
    fn id(&self) -> String {
        "ota".to_owned()
    }
}

/// Serving time of the rollout service, and the last number it gave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OtaClock {
    /// Milliseconds served on the site clock.
    pub site_ms: u64,
    /// Last number of a drain or permission.
    pub number: u64,
}

impl Record for OtaClock {
    const TABLE: Table = Table::OtaClock;
    body_is_json!();
    fn id(&self) -> String {
        "ota".to_owned()
    }
}

/// A used request_id of a command.
pub type CommandKey = crate::once::CommandKey<super::requests::Command>;
