//! What a simulated body does about operational stops, and what its journal says of that.

use midshift_agent::body::{Body, BodyOrder, PathPoint};
use midshift_core::ids::{RobotId, WaypointId};
use midshift_core::robot::StopLevel;
use midshift_core::site::{CORRIDOR, text};
use midshift_core::time::{SiteDuration, SiteTime};
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::{FaultRates, Injected};
use midshift_sim::journal::Effect;
use midshift_sim::world::{SharedWorld, World, WorldConfig, lock};
use std::sync::Arc;

/// At c-1 of the corridor, with the way to c-2, six metres on.
fn body() -> (SimBody, SharedWorld, PathPoint) {
    let site = Arc::new(text::parse(CORRIDOR).expect("the corridor is a site"));
    let world = World::new(WorldConfig::default(), &site).shared();
    let [start, waypoint] = ["c-1", "c-2"].map(|name| WaypointId::parse(name).expect("a waypoint"));
    let at = site.waypoint(site.find(&waypoint).expect("on the map"));
    let (x_mm, y_mm) = (at.x_mm as i32, at.y_mm as i32);
    let target = PathPoint { waypoint, x_mm, y_mm, speed_mm_s: 1_000, keep_off_mm: None };
    let mut config = BodyConfig::new(RobotId::parse("r1").expect("a name"), 1, start);
    config.faults = FaultRates::none();
    let body = SimBody::new(config, site, world.clone(), SiteTime(0)).expect("a body");
    (body, world, target)
}

/// What its journal says about stops: level, odometer at the stop, at its standstill and at its next motion.
fn stops(world: &SharedWorld) -> Vec<String> {
    let world = lock(world);
    let word = |effect: &Effect| match effect {
        Effect::Obeys { level, odometer_mm } => Some(format!("obeys {level:?} {odometer_mm}")),
        Effect::Stood { odometer_mm } => Some(format!("stood {odometer_mm}")),
        Effect::Moved { odometer_mm } => Some(format!("moved {odometer_mm}")),
        _ => None,
    };
    world.journal().tail().filter_map(|entry| word(&entry.effect)).collect()
}

#[test]
fn a_halt_keeps_its_order_and_its_journal_says_where_it_stood() {
    let (mut body, world, target) = body();
    body.start(SiteTime(0), BodyOrder::Drive(vec![target])).expect("drives");
    body.obeys(SiteTime(1_000), StopLevel::Halt);
    body.pause(SiteTime(1_000));
    assert_eq!((body.standstill(SiteTime(9_000)), body.state(SiteTime(9_000)).odometer_mm), (true, 1_333));
    body.obeys(SiteTime(9_000), StopLevel::None);
    body.resume(SiteTime(9_000));
    assert_eq!(body.state(SiteTime(9_500)).odometer_mm, 1_833);
    assert_eq!(stops(&world), ["obeys Halt 1000", "stood 1333", "obeys None 1333"]);
}

#[test]
fn a_body_that_is_driven_while_it_is_stopped_says_so() {
    let (mut body, world, target) = body();
    body.obeys(SiteTime(0), StopLevel::Halt);
    body.start(SiteTime(1_000), BodyOrder::Drive(vec![target])).expect("drives");
    body.stop(SiteTime(1_500), StopLevel::Halt);
    body.obeys(SiteTime(3_000), StopLevel::None);
    assert_eq!(stops(&world), ["obeys Halt 0", "stood 0", "moved 0", "stood 833", "obeys None 833"]);
}

#[test]
fn slow_holds_it_back_whatever_its_path_says_and_is_given_back() {
    let (mut body, world, target) = body();
    body.start(SiteTime(0), BodyOrder::Drive(vec![target])).expect("drives");
    body.obeys(SiteTime(1_000), StopLevel::Slow);
    let slowly_mm = body.state(SiteTime(2_000)).odometer_mm;
    assert!((1_299..=1_300).contains(&slowly_mm), "{slowly_mm} mm");
    body.obeys(SiteTime(2_000), StopLevel::None);
    let fast_mm = body.state(SiteTime(2_500)).odometer_mm;
    assert!((1_799..=1_800).contains(&fast_mm), "{fast_mm} mm");
    let said = stops(&world);
    assert!(said.len() == 2 && said[0] == "obeys Slow 1000" && said[1].starts_with("obeys None 1"), "{said:?}");
}

#[test]
fn a_posture_drops_the_order() {
    let (mut body, world, target) = body();
    body.start(SiteTime(0), BodyOrder::Drive(vec![target])).expect("drives");
    body.obeys(SiteTime(1_000), StopLevel::ControlledStopPosture);
    body.stop(SiteTime(1_000), StopLevel::ControlledStopPosture);
    body.resume(SiteTime(2_000));
    assert_eq!(body.state(SiteTime(9_000)).odometer_mm, 1_333);
    assert_eq!(stops(&world), ["obeys ControlledStopPosture 1000", "stood 1333"]);
}

#[test]
fn the_stop_line_falls_alone_and_with_the_network() {
    let (mut body, _world, _) = body();
    let (network, line) = (body.network(), body.stop_network());
    let up = || (*network.borrow(), *line.borrow());
    body.inject(SiteTime(0), Injected::DropStopLine(SiteDuration::from_secs(20)));
    assert_eq!(up(), (true, false));
    body.inject(SiteTime(10_000), Injected::DropNetwork(SiteDuration::from_secs(30)));
    assert_eq!(up(), (false, false));
    body.advance(SiteTime(20_000));
    assert_eq!(up(), (false, false));
    body.advance(SiteTime(40_000));
    assert_eq!(up(), (true, true));
}
