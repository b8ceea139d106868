//! Task failures of robots on trial beside those of robots that go on with the old software at the same time: an e-process, a bet
//! against "the new software is no worse" whose winnings are the evidence.
//!
//! Under the null hypothesis the failure rate per task on trial is at most that of the controls. Then, of the failures in an interval in
//! which trial robots ended te tasks and controls ce, each is on trial with probability q0 = te / (te + ce) at most; if tasks fail R
//! times as often, with q1 = R·te / (R·te + ce). Each failure multiplies E by q1 / q0 or (1 - q1) / (1 - q0). Given how many failed, those on trial are
//! binomial if failures are rare and less spread out than that otherwise (W. Hoeffding 1956, 1963), so E never grows on average, and by J. Ville's
//! inequality (1939) it ever reaches 20 in at most 1 of 20 roll-outs that are no worse, however often one looks.
//! See P. Grünwald, R. de Heide and W. Koolen, Safe Testing, for tests of this kind.
//!
//! One robot that falls ill on trial is no bad release. So the same bet is kept once more for each robot that failed, with its tasks left
//! out, and the release is accused only if each of them has won as much: with any one robot sick and the others no worse the bet without
//! it is fair, so that release is accused in 1 of 20 roll-outs at most. It takes failures of two robots at least.
//!
//! Invariant: an interval ends by the clock, never because a task failed: the robots' mix changes during a roll-out, and an interval
//! that ends with a failure would blame whoever happened to work then ([`FailureEvidence::observe`]).

use super::fixed::{Rounding, ln_micronats};
use super::rates::{ABORT_EVIDENCE, FAILURE_RATIO};
use crate::ids::RobotId;
use crate::limits::COUNTED_MAX;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Here and above E speaks for an abort, micro-nats.
const ABORT: i64 = ln_micronats(ABORT_EVIDENCE as u128, 1, Rounding::Nearest);

/// How work ended on a robot or on several. What a person canceled counts nowhere.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct TaskTally {
    /// Tasks that succeeded.
    pub succeeded: u64,
    /// Attempts that ended by a fault, also of tasks that were done later.
    pub failed: u64,
}

/// What task failures say of a release so far: kept in a row, replayed to the same number on any machine.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailureEvidence {
    /// ln E, micro-nats; each factor rounded down. 0: nothing was seen.
    pub log_e_micronats: i64,
    /// ln E with the tasks of a robot left out, for each robot that failed a task on trial. One that failed none only lowers E. As many as
    /// were ever on trial at most.
    pub without_micronats: BTreeMap<RobotId, i64>,
    /// All that ended on trial.
    pub trial: TaskTally,
    /// All that ended on the controls.
    pub control: TaskTally,
}

/// What follows from task failures.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Suspicion {
    /// Nothing that chance does not explain.
    None,
    /// Tasks fail more often on trial, but without this robot it might be chance: it may be the robot.
    OneSickRobot(RobotId),
    /// Tasks fail more often on trial, whichever robot is left out.
    Release,
}

impl TaskTally {
    /// How many ended: the exposure.
    pub const fn ended(self) -> u64 {
        self.succeeded.saturating_add(self.failed)
    }

    /// Both together.
    pub const fn plus(self, other: Self) -> Self {
        Self {
            succeeded: self.succeeded.saturating_add(other.succeeded),
            failed: self.failed.saturating_add(other.failed),
        }
    }

    /// What is left without `part` of it.
    const fn minus(self, part: Self) -> Self {
        Self {
            succeeded: self.succeeded.saturating_sub(part.succeeded),
            failed: self.failed.saturating_sub(part.failed),
        }
    }
}

impl FailureEvidence {
    /// Takes in what ended on each robot on trial and on all controls since it was called last. The caller calls it at a pace of its own,
    /// not when a task fails.
    pub fn observe(&mut self, trial: &BTreeMap<RobotId, TaskTally>, control: TaskTally) {
        let all = trial.values().fold(TaskTally::default(), |sum, one| sum.plus(*one));
        for (robot_id, _) in trial.iter().filter(|(_, tally)| tally.failed > 0) {
            // Until now it had only succeeded, and E with that is the lower one.
            self.without_micronats.entry(robot_id.clone()).or_insert(self.log_e_micronats);
        }
        for (robot_id, log_e) in &mut self.without_micronats {
            let own = trial.get(robot_id).copied().unwrap_or_default();
            *log_e = raised(*log_e, all.minus(own), control);
        }
        self.log_e_micronats = raised(self.log_e_micronats, all, control);
        self.trial = self.trial.plus(all);
        self.control = self.control.plus(control);
    }

    /// What it says.
    pub fn suspicion(&self) -> Suspicion {
        if self.log_e_micronats < ABORT {
            return Suspicion::None;
        }
        match self.without_micronats.iter().min_by_key(|(_, log_e)| **log_e) {
            Some((robot_id, log_e)) if *log_e < ABORT => Suspicion::OneSickRobot(robot_id.clone()),
            _ => Suspicion::Release,
        }
    }

    /// E for people to read: 20 is what an abort takes. Decisions use the logarithm.
    pub fn e_value(&self) -> f64 {
        (self.log_e_micronats as f64 / 1e6).exp()
    }
}

/// ln E after an interval, micro-nats.
fn raised(log_e: i64, trial: TaskTally, control: TaskTally) -> i64 {
    if trial.failed == 0 && control.failed == 0 {
        return log_e;
    }
    let (on_trial, on_control) = factors(trial.ended(), control.ended());
    let gained = i128::from(trial.failed) * i128::from(on_trial) + i128::from(control.failed) * i128::from(on_control);
    (i128::from(log_e) + gained).clamp(i64::MIN.into(), i64::MAX.into()) as i64
}

/// What a failure on trial and one on the controls add, micro-nats. R·te + ce cancels in both: R·(te + ce) / (R·te + ce) and
/// (te + ce) / (R·te + ce). Counts beyond belief count as the largest that is believed.
fn factors(trial: u64, control: u64) -> (i64, i64) {
    let believed = |count: u64| u128::from(count.min(COUNTED_MAX));
    let ratio = u128::from(FAILURE_RATIO);
    let (all, weighed) = (believed(trial) + believed(control), ratio * believed(trial) + believed(control));
    if all == 0 {
        return (0, 0);
    }
    (ln_micronats(ratio * all, weighed, Rounding::Down), ln_micronats(all, weighed, Rounding::Down))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tally(ended: u64, failed: u64) -> TaskTally {
        TaskTally { succeeded: ended - failed, failed }
    }

    /// Robots on trial, by number.
    fn robots(tallies: &[TaskTally]) -> BTreeMap<RobotId, TaskTally> {
        let id = |n| RobotId::parse(&format!("rbt-{n}")).expect("a valid id");
        tallies.iter().enumerate().map(|(n, tally)| (id(n), *tally)).collect()
    }

    fn after(intervals: &[(TaskTally, TaskTally)]) -> FailureEvidence {
        let mut evidence = FailureEvidence::default();
        intervals.iter().for_each(|(trial, control)| evidence.observe(&robots(&[*trial]), *control));
        evidence
    }

    /// Chance of each number of failures among `n` tasks.
    fn binomial(n: u64, rate: f64) -> Vec<f64> {
        let mut shares = vec![1.0];
        for _ in 0..n {
            let mut next = vec![0.0; shares.len() + 1];
            for (k, share) in shares.iter().enumerate() {
                next[k] += share * (1.0 - rate);
                next[k + 1] += share * rate;
            }
            shares = next;
        }
        shares
    }

    #[test]
    fn a_failure_on_trial_speaks_against_the_release_and_one_beside_it_for_it() {
        let even = |trial, control| after(&[(tally(10, trial), tally(10, control))]).log_e_micronats;
        assert_eq!(even(0, 0), 0);
        assert_eq!((even(1, 0), even(0, 1)), (405_465, -693_148), "ln 3/2 and ln 1/2, rounded down");
        assert_eq!(even(2, 3), 2 * 405_465 - 3 * 693_148);
    }

    #[test]
    fn without_controls_or_without_a_trial_nothing_is_learnt() {
        assert_eq!(after(&[(tally(50, 40), tally(0, 0)), (tally(0, 0), tally(50, 40))]).log_e_micronats, 0);
    }

    #[test]
    fn evidence_never_grows_on_average_while_the_release_is_no_worse() {
        for (te, ce) in [(1, 1), (1, 6), (6, 1), (4, 5), (7, 7), (0, 3)] {
            for control in [0.01, 0.1, 0.5, 0.9, 1.0] {
                for trial in [control, control * 0.7, 0.0] {
                    let mut mean = 0.0;
                    for (t, chance) in binomial(te, trial).into_iter().enumerate() {
                        for (c, other) in binomial(ce, control).into_iter().enumerate() {
                            let seen = (tally(te, t as u64), tally(ce, c as u64));
                            mean += chance * other * after(&[seen]).e_value();
                        }
                    }
                    assert!(mean <= 1.0 + 1e-12, "{te} and {ce} tasks at {trial} and {control}: {mean}");
                }
            }
        }
    }

    /// Share of roll-outs whose evidence ever reaches 20, over all ways that `intervals` of a task on trial and one beside it can go, but
    /// for those that together happen less than once in a million.
    fn ever_accused(trial: f64, control: f64, intervals: u32) -> f64 {
        let (mut accused, mut open) = (0.0, BTreeMap::from([(0i64, 1.0)]));
        for _ in 0..intervals {
            let mut next = BTreeMap::new();
            for (log_e_micronats, share) in open {
                for (t, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    let log_e = raised(log_e_micronats, tally(1, t), tally(1, c));
                    let chance = |failed, rate: f64| if failed == 1 { rate } else { 1.0 - rate };
                    let share = share * chance(t, trial) * chance(c, control);
                    if share < 1e-12 {
                        continue;
                    }
                    if log_e >= ABORT {
                        accused += share;
                    } else {
                        *next.entry(log_e).or_insert(0.0) += share;
                    }
                }
            }
            open = next;
        }
        accused
    }

    #[test]
    fn a_release_that_is_no_worse_is_accused_in_one_of_twenty_roll_outs_at_most_however_long_one_looks() {
        for rate in [0.02, 0.3] {
            let even = ever_accused(rate, rate, 400);
            assert!(even <= 0.049 && even > 0.001, "{rate}: {even}");
            assert!(ever_accused(rate / 2.0, rate, 400) < even);
        }
        assert!(ever_accused(0.06, 0.02, 400) > 0.5, "three times as many failures are found");
    }

    /// Controls work first, then robots on trial, and the interval ends with the first failure. Both fail equally often, yet the
    /// evidence grows on average: the trial is blamed for having worked last.
    #[test]
    fn an_interval_that_a_failure_ends_would_accuse_a_good_release() {
        let (rate, controls) = (0.02, 100u64);
        let mut mean = 0.0;
        let mut still_clean = 1.0;
        for n in 1..=5_000u64 {
            let failed = if n <= controls {
                after(&[(tally(0, 0), tally(n, 1))])
            } else {
                after(&[(tally(n - controls, 1), tally(controls, 0))])
            };
            mean += still_clean * rate * failed.e_value();
            still_clean *= 1.0 - rate;
        }
        assert!(mean > 1.1, "{mean}");
    }

    #[test]
    fn failures_of_one_robot_accuse_the_robot_and_those_of_two_the_release() {
        let seen = |trial: &[TaskTally]| {
            let mut evidence = FailureEvidence::default();
            evidence.observe(&robots(trial), tally(120, 2));
            assert!(evidence.e_value() > 20.0, "{}", evidence.e_value());
            evidence.suspicion()
        };
        let sick = RobotId::parse("rbt-1").expect("a valid id");
        assert_eq!(seen(&[tally(20, 0), tally(20, 8)]), Suspicion::OneSickRobot(sick.clone()));
        assert_eq!(seen(&[tally(20, 1), tally(20, 8), tally(20, 1)]), Suspicion::OneSickRobot(sick));
        assert_eq!(seen(&[tally(20, 7), tally(20, 8)]), Suspicion::Release);
        assert_eq!(after(&[(tally(40, 1), tally(120, 2))]).suspicion(), Suspicion::None);
    }

    #[test]
    fn a_robot_alone_on_trial_never_accuses_the_release() {
        let evidence = after(&[(tally(40, 30), tally(400, 2)), (tally(40, 30), tally(400, 2))]);
        assert!(evidence.e_value() > 1e6 && matches!(evidence.suspicion(), Suspicion::OneSickRobot(_)));
    }

    proptest! {
        /// Whatever each robot did in whichever interval: what is kept is never more than a bet that had left the robot out from the start.
        #[test]
        fn the_bet_without_a_robot_is_never_told_greater_than_one_that_never_saw_it(
            intervals in prop::collection::vec((prop::collection::vec((0u64..4, 0u64..2), 3), (0u64..9, 0u64..2)), 1..12)
        ) {
            let tally = |(succeeded, failed)| TaskTally { succeeded, failed };
            let (mut all, mut without) = (FailureEvidence::default(), FailureEvidence::default());
            for (trial, control) in intervals {
                let mut trial = robots(&trial.into_iter().map(tally).collect::<Vec<_>>());
                all.observe(&trial, tally(control));
                trial.pop_first();
                without.observe(&trial, tally(control));
            }
            let robot = RobotId::parse("rbt-0").expect("a valid id");
            let kept = all.without_micronats.get(&robot).copied().unwrap_or(all.log_e_micronats);
            prop_assert!(kept <= without.log_e_micronats, "{kept} {}", without.log_e_micronats);
        }
    }

    #[test]
    fn it_comes_back_from_its_row_as_it_was() {
        let evidence = after(&[(tally(40, 8), tally(120, 2)), (tally(7, 1), tally(9, 3))]);
        let text = serde_json::to_string(&evidence).expect("numbers");
        assert_eq!(serde_json::from_str::<FailureEvidence>(&text).expect("the same numbers"), evidence);
    }

    proptest! {
        #[test]
        fn no_counts_are_too_large(ts: u64, tf: u64, cs: u64, cf: u64) {
            let (trial, control) = (TaskTally { succeeded: ts, failed: tf }, TaskTally { succeeded: cs, failed: cf });
            let evidence = after(&[(trial, control), (trial, control)]);
            let _ = evidence.suspicion();
            prop_assert!(evidence.trial.ended() >= trial.ended() && evidence.control.ended() >= control.ended());
        }
    }
}
