//! The outcome of robots over a whole roll-out: Wald's sequential probability ratio test.
//!
//! Each decided robot adds the logarithm of how much likelier its outcome is under a bad failure rate p1 than under a good one p0:
//! ln(p1 / p0) for a failure, ln((1 - p1) / (1 - p0)) for a clean one. At ln((1 - β) / α) or above the release is aborted, at
//! ln(β / (1 - α)) or below it is promoted, between them nothing is proven. Source: A. Wald, Sequential Tests of Statistical
//! Hypotheses, Annals of Mathematical Statistics 16 (1945). Looked at after each robot or after each wave, it aborts at most α / (1 - β) of
//! the good releases and promotes at most β / (1 - α) of the bad ones.

use super::bound::{RobotOutcomes, false_abort_permille, upper_bound_permille};
use super::fixed::{Rounding, ln_micronats};
use super::rates::{BAD_PERMILLE, FALSE_ABORT_PERMILLE, FALSE_PROMOTE_PERMILLE, FEW_ROBOTS, GOOD_PERMILLE};
use serde::{Deserialize, Serialize};

/// What a failed robot adds, micro-nats.
const FAILED: i64 = ratio(BAD_PERMILLE, GOOD_PERMILLE);
/// What a clean robot adds, micro-nats: below 0.
const CLEAN: i64 = ratio(1_000 - BAD_PERMILLE, 1_000 - GOOD_PERMILLE);
/// Here and above it aborts, micro-nats.
const ABORT: i64 = ratio(1_000 - FALSE_PROMOTE_PERMILLE, FALSE_ABORT_PERMILLE);
/// Here and below it promotes, micro-nats.
const PROMOTE: i64 = ratio(FALSE_PROMOTE_PERMILLE, 1_000 - FALSE_ABORT_PERMILLE);

const fn ratio(over: u16, under: u16) -> i64 {
    ln_micronats(over as u128, under as u128, Rounding::Nearest)
}

/// What a gate says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Good enough to go on.
    Promote,
    /// Too bad to go on.
    Abort,
    /// Too little was seen for either.
    Inconclusive,
}

/// A verdict on robots with all numbers behind it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutcomeEvidence {
    /// What it rests on.
    pub outcomes: RobotOutcomes,
    /// Log likelihood ratio of bad over good, micro-nats.
    pub log_ratio_micronats: i64,
    /// It aborts here and above, micro-nats.
    pub abort_micronats: i64,
    /// It promotes here and below, micro-nats.
    pub promote_micronats: i64,
    /// The failure rate is below this with 95 % confidence, permille.
    pub upper_bound_permille: u16,
    /// How often a good release shows a failure among so few robots, permille; none unless [`RobotOutcomes::is_early_failure`].
    pub false_abort_permille: Option<u16>,
    /// What follows.
    pub verdict: Verdict,
}

impl RobotOutcomes {
    /// How many were decided.
    pub const fn decided(self) -> u64 {
        self.clean as u64 + self.failed as u64
    }

    /// Log likelihood ratio of bad over good, micro-nats.
    pub const fn log_ratio_micronats(self) -> i64 {
        self.failed as i64 * FAILED + self.clean as i64 * CLEAN
    }

    /// What the sequential test says of them.
    pub const fn verdict(self) -> Verdict {
        match self.log_ratio_micronats() {
            ratio if ratio >= ABORT => Verdict::Abort,
            ratio if ratio <= PROMOTE => Verdict::Promote,
            _ => Verdict::Inconclusive,
        }
    }

    /// A failure among fewer robots than the sequential test can judge: policy decides.
    pub const fn is_early_failure(self) -> bool {
        self.failed > 0 && self.decided() < FEW_ROBOTS as u64
    }

    /// The verdict with all numbers behind it.
    pub fn evidence(self) -> OutcomeEvidence {
        OutcomeEvidence {
            outcomes: self,
            log_ratio_micronats: self.log_ratio_micronats(),
            abort_micronats: ABORT,
            promote_micronats: PROMOTE,
            upper_bound_permille: upper_bound_permille(self),
            false_abort_permille: self.is_early_failure().then(|| false_abort_permille(self.decided())),
            verdict: self.verdict(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn outcomes(decided: u32, failed: u32) -> RobotOutcomes {
        RobotOutcomes { clean: decided - failed, failed }
    }

    #[test]
    fn the_bounds_are_where_the_design_says() {
        assert_eq!((outcomes(10, 2).verdict(), outcomes(11, 2).verdict()), (Verdict::Abort, Verdict::Inconclusive));
        assert_eq!((outcomes(11, 0).verdict(), outcomes(12, 0).verdict()), (Verdict::Inconclusive, Verdict::Promote));
        assert_eq!((outcomes(23, 1).verdict(), outcomes(24, 1).verdict()), (Verdict::Inconclusive, Verdict::Promote));
        assert_eq!(outcomes(0, 0).verdict(), Verdict::Inconclusive);
    }

    #[test]
    fn one_failure_aborts_at_no_number_of_robots() {
        assert!((1..100_000).all(|n| outcomes(n, 1).verdict() != Verdict::Abort));
        assert!((2..=10).all(|n| outcomes(n, 2).verdict() == Verdict::Abort));
    }

    /// Shares of releases that end aborted and promoted when each robot fails at `rate` and the test is looked at after each, worked out
    /// over all ways that `robots` can end.
    fn shares(rate: f64, robots: u32) -> (f64, f64) {
        let (mut abort, mut promote, mut open) = (0.0, 0.0, vec![(0u32, 1.0)]);
        for n in 1..=robots {
            let mut next = vec![0.0; n as usize + 1];
            for (failed, share) in open {
                next[failed as usize] += share * (1.0 - rate);
                next[failed as usize + 1] += share * rate;
            }
            open = Vec::new();
            for (failed, share) in (0u32..).zip(next).filter(|(_, share)| *share > 0.0) {
                match outcomes(n, failed).verdict() {
                    Verdict::Abort => abort += share,
                    Verdict::Promote => promote += share,
                    Verdict::Inconclusive => open.push((failed, share)),
                }
            }
        }
        (abort, promote)
    }

    #[test]
    fn good_and_bad_releases_are_mistaken_as_seldom_as_wald_promises() {
        let (good, bad) = (shares(0.02, 1_000), shares(0.20, 1_000));
        assert!(good.0 + good.1 > 0.999_999 && bad.0 + bad.1 > 0.999_999, "every release ends: {good:?} {bad:?}");
        assert!(good.0 <= 0.05 / 0.90 && good.0 > 0.01, "aborted although good: {good:?}");
        assert!(bad.1 <= 0.10 / 0.95 && bad.1 > 0.05, "promoted although bad: {bad:?}");
    }

    #[test]
    fn a_worse_release_is_aborted_more_often() {
        let aborted: Vec<f64> = [0.01, 0.02, 0.05, 0.1, 0.2, 0.4].iter().map(|p| shares(*p, 200).0).collect();
        assert!(aborted.is_sorted() && aborted[5] > 0.99, "{aborted:?}");
    }

    #[test]
    fn the_evidence_says_everything_that_was_weighed() {
        let early = outcomes(3, 1).evidence();
        assert_eq!((early.verdict, early.false_abort_permille), (Verdict::Inconclusive, Some(59)));
        let proven = outcomes(12, 0).evidence();
        assert_eq!((proven.verdict, proven.false_abort_permille), (Verdict::Promote, None));
        assert_eq!(proven.upper_bound_permille, 221);
        assert!(proven.log_ratio_micronats <= proven.promote_micronats);
        let text = serde_json::to_string(&proven).expect("numbers");
        assert_eq!(serde_json::from_str::<OutcomeEvidence>(&text).expect("the same numbers"), proven);
    }

    proptest! {
        #[test]
        fn a_failure_more_never_speaks_for_a_release_and_a_clean_robot_never_against_it(clean: u32, failed: u32) {
            let here = RobotOutcomes { clean, failed }.log_ratio_micronats();
            let worse = RobotOutcomes { clean, failed: failed.saturating_add(1) }.log_ratio_micronats();
            let cleaner = RobotOutcomes { clean: clean.saturating_add(1), failed }.log_ratio_micronats();
            prop_assert!(cleaner <= here && here <= worse, "{cleaner} {here} {worse}");
        }
    }
}
