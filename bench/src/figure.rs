//! One figure and how it is told: a row of the table on stdout, a record in the JSON file.
//!
//! Invariant: no thresholds. A figure stands beside the raw limit that was measured in the same run, in turn with it.

use serde::Serialize;

/// The raw limit beside a figure; of a simulation what the design says or what was worked out exactly.
#[derive(Clone, Debug, Serialize)]
pub struct Limit {
    /// What was measured.
    pub name: String,
    /// Median, in the figure's unit.
    pub median: f64,
}

/// One figure over several runs.
#[derive(Clone, Debug, Serialize)]
pub struct Figure {
    /// Target of the design it answers, e.g. `P6`.
    pub target: &'static str,
    /// What was measured.
    pub name: String,
    /// Unit of all numbers.
    pub unit: &'static str,
    /// Median of the runs; of a simulation their mean.
    pub median: f64,
    /// Smallest; of a simulation the lower end of what 95 % of repetitions would tell.
    pub min: f64,
    /// Largest; of a simulation the upper end.
    pub max: f64,
    /// Half of the way between the two: the Monte-Carlo error. None if nothing was drawn by chance.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<f64>,
    /// How many.
    pub runs: usize,
    /// The raw limit of the same run; none if there is no such thing.
    pub limit: Option<Limit>,
    /// Median over the limit's median.
    pub ratio: Option<f64>,
}

/// Median of some numbers; 0 of none.
pub fn median(values: &[f64]) -> f64 {
    percentile(values, 0.5)
}

/// The value below which this share of the numbers lies; 0 of none.
pub fn percentile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = ((sorted.len() as f64 - 1.0) * share).round().max(0.0) as usize;
    sorted.get(at).copied().unwrap_or(0.0)
}

impl Figure {
    /// From the values of several runs and those of its limit.
    pub fn new(
        target: &'static str,
        name: impl Into<String>,
        unit: &'static str,
        values: &[f64],
        limit: Option<(&str, &[f64])>,
    ) -> Self {
        let limit = limit.map(|(name, values)| Limit { name: name.to_owned(), median: median(values) });
        let middle = median(values);
        Self {
            target,
            name: name.into(),
            unit,
            median: middle,
            min: percentile(values, 0.0),
            max: percentile(values, 1.0),
            error: None,
            runs: values.len(),
            ratio: ratio(middle, limit.as_ref()),
            limit,
        }
    }

    /// From the mean of a simulation and the interval that it lies in by chance, at 95 %.
    pub fn simulated(
        target: &'static str,
        name: impl Into<String>,
        unit: &'static str,
        estimate: Estimate,
        limit: Option<(&str, f64)>,
    ) -> Self {
        let limit = limit.map(|(name, median)| Limit { name: name.to_owned(), median });
        Self {
            target,
            name: name.into(),
            unit,
            median: estimate.mean,
            min: estimate.low,
            max: estimate.high,
            error: Some((estimate.high - estimate.low) / 2.0),
            runs: estimate.runs,
            ratio: ratio(estimate.mean, limit.as_ref()),
            limit,
        }
    }
}

fn ratio(middle: f64, limit: Option<&Limit>) -> Option<f64> {
    limit.filter(|l| l.median != 0.0).map(|l| middle / l.median)
}

/// Standard deviations on each side that 95 % of all repetitions lie in.
const NORMAL_95: f64 = 1.96;

/// A mean over simulated runs, with its 95 % interval.
#[derive(Clone, Copy, Debug)]
pub struct Estimate {
    mean: f64,
    low: f64,
    high: f64,
    runs: usize,
}

impl Estimate {
    /// The share of `runs` that did something, in percent, with E. B. Wilson's interval, which says something at 0 and at all too.
    pub fn percent(hits: usize, runs: usize) -> Self {
        let (n, z2) = (runs.max(1) as f64, NORMAL_95 * NORMAL_95);
        let share = hits as f64 / n;
        let middle = (share + z2 / (2.0 * n)) / (1.0 + z2 / n);
        let half = NORMAL_95 * (share * (1.0 - share) / n + z2 / (4.0 * n * n)).sqrt() / (1.0 + z2 / n);
        let (low, high) = ((middle - half).min(share), (middle + half).max(share));
        Self { mean: share * 100.0, low: low * 100.0, high: high * 100.0, runs }
    }

    /// The mean of what the runs counted; 0 of none.
    pub fn mean(counts: &[f64]) -> Self {
        let n = counts.len().max(1) as f64;
        let mean = counts.iter().sum::<f64>() / n;
        let variance = counts.iter().map(|c| (c - mean) * (c - mean)).sum::<f64>() / (n - 1.0).max(1.0);
        let half = NORMAL_95 * (variance / n).sqrt();
        Self { mean, low: mean - half, high: mean + half, runs: counts.len() }
    }
}

/// The figures as a table.
pub fn table(figures: &[Figure]) -> String {
    let mut text = format!(
        "{:<4} {:<60} {:>12} {:>12} {:>12} {:>7} {:<8} {:>6}  {:<38} {:>10} {:>7}\n",
        "", "figure", "median", "min", "max", "±", "unit", "runs", "beside", "median", "ratio"
    );
    for f in figures {
        let (name, limit) =
            f.limit.as_ref().map_or(("", String::new()), |l| (l.name.as_str(), format!("{:.3}", l.median)));
        let ratio = f.ratio.map(|r| format!("{r:.3}")).unwrap_or_default();
        let error = f.error.map(|e| format!("{e:.3}")).unwrap_or_default();
        text += &format!(
            "{:<4} {:<60} {:>12.3} {:>12.3} {:>12.3} {:>7} {:<8} {:>6}  {:<38} {:>10} {:>7}\n",
            f.target, f.name, f.median, f.min, f.max, error, f.unit, f.runs, name, limit, ratio
        );
    }
    text
}
