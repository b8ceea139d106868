//! Whom a roll-out would reach, who is left out and why, and in which wave each comes.
//!
//! Called by the dry run and by the start, which therefore never differ. Invariant: the rank of a robot depends on the
//! roll-out's id and its own, never on the order in which robots came.

use crate::fleet::Board;
use crate::fleet::rows::RobotControl;
use crate::ids::{AreaId, RobotId, RolloutId};
use crate::reason::{Code, Reason};
use crate::robot::Duty;
use crate::rollout::projection::rows::{Act, Bundle, Quarantine, Rollout, RolloutRobot, Step};
use crate::rollout::projection::spec::{RolloutSpec, Wave};
use crate::rollout::projection::state::RolloutProjection;
use std::collections::{BTreeMap, BTreeSet};

/// One robot that a roll-out would reach.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Matched {
    /// The robot that would be reached.
    pub robot_id: RobotId,
    /// Its wave, from 0.
    pub wave: u32,
    /// Its rank within the wave: robots with a lower one come first.
    pub rank: u64,
    /// What is alike about it.
    pub stratum: Stratum,
}

/// What is alike about robots as far as software is concerned.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Stratum {
    /// Hardware model.
    pub model: String,
    /// Capabilities, ascending.
    pub capabilities: Vec<String>,
    /// Area it is in; none: not known.
    pub area: Option<AreaId>,
    /// Version it runs.
    pub from_version: String,
}

/// Whom a roll-out would reach.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Matching {
    /// By wave and rank.
    pub robots: Vec<Matched>,
    /// Robots that were selected and are left out, and why.
    pub left_out: BTreeMap<RobotId, Reason>,
}

impl Matching {
    /// Robots of each wave.
    pub fn sizes(&self, waves: usize) -> Vec<u32> {
        let mut sizes = vec![0; waves];
        for robot in &self.robots {
            if let Some(size) = sizes.get_mut(robot.wave as usize) {
                *size += 1;
            }
        }
        sizes
    }
    /// Robots left out, by reason.
    pub fn left_out_by_code(&self) -> BTreeMap<Code, u32> {
        let mut counts = BTreeMap::new();
        self.left_out.values().for_each(|r| *counts.entry(r.code).or_default() += 1);
        counts
    }
    /// Robots alike, and whether the first wave has one of them.
    pub fn strata(&self) -> BTreeMap<Stratum, (u32, bool)> {
        let mut strata = BTreeMap::new();
        for robot in &self.robots {
            let (count, first) = strata.entry(robot.stratum.clone()).or_insert((0, false));
            *count += 1;
            *first |= robot.wave == 0;
        }
        strata
    }
}

/// Matches every robot that ever attached.
pub fn match_robots(
    view: &RolloutProjection,
    board: &Board,
    id: &RolloutId,
    spec: &RolloutSpec,
    bundle: &Bundle,
) -> Matching {
    let mut matching = Matching::default();
    let mut found = Vec::new();
    for robot_id in view.sessions.values().map(|s| &s.row.robot_id) {
        let Some(stratum) = stratum_of(view, board, robot_id).filter(|s| is_selected(view, robot_id, s, spec)) else {
            continue;
        };
        match may_have(view, robot_id, &stratum, bundle) {
            Ok(()) => found.push((rank_of(id, robot_id), robot_id.clone(), stratum)),
            Err(reason) => {
                matching.left_out.insert(robot_id.clone(), reason);
            }
        }
    }
    found.sort();
    let all = found.len();
    let mut left: Vec<_> = found.into_iter().map(Some).collect();
    for (wave, what) in (0..).zip(&spec.waves) {
        let mut room = match what {
            Wave::Count(count) => *count as usize,
            Wave::Percent(percent) => (all * *percent as usize).div_ceil(100),
            _ => all,
        };
        for slot in &mut left {
            let belongs = slot.as_ref().is_some_and(|(_, robot_id, stratum)| match what {
                Wave::Label { key, value } => label_of(view, robot_id, key) == Some(value.as_str()),
                Wave::Version(version) => stratum.from_version == *version,
                _ => true,
            });
            if room > 0
                && belongs
                && let Some((rank, robot_id, stratum)) = slot.take()
            {
                room -= 1;
                matching.robots.push(Matched { robot_id, wave, rank, stratum });
            }
        }
    }
    // Whom no wave takes, no wave reaches.
    for (_, robot_id, _) in left.into_iter().flatten() {
        matching.left_out.insert(robot_id, Code::SkippedExcluded.into());
    }
    matching
}

/// What is alike about this robot; none: it never attached.
pub fn stratum_of(view: &RolloutProjection, board: &Board, robot_id: &RobotId) -> Option<Stratum> {
    let inventory = &view.sessions.get(robot_id.as_str())?.row.inventory;
    let here = board.get(robot_id).and_then(|live| view.area_of(live));
    let mut capabilities = inventory.capabilities.clone();
    capabilities.sort();
    Some(Stratum {
        model: inventory.model.clone(),
        capabilities,
        area: here.or_else(|| view.software.get(robot_id.as_str()).and_then(|s| s.row.area.clone())),
        from_version: inventory.software.clone(),
    })
}

fn label_of<'a>(view: &'a RolloutProjection, robot_id: &RobotId, key: &str) -> Option<&'a str> {
    let control = view.control.get(robot_id.as_str()).map(|c| &c.row);
    RobotControl::label(control, &view.sessions.get(robot_id.as_str())?.row.inventory, key)
}

/// Whether a roll-out is for a robot, as far as its selector goes.
pub fn is_selected(view: &RolloutProjection, robot_id: &RobotId, stratum: &Stratum, spec: &RolloutSpec) -> bool {
    fn any<T: Ord>(named: &BTreeSet<T>, has: Option<&T>) -> bool {
        named.is_empty() || has.is_some_and(|has| named.contains(has))
    }
    let s = &spec.selector;
    any(&s.robots, Some(robot_id))
        && any(&s.areas, stratum.area.as_ref())
        && any(&s.models, Some(&stratum.model))
        && any(&s.versions, Some(&stratum.from_version))
        && s.labels.iter().all(|(key, value)| label_of(view, robot_id, key) == Some(value.as_str()))
}

/// Whether a roll-out would have reached this robot had it been there: it is selected, and some wave takes all that are
/// like it.
pub fn is_meant_for(view: &RolloutProjection, robot_id: &RobotId, stratum: &Stratum, spec: &RolloutSpec) -> bool {
    let takes = |wave: &Wave| match wave {
        Wave::Rest | Wave::Percent(100..) => true,
        Wave::Label { key, value } => label_of(view, robot_id, key) == Some(value.as_str()),
        Wave::Version(version) => stratum.from_version == *version,
        Wave::Count(_) | Wave::Percent(_) => false,
    };
    is_selected(view, robot_id, stratum, spec) && spec.waves.iter().any(takes)
}

/// A person keeps the robot at what it runs.
pub fn pin_reason(pin: &Act) -> Reason {
    Reason::from(Code::SkippedPinned).with("pinned_by", &pin.actor).with("why", &pin.reason)
}

/// Its machine shows another device key than the one that is known, and nobody enrolled or took it: it is given
/// nothing.
pub fn other_key(view: &RolloutProjection, robot_id: &RobotId) -> Option<Reason> {
    let key = view.sessions.get(robot_id.as_str())?.row.other_device_key.as_ref()?;
    let accepted = view.software.get(robot_id.as_str()).and_then(|s| s.row.device_key.as_ref());
    if accepted == Some(key) {
        return None;
    }
    Some(Reason::from(Code::SkippedOtherKey).with("robot_id", robot_id).with("device_key", key))
}

/// Robots of a roll-out with wave, rank and version they run, and how many each wave has.
pub type Members = (Vec<(RobotId, u32, u64, String)>, Vec<u32>);

/// Whom a roll-out reaches.
pub fn find_members(view: &RolloutProjection, board: &Board, rollout: &Rollout) -> Members {
    if let Some(original) = rollout.revert_of.as_ref().and_then(|of| view.rollout(of)) {
        let kept = view.robots_of(&original.rollout_id).filter(|r| is_kept(view, original, r));
        let member = |r: &RolloutRobot| {
            let rank = rank_of(&rollout.rollout_id, &r.robot_id);
            (r.robot_id.clone(), 0, rank, view.software_of(&r.robot_id).version)
        };
        let mut kept: Vec<_> = kept.map(member).collect();
        kept.sort_by_key(|(_, _, rank, _)| *rank);
        let count = kept.len() as u32;
        return (kept, vec![count]);
    }
    let Some(bundle) = view.bundles.get(rollout.spec.bundle.as_str()) else { return Members::default() };
    let matching = match_robots(view, board, &rollout.rollout_id, &rollout.spec, &bundle.row);
    let sizes = matching.sizes(rollout.spec.waves.len());
    let robots = matching.robots.into_iter();
    (robots.map(|m| (m.robot_id, m.wave, m.rank, m.stratum.from_version)).collect(), sizes)
}

/// A robot keeps what the roll-out brought, or is about to: a roll-out is completed before the last of its robots has
/// said so.
pub fn is_kept(view: &RolloutProjection, rollout: &Rollout, r: &RolloutRobot) -> bool {
    let software = view.software.get(r.robot_id.as_str()).map(|s| &s.row);
    let kept = matches!(r.step, Step::Trial | Step::Committing | Step::Committed);
    kept && software.and_then(|s| s.runs()) == Some(&rollout.spec.bundle)
}

/// Whether a robot may have a bundle at all.
pub fn may_have(
    view: &RolloutProjection,
    robot_id: &RobotId,
    stratum: &Stratum,
    bundle: &Bundle,
) -> Result<(), Reason> {
    if view.duty(robot_id) == Duty::Retired {
        return Err(Code::SkippedRetired.into());
    }
    if let Some(reason) = other_key(view, robot_id) {
        return Err(reason);
    }
    let software = view.software.get(robot_id.as_str()).map(|s| &s.row);
    if let Some(pin) = software.and_then(|s| s.pin.as_ref()) {
        return Err(pin_reason(pin));
    }
    if let Some(known) = view.quarantines.get(Quarantine::id_of(robot_id, &bundle.bundle).as_str()) {
        return Err(Reason::from(Code::SkippedQuarantined).with("because", known.row.reason.code));
    }
    if !bundle.hardware.contains(&stratum.model) {
        return Err(Reason::from(Code::SkippedIncompatible).with("model", &stratum.model));
    }
    if software.is_some_and(|s| s.on_trial.is_none() && s.committed.as_ref() == Some(&bundle.bundle)) {
        return Err(Code::SkippedCurrent.into());
    }
    Ok(())
}

/// Place of a robot in a roll-out: FNV-1a over both ids, so that each roll-out begins with other robots, and then
/// stirred as the end of MurmurHash3 does: FNV alone leaves robots with neighbouring numbers, which often stand and
/// work alike, side by side.
pub fn rank_of(rollout: &RolloutId, robot: &RobotId) -> u64 {
    let bytes = rollout.as_str().bytes().chain([0]).chain(robot.as_str().bytes());
    let fold = |hash: u64, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    let stir = |hash: u64, by: u64| (hash ^ (hash >> 33)).wrapping_mul(by);
    let stirred = stir(stir(bytes.fold(0xcbf2_9ce4_8422_2325, fold), 0xff51_afd7_ed55_8ccd), 0xc4ce_b9fe_1a85_ec53);
    stirred ^ (stirred >> 33)
}

/// The roll-out that has this robot now, other than `than`.
pub fn claimed_by<'a>(view: &'a RolloutProjection, robot_id: &RobotId, than: &RolloutId) -> Option<&'a RolloutId> {
    let others = view.of_robot.get(robot_id)?.iter().filter(|id| *id != than);
    others.into_iter().find(|id| {
        let (Some(rollout), Some(robot)) = (view.rollout(id), view.robot_of(id, robot_id)) else { return false };
        let untouched = robot.step == Step::Waiting && !rollout.phase.goes_back();
        // What has ended may still have to go back.
        let returns = rollout.phase.goes_back() && !rollout.phase.is_over() && robot.step == Step::Committed;
        // Of two that only wait, the one that began first goes first.
        let waits_behind = untouched && view.rollout(than).is_some_and(|t| t.started < rollout.started);
        (!robot.step.is_over() || returns) && !waits_behind
    })
}
