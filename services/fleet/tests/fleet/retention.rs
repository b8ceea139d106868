//! What is past its time goes, whatever stays beside it; what somebody still names stays.

use crate::harness::{BEGIN, World};
use crate::old_site::{DAY_MS, OldSite, commit, robot_id, spec, task_id};
use midshift_core::fleet::bugs::Bugs;
use midshift_core::fleet::rows::{RobotControl, RobotCounter};
use midshift_core::ids::{AttemptId, Subject};
use midshift_core::item::Item;
use midshift_core::presence::PresenceRow;
use midshift_core::rows::{Record, Table, Writer};
use midshift_core::session::Session;
use midshift_core::site::CORRIDOR;
use midshift_core::task::{Attempt, AttemptPhase, TaskState};
use midshift_core::time::{Clock, Utc};
use midshift_store::{MemoryStore, Store, StoreId, load};
use std::sync::Arc;
use std::time::Duration;

/// More than a page of them.
const ENDED: u64 = 2_500;

/// An old site whose first task ended `first_days` ago and whose last one `last_days` ago.
async fn world(first_days: i64, last_days: i64) -> World {
    let [from, until] = [first_days, last_days].map(|days| Utc(BEGIN.0 - days * DAY_MS));
    let old = OldSite { ended: ENDED, robots: 4, retired: 2, from, until };
    World::over(CORRIDOR, Bugs::default(), async |site_id, clock: Arc<dyn Clock>| {
        let store = MemoryStore::new(site_id, StoreId(Arc::from("old")), clock).with_log_entries_max(200_000);
        old.write(&store).await;
        let store: Arc<dyn Store> = Arc::new(store);
        store
    })
    .await
}

async fn prune(w: &World) -> u64 {
    midshift_fleet::prune(&*w.store, &*w.clock).await.expect("prunes")
}

async fn count(w: &World, table: Table) -> usize {
    w.store.snapshot(&[table]).await.expect("a snapshot").rows.len()
}

async fn has<R: Record>(w: &World, id: &str) -> bool {
    load::<R>(&*w.store, id).await.expect("a store").is_some()
}

#[tokio::test(start_paused = true)]
async fn all_that_ended_a_month_ago_goes_in_one_pass_with_its_attempts() {
    let w = world(60, 31).await;
    // Every third has two attempts. What is about the two retired robots goes beside them.
    assert!(prune(&w).await >= ENDED + ENDED + ENDED / 3);
    assert_eq!((count(&w, Table::TaskState).await, count(&w, Table::Attempt).await), (0, 0));
    assert_eq!(prune(&w).await, 0);
}

#[tokio::test(start_paused = true)]
async fn tasks_that_ended_late_shield_none_behind_them() {
    let w = world(60, 31).await;
    // The first two pages were admitted long ago and ended yesterday.
    let mut late = Item::new(Writer::Fleet, "tests");
    for number in 1..=2_000 {
        let (state, revision) =
            load::<TaskState>(&*w.store, task_id(number).as_str()).await.expect("a store").expect("one");
        late.update(&TaskState { changed: Utc(BEGIN.0 - DAY_MS), ..state }, revision, "task.succeeded");
        if late.rows.len() == 200 {
            let item = std::mem::replace(&mut late, Item::new(Writer::Fleet, "tests"));
            w.store.commit(vec![item]).await.remove(0).expect("applied");
        }
    }
    prune(&w).await;
    assert_eq!(count(&w, Table::TaskState).await, 2_000, "the five hundred behind them went");
}

#[tokio::test(start_paused = true)]
async fn a_task_that_a_live_task_names_stays_until_that_one_has_ended() {
    let mut w = world(60, 31).await;
    w.pass(11).await;
    w.submit_with("T1", "A", "B", |raw| raw.depends_on = vec!["old-3".to_owned()]).await;
    w.pass(1).await;
    prune(&w).await;
    assert_eq!(count(&w, Table::TaskState).await, 2, "the live one, and what it waits for");
    assert!(has::<TaskState>(&w, "old-3").await);
    w.cancel("T1", false).await;
    w.until_phase("T1", midshift_core::task::Phase::Canceled).await;
    prune(&w).await;
    assert!(!has::<TaskState>(&w, "old-3").await, "nobody waits for it any more");
}

#[tokio::test(start_paused = true)]
async fn errands_go_by_age_however_many_a_robot_had_and_those_of_this_month_stay() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "B").await;
    let done = |s: &crate::harness::Seen| s.all::<Attempt>().into_iter().find(|a| a.phase == AttemptPhase::Succeeded);
    let errand = done(&w.until("it has parked", |s| done(s).is_some()).await).expect("an errand");
    w.stop_fleet().await;
    let at = |days: i64| Utc(BEGIN.0 - days * DAY_MS);
    let older = |number: u64| {
        let subject = Subject::Errand { robot_id: errand.robot_id.clone(), number };
        // Number 2 to 501 are older than a month; the other hundred are not.
        let at = if number <= 501 { at(31) } else { at(2) };
        Attempt { attempt: AttemptId { subject, epoch: 1 }, offered: at, ended: Some(at), ..errand.clone() }
    };
    w.left_behind(&(2..=601).map(older).collect::<Vec<_>>()).await;
    assert_eq!(prune(&w).await, 500);
    assert_eq!(w.seen().await.all::<Attempt>().len(), 101, "those of this month, and the newest");
}

#[tokio::test(start_paused = true)]
async fn of_a_robot_the_newest_counter_stays_and_older_ones_go_after_a_month() {
    let w = world(60, 31).await;
    let counter = |software: &str, days: i64| RobotCounter {
        robot_id: robot_id(1),
        software: software.to_owned(),
        succeeded: 1,
        failures: Default::default(),
        stats: Default::default(),
        errands: Default::default(),
        attached_ms: 1,
        counted: Utc(BEGIN.0 - days * DAY_MS),
        energy_sums: Default::default(),
    };
    w.left_behind(&[counter("0.8.0", 50), counter("0.9.0", 40)]).await;
    prune(&w).await;
    let id = |software: &str| format!("{}@{software}", robot_id(1));
    assert!(!has::<RobotCounter>(&w, &id("0.8.0")).await && !has::<RobotCounter>(&w, &id("0.9.0")).await);
    assert!(has::<RobotCounter>(&w, &id("1.0.0")).await, "a month old, and of the software that it runs");
}

#[tokio::test(start_paused = true)]
async fn of_a_robot_that_was_retired_long_ago_only_that_it_was_stays() {
    let w = world(29, 1).await;
    let gone = robot_id(5);
    let rows = |w: &World| {
        let store = w.store.clone();
        let id = gone.to_string();
        async move {
            [
                load::<RobotControl>(&*store, &id).await.expect("a store").is_some(),
                load::<RobotCounter>(&*store, &format!("{id}@1.0.0")).await.expect("a store").is_some(),
                load::<Session>(&*store, &id).await.expect("a store").is_some(),
                load::<PresenceRow>(&*store, &id).await.expect("a store").is_some(),
            ]
        }
    };
    prune(&w).await;
    assert_eq!(rows(&w).await, [true; 4], "retired for 29 days");
    tokio::time::advance(Duration::from_secs(2 * 86_400)).await;
    prune(&w).await;
    let now = w.clock.now().utc;
    midshift_store::expired_rows::forget_robots(&*w.store, Writer::Telemetry, now).await.expect("forgets");
    assert_eq!(rows(&w).await, [true, false, false, false]);
    assert!(has::<Session>(&w, robot_id(1).as_str()).await, "one that works is silent, and stays");
}

/// Tables that grow with what robots and people do, each bounded by somebody else's test or on purpose not.
const ELSEWHERE: &[(Table, &str)] = &[
    (Table::TaskIntake, "goes after its task's state: services/task/tests/task/prune.rs"),
    (Table::RequestKey, "kept 7 days by intake: services/task/tests/task/prune.rs"),
    (Table::TaskRequest, "kept 30 days by intake: services/task/tests/task/prune.rs"),
    (Table::CommandKey, "kept 7 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::LaneMark, "of a replaced ring, by telemetry: services/telemetry/tests/link/retention.rs"),
    (Table::RobotControl, "one a robot that there ever was"),
    (Table::Bundle, "a month after anything names it: services/ota/src/retention/tests.rs"),
    (Table::Rollout, "the newest 1,000 that have ended: services/ota/src/retention/tests.rs"),
    (Table::RolloutRobot, "goes with its roll-out: services/ota/src/retention/tests.rs"),
    (Table::Quarantine, "goes with its bundle, or when a person lifts it: services/ota/src/retention/tests.rs"),
    (Table::OtaCommandKey, "kept 7 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::StopRecord, "of a stop that was reset, 90 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::Token, "a month after it is good for nothing: services/identity/tests/identity/retained.rs"),
    (Table::TokenName, "goes with its token: services/identity/tests/identity/retained.rs"),
    (Table::RobotIdentity, "of a retired robot, by identity: services/identity/tests/identity/retained.rs"),
    (Table::ServerCertificate, "a month after its end: services/identity/tests/identity/retained.rs"),
    (Table::TaskAudit, "kept 400 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::FleetAudit, "kept 400 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::OtaAudit, "kept 400 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::StopAudit, "kept 400 days: services/server/src/housekeeping/tests/aging.rs"),
    (Table::IdentityAudit, "kept 400 days: services/server/src/housekeeping/tests/aging.rs"),
];
/// Tables that do not grow with time, and why.
const STANDING: &[(Table, &str)] = &[
    (Table::Timer, "a deadline of what is under way; goes when that ends"),
    (Table::HoldToken, "a reason that holds a robot now; goes when it is lifted, and with its robot"),
    (Table::PlaceGrant, "one a place of a map"),
    (Table::PlaceBlock, "one a place of a map; goes with its time, or by a person"),
    (Table::TaskType, "at most 64, names of deleted ones for a month, at most 256"),
    (Table::RobotAuthority, "one a robot; goes with it"),
    (Table::Site, "one a store"),
    (Table::AreaPolicy, "one an area of a map"),
    (Table::PlannerPolicy, "one a store"),
    (Table::DesiredWork, "one a robot, written over; goes with it"),
    (Table::DesiredPolicy, "one a robot, written over; goes with it"),
    (Table::ServiceClock, "one a store"),
    (Table::FleetMark, "one a store"),
    (Table::Incident, "at most 10,000: the oldest goes for a new one"),
    (Table::Drain, "a robot that is out of work now, or waits for it; goes when it is given back"),
    (Table::AreaBudget, "one an area of a map"),
    (Table::FleetLeader, "one a store"),
    (Table::DrainRequest, "goes when fleet has given its robot back"),
    (Table::DrainRelease, "goes when fleet has given its robot back"),
    (Table::DesiredUpdate, "one a robot, written over; goes with it"),
    (Table::RobotSoftware, "one a robot, written over; goes with it"),
    (Table::AreaBundle, "one an area of a map, with one roll-out a model"),
    (Table::OtaMark, "one a store"),
    (Table::OtaClock, "one a store"),
    (Table::OtaLeader, "one a store"),
    (Table::RootCertificate, "one a site"),
];

#[test]
fn each_table_has_one_reason_and_the_tests_that_reasons_name_are_there() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let reasons = || ELSEWHERE.iter().chain(STANDING);
    for (table, reason) in reasons() {
        assert_eq!(reasons().filter(|(other, _)| other == table).count(), 1, "{table:?} has one reason");
        let path = reason.rsplit_once(": ").map(|(_, path)| path).filter(|path| path.starts_with("services/"));
        assert!(path.is_none_or(|path| root.join(path).exists()), "{table:?}: {reason}");
    }
}

/// Twenty tasks, an errand and a new version of software for one robot, and another robot that is retired.
async fn day_of_work(w: &World, day: u64) {
    let now = w.clock.now().utc;
    let site = OldSite { ended: 1_200, robots: 4, retired: 0, from: BEGIN, until: Utc(BEGIN.0 + 60 * DAY_MS) };
    commit(&*w.store, site.tasks((day - 1) * 20 + 1..day * 20 + 1, &spec())).await;
    commit(&*w.store, OldSite { from: now, until: now, ..site }.robot(4 + day)).await;
    let task = load::<Attempt>(&*w.store, &format!("{}/1", task_id(day * 20))).await.expect("a store").expect("one").0;
    let subject = Subject::Errand { robot_id: robot_id(1), number: day };
    w.left_behind(&[Attempt { attempt: AttemptId { subject, epoch: 1 }, offered: now, ended: Some(now), ..task }])
        .await;
    let counter = RobotCounter {
        robot_id: robot_id(1),
        software: format!("1.{day}.0"),
        succeeded: 1,
        failures: Default::default(),
        stats: Default::default(),
        errands: Default::default(),
        attached_ms: 1,
        counted: now,
        energy_sums: Default::default(),
    };
    w.left_behind(&[counter]).await;
}

#[tokio::test(start_paused = true)]
async fn after_sixty_days_no_table_holds_more_than_after_forty_five() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("unresolved", "A", "B").await;
    w.pass(1).await;
    w.stop_fleet().await;
    let mut held = Vec::new();
    for day in 1..=60 {
        tokio::time::advance(Duration::from_secs(86_400)).await;
        day_of_work(&w, day).await;
        prune(&w).await;
        for writer in Writer::ALL {
            let now = w.clock.now().utc;
            midshift_store::expired_rows::forget_robots(&*w.store, writer, now).await.expect("forgets");
        }
        if day >= 45 {
            let mut rows = Vec::new();
            for table in Table::ALL {
                rows.push((*table, count(&w, *table).await));
            }
            held.push(rows);
        }
    }
    let grows = |table: &Table| ELSEWHERE.iter().any(|(elsewhere, _)| elsewhere == table);
    for ((table, before), (_, after)) in held[0].iter().zip(&held[15]) {
        assert!(grows(table) || after <= before, "{table:?}: {before} rows after 45 days, {after} after 60");
        let says = grows(table) || STANDING.iter().any(|(standing, _)| standing == table) || *after > 1;
        assert!(says, "{table:?} must be filled here or say what bounds it");
    }
    assert!(count(&w, Table::Attempt).await > 600, "a month of them is there");
}
