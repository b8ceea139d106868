//! What the story and its roll-outs came to, and why it cannot be called good.
//!
//! Invariant: activations are judged by the bodies' own journals, which say each start of software; the rows under test are shown beside them.

use super::budget::{Fullest, Seen};
use midshift_proto::convert::ms_of;
use midshift_proto::ota::v1;
use serde::Serialize;

/// Medians of the parts of the time that robots were out of work, milliseconds, each on its own clock.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct OffWork {
    /// Site clock: asked until no new work.
    pub drain_wait_ms: Option<u64>,
    /// Site clock: from there until parked.
    pub park_drive_ms: Option<u64>,
    /// Link clock: parked until permitted.
    pub parked_to_grant_ms: Option<u64>,
    /// Link clock: permitted until heard with the bundle.
    pub switch_ms: Option<u64>,
    /// Site clock: from there until at work.
    pub probation_ms: Option<u64>,
}

/// What one roll-out came to.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Played {
    /// Which bundle.
    pub bundle: String,
    /// It was to be kept by all.
    pub is_good: bool,
    /// Its last phase (roll-out row).
    pub phase: String,
    /// Robots on which it ever began to run (journals).
    pub robots_that_ran_it: usize,
    /// Of these, for the first time when it had been aborted and each permission of before was past its life (journals; the moment of the abort
    /// is the row's).
    pub activated_after_abort: usize,
    /// Most robots on which new software began to run within one probation (journals).
    pub begun_at_once_most: usize,
    /// Robots permitted when it was aborted, and in the end (rows).
    pub touched_at_abort: Option<u32>,
    /// See above.
    pub touched: u32,
    /// Robots of the canary wave (rows).
    pub canary: u32,
    /// Most robots that changed their software at once, over the whole site (heartbeats).
    pub off_work_most: usize,
    /// As many might have, over the whole site: of each area as many as might ever in this roll-out (heartbeats and the areas' rules).
    pub off_work_allowed: usize,
    /// The fullest moment of each area. A robot counts for the area that it was taken from, wherever it and the others are afterwards (rows of
    /// drains; heartbeats and the areas' rules).
    pub areas: Vec<Fullest>,
    /// Where more robots were out of work than their area or their roll-out allows, or one changed its software at work (the same).
    pub budget_broken: Vec<String>,
    /// Robots that keep it in the end: launched ones by their switch record, the others by their heartbeats' versions.
    pub kept_by: usize,
    /// Robots that run something else than they should.
    pub elsewhere: Vec<String>,
    /// Verdicts with their numbers (roll-out row).
    pub verdicts: Vec<String>,
    /// Why it was aborted (roll-out row).
    pub abort: Option<String>,
    /// Medians (rows, stamped by the server).
    pub off_work: OffWork,
    /// Seconds of real time from start to end.
    pub wall_s: f64,
    /// Tasks that succeeded from its start to its end, as so many an hour (rows).
    pub tasks_per_hour: f64,
}

/// What the story came to.
#[derive(Clone, Debug, Serialize)]
pub struct Story {
    /// Robots in this process.
    pub robots_in_process: usize,
    /// Robots that were launcher and agent processes.
    pub robots_launched: usize,
    /// How many times as fast as real bodies worked.
    pub body_speed: f64,
    /// Tasks that succeeded before the first roll-out, as so many an hour (rows).
    pub tasks_per_hour_before: f64,
    /// Its roll-outs.
    pub acts: Vec<Played>,
}

impl Story {
    /// Why it cannot be called good; empty if it can.
    pub fn objections(&self) -> Vec<String> {
        self.acts.iter().flat_map(|act| act.objections(self.robots_in_process + self.robots_launched)).collect()
    }
}

impl Played {
    /// What was seen while it was played; the rest is not known yet.
    pub fn from_seen(seen: Seen, off_work_most: usize, wall_s: f64) -> Self {
        let Seen { areas, may_at_once, broken } = seen;
        Self { off_work_most, off_work_allowed: may_at_once, areas, budget_broken: broken, wall_s, ..Self::default() }
    }

    fn objections(&self, robots: usize) -> Vec<String> {
        let mut why = Vec::new();
        let mut not = |holds: bool, text: String| {
            if !holds {
                why.push(format!("{}: {text}", self.bundle));
            }
        };
        for broken in &self.budget_broken {
            not(false, broken.clone());
        }
        not(!self.areas.is_empty(), "nobody was seen to be taken out of work for it".to_owned());
        let (begun, may) = (self.begun_at_once_most, self.off_work_allowed);
        not(begun <= may, format!("new software began on {begun} robots within one probation, {may} may"));
        not(self.elsewhere.is_empty(), format!("{} run something else", self.elsewhere.join(", ")));
        if self.is_good {
            not(self.phase == "COMPLETED", format!("it is {} and should be COMPLETED", self.phase));
            not(self.kept_by == robots, format!("{} of {robots} robots keep it", self.kept_by));
            let ran = self.robots_that_ran_it;
            not(ran == robots, format!("it ever ran on {ran} of {robots} robots"));
            let grant = self.off_work.parked_to_grant_ms.unwrap_or(u64::MAX);
            not(grant <= 5_000, format!("parked to permitted took {grant} ms in the median, 5000 may"));
        } else {
            not(self.phase == "ABORTED", format!("it is {} and should be ABORTED", self.phase));
            not(self.abort.is_some(), "it has no evidence".to_owned());
            let touched = self.robots_that_ran_it.max(self.touched as usize);
            not(
                touched <= self.canary as usize,
                format!("{touched} robots were touched, the canary has {}", self.canary),
            );
            not(self.robots_that_ran_it > 0, "no body ever ran it".to_owned());
            not(
                self.activated_after_abort == 0,
                format!("{} activated it after the abort", self.activated_after_abort),
            );
            not(self.kept_by == 0, format!("{} robots keep it", self.kept_by));
        }
        why
    }

    /// It in lines.
    pub fn lines(&self) -> Vec<String> {
        let ms = |ms: Option<u64>| ms.map_or("-".to_owned(), |ms| format!("{:.1}", ms as f64 / 1000.0));
        let o = &self.off_work;
        let mut lines = vec![format!(
            "{}: {} in {:.0} s, {:.0} tasks an hour, ran on {} (permitted {}, at the abort {}, begun after it {}), kept by {}, changed at once {} of {}",
            self.bundle,
            self.phase,
            self.wall_s,
            self.tasks_per_hour,
            self.robots_that_ran_it,
            self.touched,
            self.touched_at_abort.map_or("-".to_owned(), |n| n.to_string()),
            self.activated_after_abort,
            self.kept_by,
            self.off_work_most.max(self.begun_at_once_most),
            self.off_work_allowed,
        )];
        let areas = self.areas.iter().map(|a| format!("{} {} of {}", a.area_id, a.out, a.may)).collect::<Vec<_>>();
        lines.push(format!("  out of work at once, of as many as may be: {}", areas.join(", ")));
        lines.push(format!(
            "  off work, medians in s: drain wait {} (site), park drive {} (site), parked to permitted {} (link), switch {} (link), probation {} (site)",
            ms(o.drain_wait_ms),
            ms(o.park_drive_ms),
            ms(o.parked_to_grant_ms),
            ms(o.switch_ms),
            ms(o.probation_ms)
        ));
        lines.extend(self.verdicts.iter().map(|v| format!("  {v}")));
        lines.extend(self.abort.iter().map(|a| format!("  aborted: {a}")));
        lines
    }
}

/// A name of the wire without its prefix.
pub fn short(name: &str, prefix: &str) -> String {
    name.trim_start_matches(prefix).to_owned()
}

/// Robots in all states.
pub fn all(c: &v1::RolloutCounts) -> u32 {
    c.waiting
        + c.staging
        + c.staged
        + c.draining
        + c.activating
        + c.trial
        + c.committing
        + c.reverting
        + c.committed
        + c.rolled_back
        + c.skipped
        + c.stuck
}

/// A verdict with its numbers. Waves are counted from 1 for people.
pub fn verdict(v: &v1::RolloutVerdict) -> String {
    let outcome = short(v.outcome().as_str_name(), "GATE_OUTCOME_");
    let n = v.clean + v.failed;
    let mut text = format!(
        "wave {}: {outcome}, n {n}, failed {}, failure rate below {:.1} % with 95 % confidence",
        v.wave + 1,
        v.failed,
        f64::from(v.upper_bound_permille) / 10.0
    );
    if let Some(false_abort) = v.false_abort_permille {
        text.push_str(&format!(", a good release fails so in {:.1} % of roll-outs", f64::from(false_abort) / 10.0));
    }
    text
}

/// Why a roll-out was aborted, and by whom.
pub fn evidence(a: &v1::RolloutAbort) -> String {
    let reason = a.reason.clone().unwrap_or_default();
    format!("{}: {} ({})", reason.code, reason.message, a.robot_ids.join(", "))
}

/// Medians over these robots.
pub fn medians(robots: &[v1::RolloutRobot]) -> OffWork {
    let median = |part: fn(&v1::OffWork) -> Option<&prost_types::Duration>| {
        let parts = robots.iter().filter_map(|r| r.off_work.as_ref()).filter_map(part);
        let mut all: Vec<u64> = parts.map(|d| ms_of(d).unsigned_abs()).collect();
        all.sort_unstable();
        all.get(all.len() / 2).copied()
    };
    OffWork {
        drain_wait_ms: median(|o| o.drain_wait.as_ref()),
        park_drive_ms: median(|o| o.park_drive.as_ref()),
        parked_to_grant_ms: median(|o| o.parked_to_grant.as_ref()),
        switch_ms: median(|o| o.switch.as_ref()),
        probation_ms: median(|o| o.probation.as_ref()),
    }
}

#[cfg(test)]
mod tests;
