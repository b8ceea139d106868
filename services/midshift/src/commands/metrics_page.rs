//! docs/metrics.md is written from the catalog of metrics.

use super::page::{root, wrapped};
use midshift_process::metrics_catalog::{Kind, METRICS, Metric};

const HEAD: &str = "\
# Metrics

What `/metrics` of a process has, in the text form of Prometheus. This page is written from the programs by `cargo xtask
golden`; do not edit it.

Counters begin at 0 with the process, unless they say otherwise. Site time is that of the fleet, which a simulation may
speed up. Times are in seconds.

";

fn page() -> String {
    let line = |Metric { name, kind, help }: &Metric| {
        let kind = match kind {
            Kind::Counter => "counter",
            Kind::Gauge => "gauge",
            Kind::Histogram(_) => "histogram",
        };
        wrapped(&format!("- `{name}`, {kind}: {help}"), "  ")
    };
    METRICS.iter().map(line).fold(HEAD.to_owned(), |page, line| page + &line)
}

#[test]
fn golden_page_of_metrics() {
    let path = root().join("docs/metrics.md");
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, page()).expect("docs/metrics.md");
    }
    let stored = std::fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(stored, page(), "`cargo xtask golden` if the change is meant");
}
