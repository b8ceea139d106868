//! What is told of a shift: rates, times and shares, from the records of its tasks and its bodies.

use super::run::{Outcome, Sample};
use super::scenario::BATTERY_RATES;
use super::task_records::{TaskRecord, Urgency};
use crate::figure::{Figure, percentile};
use midshift_core::energy::{CAPACITY_MWH, IDLE_W};
use midshift_core::site::grid;
use midshift_sim::faults::FAULT_BATTERY_EMPTY;
use std::ops::Range;
use std::time::Duration;

/// What is told of one shift, each by its name and unit.
pub type Measures = Vec<(&'static str, &'static str, f64)>;

/// A shift is measured after its first part, which fills the floor with work: a tenth of it, at most so long.
const WARM_UP_MS: u64 = 600_000;

/// From when on a shift of this length is measured, milliseconds.
pub fn measured_from_ms(lasted_ms: u64) -> u64 {
    (lasted_ms / 10).min(WARM_UP_MS)
}

/// Tasks done in an hour of the part that is measured.
pub fn tasks_per_hour(outcome: &Outcome) -> f64 {
    let from_ms = measured_from_ms(outcome.lasted_ms);
    let done = outcome.tasks.iter().filter(|task| task.done_ms.is_some_and(|at| at >= from_ms)).count();
    done as f64 * 3_600_000.0 / (outcome.lasted_ms - from_ms).max(1) as f64
}

/// Everything that is told of a shift.
pub fn measures(outcome: &Outcome) -> Measures {
    let from_ms = measured_from_ms(outcome.lasted_ms);
    let told: Vec<&TaskRecord> = outcome.tasks.iter().filter(|task| task.submitted_ms >= from_ms).collect();
    let seconds = |times: Vec<u64>| times.into_iter().map(|ms| ms as f64 / 1e3).collect::<Vec<f64>>();
    let completion = seconds(told.iter().filter_map(|t| Some(t.done_ms? - t.submitted_ms)).collect());
    // Of those that still wait, the time so far: without it the longest waits would be left out.
    let waited = |t: &&TaskRecord| t.assigned_ms.unwrap_or(outcome.lasted_ms) - t.submitted_ms;
    let waits = seconds(told.iter().map(waited).collect());
    let urgent = told.iter().filter(|t| t.urgency == Urgency::Urgent).map(waited).collect();
    let urgent_waits = seconds(urgent);
    let bodies = &outcome.bodies;
    let robots_ms = (outcome.robots as u64 * outcome.lasted_ms).max(1) as f64;
    let share = |ms: u64| 100.0 * ms as f64 / robots_ms;
    let assigned = outcome.tasks.iter().filter(|t| t.assignments > 0);
    let (assigned, assignments) = assigned.fold((0_u64, 0_u64), |(n, sum), t| (n + 1, sum + u64::from(t.assignments)));
    let mut measures = vec![
        ("tasks", "1/h", tasks_per_hour(outcome)),
        ("empty travel", "%", 100.0 * (1.0 - outcome.loaded_mm as f64 / bodies.path_mm.max(1) as f64)),
        ("completion, p50", "s", percentile(&completion, 0.5)),
        ("completion, p95", "s", percentile(&completion, 0.95)),
        ("wait for a robot, p50", "s", percentile(&waits, 0.5)),
        ("wait for a robot, p95", "s", percentile(&waits, 0.95)),
        ("wait for a robot, longest", "s", percentile(&waits, 1.0)),
        ("utilisation", "%", 100.0 - share(bodies.counts.idle_ms)),
        ("driving", "%", share(bodies.counts.driving_ms)),
        ("acting", "%", share(bodies.counts.acting_ms)),
        ("standing with a task", "%", share(bodies.counts.halted_ms + bodies.counts.blocked_ms)),
        ("driving at the speed of a grid", "%", share(bodies.path_mm * 1_000 / u64::from(grid::SPEED_MM_S))),
        ("re-assignments a task", "1", assignments.saturating_sub(assigned) as f64 / assigned.max(1) as f64),
        ("tasks that failed", "1", outcome.counts.failed as f64),
        ("tasks that ended twice", "1", outcome.counts.ended_twice as f64),
        ("steps done twice", "1", bodies.verdict.steps_done_twice as f64),
        ("items lost", "1", f64::from(u8::from(!bodies.verdict.items_conserved()))),
        ("exclusion violations", "1", bodies.verdict.exclusion_violations as f64),
        ("no progress", "robot-min", outcome.no_progress.planned.as_secs_f64() / 60.0),
        ("waiting for a person", "task-min", asking_ms(outcome) as f64 / 60_000.0),
        ("waiting for a person at the end", "tasks", outcome.counts.asking as f64),
        ("answers of a person", "1", outcome.counts.answers as f64),
        ("robots let work again by a person", "1", outcome.reinstated as f64),
        ("items of plans lost", "1", outcome.plans.items_lost as f64),
        ("plan by the wall, p50", "ms", percentile(&outcome.plans.plan_ms, 0.5)),
        ("plan by the wall, p99", "ms", percentile(&outcome.plans.plan_ms, 0.99)),
        ("run by the wall", "s", outcome.wall.as_secs_f64()),
    ];
    if let Some(stop) = &outcome.planner_stop {
        let unplanned = outcome.no_progress.unplanned.as_secs_f64() / 60.0;
        measures.push(("no progress while the planner is away", "robot-min", unplanned));
        measures.push(("backlog of the stop stays", "min", backlog_stays_ms(outcome, stop) as f64 / 60_000.0));
    }
    if outcome.charging.is_some() {
        measures.extend(battery_measures(outcome));
    }
    if let Some(losses) = &outcome.losses {
        measures.push(("robots lost inside", "1", losses.robots as f64));
        measures.push(("held by a lost robot, longest", "s", losses.longest_hold_ms as f64 / 1e3));
        measures.push(("passage held by a lost robot, longest", "s", losses.longest_passage_hold_ms as f64 / 1e3));
        measures.push(("places cleared by a person", "1", losses.cleared as f64));
    }
    if !urgent_waits.is_empty() {
        measures.push(("urgent wait for a robot, p50", "s", percentile(&urgent_waits, 0.5)));
        measures.push(("urgent wait for a robot, p95", "s", percentile(&urgent_waits, 0.95)));
    }
    measures
}

/// What is told of batteries.
fn battery_measures(outcome: &Outcome) -> Measures {
    let counts = &outcome.bodies.counts;
    let busy_ms = counts.driving_ms + counts.acting_ms + counts.blocked_ms + counts.halted_ms;
    let idle_w = IDLE_W * f64::from(BATTERY_RATES.draw_permille) / 1e3;
    let busy_mwh = outcome.bodies.energy_mwh as f64 - idle_w * counts.idle_ms as f64 / 3_600.0;
    let lost_a_second = 100.0 * busy_mwh / CAPACITY_MWH / (busy_ms as f64 / 1e3).max(1.0);
    let at_chargers: usize = outcome.samples.iter().map(|sample| sample.batteries.charging).sum();
    let lowest = outcome.samples.iter().map(|sample| sample.batteries.lowest_permille).min().unwrap_or_default();
    let empty = outcome.bodies.faults_by_code.get(&FAULT_BATTERY_EMPTY).copied().unwrap_or_default();
    let robots = (outcome.samples.len() * outcome.robots).max(1) as f64;
    vec![
        ("charge lost at work", "%/s", lost_a_second),
        ("charging", "%", 100.0 * at_chargers as f64 / robots),
        ("lowest charge", "%", f64::from(lowest) / 10.0),
        ("batteries that ran empty", "1", empty as f64),
        ("waiting at the end", "tasks", outcome.counts.waiting as f64),
    ]
}

/// Time that tasks spent in NEEDS_OPERATOR, summed up.
fn asking_ms(outcome: &Outcome) -> u64 {
    let mut before_ms = 0;
    let mut since = |sample: &Sample| sample.at_ms - std::mem::replace(&mut before_ms, sample.at_ms);
    outcome.samples.iter().map(|sample| sample.counts.asking as u64 * since(sample)).sum()
}

/// How long after the planner's return more tasks are open than when it stopped; to the end of the shift if for ever.
fn backlog_stays_ms(outcome: &Outcome, stop: &Range<Duration>) -> u64 {
    let (begins_ms, ends_ms) = (stop.start.as_millis() as u64, stop.end.as_millis() as u64);
    let before = outcome.samples.iter().take_while(|sample| sample.at_ms <= begins_ms).last();
    let open = before.map_or(0, |sample| sample.counts.open);
    let mut after = outcome.samples.iter().filter(|sample| sample.at_ms >= ends_ms);
    let gone = after.find(|sample| sample.counts.open <= open);
    gone.map_or(outcome.lasted_ms, |sample| sample.at_ms).saturating_sub(ends_ms)
}

/// Figures over the seeds of one policy and workload. A reference stands beside the tasks in an hour.
pub fn figures(title: &str, seeds: &[Measures], reference_per_hour: Option<f64>) -> Vec<Figure> {
    let Some(first) = seeds.first() else { return Vec::new() };
    let figure = |(nth, (name, unit, _)): (usize, &(&str, &'static str, f64))| {
        let values: Vec<f64> = seeds.iter().filter_map(|seed| Some(seed.get(nth)?.2)).collect();
        let reference = reference_per_hour.filter(|_| *name == "tasks").map(|per_hour| [per_hour]);
        let limit = reference.as_ref().map(|values| ("the reference as given", values.as_slice()));
        Figure::new("P7", format!("{title}: {name}"), unit, &values, limit)
    };
    first.iter().enumerate().map(figure).collect()
}
