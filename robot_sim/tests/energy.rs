//! What the planner expects a trip to cost, and what it costs a simulated body.

use midshift_agent::body::{Body, BodyNews, BodyOrder, PathPoint};
use midshift_core::energy::fit::{AttemptWork, EnergySums, fit_robot};
use midshift_core::energy::{CAPACITY_MWH, EnergyRates, RobotEnergy, Trip};
use midshift_core::ids::{RobotId, TaskId, WaypointId};
use midshift_core::limits::CHARGE_RESERVE_PERMILLE;
use midshift_core::limits::STOP_SLOW_MM_S;
use midshift_core::site::route::Router;
use midshift_core::site::{DEMO, Site, WaypointIx, text};
use midshift_core::step::StepKind;
use midshift_core::time::SiteTime;
use midshift_sim::body::{BodyConfig, SPEED_MAX_MM_S, SimBody};
use midshift_sim::energy::EnergyScale;
use midshift_sim::faults::FaultRates;
use midshift_sim::world::{World, WorldConfig};
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use std::sync::Arc;

/// Trips that are driven.
const SEEDS: u64 = 200;
/// Robots at their fastest may spend so much less than was planned, times: planned is the slowest way.
const ABOVE_MAX: f64 = 2.0;

/// A draw for which the planner's reserve is enough by far, thousandths of the model's.
const HUNGRY_PERMILLE: u32 = 1_700;

/// What a trip was expected to cost, and what it did, milliwatt-hours.
struct Cost {
    planned: u64,
    spent: u64,
    /// What an agent would report of it.
    work: AttemptWork,
}

struct Driver {
    site: Arc<Site>,
    router: Router,
    body: SimBody,
    now: SiteTime,
    rng: StdRng,
}

impl Driver {
    fn new(seed: u64, draw_permille: u32) -> Self {
        let site = Arc::new(text::parse(DEMO).expect("the demo floor is a site"));
        let mut rng = StdRng::seed_from_u64(seed);
        let start = site.waypoints().choose(&mut rng).expect("waypoints").waypoint_id.clone();
        let world = World::new(WorldConfig { auto_stock: true, ..WorldConfig::default() }, &site).shared();
        let config = BodyConfig {
            faults: FaultRates::none(),
            battery_permille: Some(1_000),
            energy: EnergyScale { draw_permille, ..EnergyScale::default() },
            ..BodyConfig::new(RobotId::parse("rbt-01").expect("a name"), seed, start)
        };
        let body = SimBody::new(config, site.clone(), world, SiteTime(0)).expect("a body");
        Self { router: Router::new(site.clone()), site, body, now: SiteTime(0), rng }
    }
    fn here(&self) -> WaypointIx {
        let waypoint = self.body.state(self.now).waypoint.expect("it stands at a waypoint");
        self.site.find(&waypoint).expect("on the map")
    }
    fn carries_out(&mut self, order: BodyOrder) {
        self.body.start(self.now, order).expect("starts");
        loop {
            let news = self.body.poll(self.now);
            assert!(!news.iter().any(|n| matches!(n, BodyNews::Failed(_))), "{news:?}");
            if news.contains(&BodyNews::Done) {
                return;
            }
            self.now = self.body.next_change(self.now).expect("goes on").max(self.now);
        }
    }
    /// A goal that can be reached, at a speed that a robot may be made to drive.
    fn drives(&mut self, trip: &mut Trip, slowest: bool) {
        let here = self.here();
        let goals: Vec<WaypointId> = self.site.waypoints().iter().map(|w| w.waypoint_id.clone()).collect();
        let reachable = |goal: &WaypointId| self.router.route(here, self.site.find(goal)?).filter(|way| way.len() > 1);
        let way = loop {
            let goal = goals.choose(&mut self.rng).expect("goals");
            if let Some(way) = reachable(goal) {
                break way;
            }
        };
        trip.drive(self.router.distance_mm(here, *way.last().expect("a goal")).expect("a way"));
        let speed_mm_s = if slowest { STOP_SLOW_MM_S } else { self.rng.random_range(STOP_SLOW_MM_S..=SPEED_MAX_MM_S) };
        let point = |at: &WaypointIx| {
            let at = self.site.waypoint(*at);
            let (x_mm, y_mm) = (at.x_mm as i32, at.y_mm as i32);
            PathPoint { waypoint: at.waypoint_id.clone(), x_mm, y_mm, speed_mm_s, keep_off_mm: None }
        };
        let path = way.iter().skip(1).map(point).collect();
        self.carries_out(BodyOrder::Drive(path));
    }
    fn acts(&mut self, trip: &mut Trip, step: StepKind) {
        trip.act(&step);
        self.carries_out(BodyOrder::Act(step));
    }
}

fn action(name: &str) -> StepKind {
    let params = serde_json::Map::from_iter([("item".to_owned(), serde_json::Value::from("box"))]);
    StepKind::Action { name: name.to_owned(), params }
}

/// Transports, inspections and waits, one after the other.
fn trip(seed: u64, draw_permille: u32) -> Cost {
    let mut driver = Driver::new(seed, draw_permille);
    let mut trip = Trip::new(&RobotEnergy::MODEL, false, None);
    let mut actions = 0;
    let slowest = seed.is_multiple_of(4);
    driver.body.work_for(Some(&TaskId::parse("T1").expect("a task")), 0);
    for _ in 0..driver.rng.random_range(1..=4) {
        driver.drives(&mut trip, slowest);
        match driver.rng.random_range(0..3) {
            0 => {
                driver.acts(&mut trip, action("inspect"));
                actions += 1;
            }
            1 => {
                let duration_ms = driver.rng.random_range(0..60_000);
                driver.acts(&mut trip, StepKind::Wait { duration_ms });
            }
            _ => {
                driver.acts(&mut trip, action("pick"));
                driver.drives(&mut trip, slowest);
                driver.acts(&mut trip, action("place"));
                actions += 2;
            }
        }
    }
    let state = driver.body.state(driver.now);
    let work = AttemptWork {
        empty_mm: state.odometer_mm - state.loaded_odometer_mm,
        loaded_mm: state.loaded_odometer_mm,
        duration_ms: driver.now.since(SiteTime(0)).as_ms(),
        actions,
        energy_mwh: state.energy_mwh,
    };
    Cost { planned: trip.needed_mwh(), spent: state.energy_mwh, work }
}

/// Rates of a body of this draw, by all the trips.
fn fitted(draw_permille: u32) -> RobotEnergy {
    let mut sums = EnergySums::default();
    for seed in 0..SEEDS {
        assert!(sums.add(&trip(seed, draw_permille).work), "seed {seed}: nothing about it is absurd");
    }
    fit_robot(&sums, std::iter::once(&sums))
}

#[test]
fn no_trip_of_a_simulated_body_costs_more_than_was_planned_nor_far_less() {
    for seed in 0..SEEDS {
        let Cost { planned, spent, .. } = trip(seed, 1_000);
        assert!(spent <= planned, "seed {seed}: {spent} mWh were spent, {planned} planned");
        let above = planned as f64 / spent as f64;
        assert!(above <= ABOVE_MAX, "seed {seed}: {planned} mWh were planned, {above:.2} times the {spent} spent");
    }
}

#[test]
fn a_hungry_body_spends_more_than_was_planned_and_never_the_reserve() {
    let reserve = CAPACITY_MWH as u64 * CHARGE_RESERVE_PERMILLE / 1_000;
    let costs: Vec<Cost> = (0..SEEDS).map(|seed| trip(seed, HUNGRY_PERMILLE)).collect();
    assert!(costs.iter().any(|cost| cost.spent > cost.planned), "the margin alone is not enough");
    for Cost { planned, spent, .. } in costs {
        assert!(spent <= planned + reserve / 4, "{spent} mWh were spent, {planned} planned");
    }
}

#[test]
fn rates_that_are_fitted_to_a_simulated_body_are_its_own_and_explain_its_trips() {
    for draw_permille in [1_000, 2_000] {
        let robot = fitted(draw_permille);
        let EnergyRates { empty_mwh_per_km, loaded_mwh_per_km, idle_mw, action_mwh } = robot.rates;
        let model = EnergyRates::MODEL;
        let rates = [
            (empty_mwh_per_km, model.empty_mwh_per_km),
            (loaded_mwh_per_km, model.loaded_mwh_per_km),
            (idle_mw, model.idle_mw),
            // An inspection is shorter than a pick, so an action takes somewhat less than that.
            (action_mwh, model.action_mwh * 9 / 10),
        ];
        for (found, usual) in rates {
            let off = f64::from(found) / f64::from(usual) / f64::from(draw_permille) * 1_000.0 - 1.0;
            assert!(off.abs() < 0.1, "draw {draw_permille}: {robot:?}");
        }
        assert!(robot.error_permille.is_some_and(|error| error <= 20), "draw {draw_permille}: {robot:?}");
    }
}

#[test]
fn a_hungry_body_that_is_known_spends_less_than_is_planned() {
    let hungry = fitted(HUNGRY_PERMILLE);
    let margin = |robot: &RobotEnergy| {
        let mut trip = Trip::new(robot, false, None);
        trip.drive(100_000);
        trip.needed_mwh() as f64
    };
    let times = margin(&hungry) / margin(&RobotEnergy::MODEL);
    for seed in 0..SEEDS {
        let Cost { planned, spent, .. } = trip(seed, HUNGRY_PERMILLE);
        assert!(
            spent as f64 <= planned as f64 * times,
            "seed {seed}: {spent} mWh were spent, {planned} planned before"
        );
    }
}
