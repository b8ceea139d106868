//! Fleet's projection of the rows: kept by the feed and built anew, it is the same.

use crate::harness::{Answer, World, jam, obstacle};
use midshift_core::fleet::projection::{FleetProjection, alive, named};
use midshift_core::fleet::rows::{HolderState, Place, RobotAuthority, RobotHolder};
use midshift_core::fleet::{Board, Plan, absorb};
use midshift_core::reason::Code;
use midshift_core::robot::{HardwareStop, Mode};
use midshift_core::rows::{Log, Seq, Table};
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::raw::RawRetry;
use midshift_core::task::{Phase, TaskState};
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;

/// All rows as text, a line a row.
fn slots(view: &FleetProjection) -> BTreeMap<&'static str, Vec<String>> {
    macro_rules! told {
        ($($slot:ident)*) => { BTreeMap::from([$((stringify!($slot), view.$slot.iter().map(|r| format!("{r:?}")).collect())),*]) };
    }
    told!(intakes tasks ended dependants attempts timers holds places authority control counters sites policies planner_policies
        desired_work desired_policy clocks marks incidents sessions lane_marks held_places energy place_blocks)
}

fn without_empty(mut slots: BTreeMap<&'static str, Vec<String>>) -> BTreeMap<&'static str, Vec<String>> {
    if let Some(held) = slots.get_mut("held_places") {
        held.retain(|line| !line.ends_with("{})"));
    }
    slots
}

/// The reconciler's own projection against one built from the rows, once it has absorbed what it committed last.
async fn projections_agree(w: &mut World) {
    let mut last = None;
    for _ in 0..8 {
        let kept = w.fleet.query_projection(|view, _, _| slots(view)).await.expect("the reconciler runs");
        let snapshot = w.store.read(&alive(), named).await.expect("a snapshot");
        let now = w.clock.now();
        let mut view = FleetProjection::new(w.site.clone(), now, now);
        view.load(&snapshot.rows, snapshot.seq).expect("readable rows");
        let (kept, built) = (without_empty(kept), without_empty(slots(&view)));
        if kept == built {
            return;
        }
        last = Some((kept, built));
        w.step().await;
    }
    let (kept, built) = last.expect("two projections");
    for (slot, rows) in kept {
        assert_eq!(rows, built[slot], "{slot}: kept by the feed, and built anew");
    }
}

/// Something happens to one robot.
async fn mishap(w: &mut World, rng: &mut StdRng, id: &str) {
    match rng.random_range(0..12) {
        0 => w.r(id).cut(),
        1 | 2 => {
            w.r(id).mend();
            w.connect(id).await;
        }
        3 => w.r(id).fails = Some((rng.random_range(0..3), if rng.random() { jam() } else { obstacle() })),
        4 => w.r(id).answer = Answer::Refuse(Code::AnotherHolder),
        5 => w.r(id).answer = Answer::Accept,
        6 => w.r(id).tells = !w.r(id).tells,
        7 => {
            let stop = if rng.random() { HardwareStop::Manual } else { HardwareStop::None };
            w.r(id).set_hardware_stop(stop);
        }
        8 => w.resume(id).await,
        9 => {
            let mode = if rng.random() { Mode::Manual } else { Mode::Automatic };
            w.r(id).set_mode(mode);
        }
        10 => w.r(id).confirms = rng.random(),
        _ => w.r(id).forgets_its_work(),
    }
}

async fn random_shift(site: &'static str, stands: &[&str], goals: &[&str], seed: u64) {
    let mut rng = StdRng::seed_from_u64(seed);
    let mut w = World::on(site).await;
    for (n, at) in stands.iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    let mut tasks = 0;
    for _ in 0..60 {
        if rng.random_range(0..3) == 0 {
            let (from, to) = (goals[rng.random_range(0..goals.len())], goals[rng.random_range(0..goals.len())]);
            let retry = RawRetry { max_retry_times: rng.random_range(0..3), ..RawRetry::default() };
            // One that is over, one that is not, and now and then none.
            let waits_for = (tasks > 0 && rng.random()).then(|| format!("T{}", rng.random_range(0..tasks)));
            w.submit_with(&format!("T{tasks}"), from, to, |raw| {
                raw.retry = Some(retry);
                raw.depends_on = waits_for.into_iter().collect();
            })
            .await;
            tasks += 1;
        }
        if tasks > 0 && rng.random_range(0..6) == 0 {
            w.cancel(&format!("T{}", rng.random_range(0..tasks)), rng.random_range(0..3) == 0).await;
        }
        let ids = w.robot_ids();
        let id = ids[rng.random_range(0..ids.len())].clone();
        mishap(&mut w, &mut rng, &id).await;
        w.pass(rng.random_range(1..12)).await;
        if rng.random_range(0..10) == 0 {
            w.stop_fleet().await;
            w.pass(rng.random_range(0..40)).await;
            w.start_fleet();
            w.step().await;
        }
        projections_agree(&mut w).await;
    }
    all_is_well_again(&mut w).await;
    projections_agree(&mut w).await;
    w.lawful().await;
}

/// Every trouble ends; then every task must end, or be before a person, and no robot may be kept for nothing.
async fn all_is_well_again(w: &mut World) {
    for id in w.robot_ids() {
        let robot = w.r(&id);
        robot.mend();
        robot.answer = Answer::Accept;
        robot.confirms = true;
        robot.fails = None;
        robot.load = None;
        robot.set_hardware_stop(HardwareStop::None);
        robot.set_mode(Mode::Automatic);
        w.connect(&id).await;
        w.pass(3).await;
        w.resume(&id).await;
        let uncordon = v1::UncordonRobotRequest { robot_id: id, ..Default::default() };
        w.fleet.uncordon_robot(local(uncordon)).await.expect("uncordoned");
    }
    // What waits for a task that failed would wait for ever.
    let waiting = w.seen().await.all::<TaskState>().into_iter().filter(|t| t.phase == Phase::Queued);
    for task in waiting.collect::<Vec<_>>() {
        w.cancel(task.task_id.as_str(), false).await;
    }
    w.until("every task has ended or is before a person, and every robot is free", |s| {
        let over = |p: Phase| p.is_terminal() || p == Phase::NeedsOperator;
        let tasks = s.all::<TaskState>().iter().all(|t| over(t.phase));
        tasks && s.all::<RobotAuthority>().iter().all(|a| a.holder == RobotHolder::None)
    })
    .await;
    w.until("no place is closed or held by nobody", |s| {
        s.all::<Place>()
            .iter()
            .all(|p| p.quarantine.is_none() && p.holders.iter().all(|h| h.state == HolderState::Inside))
    })
    .await;
}

#[tokio::test(start_paused = true)]
async fn a_projection_built_from_rows_is_not_set_back_by_older_entries_and_goes_on_behind_its_mark() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
    let snapshot = w.store.read(&alive(), named).await.expect("a snapshot");
    let now = w.clock.now();
    let mut view = FleetProjection::new(w.site.clone(), now, now);
    view.load(&snapshot.rows, snapshot.seq).expect("readable rows");
    let mark = view.marks["fleet"].row.seq;
    assert!(mark > Seq(0) && view.absorbed == mark);
    let before = slots(&view);
    let entries = w.store.feed(Seq(0), &[Log::Fleet], 5_000).await.expect("the feed").entries;
    let gone = entries.iter().filter(|e| e.table == Some(Table::Timer) && e.body.is_some()).count();
    assert!(gone > 0, "there were timers that are gone now");
    for entry in entries {
        let mut plan = Plan::default();
        absorb(&mut view, now, &Board::new(), &[entry], &mut plan);
        assert_eq!(slots(&view), before);
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn the_projection_kept_by_the_feed_is_the_one_built_from_the_rows_after_any_shift() {
    for seed in 0..12 {
        random_shift(CORRIDOR, &["park-a", "park-b"], &["A", "B"], seed).await;
    }
    let goals = ["D01", "A01", "L1-in", "C01", "B03", "Q01", "P02"];
    for seed in 102..106 {
        random_shift(DEMO, &["park-1", "park-2", "park-3", "park-4", "hold-a"], &goals, seed).await;
    }
}
