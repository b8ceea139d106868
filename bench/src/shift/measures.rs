//! What is told of a shift: rates, times and shares, from the records of its tasks and its bodies.
//!
//! Invariants:
//! 1. Every figure is of the measured time, from the end of the warm-up to the end of the shift. Of the whole shift are
//!    only the rules that may not be broken, the items that the store did not take, and the times by the wall.
//! 2. Times of tasks are of those submitted within the measured time that did not fail. One that is not over counts
//!    with its time so far: without it the longest would be left out.
//! 3. What there is nothing to measure of is left out.

use super::expected_starts::StartCounts;
use super::run::Outcome;
use super::scenario::{BATTERY_RATES, BodyFaults};
use super::task_records::TaskRecord;
use super::watches::Sample;
use crate::figure::{Figure, median, percentile};
use midshift_core::energy::{CAPACITY_MWH, IDLE_W};
use midshift_core::site::grid;
use midshift_core::task::spec::Class;
use midshift_sim::body::Counts;
use midshift_sim::faults::FAULT_BATTERY_EMPTY;
use std::collections::BTreeMap;
use std::time::Duration;

/// Name of the time that a run took.
const RUN_BY_THE_WALL: &str = "run by the wall";

/// One figure of one shift.
#[derive(Clone, Debug)]
pub struct Measure {
    /// What was measured.
    pub name: String,
    /// Unit of its value.
    pub unit: &'static str,
    /// What came out.
    pub value: f64,
}

/// All that is told of one shift.
#[derive(Clone, Debug, Default)]
pub struct Measures(Vec<Measure>);

impl Measures {
    /// The value under a name; none: there was nothing to measure.
    pub fn find(&self, name: &str) -> Option<f64> {
        self.0.iter().find(|measure| measure.name == name).map(|measure| measure.value)
    }

    fn add(&mut self, name: impl Into<String>, unit: &'static str, value: f64) {
        self.0.push(Measure { name: name.into(), unit, value });
    }

    fn add_times(&mut self, what: &str, times_ms: &[u64]) {
        if times_ms.is_empty() {
            return;
        }
        let times: Vec<f64> = times_ms.iter().map(|ms| *ms as f64 / 1e3).collect();
        self.add(format!("{what}, mean"), "s", times.iter().sum::<f64>() / times.len() as f64);
        for (words, share) in [("p50", 0.5), ("p95", 0.95), ("longest", 1.0)] {
            self.add(format!("{what}, {words}"), "s", percentile(&times, share));
        }
    }
}

/// Tasks done in an hour of the measured time.
pub fn tasks_per_hour(outcome: &Outcome) -> f64 {
    let done = outcome.tasks.iter().filter(|task| task.done_ms.is_some_and(|at| at >= outcome.begin.at_ms)).count();
    done as f64 * 3_600_000.0 / measured_ms(outcome) as f64
}

fn measured_ms(outcome: &Outcome) -> u64 {
    (outcome.end.at_ms - outcome.begin.at_ms).max(1)
}

/// Samples of the measured time.
fn samples(outcome: &Outcome) -> impl Iterator<Item = &Sample> {
    outcome.samples.iter().filter(|sample| sample.at_ms > outcome.begin.at_ms)
}

/// What bodies counted within the measured time.
fn counted(outcome: &Outcome, count: fn(&Counts) -> u64) -> u64 {
    count(&outcome.end.bodies.counts) - count(&outcome.begin.bodies.counts)
}

/// Everything that is told of a shift.
pub fn measures(outcome: &Outcome) -> Measures {
    let mut told = Measures::default();
    add_tasks(&mut told, outcome);
    add_robots(&mut told, outcome);
    add_people(&mut told, outcome);
    add_rules(&mut told, outcome);
    if outcome.charging.is_some() {
        add_batteries(&mut told, outcome);
    }
    if let Some(losses) = &outcome.losses {
        told.add("robots lost inside", "1", losses.robots as f64);
        told.add("places cleared by a person", "1", losses.cleared as f64);
        if losses.robots > 0 {
            told.add("held by a lost robot, longest", "s", losses.longest_hold_ms as f64 / 1e3);
            told.add("passage held by a lost robot, longest", "s", losses.longest_passage_hold_ms as f64 / 1e3);
        }
    }
    if !outcome.end.plans.plan_ms.is_empty() {
        told.add("plan by the wall, p50", "ms", percentile(&outcome.end.plans.plan_ms, 0.5));
        told.add("plan by the wall, p99", "ms", percentile(&outcome.end.plans.plan_ms, 0.99));
    }
    told.add(RUN_BY_THE_WALL, "s", outcome.wall.as_secs_f64());
    told
}

fn add_tasks(told: &mut Measures, outcome: &Outcome) {
    told.add("tasks", "1/h", tasks_per_hour(outcome));
    let driven_mm = outcome.end.bodies.path_mm - outcome.begin.bodies.path_mm;
    if driven_mm > 0 {
        told.add("empty travel", "%", 100.0 * (1.0 - outcome.loaded_mm as f64 / driven_mm as f64));
    }
    let (begins_ms, ends_ms) = (outcome.begin.at_ms, outcome.end.at_ms);
    let submitted: Vec<&TaskRecord> = outcome.tasks.iter().filter(|task| task.submitted_ms >= begins_ms).collect();
    let completion_ms = |task: &TaskRecord| task.done_ms.unwrap_or(ends_ms) - task.submitted_ms;
    let wait_ms = |task: &TaskRecord| task.assigned_ms.unwrap_or(ends_ms) - task.submitted_ms;
    let goes_on: Vec<&TaskRecord> = submitted.iter().copied().filter(|task| !task.has_failed()).collect();
    let mut add_times = |of: &str, tasks: &[&TaskRecord]| {
        told.add_times(&format!("{of}completion"), &tasks.iter().map(|t| completion_ms(t)).collect::<Vec<_>>());
        told.add_times(&format!("{of}wait for a robot"), &tasks.iter().map(|t| wait_ms(t)).collect::<Vec<_>>());
    };
    add_times("", &goes_on);
    for class in [Class::Urgent, Class::Normal, Class::Background] {
        let of_class: Vec<&TaskRecord> = goes_on.iter().copied().filter(|task| task.class == class).collect();
        if of_class.len() < goes_on.len() {
            add_times(&format!("{} ", class.as_str()), &of_class);
        }
    }
    let not_done = goes_on.iter().filter(|task| task.done_ms.is_none()).count();
    told.add("not done at the end", "tasks", not_done as f64);
    told.add("waiting at the end", "tasks", outcome.end.counts.waiting as f64);
    told.add("tasks that failed", "tasks", (outcome.end.counts.failed - outcome.begin.counts.failed) as f64);
    let assigned = submitted.iter().filter(|task| task.assigned_ms.is_some()).count();
    if assigned > 0 {
        let sum = |times: fn(&TaskRecord) -> u32| submitted.iter().map(|task| f64::from(times(task))).sum::<f64>();
        told.add("re-assignments a task", "1", sum(|task| task.reassignments) / assigned as f64);
        told.add("retries a task", "1", sum(|task| task.retries) / assigned as f64);
    }
}

fn add_robots(told: &mut Measures, outcome: &Outcome) {
    let looks = samples(outcome).count();
    if looks > 0 {
        let busy: usize = samples(outcome).map(|sample| sample.counts.busy).sum();
        told.add("robots with a task", "%", 100.0 * busy as f64 / (looks * outcome.robots) as f64);
    }
    let robots_ms = (outcome.robots as u64 * measured_ms(outcome)) as f64;
    let share = |ms: u64| 100.0 * ms as f64 / robots_ms;
    // A robot that waits for a grant has a task and no order.
    told.add("bodies with an order", "%", 100.0 - share(counted(outcome, |c| c.idle_ms)));
    told.add("driving", "%", share(counted(outcome, |c| c.driving_ms)));
    told.add("acting", "%", share(counted(outcome, |c| c.acting_ms)));
    told.add("standing with an order", "%", share(counted(outcome, |c| c.halted_ms + c.blocked_ms)));
    if outcome.is_grid {
        let driven_mm = outcome.end.bodies.path_mm - outcome.begin.bodies.path_mm;
        told.add("driving at the speed of a grid", "%", share(driven_mm * 1_000 / u64::from(grid::SPEED_MM_S)));
    }
    if let (Some(begin), Some(end)) = (outcome.begin.gaps, outcome.end.gaps) {
        let too_long = (end.named_too_long - begin.named_too_long) as f64;
        told.add("named for a soon-free robot longer than 30 s", "tasks", too_long);
        let idle_min = (end.idle_ms - begin.idle_ms) as f64 / 60_000.0;
        told.add("idle > 5 s beside a task named for nobody", "robot-min", idle_min);
        let starts = |of: fn(&StartCounts) -> u64| (of(&end.starts) - of(&begin.starts)) as f64;
        let of_told = |count: f64| 100.0 * count / starts(|s| s.told);
        if starts(|s| s.told) > 0.0 {
            told.add("tasks told when they would get a robot", "tasks", starts(|s| s.told));
            told.add("got it within the P10-P90 that they were told", "%", of_told(starts(|s| s.within)));
            told.add("got it before", "%", of_told(starts(|s| s.early)));
        }
    }
    let stood = |time: Duration| time.as_secs_f64() / 60.0;
    let (begin, end) = (outcome.begin.no_progress, outcome.end.no_progress);
    told.add("no progress", "robot-min", stood(end.planned - begin.planned));
    if outcome.planner_stop.is_some() {
        told.add("no progress while the planner is away", "robot-min", stood(end.unplanned - begin.unplanned));
    }
}

fn add_people(told: &mut Measures, outcome: &Outcome) {
    told.add("waiting for a person", "task-min", asking_ms(outcome) as f64 / 60_000.0);
    told.add("waiting for a person at the end", "tasks", outcome.end.counts.asking as f64);
    told.add("answers of a person", "1", (outcome.end.counts.answers - outcome.begin.counts.answers) as f64);
    if outcome.faults != BodyFaults::None || outcome.charging.is_some() {
        let reinstated = outcome.end.reinstated - outcome.begin.reinstated;
        told.add("robots let work again by a person", "1", reinstated as f64);
    }
}

/// What may never be, of the whole shift.
fn add_rules(told: &mut Measures, outcome: &Outcome) {
    let verdict = &outcome.end.bodies.verdict;
    told.add("tasks that ended twice", "1", outcome.end.counts.ended_twice as f64);
    told.add("steps done twice", "1", verdict.steps_done_twice as f64);
    told.add("items lost", "1", f64::from(u8::from(!verdict.items_conserved())));
    if outcome.end.bodies.collisions_modelled {
        told.add("exclusion violations", "1", verdict.exclusion_violations as f64);
    }
    told.add("items of plans lost", "1", outcome.end.plans.items_lost as f64);
}

fn add_batteries(told: &mut Measures, outcome: &Outcome) {
    let busy_ms = counted(outcome, |c| c.driving_ms + c.acting_ms + c.blocked_ms + c.halted_ms);
    let idle_w = IDLE_W * f64::from(BATTERY_RATES.draw_permille) / 1e3;
    let spent_mwh = (outcome.end.bodies.energy_mwh - outcome.begin.bodies.energy_mwh) as f64;
    let busy_mwh = spent_mwh - idle_w * counted(outcome, |c| c.idle_ms) as f64 / 3_600.0;
    if busy_ms > 0 {
        told.add("charge lost at work", "%/s", 100.0 * busy_mwh / CAPACITY_MWH / (busy_ms as f64 / 1e3));
    }
    let looks = samples(outcome).count();
    if looks > 0 {
        let charging: usize = samples(outcome).map(|sample| sample.batteries.charging).sum();
        let lowest = samples(outcome).map(|sample| sample.batteries.lowest_permille).min().unwrap_or_default();
        told.add("charging", "%", 100.0 * charging as f64 / (looks * outcome.robots) as f64);
        told.add("lowest charge", "%", f64::from(lowest) / 10.0);
    }
    let ran_empty = |faults: &BTreeMap<u32, u64>| faults.get(&FAULT_BATTERY_EMPTY).copied().unwrap_or_default() as f64;
    let (begin, end) = (&outcome.begin.bodies.faults_by_code, &outcome.end.bodies.faults_by_code);
    told.add("batteries that ran empty", "1", ran_empty(end) - ran_empty(begin));
}

/// Time that tasks spent in NEEDS_OPERATOR, summed up.
fn asking_ms(outcome: &Outcome) -> u64 {
    let mut before_ms = outcome.begin.at_ms;
    let mut since = |sample: &Sample| sample.at_ms - std::mem::replace(&mut before_ms, sample.at_ms);
    samples(outcome).map(|sample| sample.counts.asking as u64 * since(sample)).sum()
}

/// Before a stop of the planner, the backlog is the median of so long, milliseconds.
const BACKLOG_BASE_MS: u64 = 300_000;

/// How long after the planner's return no more tasks are open than before it stopped. None: more are until the end.
fn backlog_stays_ms(outcome: &Outcome) -> Option<u64> {
    let stop = outcome.planner_stop.as_ref()?;
    let (begins_ms, ends_ms) = (stop.start.as_millis() as u64, stop.end.as_millis() as u64);
    let before = begins_ms.saturating_sub(BACKLOG_BASE_MS)..begins_ms;
    let before = outcome.samples.iter().filter(|sample| before.contains(&sample.at_ms));
    let usual = median(&before.map(|sample| sample.counts.open as f64).collect::<Vec<_>>());
    let mut after = outcome.samples.iter().filter(|sample| sample.at_ms >= ends_ms);
    let gone = after.find(|sample| sample.counts.open as f64 <= usual);
    gone.map(|sample| sample.at_ms - ends_ms)
}

/// What became of the backlog of a stop of the planner, over the seeds of one policy.
pub fn backlog_figures(title: &str, seeds: &[Outcome]) -> Vec<Figure> {
    let Some(stop) = seeds.first().and_then(|seed| seed.planner_stop.clone()) else { return Vec::new() };
    let what = format!("{title}: backlog of a stop of {} min", (stop.end - stop.start).as_secs() / 60);
    let gone: Vec<f64> = seeds.iter().filter_map(backlog_stays_ms).map(|stays_ms| stays_ms as f64 / 60_000.0).collect();
    let never = (seeds.len() - gone.len()) as f64;
    let name = format!("{what} not gone at the end, runs of {}", seeds.len());
    let mut figures = vec![Figure::new("P7", name, "runs", &[never], None)];
    if !gone.is_empty() {
        figures.push(Figure::new("P7", format!("{what} is gone after"), "min", &gone, None));
    }
    figures
}

/// Figures over the seeds of one policy and workload. A reference stands beside the tasks in an hour.
pub fn figures(
    title: &str,
    seeds: &BTreeMap<u64, Measures>,
    target_of_wall: &'static str,
    reference_per_hour: Option<f64>,
) -> Vec<Figure> {
    let mut names: Vec<(&str, &'static str)> = Vec::new();
    for Measure { name, unit, .. } in seeds.values().flat_map(|seed| &seed.0) {
        if !names.iter().any(|(known, _)| known == name) {
            names.push((name, unit));
        }
    }
    let figure = |(name, unit): (&str, &'static str)| {
        let values: Vec<f64> = seeds.values().filter_map(|seed| seed.find(name)).collect();
        let reference = reference_per_hour.filter(|_| name == "tasks").map(|per_hour| [per_hour]);
        let limit = reference.as_ref().map(|values| ("the reference as given", values.as_slice()));
        let target = if name == RUN_BY_THE_WALL { target_of_wall } else { "P7" };
        Figure::new(target, format!("{title}: {name}"), unit, &values, limit)
    };
    names.into_iter().map(figure).collect()
}
