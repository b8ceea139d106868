//! Who changes its software at once, from heartbeats and from the bodies' journals.
//!
//! Invariant: nothing here reads a row. Called by the story, for each of its roll-outs.

use super::LOOK_EVERY;
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::policy::SoftwareRules;
use midshift_core::site::Site;
use midshift_core::update::UpdateState;
use midshift_core::work::Live;
use midshift_sim::journal::{self, Effect};
use midshift_store::LiveBoard;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use tokio_util::task::AbortOnDropHandle;

/// Looks at what robots say all the time.
pub struct Watcher {
    crowd: Arc<Mutex<Crowd>>,
    _looks: AbortOnDropHandle<()>,
}

/// Robots that change their software at once, as their heartbeats say.
#[derive(Clone, Copy, Debug, Default)]
pub struct Crowd {
    /// Most at once.
    pub most: usize,
    /// As many might be, by now: of each area the share of the most robots that were there together.
    pub allowed: usize,
    /// Looks at which more did than might.
    pub broken: usize,
}

impl Watcher {
    /// Looks until it is dropped.
    pub fn begin(board: Arc<LiveBoard<Live>>, site: Arc<Site>) -> Self {
        let crowd = Arc::new(Mutex::new(Crowd::default()));
        let shared = crowd.clone();
        let looks = AbortOnDropHandle::new(tokio::spawn(async move {
            let mut allowed: BTreeMap<AreaId, usize> = BTreeMap::new();
            loop {
                for (area, may) in allowances(&board, &site) {
                    let most = allowed.entry(area).or_default();
                    *most = may.max(*most);
                }
                let changing = changing(&board);
                {
                    let mut crowd = shared.lock().unwrap_or_else(PoisonError::into_inner);
                    crowd.allowed = allowed.values().sum();
                    crowd.most = crowd.most.max(changing);
                    crowd.broken += usize::from(changing > crowd.allowed);
                }
                tokio::time::sleep(LOOK_EVERY).await;
            }
        }));
        Self { crowd, _looks: looks }
    }
    /// What was seen so far.
    pub fn crowd(&self) -> Crowd {
        *self.crowd.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Robots that change their software now.
fn changing(board: &LiveBoard<Live>) -> usize {
    let changes = |live: &Live| {
        let state = live.report.update.as_ref().map(|u| u.state);
        matches!(state, Some(UpdateState::Switching | UpdateState::Probation | UpdateState::RollingBack))
    };
    board.all().iter().filter(|(_, live)| changes(live)).count()
}

/// When each robot first began to run a version, as the bodies' journals say; UTC of the site clock in milliseconds.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct FirstRuns(BTreeMap<RobotId, i64>);

impl FirstRuns {
    /// Reads them from these journals.
    pub fn read<'a>(journals: impl IntoIterator<Item = &'a Path>, version: &str) -> Result<Self, journal::Error> {
        let mut first = BTreeMap::new();
        for path in journals {
            for entry in journal::read(path)? {
                if let (Effect::Ran { version: ran }, Some(robot_id)) = (entry.effect, entry.robot_id)
                    && ran == version
                {
                    let at = first.entry(robot_id).or_insert(entry.utc_ms);
                    *at = entry.utc_ms.min(*at);
                }
            }
        }
        Ok(Self(first))
    }
    /// Robots that ever ran it.
    pub fn robots(&self) -> usize {
        self.0.len()
    }
    /// Of these, later than a moment.
    pub fn after(&self, utc_ms: i64) -> usize {
        self.0.values().filter(|at| **at > utc_ms).count()
    }
    /// Most that began within so many milliseconds.
    pub fn most_within(&self, ms: i64) -> usize {
        let mut times: Vec<i64> = self.0.values().copied().collect();
        times.sort_unstable();
        let until = |from: i64| times.partition_point(|at| *at < from + ms);
        (0..times.len()).map(|ix| until(times[ix]) - ix).max().unwrap_or(0)
    }
}

/// How many robots of each area may be taken out of work, with as many there as are now.
fn allowances(board: &LiveBoard<Live>, site: &Site) -> BTreeMap<AreaId, usize> {
    let mut areas: BTreeMap<AreaId, usize> = BTreeMap::new();
    for (_, live) in board.all() {
        if let Some(at) = live.report.vitals.waypoint.as_ref().and_then(|w| site.find(w)) {
            *areas.entry(site.area_of(at).area_id.clone()).or_default() += 1;
        }
    }
    let rules = SoftwareRules::default();
    areas.into_iter().map(|(area, robots)| (area, rules.off_work_max(robots))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_sim::journal::{Entry, Journal};

    #[test]
    fn a_version_counts_from_its_first_start_on_each_body() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("journal.jsonl");
        let mut journal = Journal::open(&path).expect("a journal");
        for (utc_ms, robot, version) in
            [(0, "r-1", "1"), (1_000, "r-1", "2"), (1_500, "r-1", "2"), (6_000, "r-2", "2"), (16_000, "r-3", "2")]
        {
            let robot_id = Some(RobotId::parse(robot).expect("a robot"));
            let effect = Effect::Ran { version: version.to_owned() };
            journal.append(Entry { utc_ms, site_ms: 0, robot_id, effect });
        }
        let runs = FirstRuns::read([path.as_path()], "2").expect("it reads");
        assert_eq!(runs.robots(), 3);
        assert_eq!([999, 1_000, 5_999, 6_000, 16_000].map(|at| runs.after(at)), [3, 2, 2, 1, 0]);
        assert_eq!([5_000, 5_001, 10_001, 15_001].map(|ms| runs.most_within(ms)), [1, 2, 2, 3]);
        assert_eq!(FirstRuns::read([path.as_path()], "3").expect("it reads"), FirstRuns::default());
    }
}
