//! What a number of robots lets one say of the failure rate, and how often a good release looks bad by chance.
//!
//! Invariant: rounded up, so that a bound is never told better than it is.

use super::rates::{BOUND_ERROR_PERMILLE, GOOD_PERMILLE};
use serde::{Deserialize, Serialize};

/// Robots that were attempted and decided. Skipped ones count nowhere.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct RobotOutcomes {
    /// Came through.
    pub clean: u32,
    /// Went back by themselves, were lost, could not go back, or were taken out by the breaker.
    pub failed: u32,
}

/// A share that lies on its limit to within this counts as on it: rounding must not move a bound by a step.
const EQUAL: f64 = 1e-9;
/// Terms smaller than this beside the greatest add nothing.
const NOTHING: f64 = 1e-18;

/// The rate of failing robots is below this with 95 % confidence, permille, rounded up: the one-sided bound of C. J. Clopper and
/// E. S. Pearson (Biometrika 26, 1934), the smallest rate at which so few failures come up in 5 % of all cases. 1000 with no robot decided
/// or all failed. Without a failure it is 1 - 0.05^(1/n).
pub fn upper_bound_permille(outcomes: RobotOutcomes) -> u16 {
    if outcomes.clean == 0 {
        return 1_000;
    }
    let error = f64::from(BOUND_ERROR_PERMILLE) / 1e3 + EQUAL;
    let (mut below, mut at) = (0, 1_000);
    while at - below > 1 {
        let middle = (below + at) / 2;
        if at_most(outcomes.failed.into(), outcomes.decided(), middle) <= error {
            at = middle;
        } else {
            below = middle;
        }
    }
    at
}

/// How often a release with the good rate of failures shows one or more among `robots`, permille, rounded up: what it costs to abort
/// on the first failure. 1 - (1 - p0)^n.
pub fn false_abort_permille(robots: u64) -> u16 {
    let clean = at_most(0, robots, GOOD_PERMILLE);
    ((1.0 - clean) * 1e3 - EQUAL).ceil().max(0.0) as u16
}

/// P(X ≤ `failed`) of a binomial X of `decided` trials at 0 < `rate_permille` < 1000. Each term is weighed against the greatest, which is next
/// to the mean, so that nothing is lost at any size.
fn at_most(failed: u64, decided: u64, rate_permille: u16) -> f64 {
    let odds = f64::from(rate_permille) / f64::from(1_000 - rate_permille);
    let mode = (u128::from(decided) + 1) * u128::from(rate_permille) / 1_000;
    let mode = decided.min(mode as u64);
    let mut inside = if mode <= failed { 1.0 } else { 0.0 };
    let mut all = 1.0;
    let (mut weight, mut k) = (1.0, mode);
    while k > 0 && weight > NOTHING {
        weight *= k as f64 / ((decided - k + 1) as f64 * odds);
        k -= 1;
        all += weight;
        inside += if k <= failed { weight } else { 0.0 };
    }
    (weight, k) = (1.0, mode);
    while k < decided && weight > NOTHING {
        weight *= (decided - k) as f64 * odds / (k + 1) as f64;
        k += 1;
        all += weight;
        inside += if k <= failed { weight } else { 0.0 };
    }
    inside / all
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn bound(decided: u32, failed: u32) -> u16 {
        upper_bound_permille(RobotOutcomes { clean: decided - failed, failed })
    }

    /// Ways of `n` robots, `k` of them failed, times the permille of each: P(X ≤ failed) · 1000^n without any rounding.
    fn exactly(failed: u32, n: u32, rate: u128) -> u128 {
        let ways = |k: u32| (0..u128::from(k)).fold(1, |ways, i| ways * (u128::from(n) - i) / (i + 1));
        (0..=failed).map(|k| ways(k) * rate.pow(k) * (1_000 - rate).pow(n - k)).sum()
    }

    #[test]
    fn clean_robots_prove_what_the_design_says() {
        assert_eq!([bound(1, 0), bound(3, 0), bound(5, 0), bound(12, 0)], [950, 632, 451, 221]);
        assert_eq!([bound(0, 0), bound(1, 1), bound(7, 7)], [1_000; 3]);
        assert_eq!([bound(20, 1), bound(10_000, 0), bound(10_000, 200)], [217, 1, 23]);
    }

    #[test]
    fn every_bound_of_few_robots_is_the_one_of_whole_numbers() {
        for n in 1..=12u32 {
            for failed in 0..n {
                let is_below = |rate: u128| 20 * exactly(failed, n, rate) <= 1_000u128.pow(n);
                let first = (1..=1_000).find(|rate| is_below(*rate)).expect("certain failure is above any bound");
                assert_eq!(u128::from(bound(n, failed)), first, "{failed} of {n}");
            }
        }
    }

    #[test]
    fn the_bound_holds_in_ninety_five_of_a_hundred_cases_at_every_rate() {
        for n in [1, 3, 5, 12, 60] {
            let bounds: Vec<u16> = (0..=n).map(|failed| bound(n, failed)).collect();
            for rate in 1..1_000u16 {
                // Wrong are the outcomes with fewest failures, up to the last whose bound lies below the rate.
                let wrong = bounds.iter().take_while(|bound| **bound < rate).count() as u64;
                let share = if wrong == 0 { 0.0 } else { at_most(wrong - 1, n.into(), rate) };
                assert!(share <= 0.05 + EQUAL, "{n} robots at {rate}: {share}");
            }
        }
    }

    #[test]
    fn aborting_on_the_first_failure_costs_good_releases() {
        let costs: Vec<u16> = (0..10).map(false_abort_permille).collect();
        assert_eq!(costs, [0, 20, 40, 59, 78, 97, 115, 132, 150, 167]);
        assert_eq!(false_abort_permille(1_000_000), 1_000);
    }

    proptest! {
        #[test]
        fn a_bound_falls_with_clean_robots_and_rises_with_failed_ones(clean in 0u32..5_000, failed in 0u32..500) {
            let here = upper_bound_permille(RobotOutcomes { clean, failed });
            let cleaner = upper_bound_permille(RobotOutcomes { clean: clean + 1, failed });
            let worse = upper_bound_permille(RobotOutcomes { clean, failed: failed + 1 });
            prop_assert!(cleaner <= here && here <= worse, "{cleaner} {here} {worse}");
            prop_assert!(u64::from(here) * (u64::from(clean) + u64::from(failed)) >= u64::from(failed) * 1_000);
        }

    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn the_largest_fleets_have_a_bound_too(clean in 1_000_000u32.., failed: u32) {
            let rate = u128::from(failed) * 1_000 / (u128::from(clean) + u128::from(failed));
            let bound = u128::from(upper_bound_permille(RobotOutcomes { clean, failed }));
            prop_assert!(bound > rate && bound <= rate + 3, "{bound} {rate}");
        }
    }
}
