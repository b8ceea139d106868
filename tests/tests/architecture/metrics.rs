//! What programs count is in the catalog, as what it is, and nothing else is.

use crate::{ROOMS, of_rooms, read};
use midshift_process::metrics_catalog::{Kind, METRICS};
use std::collections::BTreeSet;

/// Macro and name of each metric that a text of a program counts.
fn counted(text: &str) -> impl Iterator<Item = (&str, &str)> {
    ["counter", "gauge", "histogram"].into_iter().flat_map(move |kind| {
        let uses = text.split(kind).skip(1).filter_map(|rest| rest.strip_prefix("!("));
        let names = uses.filter_map(|rest| rest.trim_start().strip_prefix('"')?.split('"').next());
        names
            .filter(|name| name.starts_with("midshift_") && *name != "midshift_test_seconds")
            .map(move |name| (kind, name))
    })
}

#[test]
fn what_is_counted_is_in_the_catalog_and_nothing_else() {
    let texts: Vec<String> = of_rooms(&ROOMS).filter(|path| path.contains("/src/")).map(read).collect();
    let counted: BTreeSet<(&str, &str)> = texts.iter().flat_map(|text| counted(text)).collect();
    let kind = |kind| match kind {
        Kind::Counter => "counter",
        Kind::Gauge => "gauge",
        Kind::Histogram(_) => "histogram",
    };
    let listed: BTreeSet<(&str, &str)> = METRICS.iter().map(|metric| (kind(metric.kind), metric.name)).collect();
    let (came, left): (Vec<_>, Vec<_>) = (counted.difference(&listed).collect(), listed.difference(&counted).collect());
    assert!(counted == listed, "counted and not listed {came:?}, listed and not counted {left:?}");
}

#[test]
fn a_metric_is_found_however_its_macro_is_broken_over_lines() {
    let text = "metrics::counter!(\n    \"midshift_a_total\", \"x\" => 1); histogram!(\"midshift_b\").record(1.0); gauge!(name)";
    assert_eq!(counted(text).collect::<Vec<_>>(), [("counter", "midshift_a_total"), ("histogram", "midshift_b")]);
}
