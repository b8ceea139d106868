//! What goes after its time and what stays, in files of SQLite.

use super::prune;
use crate::old_site::{DAY_MS, OldSite, commit, robot_id};
use midshift_core::ids::{AreaId, BundleId, RolloutId, SiteId};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::rollout::rows::{Act, AreaBundle, Bundle, Phase, Quarantine, Rollout, RolloutRobot, Step};
use midshift_core::rows::{Record, Revision, Table, Writer};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_store::{SqliteStore, Store, load};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use tempfile::TempDir;

const NOW: Utc = Utc(1_800_000_000_000);
/// Roll-outs more than are kept.
const BEYOND: u64 = 5;
const ROBOTS: u64 = 2;

struct World {
    store: SqliteStore,
    clock: Arc<dyn Clock>,
    _dir: TempDir,
}

impl World {
    /// Two robots and this many roll-outs, one every two days until two months ago.
    async fn with_rollouts(many: u64) -> Self {
        let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(|| 0, NOW, 1000));
        let dir = TempDir::new().expect("a folder");
        let site = SiteId::parse("factory").expect("an id");
        let store = SqliteStore::open(dir.path(), site, clock.clone()).await.expect("a new store");
        let from = Utc(NOW.0 - (2 * many as i64 + 60) * DAY_MS);
        let old = OldSite { ended: 0, robots: ROBOTS, retired: 0, from, until: NOW };
        let robots = (1..=ROBOTS).flat_map(|robot| old.robot(robot));
        commit(&store, robots.chain((1..=many).map(|number| old.rollout(number))).collect()).await;
        Self { store, clock, _dir: dir }
    }
    async fn prune(&self) -> u64 {
        prune(&self.store, &*self.clock).await.expect("prunes")
    }
    async fn row<R: Record>(&self, id: &str) -> (R, Revision) {
        load(&self.store, id).await.expect("a store").expect("a row")
    }
    async fn change<R: Record>(&self, id: &str, change: impl FnOnce(R) -> R) {
        let (row, at) = self.row::<R>(id).await;
        let mut item = Item::new(Writer::Ota, "tests");
        item.update(&change(row), at, "tests.changed");
        commit(&self.store, vec![item]).await;
    }
    async fn create<R: Record>(&self, row: &R) {
        let mut item = Item::new(Writer::Ota, "tests");
        item.create(row, "tests.created");
        commit(&self.store, vec![item]).await;
    }
    /// Numbers of roll-outs that are gone, of the first `of`.
    async fn gone(&self, of: u64) -> Vec<u64> {
        let rows = self.store.snapshot(&[Table::Rollout]).await.expect("a store").rows;
        let there: BTreeSet<String> = rows.iter().map(|row| row.key.id.to_string()).collect();
        (1..=of).filter(|number| !there.contains(rollout_id(*number).as_str())).collect()
    }
    async fn count(&self, table: Table) -> usize {
        self.store.snapshot(&[table]).await.expect("a store").rows.len()
    }
}

fn rollout_id(number: u64) -> RolloutId {
    RolloutId::parse(&format!("old-rollout-{number}")).expect("an id")
}

fn bundle_id(number: u64) -> BundleId {
    BundleId::parse(&format!("{number:064x}")).expect("an id")
}

fn quarantine(number: u64) -> Quarantine {
    let (robot_id, bundle, rollout_id) = (robot_id(1), bundle_id(number), rollout_id(number));
    Quarantine { robot_id, bundle, rollout_id, reason: Code::RobotWentBack.into(), since: NOW }
}

#[tokio::test]
async fn roll_outs_beyond_their_number_go_with_their_robots_and_none_that_something_names() {
    let many = limits::ROLLOUTS_MAX as u64 + BEYOND;
    let world = World::with_rollouts(many).await;
    let stuck = RolloutRobot::id_of(&rollout_id(1), &robot_id(2));
    world.change::<RolloutRobot>(&stuck, |robot| RolloutRobot { step: Step::Stuck, ..robot }).await;
    let rollouts = BTreeMap::from([("m1".to_owned(), rollout_id(2))]);
    world.create(&AreaBundle { area_id: AreaId::parse("hall").expect("an id"), rollouts }).await;
    let open = world.row::<Rollout>(rollout_id(3).as_str()).await.0;
    let back = RolloutId::parse("back").expect("an id");
    let open = Rollout { rollout_id: back, phase: Phase::Draft, revert_of: Some(rollout_id(3)), ..open };
    world.create(&open).await;
    // Two roll-outs, each with its robots and its bundle.
    assert_eq!(world.prune().await, 2 * (1 + ROBOTS + 1));
    assert_eq!(world.gone(many).await, [4, 5]);
    assert_eq!(world.count(Table::RolloutRobot).await as u64, (many - 2) * ROBOTS);
    assert_eq!(world.prune().await, 0);
}

#[tokio::test]
async fn a_bundle_goes_a_month_after_anything_names_it_with_what_robots_went_back_from() {
    let world = World::with_rollouts(3).await;
    for number in [1, 101, 102, 103, 104] {
        world.create(&quarantine(number)).await;
    }
    let bundle = world.row::<Bundle>(bundle_id(1).as_str()).await.0;
    let act = Act { actor: "anna".to_owned(), person: None, reason: "it limps".to_owned(), at: bundle.published };
    let of = |number| Bundle { bundle: bundle_id(number), ..bundle.clone() };
    world.create(&of(101)).await;
    world.create(&Bundle { listed: true, ..of(102) }).await;
    world.create(&Bundle { revoked: Some(act), ..of(103) }).await;
    world.create(&Bundle { ended: Some(Utc(NOW.0 - 29 * DAY_MS)), ..of(104) }).await;
    assert_eq!(world.prune().await, 2, "the one that nothing names, and what a robot went back from");
    assert_eq!(world.count(Table::Bundle).await, 6, "a roll-out names three; listed, taken back, ended lately");
    assert_eq!(world.count(Table::Quarantine).await, 4);
    assert_eq!(world.prune().await, 0);
}
