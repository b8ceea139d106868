//! What a run came to, counted from rows and from the bodies' own journals, never from what was planned.

use crate::scenario::Story;
use crate::task_summary::Tasks;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::TaskId;
use midshift_core::task::Phase;
use midshift_core::time::Clock;
use midshift_sim::fleet::FleetReport;
use midshift_store::LiveBoard;
use serde::Serialize;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

/// A robot with work that does not get on for longer than this makes no progress. Site clock.
const NO_PROGRESS_MS: u64 = 60_000;
/// A run shorter than this is not asked for amounts: its first tasks are still on their way. Milliseconds of site time.
const AMOUNTS_FROM_MS: u64 = 300_000;
/// What each robot of the built-in factory brings to its end in ten minutes of site time, at least.
const SUCCEEDED_PER_ROBOT: u64 = 8;
/// The built-in factory feeds so many robots; more of them wait for each other, and their number says nothing of the work done.
const BUILT_IN_ROBOTS: u64 = 20;
/// The states that lead on.
const OPEN: [Phase; 7] =
    [Phase::Queued, Phase::Assigned, Phase::Running, Phase::Held, Phase::Suspended, Phase::Stopping, Phase::RetryWait];
/// How often robots are looked at, real time.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Milliseconds of site time in which robots had work and made no progress, summed over robots.
pub async fn watch_progress(
    board: Arc<LiveBoard<NewestHeartbeat>>,
    clock: Arc<dyn Clock>,
    sum_ms: Arc<std::sync::atomic::AtomicU64>,
) {
    let mut last = clock.now().site;
    loop {
        tokio::time::sleep(LOOK_EVERY).await;
        let now = clock.now().site;
        let passed = now.since(last).as_ms();
        last = now;
        let stuck = board.all().iter().filter(|(_, live)| is_stuck(live, now)).count() as u64;
        sum_ms.fetch_add(stuck * passed, std::sync::atomic::Ordering::Relaxed);
    }
}

fn is_stuck(live: &NewestHeartbeat, now: midshift_core::time::SiteTime) -> bool {
    let working = live.report.attempts.iter().any(|a| !a.state.is_over());
    working && now.since(live.progress_at).as_ms() > NO_PROGRESS_MS
}

/// What was run, as far as it decides which amounts a good run shows.
#[derive(Clone, Copy, Debug, Default)]
pub struct Kind {
    /// Drawn work in the built-in factory: no site, map or task list of the user's own.
    pub built_in: bool,
    /// The backlog is twice the robots and not what the user asked for.
    pub own_backlog: bool,
}

/// The amounts a run is held to; none: it is not asked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Amounts {
    /// 8 a robot in ten minutes of site time, of runs of 5 minutes and more with up to 20 robots in the built-in factory and its own
    /// backlog.
    pub succeeded_min: Option<u64>,
    /// 2 % of what was submitted, or one task, of runs of 5 minutes and more.
    pub to_operator_max: Option<u64>,
    /// Twice the robots, of runs that keep their own backlog.
    pub open_max: Option<u64>,
}

impl Amounts {
    fn for_run(kind: Kind, robots: u64, submitted: u64, site_ms: u64) -> Self {
        let long = site_ms >= AMOUNTS_FROM_MS;
        let feeds = kind.built_in && kind.own_backlog && robots <= BUILT_IN_ROBOTS;
        Self {
            succeeded_min: (long && feeds).then_some(SUCCEEDED_PER_ROBOT * robots * site_ms / 600_000),
            to_operator_max: long.then_some((submitted / 50).max(1)),
            open_max: kind.own_backlog.then_some(2 * robots),
        }
    }
}

/// The report of a run.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// How many robots took part.
    pub robots: usize,
    /// Seed of the run.
    pub seed: u64,
    /// Tasks that the client was acknowledged for.
    pub submitted: u64,
    /// Of these, without a row.
    pub lost: u64,
    /// Tasks of the client's requests that it was not acknowledged for.
    pub unacknowledged: u64,
    /// Tasks that somebody else submitted, of those that are alive or came during the run. They are in no other number here.
    pub of_others: u64,
    /// The client's tasks by state, each state counted by itself from the rows.
    pub succeeded: usize,
    /// See above.
    pub failed: usize,
    /// See above.
    pub canceled: usize,
    /// See above.
    pub expired: usize,
    /// Tasks that ended in NEEDS_OPERATOR.
    pub to_operator: usize,
    /// In one of the states that lead on.
    pub open: usize,
    /// The six add up to `submitted`.
    pub states_add_up: bool,
    /// From the bodies' own journals.
    pub exclusion_violations: u64,
    /// `modelled` or `not modelled`.
    pub collisions: &'static str,
    /// Every item that came into the world is somewhere in it, once.
    pub items_conserved: bool,
    /// Steps of one task that two bodies, or one body twice, really did.
    pub steps_done_twice: u64,
    /// Succeeded an hour of site time.
    pub tasks_per_site_hour: f64,
    /// Seconds of site time from admission to success.
    pub completion_s: Spread,
    /// Share of the way driven without a load.
    pub empty_run_rate: f64,
    /// Metres driven by all.
    pub path_m: f64,
    /// How often a robot began to wait for a place.
    pub place_waits: u64,
    /// Minutes of site time, summed over robots, with work and without progress for over a minute.
    pub no_progress_robot_minutes: f64,
    /// Seconds of site time.
    pub site_s: f64,
    /// Seconds of real time.
    pub wall_s: f64,
    /// Site time over real time, as reached.
    pub achieved_speedup: f64,
    /// What the run is held to, beside the laws.
    pub asked: Amounts,
    /// What the bodies say.
    pub bodies: FleetReport,
    /// What a story came to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub story: Option<Story>,
}

/// Mean and percentiles.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Spread {
    /// Arithmetic mean.
    pub mean: f64,
    /// Median, the 50th percentile.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
}

fn spread(sorted: &[f64]) -> Spread {
    if sorted.is_empty() {
        return Spread::default();
    }
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share).round() as usize];
    Spread { mean: sorted.iter().sum::<f64>() / sorted.len() as f64, p50: at(0.5), p95: at(0.95) }
}

/// What a run is reported from.
pub struct Inputs {
    /// What was run.
    pub kind: Kind,
    /// Seed of the run.
    pub seed: u64,
    /// What the client was acknowledged for.
    pub acknowledged: Vec<TaskId>,
    /// Tasks as their rows say.
    pub tasks: Tasks,
    /// What the bodies of the robots say.
    pub bodies: FleetReport,
    /// Waits for places.
    pub place_waits: u64,
    /// See [`watch_progress`].
    pub no_progress_ms: u64,
    /// Milliseconds of site and real time.
    pub site_ms: u64,
    /// See above.
    pub wall_ms: u64,
    /// What was played, if anything.
    pub story: Option<Story>,
}

impl Report {
    /// Adds everything up.
    pub fn from_run(i: Inputs) -> Self {
        let is = |wanted: &[Phase]| i.tasks.count(|p| wanted.contains(&p));
        let six = [
            is(&[Phase::Succeeded]),
            is(&[Phase::Failed]),
            is(&[Phase::Canceled]),
            is(&[Phase::Expired]),
            is(&[Phase::NeedsOperator]),
            is(&OPEN),
        ];
        let submitted = i.acknowledged.len() as u64;
        let known: BTreeSet<&TaskId> = i.acknowledged.iter().collect();
        let site_s = i.site_ms as f64 / 1000.0;
        let wall_s = i.wall_ms as f64 / 1000.0;
        let path = i.bodies.path_mm as f64;
        Self {
            robots: i.bodies.robots,
            seed: i.seed,
            submitted,
            lost: known.iter().filter(|id| !i.tasks.has(id)).count() as u64,
            unacknowledged: i.tasks.own().filter(|id| !known.contains(id)).count() as u64,
            of_others: i.tasks.of_others() as u64,
            succeeded: six[0],
            failed: six[1],
            canceled: six[2],
            expired: six[3],
            to_operator: six[4],
            open: six[5],
            states_add_up: six.iter().sum::<usize>() as u64 == submitted,
            exclusion_violations: i.bodies.verdict.exclusion_violations,
            collisions: if i.bodies.collisions_modelled { "modelled" } else { "not modelled" },
            items_conserved: i.bodies.verdict.items_conserved(),
            steps_done_twice: i.bodies.verdict.steps_done_twice,
            tasks_per_site_hour: six[0] as f64 * 3600.0 / site_s.max(1e-9),
            completion_s: spread(&i.tasks.completions_s()),
            empty_run_rate: if path > 0.0 { (path - i.bodies.loaded_path_mm as f64) / path } else { 0.0 },
            path_m: path / 1000.0,
            place_waits: i.place_waits,
            no_progress_robot_minutes: i.no_progress_ms as f64 / 60_000.0,
            site_s,
            wall_s,
            achieved_speedup: site_s / wall_s.max(1e-9),
            asked: Amounts::for_run(i.kind, i.bodies.robots as u64, submitted, i.site_ms),
            bodies: i.bodies,
            story: i.story,
        }
    }
    /// The run in one line.
    pub fn summary(&self) -> String {
        format!(
            "{:.0} s of site time in {:.0} s: {} submitted, {} succeeded, {} failed, {} canceled, {} expired, {} to operator, {} open; \
             {:.0} tasks/h, completion p50 {:.0} s p95 {:.0} s, empty {:.0} %, {} exclusion violations (collisions: {})",
            self.site_s,
            self.wall_s,
            self.submitted,
            self.succeeded,
            self.failed,
            self.canceled,
            self.expired,
            self.to_operator,
            self.open,
            self.tasks_per_site_hour,
            self.completion_s.p50,
            self.completion_s.p95,
            self.empty_run_rate * 100.0,
            self.exclusion_violations,
            self.collisions
        )
    }

    /// Why the run cannot be called good; empty if it can.
    pub fn objections(&self) -> Vec<String> {
        let mut why = Vec::new();
        if self.exclusion_violations > 0 {
            why.push(format!("{} exclusion violations in the bodies' journals", self.exclusion_violations));
        }
        if !self.states_add_up {
            why.push(format!("the six states do not add up to {} submitted", self.submitted));
        }
        if self.lost > 0 {
            why.push(format!("{} acknowledged tasks have no row", self.lost));
        }
        if self.unacknowledged > 0 {
            why.push(format!("{} tasks were admitted without an acknowledgement, or twice", self.unacknowledged));
        }
        if !self.items_conserved {
            why.push("items were lost or doubled".to_owned());
        }
        if self.steps_done_twice > 0 {
            why.push(format!("{} steps were done twice", self.steps_done_twice));
        }
        if let Some(min) = self.asked.succeeded_min.filter(|min| (self.succeeded as u64) < *min) {
            why.push(format!("{} tasks succeeded, {min} were to", self.succeeded));
        }
        if let Some(max) = self.asked.to_operator_max.filter(|max| self.to_operator as u64 > *max) {
            why.push(format!("{} tasks wait for an operator, {max} may", self.to_operator));
        }
        why.extend(self.story.iter().flat_map(Story::objections));
        if let Some(max) = self.asked.open_max.filter(|max| self.open as u64 > *max) {
            why.push(format!("{} tasks are open, {max} may be", self.open));
        }
        why
    }
}

#[cfg(test)]
mod tests;
