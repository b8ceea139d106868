//! Where a shift takes place, and the tasks that are asked for there.
//!
//! Maps and lists are read by their paths. Without any, a small grid is built in, and tasks are drawn between stations.

use super::chargers::place_chargers;
use anyhow::{Context, ensure};
use midshift_cli::task_list::{read_list, request};
use midshift_core::site::file::{self, Loaded};
use midshift_core::site::route::Router;
use midshift_core::site::{Site, Source, WaypointIx, grid, lint};
use midshift_proto::task::v1::step::Kind;
use midshift_proto::task::v1::{Goto, Step, SubmitTaskRequest, TaskSpec, submit_task_request::Body};
use midshift_sim::workload::{Workload, WorkloadConfig};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::path::Path;
use std::sync::Arc;

/// Longest attempt of a task of this bench, seconds.
const TIMEOUT_S: i64 = 1_800;
/// The built-in floor: 14 × 9 cells, two rows of shelves between stations.
const GRID: &str = "type octile
height 9
width 14
map
E............E
..............
.S@@@S..S@@@S.
..@@@....@@@..
..............
..@@@....@@@..
.S@@@S..S@@@S.
..............
E............E
";

/// What floor, as it was asked for.
#[derive(Clone, Copy, Debug)]
pub struct FloorSource<'a> {
    /// Site file.
    pub site: Option<&'a Path>,
    /// Grid map; without it and a site the small one that is built in.
    pub map: Option<&'a Path>,
    /// List of tasks.
    pub tasks: Option<&'a Path>,
    /// Robots that work there.
    pub robots: usize,
    /// How a pair of places becomes a task.
    pub form: TaskForm,
}

/// A floor and its text.
pub struct Floor {
    /// The site.
    pub site: Arc<Site>,
    /// The text that it was read from.
    pub text: String,
    router: Router,
    listed: Vec<SubmitTaskRequest>,
}

/// How a pair of places becomes a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TaskForm {
    /// As it is listed: a transport picks and places.
    Listed,
    /// Two visits one after the other: no time goes into a gripper.
    Visits,
}

impl Floor {
    /// Reads a map or a site, and a list of tasks.
    ///
    /// # Errors
    /// A file that cannot be read, or its broken rules.
    pub fn read(source: FloorSource) -> anyhow::Result<Self> {
        let (site, text) = match (source.site, source.map) {
            (None, None) => (Arc::new(grid::parse_map("shift", GRID)?), GRID.to_owned()),
            (site, map) => {
                let robots = Some(source.robots as u64);
                let Loaded { site, text, .. } = midshift_cli::site_file::load(site, map, robots)?;
                (site, text)
            }
        };
        Self::open(site, text, source)
    }

    /// The built-in demo site, which has a door and an aisle for one. Nothing is listed there.
    ///
    /// # Errors
    /// It has no room for so many robots.
    pub fn demo(source: FloorSource) -> anyhow::Result<Self> {
        let Loaded { site, text, .. } = file::demo(Some(source.robots as u64))?;
        Self::open(site, text, FloorSource { tasks: None, ..source })
    }

    /// Checks that so many robots break no rule of the map. The fleet counts the seats when it takes them: on a grid
    /// each free cell that is no charger is one.
    ///
    /// # Errors
    /// The rules that they break.
    pub fn check_room(&self, robots: usize) -> anyhow::Result<()> {
        if self.site.collisions_modelled() {
            let findings = lint::lint(&self.site, Some(robots as u64));
            let words: Vec<&str> = findings.iter().map(|finding| finding.message.as_str()).collect();
            ensure!(!lint::refuses(&findings), "no room for {robots} robots: {}", words.join("; "));
        }
        Ok(())
    }

    /// The same floor with so many chargers, if it is a grid; a site has its own.
    ///
    /// # Errors
    /// The grid has no room for so many.
    pub fn with_chargers(&self, source: FloorSource, count: usize) -> anyhow::Result<Self> {
        if self.site.source() != Source::Grid || self.site.chargers().next().is_some() {
            return Self::open(self.site.clone(), self.text.clone(), source);
        }
        let goals = self.listed.iter().flat_map(goals);
        let needed = goals.filter_map(|name| name.strip_prefix('c')?.parse().ok()).collect();
        let text = place_chargers(&self.text, count, &needed)?;
        let site = grid::parse_map(self.site.site_id().as_str(), &text)?;
        Self::open(Arc::new(site), text, source)
    }

    fn open(site: Arc<Site>, text: String, source: FloorSource) -> anyhow::Result<Self> {
        let mut listed = source.tasks.map(|path| read_list(path, &site)).transpose()?.unwrap_or_default();
        if source.form == TaskForm::Visits {
            listed = listed.into_iter().map(as_visits).collect();
        }
        Ok(Self { router: Router::new(site.clone()), site, text, listed })
    }

    /// Tasks without end, in an order that the seed decides.
    ///
    /// # Errors
    /// If none are listed and the site has no two places to carry things between.
    pub fn tasks(self: &Arc<Self>, seed: u64) -> anyhow::Result<TaskSource> {
        let drawn = Workload::new(WorkloadConfig::background(seed), &self.site);
        let drawn = drawn.context("the site has no two stations")?;
        let rng = ChaCha8Rng::seed_from_u64(seed ^ 0x7368_6966_7421);
        Ok(TaskSource { floor: self.clone(), drawn, rng, left: Vec::new() })
    }

    /// The way through these goals in order, millimetres.
    pub fn way_mm(&self, goals: &[WaypointIx]) -> u64 {
        goals.windows(2).filter_map(|pair| self.router.distance_mm(pair[0], pair[1])).sum()
    }

    fn find_goals(&self, request: &SubmitTaskRequest) -> Vec<WaypointIx> {
        goals(request).iter().filter_map(|name| self.site.find(&name.parse().ok()?)).collect()
    }
}

/// Names of the places of a task, in order.
fn goals(request: &SubmitTaskRequest) -> Vec<String> {
    match &request.body {
        Some(Body::Flat(flat)) => vec![flat.from_waypoint.clone(), flat.to_waypoint.clone()],
        Some(Body::Spec(spec)) => {
            let goto = |step: &Step| match &step.kind {
                Some(Kind::Goto(goto)) => Some(goto.waypoint.clone()),
                _ => None,
            };
            spec.steps.iter().filter_map(goto).collect()
        }
        _ => Vec::new(),
    }
}

fn as_visits(request: SubmitTaskRequest) -> SubmitTaskRequest {
    let goto = |waypoint| Step { kind: Some(Kind::Goto(Goto { waypoint })), ..Step::default() };
    let spec = TaskSpec {
        r#type: "visit".to_owned(),
        priority: Some(7),
        steps: goals(&request).into_iter().map(goto).collect(),
        timeout: Some(prost_types::Duration { seconds: TIMEOUT_S, nanos: 0 }),
        ..TaskSpec::default()
    };
    SubmitTaskRequest { body: Some(Body::Spec(spec)), ..SubmitTaskRequest::default() }
}

/// Tasks of one shift.
pub struct TaskSource {
    floor: Arc<Floor>,
    drawn: Workload,
    rng: ChaCha8Rng,
    /// Of the list, those that this pass has not asked for yet.
    left: Vec<usize>,
}

impl TaskSource {
    /// The next task, and its goals in order. A list begins anew when it is over.
    pub fn next_task(&mut self) -> (SubmitTaskRequest, Vec<WaypointIx>) {
        if self.left.is_empty() {
            self.left = (0..self.floor.listed.len()).collect();
            self.left.shuffle(&mut self.rng);
        }
        let request = match self.left.pop() {
            Some(at) => self.floor.listed[at].clone(),
            None => request(&self.drawn.next_transport()),
        };
        let goals = self.floor.find_goals(&request);
        (request, goals)
    }
}
