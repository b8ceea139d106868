//! The one recorder of metrics of this process: each with its HELP, histograms with buckets that can be added up over processes.

use crate::metrics_catalog::{Kind, METRICS};
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};
use std::sync::OnceLock;

/// It, made at the first call; none: another one was there.
pub fn handle() -> Option<PrometheusHandle> {
    static HANDLE: OnceLock<Option<PrometheusHandle>> = OnceLock::new();
    HANDLE.get_or_init(|| install().ok()).clone()
}

fn install() -> Result<PrometheusHandle, BuildError> {
    let handle = builder()?.install_recorder()?;
    describe();
    Ok(handle)
}

/// A recorder with the buckets of the catalog.
///
/// # Errors
/// Buckets that are none.
pub fn builder() -> Result<PrometheusBuilder, BuildError> {
    METRICS.iter().try_fold(PrometheusBuilder::new(), |builder, metric| match metric.kind {
        Kind::Histogram(buckets) => {
            builder.set_buckets_for_metric(Matcher::Full(metric.name.to_owned()), buckets.bounds())
        }
        Kind::Counter | Kind::Gauge => Ok(builder),
    })
}

/// Tells the recorder in charge what each metric says.
pub fn describe() {
    for metric in METRICS {
        match metric.kind {
            Kind::Counter => metrics::describe_counter!(metric.name, metric.help),
            Kind::Gauge => metrics::describe_gauge!(metric.name, metric.help),
            Kind::Histogram(_) => metrics::describe_histogram!(metric.name, metric.help),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scrape_has_help_and_buckets() {
        let recorder = builder().expect("buckets").build_recorder();
        let handle = recorder.handle();
        metrics::with_local_recorder(&recorder, || {
            describe();
            metrics::histogram!("midshift_fleet_task_wait_seconds", "class" => "urgent", "type" => "transport")
                .record(25.0);
        });
        let page = handle.render();
        let has = |line: &str| assert!(page.contains(line), "{line}: {page}");
        has("# HELP midshift_fleet_task_wait_seconds Site time from when first only a robot was missing");
        has("# TYPE midshift_fleet_task_wait_seconds histogram");
        has("midshift_fleet_task_wait_seconds_bucket{class=\"urgent\",type=\"transport\",le=\"20\"} 0");
        has("midshift_fleet_task_wait_seconds_bucket{class=\"urgent\",type=\"transport\",le=\"30\"} 1");
    }
}
