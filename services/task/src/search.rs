//! Walks over the tasks that a filter may admit, by the narrowest index of the store.
//!
//! Invariants:
//! 1. A walk reads no row twice, and what it leaves out the filter does not admit.
//! 2. It decides nothing: the caller holds each task against the whole filter.
//! 3. A body is decoded only if it holds each text that the filter asks for: most bodies of a long walk do not.
//!
//! Called by lists and watches.

use midshift_core::ids::TaskId;
use midshift_core::limits;
use midshift_core::rows::{Key, Row, Table};
use midshift_core::task::TaskIntake;
use midshift_proto::convert::task::TaskFilter;
use midshift_store::{Cursor, Error, Query, Store};
use std::collections::VecDeque;
use std::sync::Arc;

/// Fewest rows read at a time of one robot, where several are asked for.
const ROBOT_ROWS_MIN: usize = 10;
/// A read that has grown is so many times as large.
const GROWTH: usize = 4;

/// Which end of the list comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// As they were admitted.
    OldestFirst,
    /// The reverse.
    NewestFirst,
}

/// A walk over rows of `task_state`, or of `task_intake` where only what was asked for decides.
pub struct Search<'f> {
    filter: &'f TaskFilter,
    /// Texts that the body of an intake holds if the filter admits it.
    texts: Vec<String>,
    source: Source,
    direction: Direction,
    after: Option<Cursor>,
    /// Rows of one read.
    rows: usize,
}

enum Source {
    /// The ids are known.
    Named(VecDeque<Key>),
    /// A range of the key; the walk is by id.
    Prefix(Arc<str>),
    /// The index of the task's robot, one walk a robot.
    Robots(Vec<OfRobot>),
    /// The index of states; empty: every task.
    States(Vec<i64>),
    /// Every intake, which has the place of its task in the order of admission.
    Intakes,
}

struct OfRobot {
    robot_id: Arc<str>,
    ahead: VecDeque<Row>,
    /// Nothing is behind what was read.
    is_read: bool,
}

impl<'f> Search<'f> {
    /// Behind `after`, in reads of `rows` at most. Ids that are named are read in their own order, from the first one.
    pub fn new(filter: &'f TaskFilter, direction: Direction, after: Option<Cursor>, rows: usize) -> Self {
        let rows = rows.clamp(1, limits::PAGE_MAX);
        let is_live = !filter.phases.is_empty() && filter.phases.iter().all(|phase| !phase.is_terminal());
        let source = if !filter.task_ids.is_empty() {
            Source::Named(filter.task_ids.iter().map(|id| Key::new(Table::TaskState, id.as_str())).collect())
        } else if !filter.task_id_prefix.is_empty() {
            Source::Prefix(Arc::from(filter.task_id_prefix.as_str()))
        } else if !filter.robot_ids.is_empty() && !is_live {
            // Live tasks are few; those that ended with a robot are found by the robot.
            let robots = filter.robot_ids.iter().map(|id| Arc::from(id.as_str()));
            Source::Robots(robots.map(OfRobot::new).collect())
        } else if filter.phases.is_empty() && filter.robot_ids.is_empty() && filter.has_intake_conditions() {
            Source::Intakes
        } else {
            Source::States(filter.phases.iter().map(|phase| phase.number()).collect())
        };
        Self { filter, texts: collect_texts(filter), source, direction, after, rows }
    }

    /// The next rows; none: the walk is at its end.
    pub async fn next(&mut self, store: &dyn Store) -> Result<Vec<Row>, Error> {
        let query = Query {
            after: self.after.clone(),
            newest_first: self.direction == Direction::NewestFirst,
            limit: self.rows,
            ..Query::all(Table::TaskState)
        };
        let rows = match &mut self.source {
            Source::Named(keys) => return named(store, keys, query.limit).await,
            Source::Prefix(prefix) => store.list(query.of_prefix(prefix)).await?,
            Source::Robots(robots) => of_robots(store, robots, &query).await?,
            Source::States(states) => store.list(query.in_states(states.iter().copied())).await?,
            Source::Intakes => store.list(Query { table: Table::TaskIntake, ..query }).await?,
        };
        if let Some(last) = rows.last() {
            self.after = Some(Cursor::of_row(last));
        }
        Ok(rows)
    }

    /// Makes it read more at a time from now on: few of what it read were meant.
    pub fn grow(&mut self) {
        self.rows = (self.rows * GROWTH).min(limits::PAGE_MAX);
    }

    /// Those of `rows` that the filter may admit, by what the index says of them and by what was asked for.
    pub async fn find_candidates(&self, store: &dyn Store, rows: &[Row]) -> Result<Vec<TaskId>, Error> {
        let filter = self.filter;
        let may = |row: &&Row| {
            let robot_id = row.index.parent.as_deref();
            (filter.phases.is_empty() || filter.phases.iter().any(|phase| row.index.state == Some(phase.number())))
                && (filter.robot_ids.is_empty() || filter.robot_ids.iter().any(|id| robot_id == Some(id.as_str())))
        };
        let rows = rows.iter().filter(may);
        if matches!(self.source, Source::Intakes) {
            return Ok(rows.filter(|row| self.may_admit(row)).filter_map(parse_task_id).collect());
        }
        if self.texts.is_empty() {
            return Ok(rows.filter_map(parse_task_id).collect());
        }
        let intakes = store.get(rows.map(|row| Key::new(Table::TaskIntake, &row.key.id)).collect()).await?;
        Ok(intakes.iter().filter(|row| self.may_admit(row)).filter_map(parse_task_id).collect())
    }

    /// An intake with these texts that cannot be read is left to the caller, who says so.
    fn may_admit(&self, intake: &Row) -> bool {
        self.texts.iter().all(|text| intake.body.contains(text.as_str()))
            && intake.decode::<TaskIntake>().map_or(true, |intake| self.filter.admits_intake(&intake))
    }
}

/// Collects what the filter asks of an intake's texts, as JSON has them.
fn collect_texts(filter: &TaskFilter) -> Vec<String> {
    let kind = filter.kinds.first().filter(|_| filter.kinds.len() == 1);
    let reference = Some(&filter.external_ref).filter(|reference| !reference.is_empty());
    let texts = filter.labels.values().chain(kind).chain(reference);
    texts.filter_map(|text| serde_json::to_string(text).ok()).collect()
}

fn parse_task_id(row: &Row) -> Option<TaskId> {
    TaskId::parse(&row.key.id).ok()
}

async fn named(store: &dyn Store, keys: &mut VecDeque<Key>, rows: usize) -> Result<Vec<Row>, Error> {
    // A slice of which nothing exists is not the end.
    while !keys.is_empty() {
        let found = store.get(keys.drain(..rows.min(keys.len())).collect()).await?;
        if !found.is_empty() {
            return Ok(found);
        }
    }
    Ok(Vec::new())
}

impl OfRobot {
    fn new(robot_id: Arc<str>) -> Self {
        Self { robot_id, ahead: VecDeque::new(), is_read: false }
    }
}

/// Merges the walks of several robots until one of them must be read on.
async fn of_robots(store: &dyn Store, robots: &mut [OfRobot], query: &Query) -> Result<Vec<Row>, Error> {
    let limit = if robots.len() == 1 { query.limit } else { (query.limit / robots.len()).max(ROBOT_ROWS_MIN) };
    for robot in robots.iter_mut().filter(|robot| robot.ahead.is_empty() && !robot.is_read) {
        let of_robot = Query { limit, ..query.clone() }.of_parent(&robot.robot_id);
        robot.ahead = store.list(of_robot).await?.into();
        robot.is_read = robot.ahead.len() < limit;
    }
    let mut rows = Vec::new();
    while robots.iter().all(|robot| robot.is_read || !robot.ahead.is_empty()) {
        let next = robots.iter_mut().filter(|robot| !robot.ahead.is_empty());
        let place = |robot: &&mut OfRobot| robot.ahead.front().map(Cursor::of_row);
        let next = if query.newest_first { next.max_by_key(place) } else { next.min_by_key(place) };
        let Some(row) = next.and_then(|robot| robot.ahead.pop_front()) else { break };
        rows.push(row);
    }
    Ok(rows)
}
