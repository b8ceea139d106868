//! One figure and how it is told: a row of the table on stdout, a record in the JSON file.
//!
//! Invariant: no thresholds. A figure stands beside the raw limit that was measured in the same run, in turn with it.

use serde::Serialize;

/// The raw limit beside a figure.
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
    /// Median of the runs.
    pub median: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
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
    pub fn of(
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
            runs: values.len(),
            ratio: limit.as_ref().filter(|l| l.median != 0.0).map(|l| middle / l.median),
            limit,
        }
    }
}

/// The figures as a table.
pub fn table(figures: &[Figure]) -> String {
    let mut text = format!(
        "{:<4} {:<52} {:>12} {:>12} {:>12} {:<8} {:>4}  {:<38} {:>10} {:>7}\n",
        "", "figure", "median", "min", "max", "unit", "runs", "beside", "median", "ratio"
    );
    for f in figures {
        let (name, limit) =
            f.limit.as_ref().map_or(("", String::new()), |l| (l.name.as_str(), format!("{:.3}", l.median)));
        let ratio = f.ratio.map(|r| format!("{r:.3}")).unwrap_or_default();
        text += &format!(
            "{:<4} {:<52} {:>12.3} {:>12.3} {:>12.3} {:<8} {:>4}  {:<38} {:>10} {:>7}\n",
            f.target, f.name, f.median, f.min, f.max, f.unit, f.runs, name, limit, ratio
        );
    }
    text
}
