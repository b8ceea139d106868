//! Whether tasks get a robot when they were told they would: between the two moments of their first explanation.

use super::task_records::TaskRecords;
use midshift_core::ids::TaskId;
use midshift_core::time::Utc;
use midshift_proto::convert::time_of;
use midshift_proto::fleet::v1::TaskExplanation;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;

/// What the planner told of tasks that wait.
#[derive(Clone, Debug, Default)]
pub struct ExpectedStarts {
    /// Between when and when, of each task that was told something, milliseconds since the beginning.
    told: BTreeMap<TaskId, RangeInclusive<u64>>,
}

/// What came of what was told.
#[derive(Clone, Copy, Debug, Default)]
pub struct StartCounts {
    /// Tasks that had been told when they would get a robot, and did or should have.
    pub told: u64,
    /// Of those, within the two moments.
    pub within: u64,
    /// Before the first.
    pub early: u64,
}

impl ExpectedStarts {
    /// Takes what is told of a task, if it is the first of it.
    pub fn note_told(&mut self, task_id: &TaskId, explained: &TaskExplanation, now_ms: u64) {
        let moments = [&explained.explain_time, &explained.expected_start_p10_time, &explained.expected_start_p90_time];
        let [Some(now), Some(p10), Some(p90)] = moments.map(|at| at.as_ref().map(time_of)) else { return };
        let since_begin = |at: Utc| now_ms + at.ms_since(now);
        self.told.entry(task_id.clone()).or_insert_with(|| since_begin(p10)..=since_begin(p90));
    }

    /// What came of it until now.
    pub fn counts(&self, records: &TaskRecords, now_ms: u64) -> StartCounts {
        let mut counts = StartCounts::default();
        for (told, assigned_ms) in records.assigned(&self.told) {
            let is_over = assigned_ms.is_some() || now_ms > *told.end();
            counts.told += u64::from(is_over);
            counts.within += u64::from(assigned_ms.is_some_and(|at| told.contains(&at)));
            counts.early += u64::from(assigned_ms.is_some_and(|at| at < *told.start()));
        }
        counts
    }
}
