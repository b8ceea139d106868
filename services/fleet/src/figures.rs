//! The figures of a shift as metrics: what robots do, and what became of tasks. Nothing of it goes through the store.
//!
//! Called by the loop of the process that leads. Invariant: a task is counted once its end is committed.

use midshift_core::fleet::projection::FleetProjection;
use midshift_core::fleet::{Board, FleetFigures};
use midshift_core::reason::Code;
use midshift_core::task::figures::TaskFigures;
use std::collections::BTreeSet;

/// Types of tasks that are told apart; others are `other`.
const TYPES_MAX: usize = 32;

/// What labels were used so far.
#[derive(Debug, Default)]
pub(crate) struct Figures {
    types: BTreeSet<String>,
    reasons: BTreeSet<Code>,
}

impl Figures {
    /// Publishes what stands now.
    pub(crate) fn publish(&mut self, view: &FleetProjection, board: &Board) {
        let now = FleetFigures::new(view, board);
        for (does, robots) in now.robots {
            metrics::gauge!("midshift_fleet_robots", "does" => does).set(robots as f64);
        }
        metrics::gauge!("midshift_fleet_robots_waiting_for_charger").set(now.waits_for_charger as f64);
        for (work, load, mm) in now.driven_mm {
            metrics::counter!("midshift_fleet_driven_metres_total", "work" => work, "load" => load)
                .absolute(mm / 1_000);
        }
        metrics::counter!("midshift_fleet_place_waits_total").absolute(view.place_waits);
        metrics::gauge!("midshift_fleet_tasks_open").set(view.tasks.len() as f64);
        let mut gone = std::mem::take(&mut self.reasons);
        for (code, tasks) in view.queue.counts() {
            metrics::gauge!("midshift_fleet_tasks_waiting", "reason" => code.as_str()).set(tasks as f64);
            gone.remove(&code);
            self.reasons.insert(code);
        }
        for code in gone {
            metrics::gauge!("midshift_fleet_tasks_waiting", "reason" => code.as_str()).set(0.0);
        }
    }

    /// Counts tasks that have ended.
    pub(crate) fn count(&mut self, ended: &[TaskFigures]) {
        for task in ended {
            if self.types.len() < TYPES_MAX && !self.types.contains(&task.kind) {
                self.types.insert(task.kind.clone());
            }
            let kind = self.types.get(&task.kind).map_or("other", String::as_str);
            let labels = [("class", task.class.as_str().to_owned()), ("type", kind.to_owned())];
            let state = ("state", task.phase.as_str().to_owned());
            let ends = [state, labels[0].clone(), labels[1].clone()];
            metrics::counter!("midshift_fleet_tasks_ended_total", &ends).increment(1);
            metrics::counter!("midshift_fleet_task_attempts_total", &labels).increment(task.attempts);
            if let Some(ms) = task.wait_ms {
                metrics::histogram!("midshift_fleet_task_wait_seconds", &labels).record(ms as f64 / 1_000.0);
            }
            if let Some(ms) = task.completion_ms {
                metrics::histogram!("midshift_fleet_task_completion_seconds", &labels).record(ms as f64 / 1_000.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use metrics_exporter_prometheus::PrometheusBuilder;
    use midshift_core::task::Phase;
    use midshift_core::task::spec::Class;

    #[test]
    fn types_beyond_the_first_are_counted_as_others() {
        let recorder = PrometheusBuilder::new().build_recorder();
        let task = |nth: usize| TaskFigures {
            phase: Phase::Succeeded,
            class: Class::Normal,
            kind: format!("type-{nth}"),
            wait_ms: None,
            completion_ms: None,
            attempts: 2,
        };
        metrics::with_local_recorder(&recorder, || {
            let mut figures = Figures::default();
            for _ in 0..2 {
                figures.count(&(0..TYPES_MAX + 3).map(task).collect::<Vec<_>>());
            }
        });
        let page = recorder.handle().render();
        let has = |line: &str| assert!(page.lines().any(|found| found == line), "{line}: {page}");
        has("midshift_fleet_task_attempts_total{class=\"normal\",type=\"type-31\"} 4");
        has("midshift_fleet_tasks_ended_total{state=\"SUCCEEDED\",class=\"normal\",type=\"other\"} 6");
    }
}
