//! How a simulated body moves, acts, fails, and comes back.

use midshift_agent::body::{Body, BodyNews, BodyOrder, Checked, PathPoint};
use midshift_core::ids::{RobotId, TaskId, WaypointId};
use midshift_core::robot::{Mode, StopLevel};
use midshift_core::site::{CORRIDOR, Site, text};
use midshift_core::step::StepKind;
use midshift_core::time::{SiteDuration, SiteTime};
use midshift_sim::behaviour::Behaviour;
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::{FaultRates, Injected};
use midshift_sim::world::{SharedWorld, World, WorldConfig, lock};
use proptest::prelude::*;
use std::sync::Arc;

fn site() -> Arc<Site> {
    Arc::new(text::parse(CORRIDOR).expect("the corridor is a site"))
}
fn waypoint(name: &str) -> WaypointId {
    WaypointId::parse(name).expect("a waypoint")
}
fn config(name: &str, start: &str) -> BodyConfig {
    let robot_id = RobotId::parse(name).expect("a robot");
    BodyConfig {
        faults: FaultRates::none(),
        battery_permille: Some(800),
        ..BodyConfig::new(robot_id, 7, waypoint(start))
    }
}
fn world(site: &Site) -> SharedWorld {
    World::new(WorldConfig { auto_stock: true, ..WorldConfig::default() }, site).shared()
}
fn body(start: &str) -> SimBody {
    let site = site();
    SimBody::new(config("rbt-01", start), site.clone(), world(&site), SiteTime(0)).expect("a body")
}
fn point(site: &Site, name: &str, speed_mm_s: u32) -> PathPoint {
    let at = site.waypoint(site.find(&waypoint(name)).expect("on the map"));
    PathPoint { waypoint: waypoint(name), x_mm: at.x_mm as i32, y_mm: at.y_mm as i32, speed_mm_s, keep_off_mm: None }
}
fn drive(names: &[&str]) -> BodyOrder {
    drive_at(names, 1_000)
}
fn drive_at(names: &[&str], speed_mm_s: u32) -> BodyOrder {
    let site = site();
    BodyOrder::Drive(names.iter().map(|n| point(&site, n, speed_mm_s)).collect())
}
fn act(name: &str, item: &str) -> BodyOrder {
    BodyOrder::Act(action(name, item))
}
fn action(name: &str, item: &str) -> StepKind {
    let params = serde_json::Map::from_iter([("item".to_owned(), serde_json::Value::from(item))]);
    StepKind::Action { name: name.to_owned(), params }
}
fn task(name: &str) -> TaskId {
    TaskId::parse(name).expect("a task")
}
/// Polls at each announced moment until `until`; returns what was said, with the moments.
fn run(body: &mut impl Body, from: SiteTime, until: SiteTime) -> Vec<(u64, BodyNews)> {
    let mut now = from;
    let mut heard = Vec::new();
    loop {
        heard.extend(body.poll(now).into_iter().map(|n| (now.0, n)));
        now = match body.next_change(now) {
            Some(next) if next <= until => next.max(now),
            _ => return heard,
        };
    }
}
fn reached(heard: &[(u64, BodyNews)]) -> Vec<String> {
    let name = |n: &BodyNews| if let BodyNews::Reached(w) = n { Some(w.to_string()) } else { None };
    heard.iter().filter_map(|(_, n)| name(n)).collect()
}
fn ended(heard: &[(u64, BodyNews)]) -> Vec<&BodyNews> {
    heard.iter().map(|(_, n)| n).filter(|n| matches!(n, BodyNews::Done | BodyNews::Failed(_))).collect()
}

#[test]
fn a_body_is_halfway_at_half_time_and_arrives_when_it_said() {
    let mut body = body("c-1");
    body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    let arrives = body.next_change(SiteTime(0)).expect("something comes");
    let leaves_contour = arrives;
    assert!(leaves_contour <= SiteTime(6_000));
    let half = body.state(SiteTime(3_000));
    assert_eq!((half.pose.x_mm, half.pose.y_mm, half.speed_mm_s, half.odometer_mm), (10_000, 1_000, 1_000, 3_000));
    let heard = run(&mut body, SiteTime(0), SiteTime(60_000));
    assert_eq!(heard.last(), Some(&(6_000, BodyNews::Done)));
    assert_eq!(body.state(SiteTime(6_000)).pose.x_mm, 13_000);
    assert!(body.standstill(SiteTime(6_000)));
}

#[test]
fn a_path_that_begins_with_the_rest_of_the_old_one_extends_it_without_a_stop() {
    let mut stopping = body("a-out");
    stopping.start(SiteTime(0), drive(&["wait-a", "c-1", "c-2"])).expect("starts");
    let whole = run(&mut stopping, SiteTime(0), SiteTime(60_000));
    let mut extended = body("a-out");
    extended.start(SiteTime(0), drive(&["wait-a", "c-1"])).expect("starts");
    let mut heard = run(&mut extended, SiteTime(0), SiteTime(2_000));
    let before = extended.state(SiteTime(2_000));
    extended.start(SiteTime(2_000), drive(&["c-1", "c-2"])).expect("extends");
    assert_eq!(extended.state(SiteTime(2_000)).pose, before.pose);
    assert_eq!(extended.state(SiteTime(2_001)).speed_mm_s, 1_000);
    heard.extend(run(&mut extended, SiteTime(2_000), SiteTime(60_000)));
    assert_eq!(reached(&heard), ["wait-a", "c-1", "c-2"]);
    assert_eq!(ended(&heard), [&BodyNews::Done]);
    let late = heard.last().expect("ends").0.abs_diff(whole.last().expect("ends").0);
    assert!(late <= 1, "{late} ms apart");
}

#[test]
fn a_path_that_still_names_the_waypoint_just_passed_does_not_turn_the_body_round() {
    let mut body = body("c-1");
    body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    body.start(SiteTime(2_000), drive(&["c-1", "c-2", "b-in"])).expect("goes on");
    let heard = run(&mut body, SiteTime(2_000), SiteTime(60_000));
    assert_eq!(reached(&heard), ["c-2", "b-in"]);
}

#[test]
fn a_paused_body_stands_keeps_its_order_and_goes_on() {
    let mut body = body("c-1");
    body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    body.pause(SiteTime(2_000));
    let stands = [2_000, 2_666, 2_667].map(|at| body.standstill(SiteTime(at)));
    assert_eq!(stands, [false, false, true], "from 1 m/s it brakes for two thirds of a second");
    assert_eq!(run(&mut body, SiteTime(2_000), SiteTime(50_000)), []);
    assert_eq!(body.state(SiteTime(50_000)).pose.x_mm, 9_333);
    body.resume(SiteTime(50_000));
    let heard = run(&mut body, SiteTime(50_000), SiteTime(99_000));
    assert_eq!(heard.last(), Some(&(53_667, BodyNews::Done)));
}

#[test]
fn a_body_that_is_let_go_while_it_brakes_drives_on_from_there() {
    let mut body = body("c-1");
    body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    body.pause(SiteTime(2_000));
    body.resume(SiteTime(2_300));
    assert_eq!(body.state(SiteTime(2_301)).speed_mm_s, 1_000);
    assert_eq!(run(&mut body, SiteTime(2_300), SiteTime(60_000)).last(), Some(&(6_068, BodyNews::Done)));
}

#[test]
fn a_body_that_is_stopped_shortly_before_a_waypoint_stands_there_and_enters_nothing_behind_it() {
    for is_kept in [true, false] {
        let mut body = body("a-out");
        body.start(SiteTime(0), drive(&["wait-a", "c-1", "c-2"])).expect("starts");
        assert_eq!(run(&mut body, SiteTime(0), SiteTime(800)), [], "200 mm before wait-a, and it needs 333");
        if is_kept {
            body.pause(SiteTime(800))
        } else {
            body.stop(SiteTime(800), StopLevel::Halt)
        }
        assert_eq!(run(&mut body, SiteTime(800), SiteTime(60_000)), []);
        let inside: Vec<&str> = body.inside().iter().map(|place| place.as_str()).collect();
        assert_eq!((body.standstill(SiteTime(60_000)), inside), (true, vec!["wait-a"]));
        if is_kept {
            body.resume(SiteTime(60_000));
        } else {
            body.start(SiteTime(60_000), drive(&["wait-a"])).expect("goes on");
        }
        assert_eq!(
            reached(&run(&mut body, SiteTime(60_000), SiteTime(60_001))),
            ["wait-a"],
            "it arrives when it goes on"
        );
    }
}

#[test]
fn a_stop_drops_the_order_and_slow_only_slows() {
    let mut body = body("c-1");
    body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    body.stop(SiteTime(1_000), StopLevel::Slow);
    assert_eq!(body.state(SiteTime(1_001)).speed_mm_s, 300);
    body.stop(SiteTime(2_000), StopLevel::Halt);
    assert_eq!([2_199, 2_200].map(|at| body.standstill(SiteTime(at))), [false, true]);
    assert_eq!(body.state(SiteTime(9_000)).pose.x_mm, 8_330);
    assert_eq!(ended(&run(&mut body, SiteTime(2_000), SiteTime(90_000))), [] as [&BodyNews; 0]);
}

#[test]
fn an_obstacle_that_goes_away_delays_and_one_that_stays_fails_recoverably() {
    let mut delayed = body("c-1");
    delayed.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    delayed.inject(SiteTime(1_000), Injected::Obstacle(SiteDuration::from_secs(4)));
    assert!(delayed.state(SiteTime(2_000)).field_violation);
    assert_eq!(run(&mut delayed, SiteTime(1_000), SiteTime(60_000)).last(), Some(&(10_000, BodyNews::Done)));
    let mut failed = body("c-1");
    failed.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    failed.inject(SiteTime(1_000), Injected::Obstacle(SiteDuration::from_secs(40)));
    let heard = run(&mut failed, SiteTime(1_000), SiteTime(60_000));
    assert!(matches!(ended(&heard)[..], [BodyNews::Failed(fault)] if fault.code == 1001));
    assert_eq!(heard.last().expect("failed").0, 11_000);
    failed.start(SiteTime(20_000), drive(&["c-2"])).expect("tries again");
    assert_eq!(run(&mut failed, SiteTime(20_000), SiteTime(60_000)).last(), Some(&(25_000, BodyNews::Done)));
}

#[test]
fn a_missed_pick_leaves_the_item_and_a_second_try_takes_it() {
    let mut body = body("A");
    body.inject(SiteTime(0), Injected::GripperMissed(1));
    body.work_for(Some(&task("T-1")), 1);
    body.start(SiteTime(0), act("pick", "SKU-1")).expect("starts");
    let heard = run(&mut body, SiteTime(0), SiteTime(20_000));
    assert!(matches!(ended(&heard)[..], [BodyNews::Failed(fault)] if fault.code == 1002));
    assert_eq!((body.load(), body.check(&action("pick", "SKU-1"), Some(&task("T-1")))), (None, Checked::NotDone));
    body.start(SiteTime(20_000), act("pick", "SKU-1")).expect("starts");
    run(&mut body, SiteTime(20_000), SiteTime(40_000));
    let load = body.load().expect("loaded");
    assert_eq!((load.task_id, load.item.as_str()), (Some(task("T-1")), "SKU-1"));
    assert_eq!(body.check(&action("pick", "SKU-1"), Some(&task("T-1"))), Checked::Done);
}

#[test]
fn a_jam_stands_until_a_person_clears_it() {
    let mut body = body("A");
    body.start(SiteTime(0), act("inspect", "")).expect("starts");
    body.inject(SiteTime(1_000), Injected::Jam);
    let heard = run(&mut body, SiteTime(1_000), SiteTime(90_000));
    assert!(
        matches!(&heard[..], [(_, BodyNews::Failed(a)), (_, BodyNews::Fault(b, true))] if a.code == 2001 && a == b)
    );
    assert!(body.start(SiteTime(90_000), act("inspect", "")).is_err());
    body.clear(SiteTime(100_000));
    assert!(matches!(body.poll(SiteTime(100_000))[..], [BodyNews::Fault(_, false)]));
    body.start(SiteTime(100_000), act("inspect", "")).expect("works again");
    assert_eq!(ended(&run(&mut body, SiteTime(100_000), SiteTime(120_000))), [&BodyNews::Done]);
}

#[test]
fn while_a_person_drives_it_takes_no_order_and_goes_on_with_the_old_one_afterwards() {
    let mut body = body("c-1");
    body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    body.inject(SiteTime(1_000), Injected::Manual(SiteDuration::from_secs(30)));
    assert_eq!(body.poll(SiteTime(1_000)), [BodyNews::Mode(Mode::Manual)]);
    assert!(body.start(SiteTime(2_000), drive(&["c-2"])).is_err());
    let heard = run(&mut body, SiteTime(2_000), SiteTime(99_000));
    assert_eq!(heard.first(), Some(&(31_000, BodyNews::Mode(Mode::Automatic))));
    assert_eq!(heard.last(), Some(&(35_667, BodyNews::Done)));
}

#[test]
fn a_dropped_network_comes_back_by_itself() {
    let mut body = body("A");
    let network = body.network();
    body.inject(SiteTime(0), Injected::DropNetwork(SiteDuration::from_secs(20)));
    assert!(!*network.borrow());
    assert_eq!(body.next_change(SiteTime(0)), Some(SiteTime(20_000)));
    body.poll(SiteTime(20_000));
    assert!(*network.borrow());
}

#[test]
fn an_empty_battery_stops_the_body_where_it_is() {
    let mut body = body("c-1");
    body.inject(SiteTime(0), Injected::LowBattery(0));
    let heard = run(&mut body, SiteTime(0), SiteTime(1_000));
    assert!(matches!(&heard[..], [(0, BodyNews::Fault(fault, true))] if fault.code == 2002));
    body.clear(SiteTime(5_000));
    assert_eq!(body.state(SiteTime(5_000)).battery_permille, 500);
}

#[test]
fn a_body_notes_the_passage_it_drives_through_and_the_standing_place_it_leaves() {
    let mut body = body("wait-a");
    let inside = |b: &SimBody| b.inside().iter().map(|p| p.as_str().to_owned()).collect::<Vec<_>>();
    assert_eq!(inside(&body), ["wait-a"]);
    body.start(SiteTime(0), drive(&["c-1", "c-2", "b-in"])).expect("starts");
    assert_eq!(inside(&body), ["corridor", "wait-a"]);
    run(&mut body, SiteTime(0), SiteTime(3_000));
    assert_eq!(inside(&body), ["corridor"]);
    run(&mut body, SiteTime(3_000), SiteTime(60_000));
    assert_eq!(inside(&body), [] as [&str; 0]);
}

/// A body whose software behaves so.
fn behaving(start: &str, faults: FaultRates, behaviour: Behaviour) -> SimBody {
    let site = site();
    let config = BodyConfig { behaviour, faults, software: "walk 1.5.0".to_owned(), ..config("rbt-01", start) };
    SimBody::new(config, site.clone(), world(&site), SiteTime(0)).expect("a body")
}

#[test]
fn software_makes_a_body_slower_hungrier_and_warmer() {
    let behaviour = Behaviour {
        speed_permille: 500,
        energy_permille: 3_000,
        joint_temperature_climb_millidegrees_per_s: 500,
        ..Behaviour::default()
    };
    let (mut usual, mut other) = (body("c-1"), behaving("c-1", FaultRates::none(), behaviour));
    assert_eq!((usual.capabilities().software, other.capabilities().software), ("1.0.0".into(), "walk 1.5.0".into()));
    for body in [&mut usual, &mut other] {
        body.start(SiteTime(0), drive(&["c-2"])).expect("starts");
    }
    let arrives = |body: &mut SimBody| run(body, SiteTime(0), SiteTime(60_000)).last().expect("arrives").0;
    assert_eq!((arrives(&mut usual), arrives(&mut other)), (6_000, 12_000));
    let rested = other.state(SiteTime(12_000));
    let (one, three) = (usual.state(SiteTime(72_000)), other.state(SiteTime(72_000)));
    let minute =
        |of: &SimBody, from: u64| of.state(SiteTime(from + 60_000)).energy_mwh - of.state(SiteTime(from)).energy_mwh;
    assert!(
        minute(&other, 12_000).abs_diff(3 * minute(&usual, 12_000)) <= 3,
        "a minute of standing costs three times as much"
    );
    assert!(three.hottest_joint_decidegrees > one.hottest_joint_decidegrees + 300, "36 degrees in 72 s");
    assert!(three.hottest_joint_decidegrees > rested.hottest_joint_decidegrees, "it climbs at rest too");
}

#[test]
fn joints_that_software_heated_cool_when_it_is_gone() {
    let folder = tempfile::tempdir().expect("a folder");
    let site = site();
    let open = |behaviour: Behaviour, at: u64| {
        let config = BodyConfig { behaviour, ..config("rbt-01", "c-1") };
        let (body, _) = SimBody::restore(config, site.clone(), WorldConfig::default(), folder.path(), SiteTime(at))
            .expect("a body");
        body
    };
    let hot = Behaviour { joint_temperature_climb_millidegrees_per_s: 1_000, ..Behaviour::default() };
    let mut body = open(hot, 0);
    body.poll(SiteTime(60_000));
    let heated = body.state(SiteTime(60_000)).hottest_joint_decidegrees;
    drop(body);
    let body = open(Behaviour::default(), 60_000);
    assert_eq!(body.state(SiteTime(60_000)).hottest_joint_decidegrees, heated);
    assert!(body.state(SiteTime(360_000)).hottest_joint_decidegrees < heated - 300);
}

#[test]
fn software_that_is_bad_under_load_jams_only_with_one() {
    let own = FaultRates { jam_per_action: 0.001, ..FaultRates::none() };
    let bad = Behaviour { fault_rate_permille: 1_000_000, faults_only_with_load: true, ..Behaviour::default() };
    let mut body = behaving("a-out", own, bad.clone());
    body.start(SiteTime(0), act("pick", "SKU-1")).expect("starts");
    assert_eq!(ended(&run(&mut body, SiteTime(0), SiteTime(9_000))), [&BodyNews::Done]);
    body.start(SiteTime(9_000), act("place", "SKU-1")).expect("starts");
    assert!(matches!(ended(&run(&mut body, SiteTime(9_000), SiteTime(20_000)))[..], [BodyNews::Failed(_)]));
    let always = Behaviour { faults_only_with_load: false, ..bad };
    let mut body = behaving("a-out", own, always);
    body.start(SiteTime(0), act("pick", "SKU-1")).expect("starts");
    assert!(matches!(ended(&run(&mut body, SiteTime(0), SiteTime(9_000)))[..], [BodyNews::Failed(_)]));
}

#[test]
fn a_killed_body_comes_back_where_it_was_with_its_load_its_battery_and_its_places() {
    let dir = tempfile::tempdir().expect("a directory");
    let site = site();
    let stock = WorldConfig { auto_stock: true, tag: "rbt-01".to_owned(), utc_base_ms: 1_000, crowded: false };
    let restore =
        |now| SimBody::restore(config("rbt-01", "A"), site.clone(), stock.clone(), dir.path(), now).expect("back");
    let (mut body, world) = restore(SiteTime(0));
    body.work_for(Some(&task("T-1")), 1);
    body.start(SiteTime(0), act("pick", "SKU-1")).expect("starts");
    run(&mut body, SiteTime(0), SiteTime(10_000));
    body.start(SiteTime(10_000), drive(&["a-out", "wait-a", "c-1", "c-2"])).expect("starts");
    run(&mut body, SiteTime(10_000), SiteTime(18_000));
    let (left, items) = (body.state(SiteTime(18_000)), lock(&world).judge().verdict());
    let inside = body.inside().clone();
    drop((body, world));

    let (body, world) = restore(SiteTime(5));
    let back = body.state(SiteTime(5));
    let moved = f64::hypot(f64::from(left.pose.x_mm - back.pose.x_mm), f64::from(left.pose.y_mm - back.pose.y_mm));
    assert!(moved <= 501.0, "{moved} mm");
    assert!(left.odometer_mm.abs_diff(back.odometer_mm) <= 501 && left.energy_mwh.abs_diff(back.energy_mwh) <= 100);
    assert_eq!((back.battery_permille, body.inside()), (left.battery_permille, &inside));
    assert_eq!(inside.iter().map(|p| p.as_str()).collect::<Vec<_>>(), ["corridor"]);
    assert_eq!(body.load().expect("loaded").task_id, Some(task("T-1")));
    assert_eq!(body.check(&action("pick", "SKU-1"), Some(&task("T-1"))), Checked::Done);
    assert_eq!(lock(&world).judge().verdict(), items);
    assert!(body.standstill(SiteTime(5)));
}

/// What an agent may ask, at any moment.
#[derive(Clone, Debug)]
enum Ask {
    Drive(Vec<usize>, u32),
    Pick,
    Place,
    Pause,
    Resume,
    Stop(u8),
    Inject(u8),
    Clear,
    Charge(bool),
}

const NAMES: [&str; 8] = ["A", "a-out", "wait-a", "c-1", "c-2", "b-in", "B", "b-far"];

fn asks() -> impl Strategy<Value = Vec<(u64, Ask)>> {
    let ask = prop_oneof![
        4 => (prop::collection::vec(0..NAMES.len(), 1..4), 200_u32..2_500).prop_map(|(path, speed)| Ask::Drive(path, speed)),
        2 => Just(Ask::Pick),
        2 => Just(Ask::Place),
        1 => Just(Ask::Pause),
        2 => Just(Ask::Resume),
        1 => (0_u8..4).prop_map(Ask::Stop),
        1 => (0_u8..6).prop_map(Ask::Inject),
        2 => Just(Ask::Clear),
        1 => any::<bool>().prop_map(Ask::Charge),
    ];
    prop::collection::vec((1_u64..9_000, ask), 1..60)
}

fn obey(body: &mut SimBody, now: SiteTime, ask: &Ask) {
    let started = match ask {
        Ask::Drive(path, speed) => {
            let names: Vec<&str> = path.iter().map(|i| NAMES[*i]).collect();
            body.start(now, drive_at(&names, *speed))
        }
        Ask::Pick => body.start(now, act("pick", "SKU-1")),
        Ask::Place => body.start(now, act("place", "SKU-1")),
        Ask::Pause => return body.pause(now),
        Ask::Resume => return body.resume(now),
        Ask::Stop(level) => {
            let levels = [StopLevel::None, StopLevel::Slow, StopLevel::Halt, StopLevel::ControlledStopPosture];
            return body.stop(now, levels[usize::from(*level)]);
        }
        Ask::Inject(0) => return body.inject(now, Injected::Obstacle(SiteDuration::from_secs(5))),
        Ask::Inject(1) => return body.inject(now, Injected::GripperMissed(1)),
        Ask::Inject(2) => return body.inject(now, Injected::Jam),
        Ask::Inject(3) => return body.inject(now, Injected::Manual(SiteDuration::from_secs(3))),
        Ask::Inject(4) => return body.inject(now, Injected::HardwareStop(SiteDuration::from_secs(3))),
        Ask::Inject(_) => {
            body.take_load(now);
            return;
        }
        Ask::Clear => return body.clear(now),
        Ask::Charge(on) => return body.charge(now, *on),
    };
    // A refusal leaves the body as it was, which is what the property is about.
    drop(started);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_body_jumps_charges_from_nothing_or_loses_an_item_whatever_is_asked(seed in 0_u64..1000, asks in asks()) {
        let site = site();
        let world = world(&site);
        let rates = FaultRates::default().times(40.0);
        let mut config = BodyConfig { faults: rates, seed, ..config("rbt-01", "A") };
        config.battery_permille = None;
        let mut body = SimBody::new(config, site.clone(), world.clone(), SiteTime(0)).expect("a body");
        let mut now = SiteTime(0);
        let mut was = body.state(now);
        let mut charges = false;
        for (wait_ms, ask) in &asks {
            let until = now + SiteDuration(*wait_ms);
            while now < until {
                let next = body.next_change(now).unwrap_or(until).min(until).min(now + SiteDuration(97));
                prop_assert!(next > now, "a polled body announced {next:?} at {now:?}");
                let is = body.state(next);
                let moved_mm = f64::hypot(f64::from(is.pose.x_mm - was.pose.x_mm), f64::from(is.pose.y_mm - was.pose.y_mm));
                let may_mm = next.since(now).as_secs_f64() * 1_500.0 + 2.0;
                prop_assert!(moved_mm <= may_mm, "{moved_mm} mm in {:?}", next.since(now));
                prop_assert!(is.odometer_mm >= was.odometer_mm && is.energy_mwh >= was.energy_mwh);
                prop_assert!(charges || is.battery_permille <= was.battery_permille);
                now = next;
                body.poll(now);
                was = is;
            }
            charges = *ask == Ask::Charge(true) || (charges && !matches!(ask, Ask::Charge(false)));
            obey(&mut body, now, ask);
            body.poll(now);
            let after = body.state(now);
            let jump_mm = f64::hypot(f64::from(after.pose.x_mm - was.pose.x_mm), f64::from(after.pose.y_mm - was.pose.y_mm));
            prop_assert!(jump_mm <= 1.5, "{ask:?} moved it {jump_mm} mm");
            prop_assert_eq!(body.load().is_some(), lock(&world).carrying().count() == 1);
            was = after;
        }
        let verdict = lock(&world).judge().verdict();
        prop_assert!(verdict.items_conserved(), "{verdict:?}");
    }
}

impl PartialEq for Ask {
    fn eq(&self, other: &Self) -> bool {
        matches!((self, other), (Self::Charge(a), Self::Charge(b)) if a == b)
    }
}
