//! A page of metrics as whoever judges a server looks at it.

/// What a server counts of itself, in the text form of Prometheus.
pub struct Metrics(pub String);

impl Metrics {
    /// Sum over all labels that have `label`.
    pub fn sum(&self, name: &str, label: &str) -> u64 {
        let of_name = |line: &&str| line.starts_with(name) && !line.starts_with('#') && line.contains(label);
        let value = |line: &str| line.rsplit(' ').next().and_then(|n| n.parse::<f64>().ok()).unwrap_or(0.0) as u64;
        self.0.lines().filter(of_name).map(value).sum()
    }
}
