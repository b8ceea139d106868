//! Turns: questions and the plan wait for each other only so long, counted in questions and in decisions.

use crate::harness::World;
use midshift_core::fleet::projection::FleetProjection;
use midshift_core::limits;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::task::JoinSet;

/// One turn takes so long here: its reading of the feed.
const TURN: Duration = Duration::from_millis(5);
/// People who ask again as soon as they are answered: always more than one turn takes.
const PEOPLE: usize = 200;
/// Turns from one sweep to the next, and the one that sweeps.
const TURNS: u64 = limits::SWEEP.as_ms() / 5 + 2;

#[tokio::test(start_paused = true)]
async fn a_flood_of_questions_delays_no_sweep_by_more_than_the_questions_of_one_turn() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.shaky.feed_for(TURN);
    let answered = Arc::new(AtomicU64::new(0));
    let mut people = JoinSet::new();
    for _ in 0..PEOPLE {
        let (fleet, answered) = (w.fleet.clone(), answered.clone());
        people.spawn(async move {
            loop {
                fleet.query_projection(|view, _, _| view.tasks.len()).await.expect("an answer");
                answered.fetch_add(1, Ordering::Relaxed);
            }
        });
    }
    let most = TURNS * limits::REQUESTS_PER_TURN as u64;
    for _ in 0..8 {
        // Nothing but a sweep compares a heartbeat with the rows.
        let compared =
            async |w: &World| w.fleet.query_projection(|view, _, _| view.compared.clone()).await.expect("an answer");
        let known = compared(&w).await;
        w.beat("r1");
        let before = answered.load(Ordering::Relaxed);
        while compared(&w).await == known {
            let waited = answered.load(Ordering::Relaxed) - before;
            assert!(waited <= most, "{waited} questions were answered and there was no sweep");
        }
    }
    assert!(answered.load(Ordering::Relaxed) > most, "there was a flood");
    people.shutdown().await;
    w.shaky.feed_for(Duration::ZERO);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_long_plan_lets_a_question_in_after_each_slice() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("first", "A", "B").await;
    let tasks = 8 * limits::DECISIONS_PER_STAGE;
    for n in 0..tasks {
        w.submit_with(&format!("T{n:04}"), "A", "B", |raw| raw.depends_on = vec!["first".to_owned()]).await;
    }
    w.pass(1).await;
    w.shaky.feed_for(TURN);
    // What each of them waits for can never be: each is a decision.
    w.cancel("first", false).await;
    let asked =
        |view: &FleetProjection| view.tasks.values().filter(|task| task.row.phase == Phase::NeedsOperator).count();
    let (mut last, mut answers) = (0, 0);
    while last < tasks {
        let now = w.fleet.query_projection(move |view, _, _| asked(view)).await.expect("an answer");
        assert!(now <= last + limits::DECISIONS_PER_STAGE, "{} decisions in one go", now - last);
        answers += usize::from(now > last && last > 0);
        last = now;
    }
    w.shaky.feed_for(Duration::ZERO);
    assert!(answers >= 7, "{answers} questions were answered on the way");
    w.lawful().await;
}
