//! P6: how long one planning cycle of the fleet takes, beside a fixed reference loop of the same run. It is measured
//! whole; a server cuts it into turns.

use crate::figure::{Figure, percentile};
use crate::old_store::{self, OldArgs};
use midshift_core::fleet::projection::{FleetProjection, RevisedRow};
use midshift_core::fleet::{Board, Pace, Plan, Slice, cycle, ensure_site_rows};
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::{Inventory, ReportedState, Vitals};
use midshift_core::rows::{Record, Revision, Row};
use midshift_core::session::Session;
use midshift_core::site::route::Router;
use midshift_core::site::{Site, grid, text};
use midshift_core::task::forms::Transport;
use midshift_core::task::{RawTask, TaskIntake, TaskState};
use midshift_core::time::{LinkTime, Now, SiteTime, Utc};
use std::sync::Arc;
use std::time::Instant;

/// Cells of a side of the free grid that robots and tasks are spread over.
const SIDE: usize = 120;
/// Side of the floor with one charger.
const CHARGED_SIDE: usize = 60;
/// Sizes of fleet, robots.
const SIZES: [usize; 3] = [100, 1_000, 10_000];
/// Of what is planned at one moment: how many tasks there are for each robot that nothing can be done about now.
const BLOCKED_EACH: usize = 10;
/// Battery that is enough for the way to a charger and for no task, permille.
const LOW_PERMILLE: u16 = 120;
/// Steps of the reference loop.
const REFERENCE_STEPS: u64 = 20_000_000;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub struct PlanArgs {
    /// Cycles of each fleet.
    #[arg(long, default_value_t = 15)]
    cycles: usize,
    /// Largest fleet of a cycle, robots.
    #[arg(long, default_value_t = 10_000)]
    largest: usize,
    /// Of a server.
    #[command(flatten)]
    pub old: OldArgs,
}

/// Which robots and tasks a cycle finds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fleet {
    /// Idle robots, and half as many tasks again.
    Idle,
    /// Robots with too little charge for any task, on a floor with one charger.
    LowBattery,
    /// Idle robots, and tasks whose time has not come.
    Blocked,
}

/// Plans for fleets of several sizes in this process, then asks servers.
pub async fn run(args: PlanArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let mut figures = cycles(&args)?;
    figures.extend(old_store::run(&args.old, say).await?);
    Ok(figures)
}

/// A free floor, and a square of junctions with lanes both ways and one charger in a corner.
fn floors() -> anyhow::Result<[Arc<Site>; 2]> {
    let map =
        format!("type octile\nheight {SIDE}\nwidth {SIDE}\nmap\n{}", format!("{}\n", ".".repeat(SIDE)).repeat(SIDE));
    let (mut waypoints, mut lanes) = (String::new(), String::new());
    for row in 0..CHARGED_SIDE {
        for column in 0..CHARGED_SIDE {
            let kind = if row + column == 0 { ", kind = \"charger\"" } else { "" };
            waypoints +=
                &format!("  {{ id = \"w{row}-{column}\", at = [{}, {}]{kind} }},\n", column * 1_000, row * 1_000);
            for (there, is_there) in
                [((row, column + 1), column + 1 < CHARGED_SIDE), ((row + 1, column), row + 1 < CHARGED_SIDE)]
            {
                if is_there {
                    let (here, there) = (format!("w{row}-{column}"), format!("w{}-{}", there.0, there.1));
                    lanes += &format!("  {{ path = [\"{here}\", \"{there}\", \"{here}\"] }},\n");
                }
            }
        }
    }
    let text = format!(
        "site_id = \"charged\"\nname = \"One charger\"\nmap_id = \"charged\"\nmap_version = \"1\"\n\
         area = [{{ id = \"hall\", speed_limit_mm_s = 1500 }}]\nwaypoint = [\n{waypoints}]\nlane = [\n{lanes}]\n"
    );
    Ok([Arc::new(grid::parse_map("bench", &map)?), Arc::new(text::parse(&text)?)])
}

fn cycles(args: &PlanArgs) -> anyhow::Result<Vec<Figure>> {
    let [site, charged] = floors()?;
    let mut figures = Vec::new();
    for robots in SIZES.into_iter().filter(|robots| *robots <= args.largest) {
        let (mut known, mut new, mut reference) = (Vec::new(), Vec::new(), Vec::new());
        let (mut low, mut blocked) = (Vec::new(), Vec::new());
        for round in 0..args.cycles as u64 {
            reference.push(reference_ms());
            let router = Arc::new(Router::new(site.clone()));
            new.push(cycle_ms(&site, &router, Fleet::Idle, robots, round));
            known.push(cycle_ms(&site, &router, Fleet::Idle, robots, round));
            blocked.push(cycle_ms(&site, &router, Fleet::Blocked, robots, round));
            let router = Arc::new(Router::new(charged.clone()));
            low.push(cycle_ms(&charged, &router, Fleet::LowBattery, robots, round));
        }
        let beside: Option<(&str, &[f64])> = Some(("fixed reference loop", &reference));
        let what = format!("whole cycle, {robots} idle robots, {} tasks", waiting(robots));
        figures.push(Figure::new("P6", format!("{what}, p50"), "ms", &known, beside));
        figures.push(Figure::new("P6", format!("{what}, p99"), "ms", &[percentile(&known, 0.99)], beside));
        figures.push(Figure::new("P6", format!("{what}, no way known yet"), "ms", &new, beside));
        let what = format!("whole cycle, {robots} robots of low charge, one charger, {} tasks", waiting(robots));
        figures.push(Figure::new("P6", what, "ms", &low, beside));
        let what = format!("whole cycle, {robots} idle robots, {} tasks whose time is later", robots * BLOCKED_EACH);
        figures.push(Figure::new("P6", what, "ms", &blocked, beside));
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

fn cycle_ms(site: &Arc<Site>, router: &Arc<Router>, kind: Fleet, robots: usize, seed: u64) -> f64 {
    let now = Now {
        site: SiteTime(60_000),
        link: LinkTime(60_000),
        utc: Utc(1_800_000_000_000),
        wall: Utc(1_800_000_000_000),
        jump: None,
    };
    let (mut view, board) = fleet(site, kind, robots, seed, now);
    view.router = router.clone();
    // One slice for all: what the whole fleet costs, however many turns it is cut into.
    let mut plan = Plan::for_slice(Slice::for_decisions(2 * robots));
    ensure_site_rows(&mut view, now, "", &Default::default(), &mut plan);
    let begun = instant();
    cycle(&mut view, now, &board, Pace::Wake, &mut plan);
    let took = begun.elapsed().as_secs_f64() * 1e3;
    let offers = plan.report.offers as usize;
    let is_meant = if kind == Fleet::Idle { offers >= robots * 9 / 10 } else { offers == 0 };
    assert!(is_meant, "a benchmark of another plan than is meant, {kind:?}: {:?}", plan.report);
    took
}

fn fleet(site: &Arc<Site>, kind: Fleet, robots: usize, seed: u64, now: Now) -> (FleetProjection, Board) {
    let tasks = if kind == Fleet::Blocked { robots * BLOCKED_EACH } else { waiting(robots) };
    let not_before = (kind == Fleet::Blocked).then_some(Utc(now.utc.0 + 3_600_000));
    let battery_permille = if kind == Fleet::LowBattery { LOW_PERMILLE } else { 900 };
    let mut view = FleetProjection::new(site.clone(), Now::default(), Now::default());
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
        let session = Session::new(robot_id.clone(), 1, inventory);
        view.sessions.insert(session.id().into(), RevisedRow { revision: Revision(1), row: session });
        let waypoint = Some(site.waypoints()[draw(cells)].waypoint_id.clone());
        let vitals = Vitals { waypoint, battery_permille, ..Vitals::default() };
        let live = NewestHeartbeat {
            robot_id: robot_id.clone(),
            report: ReportedState { hb: 60, session_epoch: 1, vitals, ..ReportedState::default() },
            processed_at: now.link,
            processed_site: now.site,
            received_unix_ms: now.wall.0,
            progress_at: now.site,
            clock: None,
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
            spec: RawTask { not_before, ..form.into_raw() }.check("task", &|_| true).expect("a valid task"),
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
fn absorb(view: &mut FleetProjection, record: &impl Record) {
    let row = Row { key: record.key(), revision: Revision(1), index: record.index(), body: record.body() };
    view.absorb(&row.key, row.revision, Some(&row)).expect("a row of ours");
}
