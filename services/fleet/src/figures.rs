//! The figures of a shift as metrics: what robots do, and what became of tasks. Nothing of it goes through the store.
//!
//! Called by the loop of the process that leads. Invariant: a task is counted once its end is committed.

use midshift_core::fleet::projection::FleetProjection;
use midshift_core::fleet::{Board, FleetFigures};
use midshift_core::reason::Code;
use midshift_core::task::figures::TaskFigures;
use midshift_core::time::{LinkDuration, LinkTime, Now};
use std::collections::BTreeSet;

/// Types of tasks that are told apart; others are `other`.
const TYPES_MAX: usize = 32;

/// How often what stands now is published.
const EVERY: LinkDuration = LinkDuration::from_secs(1);

/// What was published so far.
#[derive(Debug, Default)]
pub(crate) struct Figures {
    types: BTreeSet<String>,
    reasons: BTreeSet<Code>,
    place_waits: u64,
    published: Option<LinkTime>,
    /// Tasks that have ended, until it is known whether that is committed.
    pub(crate) ended: Vec<TaskFigures>,
}

impl Figures {
    /// Publishes what stands now.
    pub(crate) fn publish(&mut self, view: &FleetProjection, board: &Board, now: &Now) {
        if self.published.is_some_and(|at| now.link.since(at) < EVERY) {
            return;
        }
        self.published = Some(now.link);
        self.set(&FleetFigures::new(view, board, now), view.tasks.len());
        let waits = view.place_waits.saturating_sub(self.place_waits);
        metrics::counter!("midshift_fleet_place_waits_total").increment(waits);
        self.place_waits = view.place_waits;
        self.set_waiting(view.queue.counts());
    }

    /// Another process leads, and says what stands.
    pub(crate) fn leave(&mut self) {
        self.set(&FleetFigures::default(), 0);
        self.set_waiting(std::iter::empty());
        (self.place_waits, self.published) = (0, None);
    }

    fn set(&self, now: &FleetFigures, tasks_open: usize) {
        for does in FleetFigures::DOES {
            let robots = now.robots.get(does).copied().unwrap_or_default();
            metrics::gauge!("midshift_fleet_robots", "does" => does).set(robots as f64);
        }
        metrics::gauge!("midshift_fleet_robots_waiting_for_charger").set(now.waits_for_charger as f64);
        metrics::gauge!("midshift_fleet_tasks_open").set(tasks_open as f64);
        for (work, load, mm) in now.driven_mm {
            metrics::counter!("midshift_fleet_driven_metres_total", "work" => work, "load" => load)
                .absolute(mm / 1_000);
        }
    }

    fn set_waiting(&mut self, counts: impl Iterator<Item = (Code, u64)>) {
        let before = std::mem::take(&mut self.reasons);
        for (code, tasks) in before.into_iter().map(|code| (code, 0)).chain(counts) {
            metrics::gauge!("midshift_fleet_tasks_waiting", "reason" => code.as_str()).set(tasks as f64);
            if tasks > 0 {
                self.reasons.insert(code);
            }
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
