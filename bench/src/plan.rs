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
/// Ready tasks for each robot.
const READY_EACH: usize = 5;
/// Tasks for each robot that nothing can be done about now.
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
    /// Idle robots, and five ready tasks for each.
    Idle,
    /// The same on a floor with one charger, where every second robot has too little charge for any task.
    HalfLow,
    /// All robots have too little charge.
    Low,
    /// Idle robots, and tasks whose time has not come.
    Blocked,
    /// Idle robots, and no task.
    NoTask,
}

impl Fleet {
    const fn tasks_each(self) -> usize {
        match self {
            Self::Idle | Self::HalfLow | Self::Low => READY_EACH,
            Self::Blocked => BLOCKED_EACH,
            Self::NoTask => 0,
        }
    }

    fn is_low(self, nth: usize) -> bool {
        self == Self::Low || (self == Self::HalfLow && nth % 2 == 1)
    }

    /// Robots that get a task.
    const fn offers(self, robots: usize) -> usize {
        match self {
            Self::Idle => robots,
            Self::HalfLow => robots.div_ceil(2),
            Self::Low | Self::Blocked | Self::NoTask => 0,
        }
    }
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
        let mut reference = Vec::new();
        let mut known: [Vec<f64>; 5] = Default::default();
        let (mut new, mut contact) = (Vec::new(), Vec::new());
        for round in 0..args.cycles as u64 {
            reference.push(reference_ms());
            let free = Arc::new(Router::new(site.clone()));
            let (first, with_no_way) = cycle_ms(&site, &free, Fleet::Idle, robots, round);
            contact.push(first);
            new.push(with_no_way);
            let with_charger = Arc::new(Router::new(charged.clone()));
            cycle_ms(&charged, &with_charger, Fleet::HalfLow, robots, round);
            for (fleet, took) in
                [Fleet::Idle, Fleet::HalfLow, Fleet::Low, Fleet::Blocked, Fleet::NoTask].into_iter().zip(&mut known)
            {
                let (site, router) = if matches!(fleet, Fleet::HalfLow | Fleet::Low) {
                    (&charged, &with_charger)
                } else {
                    (&site, &free)
                };
                took.push(cycle_ms(site, router, fleet, robots, round).1);
            }
        }
        let beside: Option<(&str, &[f64])> = Some(("fixed reference loop", &reference));
        let mut tell = |what: String, took: &[f64]| figures.push(Figure::new("P6", what, "ms", took, beside));
        let [idle, half_low, low, blocked, no_task] = &known;
        let ready = robots * READY_EACH;
        for (what, took) in [
            (format!("whole cycle, {robots} idle robots, {ready} ready tasks"), idle),
            (format!("whole cycle, {robots} robots, half of low charge, {ready} ready tasks"), half_low),
        ] {
            tell(format!("{what}, p50"), took);
            tell(format!("{what}, p99"), &[percentile(took, 0.99)]);
        }
        tell(format!("whole cycle, {robots} idle robots, {ready} ready tasks, no way known yet"), &new);
        tell(format!("whole cycle, {robots} robots of low charge, one charger, {ready} ready tasks"), low);
        let later = robots * BLOCKED_EACH;
        tell(format!("whole cycle, {robots} idle robots, {later} tasks whose time is later"), blocked);
        tell(format!("whole cycle, {robots} idle robots, no task"), no_task);
        tell(format!("whole cycle, {robots} robots heard for the first time"), &contact);
    }
    Ok(figures)
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

/// Milliseconds of the cycle in which robots are heard for the first time, and of the one in which their tasks are there.
fn cycle_ms(site: &Arc<Site>, router: &Arc<Router>, kind: Fleet, robots: usize, seed: u64) -> (f64, f64) {
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
    let new_plan = || Plan::for_slice(Slice::for_decisions(4 * robots));
    let mut plan = new_plan();
    ensure_site_rows(&mut view, now, "", &Default::default(), &mut plan);
    let timed = |view: &mut FleetProjection, plan: &mut Plan| {
        let begun = instant();
        cycle(view, now, &board, Pace::Wake, plan);
        begun.elapsed().as_secs_f64() * 1e3
    };
    let contact = timed(&mut view, &mut plan);
    add_tasks(&mut view, kind, robots, seed, now);
    let mut plan = new_plan();
    let took = timed(&mut view, &mut plan);
    let (offers, meant) = (plan.report.offers as usize, kind.offers(robots));
    let is_meant = (meant * 9 / 10..=meant).contains(&offers);
    assert!(is_meant, "a benchmark of another plan than is meant, {kind:?}: {:?}", plan.report);
    (contact, took)
}

/// Draws from a seed, below a bound.
fn drawn(seed: u64) -> impl FnMut(usize) -> usize {
    let mut x = seed.wrapping_mul(0x2545_f491_4f6c_dd1d) | 1;
    move |below| {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x % below as u64) as usize
    }
}

fn fleet(site: &Arc<Site>, kind: Fleet, robots: usize, seed: u64, now: Now) -> (FleetProjection, Board) {
    let mut view = FleetProjection::new(site.clone(), Now::default(), Now::default());
    let mut board = Board::new();
    let mut draw = drawn(seed);
    let cells = site.waypoints().len();
    for i in 0..robots {
        let robot_id = RobotId::parse(&format!("rbt-{i:05}")).expect("a valid id");
        let inventory =
            Inventory { capabilities: vec!["pick".into(), "place".into()], payload_g: 10_000, ..Inventory::default() };
        let session = Session::new(robot_id.clone(), 1, inventory);
        view.sessions.insert(session.id().into(), RevisedRow { revision: Revision(1), row: session });
        let battery_permille = if kind.is_low(i) { LOW_PERMILLE } else { 900 };
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
    (view, board)
}

fn add_tasks(view: &mut FleetProjection, kind: Fleet, robots: usize, seed: u64, now: Now) {
    let site = view.site.clone();
    let mut draw = drawn(seed + 1);
    let not_before = (kind == Fleet::Blocked).then_some(Utc(now.utc.0 + 3_600_000));
    // Goals repeat, as stations do.
    let goals: Vec<usize> = (0..400).map(|_| draw(site.waypoints().len())).collect();
    for i in 0..robots * kind.tasks_each() {
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
            type_revision: None,
        };
        let state = TaskState::born(&intake);
        absorb(view, &intake);
        absorb(view, &state);
    }
}

/// A row as the store has it.
fn absorb(view: &mut FleetProjection, record: &impl Record) {
    let row = Row { key: record.key(), revision: Revision(1), index: record.index(), body: record.body() };
    view.absorb(&row.key, row.revision, Some(&row)).expect("a row of ours");
}
