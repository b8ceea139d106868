//! Rows of robots: how far each is in a roll-out, what it runs, and what it must not run.

use super::rollout::Act;
use crate::authority::Authority;
use crate::gates::{Effort, TaskTally};
use crate::ids::{AreaId, BundleId, DrainId, RobotId, RolloutId};
use crate::reason::Reason;
use crate::rollout::projection::timestamp::Stamp;
use crate::rows::{Index, Record, Table, body_is_json};
use crate::time::Utc;
use crate::update::UpdateReport;
use serde::{Deserialize, Serialize};

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

/// The permission that a robot was given to change its software.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GivenPermission {
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
        !self.unstuck || (self.generation > 0 && report.directive_generation >= self.generation)
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
    /// Its rank within the wave: robots with a lower one come first.
    pub rank: u64,
    /// How far it is.
    pub step: Step,
    /// Since when, UTC, site clock.
    pub since: Utc,
    /// What it ran before.
    pub from_version: String,
    /// Generation of the directive that was signed for it first. 0: none was.
    pub directive_generation: u64,
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
    pub grant: Option<GivenPermission>,
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
    /// The device key of its machine that a person took though another one was known, 64 lower-case hexadecimal digits;
    /// none: nobody did.
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
