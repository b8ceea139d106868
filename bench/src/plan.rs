//! P6: how long one planning cycle of the fleet takes, beside a fixed reference loop of the same run. It is measured
//! whole; a server cuts it into turns.

use crate::figure::{Figure, percentile};
use midshift_core::fleet::view::{Rowed, View};
use midshift_core::fleet::{Board, Pace, Plan, Slice, cycle, found};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::{Inventory, ReportedState, Vitals};
use midshift_core::rows::{Record, Revision, Row};
use midshift_core::site::route::Router;
use midshift_core::site::{Site, grid};
use midshift_core::task::forms::Transport;
use midshift_core::task::{TaskIntake, TaskState};
use midshift_core::time::{LinkTime, Now, SiteTime, Utc};
use midshift_core::work::{Live, Session};
use std::sync::Arc;
use std::time::Instant;

/// Cells of a side of the free grid that robots and tasks are spread over.
const SIDE: usize = 120;
/// Cycles measured per size.
const CYCLES: usize = 15;
/// Steps of the reference loop.
const REFERENCE_STEPS: u64 = 20_000_000;

/// Plans at three sizes of fleet, each with half as many tasks again as robots.
pub fn run() -> anyhow::Result<Vec<Figure>> {
    let map =
        format!("type octile\nheight {SIDE}\nwidth {SIDE}\nmap\n{}", format!("{}\n", ".".repeat(SIDE)).repeat(SIDE));
    let site = Arc::new(grid::parse_map("bench", &map)?);
    let mut figures = Vec::new();
    for robots in [100, 1_000, 10_000] {
        let (mut known, mut new, mut reference) = (Vec::new(), Vec::new(), Vec::new());
        for round in 0..CYCLES as u64 {
            reference.push(reference_ms());
            let router = Arc::new(Router::new(site.clone()));
            new.push(cycle_ms(&site, &router, robots, round));
            known.push(cycle_ms(&site, &router, robots, round));
        }
        let beside: Option<(&str, &[f64])> = Some(("fixed reference loop", &reference));
        let what = format!("whole cycle, {robots} idle robots, {} tasks", waiting(robots));
        figures.push(Figure::of("P6", format!("{what}, p50"), "ms", &known, beside));
        figures.push(Figure::of("P6", format!("{what}, p99"), "ms", &[percentile(&known, 0.99)], beside));
        figures.push(Figure::of("P6", format!("{what}, no way known yet"), "ms", &new, beside));
    }
    Ok(figures)
}

/// Tasks that wait for so many robots.
fn waiting(robots: usize) -> usize {
    robots * 3 / 2
}

/// A fixed amount of dependent integer work: what this machine is worth at this moment.
fn reference_ms() -> f64 {
    let begun = instant();
    let mut x = 0x9e37_79b9_7f4a_7c15_u64;
    for _ in 0..REFERENCE_STEPS {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
    }
    std::hint::black_box(x);
    begun.elapsed().as_secs_f64() * 1e3
}

#[expect(clippy::disallowed_methods, reason = "a benchmark measures real time")]
fn instant() -> Instant {
    Instant::now()
}

fn cycle_ms(site: &Arc<Site>, router: &Arc<Router>, robots: usize, seed: u64) -> f64 {
    let now = Now {
        site: SiteTime(60_000),
        link: LinkTime(60_000),
        utc: Utc(1_800_000_000_000),
        wall: Utc(1_800_000_000_000),
    };
    let (mut view, board) = fleet(site, robots, waiting(robots), seed, now);
    view.router = router.clone();
    // One slice for all: what the whole fleet costs, however many turns it is cut into.
    let mut plan = Plan::of(Slice::of(2 * robots));
    found(&mut view, now, "", &Default::default(), &mut plan);
    let begun = instant();
    cycle(&mut view, now, &board, Pace::Wake, &mut plan);
    let took = begun.elapsed().as_secs_f64() * 1e3;
    assert!(
        plan.report.offers as usize >= robots * 9 / 10,
        "a benchmark of a planner that assigned nothing: {:?}",
        plan.report
    );
    took
}

fn fleet(site: &Arc<Site>, robots: usize, tasks: usize, seed: u64, now: Now) -> (View, Board) {
    let mut view = View::new(site.clone(), Now::default(), Now::default());
    let mut board = Board::new();
    let mut x = seed.wrapping_mul(0x2545_f491_4f6c_dd1d) | 1;
    let mut draw = |below: usize| {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x % below as u64) as usize
    };
    let cells = site.waypoints().len();
    // Goals repeat, as stations do.
    let goals: Vec<usize> = (0..400).map(|_| draw(cells)).collect();
    for i in 0..robots {
        let robot_id = RobotId::parse(&format!("rbt-{i:05}")).expect("a valid id");
        let inventory =
            Inventory { capabilities: vec!["pick".into(), "place".into()], payload_g: 10_000, ..Inventory::default() };
        let session = Session {
            robot_id: robot_id.clone(),
            session_epoch: 1,
            secret: Default::default(),
            boot_id: String::new(),
            ring: String::new(),
            inventory,
            applied_work: 0,
            applied_update: 0,
            places: Vec::new(),
            clock_offset_ms: None,
            installed: None,
            device_key: None,
            device_key_changed: false,
        };
        view.sessions.insert(session.id(), Rowed { revision: Revision(1), row: session });
        let waypoint = Some(site.waypoints()[draw(cells)].waypoint_id.clone());
        let vitals = Vitals { waypoint, battery_permille: 900, ..Vitals::default() };
        let live = Live {
            robot_id: robot_id.clone(),
            report: ReportedState { hb: 60, session_epoch: 1, vitals, ..ReportedState::default() },
            processed_at: now.link,
            processed_site: now.site,
            received_unix_ms: now.wall.0,
            progress_at: now.site,
            clock_offset_ms: None,
        };
        board.insert(robot_id, Arc::new(live));
    }
    for i in 0..tasks {
        let name = |at: usize| site.waypoints()[at].waypoint_id.to_string();
        let form = Transport {
            kind: "transport".into(),
            from_waypoint: name(goals[draw(goals.len())]),
            to_waypoint: name(goals[draw(goals.len())]),
            timeout_ms: Some(600_000),
            ..Transport::default()
        };
        let intake = TaskIntake {
            task_id: TaskId::parse(&format!("TASK-{i:06}")).expect("a valid id"),
            spec: form.into_raw().check("task", &|_| true).expect("a valid task"),
            actor: String::new(),
            request_id: String::new(),
            payload_hash: String::new(),
            created: now.utc,
            number: i as u64 + 1,
        };
        let state = TaskState::born(&intake);
        absorb(&mut view, &intake);
        absorb(&mut view, &state);
    }
    (view, board)
}

/// A row as the store has it.
fn absorb(view: &mut View, record: &impl Record) {
    let row = Row { key: record.key(), revision: Revision(1), index: record.index(), body: record.body() };
    view.absorb(&row.key, row.revision, Some(&row)).expect("a row of ours");
}
