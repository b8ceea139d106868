//! The newest heartbeat of each robot, in memory only: what people watch and what fleet decides liveness from.
//!
//! Invariant: nothing here is durable, and nothing here waits: a slow watcher misses values in between, never the newest one,
//! and costs the writer nothing. Telemetry puts; fleet and the watching streams read.
//!
//! Every put gets the next number and a robot stands under its newest number only. "What changed since I looked" is then a range
//! of numbers, so that a watcher is one number and its backlog never exceeds the number of robots.

use midshift_core::ids::RobotId;
use std::collections::BTreeMap;
use std::ops::Bound;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use tokio::sync::watch;

/// Newest `T` per robot.
#[derive(Debug)]
pub struct LiveBoard<T> {
    robots: RwLock<Robots<T>>,
    changed: watch::Sender<u64>,
    /// Up to where the log of newest heartbeats was read into it; 0: not at all.
    read_up_to: AtomicU64,
}

#[derive(Debug)]
struct Robots<T> {
    newest: BTreeMap<RobotId, (u64, Option<Arc<T>>)>,
    by_number: BTreeMap<u64, RobotId>,
    number: u64,
}

impl<T> Default for LiveBoard<T> {
    fn default() -> Self {
        let robots = Robots { newest: BTreeMap::new(), by_number: BTreeMap::new(), number: 0 };
        Self { robots: RwLock::new(robots), changed: watch::Sender::new(0), read_up_to: AtomicU64::new(0) }
    }
}

impl<T: Send + Sync + 'static> LiveBoard<T> {
    /// An empty board.
    pub fn new() -> Arc<Self> {
        Arc::new(Self::default())
    }

    /// Replaces what is known of a robot.
    pub fn publish(&self, robot_id: &RobotId, live: Arc<T>) {
        self.set(robot_id, Some(live));
    }

    /// Forgets a robot. Watchers see it go.
    pub fn remove(&self, robot_id: &RobotId) {
        if self.get(robot_id).is_some() {
            self.set(robot_id, None);
        }
    }

    fn set(&self, robot_id: &RobotId, live: Option<Arc<T>>) {
        let number = {
            let mut robots = self.robots.write().unwrap_or_else(PoisonError::into_inner);
            robots.number += 1;
            let number = robots.number;
            if let Some((old, _)) = robots.newest.insert(robot_id.clone(), (number, live)) {
                robots.by_number.remove(&old);
            }
            robots.by_number.insert(number, robot_id.clone());
            number
        };
        // Two puts may arrive here in the other order; the number that is shown never falls.
        self.changed.send_if_modified(|shown| {
            let rises = number > *shown;
            *shown = number.max(*shown);
            rises
        });
    }

    /// What is known of one robot.
    pub fn get(&self, robot_id: &RobotId) -> Option<Arc<T>> {
        self.robots().newest.get(robot_id)?.1.clone()
    }

    /// All robots, sorted by id. The values are shared, not copied.
    pub fn all(&self) -> Vec<(RobotId, Arc<T>)> {
        self.robots().newest.iter().filter_map(|(id, (_, live))| Some((id.clone(), live.clone()?))).collect()
    }

    /// Up to which position of the [`crate::HeartbeatLog`] everything is on the board; 0: it is not read from there.
    pub fn read_up_to(&self) -> u64 {
        self.read_up_to.load(Ordering::Acquire)
    }

    pub(crate) fn set_read_up_to(&self, position: u64) {
        self.read_up_to.store(position, Ordering::Release);
    }

    /// A number that rises with every change.
    pub fn changed(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// A watcher for whom every robot is new.
    pub fn watch(self: &Arc<Self>) -> Dirty<T> {
        Dirty { board: self.clone(), seen: 0, changed: self.changed.subscribe() }
    }

    fn robots(&self) -> RwLockReadGuard<'_, Robots<T>> {
        self.robots.read().unwrap_or_else(PoisonError::into_inner)
    }
}

/// One watcher's view of what changed since it last looked.
#[derive(Debug)]
pub struct Dirty<T> {
    board: Arc<LiveBoard<T>>,
    seen: u64,
    changed: watch::Receiver<u64>,
}

impl<T: Send + Sync + 'static> Dirty<T> {
    /// The robots that changed since the last call, longest unchanged first, each once with its newest value; `None` = forgotten.
    pub fn take_changed(&mut self) -> Vec<(RobotId, Option<Arc<T>>)> {
        let robots = self.board.robots();
        let range = (Bound::Excluded(self.seen), Bound::Unbounded);
        let changed = robots.by_number.range(range).map(|(_, id)| {
            let live = robots.newest.get(id).and_then(|(_, live)| live.clone());
            (id.clone(), live)
        });
        let taken = changed.collect();
        self.seen = robots.number;
        taken
    }

    /// Waits until there is something to take. Safe to cancel.
    pub async fn changed(&mut self) {
        let seen = self.seen;
        // The board is held by this watcher, so its sender lives.
        let _ = self.changed.wait_for(|number| *number > seen).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(id: &str) -> RobotId {
        RobotId::parse(id).expect("a robot id")
    }

    #[test]
    fn a_slow_watcher_gets_each_robot_once_with_its_newest_value() {
        let board = LiveBoard::new();
        let mut slow = board.watch();
        let mut quick = board.watch();
        board.publish(&robot("a"), Arc::new(1));
        assert_eq!(quick.take_changed(), [(robot("a"), Some(Arc::new(1)))]);
        board.publish(&robot("b"), Arc::new(2));
        board.publish(&robot("a"), Arc::new(3));
        assert_eq!(quick.take_changed(), [(robot("b"), Some(Arc::new(2))), (robot("a"), Some(Arc::new(3)))]);
        assert_eq!(slow.take_changed(), [(robot("b"), Some(Arc::new(2))), (robot("a"), Some(Arc::new(3)))]);
        assert!(slow.take_changed().is_empty());
    }

    #[test]
    fn a_late_watcher_starts_with_the_whole_board_and_sees_a_robot_go() {
        let board = LiveBoard::new();
        board.publish(&robot("a"), Arc::new(1));
        let mut late = board.watch();
        assert_eq!(late.take_changed().len(), 1);
        board.remove(&robot("a"));
        assert_eq!(late.take_changed(), [(robot("a"), None)]);
        assert!(board.all().is_empty());
    }

    #[tokio::test]
    async fn a_watcher_that_has_seen_all_waits_for_the_next_change() {
        let board = LiveBoard::new();
        board.publish(&robot("a"), Arc::new(1));
        let mut watcher = board.watch();
        watcher.changed().await;
        watcher.take_changed();
        let (_, ()) = tokio::join!(watcher.changed(), async { board.publish(&robot("b"), Arc::new(2)) });
        assert_eq!(watcher.take_changed(), [(robot("b"), Some(Arc::new(2)))]);
    }
}
