//! What the judge finds in journals, what the person does in the fleet, and that work is drawn from its seed alone.

use midshift_agent::body::{Body, BodyOrder, PathPoint};
use midshift_core::ids::{PlaceId, RobotId, TaskId, WaypointId};
use midshift_core::site::{CORRIDOR, Site, text};
use midshift_core::step::StepKind;
use midshift_core::time::{SiteDuration, SiteTime};
use midshift_sim::behaviour::Behaviour;
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::{FaultRates, Injected};
use midshift_sim::handle::SimHandle;
use midshift_sim::journal::{self, Effect, Entry, Journal, Work};
use midshift_sim::judge::{Judge, Verdict};
use midshift_sim::person::{Deed, Person};
use midshift_sim::workload::{Workload, WorkloadConfig};
use midshift_sim::world::{ITEMS_PER_PLACE_MAX, SharedWorld, World, WorldConfig, lock};
use std::io::Write;
use std::sync::Arc;

fn robot(name: &str) -> RobotId {
    RobotId::parse(name).expect("a robot")
}
fn waypoint(name: &str) -> WaypointId {
    WaypointId::parse(name).expect("a waypoint")
}
fn place(name: &str) -> PlaceId {
    PlaceId::parse(name).expect("a place")
}
fn work(task: &str, step_index: u32) -> Option<Work> {
    Some(Work { task_id: TaskId::parse(task).expect("a task"), step_index })
}
fn entry(utc_ms: i64, name: &str, effect: Effect) -> Entry {
    Entry { utc_ms, site_ms: utc_ms as u64, robot_id: Some(robot(name)), effect }
}
fn stay(name: &str, from_ms: i64, to_ms: i64) -> [Entry; 2] {
    let place_id = place("corridor");
    [
        entry(from_ms, name, Effect::Entered { place_id: place_id.clone() }),
        entry(to_ms, name, Effect::Left { place_id }),
    ]
}
fn judge(capacity: u32, entries: impl IntoIterator<Item = Entry>) -> Verdict {
    let mut judge = Judge::new([(place("corridor"), capacity)]);
    entries.into_iter().for_each(|e| judge.judge_entry(&e));
    judge.verdict()
}
fn corridor() -> Arc<Site> {
    Arc::new(text::parse(CORRIDOR).expect("the corridor is a site"))
}
fn handle(site: &Arc<Site>, world: &SharedWorld, name: &str, start: &str) -> SimHandle {
    let config = BodyConfig { faults: FaultRates::none(), ..BodyConfig::new(robot(name), 1, waypoint(start)) };
    SimHandle::new(SimBody::new(config, site.clone(), world.clone(), SiteTime(0)).expect("a body"))
}
fn path(site: &Site, names: &[&str]) -> BodyOrder {
    let point = |name: &&str| {
        let at = site.waypoint(site.find(&waypoint(name)).expect("on the map"));
        PathPoint {
            waypoint: waypoint(name),
            x_mm: at.x_mm as i32,
            y_mm: at.y_mm as i32,
            speed_mm_s: 1_000,
            keep_off_mm: None,
        }
    };
    BodyOrder::Drive(names.iter().map(point).collect())
}

#[test]
fn two_bodies_in_an_exclusive_passage_are_found_from_what_they_drove() {
    let site = corridor();
    let world = World::new(WorldConfig::default(), &site).shared();
    let mut east = handle(&site, &world, "rbt-01", "wait-a");
    let mut west = handle(&site, &world, "rbt-02", "wait-b");
    east.start(SiteTime(0), path(&site, &["c-1", "c-2", "b-in"])).expect("starts");
    west.start(SiteTime(4_000), path(&site, &["c-2", "c-1", "a-in"])).expect("starts");
    for body in [&mut east, &mut west] {
        body.poll(SiteTime(60_000));
    }
    let verdict = lock(&world).judge().verdict();
    assert_eq!(verdict.exclusion_violations, 1, "{verdict:?}");
    assert_eq!(verdict.violations_by_robot.keys().collect::<Vec<_>>(), [&robot("rbt-02")]);
}

#[test]
fn one_after_the_other_is_no_violation_even_if_the_first_says_so_late() {
    let site = corridor();
    let world = World::new(WorldConfig::default(), &site).shared();
    let mut east = handle(&site, &world, "rbt-01", "wait-a");
    let mut west = handle(&site, &world, "rbt-02", "wait-b");
    east.start(SiteTime(0), path(&site, &["c-1", "c-2", "b-in"])).expect("starts");
    west.start(SiteTime(30_000), path(&site, &["c-2", "c-1", "a-in"])).expect("starts");
    west.poll(SiteTime(60_000));
    east.poll(SiteTime(60_000));
    let verdict = lock(&world).judge().verdict();
    assert_eq!((verdict.exclusion_violations, verdict.is_clean()), (0, true), "{verdict:?}");
}

#[test]
fn a_place_is_too_full_above_its_capacity_only() {
    let three = || [stay("rbt-01", 0, 100), stay("rbt-02", 50, 150), stay("rbt-03", 60, 70)].into_iter().flatten();
    assert_eq!(judge(3, three()).exclusion_violations, 0);
    assert_eq!(judge(2, three()).exclusion_violations, 1);
    assert_eq!(judge(1, three()).exclusion_violations, 2);
    let touching = [stay("rbt-01", 0, 100), stay("rbt-02", 100, 150)].into_iter().flatten();
    assert_eq!(judge(1, touching).exclusion_violations, 0);
}

#[test]
fn a_violation_is_still_counted_after_its_entries_were_dropped_from_memory() {
    let planted = [stay("rbt-01", 0, 100), stay("rbt-02", 50, 150)].into_iter().flatten();
    let quiet = (1..2_000).flat_map(|i| stay("rbt-01", i * 10_000, i * 10_000 + 5_000));
    assert_eq!(judge(1, planted.chain(quiet)).exclusion_violations, 1);
}

#[test]
fn a_step_done_twice_is_found_and_a_pick_after_a_return_is_not_one() {
    let item = "SKU-1#1".to_owned();
    let at = waypoint("A");
    let made =
        Entry { robot_id: None, ..entry(0, "rbt-01", Effect::Made { item: item.clone(), waypoint: at.clone() }) };
    let pick =
        |ms| entry(ms, "rbt-01", Effect::Picked { item: item.clone(), waypoint: at.clone(), work: work("T-1", 1) });
    let drop =
        |ms| entry(ms, "rbt-01", Effect::Placed { item: item.clone(), waypoint: at.clone(), work: work("T-1", 3) });
    let back =
        |ms| entry(ms, "rbt-01", Effect::Returned { item: item.clone(), waypoint: at.clone(), work: work("T-1", 1) });
    let twice = judge(1, [made.clone(), pick(1), drop(2), pick(3), drop(4)]);
    assert_eq!((twice.steps_done_twice, twice.items_conserved(), twice.is_clean()), (2, true, false));
    assert!(judge(1, [made.clone(), pick(1), back(2), pick(3), drop(4)]).is_clean());
    let conjured = judge(1, [made, pick(1), pick(2)]);
    assert_eq!((conjured.items_broken, conjured.items_conserved()), (1, false));
}

#[test]
fn a_full_place_ships_its_oldest_and_nothing_is_lost() {
    let site = corridor();
    let mut world = World::new(WorldConfig::default(), &site);
    world.stock(SiteTime(0), &waypoint("A"), "SKU-1", ITEMS_PER_PLACE_MAX as u32 + 3);
    let verdict = world.judge().verdict();
    assert_eq!((verdict.items_shipped, verdict.items_at_places), (3, ITEMS_PER_PLACE_MAX as u64));
    assert!(verdict.is_clean());
}

#[test]
fn without_stock_a_pick_finds_nothing() {
    let site = corridor();
    let mut world = World::new(WorldConfig::default(), &site);
    assert_eq!(world.pick(SiteTime(0), &robot("rbt-01"), &waypoint("A"), "SKU-1", None), None);
    world.stock(SiteTime(0), &waypoint("A"), "SKU-2", 1);
    assert_eq!(world.pick(SiteTime(0), &robot("rbt-01"), &waypoint("A"), "SKU-1", None), None);
    assert_eq!(world.pick(SiteTime(0), &robot("rbt-01"), &waypoint("A"), "", None).as_deref(), Some("SKU-2#1"));
}

#[test]
fn a_journal_cut_off_in_its_last_line_goes_on_after_the_last_whole_one() {
    let dir = tempfile::tempdir().expect("a directory");
    let path = dir.path().join("journal.jsonl");
    let [first, second] = stay("rbt-01", 1, 2);
    Journal::open(&path).expect("opens").append(first.clone());
    let mut file = std::fs::OpenOptions::new().append(true).open(&path).expect("opens");
    file.write_all(b"{\"utc_ms\":7,").expect("writes");
    assert_eq!(journal::read(&path).expect("reads"), std::slice::from_ref(&first));
    Journal::open(&path).expect("opens").append(second.clone());
    assert_eq!(journal::read(&path).expect("reads"), [first, second]);
}

#[test]
fn the_person_mends_a_jam_after_two_to_five_minutes() {
    let site = corridor();
    let world = World::new(WorldConfig::default(), &site).shared();
    let robots = [handle(&site, &world, "rbt-01", "A")];
    robots[0].inject(SiteTime(0), Injected::Jam);
    let mut person = Person::new(3);
    let mut mended = Vec::new();
    for seconds in 0..400 {
        let now = SiteTime(0) + SiteDuration::from_secs(seconds);
        let deeds = person.round(now, &robots, &|_| false);
        mended.extend(deeds.into_iter().map(|deed| (seconds, deed)));
    }
    assert!(matches!(&mended[..], [(120..=301, Deed::Cleared(id))] if *id == robot("rbt-01")), "{mended:?}");
    assert!(robots[0].lock().broken().is_none());
}

#[test]
fn the_person_carries_back_what_no_live_task_wants_and_leaves_the_rest() {
    let site = corridor();
    let stocked = WorldConfig { auto_stock: true, ..WorldConfig::default() };
    let world = World::new(stocked, &site).shared();
    let mut robot = handle(&site, &world, "rbt-01", "A");
    let task = TaskId::parse("T-1").expect("a task");
    robot.work_for(Some(&task), 1);
    let pick = StepKind::Action { name: "pick".to_owned(), params: serde_json::Map::new() };
    robot.start(SiteTime(0), BodyOrder::Act(pick)).expect("starts");
    let robots = [robot.clone()];
    let mut person = Person::new(3);
    let walk = |person: &mut Person, from: u64, live: bool| {
        let rounds = (from..from + 400).map(|s| SiteTime(s * 1000));
        rounds.flat_map(|now| person.round(now, &robots, &|_| live)).collect::<Vec<_>>()
    };
    assert_eq!(walk(&mut person, 0, true), []);
    assert!(robot.load().is_some());
    assert_eq!(walk(&mut person, 400, false), [Deed::CarriedBack(robot.robot_id().clone())]);
    assert_eq!(robot.load(), None);
    let verdict = lock(&world).judge().verdict();
    assert_eq!((verdict.items_at_places, verdict.is_clean()), (1, true));
}

#[test]
fn the_same_seed_draws_the_same_work_between_different_stations() {
    let site = corridor();
    let draw = |seed| {
        let mut work = Workload::new(WorkloadConfig::background(seed), &site).expect("two stations");
        (0..50).map(|_| (work.next_transport(), work.next_gap(60.0))).collect::<Vec<_>>()
    };
    assert_eq!(draw(5), draw(5));
    assert_ne!(draw(5), draw(6));
    assert!(draw(5).iter().all(|(t, _)| t.from_waypoint != t.to_waypoint && t.priority == Some(7)));
    let mean_s = draw(9).iter().map(|(_, gap)| gap.as_secs_f64()).sum::<f64>() / 50.0;
    assert!((30.0..100.0).contains(&mean_s), "{mean_s}");
}

#[test]
fn a_journal_names_each_software_that_began_on_a_body_also_one_that_dies_at_its_start() {
    let site = corridor();
    let world = World::new(WorldConfig::default(), &site).shared();
    let body = handle(&site, &world, "rbt-01", "wait-a");
    let came_with = body.lock().software().1.to_owned();
    let dies = Behaviour { crash_on_start: true, ..Behaviour::default() };
    body.lock().run_software(SiteTime(1_000), dies, "2.0.0".to_owned());
    let world = lock(&world);
    let ran = world.journal().tail().filter_map(|entry| match &entry.effect {
        Effect::Ran { version } => Some((entry.site_ms, version.as_str())),
        _ => None,
    });
    assert_eq!(ran.collect::<Vec<_>>(), [(0, came_with.as_str()), (1_000, "2.0.0")]);
}
