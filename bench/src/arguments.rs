//! Values of the command line that several measurements take.

/// Longest time that can be asked for, in the unit of the option: nobody waits longer for a measurement.
const LONGEST: f64 = 100_000.0;

/// Parses an amount of time in the unit of its option, such as hours.
///
/// # Errors
/// It is no number, not more than 0, or more than 100,000.
pub fn parse_time(text: &str) -> Result<f64, String> {
    let amount: f64 = text.parse().map_err(|_| "must be a number".to_owned())?;
    let is_time = amount > 0.0 && amount <= LONGEST;
    is_time.then_some(amount).ok_or_else(|| format!("must be more than 0 and at most {LONGEST}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_a_number_that_a_clock_can_count() {
        assert_eq!(parse_time("0.5"), Ok(0.5));
        for bad in ["", "an hour", "0", "-1", "NaN", "inf", "1e20"] {
            assert!(parse_time(bad).is_err(), "{bad}");
        }
    }
}
