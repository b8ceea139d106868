//! Two planners over one store. The lease keeps them from it, and is no more than a saving: here it is left out, and nothing is done twice.

use crate::harness::World;
use midshift_core::fleet::bugs::{Bugs, SeededBug};
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::Phase;

#[tokio::test(start_paused = true)]
async fn two_reconcilers_at_saturation_give_no_robot_two_holders_and_every_task_is_done() {
    let mut w = World::with(DEMO, Bugs::seeded(&[SeededBug::EverybodyLeads])).await;
    w.second_reconciler();
    w.pass(11).await;
    let stands = ["park-1", "park-1", "park-2", "park-2", "park-3", "park-3", "park-4", "park-4"];
    for (n, at) in stands.iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    let goals = ["D01", "A01", "L1-in", "B03", "P02", "D03", "L2-out", "A02"];
    for n in 0..32 {
        w.submit(&format!("T{n}"), goals[n % 8], goals[(n * 3 + 1) % 8]).await;
    }
    for n in 0..32 {
        w.until_phase(&format!("T{n}"), Phase::Succeeded).await;
    }
    assert!(w.shaky.conflicts() > 10, "they raced: {}", w.shaky.conflicts());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_second_reconciler_that_comes_and_the_first_that_goes_change_nothing_for_a_task() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.second_reconciler();
    w.pass(15).await;
    w.stop_fleet().await;
    w.start_fleet();
    w.r("r1").works = true;
    let seen = w.until_phase("T1", Phase::Succeeded).await;
    assert_eq!(seen.task("T1").epoch, 1);
    w.lawful().await;
}
