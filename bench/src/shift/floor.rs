//! Where a shift takes place, and the tasks that are asked for there.
//!
//! Maps and lists are read by their paths. Without any, a small grid is built in, and tasks are drawn between stations.

use anyhow::Context;
use midshift_cli::task_list::{read_list, request};
use midshift_core::site::file::Loaded;
use midshift_core::site::route::Router;
use midshift_core::site::{Site, grid};
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
    pub fn read(
        site: Option<&Path>,
        map: Option<&Path>,
        tasks: Option<&Path>,
        robots: usize,
        form: TaskForm,
    ) -> anyhow::Result<Self> {
        let (site, text) = match (site, map) {
            (None, None) => (Arc::new(grid::parse_map("shift", GRID)?), GRID.to_owned()),
            _ => {
                let Loaded { site, text, .. } = midshift_cli::site_file::load(site, map, Some(robots as u64))?;
                (site, text)
            }
        };
        let mut listed = tasks.map(|path| read_list(path, &site)).transpose()?.unwrap_or_default();
        if form == TaskForm::Visits {
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

    /// The way that a task asks for, from its first goal to its last, millimetres.
    fn way_mm(&self, request: &SubmitTaskRequest) -> u64 {
        let goals: Vec<_> = goals(request).iter().filter_map(|name| self.site.find(&name.parse().ok()?)).collect();
        goals.windows(2).filter_map(|pair| self.router.distance_mm(pair[0], pair[1])).sum()
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
    /// The next task, and the way that it asks for in millimetres. A list begins anew when it is over.
    pub fn next_task(&mut self) -> (SubmitTaskRequest, u64) {
        if self.left.is_empty() {
            self.left = (0..self.floor.listed.len()).collect();
            self.left.shuffle(&mut self.rng);
        }
        let request = match self.left.pop() {
            Some(at) => self.floor.listed[at].clone(),
            None => request(&self.drawn.next_transport()),
        };
        let way_mm = self.floor.way_mm(&request);
        (request, way_mm)
    }
}
