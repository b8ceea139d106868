//! What the edge counts, to be read by a test.

use metrics::{Counter, Gauge, Histogram, Key, KeyName, Metadata, Recorder, SharedString, Unit};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

#[derive(Default)]
pub struct Readings(Mutex<Vec<(Key, Arc<AtomicU64>)>>);

impl Readings {
    fn cell(&self, key: &Key) -> Arc<AtomicU64> {
        let mut cells = self.0.lock().expect("not poisoned");
        if let Some((_, cell)) = cells.iter().find(|(known, _)| known == key) {
            return cell.clone();
        }
        let cell = Arc::new(AtomicU64::new(0));
        cells.push((key.clone(), cell.clone()));
        cell
    }

    /// All counters of that name and label together.
    pub fn counter(&self, name: &str, label: (&str, &str)) -> u64 {
        let cells = self.0.lock().expect("not poisoned");
        let labelled = |key: &Key| key.labels().any(|l| (l.key(), l.value()) == label);
        let asked = cells.iter().filter(|(key, _)| key.name() == name && labelled(key));
        asked.map(|(_, cell)| cell.load(Ordering::SeqCst)).sum()
    }

    pub fn gauge(&self, name: &str) -> f64 {
        let cells = self.0.lock().expect("not poisoned");
        let cell = cells.iter().find(|(key, _)| key.name() == name).map(|(_, cell)| cell.load(Ordering::SeqCst));
        f64::from_bits(cell.unwrap_or_default())
    }
}

impl Recorder for Readings {
    fn describe_counter(&self, _: KeyName, _: Option<Unit>, _: SharedString) {}
    fn describe_gauge(&self, _: KeyName, _: Option<Unit>, _: SharedString) {}
    fn describe_histogram(&self, _: KeyName, _: Option<Unit>, _: SharedString) {}
    fn register_counter(&self, key: &Key, _: &Metadata<'_>) -> Counter {
        Counter::from_arc(self.cell(key))
    }
    fn register_gauge(&self, key: &Key, _: &Metadata<'_>) -> Gauge {
        Gauge::from_arc(self.cell(key))
    }
    fn register_histogram(&self, _: &Key, _: &Metadata<'_>) -> Histogram {
        Histogram::noop()
    }
}
