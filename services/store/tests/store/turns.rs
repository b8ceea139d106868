//! Callers take turns at the one writer.

use crate::support::{item, one, put, sqlite};
use midshift_core::item::Expect;
use midshift_core::limits::COMMIT_SLICE_ITEMS;
use midshift_core::rows::{Table, Writer};

#[tokio::test]
async fn a_long_commit_lets_others_in_between_its_slices() {
    let bench = sqlite().await;
    let row = |id: String| put(Table::Attempt, &id, Expect::Absent, "1");
    let items = (0..COMMIT_SLICE_ITEMS * 4).map(|i| item(Writer::Fleet, vec![row(format!("a{i}"))]));
    let long = bench.store.commit(items.collect());
    let short = one(&*bench.store, Writer::Fleet, vec![row("b".into())]);
    let (long, short) = tokio::join!(long, short);
    let long: Vec<_> = long.into_iter().map(|r| r.expect("applied").seq).collect();
    assert!(long.is_sorted(), "the items of one call keep their order");
    let before = long.iter().filter(|seq| **seq < short.as_ref().expect("applied").seq).count();
    assert!(before <= COMMIT_SLICE_ITEMS * 2, "{before} items went first");
}
