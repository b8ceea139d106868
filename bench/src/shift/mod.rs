//! P7: a whole shift of a site in virtual time, in one process: what a policy gets out of a fleet under a workload.
//!
//! Real are the intake of tasks, telemetry with its sessions, fleet's reconciler with its planner and its law of traffic,
//! the agents' cores, and the simulated bodies with their world and its judge. Stood in for are:
//! 1. The store, by its model in memory.
//! 2. The transport: messages pass from hand to hand as values, after a fixed delay (`link`).
//! 3. The shell of an agent: its ledger is durable at once, and it has no bulk connection and no launcher (`robot`).
//! 4. The time: tokio's paused clock. A plan takes as much of it as `--plan-ms` says, by default
//!    none, and the planner rests as long, as it does by its own time; a commit takes none.
//!
//! Left out are the port, identity, stops, roll-outs, and housekeeping: a shift is shorter than what any of it keeps.
//!
//! Modules, from the lowest to the highest: `background_task`, `clock`, `task_records`, `plan_log`, `link`, `robot`,
//! `control_plane`, `chargers`, `floor`, `operator`, `breakers`, `lost_robots`, `workload`, `scenario`, `progress`,
//! `expected_starts`, `assignment_gaps`, `watches`, `run`, `measures`, `comparison`, `chart`, `options`.

mod assignment_gaps;
mod background_task;
mod breakers;
mod chargers;
mod chart;
mod clock;
mod comparison;
mod control_plane;
mod expected_starts;
mod floor;
mod link;
mod lost_robots;
mod measures;
mod operator;
mod options;
mod plan_log;
mod progress;
mod robot;
mod run;
mod scenario;
mod task_records;
mod watches;
mod workload;

use crate::figure::Figure;
use crate::outcome::RunOutcome;
use anyhow::Context;
use chart::Course;
use comparison::Series;
use floor::Floor;
use options::Policy;
pub use options::ShiftArgs;
use plan_log::PlansNoted;
use run::Outcome;
use scenario::Workload;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Runs every policy under every workload, once for each seed. A shift that fails is told, and the others go on.
pub fn run(args: &ShiftArgs, say: &dyn Fn(&str)) -> RunOutcome {
    let mut shifts = Shifts { args, say, told: RunOutcome::default(), played: Vec::new(), courses: Vec::new() };
    match Floor::read(args.source()) {
        Err(error) => shifts.told.add("all shifts", Err(error)),
        Ok(floor) => shifts.play_all(&Arc::new(floor)),
    }
    shifts.told
}

/// The shifts of one run.
struct Shifts<'a> {
    args: &'a ShiftArgs,
    say: &'a dyn Fn(&str),
    told: RunOutcome,
    played: Vec<Series>,
    courses: Vec<Course>,
}

impl Shifts<'_> {
    fn play_all(&mut self, plain: &Arc<Floor>) {
        self.told.figures.extend(self.args.settings());
        let saturated = self.measure_saturated_rates(plain);
        for workload in &self.args.workload {
            match self.args.floor_of(*workload, plain) {
                Err(error) => self.told.add(&format!("{workload:?}"), Err(error)),
                Ok(floor) => {
                    for nth in 0..workload.scenarios(self.args.load(0.0), self.args.lasts()).len() {
                        for policy in &self.args.policy {
                            self.play(&floor, *policy, (*workload, nth), &saturated);
                        }
                    }
                }
            }
        }
        self.told.figures.extend(comparison::compare_all(&self.played));
        if let Some(path) = &self.args.svg {
            let drawn = std::fs::write(path, chart::draw(&self.courses)).context("the chart");
            self.told.add("chart", drawn.map(|()| Vec::new()));
        }
    }

    /// Tasks in an hour of `fifo-nearest` with always enough of them, by seed: what loads are multiples of. Empty where
    /// no load is.
    fn measure_saturated_rates(&mut self, floor: &Arc<Floor>) -> BTreeMap<u64, f64> {
        let mut rates = BTreeMap::new();
        if !self.args.workload.iter().any(|workload| workload.needs_saturated_rate()) {
            return rates;
        }
        for seed in self.args.seeds() {
            match run::run(&self.args.saturated(floor, seed)) {
                Ok(outcome) => {
                    rates.insert(seed, measures::tasks_per_hour(&outcome));
                }
                Err(error) => self.told.add(&format!("saturated rate, seed {seed}"), Err(error)),
            }
        }
        let values: Vec<f64> = rates.values().copied().collect();
        if !values.is_empty() {
            let name = "saturated rate of fifo-nearest, which loads are shares of";
            self.told.figures.push(Figure::new("P7", name, "1/h", &values, None));
        }
        rates
    }

    /// Plays one policy under one scenario of a workload, with each seed.
    fn play(
        &mut self,
        floor: &Arc<Floor>,
        policy: Policy,
        (workload, nth): (Workload, usize),
        saturated: &BTreeMap<u64, f64>,
    ) {
        let (mut outcomes, mut by_seed) = (Vec::new(), BTreeMap::new());
        let (mut title, mut scenario_name) = (String::new(), "");
        for seed in self.args.seeds().take(workload.seeds_max()) {
            let per_hour = saturated.get(&seed).copied();
            let load = self.args.load(per_hour.unwrap_or_default());
            let scenario = workload.scenarios(load, self.args.lasts()).swap_remove(nth);
            scenario_name = scenario.name;
            title = format!("{} {scenario_name}", policy.name());
            let config = self.args.config(floor, seed, policy, scenario);
            let played = match per_hour {
                None if workload.needs_saturated_rate() => Err(anyhow::anyhow!("there is no saturated rate")),
                _ => run::run(&config),
            };
            match played {
                Err(error) => self.told.add(&format!("{title}, seed {seed}"), Err(error)),
                Ok(outcome) => {
                    (self.say)(&describe_end(&title, seed, &outcome));
                    by_seed.insert(seed, measures::measures(&outcome));
                    outcomes.push(outcome);
                }
            }
        }
        if outcomes.is_empty() {
            return;
        }
        let reference = self.args.reference_per_hour.filter(|_| workload == Workload::W2);
        let figures = measures::figures(&title, &by_seed, workload.target_of_wall(), reference);
        self.told.figures.extend(figures);
        self.told.figures.extend(measures::backlog_figures(&title, &outcomes));
        self.courses.push(Course::new(title, &outcomes));
        self.played.push(Series { policy: policy.name(), scenario: scenario_name, by_seed });
    }
}

/// Broken rules of one shift that are told.
const BROKEN_TOLD: usize = 8;

/// What was planned, what was left at the end, and which rules were broken.
fn describe_end(title: &str, seed: u64, outcome: &Outcome) -> String {
    let list = |counts: Vec<String>| if counts.is_empty() { "none".to_owned() } else { counts.join(", ") };
    let open =
        outcome.open_tasks().into_iter().map(|((phase, why), n)| format!("{n} {phase} {why}").trim_end().to_owned());
    let robots = outcome.verdicts.iter().map(|(code, n)| format!("{n} {code}").trim_end().to_owned());
    let PlansNoted { hash, items, .. } = outcome.end.plans;
    let (open, robots) = (list(open.collect()), list(robots.collect()));
    let told = format!("{title}, seed {seed}: plans {hash:016x}, {items} items; open tasks: {open}; robots: {robots}");
    let broken = outcome.end.bodies.verdict.findings.iter().take(BROKEN_TOLD);
    broken.fold(told, |told, finding| format!("{told}\n  broken: {finding}"))
}
