//! What a roll-out would do, and everything that speaks against it, before anything of it is written.
//!
//! Called by whoever asks and by the commands that begin one, which therefore never differ.

use crate::fleet::Board;
use crate::ids::{AreaId, BundleId, RobotId, RolloutId};
use crate::reason::{Code, Kind, Reason, Refusal, Violations};
use crate::rollout::judgement::verdict::{self, ActsOnRates};
use crate::rollout::members::matching::{self, Matched, Matching, Members};
use crate::rollout::projection::rows::{Bundle, Rollout};
use crate::rollout::projection::spec::{RolloutSpec, Wave};
use crate::rollout::projection::state::RolloutProjection;
use crate::task::raw::parse_version;
use crate::update::Installed;
use std::collections::BTreeSet;

/// Milliseconds of site time for which an estimate takes a robot out of work, beside its probation: to end its task and
/// to park.
const PLANNED_OFF_WORK_MS: u64 = 120_000;
/// A probation shorter than this is told to be short, milliseconds.
const SHORT_PROBATION_MS: u64 = 60_000;
/// Robots that a caveat names.
const NAMED_MAX: usize = 5;

/// What a roll-out would do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DryRun {
    /// Whom it would reach.
    pub matching: Matching,
    /// Bytes of all components.
    pub bytes: u64,
    /// Milliseconds of site time that it takes at least, under the budgets.
    pub least_ms: u64,
    /// What a person should know, and what nothing forbids.
    pub caveats: Vec<String>,
}

/// A bundle that may be given to robots.
///
/// # Errors
/// None is called so, or it was taken back.
pub fn find_bundle<'a>(view: &'a RolloutProjection, id: &BundleId) -> Result<&'a Bundle, Refusal> {
    let bundle = view.bundles.get(id.as_str()).map(|b| &b.row);
    let bundle =
        bundle.ok_or_else(|| Refusal::new(Kind::NotFound, Reason::from(Code::BundleNotFound).with("bundle", id)))?;
    if bundle.revoked.is_some() || !bundle.listed {
        return Err(Refusal::new(Kind::Precondition, Reason::from(Code::BundleRevoked).with("bundle", id)));
    }
    Ok(bundle)
}

/// Whether the bundle meets the floor that is asked for.
///
/// # Errors
/// Every robot would refuse it.
pub fn meets_floor(bundle: &Bundle, spec: &RolloutSpec) -> Result<(), Refusal> {
    match bundle.rollback_index.filter(|index| *index < spec.rollback_floor) {
        Some(index) => {
            let rule = format!("must be at most {index}, the lowest of the bundle: every robot would refuse it");
            Err(Refusal::field("rollback_floor", rule))
        }
        None => Ok(()),
    }
}

/// What a roll-out would do, or everything that speaks against it.
///
/// # Errors
/// A bundle that is not there; rules that are broken; a floor above the bundle; nobody matched; a first wave that is
/// too large; a budget that lets nobody out.
pub fn dry_run(view: &RolloutProjection, board: &Board, id: &RolloutId, spec: &RolloutSpec) -> Result<DryRun, Refusal> {
    let mut bad = Violations::default();
    spec.check(&mut bad);
    bad.finish()?;
    let bundle = find_bundle(view, &spec.bundle)?;
    meets_floor(bundle, spec)?;
    let matching = matching::match_robots(view, board, id, spec, bundle);
    let robots = matching.robots.len();
    if robots == 0 {
        let mut reason = Reason::from(Code::RolloutMatchesNobody);
        for (code, count) in matching.left_out_by_code().into_iter().take(8) {
            reason = reason.with(code.as_str(), count);
        }
        return Err(Refusal::new(Kind::Precondition, reason));
    }
    let sizes = matching.sizes(spec.waves.len());
    // A wave that takes nobody proves nothing: the first is the first with a robot in it.
    let first = sizes.iter().copied().find(|size| *size > 0).unwrap_or_default() as usize;
    if !spec.allow_full_push && first > (robots / 10).max(1) {
        let reason = Reason::from(Code::RolloutFullPush).with("first_wave", first).with("robots", robots);
        return Err(Refusal::new(Kind::Precondition, reason));
    }
    check_budgets(view, &matching)?;
    let caveats = find_caveats(view, board, spec, bundle, &matching);
    Ok(DryRun { least_ms: least_ms(view, spec, &matching), bytes: bundle.length, matching, caveats })
}

/// Areas whose rules let nobody out are told now, not when everybody waits.
fn check_budgets(view: &RolloutProjection, matching: &Matching) -> Result<(), Refusal> {
    let areas: BTreeSet<_> = matching.robots.iter().filter_map(|r| r.stratum.area.as_ref()).collect();
    for area in areas {
        for (capability, least) in &view.policy(area).software.keep_in_work {
            let able = |id: &RobotId| {
                let session = view.sessions.get(id.as_str());
                session.is_some_and(|s| s.row.inventory.capabilities.contains(capability))
            };
            let here = view.software.values().filter(|s| s.row.area.as_ref() == Some(area)).map(|s| &s.row.robot_id);
            let there = here.filter(|id| able(id)).count() as u32;
            let reached = matching.robots.iter().any(|r| r.stratum.area.as_ref() == Some(area) && able(&r.robot_id));
            if reached && there <= *least {
                let reason = Reason::from(Code::BudgetImpossible).with("area_id", area).with("capability", capability);
                return Err(Refusal::new(Kind::Precondition, reason.with("robots", there).with("keep_in_work", least)));
            }
        }
    }
    Ok(())
}

fn least_ms(view: &RolloutProjection, spec: &RolloutSpec, matching: &Matching) -> u64 {
    let each = PLANNED_OFF_WORK_MS + spec.probation_ms;
    let areas: BTreeSet<_> = matching.robots.iter().map(|r| r.stratum.area.clone()).collect();
    let wave = |wave: u32, size: u32| {
        let rounds = areas.iter().map(|area| {
            let here = matching.robots.iter().filter(|r| r.wave == wave && r.stratum.area == *area).count();
            let most = area.as_ref().map_or(usize::MAX, |area| {
                let all = view.software.values().filter(|s| s.row.area.as_ref() == Some(area)).count();
                view.policy(area).software.off_work_max(all)
            });
            here.div_ceil(most.min(spec.max_in_flight.unwrap_or(size).max(1) as usize).max(1)) as u64
        });
        rounds.max().unwrap_or(0) * each + spec.soak_ms
    };
    (0..).zip(matching.sizes(spec.waves.len())).filter(|(_, size)| *size > 0).map(|(ix, size)| wave(ix, size)).sum()
}

fn find_caveats(
    view: &RolloutProjection,
    board: &Board,
    spec: &RolloutSpec,
    bundle: &Bundle,
    matching: &Matching,
) -> Vec<String> {
    let mut caveats = Vec::new();
    if spec.probation_ms < SHORT_PROBATION_MS {
        caveats.push(format!(
            "probation of {} ms is short: a program that hangs later is met on trial",
            spec.probation_ms
        ));
    }
    let uncovered = matching.strata().values().filter(|(_, first)| !first).count();
    if uncovered > 0 {
        caveats.push(format!("{uncovered} kinds of robots are not in the first wave"));
    }
    if bundle.has_base {
        caveats.push(
            "it replaces the base system: while it is staged a robot has nothing to go back to but what it runs"
                .to_owned(),
        );
    }
    if bundle.is_irreversible {
        caveats.push("once committed it cannot be gone back from".to_owned());
    }
    if spec.waves.contains(&Wave::Rest) && spec.waves.len() == 1 {
        caveats.push("all robots in one wave: a bad bundle reaches every one of them".to_owned());
    }
    let areas = matching.robots.iter().filter_map(|r| r.stratum.area.as_ref());
    let acts = if spec.acts_on_rates { Some(ActsOnRates::Spec) } else { verdict::areas_that_act(view, areas) };
    caveats.extend(acts.map(|acts| match acts {
        ActsOnRates::Spec => "rates of task failures end it too, as is asked for".to_owned(),
        ActsOnRates::Areas(areas) => {
            let areas: Vec<&str> = areas.iter().map(AreaId::as_str).collect();
            format!(
                "rates of task failures end it too once a robot that has run it is there: the rules of {} say so",
                areas.join(", ")
            )
        }
    }));
    let said = |m: &Matched| view.sessions.get(m.robot_id.as_str()).and_then(|s| s.row.installed.as_ref());
    let named = |wrong: &dyn Fn(&Installed) -> bool| {
        let ids = matching.robots.iter().filter(|m| said(m).is_some_and(wrong)).map(|m| m.robot_id.to_string());
        let mut ids: Vec<_> = ids.collect();
        ids.sort_unstable();
        let more = ids.len().saturating_sub(NAMED_MAX);
        let rest = if more > 0 { format!(" and {more} more") } else { String::new() };
        (!ids.is_empty()).then(|| format!("{}{rest}", ids[..ids.len().min(NAMED_MAX)].join(", ")))
    };
    // Heartbeats tell what has changed since.
    let free = |i: &Installed| board.get(&i.robot_id).and_then(|l| l.report.free_bytes).unwrap_or(i.free_bytes);
    let room = bundle.room.max(bundle.length);
    if let Some(robots) = named(&|i| free(i) < room) {
        let what = "for a third set and a file as it comes";
        caveats.push(format!("less room than {room} bytes, {what}, as said last: {robots}"));
    }
    for (name, version) in &bundle.requires {
        if let Some(robots) = named(&|i| lacks(i, name, version)) {
            caveats.push(format!("it needs {name} {version} or later beside it, not seen on: {robots}"));
        }
    }
    caveats
}

/// What a robot runs has no such component, or an older one.
fn lacks(installed: &Installed, name: &str, version: &str) -> bool {
    let set = installed.running_set();
    let there = set.and_then(|set| set.components.get(name));
    let listed = set.is_none_or(|set| set.components_left_out == 0);
    there.map_or(listed, |there| parse_version(there) < parse_version(version))
}

/// Roll-outs that would end if this one began in their place.
pub(super) fn find_superseded(view: &RolloutProjection, board: &Board, rollout_id: &RolloutId) -> BTreeSet<RolloutId> {
    let known =
        view.rollout(rollout_id).and_then(|rollout| Some((rollout, members_to_start(view, board, rollout).ok()?)));
    known
        .map(|(rollout, (robots, _))| find_overlapping(view, rollout, robots.iter().map(|(id, ..)| id)))
        .unwrap_or_default()
}

/// Robots that a roll-out would have, if nothing speaks against it now.
///
/// # Errors
/// Its dry run is refused, or the roll-out that it takes back is not there.
pub(super) fn members_to_start(view: &RolloutProjection, board: &Board, rollout: &Rollout) -> Result<Members, Refusal> {
    match &rollout.revert_of {
        Some(of) => {
            view.rollout(of).ok_or_else(|| {
                Refusal::new(Kind::NotFound, Reason::from(Code::RolloutNotFound).with("rollout_id", of))
            })?;
        }
        None => {
            dry_run(view, board, &rollout.rollout_id, &rollout.spec)?;
        }
    }
    Ok(matching::find_members(view, board, rollout))
}

/// Roll-outs that run and have one of these robots.
pub(super) fn find_overlapping<'a>(
    view: &RolloutProjection,
    rollout: &Rollout,
    robots: impl Iterator<Item = &'a RobotId>,
) -> BTreeSet<RolloutId> {
    let ids = robots.filter_map(|robot| view.of_robot.get(robot)).flatten().filter(|id| **id != rollout.rollout_id);
    let open = ids.filter(|id| view.rollout(id).is_some_and(|r| !r.phase.is_over()));
    open.cloned().collect()
}
