//! Verdicts on task failures: how often the evidence accuses a release that is no worse, and how soon one that is.

use super::luck::seeded;
use crate::figure::{Estimate, Figure};
use midshift_core::gates::{FailureEvidence, Suspicion, TaskTally};
use midshift_core::ids::RobotId;
use rand::RngExt;
use std::collections::BTreeMap;

/// Robots at work. Each ends one task in an interval.
const ROBOTS: usize = 20;
/// Tasks that fail on the old software.
const FAILURE_RATE: f64 = 0.02;
/// Intervals that a roll-out is looked at.
const HORIZON: u32 = 1_000;
/// Robots on trial from each interval on, as waves go.
const WAVES: [(u32, usize); 3] = [(0, 2), (100, 6), (300, 12)];
/// Robots of a canary wave that stays alone.
const CANARY: [(u32, usize); 1] = [(0, 6)];
/// What Ville's inequality allows of roll-outs that are no worse, percent.
const VILLE: (&str, f64) = ("at most, J. Ville 1939", 5.0);

/// How many times as often tasks fail on a robot while it is on trial, by the robot's number.
type Ratio = fn(usize) -> f64;

/// One kind of roll-out.
struct Shift<'a> {
    names: &'a [RobotId],
    waves: &'a [(u32, usize)],
    ratio: Ratio,
}

/// How one ended.
struct End {
    /// E reached what an abort takes, whoever was to blame.
    reached: bool,
    /// Tasks that had ended on trial when the release was accused.
    accused_after: Option<u64>,
    /// It was ever taken for one sick robot.
    sick_robot: bool,
}

impl Shift<'_> {
    fn play(&self, rng: &mut impl RngExt) -> End {
        let mut evidence = FailureEvidence::default();
        let mut trial: BTreeMap<RobotId, TaskTally> = BTreeMap::new();
        let mut end = End { reached: false, accused_after: None, sick_robot: false };
        for interval in 0..HORIZON {
            let on_trial = self.waves.iter().filter(|(from, _)| *from <= interval).map(|(_, n)| *n).max().unwrap_or(0);
            while trial.len() < on_trial {
                trial.insert(self.names[trial.len()].clone(), TaskTally::default());
            }
            for (i, tally) in trial.values_mut().enumerate() {
                *tally = one_task(FAILURE_RATE * (self.ratio)(i), rng);
            }
            let controls = (on_trial..ROBOTS).map(|_| one_task(FAILURE_RATE, rng));
            evidence.observe(&trial, controls.fold(TaskTally::default(), TaskTally::plus));
            match evidence.suspicion() {
                Suspicion::None => {}
                Suspicion::OneSickRobot(_) => (end.reached, end.sick_robot) = (true, true),
                Suspicion::Release => {
                    end.reached = true;
                    end.accused_after = Some(evidence.trial.ended());
                    return end;
                }
            }
        }
        end
    }

    fn many(&self, seed: u64, kind: u64, runs: usize) -> Vec<End> {
        let mut rng = seeded(seed, kind);
        (0..runs).map(|_| self.play(&mut rng)).collect()
    }
}

/// A robot ends a task.
fn one_task(failure_rate: f64, rng: &mut impl RngExt) -> TaskTally {
    let failed = u64::from(rng.random_bool(failure_rate));
    TaskTally { succeeded: 1 - failed, failed }
}

fn share(ends: &[End], has: impl Fn(&End) -> bool) -> Estimate {
    Estimate::percent(ends.iter().filter(|end| has(end)).count(), ends.len())
}

/// A release no worse in waves and as a canary, one sick robot, and releases that are worse.
pub fn figures(seed: u64, runs: usize) -> anyhow::Result<Vec<Figure>> {
    let names = (0..ROBOTS).map(|n| RobotId::parse(&format!("rbt-{n:02}")));
    let names = &names.collect::<Result<Vec<_>, _>>()?;
    let figure = |name: String, unit, estimate, limit| Figure::simulated("G4", name, unit, estimate, limit);
    let mut figures = Vec::new();
    for (name, waves, kind) in [("in waves", &WAVES[..], 400), ("canary of 6", &CANARY[..], 401)] {
        let ends = Shift { names, waves, ratio: |_| 1.0 }.many(seed, kind, runs);
        let what = format!("tasks, no worse, {name}, {HORIZON} a robot");
        figures.push(figure(format!("{what}: E reaches 20"), "%", share(&ends, |e| e.reached), Some(VILLE)));
        figures.push(figure(
            format!("{what}: release accused"),
            "%",
            share(&ends, |e| e.accused_after.is_some()),
            Some(VILLE),
        ));
    }
    let sick = |robot| if robot == 0 { 20.0 } else { 1.0 };
    let ends = Shift { names, waves: &CANARY, ratio: sick }.many(seed, 402, runs);
    figures.push(figure(
        "tasks, one robot 20 times as often: told to be sick".into(),
        "%",
        share(&ends, |e| e.sick_robot),
        None,
    ));
    let accused = share(&ends, |e| e.accused_after.is_some());
    figures.push(figure("tasks, one robot 20 times as often: release accused".into(), "%", accused, Some(VILLE)));
    let worse: [(u32, Ratio); 3] = [(2, |_| 2.0), (3, |_| 3.0), (5, |_| 5.0)];
    for ((times, ratio), kind) in worse.into_iter().zip(403..) {
        let ends = Shift { names, waves: &CANARY, ratio }.many(seed, kind, runs);
        let delays: Vec<f64> = ends.iter().filter_map(|e| e.accused_after).map(|tasks| tasks as f64).collect();
        let what = format!("tasks, {times} times as often, canary of 6");
        figures.push(figure(
            format!("{what}: release accused"),
            "%",
            share(&ends, |e| e.accused_after.is_some()),
            None,
        ));
        figures.push(figure(format!("{what}: accused after"), "tasks", Estimate::mean(&delays), None));
    }
    Ok(figures)
}
