//! What is over costs nothing: a start and a takeover read what is alive, and ask by id for the few that somebody waits for.

use crate::harness::{Shaky, World};
use crate::old_site::OldSite;
use midshift_core::fleet::bugs::Bugs;
use midshift_core::fleet::projection::FleetProjection;
use midshift_core::ids::TaskId;
use midshift_core::leadership::FleetLeader;
use midshift_core::reason::Code;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_core::time::Clock;
use midshift_fleet::FleetService;
use midshift_store::{MemoryStore, Store, StoreId};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Tasks that ended before anybody looks.
const ENDED: u64 = 100_000;
/// Where it does not matter how many they are.
const FEW: u64 = 300;

async fn world(ended: u64) -> World {
    World::over(CORRIDOR, Bugs::default(), async |site_id, clock: Arc<dyn Clock>| {
        let store = MemoryStore::new(site_id, StoreId(Arc::from("old")), clock.clone()).shared();
        OldSite::with_ended(ended, clock.now().utc).write(&store).await;
        let store: Arc<dyn Store> = Arc::new(store);
        store
    })
    .await
}

/// The reconciler that is there is gone, and another process leads. Rows and entries that this one read.
async fn taken_over(w: &mut World) -> u64 {
    let (_other, way): (FleetService, Arc<Shaky>) = w.other_process();
    w.pass(1).await;
    w.kill_first().await;
    w.pass(6).await;
    let row = midshift_store::load::<FleetLeader>(&*w.store, "fleet").await.expect("a store");
    assert!(row.expect("a row").1.0 > 2, "somebody took over");
    way.rows_read()
}

#[tokio::test(start_paused = true)]
async fn a_start_and_a_takeover_read_no_more_rows_when_thousands_of_tasks_have_ended() {
    let mut read = Vec::new();
    for ended in [0, ENDED] {
        let mut w = world(ended).await;
        w.pass(3).await;
        let at_start = w.shaky.rows_read();
        assert!(at_start > 0, "it reads through this handle");
        read.push((at_start, taken_over(&mut w).await));
    }
    assert_eq!(read[0], read[1], "with none and with {ENDED} ended tasks");
}

#[tokio::test(start_paused = true)]
async fn only_those_ended_tasks_are_known_that_a_task_waits_for() {
    let mut w = world(FEW).await;
    let (other, _way) = w.other_process();
    w.pass(11).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    for (id, dependency) in [("T1", "old-1"), ("T2", "old-3"), ("T3", "T1"), ("T4", "T2")] {
        w.submit_with(id, "A", "B", |raw| raw.depends_on = vec![dependency.to_owned()]).await;
    }
    w.until_phase("T1", Phase::Running).await;
    let known = |of: &FleetService| {
        let of = of.clone();
        async move {
            let phases = |view: &FleetProjection| view.ended.iter().map(|(id, end)| (id.clone(), end.phase)).collect();
            let known = of.query_projection(move |view, _, _| -> BTreeMap<TaskId, Phase> { phases(view) });
            known.await.expect("the reconciler runs")
        }
    };
    let id = |id: &str| TaskId::parse(id).expect("an id");
    let both = [(id("old-1"), Phase::Succeeded), (id("old-3"), Phase::Failed)];
    assert_eq!(known(&w.fleet).await, both.clone().into());
    assert_eq!(known(&other).await, both.clone().into(), "the one that stands by asked too");
    // As after a start: the same, read in one moment.
    w.stop_fleet().await;
    w.start_fleet();
    w.step().await;
    assert_eq!(known(&w.fleet).await, both.into());
    w.r("r1").works = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.until_phase("T3", Phase::Succeeded).await;
    w.pass(2).await;
    assert_eq!(known(&w.fleet).await, [(id("old-3"), Phase::Failed)].into(), "nobody waits for the others any more");
    let verdict = w
        .fleet
        .query_projection(move |view, board, now| {
            midshift_core::fleet::explain::task(view, board, now, &id("T2")).and_then(|e| e.verdict)
        })
        .await
        .expect("the reconciler runs");
    assert_eq!(verdict.map(|v| v.code), Some(Code::DependencyFailed));
    w.cancel("T2", false).await;
    w.until_phase("T2", Phase::Canceled).await;
    w.pass(2).await;
    assert_eq!(known(&w.fleet).await, [(id("T2"), Phase::Canceled)].into(), "T4 waits for it");
}

#[tokio::test(start_paused = true)]
async fn a_process_that_reads_for_ten_seconds_keeps_its_lease_and_plans() {
    let mut w = World::shared(CORRIDOR).await;
    let (_other, way) = w.other_process();
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    way.read_for(Duration::from_secs(10));
    w.kill_first().await;
    w.submit("T1", "A", "B").await;
    w.pass(30).await;
    assert_ne!(w.seen().await.phase("T1"), Phase::Queued, "whoever leads reads once, and plans");
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_process_that_reads_for_longer_than_half_a_minute_lets_another_one_lead() {
    let mut w = World::shared(CORRIDOR).await;
    let (_slow, way) = w.other_process();
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    // Longer than anything here is waited for.
    way.read_for(Duration::from_secs(7_200));
    w.kill_first().await;
    w.pass(10).await;
    let (_third, _) = w.other_process();
    w.submit("T1", "A", "B").await;
    w.pass(20).await;
    assert_eq!(w.seen().await.phase("T1"), Phase::Queued, "it is waited for");
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}
