//! A client that watches a roll-out at one process and goes on at the other.

use super::*;
use midshift_core::item::{Expect, Item};
use midshift_core::rows::Writer;
use tokio_stream::StreamExt;

/// The roll-out changes; its version then.
async fn change(world: &World, id: &str) -> u64 {
    let (row, revision) = world.row::<Rollout>(id).await.expect("a row");
    let row = Rollout { version: row.version + 1, ..row };
    let mut item = Item::new(Writer::Ota, "tests");
    item.put_row(&row, Expect::At(revision), "rollout.changed");
    assert!(world.store.commit(vec![item]).await.iter().all(Result::is_ok));
    row.version
}

/// The version that a watch tells next.
async fn told(watch: &mut (impl StreamExt<Item = Result<v1::WatchRolloutResponse, tonic::Status>> + Unpin)) -> u64 {
    let message = watch.next().await.expect("a message").expect("of the roll-out");
    message.rollout.expect("a roll-out").etag.parse().expect("a version")
}

/// The version that a watch tells first which begins now.
async fn told_first(process: &Process, id: &str) -> u64 {
    let request = v1::WatchRolloutRequest { rollout_id: id.to_owned(), ..Default::default() };
    let watch = Face::watch_rollout(&process.face, local(request)).await.expect("a watch");
    told(&mut watch.into_inner()).await
}

#[tokio::test(start_paused = true)]
async fn a_watcher_that_goes_on_at_the_other_process_is_told_nothing_older() {
    let world = World::new();
    let (leader, standby, bundle) = with_a_release(&world).await;
    leader.create("r-1", &bundle).await.expect("created");
    for n in 0..10 {
        let (from, to) = if n % 2 == 0 { (&leader, &standby) } else { (&standby, &leader) };
        let written = change(&world, "r-1").await;
        // So soon that neither has looked at the store by itself.
        let (here, there) = (told_first(from, "r-1").await, told_first(to, "r-1").await);
        assert_eq!((here, there), (written, written), "move {n}");
    }
    leader.end().await;
    standby.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_watch_that_goes_on_tells_what_changed_in_its_order_at_both_processes() {
    let world = World::new();
    let (leader, standby, bundle) = with_a_release(&world).await;
    leader.create("r-1", &bundle).await.expect("created");
    for process in [&leader, &standby] {
        let request = v1::WatchRolloutRequest { rollout_id: "r-1".to_owned(), ..Default::default() };
        let watch = Face::watch_rollout(&process.face, local(request)).await.expect("a watch");
        let mut watch = watch.into_inner();
        let mut newest = told(&mut watch).await;
        for _ in 0..5 {
            let written = change(&world, "r-1").await;
            while newest < written {
                let next = told(&mut watch).await;
                assert!(next >= newest, "{newest}, then {next}");
                newest = next;
            }
        }
    }
    leader.end().await;
    standby.end().await;
}
