//! A projection carried forward by the feed equals one built anew, whatever was committed.

use crate::support::{at, item, one, put};
use midshift_core::item::{Expect, Item};
use midshift_core::rows::{BadRow, Key, Revision, Table, Writer};
use midshift_store::{Change, Fold, MemoryStore, Projection, Store, StoreId};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Keeps the rows of two tables as they are.
#[derive(Debug, Default, PartialEq)]
struct Rows(BTreeMap<Key, (Revision, Arc<str>)>);

impl Fold for Rows {
    fn tables() -> &'static [Table] {
        &[Table::TaskState, Table::Attempt]
    }
    fn reset(&mut self) {
        self.0.clear();
    }
    fn apply(&mut self, change: Change) -> Result<(), BadRow> {
        match change.body {
            Some(body) => self.0.insert(change.key, (change.revision, body)),
            None => self.0.remove(&change.key),
        };
        Ok(())
    }
}

/// What a random caller does to one row; whether it is taken depends on what came before.
#[derive(Clone, Debug)]
enum Act {
    Put { table: Table, id: u8, expect: u64, body: u8 },
    Delete { table: Table, id: u8, expect: u64 },
}

fn act() -> impl Strategy<Value = Act> {
    let table = prop_oneof![Just(Table::TaskState), Just(Table::Attempt), Just(Table::RobotControl)];
    (table, 0u8..4, 0u64..4, any::<u8>(), any::<bool>()).prop_map(|(table, id, expect, body, keep)| {
        if keep || expect == 0 { Act::Put { table, id, expect, body } } else { Act::Delete { table, id, expect } }
    })
}

fn as_item(act: &Act) -> Item {
    match act {
        Act::Put { table, id, expect: 0, body } => {
            item(table.born_by(), vec![put(*table, &id.to_string(), Expect::Absent, &body.to_string())])
        }
        Act::Put { table, id, expect, body } => {
            item(table.writer(), vec![put(*table, &id.to_string(), at(*expect), &body.to_string())])
        }
        Act::Delete { table, id, expect } => {
            let mut item = Item::new(table.writer(), "test");
            item.delete(Key::new(*table, id.to_string()), Revision(*expect), "gone");
            item
        }
    }
}

async fn carried_forward_equals_built_anew(store: &dyn Store, calls: &[Vec<Act>]) {
    let mut carried = Projection::new(Rows::default());
    for call in calls {
        store.commit(call.iter().map(as_item).collect()).await;
        carried.advance(store).await.unwrap();
        let mut anew = Projection::new(Rows::default());
        anew.rebuild(store).await.unwrap();
        assert_eq!((carried.fold(), carried.seq()), (anew.fold(), anew.seq()));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn rebuilt_equals_carried_forward(calls in prop::collection::vec(prop::collection::vec(act(), 1..6), 1..12)) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            carried_forward_equals_built_anew(&*crate::support::memory().store, &calls).await;
            // A log this short makes the projection start anew every now and then.
            let short = MemoryStore::new(crate::support::site(), StoreId(Arc::from("short")), crate::support::clock()).with_log_entries_max(3);
            carried_forward_equals_built_anew(&short, &calls).await;
            let sqlite = crate::support::sqlite().await;
            carried_forward_equals_built_anew(&*sqlite.store, &calls).await;
            let postgres = crate::support::postgres().await;
            carried_forward_equals_built_anew(&*postgres.store, &calls).await;
        });
    }
}

#[tokio::test]
async fn a_projection_says_whether_its_rows_changed() {
    let store = crate::support::memory().store;
    let mut rows = Projection::new(Rows::default());
    assert!(rows.advance(&*store).await.unwrap(), "the first look is news");
    assert!(!rows.advance(&*store).await.unwrap());
    one(&*store, Writer::Fleet, vec![put(Table::RobotControl, "r", Expect::Absent, "{}")]).await.unwrap();
    assert!(!rows.advance(&*store).await.unwrap(), "not one of its tables");
    one(&*store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await.unwrap();
    assert!(rows.advance(&*store).await.unwrap());
}

#[tokio::test]
async fn a_projection_of_another_store_is_built_anew() {
    let first = crate::support::memory().store;
    one(&*first, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await.unwrap();
    let mut rows = Projection::new(Rows::default());
    rows.advance(&*first).await.unwrap();
    let restored = MemoryStore::new(crate::support::site(), StoreId(Arc::from("restored")), crate::support::clock());
    assert!(rows.advance(&restored).await.unwrap());
    assert!(rows.fold().0.is_empty());
}
