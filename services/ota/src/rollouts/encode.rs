//! Rows as their messages. Nothing is decided here.

use midshift_core::gates::{Effort, EffortLimits, Suspicion, TaskTally};
use midshift_core::rollout::Board;
use midshift_core::rollout::dry_run::DryRun;
use midshift_core::rollout::explain::blocked;
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::rows::{Abort, Act, Quarantine, RobotSoftware, Rollout, RolloutRobot, Step, Verdict};
use midshift_core::rollout::spec::{RolloutSpec, Wave};
use midshift_core::rollout::timestamp::Stamp;
use midshift_core::rollout::verdict::{self, ActsOnRates};
use midshift_core::rows::Revision;
use midshift_core::time::{Now, Utc};
use midshift_proto::convert::task::etag;
use midshift_proto::convert::{WireEnum, duration, shown, timestamp};
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_wave::Size;
use std::collections::BTreeMap;

/// Robots named one by one in a plan.
const LEFT_OUT_MAX: usize = 1_000;

fn text<T: ToString>(id: Option<&T>) -> String {
    id.map(ToString::to_string).unwrap_or_default()
}

fn act(act: &Act) -> v1::RolloutAct {
    v1::RolloutAct { actor: act.actor.clone(), reason: act.reason.clone(), time: Some(timestamp(act.at)) }
}

fn label(view: &RolloutProjection, bundle: &str) -> String {
    view.bundles.get(bundle).map(|b| b.row.label()).unwrap_or_default()
}

fn tally(tally: TaskTally) -> v1::TaskTally {
    v1::TaskTally { succeeded: tally.succeeded, failed: tally.failed }
}

fn spec(spec: &RolloutSpec) -> v1::RolloutSpec {
    let s = &spec.selector;
    let words = |set: &std::collections::BTreeSet<String>| set.iter().cloned().collect();
    let wave = |wave: &Wave| v1::RolloutWave {
        size: Some(match wave {
            Wave::Count(count) => Size::Count(*count),
            Wave::Percent(percent) => Size::Percent(*percent),
            Wave::Label { key, value } => Size::Label(format!("{key}={value}")),
            Wave::Version(version) => Size::Version(version.clone()),
            Wave::Rest => Size::Rest(true),
        }),
    };
    v1::RolloutSpec {
        bundle: spec.bundle.to_string(),
        selector: Some(v1::RolloutSelector {
            robot_ids: s.robots.iter().map(ToString::to_string).collect(),
            area_ids: s.areas.iter().map(ToString::to_string).collect(),
            labels: s.labels.clone(),
            models: words(&s.models),
            versions: words(&s.versions),
        }),
        waves: spec.waves.iter().map(wave).collect(),
        max_in_flight: spec.max_in_flight,
        drain_within: Some(duration(spec.drain_within_ms)),
        probation: Some(duration(spec.probation_ms)),
        soak: Some(duration(spec.soak_ms)),
        exposure_tasks: Some(spec.exposure_tasks),
        exposure_within: Some(duration(spec.exposure_within_ms)),
        small_wave: spec.small_wave.to_wire(),
        small_wave_failure: spec.small_wave_failure.to_wire(),
        abort_scope: spec.abort_scope.to_wire(),
        allow_full_push: spec.allow_full_push,
        rate_bytes_s: spec.rate_bytes_s,
        acts_on_rates: spec.acts_on_rates,
        complete_percent: Some(spec.complete_percent),
        lost_after: Some(duration(spec.lost_after_ms)),
        writes_off_lost: spec.writes_off_lost,
        rollback_floor: spec.rollback_floor,
        effort: (spec.effort != EffortLimits::default()).then_some(v1::EffortLimits {
            slower_permille: spec.effort.slower_permille,
            energy_permille: spec.effort.energy_permille,
            hotter_decidegrees: spec.effort.hotter_decidegrees,
        }),
    }
}

fn verdict_of(verdict: &Verdict) -> v1::RolloutVerdict {
    let robots = &verdict.robots;
    v1::RolloutVerdict {
        wave: verdict.wave,
        outcome: verdict.outcome.to_wire(),
        reason: Some(shown(&verdict.reason)),
        attempted: verdict.attempted,
        clean: robots.outcomes.clean,
        failed: robots.outcomes.failed,
        upper_bound_permille: u32::from(robots.upper_bound_permille),
        false_abort_permille: robots.false_abort_permille.map(u32::from),
        log_ratio_micronats: robots.log_ratio_micronats,
        abort_micronats: robots.abort_micronats,
        promote_micronats: robots.promote_micronats,
        trial: Some(tally(verdict.tasks.trial)),
        control: Some(tally(verdict.tasks.control)),
        e_value_milli: (verdict.tasks.e_value() * 1000.0).min(1e15) as u64,
        suspicion: suspicion(&verdict.suspicion) as i32,
        time: Some(timestamp(verdict.at)),
        actor: verdict.actor.clone().unwrap_or_default(),
        trial_effort: Some(effort(&verdict.efforts.trial)),
        control_effort: Some(effort(&verdict.efforts.control)),
    }
}

fn effort(effort: &Effort) -> v1::Effort {
    v1::Effort {
        tasks: effort.tasks,
        duration: Some(duration(effort.duration_ms)),
        path_mm: effort.path_mm,
        energy_mwh: effort.energy_mwh,
        hottest_joint_decidegrees: effort.hottest_joint_decidegrees,
    }
}

fn suspicion(suspicion: &Suspicion) -> v1::Suspicion {
    match suspicion {
        Suspicion::None => v1::Suspicion::Unspecified,
        Suspicion::OneSickRobot(_) => v1::Suspicion::OneSickRobot,
        Suspicion::Release => v1::Suspicion::Release,
    }
}

fn abort(abort: &Abort) -> v1::RolloutAbort {
    v1::RolloutAbort {
        reason: Some(shown(&abort.reason)),
        hard: abort.hard,
        robot_ids: abort.robots.iter().map(ToString::to_string).collect(),
        touched: abort.touched,
        time: Some(timestamp(abort.at)),
        actor: abort.actor.clone().unwrap_or_default(),
    }
}

/// How many robots of a roll-out are how far.
#[derive(Default)]
pub struct Counts {
    all: v1::RolloutCounts,
    waves: BTreeMap<u32, v1::RolloutCounts>,
    skipped_by_reason: BTreeMap<String, u32>,
}

impl Counts {
    /// Counts one more.
    pub fn add(&mut self, r: &RolloutRobot) {
        count(&mut self.all, r);
        count(self.waves.entry(r.wave).or_default(), r);
        if let (Step::Skipped, Some(why)) = (r.step, &r.why) {
            *self.skipped_by_reason.entry(why.name().to_owned()).or_default() += 1;
        }
    }
}

fn count(counts: &mut v1::RolloutCounts, r: &RolloutRobot) {
    let slot = match r.step {
        Step::Waiting => &mut counts.waiting,
        Step::Staging => &mut counts.staging,
        Step::Staged => &mut counts.staged,
        Step::Draining => &mut counts.draining,
        Step::Activating => &mut counts.activating,
        Step::Trial => &mut counts.trial,
        Step::Committing => &mut counts.committing,
        Step::Reverting => &mut counts.reverting,
        Step::Committed => &mut counts.committed,
        Step::RolledBack => &mut counts.rolled_back,
        Step::Skipped => &mut counts.skipped,
        Step::Stuck => &mut counts.stuck,
    };
    *slot += 1;
    counts.failed += u32::from(r.failure.is_some());
    counts.attempted += u32::from(r.attempted);
}

/// A roll-out of the projection.
pub fn rollout(view: &RolloutProjection, now: &Now, row: &Rollout) -> v1::Rollout {
    let mut counts = Counts::default();
    view.robots_of(&row.rollout_id).for_each(|r| counts.add(r));
    counted(view, now, row, counts)
}

/// A roll-out whose robots were counted.
pub fn counted(view: &RolloutProjection, now: &Now, row: &Rollout, counts: Counts) -> v1::Rollout {
    let Counts { all, waves, skipped_by_reason } = counts;
    let served = view.served_ms(now);
    let left = |c: Option<midshift_core::rollout::rows::Countdown>| c.map(|c| duration(c.left(served)));
    v1::Rollout {
        rollout_id: row.rollout_id.to_string(),
        spec: Some(spec(&row.spec)),
        bundle_label: label(view, row.spec.bundle.as_str()),
        phase: row.phase.to_wire(),
        wave: row.wave,
        pauses: row.pauses.iter().map(|p| p.to_wire()).collect(),
        in_flight: row.in_flight,
        soak_left: left(row.soak),
        exposure_left: left(row.exposure),
        unexposed: verdict::find_unexposed(view, row).count() as u32,
        verdicts: row.verdicts.iter().map(verdict_of).collect(),
        abort: row.abort.as_ref().map(abort),
        revert_of: text(row.revert_of.as_ref()),
        superseded_by: text(row.superseded_by.as_ref()),
        counts: Some(all),
        waves: waves
            .into_iter()
            .map(|(wave, counts)| v1::RolloutWaveState { wave, counts: Some(counts), promoted: wave < row.promoted })
            .collect(),
        skipped_by_reason,
        created: Some(act(&row.created)),
        approved: row.approved.as_ref().map(act),
        start_time: row.started.map(timestamp),
        since: Some(timestamp(row.since)),
        etag: etag(Revision(row.version)),
        acts_on_rates_area_ids: match verdict::acts_on_rates(view, row) {
            Some(ActsOnRates::Areas(areas)) => areas.iter().map(ToString::to_string).collect(),
            _ => Vec::new(),
        },
        outcome: row.outcome.map_or(0, WireEnum::to_wire),
        trial: Some(tally(row.tasks.trial)).filter(|tally| *tally != v1::TaskTally::default()),
        control: Some(tally(row.tasks.control)).filter(|tally| *tally != v1::TaskTally::default()),
        trial_effort: Some(effort(&row.efforts.trial)),
        control_effort: Some(effort(&row.efforts.control)),
    }
}

/// A robot in a roll-out, with what it waits for.
pub fn robot(view: &RolloutProjection, board: &Board, now: &Now, row: &Rollout, r: &RolloutRobot) -> v1::RolloutRobot {
    let waits = blocked(view, board, now, row, r);
    let m = &r.moments;
    let span = |from: Option<Utc>, to: Option<Utc>| from.zip(to).map(|(from, to)| duration(to.ms_since(from)));
    let on_link = |from: Option<Stamp>, to: Option<Stamp>| from.zip(to).map(|(from, to)| duration(to.ms_since(&from)));
    v1::RolloutRobot {
        rollout_id: r.rollout_id.to_string(),
        robot_id: r.robot_id.to_string(),
        wave: r.wave,
        step: r.step.to_wire(),
        since: Some(timestamp(r.since)),
        from_version: r.from_version.clone(),
        blocked_by: waits.as_ref().map(|w| shown(&w.by)),
        blocked_since: waits.as_ref().map(|w| timestamp(w.since)),
        deadline: waits.as_ref().and_then(|w| w.deadline).map(timestamp),
        attempted: r.attempted,
        failure: r.failure.as_ref().map(shown),
        why: r.why.as_ref().map(shown),
        progress_permille: progress_permille(board, r),
        trial: Some(tally(verdict::exposure_of(view, row, r))),
        off_work: Some(v1::OffWork {
            drain_wait: span(m.asked, m.draining),
            park_drive: span(m.draining, m.held),
            parked_to_grant: on_link(m.held_link, m.granted_link),
            switch: on_link(m.granted_link, m.switched_link),
            probation: span(m.switched, m.on_trial),
        }),
        drain_id: text(r.drain_id.as_ref()),
        lost: r.lost.as_ref().map(|lost| timestamp(lost.since)),
        written_off: r.lost.as_ref().and_then(|lost| lost.written_off.as_ref()).map(act),
    }
}

/// How much of its bundle a robot has downloaded, as it said last.
pub fn progress_permille(board: &Board, r: &RolloutRobot) -> u32 {
    let update = board.get(&r.robot_id).and_then(|live| live.report.update.as_ref());
    update.map_or(0, |u| u32::from(u.progress_permille))
}

/// What a roll-out would do.
pub fn plan(run: &DryRun, waves: usize) -> v1::PlanRolloutResponse {
    let left_out = run.matching.left_out.iter().take(LEFT_OUT_MAX);
    let strata = run.matching.strata();
    v1::PlanRolloutResponse {
        wave_sizes: run.matching.sizes(waves),
        left_out_by_reason: run
            .matching
            .left_out_by_code()
            .into_iter()
            .map(|(code, n)| (code.as_str().to_owned(), n))
            .collect(),
        left_out: left_out
            .map(|(id, reason)| v1::RolloutLeftOut { robot_id: id.to_string(), reason: Some(shown(reason)) })
            .collect(),
        strata: strata
            .into_iter()
            .map(|(s, (robots, in_first_wave))| v1::RolloutStratum {
                model: s.model,
                capabilities: s.capabilities,
                area_id: text(s.area.as_ref()),
                from_version: s.from_version,
                robots,
                in_first_wave,
            })
            .collect(),
        bytes: run.bytes,
        least: Some(duration(run.least_ms)),
        caveats: run.caveats.clone(),
    }
}

/// What a robot runs.
pub fn software(row: &RobotSoftware) -> v1::RobotSoftware {
    v1::RobotSoftware {
        robot_id: row.robot_id.to_string(),
        version: row.version.clone(),
        committed: text(row.committed.as_ref()),
        previous: text(row.previous.as_ref()),
        on_trial: text(row.on_trial.as_ref()),
        pin: row.pin.as_ref().map(act),
        since: (row.since != Utc(0)).then(|| timestamp(row.since)),
    }
}

/// A bundle that a robot went back from.
pub fn quarantine(view: &RolloutProjection, row: &Quarantine) -> v1::Quarantine {
    v1::Quarantine {
        robot_id: row.robot_id.to_string(),
        bundle: row.bundle.to_string(),
        bundle_label: label(view, row.bundle.as_str()),
        rollout_id: row.rollout_id.to_string(),
        reason: Some(shown(&row.reason)),
        since: Some(timestamp(row.since)),
    }
}
