//! Natural logarithms in integers: the library's `ln` may differ in its last bit between machines, these cannot.

/// Binary places of the working precision.
const PLACES: u32 = 56;
/// ln 2 in units of 2^-56.
const LN_2: i128 = series(2, 1);

/// How a logarithm becomes whole micro-nats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Rounding {
    /// To the nearest.
    Nearest,
    /// Towards minus infinity: evidence is never told greater than it is.
    Down,
}

/// ln(`over` / `under`) in micro-nats. Both are at least 1 and below 2^68.
pub(super) const fn ln_micronats(over: u128, under: u128, rounding: Rounding) -> i64 {
    assert!(over > 0 && under > 0 && over >> 68 == 0 && under >> 68 == 0, "a ratio of small numbers above nothing");
    let (mut over, mut under, mut doublings) = (over, under, 0);
    while over >= 2 * under {
        under *= 2;
        doublings += 1;
    }
    while over < under {
        over *= 2;
        doublings -= 1;
    }
    let ln = series(over, under) + doublings * LN_2;
    let half = match rounding {
        Rounding::Nearest => 1 << (PLACES - 1),
        Rounding::Down => 0,
    };
    ((ln * 1_000_000 + half) >> PLACES) as i64
}

/// ln(`over` / `under`) for a ratio of 1 to 2, in units of 2^-56: 2·artanh((a - b) / (a + b)), whose terms fall ninefold.
const fn series(over: u128, under: u128) -> i128 {
    let z = ((over - under) << PLACES) / (over + under);
    let square = (z * z) >> PLACES;
    let (mut power, mut sum, mut odd) = (z, 0, 1);
    while power > 0 {
        sum += power / odd;
        power = (power * square) >> PLACES;
        odd += 2;
    }
    2 * sum as i128
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_logarithms_are_right_to_the_last_place() {
        let ln = |over, under| ln_micronats(over, under, Rounding::Nearest);
        assert_eq!([ln(1, 1), ln(2, 1), ln(10, 1), ln(18, 1)], [0, 693_147, 2_302_585, 2_890_372]);
        assert_eq!([ln(1, 2), ln(10, 95), ln(800, 980)], [-693_147, -2_251_292, -202_941]);
        assert_eq!(ln(1 << 67, 1), 46_440_861);
    }

    #[test]
    fn what_is_rounded_down_is_never_more_than_it_is() {
        assert_eq!(ln_micronats(1, 1, Rounding::Down), 0);
        assert_eq!(ln_micronats(10, 1, Rounding::Down), 2_302_585);
        assert_eq!(ln_micronats(1, 10, Rounding::Down), -2_302_586);
    }

    proptest! {
        #[test]
        fn every_logarithm_is_that_of_the_library_to_a_micronat(over in 1u64.., under in 1u64..) {
            let library = (over as f64 / under as f64).ln() * 1e6;
            let ours = ln_micronats(over.into(), under.into(), Rounding::Nearest) as f64;
            prop_assert!((library - ours).abs() < 0.51, "{library} {ours}");
        }
    }
}
