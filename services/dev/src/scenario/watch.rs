//! Who is out of work for new software at once, from rows, from heartbeats and from the bodies' own journals.
//!
//! Invariant: what robots say is taken before the rows that follow from it are judged; rows that could not be read are an objection.
//! Called by the story, once, and asked for each of its roll-outs.

use super::budget::{Judge, Pace, RobotReport, Seen};
use midshift_core::fleet::rows::Drain;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::rollout::rows::{Rollout, RolloutRobot};
use midshift_core::rows::{BadRow, Seq, Table};
use midshift_core::site::Site;
use midshift_core::time::Clock;
use midshift_core::update::UpdateState;
use midshift_sim::journal::{self, Effect};
use midshift_store::{Change, Fold, LiveBoard, Projection, Store};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio_util::task::AbortOnDropHandle;

/// How often robots and roll-outs are looked at, real time.
pub const LOOK_EVERY: Duration = Duration::from_millis(200);
/// All rows of a roll-out must be read so long after its end, real time.
const READ_WITHIN: Duration = Duration::from_secs(30);

/// What is looked at.
#[derive(Clone)]
pub struct Sight {
    /// The store whose rows are read.
    pub store: Arc<dyn Store>,
    /// What robots say.
    pub board: Arc<LiveBoard<NewestHeartbeat>>,
    /// Where they are.
    pub site: Arc<Site>,
    /// The clock that says when it was looked.
    pub clock: Arc<dyn Clock>,
}

/// Looks at what robots say and at rows all the time.
pub struct Watcher {
    picture: Shared,
    store: Arc<dyn Store>,
    _looks: AbortOnDropHandle<()>,
}

/// What was looked at.
#[derive(Debug, Default)]
struct Picture {
    judge: Judge,
    /// Up to where rows were read.
    seq: Seq,
    /// Most robots that changed their software at once, as their heartbeats say.
    most: usize,
}

type Shared = Arc<Mutex<Picture>>;

fn lock(picture: &Shared) -> MutexGuard<'_, Picture> {
    picture.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Watcher {
    /// Looks until it is dropped. Of a thousand robots of each area, so many may be out of work at once.
    pub fn begin(sight: Sight, permille: BTreeMap<AreaId, usize>) -> Self {
        let picture = Arc::new(Mutex::new(Picture { judge: Judge::new(permille), ..Picture::default() }));
        let (shared, store) = (picture.clone(), sight.store.clone());
        let looks = AbortOnDropHandle::new(tokio::spawn(async move {
            let mut rows = Projection::new(Rows { sight: sight.clone(), picture: shared.clone() });
            let mut wake = sight.store.wake();
            loop {
                wake.mark_unchanged();
                let read = rows.advance(sight.store.as_ref()).await;
                {
                    let mut picture = lock(&shared);
                    if let Err(error) = read {
                        return picture.judge.cannot(format!("rows could not be read: {error}"));
                    }
                    let reports = sight.reports();
                    picture.judge.judge_reports(sight.clock.now().link, &reports);
                    picture.most = picture.most.max(reports.iter().filter(|s| s.changes || s.goes_back).count());
                    picture.seq = rows.seq();
                }
                // A store that is gone ends with the story.
                let _ = tokio::time::timeout(LOOK_EVERY, wake.changed()).await;
            }
        }));
        Self { picture, store, _looks: looks }
    }

    /// What was seen since the last time, with all that is written by now; and the most robots that changed their software at once.
    pub async fn seen(&self) -> (Seen, usize) {
        let head = *self.store.wake().borrow();
        let read = async {
            while lock(&self.picture).seq < head {
                tokio::time::sleep(LOOK_EVERY).await;
            }
        };
        let is_read = tokio::time::timeout(READ_WITHIN, read).await.is_ok();
        let mut picture = lock(&self.picture);
        if !is_read {
            let (seq, within) = (picture.seq.0, READ_WITHIN.as_secs());
            picture.judge.cannot(format!("rows were read up to {seq} of {} within {within} s", head.0));
        }
        (picture.judge.take_seen(), std::mem::take(&mut picture.most))
    }
}

impl Sight {
    fn reports(&self) -> Vec<RobotReport> {
        let report = |(robot_id, live): (RobotId, Arc<NewestHeartbeat>)| {
            let at = live.report.vitals.waypoint.as_ref().and_then(|w| self.site.find(w));
            let state = live.report.update.as_ref().map(|u| u.state);
            RobotReport {
                robot_id,
                heard: live.processed_at,
                area_id: at.map(|at| self.site.area_of(at).area_id.clone()),
                is_stuck: state == Some(UpdateState::Stuck),
                changes: matches!(state, Some(UpdateState::Switching | UpdateState::Probation)),
                goes_back: state == Some(UpdateState::RollingBack),
            }
        };
        self.board.all().into_iter().map(report).collect()
    }
}

/// Takes rows to the judge, in the order of their commits.
struct Rows {
    sight: Sight,
    picture: Shared,
}

impl Fold for Rows {
    fn tables() -> &'static [Table] {
        &[Table::Drain, Table::Rollout, Table::RolloutRobot]
    }
    fn reset(&mut self) {
        lock(&self.picture).judge.forget_rows();
    }
    fn apply(&mut self, change: Change) -> Result<(), BadRow> {
        let judge = &mut lock(&self.picture).judge;
        match change.key.table {
            Table::Drain => match change.decode::<Drain>()? {
                Some(drain) => {
                    judge.note_reports(self.sight.clock.now().link, &self.sight.reports());
                    judge.drain(drain);
                }
                None => judge.drain_is_gone(&change.key.id),
            },
            Table::Rollout => {
                if let Some(rollout) = change.decode::<Rollout>()? {
                    let pace = Pace { wave: rollout.wave, max_in_flight: rollout.spec.max_in_flight };
                    judge.rollout(rollout.rollout_id, pace);
                }
            }
            _ => {
                if let Some(robot) = change.decode::<RolloutRobot>()? {
                    if robot.counts() {
                        judge.count(&robot.rollout_id, &robot.robot_id);
                    } else {
                        judge.write_off(robot.rollout_id.clone(), robot.robot_id.clone());
                    }
                    judge.robot(robot.rollout_id, robot.robot_id, robot.wave);
                }
            }
        }
        Ok(())
    }
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
