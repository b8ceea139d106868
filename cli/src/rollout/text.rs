//! Roll-outs in words: a header, a tree of waves, verdicts with the numbers behind them.
//!
//! Invariant: pure functions of messages; nothing is asked of a server here, and no clock is read. Waves are counted from 1 for people, as
//! `wave 1/3`; on the wire from 0.

use crate::duration::span;
use crate::out::plain;
use midshift_proto::common::v1::Reason;
use midshift_proto::convert::{ms_of, time_of};
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_proto::ota::v1::{self, RolloutPhase, RolloutStep};
use prost_types::{Duration, Timestamp};

/// Robots named one by one under a wave.
const ROBOTS_SHOWN: usize = 12;

/// A moment as people read it; nothing for none.
pub fn time(at: Option<&Timestamp>) -> String {
    at.map(|t| time_of(t).rfc3339()).unwrap_or_default()
}

/// Permille as percent with one digit.
pub fn percent(permille: u32) -> String {
    format!("{}.{} %", permille / 10, permille % 10)
}

/// `1 robot`, `3 robots`.
pub fn robots(count: u32) -> String {
    if count == 1 { "1 robot".to_owned() } else { format!("{count} robots") }
}

/// A reason with its sentence.
pub fn reason(reason: &Reason) -> String {
    format!("{}: {}", reason.code, plain(&reason.message)).trim_end_matches([':', ' ']).to_owned()
}

fn because(why: Option<&Reason>) -> String {
    why.map(reason).unwrap_or_default()
}

/// The word of a phase.
pub fn phase(phase: RolloutPhase) -> &'static str {
    phase.as_str_name().trim_start_matches("ROLLOUT_PHASE_")
}

/// The word of a step.
pub fn step(step: RolloutStep) -> &'static str {
    step.as_str_name().trim_start_matches("ROLLOUT_STEP_")
}

/// Why it stands still, as words; empty: it does not.
pub fn pauses(rollout: &v1::Rollout) -> String {
    let words = rollout.pauses().map(|p| p.as_str_name().trim_start_matches("ROLLOUT_PAUSE_"));
    words.collect::<Vec<_>>().join(" ")
}

/// Phase, and why it stands still if it does, or that it ended for too few.
pub fn state(rollout: &v1::Rollout) -> String {
    let pauses = pauses(rollout);
    let phase = phase(rollout.phase());
    match rollout.outcome() {
        v1::RolloutOutcome::Incomplete => format!("{phase}, INCOMPLETE"),
        _ if pauses.is_empty() => phase.to_owned(),
        _ => format!("{phase}, paused ({pauses})"),
    }
}

/// That it ended for too few, and what was asked.
pub fn incomplete(rollout: &v1::Rollout) -> String {
    let counts = rollout.counts.unwrap_or_default();
    let asked = rollout.spec.as_ref().and_then(|s| s.complete_percent).unwrap_or_default();
    let did = if rollout.revert_of.is_empty() {
        format!("{} of {} have its bundle", counts.committed + counts.committing + counts.trial, robots(total(&counts)))
    } else {
        format!("{} of {} went back", counts.rolled_back, robots(total(&counts)))
    };
    format!("INCOMPLETE: {did}, {asked} % of those it was offered to were asked")
}

/// Waves that were asked for.
pub fn waves_of(rollout: &v1::Rollout) -> u32 {
    rollout.spec.as_ref().map_or(0, |s| s.waves.len() as u32)
}

/// The name of a wave among so many.
pub fn wave(wave: u32, waves: u32) -> String {
    match wave {
        _ if wave < waves => format!("wave {}/{waves}", wave + 1),
        _ if wave == waves => "once more".to_owned(),
        _ => "came later".to_owned(),
    }
}

/// What a wave is made of, as `--waves` takes it.
pub fn size(wave: &v1::RolloutWave) -> String {
    match &wave.size {
        Some(Size::Count(count)) => count.to_string(),
        Some(Size::Percent(percent)) => format!("{percent}%"),
        Some(Size::Label(label)) => format!("label:{label}"),
        Some(Size::Version(version)) => format!("version:{version}"),
        Some(Size::Rest(_)) | None => "rest".to_owned(),
    }
}

/// The bundle by name and version, else the beginning of its digest.
pub fn bundle(label: &str, digest: &str) -> String {
    if label.is_empty() { digest.chars().take(12).collect() } else { label.to_owned() }
}

fn steps(c: &v1::RolloutCounts) -> [(u32, &'static str); 12] {
    [
        (c.waiting, "waiting"),
        (c.staging, "staging"),
        (c.staged, "staged"),
        (c.draining, "draining"),
        (c.activating, "activating"),
        (c.trial, "on trial"),
        (c.committing, "committing"),
        (c.reverting, "reverting"),
        (c.committed, "committed"),
        (c.rolled_back, "rolled back"),
        (c.skipped, "skipped"),
        (c.stuck, "stuck"),
    ]
}

/// All robots.
pub fn total(counts: &v1::RolloutCounts) -> u32 {
    steps(counts).iter().map(|(count, _)| count).sum()
}

/// Robots for which nothing is left to do.
pub fn decided(counts: &v1::RolloutCounts) -> u32 {
    counts.committed + counts.rolled_back + counts.skipped
}

/// How many are how far; steps with nobody are left out.
pub fn counts(counts: &v1::RolloutCounts) -> String {
    let some = steps(counts).into_iter().filter(|(count, _)| *count > 0);
    let mut words: Vec<String> = some.map(|(count, step)| format!("{count} {step}")).collect();
    if counts.failed > 0 {
        words.push(format!("{} FAILED", counts.failed));
    }
    words.join(", ")
}

/// Who did something, when, and why.
pub fn act(what: &str, act: &v1::RolloutAct) -> String {
    let why = if act.reason.is_empty() { String::new() } else { format!(" ({})", plain(&act.reason)) };
    format!("{what} by {} {}{why}", act.actor, time(act.time.as_ref()))
}

/// Lines over the tree: where it is and why.
pub fn header(rollout: &v1::Rollout) -> Vec<String> {
    let label = bundle(&rollout.bundle_label, rollout.spec.as_ref().map_or("", |s| &s.bundle));
    let begun = rollout.start_time.is_some();
    let at = if begun { format!("  {}", wave(rollout.wave, waves_of(rollout))) } else { String::new() };
    let mut lines = vec![format!("{}  {}{at}  bundle {label}", rollout.rollout_id, state(rollout))];
    let mut facts = vec![format!("since {}", time(rollout.since.as_ref()))];
    if begun {
        facts.push(format!("{} out of work", robots(rollout.in_flight)));
    }
    facts.extend(rollout.soak_left.as_ref().map(|left| format!("soak {} left", span(left))));
    if let Some(left) = &rollout.exposure_left {
        let few = robots(rollout.unexposed);
        facts.push(format!("{few} had too few tasks, a person is asked in {}", span(left)));
    }
    lines.push(format!("  {}", facts.join(", ")));
    lines.extend(acts_on_rates(rollout).map(|line| format!("  {line}")));
    if rollout.outcome() == v1::RolloutOutcome::Incomplete {
        lines.push(format!("  {}", incomplete(rollout)));
    }
    let cost = effort(rollout.trial_effort.as_ref(), rollout.control_effort.as_ref());
    lines.extend(cost.map(|line| format!("  {line}")));
    let of = [("takes back", &rollout.revert_of), ("its place took", &rollout.superseded_by)];
    lines.extend(of.iter().filter(|(_, id)| !id.is_empty()).map(|(what, id)| format!("  {what} {id}")));
    lines.extend(rollout.abort.as_ref().map(|a| format!("  {}  {}", time(a.time.as_ref()), abort(a))));
    if !rollout.skipped_by_reason.is_empty() {
        let skipped: Vec<String> = rollout.skipped_by_reason.iter().map(|(code, n)| format!("{n} {code}")).collect();
        lines.push(format!("  skipped: {}", skipped.join(", ")));
    }
    lines
}

/// Who says that rates of task failures end it; none: they are only shown.
fn acts_on_rates(rollout: &v1::Rollout) -> Option<String> {
    use RolloutPhase::{Aborted, Completed, Superseded};
    if matches!(rollout.phase(), Completed | Aborted | Superseded) || !rollout.revert_of.is_empty() {
        return None;
    }
    let areas = &rollout.acts_on_rates_area_ids;
    let by = if rollout.spec.as_ref().is_some_and(|s| s.acts_on_rates) {
        "as was asked for".to_owned()
    } else if areas.is_empty() {
        return None;
    } else {
        format!("by the rules of {}", areas.join(", "))
    };
    Some(format!("rates of task failures end it too, {by}"))
}

/// The end of a roll-out that ended early.
pub fn abort(abort: &v1::RolloutAbort) -> String {
    let kind = if abort.hard { "aborted at once" } else { "aborted" };
    let mut text = format!("{kind}: {}", because(abort.reason.as_ref()));
    if !abort.actor.is_empty() {
        text += &format!(", by {}", abort.actor);
    }
    if !abort.robot_ids.is_empty() {
        text += &format!(", behind it {}", abort.robot_ids.join(" "));
    }
    text + &format!(", {} had permission by then", robots(abort.touched))
}

/// Robots worth a line of their own: out of work, working on trial, going back, or in trouble.
fn is_shown(robot: &v1::RolloutRobot) -> bool {
    use RolloutStep::{Activating, Committing, Draining, Reverting, Stuck, Trial};
    let busy = [Draining, Activating, Trial, Committing, Reverting, Stuck];
    busy.contains(&robot.step()) || robot.failure.is_some()
}

/// One robot, where it is and what it waits for.
pub fn robot(robot: &v1::RolloutRobot) -> String {
    let mut text = format!("{}  {}", robot.robot_id, step(robot.step()));
    if robot.step() == RolloutStep::Staging {
        text += &format!(" {}", percent(robot.progress_permille));
    }
    if robot.step() == RolloutStep::Trial {
        let tasks = robot.trial.unwrap_or_default();
        text += &format!(", {} tasks done, {} failed", tasks.succeeded, tasks.failed);
    }
    if let Some(failure) = &robot.failure {
        text += &format!("  FAILED {}", reason(failure));
    } else if let Some(why) = &robot.why {
        text += &format!("  {}", reason(why));
    }
    if let Some(by) = &robot.blocked_by {
        text += &format!("  waits: {}", by.code);
    }
    text
}

/// The tree of waves with the robots that are worth a line. Before the start: what was asked for.
pub fn tree<'a>(rollout: &v1::Rollout, all: impl Iterator<Item = &'a v1::RolloutRobot> + Clone) -> Vec<String> {
    let asked = waves_of(rollout);
    if rollout.waves.is_empty() {
        let waves: Vec<String> = rollout
            .spec
            .iter()
            .flat_map(|s| &s.waves)
            .zip(0..)
            .map(|(w, ix)| format!("{}: {}", wave(ix, asked), size(w)))
            .collect();
        return branches(waves.into_iter().map(|head| (head, Vec::new())).collect());
    }
    let branch = |state: &v1::RolloutWaveState| {
        let of = state.counts.unwrap_or_default();
        let kept = if state.promoted { ", kept" } else { "" };
        let head = format!("{}: {}{kept}  {}", wave(state.wave, asked), robots(total(&of)), counts(&of));
        let shown = all.clone().filter(|r| r.wave == state.wave && is_shown(r));
        let mut leaves: Vec<String> = shown.clone().take(ROBOTS_SHOWN).map(robot).collect();
        let more = shown.count().saturating_sub(ROBOTS_SHOWN);
        if more > 0 {
            leaves.push(format!("and {more} more"));
        }
        (head, leaves)
    };
    branches(rollout.waves.iter().map(branch).collect())
}

/// Draws heads with their leaves.
fn branches(all: Vec<(String, Vec<String>)>) -> Vec<String> {
    let last = all.len().saturating_sub(1);
    let mut lines = Vec::new();
    for (ix, (head, leaves)) in all.into_iter().enumerate() {
        let (fork, bar) = if ix == last { ("└─", "  ") } else { ("├─", "│ ") };
        lines.push(format!("{fork} {}", head.trim_end()));
        lines.extend(leaves.into_iter().map(|leaf| format!("{bar}   {leaf}")));
    }
    lines
}

/// The word of an outcome.
pub fn outcome(verdict: &v1::RolloutVerdict) -> &'static str {
    verdict.outcome().as_str_name().trim_start_matches("GATE_OUTCOME_")
}

/// What so many robots prove, and what they do not.
pub fn bound(verdict: &v1::RolloutVerdict) -> String {
    let known = format!("fewer than {} fail, with 95 % confidence", percent(verdict.upper_bound_permille));
    match verdict.outcome() {
        v1::GateOutcome::PromotedUnproven => {
            format!("unproven: of {}, no more is known than that {known}", robots(verdict.clean + verdict.failed))
        }
        _ => known,
    }
}

fn nats(micronats: i64) -> String {
    format!("{:.2}", micronats as f64 / 1e6)
}

/// A verdict on one line: n, failures, and the bound.
pub fn verdict(verdict: &v1::RolloutVerdict, waves: u32) -> String {
    let n = verdict.clean + verdict.failed;
    let mut text = format!("{}  {}", wave(verdict.wave, waves), outcome(verdict));
    text += &format!(
        "  {} of {n} clean, {} failed ({} attempted); {}",
        verdict.clean,
        verdict.failed,
        verdict.attempted,
        bound(verdict)
    );
    if let Some(cost) = verdict.false_abort_permille {
        text += &format!("; a good bundle is aborted like this {} of the time", percent(cost));
    }
    if !verdict.actor.is_empty() {
        text += &format!("; by {}", verdict.actor);
    }
    text
}

/// What work cost robots on trial beside the others; none: none of them has ended a task.
fn effort(trial: Option<&v1::Effort>, control: Option<&v1::Effort>) -> Option<String> {
    let told = |effort: &v1::Effort| {
        let ms = effort.duration.as_ref().map_or(0, ms_of);
        let s_a_task = if effort.tasks > 0 { ms as f64 / 1e3 / effort.tasks as f64 } else { 0.0 };
        let km = effort.path_mm as f64 / 1e6;
        let mwh_a_km = if effort.path_mm > 0 { effort.energy_mwh as f64 / km } else { 0.0 };
        let heat = f64::from(effort.hottest_joint_decidegrees) / 10.0;
        let n = effort.tasks;
        format!("{s_a_task:.1} s a task, {mwh_a_km:.0} mWh a km, joints up to {heat:.1} °C (n {n}, {km:.1} km)")
    };
    let trial = trial.filter(|trial| trial.tasks > 0)?;
    Some(format!("work: on trial {}; beside it {}", told(trial), control.map(told).unwrap_or_default()))
}

/// The evidence behind a verdict, on lines of their own.
pub fn evidence(verdict: &v1::RolloutVerdict) -> Vec<String> {
    let (trial, control) = (verdict.trial.unwrap_or_default(), verdict.control.unwrap_or_default());
    let said = match verdict.suspicion() {
        v1::Suspicion::Unspecified => "nothing that chance does not explain",
        v1::Suspicion::OneSickRobot => "one sick robot?",
        v1::Suspicion::Release => "the release is suspected",
    };
    let mut lines = vec![
        format!("{}  {}", time(verdict.time.as_ref()), because(verdict.reason.as_ref())),
        format!(
            "robots: log ratio {} (aborts at {}, proven at {})",
            nats(verdict.log_ratio_micronats),
            nats(verdict.abort_micronats),
            nats(verdict.promote_micronats)
        ),
        format!(
            "tasks: on trial {} done {} failed, beside it {} done {} failed; E {}.{:03} of 20: {said}",
            trial.succeeded,
            trial.failed,
            control.succeeded,
            control.failed,
            verdict.e_value_milli / 1000,
            verdict.e_value_milli % 1000
        ),
    ];
    lines.extend(effort(verdict.trial_effort.as_ref(), verdict.control_effort.as_ref()));
    lines
}

/// Parts of the time off work with a function that reads each.
type Part = (&'static str, fn(&v1::OffWork) -> Option<&Duration>);

/// Each is measured on a clock of its own.
const PARTS: [Part; 5] = [
    ("waiting for the drain", |o| o.drain_wait.as_ref()),
    ("to its park", |o| o.park_drive.as_ref()),
    ("parked to permission", |o| o.parked_to_grant.as_ref()),
    ("switch", |o| o.switch.as_ref()),
    ("probation", |o| o.probation.as_ref()),
];

/// The parts of one robot that are over; none: it was not taken out of work.
pub fn off_work(off: &v1::OffWork) -> Option<String> {
    let parts: Vec<String> =
        PARTS.iter().filter_map(|(name, read)| read(off).map(|part| format!("{name} {}", span(part)))).collect();
    (!parts.is_empty()).then(|| parts.join(", "))
}

/// The median of each part over the robots that have it; of an even number the lower one. Never summed: each part has its own clock.
pub fn off_work_medians<'a>(all: impl Iterator<Item = &'a v1::RolloutRobot> + Clone) -> Option<String> {
    let median = |(name, read): &Part| {
        let mut parts: Vec<&Duration> = all.clone().filter_map(|r| r.off_work.as_ref()).filter_map(read).collect();
        parts.sort_by_key(|part| ms_of(part));
        let middle = parts.get(parts.len().checked_sub(1)? / 2)?;
        Some(format!("{name} {} (n {})", span(middle), parts.len()))
    };
    let parts: Vec<String> = PARTS.iter().filter_map(median).collect();
    (!parts.is_empty()).then(|| parts.join(", "))
}

/// What a person may do about it now.
pub fn next(rollout: &v1::Rollout) -> String {
    let id = &rollout.rollout_id;
    let counts = rollout.counts.unwrap_or_default();
    match rollout.phase() {
        RolloutPhase::Draft | RolloutPhase::Unspecified => format!("midshift rollout submit {id}"),
        RolloutPhase::Validated => format!("midshift rollout approve {id}"),
        RolloutPhase::Approved => format!("midshift rollout start {id}"),
        RolloutPhase::Review => {
            format!(
                "look at midshift rollout get {id}, then midshift rollout promote {id} or midshift rollout abort {id}"
            )
        }
        RolloutPhase::Completed if counts.rolled_back + counts.skipped > 0 => {
            format!("midshift rollout retry {id} --failed")
        }
        RolloutPhase::Completed => format!("midshift rollout rollback {id} --as NEW_ID takes it back"),
        RolloutPhase::Aborted => "midshift quarantine ls; midshift incident ls".to_owned(),
        RolloutPhase::Superseded => format!("midshift rollout get {}", rollout.superseded_by),
        _ if rollout.pauses().any(|p| p == v1::RolloutPause::Operator) => format!("midshift rollout resume {id}"),
        _ if rollout.pauses().any(|p| p == v1::RolloutPause::Content) => {
            format!("midshift incident ls; once its files are whole, midshift rollout resume {id}")
        }
        _ => format!("midshift rollout watch {id}"),
    }
}
