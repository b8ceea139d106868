//! What is engaged and how robots are, for people and programs.
//!
//! Invariant: counts are those of [`confirmation`], robot by robot and stop by stop, made without asking each robot about each stop.

use crate::confirm::{count, wall_at};
use crate::inner::Inner;
use crate::threads::lock;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::limits;
use midshift_core::stop::roster::{Heard, confirmation, means_everywhere};
use midshift_core::stop::{Scope, Stop};
use midshift_core::time::Now;
use midshift_proto::convert::WireEnum;
use midshift_proto::convert::stop::names;
use midshift_proto::stop::v1;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::sync::mpsc;
use tonic::Status;

/// Silence becomes visible at most this late.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// When robots were heard is told at least so often, even if nothing else changes.
const HEARD_EVERY: Duration = Duration::from_secs(5);

/// How many robots are how far with each of several stops.
struct Tally<'a> {
    stops: &'a [(Stop, u64)],
    index: BTreeMap<&'a StopId, usize>,
    /// Stops of the whole fleet, and of single robots.
    of_fleet: Vec<usize>,
    of_robots: BTreeMap<&'a RobotId, Vec<usize>>,
    newest: u64,
    counts: Vec<v1::Counts>,
    /// Robots that are not heard: for no stop they are anything else.
    unreachable: u32,
    heard: u32,
}

impl<'a> Tally<'a> {
    fn new(stops: &'a [(Stop, u64)]) -> Self {
        let index = stops.iter().enumerate().map(|(i, (stop, _))| (&stop.stop_id, i)).collect();
        let of_fleet = (0..stops.len()).filter(|i| stops[*i].0.scope == Scope::Fleet).collect();
        let mut of_robots: BTreeMap<&RobotId, Vec<usize>> = BTreeMap::new();
        for (i, (stop, _)) in stops.iter().enumerate() {
            if let Scope::Robot(robot_id) = &stop.scope {
                of_robots.entry(robot_id).or_default().push(i);
            }
        }
        let newest = stops.iter().map(|(_, since)| *since).max().unwrap_or_default();
        let counts = vec![v1::Counts::default(); stops.len()];
        Self { stops, index, of_fleet, of_robots, newest, counts, unreachable: 0, heard: 0 }
    }
    fn add(&mut self, robot_id: &RobotId, robot: Option<&Heard>, now: &Now) {
        let Some(heard) = robot.filter(|heard| is_heard(heard, now)) else {
            self.unreachable += 1;
            return;
        };
        self.heard += 1;
        if heard.generation < self.newest {
            let told = self.stops.iter().zip(&mut self.counts).filter(|((_, since), _)| heard.generation < *since);
            told.for_each(|(_, counts)| counts.requested += 1);
        }
        let own: &[usize] = self.of_robots.get(robot_id).map_or(&[], Vec::as_slice);
        let mut meant = self.of_fleet.len() + own.len();
        for stop_id in &heard.inside {
            let Some((at, (stop, since))) = self.index.get(stop_id).map(|at| (*at, &self.stops[*at])) else { continue };
            meant -= usize::from(means_everywhere(stop, robot_id));
            if heard.generation >= *since {
                count(&mut self.counts[at], confirmation(stop, *since, robot_id, Some(heard), now.link));
            }
        }
        if meant == 0 {
            return;
        }
        // Rare: it counts itself out of what is meant for it wherever it is.
        for at in self.of_fleet.iter().chain(own) {
            let (stop, since) = &self.stops[*at];
            self.counts[*at].requested +=
                u32::from(heard.generation >= *since && !heard.inside.contains(&stop.stop_id));
        }
    }
    fn finish(mut self) -> Vec<v1::Counts> {
        for counts in &mut self.counts {
            counts.unreachable = self.unreachable;
            let elsewhere = counts.requested + counts.acked + counts.standstill_confirmed;
            counts.outside = self.heard.saturating_sub(elsewhere);
        }
        self.counts
    }
}

/// Whether what a robot says of itself is how it is now.
fn is_heard(heard: &Heard, now: &Now) -> bool {
    now.link.since(heard.at) < limits::CHECK_IN_MISSED
}

/// The whole at one moment.
pub fn status(inner: &Inner) -> v1::Status {
    let now = inner.clock.now();
    let (mut stops, version, resets): (Vec<(Stop, u64)>, u64, BTreeSet<StopId>) = {
        let engaged_stops = lock(&inner.engaged_stops);
        let stops = engaged_stops.effective().map(|(stop, since)| (stop.clone(), since)).collect();
        (stops, engaged_stops.version(), engaged_stops.latch().resets().map(|reset| reset.stop_id.clone()).collect())
    };
    stops.sort_by(|(a, _), (b, _)| (a.engaged_unix_ms, &a.stop_id).cmp(&(b.engaged_unix_ms, &b.stop_id)));
    let mut tally = Tally::new(&stops);
    let mut robots = Vec::new();
    for robot in inner.robots.all() {
        let state = robot.state();
        let heard = state.heard.as_ref();
        tally.add(&robot.robot_id, heard, &now);
        robots.push(v1::RobotStatus {
            robot_id: robot.robot_id.to_string(),
            obeys: heard.map_or(0, |h| h.level.to_wire()),
            standstill: heard.is_some_and(|h| h.is_still),
            heard_unix_ms: heard.map_or(0, |h| wall_at(&now, h.at).0),
            awaiting_resume: heard.map(|h| names(&h.awaiting)).unwrap_or_default(),
            foreign_stops: names(state.foreign.difference(&resets)),
            durable: heard.is_some_and(|h| h.is_durable),
            heard: heard.is_some_and(|h| is_heard(h, &now)),
        });
    }
    let counts = tally.finish();
    let jump = inner.clock.last_jump();
    let engaged = stops.iter().zip(counts);
    let stops = engaged.map(|((stop, _), counts)| v1::EngagedStop { stop: Some(stop.into()), counts: Some(counts) });
    v1::Status {
        stops: stops.collect(),
        robots,
        durable: inner.disk.holds(version),
        audit_refused: inner.disk.refuses_audit(),
        principals_told_unix_ms: inner.principals.get().map_or(0, |told| told.borrow().0),
        site_id: inner.site_id.as_ref().map(ToString::to_string).unwrap_or_default(),
        clock_jump_ms: jump.map_or(0, |jump| jump.step_ms()),
        clock_jumped_unix_ms: jump.map_or(0, |jump| jump.to.0),
    }
}

/// The same without what changes with each check-in.
fn still(status: &v1::Status) -> v1::Status {
    let mut still = status.clone();
    still.robots.iter_mut().for_each(|robot| robot.heard_unix_ms = robot.heard_unix_ms.min(1));
    still
}

/// Tells the whole, again when it has changed, until the reader leaves.
pub async fn tell_status(inner: &Inner, sender: mpsc::Sender<Result<v1::WatchStatusResponse, Status>>) {
    let mut changed = inner.changed.subscribe();
    let mut told: Option<(v1::Status, tokio::time::Instant)> = None;
    loop {
        changed.mark_unchanged();
        let status = status(inner);
        let now = tokio::time::Instant::now();
        let shown = still(&status);
        let is_news = told.as_ref().is_none_or(|(before, at)| *before != shown || now - *at >= HEARD_EVERY);
        if is_news {
            told = Some((shown, now));
            if sender.send(Ok(v1::WatchStatusResponse { status: Some(status) })).await.is_err() {
                return;
            }
        }
        tokio::time::sleep(Duration::from_millis(limits::STOP_STATUS_EVERY.as_ms())).await;
        tokio::select! {
            () = sender.closed() => return,
            _ = changed.changed() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::AreaId;
    use midshift_core::robot::StopLevel;
    use midshift_core::stop::ladder::{Around, Stage};
    use midshift_core::time::{LinkTime, Utc};

    fn id(n: u64) -> StopId {
        StopId::parse(&format!("STOP-{n}")).unwrap()
    }

    /// Of the fleet, of an area, and of one robot.
    fn stop(n: u64, level: StopLevel) -> (Stop, u64) {
        let scope = match n % 4 {
            0 => Scope::Area(AreaId::parse("hall").unwrap()),
            1 => Scope::Robot(RobotId::parse("r1").unwrap()),
            _ => Scope::Fleet,
        };
        (Stop::new(id(n), scope, level, Utc(0)), n)
    }

    #[test]
    fn counts_are_those_of_each_robot_asked_about_each_stop() {
        let levels = [StopLevel::Slow, StopLevel::Halt, StopLevel::ControlledStopPosture];
        let stops: Vec<(Stop, u64)> = (1..=6).map(|n| stop(n, levels[n as usize % 3])).collect();
        let now = Now { link: LinkTime(10_000), ..Now::default() };
        let mut robots: Vec<Option<Heard>> = vec![None];
        for at in [7_000, 7_001, 9_000] {
            for generation in 0..=6 {
                for (level, is_still) in
                    [(StopLevel::Halt, true), (StopLevel::Slow, false), (StopLevel::ControlledStopPosture, true)]
                {
                    for inside in [vec![], vec![1, 2], vec![2, 3, 6, 99]] {
                        robots.push(Some(Heard {
                            at: LinkTime(at),
                            generation,
                            is_durable: true,
                            level,
                            is_still,
                            inside: inside.into_iter().map(id).collect(),
                            stage: Stage::Heard,
                            around: Around::People,
                            awaiting: BTreeSet::new(),
                        }));
                    }
                }
            }
        }
        let mut tally = Tally::new(&stops);
        let named: Vec<RobotId> = (0..robots.len()).map(|n| RobotId::parse(&format!("r{}", n % 3)).unwrap()).collect();
        named.iter().zip(&robots).for_each(|(robot_id, robot)| tally.add(robot_id, robot.as_ref(), &now));
        let counts = tally.finish();
        for ((stop, since), found) in stops.iter().zip(counts) {
            let mut one_by_one = v1::Counts::default();
            for (robot_id, robot) in named.iter().zip(&robots) {
                count(&mut one_by_one, confirmation(stop, *since, robot_id, robot.as_ref(), now.link));
            }
            assert_eq!(found, one_by_one, "{}", stop.stop_id);
        }
    }
}
