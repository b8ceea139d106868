//! Where robots start, and what the simulator's own service says of them.

use midshift_agent::body::{Body, BodyOrder};
use midshift_core::ids::RobotId;
use midshift_core::site::{CORRIDOR, DEMO, Site, grid, text};
use midshift_core::step::StepKind;
use midshift_core::time::{Clock, Now, SiteTime, Utc};
use midshift_proto::sim::v1;
use midshift_proto::sim::v1::inject_fault_request::Fault;
use midshift_proto::sim::v1::sim_service_server::SimService;
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Error, Fleet, FleetConfig, Persistence};
use midshift_sim::service::SimFace;
use std::collections::BTreeSet;
use std::sync::Arc;
use tonic::{Code, Request};

/// A clock that stands at one moment, at twenty times the pace.
struct Moment(Now);

impl Clock for Moment {
    fn now(&self) -> Now {
        self.0
    }
    fn rate_permille(&self) -> u32 {
        20_000
    }
}

fn at(site_ms: u64) -> Now {
    Now { site: SiteTime(site_ms), utc: Utc(1_000_000 + site_ms as i64), ..Now::default() }
}
fn site(text: &str) -> Arc<Site> {
    Arc::new(text::parse(text).expect("a site"))
}
fn config(site: Arc<Site>, count: usize) -> FleetConfig {
    FleetConfig { faults: FaultRates::none(), ..FleetConfig::new(site, count, 7) }
}
fn robot(name: &str) -> RobotId {
    RobotId::parse(name).expect("a robot")
}
fn pick(fleet: &Fleet, name: &str) {
    let mut body = fleet.robot(&robot(name)).expect("lives here").clone();
    let pick = StepKind::Action { name: "pick".to_owned(), params: serde_json::Map::new() };
    body.start(SiteTime(0), BodyOrder::Act(pick)).expect("starts");
    body.poll(SiteTime(20_000));
    assert!(body.load().is_some());
}

#[test]
fn twenty_robots_start_in_the_demo_without_standing_in_each_other() {
    let fleet = Fleet::open(&config(site(DEMO), 20), &at(0)).expect("opens");
    assert_eq!(fleet.robots().len(), 20);
    let verdict = fleet.verdict().expect("judged");
    assert!(verdict.is_clean(), "{verdict:?}");
}

#[test]
fn more_robots_than_seats_are_refused_unless_a_crowd_is_wanted() {
    let crowd = config(site(CORRIDOR), 200);
    assert!(matches!(Fleet::open(&crowd, &at(0)), Err(Error::TooFewSeats { asked: 200, .. })));
    let fleet = Fleet::open(&FleetConfig { crowded: true, ..crowd }, &at(0)).expect("opens");
    assert_eq!(fleet.verdict().expect("judged").exclusion_violations, 0);
}

#[test]
fn on_a_grid_robots_start_on_seeded_cells_of_their_own() {
    let map = "type octile\nheight 3\nwidth 4\nmap\n....\n.@@.\n....\n";
    let grid = Arc::new(grid::parse_map("small", map).expect("a grid"));
    let starts = |seed| FleetConfig { seed, ..config(grid.clone(), 6) }.starting_waypoints().expect("seats");
    assert_eq!(starts(1).iter().collect::<BTreeSet<_>>().len(), 6);
    assert_eq!(starts(1), starts(1));
    assert_ne!(starts(1), starts(2));
    let charged = Arc::new(grid::parse_map("small", &map.replace("map\n.", "map\nC")).expect("a grid"));
    let all = FleetConfig { seed: 1, ..config(charged, 9) }.starting_waypoints().expect("seats");
    assert!(all.iter().all(|at| at.as_str() != "c0"), "a charger is nobody's start: {all:?}");
}

#[test]
fn processes_that_take_a_part_each_make_the_same_hall_together() {
    let dir = tempfile::tempdir().expect("a directory");
    let persistence = Persistence::Dir(dir.path().to_owned());
    let whole = FleetConfig { persistence, ..config(site(CORRIDOR), 3) };
    let part = |range| Fleet::open(&FleetConfig { only: Some(range), ..whole.clone() }, &at(0)).expect("opens");
    let fleets = [part(0..1), part(1..3)];
    let names: Vec<_> = fleets.iter().flat_map(|h| h.robots()).map(|r| r.robot_id().to_string()).collect();
    assert_eq!(names, ["rbt-01", "rbt-02", "rbt-03"]);
    drop(fleets);
    let again = Fleet::open(&whole, &at(500)).expect("comes back");
    assert!(again.verdict().expect("judged").is_clean());
}

#[test]
fn a_load_survives_the_process_and_the_journals_of_all_are_judged_together() {
    let dir = tempfile::tempdir().expect("a directory");
    let persistence = Persistence::Dir(dir.path().to_owned());
    let kept = FleetConfig { persistence, ..config(site(CORRIDOR), 2) };
    pick(&Fleet::open(&kept, &at(0)).expect("opens"), "rbt-02");
    let fleet = Fleet::open(&kept, &at(100_000)).expect("comes back");
    assert!(fleet.robot(&robot("rbt-02")).expect("lives here").load().is_some());
    let report = fleet.report(SiteTime(100_000)).expect("reported");
    assert_eq!((report.verdict.items_made, report.verdict.items_on_robots), (1, 1));
    assert!(report.verdict.is_clean());
}

fn face(fleet: &Arc<Fleet>) -> SimFace {
    SimFace::new(fleet.clone(), Arc::new(Moment(at(30_000))), Arc::new(|id: &RobotId| id.as_str() == "rbt-01"))
}
fn request(robot_id: &str, fault: Option<Fault>) -> Request<v1::InjectFaultRequest> {
    Request::new(v1::InjectFaultRequest { robot_id: robot_id.to_owned(), fault })
}

#[tokio::test]
async fn a_fault_reaches_its_robot_and_link_time_becomes_site_time() {
    let fleet = Arc::new(Fleet::open(&config(site(CORRIDOR), 2), &at(0)).expect("opens"));
    let duration = Some(prost_types::Duration { seconds: 20, nanos: 0 });
    let drop_network = Some(Fault::DropNetwork(v1::DropNetworkFault { duration }));
    face(&fleet).inject_fault(request("rbt-02", drop_network)).await.expect("injected");
    let mut body = fleet.robot(&robot("rbt-02")).expect("lives here").clone();
    assert!(!*body.network().borrow());
    body.poll(SiteTime(30_000 + 399_999));
    assert!(!*body.network().borrow());
    body.poll(SiteTime(30_000 + 400_000));
    assert!(*body.network().borrow());
    face(&fleet).inject_fault(request("rbt-01", Some(Fault::Jam(v1::JamFault {})))).await.expect("injected");
    assert!(fleet.robots()[0].lock().broken().is_some());
}

#[tokio::test]
async fn a_bad_injection_is_refused_with_its_reason() {
    let fleet = Arc::new(Fleet::open(&config(site(CORRIDOR), 2), &at(0)).expect("opens"));
    let jam = Some(Fault::Jam(v1::JamFault {}));
    let crash = || Some(Fault::Crash(v1::CrashFault {}));
    let manual = |duration| Some(Fault::Manual(v1::ManualFault { duration }));
    let too_many_nanos = Some(prost_types::Duration { seconds: 1, nanos: i32::MAX });
    let cases = [
        (request("rbt-09", jam), Code::NotFound),
        (request("rbt-01", None), Code::InvalidArgument),
        (request("rbt-01", manual(None)), Code::InvalidArgument),
        (request("rbt-01", manual(too_many_nanos)), Code::InvalidArgument),
        (request("rbt-02", crash()), Code::FailedPrecondition),
    ];
    for (request, code) in cases {
        let refused = face(&fleet).inject_fault(request).await.expect_err("refused");
        assert_eq!(refused.code(), code, "{refused:?}");
    }
    face(&fleet).inject_fault(request("rbt-01", crash())).await.expect("its agent runs here");
}

#[tokio::test]
async fn bodies_come_in_pages_and_the_world_is_counted() {
    let fleet = Arc::new(Fleet::open(&config(site(CORRIDOR), 3), &at(0)).expect("opens"));
    pick(&fleet, "rbt-03");
    let list = |page_token: String| v1::ListBodiesRequest { page_size: 2, page_token };
    let first = face(&fleet).list_bodies(Request::new(list(String::new()))).await.expect("listed").into_inner();
    let second = face(&fleet).list_bodies(Request::new(list(first.next_page_token.clone()))).await;
    let second = second.expect("listed").into_inner();
    let names: Vec<_> = first.bodies.iter().chain(&second.bodies).map(|b| b.robot_id.as_str()).collect();
    assert_eq!((names, second.next_page_token.as_str()), (vec!["rbt-01", "rbt-02", "rbt-03"], ""));
    assert_eq!((second.bodies[0].picks, second.bodies[0].item.as_str()), (1, "ITEM"));
    let world = face(&fleet).get_world(Request::new(v1::GetWorldRequest {})).await.expect("told").into_inner();
    assert_eq!((world.items_created, world.items_found, world.conserved, world.stocks.len()), (1, 1, true, 1));
}
